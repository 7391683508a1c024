//! The demo's own pictures, beside those of `track`.

use std::path::Path;

use anyhow::Result;
use muybridge::body::{Clip, Joint};
use muybridge::math::rotation::log;
use muybridge::motion_model::{Cycle, SAMPLES};
use muybridge::phantom::DepthMap;
use muybridge::report::{self, Curve};

use super::{Generated, SPEED_M_S, Truth};
use crate::cli::track::{NamedModel, Tracked};

/// Figures of one row of the speeds, over this time.
const FIGURES: usize = 7;
const SECONDS: f64 = 1.5;
/// Room around the person in the depth picture.
const MARGIN_PX: u32 = 60;

pub fn draw(
    folder: &Path,
    truth: &Truth,
    model: &NamedModel,
    tracked: &Tracked,
    made: &[Generated],
    depth: Option<&DepthMap>,
) -> Result<()> {
    report::save(&folder.join("angles.png"), &angles(truth, model, tracked)?)?;
    report::save(&folder.join("speeds.png"), &speeds(made)?)?;
    if let Some(depth) = depth {
        report::save(&folder.join("depth.png"), &depth_picture(depth)?)?;
    }
    Ok(())
}

fn angles(truth: &Truth, model: &NamedModel, tracked: &Tracked) -> Result<image::RgbImage> {
    let found = model.model.cycle(&tracked.fit.state.weights, "", SPEED_M_S, 1.0, 1.0);
    let mut series = Vec::new();
    // The knee bends backwards: turns the other way about the axis to the left.
    for (colour, (name, joint, sign)) in [("hip", Joint::RHip, -1.0), ("knee", Joint::RKnee, 1.0)].into_iter().enumerate() {
        for (label, cycle, dashed) in [("recovered", &found, false), ("true", &truth.cycle, true)] {
            series.push(Curve { label: format!("{name}, {label}"), points: flexion(cycle, joint, sign), dashed, colour, band: Vec::new() });
        }
    }
    Ok(report::curves("Right leg over the cycle", "cycle from the right heel strike (%)", "flexion (degrees)", &series)?)
}

fn flexion(cycle: &Cycle, joint: Joint, sign: f64) -> Vec<[f64; 2]> {
    let at = |k: usize| log(&cycle.joints[k % SAMPLES][joint as usize - 1]).x;
    (0..=SAMPLES).map(|k| [100.0 * k as f64 / SAMPLES as f64, sign * at(k).to_degrees()]).collect()
}

fn speeds(made: &[Generated]) -> Result<image::RgbImage> {
    let short = |clip: &Clip| {
        let count = ((SECONDS * clip.fps) as usize + 1).min(clip.poses.len());
        Clip { poses: clip.poses[..count].to_vec(), ..clip.clone() }
    };
    let clips: Vec<(String, Clip)> = made.iter().map(|m| (format!("{} km/h", m.kmh), short(&m.clip))).collect();
    let labelled: Vec<(String, &Clip)> = clips.iter().map(|(label, clip)| (label.clone(), clip)).collect();
    Ok(report::stick_figures(&labelled, FIGURES)?)
}

/// The person alone, twice as large.
fn depth_picture(depth: &DepthMap) -> Result<image::RgbImage> {
    let values = || depth.enumerate_pixels().filter(|(_, _, d)| d.0[0].is_finite());
    let bounds = |at: fn((u32, u32)) -> u32, size: u32| {
        let (low, high) = values().map(|(x, y, _)| at((x, y))).fold((size, 0), |(low, high), v| (low.min(v), high.max(v)));
        (low.saturating_sub(MARGIN_PX), (high + MARGIN_PX).min(size))
    };
    let ((left, right), (top, bottom)) = (bounds(|p| p.0, depth.width()), bounds(|p| p.1, depth.height()));
    let (width, height) = (right.saturating_sub(left).max(1), bottom.saturating_sub(top).max(1));
    let large = DepthMap::from_fn(2 * width, 2 * height, |x, y| *depth.get_pixel(left + x / 2, top + y / 2));
    let mut sorted: Vec<f64> = values().map(|(_, _, d)| f64::from(d.0[0])).collect();
    sorted.sort_by(f64::total_cmp);
    // Without the extreme hundredths.
    let at = |part: f64| sorted.get((part * sorted.len() as f64) as usize).copied().unwrap_or(1.0);
    Ok(report::depth_map(&large, (at(0.01), at(0.99)), "Measured depth, middle frame", "m")?)
}
