//! The least squares behind planted feet: small changes of pelvis and legs after which soles that touch do not slide.
//!
//! Unknowns x(t) of a frame: shift of the root, its turn about the vertical, and for each leg rotation vectors of hip and ankle
//! and the bends of knee and toes, all on the right of the motion's own rotations. With p_i(t) the heel, ball and toe tip, y_i
//! their heights and u_k the unknowns by their scales,
//!   min ∫ Σ_k (c_k u_k² + τ_k⁴ ü_k²) + Σ_i w_i (ẋ_i² + ż_i²)/σ_v² + Σ_i v_i (y_i − y_i*)²/σ_y² dt                 (1)
//! During a contact w_i = b(h_i/h0), h_i the height y_i* over the foot's lowest point and b(r) = (1 − r²)²: the heel stands first,
//! then all of the foot, then ball and toe tip while the foot turns about its toes; who touches with the tip alone may pivot
//! on it. v_i = b(height over the floor/h1): feet come down where they did. y_i* is the own height, in the midst of a contact
//! the floor's where the point is under or little over it: the toes of recordings flutter there, and a toe that turns drags the
//! ball along. c_k is 1; for toes of a leg that does not stand `FREE` squared, for its joints that times (1 + |u|²/`FREE_RAD`²)²:
//! large changes grow stiff. Everything is a difference of neighbouring frames, so the equations are a band of three frames.
//! Checked against central differences.

use std::ops::Range;

use nalgebra::{DVector, SMatrix, Vector3};

use super::contact::{FootTrack, lowest_m};
use crate::body::{Clip, Joint, Pose, place};
use crate::math::arrow::{ArrowProblem, NormalEquations};
use crate::math::rotation::{exp, hat, left_jacobian};

/// Hip, knee, ankle and toes of one side.
pub const LEGS: [[Joint; 4]; 2] =
    [[Joint::LHip, Joint::LKnee, Joint::LAnkle, Joint::LMidtarsal], [Joint::RHip, Joint::RKnee, Joint::RAnkle, Joint::RMidtarsal]];
/// Shift (3) and turn (1) of the root.
const ROOT: usize = 4;
/// Hip (3), knee (1), ankle (3) and toes (1) of a leg.
const LEG: usize = 8;
pub const UNKNOWNS: usize = ROOT + 2 * LEG;

/// Scales of the unknowns: changes of a joint and of the pelvis' turn (radians) and place that weigh alike. A pelvis that gives
/// way more spares the legs and leaves the path.
const JOINT: f64 = 0.02;
/// Toes give way first: recordings know least of them. Less turns ankles and knees with them.
const TOES: f64 = 0.04;
const TURN: f64 = 0.012;
const SHIFT_M: f64 = 0.01;
/// How much more a joint's change weighs while its foot does not stand. Less lets the swing change as much as the stance; more
/// only hastens the changes at touch-down.
const FREE: f64 = 8.0;
/// Change of hip, knee or ankle at which that doubles. Less jerks where takes are noisy.
const FREE_RAD: f64 = 0.06;
/// Unknowns of hip, knee and ankle within a leg's.
const JOINTS: [Range<usize>; 3] = [0..3, 3..4, 4..7];
/// τ of legs and root, seconds. Shorter jerks, longer changes the swing, or for the root leaves more to the legs.
const LEG_S: f64 = 0.08;
const ROOT_S: f64 = 0.2;
/// σ_v: small enough that about a hundredth of a slide is left.
const SLIDE_M_S: f64 = 0.0006;
/// σ_y.
const HEIGHT_M: f64 = 0.001;
/// h0 and h1.
const TOUCH_M: f64 = 0.01;
const NEAR_M: f64 = 0.03;
/// Less leaves toes that flutter over the floor between standing and rising, more lets feet land early.
const PRESSED_M: f64 = 0.015;
/// Time from the ends of a contact over which that sets in. Shorter jerks at them.
const PRESSED_S: f64 = 0.08;

/// Unknowns of one frame.
pub type Unknowns = [f64; UNKNOWNS];

/// A point of a sole and its derivatives by the unknowns of the root and of its own leg.
type Point = (Vector3<f64>, SMatrix<f64, 3, { ROOT + LEG }>);

/// One foot over the frames; per frame the three points of its sole.
struct Foot {
    /// w_i from a frame to the next; zero outside contacts.
    touching: Vec<[f64; 3]>,
    /// v_i.
    near: Vec<[f64; 3]>,
    heights: Vec<[f64; 3]>,
    stands: Vec<bool>,
    track: FootTrack,
}

/// Equation (1) of one clip.
pub struct Footing<'a> {
    clip: &'a Clip,
    feet: [Foot; 2],
}

