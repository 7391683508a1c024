//! The skin: level set of a sum of ellipsoidal fields on the skeleton (Plänkers and Fua 2003, as used by the style paper §6.1).
//!
//! u_b(x) = A_b⁻¹ (R_bᵀ (x − p_b) − c_b),  d_b = u_bᵀ u_b,  F(x) = Σ_b exp(−2 d_b),  skin: F = 1/2.            (1)
//! A_b holds the semi-axes, c_b the centre in the frame of the node that carries primitive b. Both scale with the
//! [`Shape`]: centres and the semi-axis along the limb with its length, the others with its width.
//!
//! d_eff = −½ ln F is the squared distance in primitive units, so that √d_eff is nearly linear in metres, and
//!   r = (√d_eff − √d_0) / |∇√d_eff|,  d_0 = ½ ln 2,                                                            (2)
//! is a signed distance in metres, exact for one sphere; T − F of the paper saturates two radii from the skin and
//! (T − F)/|∇F| explodes there. With the denominator frozen the derivative of (2) for a parameter that moves the material
//! at x with velocity v_b(x) in primitive b is
//!   ∂r = −Σ_b ω_b ∇d_b · v_b(x) / |∇d_eff|,  ω_b = exp(−2 d_b)/F.                                                (3)
//!
//! Limbs are chains of primitives spaced by their own semi-axis, where Σ exp(−2 (y − y_i)²/L²) ≈ √(π/2): a skin radius R
//! needs the lateral semi-axis R/√(½ ln √(2π)) = R/0.678. Chains stop short of knees and elbows by half their spacing, else
//! joints would swell by a third. Neighbouring limbs blend, so thighs swell where they touch.
//! Checked against central differences, closed forms and ray casting.

// Indexed loops of fixed length are what the compiler turns into vectors.
#![allow(clippy::needless_range_loop)]

use nalgebra::{Matrix3, Vector3};

use super::pose::Placement;
use super::shape::{Length, Shape};
use super::skeleton::Joint;
use crate::math::exponential::exp_of_negative;

/// Value of d_eff on the skin.
pub const SKIN: f64 = 0.5 * std::f64::consts::LN_2;
/// Below this d_eff, √d_eff is continued by its tangent: deep inside, where many fields add up, −½ ln F turns negative.
const DEEP: f64 = 0.05;
/// Primitives whose d exceeds the smallest by this have a weight below e⁻¹⁰ and are skipped.
const NEGLIGIBLE: f32 = 5.0;
/// Lateral skin radius of a chain over its semi-axis.
const CHAIN: f64 = 0.678;
/// Skin radius of one isolated primitive over its semi-axis: √d_0.
const SINGLE: f64 = 0.588_705_011_257_737_3;

/// One ellipsoid in the frame of its node.
#[derive(Clone, Debug)]
pub struct Primitive {
    pub node: Joint,
    /// Limb whose length and width scale it.
    pub limb: Length,
    /// Axis of the node frame along the limb: 0 x, 1 y, 2 z.
    pub axis: usize,
    /// Metres, in the node frame.
    pub centre: Vector3<f64>,
    /// Metres.
    pub semi_axes: Vector3<f64>,
}

/// The body's primitives at one shape.
#[derive(Clone, Debug)]
pub struct Surface {
    pub primitives: Vec<Primitive>,
}

/// A chain of `count` primitives from `from` to `to` (node frame, fractions of stature), skin radii across the limb
/// running from `radii.0` to `radii.1`: the two axes other than `axis`, in order. Half-way the flesh adds `bulge.0` to the
/// centre's x and z and `bulge.1` to the radii, falling off to both ends as a parabola.
struct Chain {
    node: Joint,
    axis: usize,
    from: [f64; 3],
    to: [f64; 3],
    radii: ([f64; 2], [f64; 2]),
    bulge: ([f64; 2], [f64; 2]),
    count: usize,
}

