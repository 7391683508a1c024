use std::f64::consts::PI;
use std::path::Path;

use super::*;
use crate::body::{BALL_JOINTS, Placement, Pose, place};
use crate::math::rotation::{exp, log};
use crate::motion_model::cycle::SAMPLES;

const ALL: [Activity; 3] = [Activity::Walking, Activity::Running, Activity::Jumping];
const KMH: f64 = 1.0 / 3.6;

/// Placements of a cycle in the world, progress included.
fn placements(subject: &SyntheticSubject, cycle: &Cycle) -> Vec<Placement> {
    let (h, offsets) = (cycle.hip_height_m, subject.shape().offsets());
    let at = |i: usize| {
        let sample = &cycle.root[i];
        let uniform = if cycle.activity.is_cyclic() { cycle.parameter * cycle.duration_s * i as f64 / SAMPLES as f64 } else { 0.0 };
        let p = sample.position * h;
        let root = Vector3::new(p.x, p.y + h, p.z + uniform);
        place(&offsets, &Pose { root, world_from_root: exp(&sample.rotation), joints: cycle.joints[i] })
    };
    (0..SAMPLES).map(at).collect()
}

/// Heel, ball and toe tip of a foot in the world: what a standing template touches the floor with.
fn sole(subject: &SyntheticSubject, placement: &Placement, side: usize) -> [Vector3<f64>; 3] {
    let [ankle, ball] = [[Joint::LAnkle, Joint::LMidtarsal], [Joint::RAnkle, Joint::RMidtarsal]][side];
    let at = |joint: Joint, x: [f64; 3]| {
        placement.position(joint) + placement.world_from_node[joint as usize] * Vector3::from(x) * subject.stature_m
    };
    [at(ankle, [0.0, -0.039, -0.04]), at(ball, [0.0, -0.02, 0.0]), at(ball, [0.0, -0.02, 0.055])]
}

fn lowest(points: &[Vector3<f64>; 3]) -> f64 {
    points.iter().map(|p| p.y).fold(f64::INFINITY, f64::min)
}

/// Lowest point of both feet at every sample.
fn foot_heights(subject: &SyntheticSubject, cycle: &Cycle) -> Vec<[f64; 2]> {
    placements(subject, cycle).iter().map(|p| [0, 1].map(|side| lowest(&sole(subject, p, side)))).collect()
}

fn phase_from_strike(i: usize, side: usize) -> f64 {
    ((i + if side == 0 { SAMPLES / 2 } else { 0 }) % SAMPLES) as f64 / SAMPLES as f64
}

/// Rotation component about x of a joint over the cycle, degrees, positive as given.
fn angle_deg(cycle: &Cycle, joint: Joint, sign: f64) -> Vec<f64> {
    cycle.joints.iter().map(|joints| sign * log(&joints[joint as usize - 1]).x.to_degrees()).collect()
}

fn bits(cycles: &[Cycle]) -> Vec<u64> {
    let of_cycle = |c: &Cycle| {
        let joints = c.joints.iter().flatten().flat_map(|q| [q.w, q.i, q.j, q.k]);
        let root = c.root.iter().flat_map(|r| r.rotation.iter().chain(r.position.iter()).copied().collect::<Vec<_>>());
        let all: Vec<f64> = joints.chain(root).chain([c.parameter, c.duration_s, c.hip_height_m]).collect();
        assert!(all.iter().all(|x| x.is_finite()));
        all.into_iter().map(f64::to_bits).collect::<Vec<_>>()
    };
    cycles.iter().flat_map(of_cycle).collect()
}

