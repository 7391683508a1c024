//! Ctrl-C: the first one ends long work at the next step, so that temporary folders go; the second one at once.

use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Result, ensure};

static STOP: AtomicBool = AtomicBool::new(false);

/// What a shell reports for a command that SIGINT ended.
const EXIT_CODE: i32 = 130;

/// Catches Ctrl-C from now on. Without the handler, which only a second call could miss, Ctrl-C ends the program at once.
pub fn catch() {
    let _ = ctrlc::set_handler(|| {
        if STOP.swap(true, Ordering::Relaxed) {
            std::process::exit(EXIT_CODE);
        }
    });
}

/// Whether Ctrl-C came.
pub fn came() -> bool {
    STOP.load(Ordering::Relaxed)
}

/// An error once Ctrl-C came.
pub fn check() -> Result<()> {
    ensure!(!came(), "interrupted; nothing was written, run the same command to begin again");
    Ok(())
}
