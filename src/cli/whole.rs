//! Output folders that appear whole or not at all.

use std::path::Path;

use anyhow::{Context, Result};
use muybridge::io::with_remedy;
use tempfile::TempDir;

/// A temporary folder beside `folder`, gone with its content unless [`publish`]ed.
pub fn beside(folder: &Path) -> Result<TempDir> {
    let parent = folder.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    create(parent)?;
    let made = tempfile::Builder::new().prefix(".writing").tempdir_in(parent);
    made.map_err(with_remedy).with_context(|| format!("cannot write in {}", parent.display()))
}

/// Creates a folder and those above it.
pub fn create(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(with_remedy).with_context(|| format!("cannot create {}", folder.display()))
}

/// Renames the finished temporary folder to `folder`, or moves its entries there where `folder` exists.
pub fn publish(partial: TempDir, folder: &Path) -> Result<()> {
    make_readable(partial.path())?;
    let failed = || format!("cannot write {}", folder.display());
    if !folder.exists() {
        rename(partial.path(), folder)?;
        // Nothing is left there to remove.
        let _ = partial.keep();
        return Ok(());
    }
    for entry in partial.path().read_dir().with_context(failed)? {
        let entry = entry.with_context(failed)?;
        rename(&entry.path(), &folder.join(entry.file_name()))?;
    }
    Ok(())
}

/// A finished file or folder to its place.
fn rename(from: &Path, to: &Path) -> Result<()> {
    std::fs::rename(from, to).map_err(with_remedy).with_context(|| format!("cannot write {}", to.display()))
}

/// Temporary folders are the owner's alone.
pub fn make_readable(folder: &Path) -> Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o755))?;
    }
    Ok(())
}