/// Skin radii of a lightly clothed adult as fractions of stature; the fit frees the widths of all limbs.
///
/// Where a skeleton's joints lie within the flesh is a convention: anatomical hip centres are found some 60 mm behind the
/// groin, animators' rigs put them into the middle or behind it. Chains lie here about the joints as the skin of four clothed
/// figures (MakeHuman's rig, two in trousers, two with bare legs) lies about theirs, on average: thighs and shanks by least
/// squares over the distances of cloud points from the bones' axes, ten places along and eight around them; feet by their
/// outline on the floor, but as low as bare ones. Without the bulges of thigh and calf knees were found 10 to 35 mm too high.
/// Calibrated on three figures each, the legs of the fourth come out within 0.3 degrees of those found with this template.
/// From figure to figure these places vary by 10 to 15 mm. Against a marker set's hip centres expect a constant 5 degrees of
/// hip flexion.
///
/// The radii of the trunk are not the skin's: they were solved for such that all fields together meet the breadths and depths of the
/// trunk in Drillis and Contini's proportions (hips 0.19, waist 0.165 and chest 0.18 of stature wide).
fn template() -> Vec<Chain> {
    use Joint::*;
    let chain = |node, axis, from, to, radii, count| Chain { node, axis, from, to, radii, bulge: ([0.0; 2], [0.0; 2]), count };
    let mut chains = vec![
        chain(Sacroiliac, 1, [0.0, -0.030, 0.003], [0.0, 0.030, 0.003], ([0.050, 0.065], [0.111, 0.071]), 3),
        chain(Vl5, 1, [0.0, 0.020, 0.008], [0.0, 0.070, 0.022], ([0.070, 0.056], [0.096, 0.073]), 3),
        chain(Vt10, 1, [0.0, 0.005, 0.031], [0.0, 0.060, 0.030], ([0.088, 0.065], [0.091, 0.085]), 3),
        chain(Vt5, 1, [0.0, 0.025, 0.031], [0.0, 0.070, 0.021], ([0.080, 0.074], [0.060, 0.055]), 2),
        chain(Vt1, 1, [0.0, 0.0, 0.006], [0.0, 0.055, 0.013], ([0.034, 0.042], [0.034, 0.034]), 3),
        chain(Skullbase, 1, [0.0, -0.004, 0.000], [0.0, 0.066, -0.010], ([0.042, 0.051], [0.048, 0.062]), 3),
    ];
    for (side, [hip, knee, ankle, midtarsal, clavicle, shoulder, elbow, wrist]) in [
        (1.0, [LHip, LKnee, LAnkle, LMidtarsal, LAcromioclavicular, LShoulder, LElbow, LWrist]),
        (-1.0, [RHip, RKnee, RAnkle, RMidtarsal, RAcromioclavicular, RShoulder, RElbow, RWrist]),
    ] {
        chains.extend([
            Chain {
                bulge: ([0.0, 0.006], [0.010, 0.009]),
                ..chain(hip, 1, [0.005 * side, -0.035, 0.007], [-0.005 * side, -0.225, 0.003], ([0.047, 0.057], [0.034, 0.039]), 6)
            },
            Chain {
                bulge: ([0.004 * side, -0.008], [0.004, 0.003]),
                ..chain(knee, 1, [0.004 * side, -0.025, -0.009], [0.002 * side, -0.235, 0.002], ([0.037, 0.036], [0.016, 0.019]), 5)
            },
            chain(ankle, 2, [0.0, -0.017, -0.024], [-0.002 * side, -0.018, 0.040], ([0.023, 0.024], [0.026, 0.022]), 3),
            chain(midtarsal, 2, [-0.003 * side, -0.001, 0.012], [-0.009 * side, -0.004, 0.055], ([0.028, 0.021], [0.021, 0.018]), 3),
            chain(clavicle, 0, [-0.030 * side, -0.018, 0.0], [0.008 * side, -0.020, 0.0], ([0.041, 0.043], [0.038, 0.041]), 2),
            chain(shoulder, 1, [0.0, -0.015, -0.004], [0.0, -0.140, 0.0], ([0.029, 0.032], [0.024, 0.026]), 4),
            chain(elbow, 1, [0.0, -0.020, 0.0], [0.0, -0.145, 0.0], ([0.025, 0.026], [0.018, 0.020]), 4),
            chain(wrist, 1, [0.0, -0.020, 0.0], [0.0, -0.080, 0.004], ([0.020, 0.033], [0.017, 0.027]), 3),
        ]);
    }
    chains
}

impl Chain {
    fn primitives(&self, shape: &Shape) -> impl Iterator<Item = Primitive> + '_ {
        let limb = Length::of(self.node);
        let length = shape.stature_m * shape.lengths[limb as usize];
        let width = shape.stature_m * shape.widths[limb as usize];
        let (from, to) = (Vector3::from(self.from), Vector3::from(self.to));
        let spacing = (to - from).norm() / (self.count - 1) as f64;
        (0..self.count).map(move |i| {
            let t = i as f64 / (self.count - 1) as f64;
            let flesh = 4.0 * t * (1.0 - t);
            let mut radii = [0, 1].map(|k| (1.0 - t) * self.radii.0[k] + t * self.radii.1[k] + flesh * self.bulge.1[k]).into_iter();
            let centre = from + t * (to - from) + flesh * Vector3::new(self.bulge.0[0], 0.0, self.bulge.0[1]);
            let semi_axes =
                Vector3::from_fn(
                    |axis, _| {
                        if axis == self.axis { length * spacing } else { width * radii.next().unwrap_or(spacing) / CHAIN }
                    },
                );
            Primitive { node: self.node, limb, axis: self.axis, centre: length * centre, semi_axes }
        })
    }
}

