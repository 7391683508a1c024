//! How far estimates lie from the known truth.
//!
//! Distance to the skin: the foot p of the perpendicular is found by sliding x's projection into the tangent plane at p back
//! onto the skin along the field's gradient. Joints and angles as in the usual scores of markerless motion capture: 13 joint
//! centres, and included angles that do not depend on how joint frames are defined.
//! Fails where a point is nearer to the skin's centre of curvature than half its radius: then the distance is an upper bound.
//! Checked against balls and against a dense sampling of the whole skin.

use nalgebra::Vector3;

use crate::body::Joint::*;
use crate::body::{Joint, NODES, PosedSurface};

/// Positions of all nodes at one instant, metres, by `joint as usize`.
pub type Positions = [Vector3<f64>; NODES];

/// Joint centres that are scored.
pub const SCORED: [Joint; 13] = [Root, LHip, RHip, LKnee, RKnee, LAnkle, RAnkle, LShoulder, RShoulder, LElbow, RElbow, LWrist, RWrist];

/// Included angles that are scored: name, and three joints of which the second is the vertex, left and right.
pub const ANGLES: [(&str, [[Joint; 3]; 2]); 4] = [
    ("hip", [[LShoulder, LHip, LKnee], [RShoulder, RHip, RKnee]]),
    ("knee", [[LHip, LKnee, LAnkle], [RHip, RKnee, RAnkle]]),
    ("shoulder", [[LHip, LShoulder, LElbow], [RHip, RShoulder, RElbow]]),
    ("elbow", [[LShoulder, LElbow, LWrist], [RShoulder, RElbow, RWrist]]),
];

/// Slides of the foot of the perpendicular; each halves what is missing or better within half a radius of curvature.
const SLIDES: usize = 12;

/// Distance of `x` to the skin, metres, without sign: to the nearest foot that sliding from the gradient's finds, which from
/// deep inside a limb need not be the nearest of all.
pub fn distance_to_skin(skin: &PosedSurface, x: &Vector3<f64>) -> f64 {
    let mut foot = onto_skin(skin, *x);
    let mut least = (x - foot).norm();
    for _ in 0..SLIDES {
        let normal = skin.gradient(&foot).normalize();
        let offset = x - foot;
        let along = offset - normal * normal.dot(&offset);
        if along.norm() < 1e-5 {
            break;
        }
        foot = onto_skin(skin, foot + along);
        least = least.min((x - foot).norm());
    }
    least
}

fn onto_skin(skin: &PosedSurface, mut x: Vector3<f64>) -> Vector3<f64> {
    for _ in 0..10 {
        let here = skin.evaluate(&x);
        let Some(normal) = here.gradient.try_normalize(1e-9) else { break };
        let distance = here.distance();
        x -= normal * distance;
        if distance.abs() < 1e-6 {
            break;
        }
    }
    x
}

/// Mean errors over time and joints.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointErrors {
    /// Of the joint centres, metres.
    pub absolute_m: f64,
    /// With both roots moved together, metres.
    pub root_relative_m: f64,
    /// Of the included angles in the order of [`ANGLES`], both sides together, radians.
    pub angles: [f64; ANGLES.len()],
    /// Of knees and ankles if left and right were exchanged, over that as they are: below 1 the legs are swapped.
    pub swapped_over_straight: f64,
}

impl JointErrors {
    /// Mean error of all included angles, radians.
    pub fn angle(&self) -> f64 {
        self.angles.iter().sum::<f64>() / self.angles.len() as f64
    }
}

