//! The unknowns of the all-frames fit (style paper, equation 11) and how the body moves with each of them.
//!
//! The paper's root vector G_t is split: a carrier that glides smoothly with the person (heading and mean speed), and the
//! model's own root channels (tilt, list, bob, sway) riding on it, so that smoothness can be asked of the carrier alone:
//!   world_from_root = R_t exp(ρ(μ_t, α)),  p_root = g_t + R_t H π(μ_t, α),
//!   parent_from_joint = q̄_j exp(v_j(μ_t, α)) exp(c_j + δ_jt).                                                             (1)
//! c_j, the posture, is what a joint keeps to all the time against the model: markers on other bodies than this one define
//! the database's joint angles. δ_jt, the deviation, lets the person leave the model from frame to frame.
//! Moving one unknown moves every node rigidly, x' = v + ω × x; [`Motion`] holds these twists. Unknowns in order:
//! per frame δω, δg (left perturbation of R_t, g_t), δμ, and δ_j; shared α, ln stature, limb lengths, limb widths, c_j.
//! Stature scales the body about g_t; lengths and widths also deform the primitives (body::surface).
//! Checked against central differences in `problem`.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use super::curve::{Curve, CurveSample};
use crate::body::{BALL_JOINTS, Joint, Length, Placement, Pose, PosedSurface, Shape, Surface, place};
use crate::math::rotation::{exp, left_jacobian, log};

/// Unknowns of one frame without deviations.
pub const LOCAL: usize = 7;

/// Joints that may be held otherwise than in the model; those between follow it. Wrists last: how they are held can be seen, how
/// they turn from frame to frame hardly.
pub const HELD: [Joint; 13] = [
    Joint::LHip,
    Joint::LKnee,
    Joint::LAnkle,
    Joint::RHip,
    Joint::RKnee,
    Joint::RAnkle,
    Joint::Vl1,
    Joint::LShoulder,
    Joint::LElbow,
    Joint::RShoulder,
    Joint::RElbow,
    Joint::LWrist,
    Joint::RWrist,
];

/// Those of them, the first, that may leave the model from frame to frame.
pub const DEVIATING: [Joint; 11] = *HELD.first_chunk().unwrap();

/// Turns of the [`DEVIATING`] joints, rad, in the joint's own frame.
pub type Turns = [Vector3<f64>; DEVIATING.len()];
/// Turns of the [`HELD`] joints, likewise.
pub type Posture = [Vector3<f64>; HELD.len()];

/// The gliding frame of one instant, and the phase.
#[derive(Clone, Debug, PartialEq)]
pub struct Carrier {
    /// At standing hip height, metres.
    pub position: Vector3<f64>,
    /// Axes of the carrier (x left, y up, z forward) in the rig's world.
    pub world_from_carrier: UnitQuaternion<f64>,
    /// Unwrapped.
    pub phase: f64,
}

/// Everything that is estimated.
#[derive(Clone, Debug)]
pub struct State {
    pub carriers: Vec<Carrier>,
    /// α, in the units of the motion vector.
    pub weights: Vec<f64>,
    pub shape: Shape,
    /// What the person's joints keep to all the time against the model.
    pub posture: Posture,
    /// Per frame, or empty: the person moves exactly as the model.
    pub deviations: Vec<Turns>,
}

/// Where the unknowns stand: y of a frame, and z.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Unknowns of one frame.
    pub local: usize,
    pub weights: usize,
}

/// Stature, lengths and widths, in this order.
pub const SIZES: usize = 1 + 2 * Length::COUNT;

impl Layout {
    /// δ of deviating joint `k`, first of three, in y of a frame; only with deviations.
    pub fn deviation(self, k: usize) -> usize {
        LOCAL + 3 * k
    }
    pub fn stature(self) -> usize {
        self.weights
    }
    pub fn length(self, limb: Length) -> usize {
        self.weights + 1 + limb as usize
    }
    pub fn width(self, limb: Length) -> usize {
        self.weights + 1 + Length::COUNT + limb as usize
    }
    /// Posture of held joint `k`, first of three.
    pub fn posture(self, k: usize) -> usize {
        self.weights + SIZES + 3 * k
    }
    /// Length of z.
    pub fn shared(self) -> usize {
        self.weights + SIZES + 3 * HELD.len()
    }
    /// Unknowns that move one frame.
    pub fn size(self) -> usize {
        self.local + self.shared()
    }
}

