//! The demo's own pictures, beside those of `track`.

use std::path::Path;

use anyhow::Result;
use muybridge::body::{Clip, Joint};
use muybridge::math::rotation::log;
use muybridge::motion_model::{Cycle, Model, SAMPLES};
use muybridge::report::{self, Curve};

use super::{Generated, Truth};
use crate::cli::outputs::own_cycle;
use crate::cli::track::Tracked;

/// Figures of one row of the speeds, over this time.
const FIGURES: usize = 7;
const SECONDS: f64 = 1.5;

pub fn draw(folder: &Path, truth: &Truth, model: &Model, tracked: &Tracked, made: &[Generated]) -> Result<()> {
    report::save(&folder.join("angles.png"), &angles(truth, model, tracked)?)?;
    report::save(&folder.join("speeds.png"), &speeds(made)?)?;
    if let Some((_, depth)) = &tracked.depth {
        report::save(&folder.join("depth.png"), &report::person_depth(depth, "Measured depth, middle frame")?)?;
    }
    Ok(())
}

fn angles(truth: &Truth, model: &Model, tracked: &Tracked) -> Result<image::RgbImage> {
    let found = own_cycle(model, &tracked.style);
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
