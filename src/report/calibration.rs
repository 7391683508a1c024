//! A calibration as a picture: where the corners were, and what the cameras leave of them.

use image::RgbImage;

use super::ReportError;
use super::canvas::{Align, Canvas, GRID, INK, LEFT, RIGHT, WHITE, faded, tick_label, ticks};
use crate::math::order::quantile;
use crate::rig::calibrate::{Calibration, FittedCorner};

const MAP_WIDTH: f64 = 560.0;
const SCATTER: f64 = 330.0;
const EDGE: f64 = 24.0;
const TITLE: f64 = 44.0;
/// Between the maps and the scatter plots, for the axis' numbers.
const GAP: f64 = 76.0;
/// Below each row, for the numbers of the scatter plot.
const FOOT: f64 = 58.0;
/// Length on the picture of the residual that 95 % do not reach.
const LONG_PX: f64 = 26.0;

/// One row per camera: its corners on the picture with their residuals enlarged, and the residuals in a plane.
pub fn calibration(result: &Calibration) -> Result<RgbImage, ReportError> {
    let all: Vec<f64> = result.sightings.iter().flat_map(|s| &s.corners).map(|c| c.residual.norm()).collect();
    let long_px = quantile(all, 0.95).unwrap_or(1.0).max(1e-6);
    let enlargement = round_down(LONG_PX / long_px);
    let reach_px = 1.6 * long_px;
    let heights: Vec<f64> = result.rig.cameras.iter().map(|c| map_height(c.size_px).max(SCATTER) + TITLE + FOOT).collect();
    let height = EDGE + 40.0 + heights.iter().sum::<f64>();
    let mut canvas = Canvas::new((2.0 * EDGE + MAP_WIDTH + GAP + SCATTER) as u32, height as u32, WHITE);
    let title = format!("corners used, residuals x {enlargement}");
    canvas.text([EDGE, EDGE + 14.0], &title, 13.0, INK, Align::Left)?;
    canvas.text([EDGE + MAP_WIDTH + GAP, EDGE + 14.0], "residuals (px)", 13.0, INK, Align::Left)?;
    let mut top = EDGE + 40.0;
    for (k, camera) in result.rig.cameras.iter().enumerate() {
        let corners: Vec<&FittedCorner> = result.sightings.iter().filter(|s| s.camera == k).flat_map(|s| &s.corners).collect();
        let q = &result.quality[k];
        let text = format!("{}: RMS {:.3} px, {} views, {:.0} % of the picture", camera.name, q.rms_px, q.views, 100.0 * q.coverage);
        canvas.text([EDGE, top + 22.0], &text, 11.0, INK, Align::Left)?;
        map(&mut canvas, [EDGE, top + TITLE - 8.0], camera.size_px, &corners, enlargement)?;
        scatter(&mut canvas, [EDGE + MAP_WIDTH + GAP, top + TITLE - 8.0], &corners, reach_px, result.sigma_px)?;
        top += heights[k];
    }
    Ok(canvas.picture)
}

fn map_height(size_px: [u32; 2]) -> f64 {
    MAP_WIDTH * f64::from(size_px[1]) / f64::from(size_px[0])
}

/// 1, 2 or 5 times a power of ten, not above `value`.
fn round_down(value: f64) -> f64 {
    let decade = 10f64.powf(value.log10().floor());
    [5.0, 2.0, 1.0].into_iter().map(|m| m * decade).find(|v| *v <= value * 1.0001).unwrap_or(decade)
}

fn frame(canvas: &mut Canvas, [x, y]: [f64; 2], width: f64, height: f64) -> Result<(), ReportError> {
    let around = [[x, y], [x + width, y], [x + width, y + height], [x, y + height], [x, y]];
    canvas.polyline(&around, INK, 1, false)
}

fn map(canvas: &mut Canvas, at: [f64; 2], size_px: [u32; 2], corners: &[&FittedCorner], enlargement: f64) -> Result<(), ReportError> {
    let scale = MAP_WIDTH / f64::from(size_px[0]);
    frame(canvas, at, MAP_WIDTH, map_height(size_px))?;
    let place = |c: &FittedCorner| [at[0] + (c.pixel.x + 0.5) * scale, at[1] + (c.pixel.y + 0.5) * scale];
    for corner in corners {
        canvas.disc(place(corner), 1.6, faded(LEFT, 0.45))?;
    }
    for corner in corners {
        let [x, y] = place(corner);
        canvas.line([x, y], [x + corner.residual.x * enlargement, y + corner.residual.y * enlargement], RIGHT, 1)?;
    }
    Ok(())
}

fn scatter(canvas: &mut Canvas, at: [f64; 2], corners: &[&FittedCorner], reach_px: f64, sigma_px: f64) -> Result<(), ReportError> {
    let pixel = |x: f64, y: f64| [at[0] + SCATTER * (0.5 + 0.5 * x / reach_px), at[1] + SCATTER * (0.5 + 0.5 * y / reach_px)];
    let marks = ticks(-reach_px, reach_px, 6);
    for mark in &marks {
        canvas.line(pixel(*mark, -reach_px), pixel(*mark, reach_px), GRID, 1)?;
        canvas.line(pixel(-reach_px, *mark), pixel(reach_px, *mark), GRID, 1)?;
        let [x, y] = pixel(*mark, reach_px);
        canvas.text([x, y + 20.0], &tick_label(*mark, &marks), 9.0, INK, Align::Centre)?;
        let [x, y] = pixel(-reach_px, *mark);
        canvas.text([x - 8.0, y + 5.0], &tick_label(*mark, &marks), 9.0, INK, Align::Right)?;
    }
    let inside = |c: &&&FittedCorner| c.residual.amax() < reach_px;
    for corner in corners.iter().filter(inside) {
        canvas.disc(pixel(corner.residual.x, corner.residual.y), 1.8, faded(LEFT, 0.35))?;
    }
    // Half of the corners lie inside √(2 ln 2) standard deviations of a coordinate.
    let half = (2.0 * std::f64::consts::LN_2).sqrt() * sigma_px * SCATTER / (2.0 * reach_px);
    canvas.circle(pixel(0.0, 0.0), half, RIGHT, 2)?;
    let outside = corners.len() - corners.iter().filter(inside).count();
    if outside > 0 {
        let [x, y] = pixel(reach_px, -reach_px);
        canvas.text([x - 6.0, y + 16.0], &format!("{outside} beyond"), 9.0, INK, Align::Right)?;
    }
    frame(canvas, at, SCATTER, SCATTER)?;
    let [x, y] = pixel(0.0, reach_px);
    canvas.text([x, y + 40.0], "circle: half of normal ones", 9.0, RIGHT, Align::Centre)
}
