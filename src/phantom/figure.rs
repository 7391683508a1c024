//! The posed body as rays see it: first hit on the skin, solid texture, cast shadow.
//!
//! Along a ray x(t) = o + t v every primitive is a parabola, d_b(t) = a (t − m)² + d_min, so the sum over an interval is
//! bounded by F([t0, t1]) ≤ Σ_b exp(−2 min d_b): intervals bounded below 1/2 are skipped whole, the others halved, until
//! the first crossing is bracketed in 1 mm and bisected. No crossing wider than 1 mm is missed, whatever the pose.
//!
//! Texture: every primitive carries the point back to the rest pose, x_rest = p_rest + R_bᵀ (x − p_b), and the field
//! weights exp(−2 d_b)/F average these; the noise is looked up there. It moves with the limbs and is continuous in x.
//! Checked against dense marching of the field and the closed form of one ball.

use nalgebra::{Matrix3, Vector3};

use super::noise::{Octave, octaves};
use crate::body::surface::{PosedSurface, Surface};
use crate::body::{Joint, NODES, Placement, Pose, place};

/// Primitives farther than this in d add less than 5e-5 to the field: a hundredth of a millimetre on the skin.
const REACH: f64 = 5.0;
/// Width of the bracket around the first crossing, and what bisection leaves of it, metres.
const BRACKET_M: f64 = 1e-3;
const PRECISION_M: f64 = 1e-5;
/// Cells of 3 to 15 pixels at 4 m through 550 px: what a correlation window of 7 to 15 pixels needs.
const CLOTH: [Octave; 3] = [(0.024, 0.27), (0.052, 0.28), (0.11, 0.18)];

/// A body at one instant.
pub struct Figure {
    surface: PosedSurface,
    /// Radius of influence of each primitive around its centre, metres.
    reach_m: Vec<f64>,
    rest_from_world: Vec<(Matrix3<f64>, Vector3<f64>)>,
}

/// The figure's primitives as seen from one point, and scratch space.
pub struct Eye<'a> {
    figure: &'a Figure,
    origin: Vector3<f64>,
    /// Unit direction to each primitive's centre and cosine of the half angle of its influence.
    cones: Vec<(Vector3<f64>, f64)>,
    along: Vec<Along>,
}

/// d_b along a ray: a (t − middle)² + lowest.
struct Along {
    primitive: usize,
    a: f64,
    middle: f64,
    lowest: f64,
}

/// What a ray sees of the skin.
#[derive(Clone, Debug, PartialEq)]
pub struct Skin {
    /// Distance along the ray, metres.
    pub distance: f64,
    pub position: Vector3<f64>,
    /// Unit outward normal.
    pub normal: Vector3<f64>,
    /// Share of the light that the texture reflects, 0 to 1.
    pub albedo: f64,
}

impl Figure {
    /// `offsets` as in [`place`]; they also give the rest pose that carries the texture.
    pub fn new(surface: &Surface, offsets: &[Vector3<f64>; NODES], placement: &Placement) -> Figure {
        let rest = place(offsets, &Pose::rest(offsets[Joint::Root as usize]));
        let surface = PosedSurface::new(surface, placement);
        let reach_m = surface.primitives.iter().map(|p| p.semi_axes.max() * REACH.sqrt()).collect();
        let rest_from_world = surface.primitives.iter().map(|p| {
            let rotation = p.world_from_node.transpose();
            (rotation, rest.position(p.node) - rotation * p.node_position)
        });
        Figure { rest_from_world: rest_from_world.collect(), reach_m, surface }
    }

