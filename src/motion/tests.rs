//! The player, the profile and planted feet on synthetic people, against finite differences and forward kinematics.

use std::f64::consts::TAU;

use nalgebra::Vector3;

use super::gait::{Change, Gait, aligning_phase};
use super::player::{Eased, GRAVITY_M_S2, Gaits, Player};
use super::{Profile, Waypoint, follow, plant_feet, play};
use crate::body::{Clip, Joint, NODES, Pose, Shape};
use crate::math::rotation::log;
use crate::motion::{Length, synthesize};
use crate::motion_model::{Activity, Model, synthetic};
use crate::style::{Method, Population, Style};

const WALKS: [f64; 4] = [0.8, 1.2, 1.6, 2.0];
const RUNS: [f64; 4] = [1.8, 2.3, 2.8, 3.4];

fn model(activity: Activity, speeds: [f64; 4]) -> Model {
    let cycles: Vec<_> = (1..5).flat_map(|seed| speeds.map(|v| synthetic::subject(activity, seed).cycle(v, 0))).collect();
    Model::build(activity, true, &cycles).unwrap()
}

pub(super) fn offsets() -> [Vector3<f64>; NODES] {
    Shape::template(1.7).offsets()
}

pub(super) fn hip_height_m() -> f64 {
    Shape::template(1.7).hip_height_m()
}

fn style(model: &Model, speed: f64) -> Style {
    Style::of_cycles(model, "", &[synthetic::subject(model.activity, 7).mean_cycle(speed)]).unwrap()
}

fn gait(model: &Model, speed: f64) -> Gait {
    let style = style(model, speed);
    let population = Population::new(model, style.weights.len());
    Gait::of_style(model, &population, Method::Default, &style, hip_height_m(), &offsets()).unwrap().unwrap().0
}

fn gaits() -> Gaits {
    Gaits::walk_and_run(gait(&model(Activity::Walking, WALKS), 1.2), gait(&model(Activity::Running, RUNS), 2.5))
}

fn profile(points: &[(f64, f64)]) -> Profile {
    Profile::new(points.iter().map(|&(time_s, speed_m_s)| Waypoint { time_s, speed_m_s, curvature: 0.0 }).collect()).unwrap()
}

/// Stands, walks, runs, walks and stands again.
fn outing() -> Profile {
    profile(&[(0.0, 0.0), (0.5, 0.0), (2.0, 1.4), (4.0, 1.4), (6.0, 3.0), (8.0, 3.0), (9.5, 1.4), (11.0, 1.4), (12.5, 0.0), (14.0, 0.0)])
}

/// Turns of all joints and of the root between two poses, rotation vectors.
pub(super) fn turns(a: &Pose, b: &Pose) -> Vec<Vector3<f64>> {
    let joints = a.joints.iter().zip(&b.joints).map(|(a, b)| log(&(a.inverse() * b)));
    joints.chain([log(&(a.world_from_root.inverse() * b.world_from_root))]).collect()
}

/// Largest joint velocity (rad/s), change of velocity from frame to frame (rad/s), and the same of the root's position.
pub(super) fn roughness(clip: &Clip) -> [f64; 4] {
    let mut worst = [0.0f64; 4];
    let mut before: Option<(Vec<Vector3<f64>>, Vector3<f64>)> = None;
    for w in clip.poses.windows(2) {
        let turning: Vec<Vector3<f64>> = turns(&w[0], &w[1]).into_iter().map(|t| t * clip.fps).collect();
        let moving = (w[1].root - w[0].root) * clip.fps;
        worst[0] = turning.iter().map(|t| t.norm()).fold(worst[0], f64::max);
        worst[2] = worst[2].max(moving.norm());
        if let Some((turned, moved)) = &before {
            worst[1] = turning.iter().zip(turned).map(|(a, b)| (a - b).norm()).fold(worst[1], f64::max);
            worst[3] = worst[3].max((moving - moved).norm());
        }
        before = Some((turning, moving));
    }
    worst
}

