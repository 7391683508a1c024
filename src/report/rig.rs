//! A rig drawn from above, from the side and from behind: what each camera sees as a pyramid, its upper edge thicker.

use image::RgbImage;
use nalgebra::{Point2, Vector2, Vector3};

use super::ReportError;
use super::canvas::{Align, Canvas, Colour, GRID, INK, PALETTE, WHITE, faded, text_width_px};
use crate::rig::{Camera, Rig};

const PANEL_PX: f64 = 560.0;
const MARGIN_PX: f64 = 78.0;
const TITLE_PX: f64 = 56.0;
/// Beyond this angle from the axis a fisheye camera's corner is not drawn as one.
const WIDEST_CORNER_DEG: f64 = 75.0;
/// Views along a world axis are read more easily than views nearly along it.
const SNAP_DEG: f64 = 25.0;
/// Cameras nearer than this on the paper have one label.
const SAME_PLACE_PX: f64 = 16.0;
const LABEL_PX: f64 = 10.0;
/// With more cameras the lines between all pairs hide the rest.
const MOST_WITH_BASELINES: usize = 3;

/// One direction to look along: what is to the right and what is up on the paper, unit vectors in the world.
struct View {
    title: &'static str,
    right: Vector3<f64>,
    up: Vector3<f64>,
    /// Whether the floor is a line.
    floor: bool,
}

/// Three views of a rig side by side at one scale, with a scale bar, the world's axes and its floor at height 0.
pub fn rig_views(rig: &Rig) -> Result<RgbImage, ReportError> {
    let views = views(rig);
    let pyramids: Vec<Pyramid> = rig.cameras.iter().map(|c| Pyramid::of(c, pyramid_m(rig))).collect();
    let lows: Vec<[Vector2<f64>; 2]> = views.iter().map(|view| extent(&pyramids, view)).collect();
    let longest = lows.iter().map(|[low, high]| (high - low).max()).fold(1e-3, f64::max);
    let px_per_m = (PANEL_PX - 2.0 * MARGIN_PX) / longest;
    let mut canvas = Canvas::new((PANEL_PX * 3.0) as u32, (PANEL_PX + TITLE_PX) as u32, WHITE);
    for (k, (view, [low, high])) in views.iter().zip(&lows).enumerate() {
        let middle = Vector2::new(PANEL_PX * (k as f64 + 0.5), TITLE_PX + PANEL_PX / 2.0);
        let panel = Panel { view, px_per_m, centre_m: (low + high) / 2.0, middle_px: middle };
        panel.draw(&mut canvas, rig, &pyramids)?;
        if k > 0 {
            canvas.line([PANEL_PX * k as f64, 24.0], [PANEL_PX * k as f64, TITLE_PX + PANEL_PX - 24.0], GRID, 2)?;
        }
    }
    scale_bar(&mut canvas, px_per_m)?;
    Ok(canvas.picture)
}

/// Along the horizontal part of the mean viewing direction, or along the world's own axis where that is near or where the
/// cameras look all around.
fn views(rig: &Rig) -> [View; 3] {
    let up = rig.up.direction();
    let mean: Vector3<f64> = rig.cameras.iter().map(axis).sum::<Vector3<f64>>() / rig.cameras.len().max(1) as f64;
    let level = mean - up * mean.dot(&up);
    let axes = [0, 1, 2].map(|k| Vector3::ith(k, 1.0)).into_iter().filter(|axis| axis.dot(&up) == 0.0).flat_map(|axis| [axis, -axis]);
    let near = axes.into_iter().find(|axis| axis.angle(&level) < SNAP_DEG.to_radians());
    let forward = if level.norm() < 0.3 { up.yzx() } else { near.unwrap_or_else(|| level.normalize()) };
    let right = forward.cross(&up);
    [
        View { title: "from above", right, up: forward, floor: false },
        View { title: "from the side", right: forward, up, floor: true },
        View { title: "from behind", right, up, floor: true },
    ]
}