    /// Spheres that together hold the whole skin: centres and radii, metres.
    pub fn bounds(&self) -> impl Iterator<Item = (Vector3<f64>, f64)> + '_ {
        // On the skin of n primitives at least one has exp(−2d) ≥ 1/(2n).
        let d = 0.5 * (2.0 * self.surface.primitives.len() as f64).ln();
        self.surface.primitives.iter().map(move |p| (p.centre, p.semi_axes.max() * d.sqrt()))
    }

    pub fn seen_from(&self, origin: &Vector3<f64>) -> Eye<'_> {
        let cones = self.surface.primitives.iter().zip(&self.reach_m).map(|(p, reach)| {
            let to = p.centre - origin;
            let distance = to.norm();
            let cosine = if distance > *reach { (1.0 - (reach / distance).powi(2)).sqrt() } else { -1.0 };
            (to / distance.max(1e-9), cosine)
        });
        Eye { figure: self, origin: *origin, cones: cones.collect(), along: Vec::new() }
    }

    /// Share of the light from direction `to_light` that the body keeps from `x`: 0 in the open, 1 in full shadow.
    ///
    /// The field's largest value on the way stands for the part of a broad light that the body hides, which gives a soft
    /// rim as wide as the limb that casts it.
    pub fn shadow(&self, x: &Vector3<f64>, to_light: &Vector3<f64>, scratch: &mut Shadow) -> f64 {
        scratch.0.clear();
        for ((index, p), reach) in self.surface.primitives.iter().enumerate().zip(&self.reach_m) {
            let to = p.centre - x;
            let ahead = to.dot(to_light);
            if ahead > -reach && to.norm_squared() - ahead * ahead < reach * reach {
                scratch.0.push(Along::new(index, &p.unit_from_world, &-to, to_light));
            }
        }
        let largest = scratch.0.iter().map(|top| field(&scratch.0, top.middle.max(0.0))).fold(0.0, f64::max);
        let s = ((largest - 0.05) / 0.6).clamp(0.0, 1.0);
        s * s * (3.0 - 2.0 * s)
    }
}

/// Scratch space of [`Figure::shadow`].
#[derive(Default)]
pub struct Shadow(Vec<Along>);

impl Eye<'_> {
    /// The first point of the skin along a ray (unit direction), if any.
    pub fn look(&mut self, direction: &Vector3<f64>) -> Option<Skin> {
        let distance = self.first_hit(direction)?;
        let position = self.origin + direction * distance;
        let (mut normal, mut rest, mut base, mut sum) = (Vector3::zeros(), Vector3::zeros(), 0.0, 0.0);
        for along in &self.along {
            let p = &self.figure.surface.primitives[along.primitive];
            let weight = (-2.0 * along.at(distance)).exp();
            normal += p.unit_from_world.tr_mul(&(p.unit_from_world * (position - p.centre))) * weight;
            let (rotation, shift) = &self.figure.rest_from_world[along.primitive];
            rest += (rotation * position + shift) * weight;
            base += cloth_albedo(p.node) * weight;
            sum += weight;
        }
        let albedo = (base / sum + octaves(&(rest / sum), &CLOTH, 41)).clamp(0.06, 0.95);
        Some(Skin { distance, position, normal: normal.normalize(), albedo })
    }

    /// Distance along the ray to the skin, metres.
    pub fn first_hit(&mut self, direction: &Vector3<f64>) -> Option<f64> {
        self.along.clear();
        for (index, (axis, cosine)) in self.cones.iter().enumerate() {
            if axis.dot(direction) > *cosine {
                let p = &self.figure.surface.primitives[index];
                let along = Along::new(index, &p.unit_from_world, &(self.origin - p.centre), direction);
                if along.lowest < REACH {
                    self.along.push(along);
                }
            }
        }
        first_crossing(&self.along)
    }
}

impl Along {
    fn new(primitive: usize, unit_from_world: &Matrix3<f64>, from_centre: &Vector3<f64>, direction: &Vector3<f64>) -> Along {
        let (u, v) = (unit_from_world * from_centre, unit_from_world * direction);
        let a = v.norm_squared();
        let middle = -u.dot(&v) / a;
        Along { primitive, a, middle, lowest: (u + v * middle).norm_squared() }
    }

    fn at(&self, t: f64) -> f64 {
        self.a * (t - self.middle).powi(2) + self.lowest
    }
}

fn field(along: &[Along], t: f64) -> f64 {
    along.iter().map(|p| (-2.0 * p.at(t)).exp()).sum()
}

/// Upper bound of the field on an interval.
fn bound(along: &[Along], from: f64, to: f64) -> f64 {
    along.iter().map(|p| (-2.0 * p.at(p.middle.clamp(from, to))).exp()).sum()
}

fn first_crossing(along: &[Along]) -> Option<f64> {
    let d = 0.5 * (2.0 * along.len() as f64).ln();
    let spans = along.iter().filter(|p| p.lowest < d).map(|p| (p.middle, ((d - p.lowest) / p.a).sqrt()));
    let (from, to) = spans.fold((f64::INFINITY, 0.0_f64), |(lo, hi), (m, half)| (lo.min(m - half), hi.max(m + half)));
    let (mut t, mut step) = (from.max(0.0), 0.05_f64);
    while t < to {
        if bound(along, t, t + step) < 0.5 {
            t += step;
            step *= 2.0;
        } else if step > BRACKET_M {
            step *= 0.5;
        } else if field(along, t + step) >= 0.5 {
            return Some(bisect(along, t, t + step));
        } else {
            t += step;
        }
    }
    None
}

