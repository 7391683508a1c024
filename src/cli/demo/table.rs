//! The demo's table, for the terminal and as CSV.

use std::fmt::Write;

/// One error with what it is to be set beside.
pub struct Row {
    pub quantity: String,
    pub value: f64,
    pub unit: &'static str,
    pub beside: Vec<(&'static str, f64)>,
}

impl Row {
    pub fn new(quantity: impl Into<String>, value: f64, unit: &'static str) -> Row {
        Row { quantity: quantity.into(), value, unit, beside: Vec::new() }
    }

    pub fn beside(mut self, name: &'static str, value: f64) -> Row {
        self.beside.push((name, value));
        self
    }
}

/// Aligned columns; `notes` stand below the errors.
pub fn text(rows: &[Row], notes: &str, seconds: &[(&'static str, f64)]) -> String {
    let mut text = format!("{:<44}{:>9}  {:<6}  {}\n", "error against the truth", "", "", "beside it");
    for row in rows {
        let beside: Vec<_> = row.beside.iter().map(|(name, value)| format!("{name} {}", number(*value))).collect();
        let line = format!("{:<44}{:>9}  {:<6}  {}", row.quantity, number(row.value), row.unit, beside.join(", "));
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{}", line.trim_end());
    }
    text.push_str(notes);
    text.push_str("\nseconds per stage\n");
    let total: f64 = seconds.iter().map(|s| s.1).sum();
    for (stage, value) in seconds.iter().chain([&("together", total)]) {
        let _ = writeln!(text, "{stage:<44}{value:>9.1}  s");
    }
    text
}

/// Three figures that count, without exponents.
fn number(value: f64) -> String {
    let decimals = if value.is_finite() && value != 0.0 { (2 - value.abs().log10().floor() as i32).clamp(0, 4) } else { 0 };
    format!("{value:.*}", decimals as usize)
}

/// `quantity,value,unit,beside,beside_value`; a row for every comparison. No seconds: the same bytes at every run.
pub fn csv(rows: &[Row]) -> String {
    let mut text = String::from("quantity,value,unit,beside,beside_value\n");
    for row in rows {
        let Row { quantity, value, unit, beside } = row;
        let quantity = quantity.replace(',', ";");
        if beside.is_empty() {
            let _ = writeln!(text, "{quantity},{value:.6},{unit},,");
        }
        for (name, other) in beside {
            let _ = writeln!(text, "{quantity},{value:.6},{unit},{name},{other:.6}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_aligned_and_every_comparison_has_its_line() {
        let rows =
            [Row::new("joints, absolute", 31.256, "mm"), Row::new("weights", 0.01234, "rad").beside("spread", 2.0).beside("people", 140.0)];
        let text = text(&rows, "notes\n", &[("fit", 3.21), ("clouds", 4.0)]);
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines[1].find("31.3"), Some(49));
        assert!(lines[2].contains("0.0123  rad     spread 2.00, people 140"), "{}", lines[2]);
        assert!(lines.last().unwrap().ends_with("7.2  s"));
        let csv = csv(&rows);
        assert_eq!(csv.lines().nth(1), Some("joints; absolute,31.256000,mm,,"));
        assert_eq!(csv.lines().nth(3), Some("weights,0.012340,rad,people,140.000000"));
    }
}
