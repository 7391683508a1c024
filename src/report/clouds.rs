//! A frame's point cloud with the fitted skeleton, from the side and from the front.

use image::{Rgb, RgbImage};
use nalgebra::Vector3;

use super::ReportError;
use super::canvas::{Align, Canvas, GRID, INK, LEFT, Pen, RIGHT, WHITE, skeleton, text_width_px, tick_label, ticks};
use crate::body::{Joint, NODES};
use crate::rig::Up;

const PX_PER_M: f64 = 340.0;
/// Half the width shown around the root, height shown above and below the floor, metres.
const HALF_WIDTH_M: f64 = 0.85;
const ABOVE_M: f64 = 2.0;
const BELOW_M: f64 = 0.12;

/// A cloud point and its signed distance to the fitted skin, metres; NaN where it is not known.
#[derive(Clone, Copy, Debug)]
pub struct CloudDot {
    pub x: Vector3<f64>,
    pub distance_m: f64,
}

/// Distance that has the full colour.
const FULL_COLOUR_M: f64 = 0.04;

/// Grey on the skin, green inside, purple outside: not the colours of left and right.
fn colour(distance_m: f64, grey: u8) -> Rgb<u8> {
    if !distance_m.is_finite() {
        return Rgb([grey; 3]);
    }
    let share = (distance_m.abs() / FULL_COLOUR_M).min(1.0);
    let full: [u8; 3] = if distance_m < 0.0 { [0, 130, 95] } else { [190, 80, 150] };
    Rgb(full.map(|c| (f64::from(c) * share + 190.0 * (1.0 - share)) as u8))
}

/// Cloud points (coloured by distance to the skin) and the skeleton at `positions`, both in the rig's world: seen from the subject's right and from
/// the front. Points more than 1.2 m from the root are left out.
pub fn cloud_and_body(points: &[CloudDot], positions: &[Vector3<f64>; NODES], up: Up, title: &str) -> Result<RgbImage, ReportError> {
    const TOP: u32 = 56;
    const LEFT_EDGE: u32 = 64;
    let panel = (2.0 * HALF_WIDTH_M * PX_PER_M) as u32;
    let height = ((ABOVE_M + BELOW_M) * PX_PER_M) as u32;
    let mut canvas = Canvas::new(LEFT_EDGE + 2 * panel + 60, TOP + height + 50, WHITE);
    canvas.text([16.0, 26.0], title, 13.0, INK, Align::Left)?;
    let up = up.direction();
    let left = positions[Joint::LHip as usize] - positions[Joint::RHip as usize];
    let left = (left - up * left.dot(&up)).try_normalize(1e-9).unwrap_or_else(|| up.yzx());
    let forward = left.cross(&up);
    let near = |dot: &&CloudDot| (dot.x - positions[0]).norm() < 1.2;
    let near: Vec<_> = points.iter().filter(near).copied().collect();
    for (name, right, x0) in [("from the right", forward, LEFT_EDGE), ("from the front", left, LEFT_EDGE + panel + 30)] {
        let frame = Panel { right, up, centre: positions[0], x0, y0: TOP, width: panel, height };
        frame.axes(&mut canvas, name)?;
        frame.cloud(&mut canvas, &near);
        let pen = Pen { width_px: 4, middle: INK, fade: 0.0, rim: Some(WHITE) };
        skeleton(&mut canvas, &positions.map(|x| Some(frame.pixel(&x))), &pen)?;
    }
    let mut x = f64::from(canvas.picture.width()) - 560.0;
    let (inside, outside) = (colour(-FULL_COLOUR_M, 0).0, colour(FULL_COLOUR_M, 0).0);
    let legend = [("left", LEFT), ("right", RIGHT), ("40 mm inside", inside), ("on the skin", [190; 3]), ("40 mm outside", outside)];
    for (name, colour) in legend {
        canvas.disc([x, 21.0], 6.0, colour)?;
        canvas.text([x + 14.0, 26.0], name, 10.0, INK, Align::Left)?;
        x += 44.0 + text_width_px(name, 10.0)?;
    }
    Ok(canvas.picture)
}

/// An orthographic view: `right` and `up` are the world directions of the picture's axes.
struct Panel {
    right: Vector3<f64>,
    up: Vector3<f64>,
    centre: Vector3<f64>,
    x0: u32,
    y0: u32,
    width: u32,
    height: u32,
}