impl Surface {
    /// The template at a shape.
    pub fn new(shape: &Shape) -> Surface {
        let primitives = template().iter().flat_map(|c| c.primitives(shape).collect::<Vec<_>>()).collect();
        Surface { primitives }
    }

    /// One isolated ball of skin radius `radius_m` at a node; the closed form that tests compare with.
    pub fn ball(node: Joint, radius_m: f64) -> Surface {
        let semi_axes = Vector3::repeat(radius_m / SINGLE);
        Surface { primitives: vec![Primitive { node, limb: Length::of(node), axis: 1, centre: Vector3::zeros(), semi_axes }] }
    }
}

/// A primitive in the world.
#[derive(Clone, Debug)]
pub struct PosedPrimitive {
    pub node: Joint,
    pub limb: Length,
    pub axis: usize,
    /// Centre in the world, metres.
    pub centre: Vector3<f64>,
    /// u = unit_from_world (x − centre), equation (1).
    pub unit_from_world: Matrix3<f64>,
    /// Columns: the node's axes in the world.
    pub world_from_node: Matrix3<f64>,
    pub node_position: Vector3<f64>,
    pub semi_axes: Vector3<f64>,
    /// Centre in the node frame, metres.
    pub centre_in_node: Vector3<f64>,
}

/// The surface at one pose.
#[derive(Clone, Debug)]
pub struct PosedSurface {
    pub primitives: Vec<PosedPrimitive>,
    search: Search,
}

/// Primitives side by side in single precision, to find those near a point: u = M (x − origin) + t.
#[derive(Clone, Debug)]
struct Search {
    origin: Vector3<f64>,
    blocks: Vec<Block>,
}

/// Primitives of one [`Block`].
const BLOCK: usize = 8;

/// Entries of M by rows, then t, of as many primitives.
#[derive(Clone, Debug)]
struct Block([[f32; BLOCK]; 12]);

impl Search {
    fn new(primitives: &[PosedPrimitive]) -> Search {
        let origin = primitives.first().map_or(Vector3::zeros(), |p| p.centre);
        // Places of a block that no primitive takes are far from everything.
        let mut blocks = vec![Block(std::array::from_fn(|k| [if k < 9 { 0.0 } else { 1e9 }; BLOCK])); primitives.len().div_ceil(BLOCK)];
        for (i, p) in primitives.iter().enumerate() {
            let t = p.unit_from_world * (origin - p.centre);
            let block = &mut blocks[i / BLOCK].0;
            for row in 0..3 {
                (0..3).for_each(|k| block[3 * row + k][i % BLOCK] = p.unit_from_world[(row, k)] as f32);
                block[9 + row][i % BLOCK] = t[row] as f32;
            }
        }
        Search { origin, blocks }
    }

    /// d_b of all primitives at `x`.
    #[inline(always)]
    fn at(&self, x: &Vector3<f64>, into: &mut Vec<[f32; BLOCK]>) {
        let [x, y, z] = (x - self.origin).map(|v| v as f32).into();
        into.clear();
        for Block(m) in &self.blocks {
            let u = |row: usize, i: usize| m[3 * row][i] * x + m[3 * row + 1][i] * y + m[3 * row + 2][i] * z + m[9 + row][i];
            let mut distances = [0.0; BLOCK];
            for i in 0..BLOCK {
                distances[i] = u(0, i) * u(0, i) + u(1, i) * u(1, i) + u(2, i) * u(2, i);
            }
            into.push(distances);
        }
    }

