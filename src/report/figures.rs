//! Stick figures of whole motions from the side, in the manner of chronophotographs.
//!
//! Seen from the subject's right the left side is the far one; bones are drawn left before right.

use image::RgbImage;
use nalgebra::Vector3;

use super::ReportError;
use super::canvas::{Align, Canvas, GRID, INK, Pen, WHITE, legend, skeleton, tick_label, ticks};
use crate::body::{Clip, NODES, place};

const PX_PER_M: f64 = 200.0;
const LABEL_PX: u32 = 190;

/// One row per clip: `figures` instants at equal steps of time, early ones pale, seen from the subject's right, all at one
/// scale, with the floor in metres. Each clip comes with its label, such as its speed; y-up worlds.
pub fn stick_figures(clips: &[(String, &Clip)], figures: usize) -> Result<RgbImage, ReportError> {
    let rows: Vec<Row> = clips.iter().map(|(label, clip)| Row::new(label, clip, figures)).collect();
    let reach = rows.iter().map(|r| r.to_m - r.from_m).fold(1.0, f64::max);
    let tall = rows.iter().map(|r| r.top_m).fold(1.0, f64::max);
    let row_px = (tall * PX_PER_M) as u32 + 62;
    let mut canvas = Canvas::new(LABEL_PX + (reach * PX_PER_M) as u32 + 30, row_px * rows.len() as u32 + 44, WHITE);
    legend(&mut canvas, f64::from(LABEL_PX))?;
    for (i, row) in rows.iter().enumerate() {
        row.draw(&mut canvas, f64::from(44 + (i as u32 + 1) * row_px) - 34.0, reach)?;
    }
    Ok(canvas.picture)
}

/// Where a clip goes, or looks if it stays in place; horizontal.
pub(super) fn forward(clip: &Clip) -> Vector3<f64> {
    let (Some(first), Some(last)) = (clip.poses.first(), clip.poses.last()) else { return Vector3::z() };
    let flat = |v: Vector3<f64>| Vector3::new(v.x, 0.0, v.z);
    let travel = flat(last.root - first.root);
    let forward = if travel.norm() > 0.3 { travel } else { flat(first.world_from_root * Vector3::z()) };
    forward.try_normalize(1e-9).unwrap_or_else(Vector3::z)
}

/// Node positions as (forward, height) in metres from the clip's first root position.
struct Row<'a> {
    label: &'a str,
    figures: Vec<[[f64; 2]; NODES]>,
    from_m: f64,
    to_m: f64,
    top_m: f64,
}

impl Row<'_> {
    fn new<'a>(label: &'a str, clip: &Clip, figures: usize) -> Row<'a> {
        let mut row = Row { label, figures: Vec::new(), from_m: 0.0, to_m: 0.0, top_m: 0.0 };
        let Some(first) = clip.poses.first() else { return row };
        let forward = forward(clip);
        let count = figures.clamp(1, clip.poses.len());
        for i in 0..count {
            let pose = &clip.poses[i * (clip.poses.len() - 1) / (count - 1).max(1)];
            let placed = place(&clip.offsets, pose);
            row.figures.push(placed.positions.map(|x| [(x - first.root).dot(&forward), x.y]));
        }
        let all = || row.figures.iter().flatten();
        row.from_m = all().map(|p| p[0]).fold(f64::INFINITY, f64::min) - 0.15;
        row.to_m = all().map(|p| p[0]).fold(f64::NEG_INFINITY, f64::max) + 0.25;
        // The crown is a seventh of the hip height above the highest joint of an upright figure.
        row.top_m = all().map(|p| p[1]).fold(0.0, f64::max) + 0.2 * clip.hip_height_m;
        row
    }

    fn draw(&self, canvas: &mut Canvas, floor_px: f64, reach_m: f64) -> Result<(), ReportError> {
        let x_px = |metres: f64| f64::from(LABEL_PX) + (metres - self.from_m) * PX_PER_M;
        canvas.text([f64::from(LABEL_PX) - 30.0, floor_px - 0.45 * self.top_m * PX_PER_M], self.label, 13.0, INK, Align::Right)?;
        canvas.line([x_px(self.from_m), floor_px], [x_px(self.from_m + reach_m), floor_px], GRID, 2)?;
        let marks = ticks(self.from_m, self.from_m + reach_m, (reach_m * 2.0) as usize);
        for mark in &marks {
            canvas.line([x_px(*mark), floor_px], [x_px(*mark), floor_px + 6.0], INK, 1)?;
            canvas.text([x_px(*mark), floor_px + 22.0], &format!("{} m", tick_label(*mark, &marks)), 8.0, INK, Align::Centre)?;
        }
        let last = self.figures.len().saturating_sub(1).max(1) as f64;
        for (i, figure) in self.figures.iter().enumerate() {
            let fade = 0.78 * (1.0 - i as f64 / last);
            let pen = Pen { width_px: 3, middle: INK, fade, rim: None };
            let nodes = figure.map(|p| Some([x_px(p[0]), floor_px - p[1] * PX_PER_M]));
            skeleton(canvas, &nodes, &pen)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Pose, Shape};

    #[test]
    fn figures_go_to_the_right_grow_dark_and_stand_on_the_floor() {
        let shape = Shape::template(1.7);
        let offsets = shape.offsets();
        let mut poses: Vec<_> =
            (0..31).map(|k| Pose::rest(offsets[0] + Vector3::new(3.0, 0.0, 0.0) + Vector3::new(-0.06, 0.0, 0.08) * k as f64)).collect();
        let turn = crate::math::rotation::exp(&Vector3::new(0.0, -0.6435, 0.0));
        poses.iter_mut().for_each(|p| p.world_from_root = turn);
        let clip = Clip { fps: 30.0, poses, offsets, hip_height_m: shape.hip_height_m() };
        let picture = stick_figures(&[("1.0 m/s".into(), &clip), ("again".into(), &clip)], 4).unwrap();
        let row_px = (picture.height() - 44) / 2;
        // Right knees of the first and last figure: 3 m apart, pale and full vermilion.
        let knee = 0.285 * 1.7 * PX_PER_M;
        let column = |metres: f64| (f64::from(LABEL_PX) + metres * PX_PER_M) as u32;
        let y = (f64::from(44 + row_px) - 34.0 - knee) as u32;
        let redness = |x: u32| {
            (x.saturating_sub(8)..x + 8).map(|x| picture.get_pixel(x, y)).map(|p| i32::from(p[0]) - i32::from(p[2])).max().unwrap()
        };
        // The first foot's heel is the row's rear end less its margin; joints of a standing body are within 0.1 m of its knee.
        let first = (column(0.0)..column(0.5)).max_by_key(|x| redness(*x)).unwrap();
        let last = (column(3.0)..column(3.5)).max_by_key(|x| redness(*x)).unwrap();
        assert!((f64::from(last - first) - 3.0 * PX_PER_M).abs() < 12.0, "{first} {last}");
        assert!(redness(last) > 200 && (30..100).contains(&redness(first)), "{} {}", redness(first), redness(last));
        assert!(stick_figures(&[], 5).is_ok());
    }
}