impl Panel {
    fn pixel(&self, x: &Vector3<f64>) -> [f64; 2] {
        let across = (x - self.centre).dot(&self.right) + HALF_WIDTH_M;
        [f64::from(self.x0) + across * PX_PER_M, f64::from(self.y0) + (ABOVE_M - x.dot(&self.up)) * PX_PER_M]
    }

    fn axes(&self, canvas: &mut Canvas, name: &str) -> Result<(), ReportError> {
        let (x0, x1) = (f64::from(self.x0), f64::from(self.x0 + self.width));
        let heights = ticks(0.0, ABOVE_M, 4);
        for mark in &heights {
            let y = f64::from(self.y0) + (ABOVE_M - mark) * PX_PER_M;
            canvas.line([x0, y], [x1, y], if *mark == 0.0 { [120, 120, 120] } else { GRID }, 1)?;
            if self.x0 < self.width {
                canvas.text([x0 - 8.0, y + 5.0], &tick_label(*mark, &heights), 9.0, INK, Align::Right)?;
            }
        }
        let bottom = f64::from(self.y0 + self.height);
        let across = ticks(-HALF_WIDTH_M, HALF_WIDTH_M, 4);
        for mark in &across {
            let x = x0 + (mark + HALF_WIDTH_M) * PX_PER_M;
            canvas.line([x, f64::from(self.y0)], [x, bottom], GRID, 1)?;
            canvas.text([x, bottom + 18.0], &tick_label(*mark, &across), 9.0, INK, Align::Centre)?;
        }
        canvas.text([(x0 + x1) / 2.0, bottom + 40.0], &format!("{name} (m)"), 10.0, INK, Align::Centre)
    }

    /// Points as 2 by 2 pixels; far ones pale, near ones drawn last.
    fn cloud(&self, canvas: &mut Canvas, points: &[CloudDot]) {
        let towards_viewer = self.right.cross(&self.up);
        let seen = |dot: &CloudDot| ((dot.x - self.centre).dot(&towards_viewer), self.pixel(&dot.x), dot.distance_m);
        let mut sorted: Vec<(f64, [f64; 2], f64)> = points.iter().map(seen).collect();
        sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (near_m, p, distance_m) in sorted {
            let grey = (175.0 - 90.0 * (near_m / 0.4).clamp(-0.6, 1.0)) as u8;
            for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
                let (x, y) = (p[0] + dx, p[1] + dy);
                let inside = x > f64::from(self.x0)
                    && x < f64::from(self.x0 + self.width)
                    && y > f64::from(self.y0)
                    && y < f64::from(self.y0 + self.height);
                if inside {
                    canvas.picture.put_pixel(x as u32, y as u32, colour(distance_m, grey));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Pose, Shape, place};

    #[test]
    fn a_point_before_the_chest_is_right_of_the_body_from_the_side_and_on_it_from_the_front() {
        let shape = Shape::template(1.7);
        let placed = place(&shape.offsets(), &Pose::rest(shape.offsets()[0])).positions;
        // Beside the trunk in front view (x = 0.1 to the left) and 0.4 m before it.
        let point = Vector3::new(0.1, 1.2, 0.4);
        let dot = |x: Vector3<f64>| CloudDot { x, distance_m: f64::NAN };
        let with = cloud_and_body(&[dot(point), dot(Vector3::new(9.0, 0.0, 0.0))], &placed, Up::Y, "t").unwrap();
        let without = cloud_and_body(&[], &placed, Up::Y, "t").unwrap();
        let changed: Vec<(u32, u32)> =
            with.enumerate_pixels().filter(|(x, y, p)| *p != without.get_pixel(*x, *y)).map(|(x, y, _)| (x, y)).collect();
        assert_eq!(changed.len(), 8);
        let panel = 2.0 * HALF_WIDTH_M * PX_PER_M;
        let y = 56.0 + (ABOVE_M - 1.2) * PX_PER_M;
        for x in [64.0 + (HALF_WIDTH_M + 0.4) * PX_PER_M, 64.0 + panel + 30.0 + (HALF_WIDTH_M + 0.1) * PX_PER_M] {
            assert!(
                changed.iter().any(|(cx, cy)| (f64::from(*cx) - x).abs() <= 2.0 && (f64::from(*cy) - y).abs() <= 2.0),
                "{x} {y} {changed:?}"
            );
        }
    }
}