#[test]
fn a_steady_gait_plays_the_models_postures() {
    let model = model(Activity::Walking, WALKS);
    let style = style(&model, 1.2);
    let population = Population::new(&model, style.weights.len());
    let at = |v: f64| synthesize(&model, &population, Method::Default, &style, v, hip_height_m()).unwrap();
    let synthesis = at(1.3);
    let steady = Gait::steady(&model, &synthesis, &offsets()).unwrap();
    let over_speeds = gait(&model, 1.2);
    for k in 0..100 {
        let phase = f64::from(k) / 100.0;
        let (joints, root) = model.posture_with(synthesis.weights.as_slice(), synthesis.detail.as_ref(), phase);
        let posture = steady.posture(1.3, phase, std::iter::empty());
        assert!(posture.joints.iter().zip(&joints).all(|(a, b)| a.angle_to(b) < 1e-7));
        assert!((posture.root - root.position).norm() < 1e-9);
        // Over speeds the spline smooths: close, and far from the neighbouring speed.
        let smoothed = over_speeds.posture(1.3, phase, std::iter::empty());
        assert!(smoothed.joints.iter().zip(&joints).all(|(a, b)| a.angle_to(b) < 0.02));
    }
    let hip = |v: f64| over_speeds.posture(v, 0.0, std::iter::empty()).joints[Joint::RHip as usize - 1];
    assert!(hip(1.3).angle_to(&hip(0.9)) > 0.04, "{}", hip(1.3).angle_to(&hip(0.9)));
    assert!((over_speeds.frequency_hz(1.3) / synthesis.frequency_hz - 1.0).abs() < 2e-3);
    let (slowest, fastest) = over_speeds.range_m_s();
    assert!((over_speeds.frequency_hz(2.0 * fastest) / over_speeds.frequency_hz(fastest) - 2.0).abs() < 1e-9);
    assert!((over_speeds.frequency_hz(1e-9) / over_speeds.frequency_hz(slowest) - 0.5).abs() < 1e-6);
    // Played in time it is what `play` plays.
    let clip = play(&model, &synthesis, &offsets(), 50.0, Length::Seconds(2.0));
    let followed = follow(&Gaits::one(steady), &Profile::steady(1.3, 0.0, 2.0).unwrap(), &offsets(), 50.0).0;
    for (a, b) in clip.poses.iter().zip(&followed.poses) {
        assert!((a.root - b.root).norm() < 1e-3, "{:?} {:?}", a.root, b.root);
        assert!(turns(a, b).iter().all(|t| t.norm() < 0.01));
    }
}

#[test]
fn a_body_of_half_the_size_moves_alike_at_half_the_speed() {
    let model = model(Activity::Walking, WALKS);
    let style = style(&model, 1.2);
    let population = Population::new(&model, style.weights.len());
    let [large, small] = [1.7, 0.85].map(|stature_m| {
        let shape = Shape::template(stature_m);
        Gait::of_style(&model, &population, Method::Default, &style, shape.hip_height_m(), &shape.offsets()).unwrap().unwrap().0
    });
    let (a, b) = (large.range_m_s(), small.range_m_s());
    assert!((a.0 / b.0 - 2.0).abs() < 1e-9 && (a.1 / b.1 - 2.0).abs() < 1e-9);
    for phase in [0.1, 0.45, 0.8] {
        let (p, q) = (large.posture(1.4, phase, std::iter::empty()), small.posture(0.7, phase, std::iter::empty()));
        assert!(p.joints.iter().zip(&q.joints).all(|(p, q)| p.angle_to(q) < 0.01) && (p.root - q.root).norm() < 1e-3);
        let same_speed = small.posture(1.0, phase, std::iter::empty());
        assert!(same_speed.joints.iter().zip(&q.joints).any(|(p, q)| p.angle_to(q) > 0.03));
    }
    assert!((large.frequency_hz(1.4) / small.frequency_hz(0.7) - 1.0).abs() < 0.01);
    let runs = Gaits::walk_and_run(small.clone(), small).transition_m_s().unwrap();
    assert!((runs - (0.25 * 9.81 * hip_height_m()).sqrt()).abs() < 1e-9);
}