/// The posed body of one frame.
pub struct Posed {
    pub surface: PosedSurface,
    pub placement: Placement,
}

/// The posed body and how it moves.
pub struct Motion {
    pub surface: PosedSurface,
    /// Per node six rows of [`Layout::size`] columns: velocity v of the material at the world origin, angular velocity ω.
    pub twists: Vec<Twist>,
}

/// Six rows of `size` columns.
#[derive(Clone, Debug)]
pub struct Twist {
    entries: Vec<f64>,
    size: usize,
}

impl Twist {
    fn zeros(size: usize) -> Twist {
        Twist { entries: vec![0.0; 6 * size], size }
    }

    pub fn row(&self, i: usize) -> &[f64] {
        &self.entries[i * self.size..][..self.size]
    }

    fn add_velocity(&mut self, column: usize, velocity: &Vector3<f64>) {
        (0..3).for_each(|axis| self.entries[axis * self.size + column] += velocity[axis]);
    }

    /// Turns with `omega` about the point `at`.
    fn add_turn(&mut self, column: usize, omega: &Vector3<f64>, at: &Vector3<f64>) {
        self.add_velocity(column, &at.cross(omega));
        (0..3).for_each(|axis| self.entries[(3 + axis) * self.size + column] += omega[axis]);
    }
}

impl State {
    pub fn layout(&self) -> Layout {
        Layout { local: LOCAL + if self.deviations.is_empty() { 0 } else { 3 * DEVIATING.len() }, weights: self.weights.len() }
    }

    /// Posture and deviation of the joints in one frame together.
    fn turns(&self, frame: usize) -> Posture {
        let mut turns = self.posture;
        let deviation = self.deviations.get(frame).into_iter().flatten();
        turns.iter_mut().zip(deviation).for_each(|(turn, deviation)| *turn += deviation);
        turns
    }

    /// The pose of one frame, equation (1).
    pub fn pose(&self, curve: &Curve, frame: usize) -> Pose {
        self.pose_of(curve.value(self.carriers[frame].phase, &self.weights).as_slice(), curve, frame)
    }

    fn pose_of(&self, value: &[f64], curve: &Curve, frame: usize) -> Pose {
        let carrier = &self.carriers[frame];
        let mut joints: [UnitQuaternion<f64>; BALL_JOINTS] =
            std::array::from_fn(|k| curve.mean_rotations[k] * exp(&CurveSample::joint(value, k)));
        for (joint, turn) in HELD.iter().zip(self.turns(frame)) {
            joints[*joint as usize - 1] *= exp(&turn);
        }
        let ride = CurveSample::root_position(value) * self.shape.hip_height_m();
        Pose {
            root: carrier.position + carrier.world_from_carrier * ride,
            world_from_root: carrier.world_from_carrier * exp(&CurveSample::root_rotation(value)),
            joints,
        }
    }

    /// The posed body of one frame; `surface` is that of the shape.
    pub fn posed(&self, curve: &Curve, surface: &Surface, frame: usize) -> Posed {
        let placement = place(&self.shape.offsets(), &self.pose(curve, frame));
        Posed { surface: PosedSurface::new(surface, &placement), placement }
    }

