//! The unknowns of the all-frames fit (style paper, equation 11) and how the body moves with each of them.
//!
//! The paper's root vector G_t is split: a carrier that glides smoothly with the person (heading and mean speed), and the
//! model's own root channels (tilt, list, bob, sway) riding on it, so that smoothness can be asked of the carrier alone:
//!   world_from_root = R_t exp(ρ(μ_t, α)),  p_root = g_t + R_t H π(μ_t, α),  parent_from_joint = q̄_j exp(v_j(μ_t, α)).   (1)
//! Moving one unknown moves every node rigidly, x' = v + ω × x; [`Motion`] holds these twists. Unknowns in order:
//! per frame δω, δg (left perturbation of R_t, g_t) and δμ; shared α, ln stature, limb lengths, limb widths.
//! Stature scales the body about g_t; lengths and widths also deform the primitives (body::surface).
//! Checked against central differences in `problem`.

use nalgebra::{DMatrix, Matrix3, UnitQuaternion, Vector3};

use super::curve::{Curve, CurveSample};
use crate::body::{BALL_JOINTS, Joint, Length, NODES, Placement, Pose, PosedSurface, Shape, Surface, place};
use crate::math::rotation::{exp, left_jacobian};

/// Unknowns of one frame.
pub const LOCAL: usize = 7;

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
}

/// Where the shared unknowns stand in z.
#[derive(Clone, Copy, Debug)]
pub struct SharedLayout {
    pub weights: usize,
}

impl SharedLayout {
    pub fn stature(self) -> usize {
        self.weights
    }
    pub fn length(self, limb: Length) -> usize {
        self.weights + 1 + limb as usize
    }
    pub fn width(self, limb: Length) -> usize {
        self.weights + 1 + Length::COUNT + limb as usize
    }
    pub fn size(self) -> usize {
        self.weights + 1 + 2 * Length::COUNT
    }
}

impl State {
    pub fn layout(&self) -> SharedLayout {
        SharedLayout { weights: self.weights.len() }
    }

    /// The pose of one frame, equation (1).
    pub fn pose(&self, curve: &Curve, frame: usize) -> Pose {
        let carrier = &self.carriers[frame];
        let sample = curve.sample(carrier.phase, &self.weights);
        pose_of(&sample, curve, carrier, self.shape.hip_height_m())
    }
}

