//! Speed over time as given on the command line or in a CSV file.
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use muybridge::motion::{Profile, Waypoint};

/// `0:0,2:1.4,6:3.0` (seconds:speed), or a CSV file with the columns `time_s,speed_m_s` and, if there are bends, `radius_m`
/// (positive to the left, empty or 0 straight on); `radius_m` bends the whole way of the first form.
pub fn read(text: &str, radius_m: Option<f64>) -> Result<Profile> {
    let waypoints = if text.contains(':') && !Path::new(text).is_file() {
        let curvature = radius_m.map_or(0.0, f64::recip);
        text.split(',').map(|part| pair(part, curvature)).collect::<Result<Vec<_>>>()?
    } else {
        from_csv(&std::fs::read_to_string(text).with_context(|| format!("cannot read {text}"))?, radius_m).context(text.to_string())?
    };
    Ok(Profile::new(waypoints)?)
}

fn pair(part: &str, curvature: f64) -> Result<Waypoint> {
    let wrong = || anyhow!("`{part}` is no SECONDS:SPEED, such as 2:1.4 or 2:5km/h");
    let (time, speed) = part.split_once(':').ok_or_else(wrong)?;
    let time_s = time.trim().trim_end_matches('s').parse().map_err(|_| wrong())?;
    Ok(Waypoint { time_s, speed_m_s: speed_m_s(speed).ok_or_else(wrong)?, curvature })
}

fn speed_m_s(text: &str) -> Option<f64> {
    let text = text.trim();
    let number = |t: &str| t.trim().parse::<f64>().ok();
    match text.strip_suffix("km/h") {
        Some(kmh) => Some(number(kmh)? / 3.6),
        None => number(text.strip_suffix("m/s").unwrap_or(text)),
    }
}

fn from_csv(text: &str, radius_m: Option<f64>) -> Result<Vec<Waypoint>> {
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
    let header: Vec<&str> =
        lines.next().map(|(_, l)| l.trim_start_matches('\u{feff}').split(',').map(str::trim).collect()).unwrap_or_default();
    let column = |name: &str| header.iter().position(|h| *h == name);
    let (Some(time), Some(speed)) = (column("time_s"), column("speed_m_s")) else {
        bail!("line 1 must name the columns time_s and speed_m_s, and radius_m for bends");
    };
    let radius = column("radius_m");
    let row = |(line, text): (usize, &str)| -> Result<Waypoint> {
        let cells: Vec<&str> = text.split(',').map(str::trim).collect();
        let number = |at: usize| -> Result<f64> {
            let cell = cells.get(at).copied().unwrap_or_default();
            cell.parse().map_err(|_| anyhow!("line {}: `{cell}` in column {} is no number", line + 1, header[at]))
        };
        let bend = match radius.filter(|at| cells.get(*at).is_some_and(|c| !c.is_empty())) {
            Some(at) => number(at)?,
            None => radius_m.unwrap_or(0.0),
        };
        let curvature = if bend == 0.0 { 0.0 } else { bend.recip() };
        Ok(Waypoint { time_s: number(time)?, speed_m_s: number(speed)?, curvature })
    };
    lines.map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_forms_say_the_same() {
        let points = from_csv("time_s,radius_m,speed_m_s\n0,,0\n\n2,-8,1.5\n", None).unwrap();
        assert_eq!(points[1], Waypoint { time_s: 2.0, speed_m_s: 1.5, curvature: -0.125 });
        assert_eq!(points[0].curvature, 0.0);
        let profile = read("0:0, 2s:5.4km/h,4:1.5m/s", Some(4.0)).unwrap();
        let (speed, curvature) = profile.at(1.0);
        assert!((speed - 0.75).abs() < 1e-12 && curvature == 0.25);
        assert_eq!(profile.at(3.0).0, profile.at(9.0).0);
    }

    #[test]
    fn wrong_ones_are_one_sentence() {
        let said = |text: &str| format!("{:#}", read(text, None).unwrap_err());
        assert!(said("0:0,2").contains("`2` is no SECONDS:SPEED"), "{}", said("0:0,2"));
        assert!(said("0:0,2:x").contains("no SECONDS:SPEED") && said("0:1").contains("at least two times"));
        assert!(said("1:0,2:1").contains("must increase from 0") && said("0:0,2:1,2:2").contains("must increase"));
        assert!(said("0:0,2:-1").contains("not negative") && said("nothing.csv").contains("cannot read nothing.csv"));
        let csv = |text: &str| from_csv(text, None).unwrap_err().to_string();
        assert!(csv("t,v\n0,0\n").contains("time_s and speed_m_s"));
        assert_eq!(csv("time_s,speed_m_s\n0,1\n2\n"), "line 3: `` in column speed_m_s is no number");
    }
}
