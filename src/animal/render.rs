//! Pictures of a creature by an orthographic rasteriser: its silhouette, and a shaded view.
//!
//! Triangles are filled where pixel centres lie inside (edge functions), the nearest in front; faces are lit from the
//! viewer's upper left. Strokes are capsules. Checked against the closed form of an ellipsoid's outline and its depth.

use image::{GrayImage, Luma, Rgb, RgbImage};
use nalgebra::{Vector2, Vector3};

use super::creature::{Creature, Local};

/// An orthographic view; `right` and `up` are unit vectors of the world, the viewer looks along `up` × `right`.
#[derive(Clone, Copy, Debug)]
pub struct View {
    pub right: Vector3<f64>,
    pub up: Vector3<f64>,
    /// World point in the middle of the picture.
    pub centre: Vector3<f64>,
    pub px_per_unit: f64,
    pub size_px: [u32; 2],
}

impl View {
    /// From the creature's right side, the whole rest pose with half of its length round it.
    pub fn side(creature: &Creature, size_px: [u32; 2]) -> View {
        let [low, high] = creature.bounds().unwrap_or_default();
        let extent = high - low;
        let fit = |length: f64, px: u32| f64::from(px) / (1.35 * length.max(1e-9));
        View {
            right: Vector3::z(),
            up: Vector3::y(),
            centre: (low + high) / 2.0,
            px_per_unit: fit(extent.z, size_px[0]).min(fit(extent.y, size_px[1])),
            size_px,
        }
    }

    pub fn pixel(&self, world: &Vector3<f64>) -> Vector2<f64> {
        let p = world - self.centre;
        let [width, height] = self.size_px.map(f64::from);
        Vector2::new((width - 1.0) / 2.0 + self.px_per_unit * p.dot(&self.right), (height - 1.0) / 2.0 - self.px_per_unit * p.dot(&self.up))
    }

    /// Towards the viewer.
    fn back(&self) -> Vector3<f64> {
        self.right.cross(&self.up)
    }
}

/// What a pixel shows: the triangle, and its place towards the viewer.
type Hit = Option<(u32, f64)>;

fn hits(creature: &Creature, vertices: &[Vector3<f64>], view: &View) -> Vec<Hit> {
    let [width, height] = view.size_px;
    let mut hits: Vec<Hit> = vec![None; width as usize * height as usize];
    let back = view.back();
    let placed: Vec<(Vector2<f64>, f64)> = vertices.iter().map(|v| (view.pixel(v), v.dot(&back))).collect();
    for (t, corners) in creature.skin.triangles.iter().enumerate() {
        let Some([a, b, c]) = get_three(&placed, corners) else { continue };
        let area = (b.0 - a.0).perp(&(c.0 - a.0));
        if area == 0.0 {
            continue;
        }
        let range = |k: usize, size: u32| {
            let low = a.0[k].min(b.0[k]).min(c.0[k]).ceil().max(0.0);
            let high = a.0[k].max(b.0[k]).max(c.0[k]).floor().min(f64::from(size) - 1.0);
            low as u32..(high + 1.0).max(0.0) as u32
        };
        for y in range(1, height) {
            for x in range(0, width) {
                let p = Vector2::new(f64::from(x), f64::from(y));
                let weights = [(b.0 - p).perp(&(c.0 - p)), (c.0 - p).perp(&(a.0 - p)), (a.0 - p).perp(&(b.0 - p))].map(|w| w / area);
                if weights.iter().any(|w| *w < 0.0) {
                    continue;
                }
                let depth = weights[0] * a.1 + weights[1] * b.1 + weights[2] * c.1;
                let hit = &mut hits[(y * width + x) as usize];
                if hit.is_none_or(|(_, nearest)| depth > nearest) {
                    *hit = Some((t as u32, depth));
                }
            }
        }
    }
    hits
}

fn get_three<T: Copy>(list: &[T], corners: &[u32; 3]) -> Option<[T; 3]> {
    let [a, b, c] = corners.map(|i| list.get(i as usize).copied());
    Some([a?, b?, c?])
}

/// 255 where the creature is.
pub fn silhouette(creature: &Creature, posture: &[Local], view: &View) -> GrayImage {
    let hits = hits(creature, &creature.vertices(posture), view);
    let mut mask = GrayImage::new(view.size_px[0], view.size_px[1]);
    mask.iter_mut().zip(&hits).for_each(|(p, hit)| *p = if hit.is_some() { 255 } else { 0 });
    mask
}