#[test]
fn databases_have_the_papers_shape_and_the_same_bytes_with_any_number_of_threads() {
    for (activity, count) in ALL.into_iter().zip([324, 140, 48]) {
        let cycles = database(activity);
        assert_eq!(cycles.len(), count);
        for (i, cycle) in cycles.iter().enumerate() {
            let per_subject = parameters(activity).len() * REPEATS as usize;
            assert_eq!(cycle.subject, format!("synthetic_{}", i / per_subject + 1));
            assert_eq!(cycle.parameter, parameters(activity)[i % per_subject / REPEATS as usize]);
            assert_eq!((cycle.joints.len(), cycle.root.len()), (SAMPLES, SAMPLES));
            assert!(cycle.source.contains("synthetic"));
        }
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert!(bits(&cycles) == bits(&one.install(|| database(activity))));
    }
}

#[test]
fn a_person_keeps_body_and_style_and_another_seed_is_another_person() {
    let [a, b] = [Activity::Walking, Activity::Running].map(|activity| subject(activity, 3));
    assert_eq!((a.stature_m, a.hip_height_m), (b.stature_m, b.hip_height_m));
    assert!((a.shape().hip_height_m() - a.hip_height_m).abs() < 1e-12);
    let new = subject(Activity::Walking, 100);
    assert!(database(Activity::Walking).iter().all(|c| c.subject != new.name && c.hip_height_m != new.hip_height_m));
    for activity in ALL {
        for seed in 1..=subjects(activity) {
            let stature_m = subject(activity, seed).stature_m;
            assert!((1.55..=1.90).contains(&stature_m), "{stature_m}");
        }
    }
}

#[test]
fn rotations_are_continuous_and_cycles_close() {
    for (activity, most_deg) in ALL.into_iter().zip([13.0, 18.0, 32.0]) {
        for cycle in database(activity) {
            let last = if activity.is_cyclic() { SAMPLES } else { SAMPLES - 1 };
            for i in 0..last {
                let (now, next) = (&cycle.joints[i], &cycle.joints[(i + 1) % SAMPLES]);
                for k in 0..BALL_JOINTS {
                    let step_deg = now[k].angle_to(&next[k]).to_degrees();
                    assert!(step_deg < most_deg, "{activity:?} {} {} joint {k} sample {i}: {step_deg}", cycle.subject, cycle.parameter);
                }
                let step = cycle.root[(i + 1) % SAMPLES].position - cycle.root[i].position;
                assert!(step.norm() < 0.12, "{activity:?} {} root {i}: {step:?}", cycle.subject);
            }
        }
    }
}

#[test]
fn walking_feet_stand_on_the_floor_and_do_not_slide() {
    for seed in 1..=9 {
        let subject = subject(Activity::Walking, seed);
        for (kmh, repeat) in (0..9).flat_map(|k| [(3.0 + 0.5 * f64::from(k), 0), (3.0 + 0.5 * f64::from(k), 3)]) {
            let cycle = subject.cycle(kmh * KMH, repeat);
            let placements = placements(&subject, &cycle);
            let mut slides = Vec::new();
            for (i, heights) in foot_heights(&subject, &cycle).iter().enumerate() {
                for (side, &height) in heights.iter().enumerate() {
                    let t = phase_from_strike(i, side);
                    assert!(height > -0.03, "{seed} at {kmh} side {side} phase {t}: {height}");
                    if (0.02..0.48).contains(&t) {
                        assert!(height.abs() < 0.045, "{seed} at {kmh} side {side} phase {t}: {height}");
                    }
                    if (0.12..0.45).contains(&t) && i + 1 < SAMPLES {
                        let toe = |i: usize| sole(&subject, &placements[i], side)[2];
                        let slide = (toe(i + 1) - toe(i)) * SAMPLES as f64 / cycle.duration_s;
                        slides.push(slide.xz().norm() / cycle.parameter);
                    }
                }
            }
            let (mean, most) = (slides.iter().sum::<f64>() / slides.len() as f64, range(&slides).1);
            assert!(mean < 0.10 && most < 0.50, "{seed} at {kmh}: slides at {mean} of the speed, at most {most}");
        }
    }
}