    /// Least d_b of all primitives on the line from `origin` along `direction`, and how far along.
    #[inline(always)]
    fn on_line(&self, origin: &Vector3<f64>, direction: &Vector3<f64>, into: &mut Vec<[f32; BLOCK]>, places: &mut Vec<[f32; BLOCK]>) {
        let o: [f32; 3] = (origin - self.origin).map(|v| v as f32).into();
        let v: [f32; 3] = direction.map(|v| v as f32).into();
        into.clear();
        places.clear();
        for Block(m) in &self.blocks {
            let turned = |a: &[f32; 3], row: usize, i: usize| m[3 * row][i] * a[0] + m[3 * row + 1][i] * a[1] + m[3 * row + 2][i] * a[2];
            let [mut distances, mut along] = [[0.0; BLOCK]; 2];
            for i in 0..BLOCK {
                let start = [turned(&o, 0, i) + m[9][i], turned(&o, 1, i) + m[10][i], turned(&o, 2, i) + m[11][i]];
                let way = [turned(&v, 0, i), turned(&v, 1, i), turned(&v, 2, i)];
                let dot = |a: &[f32; 3], b: &[f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
                let square = dot(&way, &way);
                along[i] = -dot(&start, &way) / if square > 1e-12 { square } else { 1e-12 };
                let at = [start[0] + along[i] * way[0], start[1] + along[i] * way[1], start[2] + along[i] * way[2]];
                distances[i] = dot(&at, &at);
            }
            into.push(distances);
            places.push(along);
        }
    }
}

/// One primitive's share of the gradient at a point.
#[derive(Clone, Copy, Debug)]
pub struct Share {
    /// Index into [`PosedSurface::primitives`].
    pub primitive: usize,
    /// ω_b ∇d_b, equation (3).
    pub force: Vector3<f64>,
    /// u_b.
    pub unit: Vector3<f64>,
}

/// d_eff and its gradient at a point, with the primitives that make it.
#[derive(Clone, Debug, Default)]
pub struct Evaluation {
    pub d_eff: f64,
    pub gradient: Vector3<f64>,
    pub shares: Vec<Share>,
    near: Near,
    distances: Vec<[f32; BLOCK]>,
    places: Vec<[f32; BLOCK]>,
}

/// Longest Newton step along a line.
const LONGEST_STEP_M: f64 = 0.03;
/// Largest number of primitives that make the skin at a point.
const MOST_NEAR: usize = 16;

/// The primitives that make the skin about a point, in their order; frozen, they make the distance a smooth function.
#[derive(Clone, Copy, Debug, Default)]
pub struct Near {
    indices: [u8; MOST_NEAR],
    count: u8,
}

impl Near {
    pub fn indices(&self) -> impl Iterator<Item = usize> {
        self.indices[..self.count as usize].iter().map(|i| *i as usize)
    }

    /// Those whose d exceeds the least by less than `margin`, of too many the nearest.
    #[inline(always)]
    fn select(distances: &[[f32; BLOCK]], margin: f32) -> Near {
        let lower = |a: f32, b: f32| if b < a { b } else { a };
        let mut least = [f32::INFINITY; BLOCK];
        for block in distances {
            for i in 0..BLOCK {
                least[i] = lower(least[i], block[i]);
            }
        }
        let mut limit = least.into_iter().fold(f32::INFINITY, lower) + margin;
        loop {
            let mut near = Near::default();
            let mut farthest = f32::NEG_INFINITY;
            let holds = |block: &[f32; BLOCK]| block.iter().fold(false, |any, d| any | (*d < limit));
            for (k, block) in distances.iter().enumerate().filter(|(_, block)| holds(block)) {
                for (i, d) in block.iter().enumerate().filter(|(_, d)| **d < limit) {
                    near.push(k * BLOCK + i);
                    farthest = farthest.max(*d);
                }
            }
            if near.count as usize <= MOST_NEAR {
                return near;
            }
            limit = farthest;
        }
    }

    /// One more; of those beyond [`MOST_NEAR`] only the number is kept.
    fn push(&mut self, primitive: usize) {
        if let Some(place) = self.indices.get_mut(self.count as usize) {
            *place = primitive as u8;
        }
        self.count = self.count.saturating_add(1);
    }
}

/// The field of some primitives along a line: d_b(s) = α + 2 β s + γ s².
#[derive(Clone, Debug)]
struct LineField {
    near: Near,
    /// α, β and γ of each; of those that are not there d is large.
    terms: [[f64; MOST_NEAR]; 3],
}

impl LineField {
    /// d_b at `s`.
    #[inline(always)]
    fn squares(&self, s: f64) -> [f64; MOST_NEAR] {
        let [alpha, beta, gamma] = &self.terms;
        let mut squares = [0.0; MOST_NEAR];
        for i in 0..MOST_NEAR {
            squares[i] = alpha[i] + s * (2.0 * beta[i] + s * gamma[i]);
        }
        squares
    }

    /// d_eff at `s`.
    #[inline(always)]
    fn d_eff(&self, s: f64) -> f64 {
        let (nearest, sum) = weigh(&mut self.squares(s), self.near.count as usize);
        nearest - 0.5 * sum.ln()
    }

