//! What the fuzz targets began with and what they found (`fixtures/fuzz/READER/`): `good-` files are read, `bad-` ones give one
//! sentence, the others one or the other; nothing panics, hangs or takes memory that is not in proportion to the file.

#[path = "../fuzz/src/lib.rs"]
mod readers;

use std::path::{Path, PathBuf};

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = folder.read_dir().unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    files
}

/// From now on more address space than this is an error of whoever asks for it.
fn limit_memory(bytes: u64) {
    let limit = libc::rlimit { rlim_cur: bytes, rlim_max: bytes };
    // SAFETY: the struct lives as long as the call.
    assert_eq!(unsafe { libc::setrlimit(libc::RLIMIT_AS, &limit) }, 0);
}

#[test]
fn every_file_gives_what_its_name_says() {
    limit_memory(3 << 30);
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/fuzz");
    for target in readers::TARGETS {
        let all = files(&folder.join(target.name));
        assert!(!all.is_empty(), "{} has no seed", target.name);
        for path in all {
            let name = path.file_name().unwrap().to_str().unwrap();
            let read = readers::read(target.name, &std::fs::read(&path).unwrap());
            println!("{}/{name}: {read:?}", target.name);
            match &read {
                Ok(()) => assert!(!name.starts_with("bad-"), "{} is read", path.display()),
                Err(error) => {
                    assert!(!name.starts_with("good-"), "{}: {error}", path.display());
                    assert!(
                        !error.contains('\n') && error.len() < 900 && error.contains(readers::place().to_str().unwrap()),
                        "{}: {error}",
                        path.display()
                    );
                }
            }
        }
    }
    std::fs::remove_dir_all(readers::place()).unwrap();
}