/// Errors of `found` against `truth`, instant by instant.
pub fn joint_errors(found: &[Positions], truth: &[Positions]) -> JointErrors {
    let mean = |error: &dyn Fn(&Positions, &Positions) -> f64| {
        found.iter().zip(truth).map(|(f, t)| error(f, t)).sum::<f64>() / found.len().min(truth.len()).max(1) as f64
    };
    let over = |pairs: &[(Joint, Joint)], relative: bool| {
        mean(&|f, t| {
            let shift = if relative { f[0] - t[0] } else { Vector3::zeros() };
            pairs.iter().map(|(a, b)| (f[*a as usize] - t[*b as usize] - shift).norm()).sum::<f64>() / pairs.len() as f64
        })
    };
    let scored = SCORED.map(|j| (j, j));
    let straight = [LKnee, LAnkle, RKnee, RAnkle].map(|j| (j, j));
    let swapped = [(LKnee, RKnee), (LAnkle, RAnkle), (RKnee, LKnee), (RAnkle, LAnkle)];
    JointErrors {
        absolute_m: over(&scored, false),
        root_relative_m: over(&scored, true),
        angles: ANGLES.map(|(_, sides)| {
            mean(&|f, t| sides.iter().map(|s| (included_angle(f, s) - included_angle(t, s)).abs()).sum::<f64>() / sides.len() as f64)
        }),
        swapped_over_straight: over(&swapped, false) / over(&straight, false).max(1e-12),
    }
}

/// Mean error of the joint centres, metres, when the mean offset of each joint in the person's frame (true hip line, `up`)
/// is taken out: a skeleton of another kind has constant offsets, an error in tracking has not.
pub fn varying_m(found: &[Positions], truth: &[Positions], up: &Vector3<f64>) -> f64 {
    let of_joint = |joint: Joint| {
        let in_person = |(f, t): (&Positions, &Positions)| {
            let hips = t[LHip as usize] - t[RHip as usize];
            let side = (hips - up * hips.dot(up)).try_normalize(1e-9).unwrap_or_default();
            let error = f[joint as usize] - t[joint as usize];
            Vector3::new(error.dot(&side), error.dot(&up.cross(&side)), error.dot(up))
        };
        let errors: Vec<Vector3<f64>> = found.iter().zip(truth).map(in_person).collect();
        let mean = errors.iter().sum::<Vector3<f64>>() / errors.len().max(1) as f64;
        errors.iter().map(|e| (e - mean).norm()).sum::<f64>() / errors.len().max(1) as f64
    };
    SCORED.map(of_joint).iter().sum::<f64>() / SCORED.len() as f64
}