#[test]
fn who_stands_has_straight_legs_and_flat_soles_on_the_floor() {
    let gaits = gaits();
    let pose = Player::new(&gaits, 0.0, 0.0).pose();
    let clip = Clip { fps: 60.0, poses: vec![pose], offsets: offsets(), hip_height_m: hip_height_m() };
    let placed = clip.place(&clip.poses[0]);
    for ankle in [Joint::LAnkle, Joint::RAnkle] {
        let heights = clip.sole_points(&placed, ankle).map(|p| p.y);
        assert!(heights.iter().all(|h| h.abs() < 0.004), "{heights:?}");
    }
    let (hips, ankles) = (placed.position(Joint::LHip) - placed.position(Joint::LAnkle), clip.leg_m());
    assert!((hips.y - ankles).abs() < 1e-9);
}

#[test]
fn starts_stops_and_changes_of_gait_have_no_jump_in_position_or_velocity() {
    let gaits = gaits();
    let clips = [500.0, 1000.0].map(|fps| follow(&gaits, &outing(), &offsets(), fps).0);
    let [coarse, fine] = clips.each_ref().map(roughness);
    println!("largest joint speed {:.1} rad/s, change per ms {:.3} rad/s; root {:.2} m/s, {:.4} m/s", fine[0], fine[1], fine[2], fine[3]);
    // A jump would stand in the differences of any step: velocities would double with half the step, and changes of
    // velocity would stay.
    assert!(fine[0] < 1.02 * coarse[0] && fine[2] < 1.02 * coarse[2], "{coarse:?} {fine:?}");
    assert!(fine[1] < 0.65 * coarse[1] && fine[3] < 0.65 * coarse[3], "{coarse:?} {fine:?}");
    // Nor is a transition much rougher than steady walking and running are by themselves.
    let steady = [1.4, 3.0].map(|v| roughness(&follow(&gaits, &Profile::steady(v, 0.0, 2.0).unwrap(), &offsets(), 1000.0).0));
    println!("steady walking and running {steady:?}");
    assert!((0..2).all(|i| fine[i] < 2.0 * steady[0][i].max(steady[1][i])), "{fine:?} {steady:?}");
}

#[test]
fn the_speed_follows_the_profile_and_the_way_is_its_integral() {
    let gaits = gaits();
    let (clip, steps) = follow(&gaits, &outing(), &offsets(), 100.0);
    let off = steps.iter().map(|s| (s.speed_m_s - s.wanted_m_s).abs()).fold(0.0, f64::max);
    let way = clip.poses[clip.poses.len() - 1].root - clip.poses[0].root;
    let wanted: f64 = steps.windows(2).map(|w| 0.5 * (w[0].wanted_m_s + w[1].wanted_m_s) * (w[1].time_s - w[0].time_s)).sum();
    println!("speed off by at most {off:.3} m/s, way {:.3} of {wanted:.3} m", way.z);
    assert!(off < 0.12 && (way.z / wanted - 1.0).abs() < 0.01);
    // In the middle of ramps and plateaus it is met closely.
    for time in [1.25, 3.5, 5.0, 7.5, 8.75, 10.8, 11.75, 13.9] {
        let s = steps.iter().min_by(|a, b| (a.time_s - time).abs().total_cmp(&(b.time_s - time).abs())).unwrap();
        assert!((s.speed_m_s - s.wanted_m_s).abs() < 0.02, "{time}: {} of {}", s.speed_m_s, s.wanted_m_s);
    }
    assert!(steps[750].running == 1.0 && steps[300].running == 0.0 && steps[1080].running == 0.0);
    // Half the step, the same pose: what is played does not depend on the frame rate.
    let finer = follow(&gaits, &outing(), &offsets(), 200.0).0;
    let (a, b) = (&clip.poses[700], &finer.poses[1400]);
    assert!((a.root - b.root).norm() < 0.02, "{:?} {:?}", a.root, b.root);
}