fn pose_of(sample: &CurveSample, curve: &Curve, carrier: &Carrier, hip_height: f64) -> Pose {
    let value = sample.value.as_slice();
    Pose {
        root: carrier.position + carrier.world_from_carrier * (CurveSample::root_position(value) * hip_height),
        world_from_root: carrier.world_from_carrier * exp(&CurveSample::root_rotation(value)),
        joints: std::array::from_fn(|k| curve.mean_rotations[k] * exp(&CurveSample::joint(value, k))),
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
    /// Per node 6 × (LOCAL + shared): velocity v of the material at the world origin, angular velocity ω.
    pub twists: Vec<DMatrix<f64>>,
}

impl State {
    pub fn posed(&self, curve: &Curve, frame: usize) -> Posed {
        let placement = place(&self.shape.offsets(), &self.pose(curve, frame));
        Posed { surface: PosedSurface::new(&Surface::new(&self.shape), &placement), placement }
    }

    /// The posed body of one frame with the twist of every node for every unknown but stature and widths.
    pub fn motion(&self, curve: &Curve, frame: usize) -> Motion {
        let carrier = &self.carriers[frame];
        let sample = curve.sample(carrier.phase, &self.weights);
        let hip_height = self.shape.hip_height_m();
        let offsets = self.shape.offsets();
        let pose = pose_of(&sample, curve, carrier, hip_height);
        let placement = place(&offsets, &pose);
        let layout = self.layout();
        let size = LOCAL + layout.size();
        let mut twists = vec![DMatrix::zeros(6, size); NODES];
        twists[0] = self.root_twist(&sample, carrier, &placement, hip_height, size);
        let value = sample.value.as_slice();
        for joint in Joint::ALL.into_iter().skip(1) {
            let Some(parent) = joint.parent() else { continue };
            let (k, p) = (joint as usize, parent as usize);
            let mut twist = twists[p].clone();
            let at = placement.positions[k];
            let world_from_parent = placement.world_from_node[p];
            let spin = (world_from_parent * curve.mean_rotations[k - 1]).to_rotation_matrix().into_inner()
                * left_jacobian(&CurveSample::joint(value, k - 1));
            add_spin(&mut twist, &sample, &spin, &at, k - 1);
            let limb = Length::above(joint);
            let stretch = world_from_parent * offsets[k] / self.shape.lengths[limb as usize];
            add_velocity(&mut twist, LOCAL + layout.length(limb), &stretch);
            twists[k] = twist;
        }
        Motion { surface: PosedSurface::new(&Surface::new(&self.shape), &placement), twists }
    }

    fn root_twist(&self, sample: &CurveSample, carrier: &Carrier, placement: &Placement, hip_height: f64, size: usize) -> DMatrix<f64> {
        let layout = self.layout();
        let mut twist = DMatrix::zeros(6, size);
        let world_from_carrier = carrier.world_from_carrier.to_rotation_matrix().into_inner();
        for axis in 0..3 {
            let unit = Vector3::ith(axis, 1.0);
            twist[(3 + axis, axis)] = 1.0;
            add_velocity(&mut twist, axis, &carrier.position.cross(&unit));
            add_velocity(&mut twist, 3 + axis, &unit);
        }
        let value = sample.value.as_slice();
        let spin = world_from_carrier * left_jacobian(&CurveSample::root_rotation(value));
        add_spin(&mut twist, sample, &spin, &placement.positions[0], BALL_JOINTS);
        let ride = world_from_carrier * hip_height;
        add_velocity(&mut twist, 6, &(ride * CurveSample::root_position(sample.slope.as_slice())));
        for i in 0..layout.weights {
            add_velocity(&mut twist, LOCAL + i, &(ride * CurveSample::root_position(sample.components.column(i).as_slice())));
        }
        for limb in [Length::Thigh, Length::Shank, Length::Foot] {
            let h = 1e-3;
            let mut longer = self.shape.clone();
            longer.lengths[limb as usize] += h;
            // H is linear in each length factor, so this difference is exact.
            let growth = (longer.hip_height_m() - hip_height) / h;
            add_velocity(&mut twist, LOCAL + layout.length(limb), &(world_from_carrier * CurveSample::root_position(value) * growth));
        }
        twist
    }

    /// The state moved by the tangent step (y, z).
    pub fn moved(&self, y: &[f64], z: &[f64]) -> State {
        let layout = self.layout();
        let mut next = self.clone();
        for (carrier, step) in next.carriers.iter_mut().zip(y.chunks_exact(LOCAL)) {
            let turn = exp(&Vector3::new(step[0], step[1], step[2]));
            carrier.world_from_carrier = UnitQuaternion::new_normalize((turn * carrier.world_from_carrier).into_inner());
            carrier.position += Vector3::new(step[3], step[4], step[5]);
            carrier.phase += step[6];
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
        next
    }
}

fn add_velocity(twist: &mut DMatrix<f64>, column: usize, velocity: &Vector3<f64>) {
    for axis in 0..3 {
        twist[(axis, column)] += velocity[axis];
    }
}

/// Adds the rotation about `at` that phase and weights give to channel triple `k`; `spin` turns coordinate rates into ω.
fn add_spin(twist: &mut DMatrix<f64>, sample: &CurveSample, spin: &Matrix3<f64>, at: &Vector3<f64>, k: usize) {
    let mut add = |column: usize, rate: Vector3<f64>| {
        let omega = spin * rate;
        add_velocity(twist, column, &at.cross(&omega));
        for axis in 0..3 {
            twist[(3 + axis, column)] += omega[axis];
        }
    };
    add(6, CurveSample::joint(sample.slope.as_slice(), k));
    for i in 0..sample.components.ncols() {
        add(LOCAL + i, CurveSample::joint(sample.components.column(i).as_slice(), k));
    }
}
