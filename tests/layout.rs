//! Dependencies between modules point downwards only: the table of the layout, held against the `crate::` paths.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Module and the modules it may use; `math` is free to all.
const ALLOWED: [(&str, &[&str]); 15] = [
    ("math", &[]),
    ("rig", &[]),
    ("body", &[]),
    ("motion_model", &["body"]),
    ("footage", &["rig"]),
    ("clouds", &["footage", "rig"]),
    ("fit", &["clouds", "footage", "rig", "body", "motion_model"]),
    ("style", &["motion_model", "body"]),
    ("motion", &["style", "motion_model", "body"]),
    ("animal", &["footage", "body"]),
    ("phantom", &["rig", "body", "footage", "motion_model"]),
    ("io", &["rig", "body", "motion_model", "footage", "clouds", "fit", "style", "motion", "animal", "phantom"]),
    ("report", &["rig", "body", "motion_model", "footage", "clouds", "fit", "style", "motion", "animal", "phantom", "io"]),
    ("cli", &["rig", "body", "motion_model", "footage", "clouds", "fit", "style", "motion", "animal", "phantom", "io", "report"]),
    ("main.rs", &["cli"]),
];

fn rust_files(at: &Path) -> Vec<PathBuf> {
    if at.is_file() {
        return vec![at.to_path_buf()];
    }
    let mut files: Vec<PathBuf> = std::fs::read_dir(at).unwrap().flat_map(|e| rust_files(&e.unwrap().path())).collect();
    files.sort();
    files.retain(|f| f.extension().is_some_and(|e| e == "rs"));
    files
}

/// First segments of all `crate::` and `muybridge::` paths in code; doc comments may point anywhere.
fn used(text: &str) -> BTreeSet<String> {
    let code = text.lines().filter(|l| !l.trim_start().starts_with("//"));
    let mut found = BTreeSet::new();
    for line in code {
        for prefix in ["crate::", "muybridge::"] {
            for (at, _) in line.match_indices(prefix) {
                let rest = &line[at + prefix.len()..];
                let list = rest.strip_prefix('{').map_or(rest, |r| r.split('}').next().unwrap_or(r));
                let parts: Vec<&str> = if rest.starts_with('{') { list.split(',').collect() } else { vec![rest] };
                for part in parts {
                    let name: String = part.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                    found.insert(name);
                }
            }
        }
    }
    found
}

#[test]
fn dependencies_point_downwards() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut wrong = Vec::new();
    for (module, allowed) in ALLOWED {
        for file in rust_files(&src.join(module)) {
            for name in used(&std::fs::read_to_string(&file).unwrap()) {
                let known = ALLOWED.iter().any(|(m, _)| *m == name);
                if known && name != module && name != "math" && !allowed.contains(&name.as_str()) {
                    wrong.push(format!("{} uses {name}", file.strip_prefix(&src).unwrap().display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    // Every folder of src stands in the table.
    for entry in std::fs::read_dir(&src).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        assert!(name == "lib.rs" || ALLOWED.iter().any(|(m, _)| *m == name), "{name} is missing from the table");
    }
}

#[test]
fn the_command_line_parser_stays_out_of_the_library() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for file in rust_files(&src) {
        let inside = file.strip_prefix(&src).unwrap();
        if inside.starts_with("cli") || inside == Path::new("main.rs") {
            continue;
        }
        let text = std::fs::read_to_string(&file).unwrap();
        assert!(!text.contains("use clap") && !text.contains("use anyhow"), "{}", inside.display());
    }
}