impl Foot {
    fn new(clip: &Clip, track: &FootTrack, contacts: &[Range<usize>]) -> Foot {
        let frames = clip.poses.len();
        let mut foot = Foot {
            touching: vec![[0.0; 3]; frames],
            near: track.soles.iter().map(|sole| sole.map(|p| bump(p.y.max(0.0) / NEAR_M))).collect(),
            heights: track.soles.iter().map(|sole| sole.map(|p| p.y)).collect(),
            stands: vec![false; frames],
            track: track.clone(),
        };
        for contact in contacts {
            foot.stands[contact.clone()].fill(true);
            for frame in contact.clone() {
                let to_end = (frame - contact.start).min(contact.end - 1 - frame) as f64 / clip.fps;
                let share = 1.0 - bump((to_end / PRESSED_S).min(1.0));
                foot.heights[frame].iter_mut().for_each(|y| *y += share * (pressed(*y) - *y));
            }
            for frame in contact.start..contact.end - 1 {
                let [u, v] = [frame, frame + 1].map(|t| touching(&foot.heights[t]));
                foot.touching[frame] = std::array::from_fn(|i| 0.5 * (u[i] + v[i]));
            }
        }
        foot
    }
}

fn bump(r: f64) -> f64 {
    (1.0 - r * r).max(0.0).powi(2)
}

/// The height that a point is to have: on the floor where it is under or little over it.
fn pressed(height_m: f64) -> f64 {
    let over = height_m.max(0.0);
    over * (1.0 - bump(over / PRESSED_M))
}

/// w_i of a sole from the heights that its points are to have; 1 for the lowest.
fn touching(heights: &[f64; 3]) -> [f64; 3] {
    let lowest = lowest_m(heights);
    heights.map(|y| bump((y.max(0.0) - lowest) / TOUCH_M))
}

fn vector(x: &[f64]) -> Vector3<f64> {
    Vector3::new(x[0], x[1], x[2])
}

/// Rotation vectors of a leg's unknowns, joint by joint.
fn leg_vectors(x: &Unknowns, side: usize) -> [Vector3<f64>; 4] {
    let leg = &x[ROOT + side * LEG..][..LEG];
    let bend = |k: usize| Vector3::new(leg[k], 0.0, 0.0);
    [vector(leg), bend(3), vector(&leg[4..]), bend(7)]
}