#[test]
fn a_speed_that_hovers_about_the_transition_does_not_flicker() {
    let gaits = gaits();
    let transition = gaits.transition_m_s().unwrap();
    assert!((transition - (0.5 * 9.81 * hip_height_m()).sqrt()).abs() < 1e-12);
    let mut player = Player::new(&gaits, 0.97 * transition, 0.0);
    let mut changes = |amplitude: f64| {
        let (mut count, mut before) = (0, player.running() > 0.5);
        for k in 0..3000 {
            player.target_speed_m_s = transition * (1.0 + amplitude * (TAU * f64::from(k) / 500.0).sin());
            player.next(0.01);
            let now = player.running() > 0.5;
            count += usize::from(now != before);
            before = now;
        }
        count
    };
    assert_eq!(changes(0.03), 0);
    assert!(changes(0.15) >= 10, "wide swings change the gait each time");
}

#[test]
fn the_running_cycle_is_shifted_to_where_its_legs_agree() {
    let walk = gait(&model(Activity::Walking, WALKS), 1.2);
    let run = gait(&model(Activity::Running, RUNS), 2.5);
    let shift = aligning_phase(&walk, &run, 2.1);
    // Independently by forward kinematics: the ankles against the root.
    let ankles = |gait: &Gait, phase: f64| {
        let p = gait.posture(2.1, phase, std::iter::empty());
        let pose = Pose { root: Vector3::zeros(), world_from_root: p.carrier_from_root, joints: p.joints };
        let placed = crate::body::place(&offsets(), &pose);
        [Joint::LAnkle, Joint::RAnkle].map(|j| placed.position(j))
    };
    let apart = |shift: f64| -> f64 {
        (0..50)
            .map(|k| f64::from(k) / 50.0)
            .map(|phase| {
                let (a, b) = (ankles(&walk, phase), ankles(&run, phase + shift));
                (a[0] - b[0]).norm_squared() + (a[1] - b[1]).norm_squared()
            })
            .sum()
    };
    let best = (-50..50).map(|k| f64::from(k) / 100.0).min_by(|a, b| apart(*a).total_cmp(&apart(*b))).unwrap();
    println!("shift {shift:.3}, by ankles {best:.2}");
    assert!((shift - best).abs() < 0.06 && shift.abs() < 0.2, "{shift} {best}");
    assert!(apart(shift) < 0.5 * apart(shift + 0.25));
}

#[test]
fn a_bend_has_its_radius_and_the_lean_that_balances_it() {
    let gaits = gaits();
    for (speed, radius) in [(1.4, 3.0), (3.0, 8.0), (3.0, -8.0)] {
        let mut player = Player::new(&gaits, speed, 1.0 / radius);
        let period = {
            let gait = if speed > 2.0 { gaits.fast().unwrap() } else { &gaits.slow };
            1.0 / gait.frequency_hz(speed)
        };
        // The root at equal phases lies on a circle: circumradius of three points.
        let p: Vec<Vector3<f64>> = (0..3).map(|_| player.next(period).root).collect();
        let (a, b, c) = ((p[1] - p[0]).xz(), (p[2] - p[1]).xz(), (p[2] - p[0]).xz());
        let area = 0.5 * (a.x * c.y - a.y * c.x);
        let found = a.norm() * b.norm() * c.norm() / (4.0 * area.abs());
        assert!((found / radius.abs() - 1.0).abs() < 0.02, "{found} of {radius}");
        // Left is +x for somebody who goes along +z.
        assert_eq!(p[2].x > 0.0, radius > 0.0);
        // Hips against feet over whole cycles, in the carrier and against straight on.
        let tilt = |curvature: f64| {
            let mut player = Player::new(&gaits, speed, curvature);
            let (mut across, mut up) = (0.0, 0.0);
            for _ in 0..200 {
                let pose = player.next(period / 100.0);
                let placed = crate::body::place(&offsets(), &pose);
                let at = |j: Joint| placed.position(j);
                let body = pose.root - 0.5 * (at(Joint::LAnkle) + at(Joint::RAnkle));
                let left = Vector3::new(player.heading().cos(), 0.0, -player.heading().sin());
                across += body.dot(&left);
                up += body.y;
            }
            (across / up).atan()
        };
        let lean = tilt(1.0 / radius) - tilt(0.0);
        let balance = (speed * speed / (GRAVITY_M_S2 * radius)).atan();
        println!("{speed} m/s, radius {radius} m: lean {:.2} of {:.2} degrees", lean.to_degrees(), balance.to_degrees());
        assert!((lean / balance - 1.0).abs() < 0.05, "{lean} {balance}");
    }
}

