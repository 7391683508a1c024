//! The tables of `muybridge bench`: matching beside OpenCV's in the same process, and clouds of people against their truth.
//! They need `../shared/data`; without it there is nothing to compare on, and that is said.

use std::path::Path;
use std::process::Command;

fn main() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    if !data.exists() {
        println!("skipped: {} is not there", data.display());
        return;
    }
    let mut sessions: Vec<_> = std::fs::read_dir(data.join("footage")).map(|d| d.flatten().map(|e| e.path()).collect()).unwrap_or_default();
    sessions.retain(|path| path.join("truth").exists());
    sessions.sort();
    run(Command::new(env!("CARGO_BIN_EXE_muybridge")).args(["bench", "stereo"]).arg(data.join("stereo")));
    run(Command::new(env!("CARGO_BIN_EXE_muybridge")).args(["bench", "clouds"]).args(sessions));
}

fn run(command: &mut Command) {
    let status = command.status().expect("the binary was built");
    assert!(status.success(), "{command:?} failed");
}