#[test]
fn the_bob_follows_the_published_amplitude() {
    // Boulic: amplitude 0.015 RV in units of H, lowest in double support, highest in single support.
    let average = subject(Activity::Walking, 0);
    for kmh in [3.5, 5.0, 6.5] {
        let cycle = average.mean_cycle(kmh * KMH);
        let heights: Vec<f64> = cycle.root.iter().map(|r| r.position.y).collect();
        let (min, max) = (heights.iter().copied().fold(f64::INFINITY, f64::min), heights.iter().copied().fold(-1.0, f64::max));
        let published = 2.0 * 0.015 * cycle.parameter / cycle.hip_height_m;
        assert!((0.55..1.8).contains(&((max - min) / published)), "at {kmh}: {} against {published}", max - min);
        assert!(heights[2] < heights[28] && heights[52] < heights[78]);
    }
}

#[test]
fn arms_swing_against_the_legs_and_the_pelvis_drops_on_the_swing_side() {
    for activity in [Activity::Walking, Activity::Running] {
        let average = subject(activity, 0);
        let cycle = average.mean_cycle(if activity == Activity::Walking { 5.0 } else { 9.0 } * KMH);
        let placements = placements(&average, &cycle);
        let ahead = |i: usize, joint: Joint| placements[i].position(joint).z - placements[i].position(Joint::Root).z;
        // Right heel strike: right foot and left hand in front.
        assert!(ahead(0, Joint::RAnkle) > 0.15 && ahead(0, Joint::LAnkle) < -0.15);
        assert!(ahead(0, Joint::LWrist) > ahead(0, Joint::RWrist) + 0.1);
        // Right single support: the left hip hangs lower; left single support: the right one.
        for (i, sign) in [(15, 1.0), (65, -1.0)] {
            let drop = placements[i].position(Joint::RHip).y - placements[i].position(Joint::LHip).y;
            assert!((0.005..0.05).contains(&(sign * drop)), "{activity:?} {i} {drop}");
        }
    }
}

#[test]
fn running_has_flight_under_gravity_and_stance_on_the_floor() {
    for seed in 1..=5 {
        let subject = subject(Activity::Running, seed);
        for kmh in [6.0, 9.0, 12.0] {
            let cycle = subject.cycle(kmh * KMH, 1);
            let support = running::support(cycle.parameter / cycle.hip_height_m);
            let heights = foot_heights(&subject, &cycle);
            let stands = |i: usize, side: usize| phase_from_strike(i, side) <= support;
            let step_s = cycle.duration_s / SAMPLES as f64;
            let y = |i: usize| cycle.root[i % SAMPLES].position.y * cycle.hip_height_m;
            let mut aloft = 0;
            for (i, low) in heights.iter().enumerate() {
                assert!(low[0].min(low[1]) > -0.04, "{seed} at {kmh} {i}: {low:?}");
                // Slow runners hardly rise.
                let clear = if kmh < 8.0 { 0.004 } else { 0.01 };
                aloft += usize::from(low[0] > clear && low[1] > clear);
                for (side, low) in low.iter().enumerate() {
                    let t = phase_from_strike(i, side);
                    if (0.03..support - 0.03).contains(&t) {
                        assert!(low.abs() < 0.04, "{seed} at {kmh} side {side} phase {t}: {low}");
                    }
                }
                if (i..i + 3).all(|k| !stands(k % SAMPLES, 0) && !stands(k % SAMPLES, 1)) {
                    let acceleration = (y(i) - 2.0 * y(i + 1) + y(i + 2)) / (step_s * step_s);
                    assert!((acceleration + 9.81).abs() < 0.01, "{seed} at {kmh} {i}: {acceleration}");
                }
            }
            // Two flights per cycle, each 0.5 − support of it.
            let share = aloft as f64 / SAMPLES as f64;
            let flight = 2.0 * (0.5 - support);
            assert!(share > 0.3 * flight && share < flight + 0.15, "{seed} at {kmh}: {share} aloft, flight {flight}");
        }
    }
}