impl<'a> Footing<'a> {
    /// For feet that stand in `contacts`, left and right.
    pub fn new(clip: &'a Clip, tracks: &[FootTrack; 2], contacts: &[Vec<Range<usize>>; 2]) -> Footing<'a> {
        Footing { clip, feet: std::array::from_fn(|side| Foot::new(clip, &tracks[side], &contacts[side])) }
    }

    /// The pose of a frame after its change.
    pub fn pose(&self, frame: usize, x: &Unknowns) -> Pose {
        let mut pose = self.clip.poses[frame].clone();
        pose.root += vector(x);
        pose.world_from_root = exp(&Vector3::new(0.0, x[3], 0.0)) * pose.world_from_root;
        for (side, leg) in LEGS.into_iter().enumerate() {
            for (joint, turn) in leg.into_iter().zip(leg_vectors(x, side)) {
                pose.joints[joint as usize - 1] *= exp(&turn);
            }
        }
        pose
    }

    fn soles(&self, frame: usize, x: &Unknowns) -> [[Point; 3]; 2] {
        let pose = self.pose(frame, x);
        let placed = place(&self.clip.offsets, &pose);
        std::array::from_fn(|side| {
            let turns = leg_vectors(x, side);
            // About the joint in the world, by a joint's rotation vector.
            let by: [_; 4] = std::array::from_fn(|k| {
                let world_from_joint = placed.world_from_node[LEGS[side][k] as usize].to_rotation_matrix();
                (placed.position(LEGS[side][k]), world_from_joint * left_jacobian(&-turns[k]))
            });
            let points = self.feet[side].track.sole(self.clip, &placed);
            std::array::from_fn(|i| {
                let p = points[i];
                let [hip, knee, ankle, toes] = by.map(|(at, turn)| -hat(&(p - at)) * turn);
                let mut j = SMatrix::<f64, 3, { ROOT + LEG }>::zeros();
                j.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
                j.set_column(3, &Vector3::y().cross(&(p - pose.root)));
                j.fixed_view_mut::<3, 3>(0, ROOT).copy_from(&hip);
                j.set_column(ROOT + 3, &knee.column(0));
                j.fixed_view_mut::<3, 3>(0, ROOT + 4).copy_from(&ankle);
                // The heel is behind the toes' joint.
                if i > 0 {
                    j.set_column(ROOT + 7, &toes.column(0));
                }
                (p, j)
            })
        })
    }

    /// Every residual of (1) with its derivatives by unknowns, places increasing.
    fn residuals(&self, state: &[Unknowns], mut take: impl FnMut(f64, &[(usize, f64)])) {
        self.calm(state, &mut take);
        self.swing(state, &mut take);
        let dt_s = 1.0 / self.clip.fps;
        let soles: Vec<_> = state.iter().enumerate().map(|(t, x)| self.soles(t, x)).collect();
        for (t, side) in (0..state.len()).flat_map(|t| [(t, 0), (t, 1)]) {
            let foot = &self.feet[side];
            // Derivatives of a coordinate of a point of the sole.
            let by = |t: usize, i: usize, axis: usize, factor: f64| {
                let row = soles[t][side][i].1.row(axis) * factor;
                (0..ROOT + LEG).map(move |k| (t * UNKNOWNS + if k < ROOT { k } else { k + side * LEG }, row[k]))
            };
            for i in (0..3).filter(|i| foot.near[t][*i] > 0.0) {
                let factor = (dt_s * foot.near[t][i]).sqrt() / HEIGHT_M;
                let terms: [_; ROOT + LEG] = gather(by(t, i, 1, factor));
                take(factor * (soles[t][side][i].0.y - foot.heights[t][i]), &terms);
            }
            for (i, axis) in (0..3).flat_map(|i| [(i, 0), (i, 2)]).filter(|(i, _)| foot.touching[t][*i] > 0.0) {
                let factor = (foot.touching[t][i] / dt_s).sqrt() / SLIDE_M_S;
                let terms: [_; 2 * (ROOT + LEG)] = gather(by(t, i, axis, -factor).chain(by(t + 1, i, axis, factor)));
                take(factor * (soles[t + 1][side][i].0[axis] - soles[t][side][i].0[axis]), &terms);
            }
        }
    }

    /// The first two terms of (1), but for [`swing`](Self::swing).
    fn calm(&self, state: &[Unknowns], take: &mut impl FnMut(f64, &[(usize, f64)])) {
        let dt_s = 1.0 / self.clip.fps;
        for (t, k) in (0..state.len()).flat_map(|t| (0..UNKNOWNS).map(move |k| (t, k))) {
            let (scale, tau_s) = match k {
                0..3 => (SHIFT_M, ROOT_S),
                3 => (TURN, ROOT_S),
                _ if (k - ROOT) % LEG == LEG - 1 => (TOES, LEG_S),
                _ => (JOINT, LEG_S),
            };
            let at = t * UNKNOWNS + k;
            let free = k >= ROOT && !self.feet[(k - ROOT) / LEG].stands[t];
            if !free || (k - ROOT) % LEG == LEG - 1 {
                let factor = dt_s.sqrt() / scale * if free { FREE } else { 1.0 };
                take(factor * state[t][k], &[(at, factor)]);
            }
            if t > 0 && t + 1 < state.len() {
                let factor = dt_s.sqrt() / scale * (tau_s / dt_s).powi(2);
                let bend = state[t - 1][k] - 2.0 * state[t][k] + state[t + 1][k];
                take(factor * bend, &[(at - UNKNOWNS, factor), (at, -2.0 * factor), (at + UNKNOWNS, factor)]);
            }
        }
    }

    /// The first term of (1) for hips, knees and ankles of legs that do not stand.
    fn swing(&self, state: &[Unknowns], take: &mut impl FnMut(f64, &[(usize, f64)])) {
        let factor = FREE / (self.clip.fps.sqrt() * JOINT);
        for (t, side) in (0..state.len()).flat_map(|t| [(t, 0), (t, 1)]).filter(|(t, side)| !self.feet[*side].stands[*t]) {
            for joint in JOINTS {
                let first = ROOT + side * LEG + joint.start;
                let u = &state[t][first..][..joint.len()];
                let stiffness = 1.0 + u.iter().map(|v| v * v).sum::<f64>() / FREE_RAD.powi(2);
                for (i, value) in u.iter().enumerate() {
                    let mut terms = [(0, 0.0); 3];
                    for (j, other) in u.iter().enumerate() {
                        let own = if i == j { stiffness } else { 0.0 };
                        terms[j] = (t * UNKNOWNS + first + j, factor * (own + 2.0 * value * other / FREE_RAD.powi(2)));
                    }
                    take(factor * value * stiffness, &terms[..u.len()]);
                }
            }
        }
    }
}

fn gather<const N: usize>(terms: impl Iterator<Item = (usize, f64)>) -> [(usize, f64); N] {
    let mut found = [(0, 0.0); N];
    found.iter_mut().zip(terms).for_each(|(f, t)| *f = t);
    found
}

impl ArrowProblem for &Footing<'_> {
    type State = Vec<Unknowns>;