    /// The same with the twist of every node for every unknown but stature and widths.
    pub fn motion(&self, curve: &Curve, surface: &Surface, frame: usize) -> Motion {
        let sample = curve.sample(self.carriers[frame].phase, &self.weights);
        let offsets = self.shape.offsets();
        let placement = place(&offsets, &self.pose_of(sample.value.as_slice(), curve, frame));
        let layout = self.layout();
        let turns = self.turns(frame);
        let mut twists = vec![self.root_twist(&sample, frame, &placement)];
        let value = sample.value.as_slice();
        for joint in Joint::ALL.into_iter().skip(1) {
            let Some(parent) = joint.parent() else { continue };
            let (k, p) = (joint as usize, parent as usize);
            let mut twist = twists[p].clone();
            let at = placement.positions[k];
            let world_from_parent = placement.world_from_node[p];
            let world_from_mean = (world_from_parent * curve.mean_rotations[k - 1]).to_rotation_matrix().into_inner();
            let coordinates = CurveSample::joint(value, k - 1);
            add_spin(&mut twist, layout, &sample, &(world_from_mean * left_jacobian(&coordinates)), &at, k - 1);
            if let Some(which) = HELD.iter().position(|d| *d == joint) {
                let spin = world_from_mean * exp(&coordinates).to_rotation_matrix().into_inner() * left_jacobian(&turns[which]);
                for (axis, omega) in spin.column_iter().map(|c| c.into_owned()).enumerate() {
                    twist.add_turn(layout.local + layout.posture(which) + axis, &omega, &at);
                    if layout.local > LOCAL && which < DEVIATING.len() {
                        twist.add_turn(layout.deviation(which) + axis, &omega, &at);
                    }
                }
            }
            let limb = Length::above(joint);
            let stretch = world_from_parent * offsets[k] / self.shape.lengths[limb as usize];
            twist.add_velocity(layout.local + layout.length(limb), &stretch);
            twists.push(twist);
        }
        Motion { surface: PosedSurface::new(surface, &placement), twists }
    }

    fn root_twist(&self, sample: &CurveSample, frame: usize, placement: &Placement) -> Twist {
        let (layout, carrier, hip_height) = (self.layout(), &self.carriers[frame], self.shape.hip_height_m());
        let mut twist = Twist::zeros(layout.size());
        let world_from_carrier = carrier.world_from_carrier.to_rotation_matrix().into_inner();
        for axis in 0..3 {
            let unit = Vector3::ith(axis, 1.0);
            twist.add_turn(axis, &unit, &carrier.position);
            twist.add_velocity(3 + axis, &unit);
        }
        let value = sample.value.as_slice();
        let spin = world_from_carrier * left_jacobian(&CurveSample::root_rotation(value));
        add_spin(&mut twist, layout, sample, &spin, &placement.positions[0], BALL_JOINTS);
        let ride = world_from_carrier * hip_height;
        twist.add_velocity(6, &(ride * CurveSample::root_position(sample.slope.as_slice())));
        for i in 0..layout.weights {
            let rate = CurveSample::root_position(sample.components.column(i).as_slice());
            twist.add_velocity(layout.local + i, &(ride * rate));
        }
        for limb in [Length::Thigh, Length::Shank, Length::Foot] {
            let h = 1e-3;
            let mut longer = self.shape.clone();
            longer.lengths[limb as usize] += h;
            // H is linear in each length factor, so this difference is exact.
            let growth = (longer.hip_height_m() - hip_height) / h;
            twist.add_velocity(layout.local + layout.length(limb), &(world_from_carrier * CurveSample::root_position(value) * growth));
        }
        twist
    }

    /// The state of some frames only.
    pub fn at(&self, frames: &[usize]) -> State {
        let of = |all: &[Turns]| frames.iter().filter_map(|t| all.get(*t)).copied().collect();
        let carriers = frames.iter().map(|t| self.carriers[*t].clone()).collect();
        State { carriers, deviations: of(&self.deviations), ..self.clone() }
    }

