//! Progress of long work on stderr: a bar on a terminal, a line per tenth elsewhere.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Work of a known number of steps; may be shared between threads.
pub struct Progress {
    label: String,
    total: u64,
    done: AtomicU64,
    started: Instant,
    /// `None` where stderr is no terminal.
    bar: Option<ProgressBar>,
}

/// Starts showing the progress of `total` steps of `label`.
pub fn bar(label: &str, total: u64) -> Progress {
    let bar = std::io::stderr().is_terminal().then(|| {
        let template = ProgressStyle::with_template("{prefix:>12} {wide_bar} {pos}/{len} {eta} left");
        let style = template.unwrap_or_else(|_| ProgressStyle::default_bar());
        ProgressBar::new(total).with_style(style).with_prefix(label.to_string())
    });
    Progress { label: label.into(), total, done: AtomicU64::new(0), started: Instant::now(), bar }
}

impl Progress {
    /// Counts `steps` more as done.
    pub fn inc(&self, steps: u64) {
        let before = self.done.fetch_add(steps, Ordering::Relaxed);
        match &self.bar {
            Some(bar) => bar.inc(steps),
            None => {
                if let Some(line) = tenth_line(&self.label, before, before + steps, self.total) {
                    eprintln!("{line}");
                }
            }
        }
    }

    /// Ends the bar and says how long the work took.
    pub fn finish(self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        eprintln!("{}: done in {:.1} s", self.label, self.started.elapsed().as_secs_f64());
    }
}

/// The line to print when progress passes another tenth; the whole is `finish`'s.
fn tenth_line(label: &str, before: u64, after: u64, total: u64) -> Option<String> {
    let tenths = |done: u64| 10 * done / total.max(1);
    (tenths(after) > tenths(before) && after < total).then(|| format!("{label}: {after}/{total}"))
}

#[cfg(test)]
mod tests {
    use super::tenth_line;

    #[test]
    fn plain_lines_come_once_per_tenth_and_not_at_the_end() {
        let lines: Vec<_> = (0..37).filter_map(|i| tenth_line("clouds", i, i + 1, 37)).collect();
        assert_eq!(lines.len(), 9);
        assert_eq!(lines[0], "clouds: 4/37");
        assert_eq!(tenth_line("fit", 0, 3, 3), None);
        assert_eq!(tenth_line("fit", 0, 1, 0), None);
    }
}
