//! Puts a motion clip on the floor before a rig.
//!
//! Clips live in a y-up world of their own; the rig's world has its own up axis. world_from_clip turns up to up, turns the
//! way of travel (or, for a motion on the spot, the way the subject faces at first) to the wanted heading and carries the
//! first root position over the wanted start. The lowest skin of the whole clip touches the floor.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::body::surface::Surface;
use crate::body::{Clip, Joint, Placement, Pose, Shape, place};
use crate::math::rotation;
use crate::rig::{Rig, Up};

/// A motion that goes no farther than this is taken to be on the spot, metres.
const ON_THE_SPOT_M: f64 = 0.3;
/// Share of the picture's width and height that stays free around a body that counts as in view.
const MARGIN: f64 = 0.03;
/// Towards the cameras out of a straight crossing: far arm and leg are then seen, not only hidden.
const TURN_TO_CAMERAS: f64 = 0.35;
/// Beyond this distance a subject is too small for the stereo of a rig with decimetres of baseline.
const FARTHEST_M: f64 = 5.0;

/// Floor coordinates of a world: two axes that together with up make a right-handed frame (x, y for z up; z, x for y up).
pub fn floor_axes(up: Up) -> [Vector3<f64>; 2] {
    match up {
        Up::Z => [Vector3::x(), Vector3::y()],
        Up::Y => [Vector3::z(), Vector3::x()],
    }
}

/// The template at the stature (metres) whose standing hip height is the clip's.
pub fn subject_of(clip: &Clip) -> Shape {
    Shape::template(clip.hip_height_m / Shape::template(1.0).hip_height_m())
}

/// The clip between two times at another frame rate: slerp for rotations, linear for the root. Times beyond the clip are
/// clipped; an empty clip stays empty.
pub fn resample(clip: &Clip, fps: f64, from_s: f64, to_s: f64) -> Clip {
    let last = clip.poses.len().saturating_sub(1);
    let (from, to) = (from_s.max(0.0), to_s.min(last as f64 / clip.fps));
    // A hair of slack: 44/30 s at 30 fps are 45 frames however the quotient was rounded.
    let count = if clip.poses.is_empty() || to < from { 0 } else { ((to - from) * fps + 1e-6).floor() as usize + 1 };
    let at = |k: usize| {
        let place = (from + k as f64 / fps) * clip.fps;
        let i = (place as usize).min(last);
        clip.poses[i].towards(&clip.poses[(i + 1).min(last)], (place - i as f64).clamp(0.0, 1.0))
    };
    Clip { fps, poses: (0..count).map(at).collect(), ..clip.clone() }
}

/// Carries the clip's world to the rig's: `start_m` in floor coordinates, `heading` in radians from the first floor axis
/// towards the second. Heights are kept.
pub fn world_from_clip(clip: &Clip, up: Up, start_m: [f64; 2], heading: f64) -> Isometry3<f64> {
    let [first, second] = floor_axes(up);
    let world_from_y_up = match up {
        Up::Y => UnitQuaternion::identity(),
        Up::Z => rotation::exp(&Vector3::new(std::f64::consts::FRAC_PI_2, 0.0, 0.0)),
    };
    let (Some(a), Some(b)) = (clip.poses.first(), clip.poses.last()) else { return Isometry3::identity() };
    let travel = (b.root - a.root).component_mul(&Vector3::new(1.0, 0.0, 1.0));
    let way = world_from_y_up * if travel.norm() > ON_THE_SPOT_M { travel } else { a.world_from_root * Vector3::z() };
    let turn = rotation::exp(&(up.direction() * (heading - way.dot(&second).atan2(way.dot(&first)))));
    let world_from_clip = turn * world_from_y_up;
    let begin = world_from_clip * a.root;
    let shift = first * (start_m[0] - begin.dot(&first)) + second * (start_m[1] - begin.dot(&second));
    Isometry3::from_parts(Translation3::from(shift), world_from_clip)
}

/// The clip's poses in the rig's world, performed by a body of `shape`: the path is scaled by the ratio of hip heights.
pub fn poses_in_world(clip: &Clip, shape: &Shape, up: Up, start_m: [f64; 2], heading: f64) -> Vec<Pose> {
    let mut scaled = clip.clone();
    scaled.poses.iter_mut().for_each(|p| p.root *= shape.hip_height_m() / clip.hip_height_m);
    let world_from_clip = world_from_clip(&scaled, up, start_m, heading);
    let mut poses = scaled.poses;
    for pose in &mut poses {
        pose.root = (world_from_clip * nalgebra::Point3::from(pose.root)).coords;
        pose.world_from_root = world_from_clip.rotation * pose.world_from_root;
    }
    let (surface, offsets) = (Surface::new(shape), shape.offsets());
    let lowest = poses.iter().map(|p| lowest_m(&surface, &place(&offsets, p), up)).fold(f64::INFINITY, f64::min);
    poses.iter_mut().for_each(|p| p.root -= up.direction() * lowest);
    poses
}