    /// Derivative of d_eff at `s`, and the curvature of the nearest d_b.
    #[inline(always)]
    fn slope(&self, s: f64) -> (f64, f64) {
        let [_, beta, gamma] = &self.terms;
        let mut weights = self.squares(s);
        let count = self.near.count as usize;
        let first = (0..count).fold(0, |first, i| if weights[i] < weights[first] { i } else { first });
        let (_, sum) = weigh(&mut weights, count);
        let slopes: f64 = (0..count).map(|i| weights[i] * 2.0 * (beta[i] + gamma[i] * s)).sum();
        (slopes / sum, 2.0 * gamma[first])
    }

    /// Those primitives whose d at `s` exceeds the least by less than `margin`.
    fn near(&self, s: f64, margin: f64) -> Near {
        let squares = self.squares(s);
        let limit = squares[..self.near.count as usize].iter().copied().fold(f64::INFINITY, f64::min) + margin;
        let mut near = Near::default();
        self.near.indices().zip(squares).filter(|(_, d)| *d < limit).for_each(|(i, _)| near.push(i));
        near
    }
}

/// Turns the first `count` of squared distances into exp(−2 (d − least)); the least and the sum.
#[inline(always)]
fn weigh(squares: &mut [f64; MOST_NEAR], count: usize) -> (f64, f64) {
    let nearest = squares[..count].iter().fold(f64::INFINITY, |least, d| if *d < least { *d } else { least });
    for four in squares[..count.next_multiple_of(4).min(MOST_NEAR)].as_chunks_mut::<4>().0 {
        for d in four {
            *d = exp_of_negative(-2.0 * (*d - nearest));
        }
    }
    (nearest, squares[..count].iter().sum())
}

impl Evaluation {
    /// Signed distance to the skin in metres, positive outside, equation (2).
    pub fn distance(&self) -> f64 {
        (self.root() - SKIN.sqrt()) * self.metres_per_root()
    }

    /// √d_eff, continued by its tangent deep inside.
    pub fn root(&self) -> f64 {
        root(self.d_eff)
    }

    /// Derivative of [`root`](Self::root) for d_eff.
    pub fn root_slope(&self) -> f64 {
        root_slope(self.d_eff)
    }

    /// 1/|∇√d_eff|, the factor that the fit freezes, metres.
    pub fn metres_per_root(&self) -> f64 {
        1.0 / (self.root_slope() * self.gradient.norm()).max(1e-6)
    }
}

fn root(d_eff: f64) -> f64 {
    d_eff.max(DEEP).sqrt() + (d_eff - d_eff.max(DEEP)) * root_slope(d_eff)
}

fn root_slope(d_eff: f64) -> f64 {
    0.5 / d_eff.max(DEEP).sqrt()
}

impl PosedSurface {
    pub fn new(surface: &Surface, placement: &Placement) -> PosedSurface {
        let axes = placement.world_from_node.map(|q| q.to_rotation_matrix().into_inner());
        let primitives = surface.primitives.iter().map(|p| {
            let world_from_node = axes[p.node as usize];
            let node_position = placement.positions[p.node as usize];
            PosedPrimitive {
                node: p.node,
                limb: p.limb,
                axis: p.axis,
                centre: node_position + world_from_node * p.centre,
                unit_from_world: Matrix3::from_diagonal(&p.semi_axes.map(f64::recip)) * world_from_node.transpose(),
                world_from_node,
                node_position,
                semi_axes: p.semi_axes,
                centre_in_node: p.centre,
            }
        });
        let primitives: Vec<PosedPrimitive> = primitives.collect();
        PosedSurface { search: Search::new(&primitives), primitives }
    }

    /// The primitives that make the skin about `x`: those whose d exceeds the least by less than `margin`, and so have
    /// weights above exp(−2 margin).
    pub fn near(&self, x: &Vector3<f64>, margin: f32, scratch: &mut Evaluation) -> Near {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.near_avx2(x, margin, scratch) };
        }
        self.near_with(x, margin, scratch)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn near_avx2(&self, x: &Vector3<f64>, margin: f32, scratch: &mut Evaluation) -> Near {
        self.near_with(x, margin, scratch)
    }

    #[inline(always)]
    fn near_with(&self, x: &Vector3<f64>, margin: f32, scratch: &mut Evaluation) -> Near {
        self.search.at(x, &mut scratch.distances);
        Near::select(&scratch.distances, margin)
    }

