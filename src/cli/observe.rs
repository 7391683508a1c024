//! A session's frames to what the fit looks at: clouds and silhouettes.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use muybridge::clouds::{CloudError, CloudOptions, CloudRig, FrameCloud};
use muybridge::fit::{Observation, Silhouette};
use muybridge::footage::FrameSet;
use muybridge::io::frame_cloud;
use muybridge::io::session::Session;
use rayon::prelude::*;

use super::{interrupt, progress};

/// Frames that are looked at together; twice as many are in memory.
const BATCH: usize = 8;
/// One frame in so many may have a black picture: it counts as not seen.
const BLANK: usize = 2;

/// Clouds of all frames, empty where a camera shows nothing; `each` sees every frame with its pictures, in order. What stereo finds is kept in the folder `kept`
/// and taken from there the next time, so that work that was stopped goes on; the folder's name must tell footage, options
/// and program.
pub fn observe(
    session: &Session,
    rig: &CloudRig,
    options: &CloudOptions,
    kept: Option<&Path>,
    mut each: impl FnMut(&FrameSet, &FrameCloud) -> Result<()>,
) -> Result<Vec<Observation>> {
    let bar = progress::bar("clouds", session.frame_count as u64);
    let mut observations = Vec::with_capacity(session.frame_count);
    let mut frames = session.frames();
    let mut blank = Vec::new();
    let mut read = || frames.by_ref().take(BATCH).collect::<Result<Vec<FrameSet>, _>>();
    let mut batch = read()?;
    while !batch.is_empty() {
        let of_frame = |frame: &FrameSet| {
            interrupt::check()?;
            let found = found(frame, rig, options, kept).with_context(|| format!("frame {}", frame.number));
            bar.inc(1);
            found.map(|cloud| (Arc::new(silhouettes(&cloud)), cloud))
        };
        // The next pictures are read meanwhile.
        let (next, clouds) = rayon::join(&mut read, || batch.par_iter().map(of_frame).collect::<Vec<Result<_>>>());
        for (frame, cloud) in batch.iter().zip(clouds) {
            let (silhouettes, cloud) = match cloud {
                Err(error) if matches!(error.downcast_ref::<CloudError>(), Some(CloudError::Blank { .. })) => {
                    blank.push(error);
                    let unseen = FrameCloud::unseen(session.rig.cameras.len());
                    (Arc::new(silhouettes(&unseen)), unseen)
                }
                found => found?,
            };
            each(frame, &cloud)?;
            let (number, time_s) = (frame.number, frame.time_s);
            observations.push(Observation { number, time_s, cloud: cloud.cloud, silhouettes });
        }
        batch = next?;
    }
    bar.finish();
    if BLANK * blank.len() > session.frame_count {
        return Err(blank.swap_remove(0)).with_context(|| session.folder.display().to_string());
    }
    if let Some(first) = blank.first() {
        eprintln!("warning: nothing is taken from {} of {} frames, the first is {first:#}", blank.len(), session.frame_count);
    }
    if observations.iter().all(|o| o.cloud.points.is_empty()) {
        bail!(
            "{}: nobody is in view in any of the {} frames; check that the pictures show a person that the stage pictures do not",
            session.folder.display(),
            session.frame_count
        );
    }
    Ok(observations)
}

fn silhouettes(cloud: &FrameCloud) -> Vec<Option<Silhouette>> {
    cloud.masks.iter().map(|mask| mask.as_ref().map(Silhouette::new)).collect()
}

/// What stereo finds in one frame, or found before.
fn found(frame: &FrameSet, rig: &CloudRig, options: &CloudOptions, kept: Option<&Path>) -> Result<FrameCloud> {
    let Some(path) = kept.map(|folder| folder.join(format!("{:06}.frame", frame.number))) else {
        return Ok(rig.frame(&frame.images, options)?);
    };
    if let Some(before) = frame_cloud::read(&path) {
        return Ok(before);
    }
    let found = rig.frame(&frame.images, options)?;
    frame_cloud::write(&path, &found).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(found)
}