/// Height of the lowest primitive's skin, metres.
pub fn lowest_m(surface: &Surface, placement: &Placement, up: Up) -> f64 {
    let skin = crate::body::surface::SKIN.sqrt();
    let lowest = surface.primitives.iter().map(|p| {
        let world_from_node = placement.world_from_node[p.node as usize];
        let centre = placement.position(p.node) + world_from_node * p.centre;
        let up_in_node = world_from_node.inverse() * up.direction();
        centre.dot(&up.direction()) - skin * p.semi_axes.component_mul(&up_in_node).norm()
    });
    lowest.fold(f64::INFINITY, f64::min)
}

/// True when every camera sees the whole skeleton in `pose` (rig's world), with a margin.
pub fn in_view(rig: &Rig, shape: &Shape, pose: &Pose) -> bool {
    let placement = place(&shape.offsets(), pose);
    let tips = Joint::ALL
        .into_iter()
        .filter_map(|j| Some(placement.position(j) + placement.world_from_node[j as usize] * j.end_site()? * shape.stature_m));
    let points: Vec<_> = placement.positions.iter().copied().chain(tips).collect();
    rig.cameras.iter().all(|camera| {
        let [width, height] = camera.size_px.map(f64::from);
        points.iter().all(|x| {
            camera.project(x).is_some_and(|p| {
                let inside = |v: f64, size: f64| v > MARGIN * size && v < (1.0 - MARGIN) * size;
                inside(p.x, width) && inside(p.y, height)
            })
        })
    })
}

/// Horizontal direction in which the rig looks.
fn forward(rig: &Rig) -> Vector3<f64> {
    let up = rig.up.direction();
    let sum: Vector3<f64> = rig.cameras.iter().map(|c| c.camera_from_world.inverse() * Vector3::z()).sum();
    (sum - up * sum.dot(&up)).try_normalize(1e-9).unwrap_or(floor_axes(rig.up)[1])
}

/// Heading (radians) that crosses the rig's view from left to right and a little towards the cameras.
pub fn crossing_heading(rig: &Rig) -> f64 {
    let (forward, axes) = (forward(rig), floor_axes(rig.up));
    let way = forward.cross(&rig.up.direction()) * TURN_TO_CAMERAS.cos() - forward * TURN_TO_CAMERAS.sin();
    way.dot(&axes[1]).atan2(way.dot(&axes[0]))
}

/// Start (floor coordinates, metres) of a clip with this heading before the middle of the rig, as near as all of it is in
/// view or, if it is too long for that, a little behind where its middle is in view. `None` if no distance up to 5 m shows
/// even the middle pose whole.
pub fn cross_the_view(rig: &Rig, clip: &Clip, shape: &Shape, heading: f64) -> Option<[f64; 2]> {
    let axes = floor_axes(rig.up);
    let centre = rig.cameras.iter().map(|c| c.centre()).sum::<Vector3<f64>>() / rig.cameras.len() as f64;
    let poses = poses_in_world(clip, shape, rig.up, [0.0; 2], heading);
    let half_way = (poses.first()?.root + poses.last()?.root) / 2.0;
    let start_at = |distance: f64| axes.map(|axis| axis.dot(&(centre + forward(rig) * distance - half_way)));
    let seen = |pose: &Pose, distance: f64| {
        let [a, b] = start_at(distance);
        in_view(rig, shape, &Pose { root: pose.root + axes[0] * a + axes[1] * b, ..pose.clone() })
    };
    let nearest_that = |shows: &dyn Fn(f64) -> bool| (10..).map(|i| 0.1 * i as f64).take_while(|d| *d <= FARTHEST_M).find(|d| shows(*d));
    if let Some(distance) = nearest_that(&|d| poses.iter().all(|p| seen(p, d))) {
        return Some(start_at(distance));
    }
    let middle = poses.iter().min_by(|a, b| (a.root - half_way).norm().total_cmp(&(b.root - half_way).norm()))?;
    nearest_that(&|d| seen(middle, d)).map(|d| start_at((d + 0.7).min(FARTHEST_M)))
}