#[test]
fn walking_never_leaves_the_floor() {
    for kmh in [3.0, 5.0, 7.0] {
        let subject = subject(Activity::Walking, 4);
        let aloft = foot_heights(&subject, &subject.cycle(kmh * KMH, 0)).iter().filter(|low| low[0].min(low[1]) > 0.015).count();
        assert_eq!(aloft, 0, "at {kmh}");
    }
}

#[test]
fn jumps_fly_under_gravity_and_cover_their_length() {
    for seed in 1..=4 {
        let subject = subject(Activity::Jumping, seed);
        for length in parameters(Activity::Jumping) {
            let cycle = subject.mean_cycle(length);
            let h = cycle.hip_height_m;
            let [off, land, end] = jumping::events(&subject, length);
            assert!((cycle.duration_s - end).abs() < 1e-12);
            let step_s = cycle.duration_s / SAMPLES as f64;
            let heights = foot_heights(&subject, &cycle);
            let mut flown = 0;
            for (i, low) in heights.iter().enumerate().take(SAMPLES - 2) {
                let s = i as f64 * step_s;
                let p = [0, 1, 2].map(|k| cycle.root[i + k].position * h);
                if s >= off && s + 2.0 * step_s <= land {
                    let a = (p[0] - 2.0 * p[1] + p[2]) / (step_s * step_s);
                    assert!((a - Vector3::new(0.0, -9.81, 0.0)).norm() < 1e-6, "{seed} {length} {i}: {a:?}");
                    flown += 1;
                }
                let mid_flight = s > off + 0.3 * (land - off) && s < off + 0.7 * (land - off);
                for &low in low {
                    assert!(low > -0.02, "{seed} {length} {i}: {low}");
                    assert!(if mid_flight { low > 0.03 } else { s > off && s < land || low < 0.03 }, "{seed} {length} {i}: {low}");
                }
            }
            assert!(flown > 8);
            let (first, last) = (cycle.root[0].position, cycle.root[SAMPLES - 1].position);
            assert!(first.z.abs() < 1e-9 && (last.z - length / h).abs() < 1e-9);
            let placements = placements(&subject, &cycle);
            for ankle in [Joint::LAnkle, Joint::RAnkle] {
                let moved = placements[SAMPLES - 1].position(ankle).z - placements[0].position(ankle).z;
                assert!((moved - length).abs() < 0.01, "{seed} {length}: foot moved {moved}");
            }
        }
    }
}

fn range(values: &[f64]) -> (f64, f64) {
    (values.iter().copied().fold(f64::INFINITY, f64::min), values.iter().copied().fold(f64::NEG_INFINITY, f64::max))
}

#[test]
fn knees_swing_as_far_as_in_people_and_never_backwards() {
    for (activity, peaks) in [(Activity::Walking, 55.0..75.0), (Activity::Running, 78.0..104.0)] {
        for parameter in parameters(activity) {
            let peak = |seed| range(&angle_deg(&subject(activity, seed).mean_cycle(parameter), Joint::RKnee, 1.0)).1;
            let mean = (1..=subjects(activity)).map(peak).sum::<f64>() / subjects(activity) as f64;
            assert!(peaks.contains(&mean), "{activity:?} at {parameter}: {mean}");
        }
    }
    for cycle in ALL.into_iter().flat_map(database) {
        for joint in [Joint::LKnee, Joint::RKnee] {
            let straightest = range(&angle_deg(&cycle, joint, 1.0)).0;
            assert!(straightest > -3.0, "{} {:?} {}: {straightest}", cycle.subject, cycle.activity, cycle.parameter);
        }
    }
}

