//! A session's frames to what the fit looks at: clouds and silhouettes.

use anyhow::{Context, Result, bail};
use muybridge::clouds::{CloudOptions, CloudRig, FrameCloud};
use muybridge::fit::Observation;
use muybridge::footage::FrameSet;
use muybridge::io::session::Session;
use rayon::prelude::*;

use super::{interrupt, progress};

/// Frames that are in memory at once.
const BATCH: usize = 8;

/// Clouds of all frames; `each` sees every frame with its pictures, in order.
pub fn observe(
    session: &Session,
    rig: &CloudRig,
    options: &CloudOptions,
    mut each: impl FnMut(&FrameSet, &FrameCloud) -> Result<()>,
) -> Result<Vec<Observation>> {
    let bar = progress::bar("clouds", session.frame_count as u64);
    let mut observations = Vec::with_capacity(session.frame_count);
    let mut frames = session.frames();
    loop {
        let batch: Vec<FrameSet> = frames.by_ref().take(BATCH).collect::<Result<_, _>>()?;
        if batch.is_empty() {
            break;
        }
        let clouds: Vec<FrameCloud> = batch
            .par_iter()
            .map(|frame| {
                interrupt::check()?;
                let cloud = rig.frame(&frame.images, options).with_context(|| format!("frame {}", frame.number));
                bar.inc(1);
                cloud
            })
            .collect::<Result<_>>()?;
        for (frame, cloud) in batch.iter().zip(clouds) {
            each(frame, &cloud)?;
            observations.push(Observation { number: frame.number, time_s: frame.time_s, cloud: cloud.cloud, masks: cloud.masks });
        }
    }
    bar.finish();
    if observations.iter().all(|o| o.cloud.points.is_empty()) {
        bail!(
            "{}: nobody is in view in any of the {} frames; check that the pictures show a person that the stage pictures do not",
            session.folder.display(),
            session.frame_count
        );
    }
    Ok(observations)
}
