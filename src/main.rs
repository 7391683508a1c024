mod cli;

use clap::Parser;

fn main() -> std::process::ExitCode {
    cli::silence_opencv();
    match cli::run(cli::Cli::parse()) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            std::process::ExitCode::FAILURE
        }
    }
}
