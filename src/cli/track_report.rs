//! A tracked session's report, with its numbers beside it.

use std::path::Path;

use anyhow::{Context, Result};
use muybridge::io::session::Session;
use muybridge::io::{gait_csv, write_atomic};
use muybridge::report::page::jpeg;
use muybridge::report::track::{TrackReport, thumbnail};
use muybridge::report::walk::Walk;

use super::motions::file_name;
use super::track::{NamedModel, Tracked, clip};

/// Writes report.html, thumbnail.jpg and, for gaits, gait.csv and angles_cycle.csv. The page names
/// the session by its folder alone, so that it is the same wherever the study stands.
pub fn write(folder: &Path, session: &Session, models: &[NamedModel], tracked: &Tracked) -> Result<()> {
    let Tracked { fit, style, observations, pictures, depth } = tracked;
    let model = &models[fit.model];
    let whole = session.folder.canonicalize().unwrap_or_else(|_| session.folder.clone());
    let name = file_name(&whole);
    let (clip, _) = clip(fit, &session.rig, observations, session.fps)?;
    let walk = Walk::of(fit, &clip, model.model.activity, observations.first().map_or(0.0, |o| o.time_s));
    if let Some(walk) = &walk {
        let tables = walk.tables();
        let tables = tables.each_ref().map(|(source, lines)| (*source, lines.as_slice()));
        written(folder, "gait.csv", |path| gait_csv::write_gait(path, &tables))?;
        written(folder, "angles_cycle.csv", |path| gait_csv::write_angles(path, &walk.curves()))?;
    }
    let report = TrackReport {
        session: &name,
        rig: &session.rig,
        fps: session.fps,
        model: &model.model,
        model_name: &model.name,
        model_hash: &model.hash,
        given: &models.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(),
        fit,
        observations,
        pictures,
        depth: depth.as_ref().map(|(number, map)| (*number, map)),
        style,
        walk: walk.as_ref(),
        options: &[("components in the last stage", fit.state.weights.len().to_string())],
    };
    if let Some(picture) = thumbnail(&report)? {
        let bytes = jpeg(&picture)?;
        written(folder, "thumbnail.jpg", |path| write_atomic(path, &bytes))?;
    }
    let page = report.html()?;
    written(folder, "report.html", |path| write_atomic(path, page.as_bytes()))
}

fn written(folder: &Path, name: &str, write: impl FnOnce(&Path) -> std::io::Result<()>) -> Result<()> {
    let path = folder.join(name);
    write(&path).with_context(|| format!("cannot write {}", path.display()))
}