#[test]
fn faster_means_longer_strides_and_farther_jumps_deeper_knees() {
    for activity in ALL {
        for seed in 1..=subjects(activity) {
            let subject = subject(activity, seed);
            let cycles: Vec<Cycle> = parameters(activity).into_iter().map(|p| subject.mean_cycle(p)).collect();
            for pair in cycles.windows(2) {
                let hip = |c: &Cycle| {
                    let (min, max) = range(&angle_deg(c, Joint::RHip, -1.0));
                    max - min
                };
                let knee = |c: &Cycle| range(&angle_deg(c, Joint::RKnee, 1.0)).1;
                assert!(hip(&pair[1]) > hip(&pair[0]) - 1.0, "{activity:?} {seed} hip at {}", pair[1].parameter);
                if activity.is_cyclic() {
                    assert!(pair[1].parameter * pair[1].duration_s > pair[0].parameter * pair[0].duration_s);
                    assert!(pair[1].duration_s < pair[0].duration_s);
                } else {
                    assert!(knee(&pair[1]) > knee(&pair[0]), "{seed} knee at {}", pair[1].parameter);
                }
            }
            let ends = [cycles.first(), cycles.last()].map(|c| range(&angle_deg(c.unwrap(), Joint::RKnee, 1.0)).1);
            assert!(ends[1] > ends[0], "{activity:?} {seed}: knee {ends:?}");
        }
    }
}

/// Root mean square angle between the joints of two cycles: the distance in raw motion space, in degrees.
fn distance_deg(a: &Cycle, b: &Cycle) -> f64 {
    let pairs = a.joints.iter().flatten().zip(b.joints.iter().flatten());
    let sum: f64 = pairs.map(|(p, q)| p.angle_to(q).powi(2)).sum();
    (sum / (SAMPLES * BALL_JOINTS) as f64).sqrt().to_degrees()
}

#[test]
fn cycles_of_one_person_are_closer_than_people() {
    for activity in ALL {
        let cycles = database(activity);
        let (mut intra, mut inter) = ((0.0, 0), (0.0, 0));
        for (i, a) in cycles.iter().enumerate() {
            for b in cycles[i + 1..].iter().filter(|b| b.parameter == a.parameter) {
                let sums = if a.subject == b.subject { &mut intra } else { &mut inter };
                *sums = (sums.0 + distance_deg(a, b), sums.1 + 1);
            }
        }
        let (intra, inter) = (intra.0 / f64::from(intra.1), inter.0 / f64::from(inter.1));
        println!("{activity:?}: intra {intra:.2}, inter {inter:.2} degrees");
        assert!(intra > 0.3 && 1.8 * intra < inter && inter < 15.0, "{activity:?}: {intra} {inter}");
    }
}

#[test]
fn the_walking_law_gives_the_published_figures() {
    // The published frequency at H = 0.884 m and 3, 5 and 7 km/h.
    for (kmh, hz, stride_m) in [(3.0, 0.72, 1.16), (5.0, 0.93, 1.49), (7.0, 1.10, 1.76)] {
        let f = walking::frequency_hz(kmh * KMH / 0.884);
        assert!((f - hz).abs() < 0.006 && (kmh * KMH / f - stride_m).abs() < 0.01, "{kmh}: {f}");
    }
    assert!((walking::support(0.931) - 0.62).abs() < 0.005);
    let average = subject(Activity::Walking, 0).mean_cycle(5.0 * KMH);
    assert!((average.duration_s * walking::frequency_hz(average.parameter / average.hip_height_m) - 1.0).abs() < 0.2);
}

/// Row of the reference table: channel, speed, coefficients a0 a1 b1 a2 b2 …, spread between people in degrees.
type Row = (String, f64, Vec<f64>, f64);

fn reference(dataset: &str) -> Option<Vec<Row>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/reference/gait_fourier.csv");
    let Ok(text) = std::fs::read_to_string(&path) else {
        println!("skipped: no {}", path.display());
        return None;
    };
    let parse = |line: &str| {
        let fields: Vec<&str> = line.split(',').collect();
        let number = |k: usize| fields[k].parse::<f64>().unwrap_or(0.0);
        (fields[1].to_string(), number(3), (4..21).map(number).collect(), number(22))
    };
    Some(text.lines().filter(|line| line.starts_with(dataset)).map(parse).collect())
}

