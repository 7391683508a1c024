//! What several test files have in common.

// Not every one of them needs all.
#![allow(dead_code)]

use std::path::{Path, PathBuf};

use assert_cmd::Command;

/// A folder of the recordings beside the project; `None`, said, where they are not.
pub fn mocap(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap").join(folder);
    if !path.exists() {
        println!("skipped: {} is not there", path.display());
    }
    path.exists().then_some(path)
}

/// Runs the program: whether it succeeded, what it said, what it complained of.
pub fn run(arguments: &[&str]) -> (bool, String, String) {
    let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.success(), text(&output.stdout), text(&output.stderr))
}

/// A file of a folder as an argument.
pub fn path(folder: &Path, name: &str) -> String {
    folder.join(name).to_string_lossy().into_owned()
}
