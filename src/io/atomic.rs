//! Outputs that appear whole or not at all.

use std::io::{Error, ErrorKind, Write};
use std::path::Path;

/// Writes `bytes` to a temporary file beside `path` and renames it to `path`; creates the folder. Errors say what to do where
/// something can be done ([`with_remedy`]).
pub fn write_atomic(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    write(path, bytes).map_err(with_remedy)
}

fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder)?;
    let mut file = tempfile::Builder::new().prefix(".writing").tempfile_in(folder)?;
    file.write_all(bytes)?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.as_file().set_permissions(std::fs::Permissions::from_mode(0o644))?;
    }
    file.persist(path)?;
    Ok(())
}

/// The error of a failed write with what to do about it, in place of the system's words where the kind says enough.
pub fn with_remedy(error: Error) -> Error {
    let words = match error.kind() {
        ErrorKind::StorageFull => "no space is left on the disk; make room there or write to another one, and run the same command again",
        ErrorKind::QuotaExceeded => {
            "your quota on the disk is used up; make room there or write to another one, and run the same command again"
        }
        ErrorKind::FileTooLarge => {
            "the file is larger than files may be here; raise the limit (ulimit -f) or write to another disk, and run the same command again"
        }
        ErrorKind::ReadOnlyFilesystem => "the disk can only be read; write to another one, or mount it for writing",
        ErrorKind::PermissionDenied => "you may not write there; write to a folder of your own, or ask its owner",
        _ => return error,
    };
    Error::new(error.kind(), words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_can_be_mended_says_how_and_the_rest_stays_as_it_is() {
        for code in [28, 122, 27, 30, 13] {
            let error = with_remedy(Error::from_raw_os_error(code));
            assert!(error.to_string().contains(';') && error.kind() == Error::from_raw_os_error(code).kind(), "{code}: {error}");
        }
        assert_eq!(with_remedy(Error::from_raw_os_error(5)).raw_os_error(), Some(5));
    }

    #[test]
    fn a_failed_write_leaves_what_was_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::create_dir_all(path.join("b")).unwrap();
        assert!(write_atomic(&path, b"x").is_err());
        assert!(path.join("b").is_dir() && folder.path().read_dir().unwrap().count() == 1);
    }
}