fn axis(camera: &Camera) -> Vector3<f64> {
    camera.camera_from_world.inverse() * Vector3::z()
}

/// Length of the drawn rays, metres: pyramids neither touch more than they must nor vanish.
fn pyramid_m(rig: &Rig) -> f64 {
    let baselines = rig.baselines_m();
    let longest = baselines.iter().map(|b| b.2).fold(0.0, f64::max);
    let shortest = baselines.iter().map(|b| b.2).fold(longest, f64::min);
    if longest > 0.0 { (0.7 * shortest).max(0.25 * longest) } else { 0.3 }
}

struct Pyramid {
    apex: Vector3<f64>,
    /// Upper left, upper right, lower right, lower left.
    corners: [Vector3<f64>; 4],
    tip: Vector3<f64>,
}

impl Pyramid {
    fn of(camera: &Camera, length_m: f64) -> Pyramid {
        let [w, h] = camera.size_px.map(|s| f64::from(s) - 1.0);
        let apex = camera.centre();
        let corners = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)].map(|(x, y)| apex + corner_ray(camera, Point2::new(x, y)) * length_m);
        Pyramid { apex, corners, tip: apex + axis(camera) * length_m }
    }

    fn points(&self) -> impl Iterator<Item = &Vector3<f64>> {
        [&self.apex, &self.tip].into_iter().chain(&self.corners)
    }
}

/// The ray through a corner, or through the point nearest to it on the way from the middle that a picture plane can hold.
fn corner_ray(camera: &Camera, corner: Point2<f64>) -> Vector3<f64> {
    let middle = Point2::new(camera.matrix[(0, 2)], camera.matrix[(1, 2)]);
    let axis = axis(camera);
    let rays = (0..=50).rev().map(|k| middle + (corner - middle) * (f64::from(k) / 50.0)).filter_map(|pixel| camera.ray(&pixel));
    rays.into_iter().find(|ray| ray.angle(&axis).to_degrees() < WIDEST_CORNER_DEG).unwrap_or(axis)
}

/// Low and high corner of what a view shows, metres on the paper: the pyramids, and the floor unless it is far away.
fn extent(pyramids: &[Pyramid], view: &View) -> [Vector2<f64>; 2] {
    let mut low = Vector2::repeat(f64::INFINITY);
    let mut high = Vector2::repeat(f64::NEG_INFINITY);
    for p in pyramids.iter().flat_map(Pyramid::points).map(|x| view.paper(x)) {
        low = low.inf(&p);
        high = high.sup(&p);
    }
    // The cameras would be drawn too small above a floor far below.
    let near = (high - low).max();
    if view.floor && low.y > 0.0 && low.y < near {
        low.y = 0.0;
    }
    [low, high]
}

impl View {
    fn paper(&self, x_in_world: &Vector3<f64>) -> Vector2<f64> {
        Vector2::new(self.right.dot(x_in_world), self.up.dot(x_in_world))
    }
}

struct Panel<'a> {
    view: &'a View,
    px_per_m: f64,
    centre_m: Vector2<f64>,
    middle_px: Vector2<f64>,
}

