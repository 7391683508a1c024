//! Strips: motions one below the other, each at the same instants, figure beside figure (figures 2 to 4 of Lim and Thalmann 2001).
//!
//! Instants are equal parts of each motion's duration. The figures stand where the cell's middle is and are seen from the front
//! right, so that both hands show.

use image::RgbImage;
use nalgebra::Vector3;

use super::ReportError;
use super::canvas::{Align, Canvas, GRID, INK, Pen, WHITE, legend, skeleton, text_width_px};
use crate::body::{Clip, place};
use crate::math::rotation::exp;

const PX_PER_M: f64 = 105.0;
const CELL_PX: u32 = 128;
/// Least width of the labels' column.
const LABEL_PX: u32 = 180;
const TOP_PX: u32 = 44;
const SCALE_PX: u32 = 34;
/// Angle between the view and the walking direction, radians: 90 degrees would be the side.
const VIEW: f64 = 0.9;

/// One motion of a strip: its label and one cycle, or the whole of it.
pub struct Row {
    pub label: String,
    pub clip: Clip,
    /// Open motions show their last instant too; a cycle's is its first.
    pub cyclic: bool,
}

/// All rows at `figures` instants, at one scale; the numbers below are parts of the duration.
pub fn strips(rows: &[Row], figures: usize) -> Result<RgbImage, ReportError> {
    let figures = figures.max(1);
    let drawn: Vec<Vec<[[f64; 2]; crate::body::NODES]>> = rows.iter().map(|r| figures_of(r, figures)).collect();
    let all = || drawn.iter().flatten().flatten();
    let top_m = all().map(|p| p[1]).fold(1.0, f64::max) + 0.2;
    let low_m = all().map(|p| p[1]).fold(0.0, f64::min);
    let row_px = ((top_m - low_m) * PX_PER_M) as u32 + 12;
    let height = TOP_PX + row_px * rows.len() as u32 + SCALE_PX;
    let mut left_px = LABEL_PX;
    for row in rows {
        left_px = left_px.max(text_width_px(&row.label, 11.0)?.ceil() as u32 + 30);
    }
    let left = f64::from(left_px);
    let middle_px = |figure: usize| left + f64::from(CELL_PX) * (figure as f64 + 0.5);
    let mut canvas = Canvas::new(left_px + CELL_PX * figures as u32 + 10, height, WHITE);
    legend(&mut canvas, left)?;
    for (i, (row, drawn)) in rows.iter().zip(&drawn).enumerate() {
        let floor_px = f64::from(TOP_PX + row_px * (i as u32 + 1)) - 6.0 + low_m * PX_PER_M;
        canvas.line([left, floor_px], [left + f64::from(CELL_PX) * figures as f64, floor_px], GRID, 2)?;
        canvas.text([left - 16.0, floor_px - 0.5 * top_m * PX_PER_M], &row.label, 11.0, INK, Align::Right)?;
        for (k, figure) in drawn.iter().enumerate() {
            let middle = middle_px(k);
            let nodes = figure.map(|p| Some([middle + p[0] * PX_PER_M, floor_px - p[1] * PX_PER_M]));
            skeleton(&mut canvas, &nodes, &Pen { width_px: 3, middle: INK, fade: 0.0, rim: None })?;
        }
    }
    let last = if rows.iter().all(|r| r.cyclic) { figures } else { figures.max(2) - 1 };
    for k in 0..figures {
        let at = format!("{:.3}", k as f64 / last as f64);
        let at = at.trim_end_matches('0').trim_end_matches('.');
        canvas.text([middle_px(k), f64::from(height) - 12.0], at, 9.0, INK, Align::Centre)?;
    }
    canvas.text([left - 16.0, f64::from(height) - 12.0], "part of the duration", 9.0, INK, Align::Right)?;
    Ok(canvas.picture)
}

/// Nodes as (right, up) in metres from the floor below the root.
fn figures_of(row: &Row, figures: usize) -> Vec<[[f64; 2]; crate::body::NODES]> {
    let poses = &row.clip.poses;
    let (Some(last), Some(first)) = (poses.len().checked_sub(1), poses.first()) else { return Vec::new() };
    let facing = first.world_from_root * Vector3::z();
    let right_in_view = exp(&Vector3::new(0.0, facing.x.atan2(facing.z), 0.0)) * Vector3::new(VIEW.cos(), 0.0, VIEW.sin());
    let steps = if row.cyclic { figures } else { figures.max(2) - 1 };
    (0..figures)
        .map(|k| {
            let at = (k * last) as f64 / steps as f64;
            let pose = poses[at as usize].towards(&poses[(at as usize + 1).min(last)], at.fract());
            place(&row.clip.offsets, &pose).positions.map(|x| [(x - pose.root).dot(&right_in_view), x.y])
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Joint, Pose, Shape};
    use crate::report::canvas::{LEFT, RIGHT};

    #[test]
    fn every_row_and_instant_has_its_figure_on_the_floor() {
        let shape = Shape::template(1.7);
        let offsets = shape.offsets();
        let poses = (0..41).map(|k| {
            let mut pose = Pose::rest(offsets[0] + Vector3::new(0.0, 0.0, 0.05 * k as f64));
            // The right arm rises to the side from down to level.
            pose.joints[Joint::RShoulder as usize - 1] = exp(&Vector3::new(0.0, 0.0, -0.0393 * k as f64));
            pose
        });
        let clip = Clip { fps: 40.0, poses: poses.collect(), offsets, hip_height_m: shape.hip_height_m() };
        let row = |label: &str| Row { label: label.into(), clip: clip.clone(), cyclic: false };
        let picture = strips(&[row("mean"), row("again")], 5).unwrap();
        let row_px = (picture.height() - TOP_PX - SCALE_PX) / 2;
        // Topmost pixel of the right arm's colour in a cell: it rises from instant to instant, in both rows alike.
        let top = |row: u32, cell: u32| {
            let hand = |x: u32, y: u32| {
                let p = picture.get_pixel(x, y).0;
                p.iter().zip(RIGHT).all(|(a, b)| a.abs_diff(b) < 30)
            };
            let x = LABEL_PX + cell * CELL_PX..LABEL_PX + (cell + 1) * CELL_PX;
            x.filter_map(|x| (TOP_PX + row * row_px..TOP_PX + (row + 1) * row_px).find(|&y| hand(x, y)).map(|y| (x, y - row * row_px)))
                .min()
                .unwrap()
        };
        let outermost: Vec<u32> = (0..5).map(|cell| top(0, cell).1).collect();
        assert!(outermost.windows(2).all(|w| w[1] <= w[0]) && outermost[4] + 40 < outermost[0], "{outermost:?}");
        assert_eq!(outermost, (0..5).map(|cell| top(1, cell).1).collect::<Vec<_>>());
        assert!(picture.pixels().any(|p| p.0 == LEFT));
        assert!(strips(&[], 5).is_ok());
    }
}