#[test]
fn changes_are_mixed_in_smoothly_while_it_plays() {
    let model = model(Activity::Walking, WALKS);
    let mut own = gait(&model, 1.2);
    let population = Population::new(&model, model.basis.ncols());
    let typical = Gait::typical(&model, &population, hip_height_m(), &offsets()).unwrap();
    let difference = own.difference(&typical, 1.2);
    let place = own.add_change(difference).unwrap();
    assert_eq!((place, own.add_change(Change { rows: vec![0.0; 3], log_stride: 0.0 })), (0, None));
    // All of the difference taken away leaves the typical person; twice as much added moves as far to the other side.
    let angle = |a: &Gait, amount: f64| {
        let [p, q] = [a.posture(1.2, 0.3, [amount].into_iter()), typical.posture(1.2, 0.3, std::iter::empty())];
        p.joints.iter().zip(&q.joints).map(|(p, q)| p.angle_to(q).powi(2)).sum::<f64>().sqrt()
    };
    assert!(angle(&own, -1.0) < 1e-6 && angle(&own, 0.0) > 0.03);
    assert!((angle(&own, 1.0) / angle(&own, 0.0) - 2.0).abs() < 0.05);
    let gaits = Gaits::one(own);
    let mut player = Player::new(&gaits, 1.2, 0.0);
    let poses: Vec<Pose> = (0..2000)
        .map(|k| {
            player.amounts[0].target = if k < 300 { 0.0 } else { 2.0 };
            player.next(0.001)
        })
        .collect();
    assert!((player.amounts[0].value() - 2.0).abs() < 0.01);
    let clip = Clip { fps: 1000.0, poses, offsets: offsets(), hip_height_m: hip_height_m() };
    let steady = |amount: f64| {
        let mut player = Player::new(&gaits, 1.2, 0.0);
        player.amounts[0] = Eased::at(amount);
        let poses = (0..1000).map(|_| player.next(0.001)).collect();
        roughness(&Clip { fps: 1000.0, poses, offsets: offsets(), hip_height_m: hip_height_m() })
    };
    let (mixed, lively) = (roughness(&clip), steady(2.0));
    assert!(mixed[1] < 1.1 * lively[1] && mixed[3] < 1.1 * lively[3], "rougher than either: {mixed:?} {lively:?}");
    assert!(lively[1] > 1.2 * steady(0.0)[1]);
}

/// Largest drift in m of a point of the sole while it touches (within 2 mm of the lowest), over one contact.
fn largest_drift(clip: &Clip, contacts: &[Vec<std::ops::Range<usize>>; 2]) -> f64 {
    let mut worst: f64 = 0.0;
    for (side, ankle) in [Joint::LAnkle, Joint::RAnkle].into_iter().enumerate() {
        for contact in &contacts[side] {
            for point in 0..3 {
                let mut first: Option<Vector3<f64>> = None;
                for frame in contact.clone() {
                    let sole = clip.sole_points(&clip.place(&clip.poses[frame]), ankle);
                    let lowest = sole.iter().map(|p| p.y).fold(f64::INFINITY, f64::min);
                    if sole[point].y > lowest + 0.002 {
                        first = None;
                        continue;
                    }
                    let from = *first.get_or_insert(sole[point]);
                    worst = worst.max((sole[point] - from).xz().norm());
                }
            }
        }
    }
    worst
}

/// Largest second differences of all joint rotations, rad/s², and of the root's position, m/s².
fn largest_accelerations(clip: &Clip) -> [f64; 2] {
    let rough = roughness(clip);
    [rough[1] * clip.fps, rough[3] * clip.fps]
}