impl Panel<'_> {
    fn px(&self, x_in_world: &Vector3<f64>) -> [f64; 2] {
        let p = (self.view.paper(x_in_world) - self.centre_m) * self.px_per_m;
        [self.middle_px.x + p.x, self.middle_px.y - p.y]
    }

    fn draw(&self, canvas: &mut Canvas, rig: &Rig, pyramids: &[Pyramid]) -> Result<(), ReportError> {
        canvas.text([self.middle_px.x, 36.0], self.view.title, 13.0, INK, Align::Centre)?;
        self.floor(canvas)?;
        for (k, pyramid) in pyramids.iter().enumerate() {
            self.pyramid(canvas, pyramid, PALETTE[k % PALETTE.len()])?;
        }
        if pyramids.len() <= MOST_WITH_BASELINES {
            self.baselines(canvas, rig, pyramids)?;
        }
        self.labels(canvas, rig, pyramids)?;
        self.axes(canvas)
    }

    /// Height 0 as a line, or in words where it is outside.
    fn floor(&self, canvas: &mut Canvas) -> Result<(), ReportError> {
        if !self.view.floor {
            return Ok(());
        }
        let y = self.middle_px.y + self.centre_m.y * self.px_per_m;
        let [left, right] = [-0.5, 0.5].map(|share| self.middle_px.x + share * (PANEL_PX - MARGIN_PX));
        let bottom = TITLE_PX + PANEL_PX - MARGIN_PX / 2.0;
        if (TITLE_PX..bottom).contains(&y) {
            canvas.line([left, y], [right, y], faded(INK, 0.6), 2)?;
            return canvas.text([right, y + 18.0], "height 0", 9.0, faded(INK, 0.3), Align::Right);
        }
        let text = format!("middle of the picture: height {:.2} m", self.centre_m.y);
        canvas.text([self.middle_px.x, 58.0], &text, 9.0, faded(INK, 0.3), Align::Centre)
    }

    /// Lines between the cameras, with their lengths where a view shows them whole and along the paper's edges.
    fn baselines(&self, canvas: &mut Canvas, rig: &Rig, pyramids: &[Pyramid]) -> Result<(), ReportError> {
        for (i, k, baseline_m) in rig.baselines_m() {
            let (a, b) = (self.px(&pyramids[i].apex), self.px(&pyramids[k].apex));
            canvas.polyline(&[a, b], faded(INK, 0.4), 1, true)?;
            let (across, along) = ((b[0] - a[0]).abs(), (b[1] - a[1]).abs());
            let whole = across.hypot(along) > 0.9 * baseline_m * self.px_per_m && across.hypot(along) > 100.0;
            let middle = [(a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0];
            let label = format!("{:.1} cm", 100.0 * baseline_m);
            if whole && across > 5.0 * along {
                canvas.text([middle[0], middle[1] - 7.0], &label, 8.0, INK, Align::Centre)?;
            } else if whole && along > 5.0 * across {
                canvas.text([middle[0] + 7.0, middle[1] + 4.0], &label, 8.0, INK, Align::Left)?;
            }
        }
        Ok(())
    }

    fn pyramid(&self, canvas: &mut Canvas, pyramid: &Pyramid, colour: Colour) -> Result<(), ReportError> {
        let corners = pyramid.corners.map(|x| self.px(&x));
        let apex = self.px(&pyramid.apex);
        for (k, corner) in corners.iter().enumerate() {
            canvas.line(apex, *corner, faded(colour, 0.35), 1)?;
            canvas.line(*corner, corners[(k + 1) % 4], colour, if k == 0 { 4 } else { 2 })?;
        }
        canvas.polyline(&[apex, self.px(&pyramid.tip)], faded(colour, 0.35), 1, true)?;
        canvas.disc(apex, 6.0, colour)
    }

    /// Names behind the cameras as they are seen, those in one place together.
    fn labels(&self, canvas: &mut Canvas, rig: &Rig, pyramids: &[Pyramid]) -> Result<(), ReportError> {
        let places: Vec<[f64; 2]> = pyramids.iter().map(|p| self.px(&p.apex)).collect();
        let near = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < SAME_PLACE_PX;
        let mut told: Vec<bool> = vec![false; places.len()];
        let mut boxes: Vec<[f64; 4]> = Vec::new();
        for (k, pyramid) in pyramids.iter().enumerate() {
            if told[k] {
                continue;
            }
            let together: Vec<usize> = (k..places.len()).filter(|&i| !told[i] && near(places[i], places[k])).collect();
            together.iter().for_each(|&i| told[i] = true);
            let names: Vec<&str> = together.iter().map(|&i| rig.cameras[i].name.as_str()).collect();
            let seen = self.px(&pyramid.tip);
            let way = Vector2::new(places[k][0] - seen[0], places[k][1] - seen[1]);
            let long = way.norm() > 0.4 * (pyramid.tip - pyramid.apex).norm() * self.px_per_m;
            let back = if long { way.normalize() } else { Vector2::y() };
            let (label, width) = (names.join(", "), text_width_px(&names.join(", "), LABEL_PX)?);
            let share = 0.5 - 0.5 * (1.5 * back.x).clamp(-1.0, 1.0);
            let at = [places[k][0] + 15.0 * back.x - share * width, places[k][1] + 5.0 + 21.0 * back.y];
            let at = free_place(at, width, back, &mut boxes);
            let colour = if together.len() == 1 { PALETTE[k % PALETTE.len()] } else { INK };
            canvas.text(at, &label, LABEL_PX, colour, Align::Left)?;
        }
        Ok(())
    }

    /// The world's axes that this view shows, in its lower left corner.
    fn axes(&self, canvas: &mut Canvas) -> Result<(), ReportError> {
        let origin = Vector2::new(self.middle_px.x - PANEL_PX / 2.0 + 64.0, TITLE_PX + PANEL_PX - 58.0);
        let mut axes = ["x", "y", "z"].map(|name| (name, Vector2::zeros()));
        for (k, axis) in axes.iter_mut().enumerate() {
            axis.1 = self.view.paper(&Vector3::ith(k, 1.0));
        }
        axes.sort_by(|a, b| b.1.norm().total_cmp(&a.1.norm()));
        for (name, p) in &axes[..2] {
            let tip = origin + Vector2::new(p.x, -p.y) * 34.0;
            canvas.line([origin.x, origin.y], [tip.x, tip.y], INK, 2)?;
            let head = (tip - origin).normalize() * 8.0;
            for side in [Vector2::new(-head.y, head.x), Vector2::new(head.y, -head.x)] {
                let barb = tip - head + side * 0.5;
                canvas.line([tip.x, tip.y], [barb.x, barb.y], INK, 2)?;
            }
            let label = tip + (tip - origin).normalize() * 11.0;
            canvas.text([label.x, label.y + 4.0], name, 9.0, INK, Align::Centre)?;
        }
        Ok(())
    }
}

