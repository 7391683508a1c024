//! Output folders that appear whole or not at all.

use std::path::Path;

use anyhow::{Context, Result};
use tempfile::TempDir;

/// A temporary folder beside `folder`, gone with its content unless [`publish`]ed.
pub fn beside(folder: &Path) -> Result<TempDir> {
    let parent = folder.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(parent).with_context(|| format!("cannot create {}", parent.display()))?;
    tempfile::Builder::new().prefix(".writing").tempdir_in(parent).with_context(|| format!("cannot write in {}", parent.display()))
}

/// Renames the finished temporary folder to `folder`, or moves its entries there where `folder` exists.
pub fn publish(partial: TempDir, folder: &Path) -> Result<()> {
    make_readable(partial.path())?;
    let failed = || format!("cannot write {}", folder.display());
    if !folder.exists() {
        std::fs::rename(partial.keep(), folder).with_context(failed)?;
        return Ok(());
    }
    for entry in partial.path().read_dir().with_context(failed)? {
        let entry = entry.with_context(failed)?;
        std::fs::rename(entry.path(), folder.join(entry.file_name())).with_context(failed)?;
    }
    Ok(())
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
