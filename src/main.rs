/// The standard macros panic where nobody listens; see [`cli::say`].
macro_rules! println {
    () => { crate::cli::say::out(format_args!(""), "\n") };
    ($($text:tt)*) => { crate::cli::say::out(format_args!($($text)*), "\n") };
}
macro_rules! print {
    ($($text:tt)*) => { crate::cli::say::out(format_args!($($text)*), "") };
}
macro_rules! eprintln {
    ($($text:tt)*) => { crate::cli::say::err(format_args!($($text)*)) };
}

mod cli;

use anyhow::Context;
use clap::Parser;

fn main() -> std::process::ExitCode {
    cli::silence_opencv();
    cli::outlive_file_limits();
    let done = cli::run(cli::Cli::parse());
    let heard = || cli::say::lost().map_or(Ok(()), |error| Err(error).context("cannot write to standard output"));
    match done.and_then(|()| heard()) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", sentence(&error));
            std::process::ExitCode::FAILURE
        }
    }
}

/// The error with its causes on one line; a cause that the text before it tells already is not told again.
fn sentence(error: &anyhow::Error) -> String {
    let mut told = String::new();
    for cause in error.chain() {
        let text = cause.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
        if !told.contains(&text) {
            told += if told.is_empty() { "" } else { ": " };
            told += &text;
        }
    }
    told
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_are_told_once_and_on_one_line() {
        let io = std::io::Error::other("no\n  space");
        let error = anyhow::Error::new(io).context("cannot write a: no space").context("walk");
        assert_eq!(sentence(&error), "walk: cannot write a: no space");
        assert_eq!(sentence(&anyhow::anyhow!("inner").context("outer")), "outer: inner");
    }
}