/// A label's place that covers no earlier label, moved on along `back`; its box joins the others.
fn free_place(start: [f64; 2], width_px: f64, back: Vector2<f64>, boxes: &mut Vec<[f64; 4]>) -> [f64; 2] {
    let box_at = |at: [f64; 2]| [at[0] - 4.0, at[0] + width_px + 4.0, at[1] - LABEL_PX - 5.0, at[1] + 5.0];
    let free = |b: [f64; 4]| boxes.iter().all(|o| b[0] > o[1] || b[1] < o[0] || b[2] > o[3] || b[3] < o[2]);
    let way = if back.y.abs() > 0.3 { back.y.signum() } else { 1.0 };
    let places = (0..8).map(|k| [start[0], start[1] + way * 20.0 * f64::from(k)]);
    let at = places.into_iter().find(|at| free(box_at(*at))).unwrap_or(start);
    boxes.push(box_at(at));
    at
}

/// A round length at the lower right.
fn scale_bar(canvas: &mut Canvas, px_per_m: f64) -> Result<(), ReportError> {
    let wanted = 150.0 / px_per_m;
    let decade = 10f64.powf(wanted.log10().floor());
    let metres = [5.0, 2.0, 1.0].into_iter().map(|m| m * decade).find(|m| *m <= wanted).unwrap_or(decade);
    let right = f64::from(canvas.picture.width()) - 30.0;
    let (left, y) = (right - metres * px_per_m, f64::from(canvas.picture.height()) - 28.0);
    canvas.line([left, y], [right, y], INK, 3)?;
    for x in [left, right] {
        canvas.line([x, y - 6.0], [x, y + 6.0], INK, 3)?;
    }
    let label = if metres < 1.0 { format!("{:.0} cm", metres * 100.0) } else { format!("{metres:.0} m") };
    canvas.text([(left + right) / 2.0, y - 12.0], &label, 10.0, INK, Align::Centre)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::{Lens, Up};
    use nalgebra::{Matrix3, Rotation3};

    /// An upright L of three cameras 1 m above the floor of a z-up world, looking along +y.
    fn rig(lens: Lens) -> Rig {
        let camera = |name: &str, x: f64, z: f64| {
            let camera_from_world = Rotation3::new(Vector3::x() * std::f64::consts::FRAC_PI_2);
            Camera {
                name: name.into(),
                size_px: [640, 480],
                matrix: Matrix3::new(550.0, 0.0, 320.0, 0.0, 550.0, 240.0, 0.0, 0.0, 1.0),
                lens,
                camera_from_world,
                translation: -(camera_from_world * Vector3::new(x, 0.0, z)),
            }
        };
        Rig { cameras: vec![camera("cam_00", 0.0, 1.0), camera("cam_01", 0.3, 1.0), camera("cam_02", 0.0, 1.3)], up: Up::Z }
    }

    /// Mean place of a colour in a panel.
    fn place(picture: &RgbImage, panel: u32, colour: Colour) -> [f64; 2] {
        let inside = picture.enumerate_pixels().filter(|(x, _, p)| x / PANEL_PX as u32 == panel && p.0 == colour);
        let [n, x, y] = inside.fold([0.0; 3], |s, (x, y, _)| [s[0] + 1.0, s[1] + f64::from(x), s[2] + f64::from(y)]);
        assert!(n > 50.0, "panel {panel} shows {n} pixels of {colour:?}");
        [x / n, y / n]
    }

    #[test]
    fn each_view_shows_the_cameras_where_they_stand() {
        let picture = rig_views(&rig(Lens::IDEAL)).unwrap();
        assert_eq!(picture.dimensions(), (1680, 616));
        let [a, b, c] = [0, 1, 2].map(|k| place(&picture, 2, PALETTE[k]));
        // From behind: the second to the right of the first, the third above it, both by one length.
        assert!((b[0] - a[0] - (a[1] - c[1])).abs() < 12.0 && b[0] - a[0] > 50.0, "{a:?} {b:?} {c:?}");
        assert!((a[0] - c[0]).abs() < 12.0 && (a[1] - b[1]).abs() < 12.0);
        // From the side all look to the right, the third above the first.
        // The second stands before the first one.
        let [a, c] = [1, 2].map(|k| place(&picture, 1, PALETTE[k]));
        assert!(a[1] - c[1] > 50.0 && (a[0] - c[0]).abs() < 12.0);
    }

    #[test]
    fn fisheye_single_and_surrounding_cameras_are_drawn() {
        let mut rig = rig(Lens::Fisheye([0.0; 4]));
        rig.cameras.iter_mut().for_each(|c| c.matrix[(0, 0)] = 200.0);
        assert!(rig_views(&rig).is_ok());
        let around = (0..4).map(|k| {
            let turn = Rotation3::new(Vector3::z() * (f64::from(k) * std::f64::consts::FRAC_PI_2));
            Camera {
                camera_from_world: rig.cameras[0].camera_from_world * turn,
                translation: Vector3::new(0.0, 1.0, 3.0),
                ..rig.cameras[0].clone()
            }
        });
        let around = Rig { cameras: around.collect(), up: Up::Z };
        assert!((0..4).all(|k| place(&rig_views(&around).unwrap(), 0, PALETTE[k])[1] > 0.0));
        rig.cameras.truncate(1);
        assert!(rig_views(&rig).is_ok());
    }
}