/// Angle at the second of three joints, radians.
pub fn included_angle(positions: &Positions, joints: &[Joint; 3]) -> f64 {
    let [a, b, c] = joints.map(|j| positions[j as usize]);
    (a - b).angle(&(c - b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Pose, Shape, Surface, place};
    use crate::math::rotation::exp;
    use crate::phantom::Figure;

    #[test]
    fn distance_to_a_ball_is_exact_on_both_sides() {
        let placed = place(&Shape::template(1.7).offsets(), &Pose::rest(Vector3::zeros()));
        let ball = PosedSurface::new(&Surface::ball(LKnee, 0.1), &placed);
        for rho in [0.06, 0.1, 0.13, 0.4] {
            let x = placed.position(LKnee) + rho * Vector3::new(0.48, -0.6, 0.64);
            assert!((distance_to_skin(&ball, &x) - (rho - 0.1f64).abs()).abs() < 1e-7, "{rho}");
        }
    }

    #[test]
    fn distance_to_a_body_is_that_to_the_nearest_of_its_sampled_points() {
        let shape = Shape::template(1.75);
        let (surface, offsets) = (Surface::new(&shape), shape.offsets());
        let mut pose = Pose::rest(Vector3::new(0.0, 0.95, 0.0));
        pose.joints[LHip as usize - 1] = exp(&Vector3::new(-0.4, 0.0, 0.05));
        pose.joints[RKnee as usize - 1] = exp(&Vector3::new(0.7, 0.0, 0.0));
        let placed = place(&offsets, &pose);
        let figure = Figure::new(&surface, &offsets, &placed);
        let mut skin_points = Vec::new();
        // Rays every 4 mm from four sides.
        for eye in [Vector3::z(), -Vector3::z(), Vector3::x(), -Vector3::x()].map(|d| d * 4.0 + Vector3::y()) {
            let mut seen = figure.seen_from(&eye);
            for (column, row) in (-100..100).flat_map(|c| (-250..250).map(move |r| (c, r))) {
                let across = Vector3::y().cross(&(eye - Vector3::y()).normalize());
                let target = Vector3::y() + across * (0.004 * f64::from(column)) + Vector3::y() * (0.004 * f64::from(row));
                skin_points.extend(seen.look(&(target - eye).normalize()).map(|s| s.position));
            }
        }
        let skin = PosedSurface::new(&surface, &placed);
        assert!(skin_points.iter().all(|p| distance_to_skin(&skin, p) < 1e-4));
        for (i, p) in skin_points.iter().step_by(1501).enumerate() {
            // Off the skin to all sides by up to 50 mm, less than the radius of a limb.
            let x = p + 0.03 * Vector3::new((i as f64).sin(), (1.7 * i as f64).cos(), (2.3 * i as f64).sin());
            let brute = skin_points.iter().map(|q| (x - q).norm()).fold(f64::INFINITY, f64::min);
            let found = distance_to_skin(&skin, &x);
            // Samples are 4 mm apart, so the nearest of them is at most sqrt(d^2 + 3^2 mm) away where sampled at all.
            assert!((found - brute).abs() < 0.0035, "{x:?}: {found} {brute}");
        }
    }

    #[test]
    fn offsets_that_turn_with_the_person_do_not_vary() {
        let offsets = Shape::template(1.7).offsets();
        let facing = |angle: f64| Pose { world_from_root: exp(&(Vector3::y() * angle)), ..Pose::rest(Vector3::new(angle, 0.9, 0.0)) };
        let truth: Vec<Positions> = (0..8).map(|k| place(&offsets, &facing(0.3 * f64::from(k))).positions).collect();
        let shifted = |by: &dyn Fn(usize) -> Vector3<f64>| -> Vec<Positions> {
            truth.iter().enumerate().map(|(k, t)| t.map(|x| x + exp(&(Vector3::y() * 0.3 * k as f64)) * by(k))).collect()
        };
        let up = Vector3::y();
        assert!(varying_m(&shifted(&|_| Vector3::new(0.02, -0.01, 0.03)), &truth, &up) < 1e-12);
        // Back and forth by 2 cm about the mean.
        let swinging = shifted(&|k| Vector3::new(0.01, 0.0, if k % 2 == 0 { 0.02 } else { -0.02 }));
        assert!((varying_m(&swinging, &truth, &up) - 0.02).abs() < 1e-12);
        // Offsets that stay in the world turn against the person.
        let dragged: Vec<Positions> = truth.iter().map(|t| t.map(|x| x + Vector3::new(0.02, 0.0, 0.0))).collect();
        assert!(varying_m(&dragged, &truth, &up) > 0.005);
    }

    #[test]
    fn joint_errors_by_hand() {
        let shape = Shape::template(1.7);
        let truth = place(&shape.offsets(), &Pose::rest(Vector3::new(0.0, 0.9, 0.0)));
        let mut pose = Pose::rest(Vector3::new(0.03, 0.9, 0.0));
        pose.joints[LKnee as usize - 1] = exp(&Vector3::new(0.5, 0.0, 0.0));
        let found = place(&shape.offsets(), &pose);
        let errors = joint_errors(&[found.positions], &[truth.positions]);
        let ankle = 2.0 * 1.7 * 0.246 * 0.25f64.sin();
        assert!((errors.root_relative_m - ankle / 13.0).abs() < 1e-9);
        let sideways = (ankle.powi(2) + 0.03f64.powi(2)).sqrt();
        assert!((errors.absolute_m - (12.0 * 0.03 + sideways) / 13.0).abs() < 1e-9);
        assert!((errors.angles[1] - 0.25).abs() < 1e-9 && errors.angles[0].abs() < 1e-9 && errors.angles[3].abs() < 1e-9);
        assert!((errors.angle() - 0.0625).abs() < 1e-9);
        assert!(errors.swapped_over_straight > 1.0);
        // Exchanged legs are told.
        let mut exchanged = truth.positions;
        exchanged.swap(LKnee as usize, RKnee as usize);
        exchanged.swap(LAnkle as usize, RAnkle as usize);
        assert!(joint_errors(&[exchanged], &[truth.positions]).swapped_over_straight < 1.0);
    }
}