    /// How far along the line from `origin` the skin is nearest: least d_eff among the closest approaches to `count` single
    /// primitives, then refined by `steps` Newton steps; and the primitives that make the skin there, see [`near`](Self::near).
    pub fn nearest_on_line(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        margin: f32,
        [count, steps]: [usize; 2],
        scratch: &mut Evaluation,
    ) -> (f64, Near) {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.nearest_on_line_avx2(origin, direction, margin, [count, steps], scratch) };
        }
        self.nearest_on_line_with(origin, direction, margin, [count, steps], scratch)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn nearest_on_line_avx2(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        margin: f32,
        numbers: [usize; 2],
        scratch: &mut Evaluation,
    ) -> (f64, Near) {
        self.nearest_on_line_with(origin, direction, margin, numbers, scratch)
    }

    #[inline(always)]
    fn nearest_on_line_with(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        margin: f32,
        [count, steps]: [usize; 2],
        scratch: &mut Evaluation,
    ) -> (f64, Near) {
        self.search.on_line(origin, direction, &mut scratch.distances, &mut scratch.places);
        let near = Near::select(&scratch.distances, margin);
        let place = |i: usize| (scratch.distances[i / BLOCK][i % BLOCK], scratch.places[i / BLOCK][i % BLOCK]);
        let mut places = [(f32::INFINITY, 0.0); MOST_NEAR];
        places.iter_mut().zip(near.indices()).for_each(|(p, i)| *p = place(i));
        places[..near.count as usize].sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let field = self.along_line(&near, origin, direction);
        let mut best = (f64::INFINITY, 0.0);
        for (_, along) in &places[..count.min(near.count as usize)] {
            let d_eff = field.d_eff(f64::from(*along));
            if d_eff < best.0 {
                best = (d_eff, f64::from(*along));
            }
        }
        // Near one primitive d_eff is a parabola along the line; Newton steps with its curvature settle the blend.
        let mut along = best.1;
        for _ in 0..steps {
            let (slope, curvature) = field.slope(along);
            along -= (slope / curvature).clamp(-LONGEST_STEP_M, LONGEST_STEP_M);
        }
        (along, field.near(along, f64::from(margin)))
    }

    #[inline(always)]
    fn along_line(&self, near: &Near, origin: &Vector3<f64>, direction: &Vector3<f64>) -> LineField {
        let mut terms = [[1e9; MOST_NEAR], [0.0; MOST_NEAR], [0.0; MOST_NEAR]];
        for (i, primitive) in near.indices().enumerate() {
            let p = &self.primitives[primitive];
            let (start, way) = (p.unit_from_world * (origin - p.centre), p.unit_from_world * direction);
            [start.norm_squared(), start.dot(&way), way.norm_squared()].iter().zip(&mut terms).for_each(|(v, term)| term[i] = *v);
        }
        LineField { near: *near, terms }
    }

    /// d_eff, its gradient and the contributing primitives at `x`; `into` is reused between calls.
    pub fn evaluate_into(&self, x: &Vector3<f64>, into: &mut Evaluation) {
        into.near = self.near(x, NEGLIGIBLE, into);
        self.evaluate_among(&into.near.clone(), x, into);
    }

    /// The same of some primitives only.
    pub fn evaluate_among(&self, near: &Near, x: &Vector3<f64>, into: &mut Evaluation) {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.evaluate_among_avx2(near, x, into) };
        }
        self.evaluate_among_with(near, x, into);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn evaluate_among_avx2(&self, near: &Near, x: &Vector3<f64>, into: &mut Evaluation) {
        self.evaluate_among_with(near, x, into);
    }

    #[inline(always)]
    fn evaluate_among_with(&self, near: &Near, x: &Vector3<f64>, into: &mut Evaluation) {
        into.shares.clear();
        let mut weights = [1e9; MOST_NEAR];
        for (weight, primitive) in weights.iter_mut().zip(near.indices()) {
            let p = &self.primitives[primitive];
            let unit = p.unit_from_world * (x - p.centre);
            *weight = unit.norm_squared();
            into.shares.push(Share { primitive, force: Vector3::zeros(), unit });
        }
        let (nearest, sum) = weigh(&mut weights, near.count as usize);
        let over = 1.0 / sum;
        into.gradient = Vector3::zeros();
        for (share, weight) in into.shares.iter_mut().zip(weights) {
            share.force = self.primitives[share.primitive].unit_from_world.tr_mul(&share.unit) * (2.0 * weight * over);
            into.gradient += share.force;
        }
        into.d_eff = nearest - 0.5 * sum.ln();
    }

    /// [`Evaluation::root`] of some primitives alone, without the gradient.
    pub fn root_among(&self, near: &Near, x: &Vector3<f64>) -> f64 {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.root_among_avx2(near, x) };
        }
        self.root_among_with(near, x)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn root_among_avx2(&self, near: &Near, x: &Vector3<f64>) -> f64 {
        self.root_among_with(near, x)
    }

    #[inline(always)]
    fn root_among_with(&self, near: &Near, x: &Vector3<f64>) -> f64 {
        let mut squares = [1e9; MOST_NEAR];
        for (square, primitive) in squares.iter_mut().zip(near.indices()) {
            let p = &self.primitives[primitive];
            *square = (p.unit_from_world * (x - p.centre)).norm_squared();
        }
        let (nearest, sum) = weigh(&mut squares, near.count as usize);
        root(nearest - 0.5 * sum.ln())
    }

    pub fn evaluate(&self, x: &Vector3<f64>) -> Evaluation {
        let mut evaluation = Evaluation::default();
        self.evaluate_into(x, &mut evaluation);
        evaluation
    }

    /// F(x), equation (1).
    pub fn field(&self, x: &Vector3<f64>) -> f64 {
        self.primitives.iter().map(|p| (-2.0 * (p.unit_from_world * (x - p.centre)).norm_squared()).exp()).sum()
    }

    /// Signed distance to the skin in metres, positive outside, equation (2).
    pub fn distance(&self, x: &Vector3<f64>) -> f64 {
        self.evaluate(x).distance()
    }

    /// Outward direction at `x`, not normalised: ∇d_eff.
    pub fn gradient(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self.evaluate(x).gradient
    }
}