/// The longest run of poses that every camera sees whole.
pub fn longest_run_in_view(rig: &Rig, shape: &Shape, poses: &[Pose]) -> std::ops::Range<usize> {
    let (mut best, mut begin) = (0..0, 0);
    for (i, pose) in poses.iter().enumerate() {
        if !in_view(rig, shape, pose) {
            begin = i + 1;
        } else if i + 1 - begin > best.len() {
            best = begin..i + 1;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phantom::scene::tests::lab_rig;

    /// Strides of 1.2 m/s along x + z of the clip's world at 100 fps, body facing the way it goes.
    fn walk(seconds: f64) -> Clip {
        let shape = Shape::template(1.7);
        let pose = |k: usize| {
            let t = k as f64 / 100.0;
            let mut pose = Pose::rest(
                shape.offsets()[0] + Vector3::new(1.0, 0.3, 1.0) * (1.2 * t / 2f64.sqrt()).min(1e9) + Vector3::new(5.0, 0.0, 0.0),
            );
            pose.root.y = shape.offsets()[0].y + 0.3;
            pose.world_from_root = rotation::exp(&Vector3::new(0.0, std::f64::consts::FRAC_PI_4, 0.0));
            pose.joints[Joint::LHip as usize - 1] = rotation::exp(&Vector3::new(0.5 * (5.0 * t).sin(), 0.0, 0.0));
            pose
        };
        let count = (seconds * 100.0) as usize + 1;
        Clip { fps: 100.0, poses: (0..count).map(pose).collect(), offsets: shape.offsets(), hip_height_m: shape.hip_height_m() }
    }

    #[test]
    fn clip_starts_where_it_should_goes_where_it_should_and_stands_on_the_floor() {
        let clip = walk(1.5);
        let shape = subject_of(&clip);
        assert!((shape.stature_m - 1.7).abs() < 1e-9);
        for up in [Up::Z, Up::Y] {
            let [first, second] = floor_axes(up);
            assert!((first.cross(&second) - up.direction()).norm() < 1e-12);
            let poses = poses_in_world(&clip, &shape, up, [0.4, 3.0], 0.5);
            let (a, b) = (&poses[0], &poses[poses.len() - 1]);
            assert!((a.root.dot(&first) - 0.4).abs() < 1e-9 && (a.root.dot(&second) - 3.0).abs() < 1e-9);
            let way = first * 0.5f64.cos() + second * 0.5f64.sin();
            assert!((b.root - a.root - way * 1.8).norm() < 1e-9);
            assert!(
                (a.world_from_root * Vector3::z() - way).norm() < 1e-9 && (a.world_from_root * Vector3::y() - up.direction()).norm() < 1e-9
            );
            // The sole of the upright leg is on the floor, though the clip floats 0.3 m above its own.
            let height = a.root.dot(&up.direction());
            assert!((height - shape.offsets()[0].y).abs() < 0.02, "{height}");
            // A child of half the hip height takes half the steps.
            let child = poses_in_world(&clip, &Shape::template(0.85), up, [0.0; 2], 0.0);
            assert!(((child[150].root - child[0].root).norm() - 0.9).abs() < 1e-9);
        }
    }

    #[test]
    fn resampling_keeps_time_and_halves_turns() {
        let clip = walk(1.0);
        let at_30 = resample(&clip, 30.0, 0.1, 0.9);
        assert_eq!((at_30.poses.len(), at_30.fps), (25, 30.0));
        let expected = clip.poses[0].root + (clip.poses[100].root - clip.poses[0].root) * (0.1 + 7.0 / 30.0);
        assert!((at_30.poses[7].root - expected).norm() < 1e-9);
        let angle = at_30.poses[7].joint(Joint::LHip).scaled_axis().x;
        assert!((angle - 0.5 * (5.0 * (0.1 + 7.0 / 30.0_f64)).sin()).abs() < 2e-4);
        assert_eq!(resample(&clip, 50.0, -1.0, 99.0).poses.len(), 51);
        assert_eq!(resample(&clip, 50.0, 2.0, 99.0).poses.len(), 0);
    }

    #[test]
    fn automatic_placing_shows_a_short_walk_whole_and_the_middle_of_a_long_one() {
        let rig = lab_rig([640, 480]);
        for (seconds, whole) in [(1.2, true), (9.0, false)] {
            let clip = resample(&walk(seconds), 30.0, 0.0, 99.0);
            let shape = subject_of(&clip);
            let heading = crossing_heading(&rig);
            let start = cross_the_view(&rig, &clip, &shape, heading).unwrap();
            let poses = poses_in_world(&clip, &shape, rig.up, start, heading);
            let run = longest_run_in_view(&rig, &shape, &poses);
            assert_eq!(run.len() == poses.len(), whole, "{run:?} of {}", poses.len());
            assert!(run.len() > 30 && run.contains(&(poses.len() / 2)), "{run:?}");
            // From left to right.
            let column = |p: &Pose| rig.cameras[0].project(&p.root).unwrap().x;
            assert!(column(&poses[run.start]) + 150.0 < column(&poses[run.end - 1]));
        }
    }
}
