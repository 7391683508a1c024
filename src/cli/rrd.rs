//! A tracked session as a recording for rerun's viewer, where the program is built with its SDK.

use std::path::Path;

use anyhow::Result;
use muybridge::io::session::Session;

use super::track::Tracked;

/// An error where this program has no SDK: it doubles the time of a build.
pub fn ready() -> Result<()> {
    #[cfg(not(feature = "rerun"))]
    anyhow::bail!("--rrd needs rerun's SDK, which this program was built without; build it with `cargo build --release --features rerun`");
    #[cfg(feature = "rerun")]
    Ok(())
}

#[cfg(not(feature = "rerun"))]
pub fn write(_: &Path, _: &Session, _: &Tracked) -> Result<()> {
    ready()
}

/// Writes all frames; the file appears when it is whole.
#[cfg(feature = "rerun")]
pub fn write(path: &Path, session: &Session, tracked: &Tracked) -> Result<()> {
    use super::{progress, whole};
    use muybridge::report::rrd::Recording;

    let Tracked { fit, observations, .. } = tracked;
    let partial = whole::beside(path)?;
    let name = super::motions::file_name(&session.folder);
    let file = partial.path().join("whole.rrd");
    let recording = Recording::begin(&file, &name, &session.rig, fit)?;
    let bar = progress::bar("rrd", session.frame_count as u64);
    for (index, (frame, seen)) in session.frames().zip(observations).enumerate() {
        recording.frame(&session.rig, &frame?.images, seen, fit, index)?;
        bar.inc(1);
    }
    recording.finish().map_err(anyhow::Error::msg)?;
    bar.finish();
    whole::rename(&file, path)
}