    fn cost(&self, state: &Vec<Unknowns>) -> f64 {
        let mut sum = 0.0;
        self.residuals(state, |r, _| sum += r * r);
        0.5 * sum
    }

    fn linearise(&self, state: &Vec<Unknowns>) -> NormalEquations {
        let mut normal = NormalEquations::zeros(state.len() * UNKNOWNS, 3 * UNKNOWNS - 1, 0);
        self.residuals(state, |residual, terms| {
            normal.cost += 0.5 * residual * residual;
            for (i, (row, a)) in terms.iter().enumerate() {
                normal.local_gradient[*row] += residual * a;
                terms[..=i].iter().for_each(|(column, b)| normal.local.add(*row, *column, a * b));
            }
        });
        normal
    }

    fn retract(&self, state: &Vec<Unknowns>, y: &DVector<f64>, _: &DVector<f64>) -> Vec<Unknowns> {
        state.iter().zip(y.as_slice().chunks_exact(UNKNOWNS)).map(|(x, d)| std::array::from_fn(|k| x[k] + d[k])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::motion::{Length, play_cycle};
    use crate::motion_model::{Activity, synthetic};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn every_derivative_matches_central_differences() {
        let subject = synthetic::subject(Activity::Walking, 7);
        let clip = play_cycle(&subject.mean_cycle(1.2), &subject.shape().offsets(), 30.0, Length::Seconds(0.8));
        let tracks = LEGS.map(|leg| FootTrack::new(&clip, leg[2]));
        let contacts = tracks.each_ref().map(|foot| foot.contacts(&clip));
        let footing = Footing::new(&clip, &tracks, &contacts);
        assert!(footing.feet.iter().all(|f| f.touching.iter().any(|w| w[0] > 0.0) && f.stands.iter().any(|s| !s)));
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let state: Vec<Unknowns> = clip.poses.iter().map(|_| std::array::from_fn(|_| 0.2 * (rng.random::<f64>() - 0.5))).collect();
        let residuals = |state: &[Unknowns]| {
            let mut found = Vec::new();
            footing.residuals(state, |r, _| found.push(r));
            found
        };
        let mut jacobian = Vec::new();
        footing.residuals(&state, |_, terms| jacobian.push(terms.to_vec()));
        let h = 1e-6;
        for at in 0..state.len() * UNKNOWNS {
            let [plus, minus] = [h, -h].map(|h| {
                let mut moved = state.clone();
                moved[at / UNKNOWNS][at % UNKNOWNS] += h;
                residuals(&moved)
            });
            for ((plus, minus), terms) in plus.iter().zip(&minus).zip(&jacobian) {
                let numeric = (plus - minus) / (2.0 * h);
                let analytic = terms.iter().find(|t| t.0 == at).map_or(0.0, |t| t.1);
                assert!((numeric - analytic).abs() < 1e-6 * analytic.abs().max(1e3), "{at}: {numeric} {analytic}");
            }
        }
        // The band holds JᵀJ and Jᵀr.
        let normal = (&footing).linearise(&state);
        assert!((normal.cost / (&footing).cost(&state) - 1.0).abs() < 1e-12);
        let all = residuals(&state);
        for (row, column) in [(0, 0), (40, 21), (3 * UNKNOWNS + 3, 2 * UNKNOWNS + 8), (4 * UNKNOWNS + 11, 2 * UNKNOWNS + 11)] {
            let entry = |terms: &[(usize, f64)], k: usize| terms.iter().find(|t| t.0 == k).map_or(0.0, |t| t.1);
            let expected: f64 = jacobian.iter().map(|t| entry(t, row) * entry(t, column)).sum();
            let gradient: f64 = jacobian.iter().zip(&all).map(|(t, r)| entry(t, row) * r).sum();
            assert!((normal.local.get(row, column) - expected).abs() <= 1e-9 * expected.abs(), "{row} {column}");
            assert!((normal.local_gradient[row] - gradient).abs() <= 1e-9 * gradient.abs(), "{row}");
        }
    }

    #[test]
    fn no_change_leaves_the_pose() {
        let clip = Clip { fps: 60.0, poses: vec![Pose::rest(Vector3::y())], offsets: Shape::template(1.7).offsets(), hip_height_m: 0.9 };
        let tracks = LEGS.map(|leg| FootTrack::new(&clip, leg[2]));
        let footing = Footing::new(&clip, &tracks, &[Vec::new(), Vec::new()]);
        assert_eq!(footing.pose(0, &[0.0; UNKNOWNS]), clip.poses[0]);
    }
}