impl PosedPrimitive {
    /// Velocity in the node frame of the material at `unit` when its limb lengthens by its own length per second.
    pub fn lengthening(&self, unit: &Vector3<f64>) -> Vector3<f64> {
        let mut velocity = self.centre_in_node;
        velocity[self.axis] += self.semi_axes[self.axis] * unit[self.axis];
        velocity
    }

    /// The same when it widens by its own width per second.
    pub fn widening(&self, unit: &Vector3<f64>) -> Vector3<f64> {
        let mut velocity = self.semi_axes.component_mul(unit);
        velocity[self.axis] = 0.0;
        velocity
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Pose, place};
    use crate::math::rotation::exp;

    fn bent_pose() -> Pose {
        let mut pose = Pose::rest(Vector3::new(0.3, 0.9, -0.2));
        pose.world_from_root = exp(&Vector3::new(0.1, 0.6, -0.05));
        for (k, q) in pose.joints.iter_mut().enumerate() {
            *q = exp(&(Vector3::new((k as f64).sin(), (2.0 * k as f64).cos(), (3.0 * k as f64).sin()) * 0.2));
        }
        pose
    }

    fn posed(shape: &Shape, pose: &Pose) -> PosedSurface {
        PosedSurface::new(&Surface::new(shape), &place(&shape.offsets(), pose))
    }

    #[test]
    fn distance_to_one_ball_is_exact_inside_and_far_outside() {
        let placement = place(&Shape::template(1.7).offsets(), &bent_pose());
        let ball = PosedSurface::new(&Surface::ball(Joint::LKnee, 0.1), &placement);
        for rho in [0.06, 0.1, 0.15, 0.5, 2.0] {
            let x = placement.position(Joint::LKnee) + rho * Vector3::new(0.48, -0.6, 0.64);
            assert!((ball.distance(&x) - (rho - 0.1)).abs() < 1e-9, "{rho}");
        }
    }

    #[test]
    fn gradient_matches_central_differences_and_field_agrees_with_d_eff() {
        let surface = posed(&Shape::template(1.7), &bent_pose());
        for p in surface.primitives.iter().step_by(5) {
            let x = p.centre + Vector3::new(0.07, -0.05, 0.04);
            let e = surface.evaluate(&x);
            assert!((surface.field(&x).ln() * -0.5 - e.d_eff).abs() < 1e-4);
            let numeric = Vector3::from_fn(|k, _| {
                let h = Vector3::ith(k, 1e-6);
                (surface.evaluate(&(x + h)).d_eff - surface.evaluate(&(x - h)).d_eff) / 2e-6
            });
            assert!((numeric - e.gradient).norm() < 1e-4 * e.gradient.norm(), "{numeric} {}", e.gradient);
        }
    }

    /// Half the width of the body through `at` along `direction`, by marching out of the inside.
    fn radius(surface: &PosedSurface, at: Vector3<f64>, direction: Vector3<f64>) -> f64 {
        (1..4000).map(|i| i as f64 * 1e-4).find(|s| surface.field(&(at + direction * *s)) < 0.5).unwrap()
    }