fn stand(contacts: &[Vec<std::ops::Range<usize>>; 2], frame: usize) -> [bool; 2] {
    contacts.each_ref().map(|c| c.iter().any(|r| r.contains(&frame)))
}

#[test]
fn planted_feet_stay_where_they_stand_and_nothing_pops() {
    let gaits = gaits();
    let straight = follow(&gaits, &outing(), &offsets(), 60.0).0;
    let bend = follow(&gaits, &Profile::steady(1.4, 0.25, 6.0).unwrap(), &offsets(), 60.0).0;
    let run = follow(&gaits, &Profile::steady(3.0, -0.25, 6.0).unwrap(), &offsets(), 60.0).0;
    // The pelvis may leave the path by as many millimetres.
    for (name, clip, most_mm) in
        [("start, walk, run, stop", straight, 35.0), ("bend of 4 m", bend, 35.0), ("run in a bend of 4 m", run, 95.0)]
    {
        let planted = plant_feet(&clip);
        let [before, after] = [&clip, &planted.clip].map(|c| largest_drift(c, &planted.contacts));
        let [calm, shaken] = [&clip, &planted.clip].map(largest_accelerations);
        let (mut elsewhere, mut toes, mut standing, mut others) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
        for (frame, (a, b)) in clip.poses.iter().zip(&planted.clip.poses).enumerate() {
            let stands = stand(&planted.contacts, frame);
            for joint in Joint::ALL.into_iter().skip(1) {
                let change = a.joint(joint).angle_to(b.joint(joint)).to_degrees();
                match super::footing::LEGS.iter().position(|leg| leg.contains(&joint)) {
                    Some(side) if stands[side] => standing = standing.max(change),
                    Some(side) if joint == super::footing::LEGS[side][3] => toes = toes.max(change),
                    Some(_) => elsewhere = elsewhere.max(change),
                    None => others = others.max(change),
                }
            }
        }
        let moved = |f: fn(&Pose, &Pose) -> f64| clip.poses.iter().zip(&planted.clip.poses).map(|(a, b)| f(a, b)).fold(0.0, f64::max);
        let shift_mm = 1e3 * moved(|a, b| (a.root - b.root).norm());
        let turn = moved(|a, b| a.world_from_root.angle_to(&b.world_from_root)).to_degrees();
        println!(
            "{name}: drift {:.1} -> {:.2} mm, change {standing:.1} deg standing, {elsewhere:.1} deg elsewhere, toes there {toes:.1} deg, pelvis by {shift_mm:.0} mm \
             and {turn:.1} deg, largest acceleration {:.0} -> {:.0} rad/s2, of the root {:.1} -> {:.1} m/s2, {} contacts",
            1e3 * before,
            1e3 * after,
            calm[0],
            shaken[0],
            calm[1],
            shaken[1],
            planted.contacts.iter().map(Vec::len).sum::<usize>(),
        );
        assert!(after < 0.003 && after < 0.1 * before, "{before} {after}");
        assert!(elsewhere < 3.0 && toes < 6.0 && standing < 10.0 && others < 1e-6, "{elsewhere} {toes} {standing} {others}");
        assert!(shift_mm < most_mm && turn < 5.0, "{shift_mm} {turn}");
        assert!((0..2).all(|k| shaken[k] < 1.1 * calm[k]), "{calm:?} {shaken:?}");
        assert_eq!(planted.sliding(), 0);
    }
}

#[test]
fn who_never_stands_is_left_alone() {
    // Carried through the air at 3 m/s.
    let pose = |k: usize| Pose::rest(Vector3::new(0.0, 3.0, 0.05 * k as f64));
    for frames in [0, 1, 2, 40] {
        let clip = Clip { fps: 60.0, poses: (0..frames).map(pose).collect(), offsets: offsets(), hip_height_m: hip_height_m() };
        let planted = plant_feet(&clip);
        assert!(planted.clip.poses == clip.poses && planted.sliding() == 0 && planted.contacts.iter().all(Vec::is_empty));
    }
}