    /// The state of all frames from that of `some` of them in rising order, first and last among them: carriers go steadily
    /// from one to the next over `times_s`. Without deviations.
    pub fn between(&self, some: &[usize], times_s: &[f64]) -> State {
        let carrier = |t: usize| {
            let b = some.partition_point(|s| *s <= t).min(some.len() - 1);
            let a = b.saturating_sub(1);
            let span = times_s[some[b]] - times_s[some[a]];
            let share = if span > 0.0 { (times_s[t] - times_s[some[a]]) / span } else { 0.0 };
            let (from, to) = (&self.carriers[a], &self.carriers[b]);
            let turn = log(&(to.world_from_carrier * from.world_from_carrier.inverse()));
            Carrier {
                position: from.position.lerp(&to.position, share),
                world_from_carrier: UnitQuaternion::new_normalize((exp(&(turn * share)) * from.world_from_carrier).into_inner()),
                phase: from.phase + share * (to.phase - from.phase),
            }
        };
        State { carriers: (0..times_s.len()).map(carrier).collect(), deviations: Vec::new(), ..self.clone() }
    }

    /// The state moved by the tangent step (y, z).
    pub fn moved(&self, y: &[f64], z: &[f64]) -> State {
        let layout = self.layout();
        let mut next = self.clone();
        let triple = |v: &[f64]| Vector3::new(v[0], v[1], v[2]);
        for (carrier, step) in next.carriers.iter_mut().zip(y.chunks_exact(layout.local)) {
            let turn = exp(&triple(step));
            carrier.world_from_carrier = UnitQuaternion::new_normalize((turn * carrier.world_from_carrier).into_inner());
            carrier.position += triple(&step[3..]);
            carrier.phase += step[6];
        }
        for (turns, step) in next.deviations.iter_mut().zip(y.chunks_exact(layout.local)) {
            turns.iter_mut().enumerate().for_each(|(k, turn)| *turn += triple(&step[layout.deviation(k)..]));
        }
        for (w, dz) in next.weights.iter_mut().zip(z) {
            *w += dz;
        }
        next.shape.stature_m *= z[layout.stature()].exp();
        for (i, factor) in next.shape.lengths.iter_mut().enumerate() {
            *factor = (*factor + z[layout.weights + 1 + i]).max(0.2);
        }
        for (i, factor) in next.shape.widths.iter_mut().enumerate() {
            *factor = (*factor + z[layout.weights + 1 + Length::COUNT + i]).max(0.2);
        }
        next.posture.iter_mut().enumerate().for_each(|(k, turn)| *turn += triple(&z[layout.posture(k)..]));
        next
    }
}

/// Adds the rotation about `at` that phase and weights give to channel triple `k`; `spin` turns coordinate rates into ω.
fn add_spin(twist: &mut Twist, layout: Layout, sample: &CurveSample, spin: &Matrix3<f64>, at: &Vector3<f64>, k: usize) {
    twist.add_turn(6, &(spin * CurveSample::joint(sample.slope.as_slice(), k)), at);
    for i in 0..sample.components.ncols() {
        twist.add_turn(layout.local + i, &(spin * CurveSample::joint(sample.components.column(i).as_slice(), k)), at);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steady_carriers_come_back_between_frames() {
        let times_s = [0.0, 0.03, 0.07, 0.1, 0.2, 0.21];
        let carrier = |time_s: &f64| Carrier {
            position: Vector3::new(1.0, 2.0, 0.9) + Vector3::new(1.3, -0.2, 0.01) * *time_s,
            world_from_carrier: exp(&(Vector3::new(0.1, 2.0, -0.3) * *time_s)) * exp(&Vector3::new(1.5, 0.0, 0.2)),
            phase: 0.3 + 0.9 * time_s,
        };
        let carriers = times_s.iter().map(carrier).collect();
        let shape = Shape::template(1.7);
        let all = State { carriers, weights: vec![1.0], shape, posture: Posture::default(), deviations: Vec::new() };
        let some = [0, 2, 5];
        let back = all.at(&some).between(&some, &times_s);
        assert_eq!(back.carriers.len(), all.carriers.len());
        for (found, expected) in back.carriers.iter().zip(&all.carriers) {
            assert!((found.position - expected.position).norm() < 1e-12 && (found.phase - expected.phase).abs() < 1e-12);
            assert!(found.world_from_carrier.angle_to(&expected.world_from_carrier) < 1e-7);
        }
    }
}