    #[test]
    fn limbs_have_the_radii_of_the_template() {
        let shape = Shape::template(1.75);
        let mut pose = Pose::rest(Vector3::new(0.0, 0.95, 0.0));
        for (joint, sign) in [(Joint::LShoulder, 1.0), (Joint::RShoulder, -1.0), (Joint::LHip, 0.3), (Joint::RHip, -0.3)] {
            pose.joints[joint as usize - 1] = exp(&Vector3::new(0.0, 0.0, sign));
        }
        let placement = place(&shape.offsets(), &pose);
        let surface = posed(&shape, &pose);
        for (node, along, expected) in [
            (Joint::LHip, 0.6, 0.0461),
            (Joint::LKnee, 0.5, 0.0349),
            (Joint::LShoulder, 0.5, 0.0265),
            (Joint::LKnee, 0.0, 0.0345),
            (Joint::LElbow, 0.0, 0.0245),
        ] {
            let k = node as usize;
            let end = placement.positions[k + 1];
            let at = placement.positions[k] + (end - placement.positions[k]) * along;
            let measured = radius(&surface, at, placement.world_from_node[k] * Vector3::x());
            assert!((measured - expected * 1.75).abs() < 0.06 * expected * 1.75, "{}: {measured} vs {}", node.name(), expected * 1.75);
        }
    }

    #[test]
    fn trunk_and_head_have_the_size_of_an_adult() {
        let shape = Shape::template(1.0);
        let mut pose = Pose::rest(Vector3::new(0.0, Joint::Root.rest_position().y, 0.0));
        for (joint, sign) in [(Joint::LShoulder, 0.7), (Joint::RShoulder, -0.7)] {
            pose.joints[joint as usize - 1] = exp(&Vector3::new(0.0, 0.0, sign));
        }
        let surface = posed(&shape, &pose);
        let across = |height: f64, direction: Vector3<f64>| radius(&surface, Vector3::new(0.0, height, 0.0), direction);
        for (height, half_breadth) in [(0.53, 0.095), (0.65, 0.082), (0.70, 0.090)] {
            assert!((across(height, Vector3::x()) - half_breadth).abs() < 0.01, "{height}: {}", across(height, Vector3::x()));
        }
        for (height, depth) in [(0.53, 0.143), (0.62, 0.130), (0.71, 0.150)] {
            let measured = across(height, Vector3::z()) + across(height, -Vector3::z());
            assert!((measured - depth).abs() < 0.015, "{height}: {measured}");
        }
        let crown = 0.95 + radius(&surface, Vector3::new(0.0, 0.95, 0.01), Vector3::y());
        assert!((crown - 1.0).abs() < 0.01, "{crown}");
    }

    #[test]
    fn wider_and_longer_limbs_move_the_skin_as_the_velocities_say() {
        let pose = bent_pose();
        let base = Shape::template(1.7);
        let placement = place(&base.offsets(), &pose);
        let before = posed(&base, &pose);
        let h = 1e-5;
        for limb in [Length::Thigh, Length::Foot, Length::Trunk, Length::Forearm] {
            for lengthen in [false, true] {
                let at = |step: f64| {
                    let mut shape = base.clone();
                    if lengthen {
                        shape.lengths[limb as usize] += step
                    } else {
                        shape.widths[limb as usize] += step
                    }
                    // The same placement: only what the primitives do within their nodes.
                    PosedSurface::new(&Surface::new(&shape), &placement)
                };
                let (plus, minus) = (at(h), at(-h));
                for p in before.primitives.iter().filter(|p| p.limb == limb) {
                    let x = p.centre + Vector3::new(0.03, 0.02, -0.05);
                    let e = before.evaluate(&x);
                    let numeric = (plus.evaluate(&x).d_eff - minus.evaluate(&x).d_eff) / (2.0 * h);
                    let analytic: f64 = e
                        .shares
                        .iter()
                        .filter(|s| before.primitives[s.primitive].limb == limb)
                        .map(|s| {
                            let b = &before.primitives[s.primitive];
                            let v = if lengthen { b.lengthening(&s.unit) } else { b.widening(&s.unit) };
                            -s.force.dot(&(b.world_from_node * v))
                        })
                        .sum();
                    assert!((numeric - analytic).abs() < 1e-5 * (1.0 + numeric.abs()), "{limb:?} {lengthen} {numeric} {analytic}");
                }
            }
        }
    }
}