fn bisect(along: &[Along], mut outside: f64, mut inside: f64) -> f64 {
    while inside - outside > PRECISION_M {
        let middle = 0.5 * (outside + inside);
        if field(along, middle) < 0.5 { outside = middle } else { inside = middle }
    }
    0.5 * (outside + inside)
}

/// Mean albedo by what covers the node: shoes, trousers, shirt, skin.
fn cloth_albedo(node: Joint) -> f64 {
    use Joint::*;
    match node {
        LAnkle | RAnkle | LMidtarsal | RMidtarsal => 0.32,
        Root | Sacroiliac | LHip | RHip | LKnee | RKnee => 0.42,
        Vc4 | Skullbase | LWrist | RWrist => 0.68,
        _ => 0.58,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::math::rotation::exp;
    use crate::phantom::scene::tests::stride;

    #[test]
    fn first_hit_agrees_with_dense_marching_of_the_field() {
        let shape = Shape::template(1.72);
        let (surface, offsets) = (Surface::new(&shape), shape.offsets());
        let placement = place(&offsets, &stride(&shape, 0.7));
        let (figure, posed) = (Figure::new(&surface, &offsets, &placement), PosedSurface::new(&surface, &placement));
        let origin = Vector3::new(0.3, 0.2, 1.1);
        let mut eye = figure.seen_from(&origin);
        let (mut hits, mut misses) = (0, 0);
        for i in 0..400 {
            let aim = Vector3::new(0.1 + 0.25 * (i as f64 * 0.618).sin(), 3.0, 0.95 + 0.95 * (i as f64 * 0.414).cos());
            let direction = (aim - origin).normalize();
            let marched = (0..6000).map(|k| 2.2 + k as f64 * 2.5e-4).find(|t| posed.field(&(origin + direction * *t)) >= 0.5);
            match (eye.look(&direction), marched) {
                (Some(skin), Some(t)) => {
                    // Behind a rim thinner than the march's step the march sees the next limb.
                    assert!(skin.distance < t + 5e-5 && skin.distance > t - 4e-4, "{i}: {} {t}", skin.distance);
                    assert!(posed.distance(&skin.position).abs() < 1e-4);
                    let outward = posed.gradient(&skin.position).normalize();
                    assert!(outward.dot(&skin.normal) > 1.0 - 1e-4);
                    hits += 1;
                }
                (None, None) => misses += 1,
                // One of them may miss a graze less than a millimetre deep.
                (found, marched) => {
                    let t = found.map(|s| s.distance).or(marched).unwrap();
                    let deepest = (0..100).map(|k| posed.field(&(origin + direction * (t + k as f64 * 2e-5)))).fold(0.0, f64::max);
                    assert!(deepest < 0.51, "{i}: {deepest}");
                }
            }
        }
        assert!(hits > 100 && misses > 100, "{hits} {misses}");
    }

    #[test]
    fn texture_moves_with_the_limb() {
        let shape = Shape::template(1.72);
        let (surface, offsets) = (Surface::new(&shape), shape.offsets());
        let mut poses = [stride(&shape, 0.7), stride(&shape, 0.7)];
        poses[1].joints[Joint::LKnee as usize - 1] = exp(&Vector3::new(1.0, 0.0, 0.0));
        let placements = poses.map(|p| place(&offsets, &p));
        let albedos = [0, 1].map(|k| {
            let figure = Figure::new(&surface, &offsets, &placements[k]);
            // From 1 m before the middle of the shank, seen across it at twenty heights.
            (0..20)
                .map(|i| {
                    let node = Joint::LKnee as usize;
                    let (rotation, knee) = (placements[k].world_from_node[node], placements[k].positions[node]);
                    let from = knee + rotation * Vector3::new(1.0, -0.2 - 0.005 * i as f64, 0.0);
                    figure.seen_from(&from).look(&(rotation * -Vector3::x())).map(|s| s.albedo).unwrap()
                })
                .collect::<Vec<_>>()
        });
        let spread = albedos[0].iter().fold(0.0f64, |m, a| m.max((a - albedos[0][0]).abs()));
        assert!(spread > 0.08, "{spread}");
        assert!(albedos[0].iter().zip(&albedos[1]).all(|(a, b)| (a - b).abs() < 0.01), "{albedos:?}");
    }
}