/// The creature in its colours on `ground`.
pub fn shaded(creature: &Creature, posture: &[Local], view: &View, ground: [u8; 3]) -> RgbImage {
    let vertices = creature.vertices(posture);
    let hits = hits(creature, &vertices, view);
    let light = (view.back() + view.up * 0.8 - view.right * 0.4).normalize();
    let colour = |triangle: u32| {
        let corners = creature.skin.triangles.get(triangle as usize)?;
        let [a, b, c] = get_three(&vertices, corners)?;
        let mut normal = (b - a).cross(&(c - a)).try_normalize(0.0)?;
        if normal.dot(&view.back()) < 0.0 {
            normal = -normal;
        }
        let lit = 0.45 + 0.6 * normal.dot(&light).max(0.0);
        let base = creature.skin.vertices.get(corners[0] as usize)?.colour;
        Some(base.map(|v| (f64::from(v) * lit).min(255.0) as u8))
    };
    let mut picture = RgbImage::from_pixel(view.size_px[0], view.size_px[1], Rgb(ground));
    for (pixel, hit) in picture.pixels_mut().zip(&hits) {
        if let Some(shade) = hit.and_then(|(t, _)| colour(t)) {
            *pixel = Rgb(shade);
        }
    }
    picture
}

/// A line drawn by hand, pixels; integer coordinates are pixel centres.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stroke {
    /// What it stands for: `spine`, `leg`, `head` or whatever else.
    pub part: String,
    pub width_px: f64,
    pub points: Vec<[f64; 2]>,
}

/// White strokes with round ends on black.
pub fn strokes(strokes: &[Stroke], size_px: [u32; 2]) -> GrayImage {
    let mut mask = GrayImage::new(size_px[0], size_px[1]);
    for stroke in strokes {
        let radius = stroke.width_px / 2.0;
        for k in 0..stroke.points.len() {
            let (a, b) = (stroke.points[k], stroke.points[(k + 1).min(stroke.points.len() - 1)]);
            let range = |axis: usize| {
                let low = (a[axis].min(b[axis]) - radius).ceil().max(0.0);
                let high = (a[axis].max(b[axis]) + radius).floor().min(f64::from(size_px[axis]) - 1.0);
                low as u32..(high + 1.0).max(0.0) as u32
            };
            for y in range(1) {
                for x in range(0) {
                    if distance([f64::from(x), f64::from(y)], a, b) <= radius {
                        mask.put_pixel(x, y, Luma([255]));
                    }
                }
            }
        }
    }
    mask
}

/// From a point to a segment.
fn distance(p: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    let (along, to) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let length2 = along[0] * along[0] + along[1] * along[1];
    let part = if length2 > 0.0 { ((to[0] * along[0] + to[1] * along[1]) / length2).clamp(0.0, 1.0) } else { 0.0 };
    (to[0] - part * along[0]).hypot(to[1] - part * along[1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::horse::ellipsoids;

    #[test]
    fn an_ellipsoids_outline_and_place_are_those_of_the_closed_form() {
        let (radii, turn) = (Vector3::new(0.5, 0.3, 1.0), 0.4f64);
        let axis = Vector3::new(0.0, turn.sin(), turn.cos());
        let creature = ellipsoids(&[(Vector3::new(0.0, 2.0, 0.0), axis, radii)]);
        let view =
            View { right: Vector3::z(), up: Vector3::y(), centre: Vector3::new(0.0, 2.0, 0.1), px_per_unit: 60.0, size_px: [160, 100] };
        let mask = silhouette(&creature, &creature.rest(), &view);
        // Projected onto y z, the ellipsoid's quadric with axes z' (along, 1.0) and y' (0.3).
        let inside = |x: u32, y: u32| {
            let (z, y) = ((f64::from(x) - 79.5) / 60.0 + 0.1, -(f64::from(y) - 49.5) / 60.0);
            let (along, across) = (z * turn.cos() + y * turn.sin(), y * turn.cos() - z * turn.sin());
            (along / 1.0).powi(2) + (across / 0.3).powi(2) < 1.0
        };
        let wrong = mask.enumerate_pixels().filter(|(x, y, p)| inside(*x, *y) != (p.0[0] > 0)).count();
        let all = mask.iter().filter(|p| **p > 0).count();
        assert!(all > 2500 && wrong < all / 50, "{wrong} of {all}");
        let picture = shaded(&creature, &creature.rest(), &view, [255; 3]);
        assert!(picture.pixels().zip(mask.iter()).all(|(p, m)| (p.0 == [255; 3]) == (*m == 0)));
    }

    #[test]
    fn strokes_are_capsules() {
        let stroke = Stroke { part: "spine".into(), width_px: 6.0, points: vec![[10.0, 10.0], [30.0, 10.0]] };
        let mask = strokes(&[stroke], [40, 20]);
        for (x, y, p) in mask.enumerate_pixels() {
            let (x, y) = (f64::from(x), f64::from(y));
            let away = (x - x.clamp(10.0, 30.0)).hypot(y - 10.0);
            assert_eq!(p.0[0] > 0, away <= 3.0);
        }
        let dot = Stroke { part: "head".into(), width_px: 3.0, points: vec![[5.0, 5.0]] };
        assert_eq!(strokes(&[dot], [9, 9]).iter().filter(|p| **p > 0).count(), 9);
    }
}
