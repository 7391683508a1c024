//! What the program prints. A closed pipe (`muybridge batch list STUDY | head -1`) or a full disk behind stdout or stderr ends no
//! work and is no bug, as it would be with the standard macros, which panic; `println!`, `print!` and `eprintln!` of this program
//! are these functions.

use std::fmt::Arguments;
use std::io::{Error, ErrorKind, Write};
use std::sync::OnceLock;

use muybridge::io::with_remedy;

/// The first write to stdout that failed.
static LOST: OnceLock<Error> = OnceLock::new();

pub fn out(text: Arguments, end: &str) {
    let mut out = std::io::stdout().lock();
    if let Err(error) = out.write_fmt(text).and_then(|()| out.write_all(end.as_bytes())) {
        let _ = LOST.set(with_remedy(error));
    }
}

/// There is no place to say that stderr is lost.
pub fn err(text: Arguments) {
    let _ = writeln!(std::io::stderr().lock(), "{text}");
}

/// Why the end of what was printed did not arrive; whoever closes a pipe wants no more of it.
pub fn lost() -> Option<&'static Error> {
    if let Err(error) = std::io::stdout().lock().flush() {
        let _ = LOST.set(with_remedy(error));
    }
    LOST.get().filter(|error| error.kind() != ErrorKind::BrokenPipe)
}