fn series(coefficients: &[f64], t: f64) -> f64 {
    let harmonic = |(k, ab): (usize, &[f64])| {
        let (sin, cos) = (2.0 * PI * (k + 1) as f64 * t).sin_cos();
        ab[0] * cos + ab[1] * sin
    };
    coefficients[0] + coefficients[1..].chunks(2).enumerate().map(harmonic).sum::<f64>()
}

/// Mean over the subjects of the right thigh's angle against the vertical, the knee's and the ankle's, degrees.
fn mean_leg_angles(activity: Activity, parameter_of: impl Fn(f64) -> f64) -> [Vec<f64>; 3] {
    let count = subjects(activity);
    let mut sums = [(); 3].map(|_| vec![0.0; SAMPLES]);
    for seed in 1..=count {
        let subject = subject(activity, seed);
        let cycle = subject.mean_cycle(parameter_of(subject.hip_height_m));
        let placements = placements(&subject, &cycle);
        let thigh = placements.iter().map(|p| {
            let down = p.position(Joint::RKnee) - p.position(Joint::RHip);
            down.z.atan2(-down.y).to_degrees()
        });
        let angles = [thigh.collect(), angle_deg(&cycle, Joint::RKnee, 1.0), angle_deg(&cycle, Joint::RAnkle, -1.0)];
        for (sum, angle) in sums.iter_mut().zip(&angles) {
            for (s, a) in sum.iter_mut().zip(angle) {
                *s += a / count as f64;
            }
        }
    }
    sums
}

/// Root mean square of the difference of two curves, and the largest.
fn deviation(ours: &[f64], theirs: impl Fn(f64) -> f64) -> (f64, f64) {
    let differences: Vec<f64> = ours.iter().enumerate().map(|(i, y)| y - theirs(i as f64 / SAMPLES as f64)).collect();
    let rms = (differences.iter().map(|d| d * d).sum::<f64>() / SAMPLES as f64).sqrt();
    (rms, differences.iter().fold(0.0, |m, d| d.abs().max(m)))
}

#[test]
fn mean_walkers_lie_within_the_spread_of_people() {
    let Some(rows) = reference("Schwartz2008") else { return };
    let row = |channel: &str, beta: f64| rows.iter().find(|r| r.0 == channel && r.1 == beta).unwrap();
    for beta in [0.290, 0.429, 0.560] {
        let ours = mean_leg_angles(Activity::Walking, |h| beta * (9.81 * h).sqrt());
        // Their hip angle is measured against the pelvis' own plane, tilted forward by this much in standing.
        let tilt = row("pelvis_ant_tilt", beta).2[0];
        for (ours, (channel, offset, most)) in
            ours.iter().zip([("hip_flexion", tilt, 0.7), ("knee_flexion", 0.0, 1.2), ("ankle_dorsiflexion", 0.0, 1.35)])
        {
            let (_, _, coefficients, spread) = row(channel, beta);
            let (rms, largest) = deviation(ours, |t| series(coefficients, t) - offset);
            println!("{channel} at {beta}: rms {rms:.1}, largest {largest:.1}, spread of people {spread:.1} degrees");
            assert!(rms < most * spread, "{channel} at {beta}: {rms} against {spread}");
        }
    }
}

#[test]
fn mean_runners_follow_the_measured_ones() {
    let Some(rows) = reference("BMC_running") else { return };
    let ours = mean_leg_angles(Activity::Running, |h| running::REFERENCE_RV * h);
    // Their hip angle is against the pelvis, which leans forward by 6 degrees here.
    for (ours, (channel, offset)) in ours.iter().zip([("hip_flexion", 6.0), ("knee_flexion", 0.0), ("ankle_dorsiflexion", 0.0)]) {
        let (_, _, coefficients, spread) = rows.iter().find(|r| r.0 == channel).unwrap();
        let (rms, largest) = deviation(ours, |t| series(coefficients, t) - offset);
        println!("{channel}: rms {rms:.1}, largest {largest:.1}, spread of people {spread:.1} degrees");
        assert!(rms < 1.3 * spread, "{channel}: {rms} against {spread}");
    }
}
