//! The vector space of motions on recorded walks, and the command `blend` as a user runs it. Recordings lie beside the project;
//! without them their tests say so and pass.

use std::path::{Path, PathBuf};

use crate::common::{mocap, run};
use muybridge::body::{Joint, Pose, Shape, place};
use muybridge::io::read_clip;
use muybridge::math::rotation::exp;
use muybridge::motion_model::{Activity, Cycle, Label, SAMPLES, segment};
use muybridge::style::space::attributes::{direction, spread};
use muybridge::style::space::measure::measure;
use muybridge::style::space::{Blend, Example, Live, Method, Options, Posture, Space, Vectors, manipulate};
use nalgebra::Vector3;

fn cycles(path: &Path, part_s: Option<(f64, f64)>) -> Vec<Cycle> {
    let clip = read_clip(path).unwrap().clip;
    let source = path.file_stem().unwrap().to_string_lossy().into_owned();
    let (start_s, end_s) = part_s.unzip();
    let label = Label { subject: "s".into(), source, activity: Activity::Walking, parameter: None, start_s, end_s };
    segment(&clip, &label).map(|s| s.cycles).unwrap_or_default()
}

/// Ankles (left, right) ahead of the root in metres, for a body of 1.75 m.
fn ankles((joints, root): &Posture) -> [f64; 2] {
    let shape = Shape::template(1.75);
    let pose = Pose { root: Vector3::zeros(), world_from_root: exp(&root.rotation), joints: *joints };
    let placed = place(&shape.offsets(), &pose);
    [Joint::LAnkle, Joint::RAnkle].map(|j| placed.position(j).z)
}

/// Times, as parts of the cycle, when the left and the right ankle are farthest ahead: strikes, read from positions and not from
/// any warp.
fn strikes(posture: &dyn Fn(f64) -> Posture) -> [f64; 2] {
    const FINE: usize = 1000;
    let at: Vec<[f64; 2]> = (0..FINE).map(|k| ankles(&posture(k as f64 / FINE as f64))).collect();
    let farthest = |side: usize| (0..FINE).max_by(|&a, &b| at[a][side].total_cmp(&at[b][side])).unwrap();
    [0, 1].map(|side| farthest(side) as f64 / FINE as f64)
}

/// The smallest difference of two parts of a cycle.
fn apart(a: f64, b: f64) -> f64 {
    ((a - b + 0.5).rem_euclid(1.0) - 0.5).abs()
}

/// The cycle with its clock bent: at part t of the new duration it does what it did at t + bend(t).
fn bent(cycle: &Cycle, name: &str) -> Example {
    let mut example = Example::of_cycle(name, cycle);
    let bend = |t: f64| t + 0.025 * (1.0 - (std::f64::consts::TAU * t).cos());
    let forward = |t: f64| {
        let (joints, mut root) = cycle.posture(bend(t));
        root.position.z += example.stride * (bend(t) - t);
        (joints, root)
    };
    example.postures = (0..SAMPLES).map(|k| forward(k as f64 / SAMPLES as f64)).collect();
    example
}

#[test]
fn walks_at_different_speeds_meet_at_their_heel_strikes() {
    let Some(folder) = mocap("cmu-asfamc") else { return };
    let find = |trial: &str| {
        muybridge::io::manifest::find_motions(std::slice::from_ref(&folder), None)
            .unwrap()
            .into_iter()
            .find(|e| e.path.file_stem().is_some_and(|s| s == trial))
            .unwrap()
            .path
    };
    let mut without = 0.0f64;
    for (slow, fast) in [("07_03", "07_11"), ("08_04", "08_06"), ("07_03", "08_08")] {
        let [slow, fast] = [slow, fast].map(|t| cycles(&find(t), None).remove(0));
        assert!(fast.parameter > 1.4 * slow.parameter, "{} {}", slow.parameter, fast.parameter);
        for other in [Example::of_cycle("fast", &fast), bent(&fast, "fast")] {
            let is_bent = other.postures[30] != Example::of_cycle("", &fast).postures[30];
            let options = Options { reference: Some("slow".into()), ..Options::default() };
            let space = Space::build(&[Example::of_cycle("slow", &slow), other], &options).unwrap();
            let [a, b] = [0, 1].map(|m| space.play(&space.members[m].vectors));
            let [own, others] = [&a, &b].map(|blend| strikes(&|t| blend.posture(t)));
            for strike in 0..2 {
                // The reference's strike, carried into the other's time.
                let carried = b.time_phase(a.shape_phase(own[strike]));
                let (error, uncarried) = (apart(carried, others[strike]), apart(own[strike], others[strike]));
                println!(
                    "{:.2} to {:.2} m/s{}: strike off by {:.1} %, without a warp {:.1} %",
                    slow.parameter,
                    fast.parameter,
                    if is_bent { ", bent" } else { "" },
                    100.0 * error,
                    100.0 * uncarried
                );
                assert!(error < 0.02, "{error}");
                without = without.max(uncarried);
            }
        }
    }
    assert!(without > 0.03, "the bent clocks need a warp: {without}");
}

/// Cycles of walks, named like their files.
fn examples(files: Vec<(PathBuf, Option<(f64, f64)>)>) -> Vec<Example> {
    let of = |(path, part): (PathBuf, Option<(f64, f64)>)| {
        let stem = path.file_stem().unwrap().to_string_lossy().into_owned();
        let found = cycles(&path, part);
        found.iter().enumerate().map(|(i, c)| Example::of_cycle(&format!("{stem}#{}", i + 1), c)).collect::<Vec<_>>()
    };
    files.into_iter().flat_map(of).collect()
}

/// The stylised walks of both sets; of long takes the part that walks.
fn stylised() -> Vec<(&'static str, Vec<Example>)> {
    let mut sets = Vec::new();
    if let Some(m21) = mocap("stylised-cmu-m21") {
        let files = [
            ("content/walk.bvh", None),
            ("content/female-walk.bvh", None),
            ("style/ZOMBIE.bvh", Some((0.0, 2.6))),
            ("style/DEPRESSED.bvh", Some((5.2, 8.5))),
        ];
        sets.push(("ZOMBIE", examples(files.map(|(file, part)| (m21.join(file), part)).to_vec())));
    }
    if let Some(bandai) = mocap("bandai-namco-1/data") {
        let mut files: Vec<_> = std::fs::read_dir(bandai).unwrap().map(|e| (e.unwrap().path(), None)).collect();
        files.retain(|f| f.0.to_string_lossy().contains("_walk_"));
        files.sort_by(|a: &(PathBuf, _), b| a.0.cmp(&b.0));
        sets.push(("dataset-1_walk_happy_001", examples(files)));
    }
    sets
}

#[test]
fn attributes_of_stylised_walks_move_alone_and_caricatures_move_away() {
    for (own, examples) in stylised() {
        let space = Space::build(&examples, &Options { activity: Some(Activity::Walking), ..Options::default() }).unwrap();
        println!("{} walks", space.members.len());
        assert!(space.members.len() >= 4);
        space.members.iter().zip(&examples).for_each(|(member, example)| round_trip(&space.play(&member.vectors), example));
        (0..2).for_each(|attribute| moves_alone(&space, attribute));
        let own = &space.members[space.members_called(own).unwrap()[0]].vectors;
        print_cost(&space, own);
        let mean = space.play(&space.mean());
        let distances = [0.0, 0.5, 1.0, 1.5, 2.0]
            .map(|degree| posture_distance_deg(&space.play(&manipulate::caricature(&space.mean(), own, degree, degree)), &mean));
        println!("caricatures of degree 0, 0.5, ..., 2: {distances:.1?} degrees from the mean");
        assert!(distances.windows(2).all(|w| w[1] > w[0] + 1.0), "{distances:?}");
    }
}

/// What a knob and a posture cost live; neither looks at the examples.
fn print_cost(space: &Space, own: &Vectors) {
    let mut live = Live::new(space, own, &[0, 1]).unwrap();
    let start = std::time::Instant::now();
    (0..200).for_each(|k| live.set(&[1e-4 * f64::from(k), 0.0], 1.2));
    let set_us = start.elapsed().as_secs_f64() / 200.0 * 1e6;
    let start = std::time::Instant::now();
    let knees: Vec<f64> = (0..20_000).map(|_| live.next(0.01).0[Joint::LKnee as usize - 1].angle()).collect();
    let next_us = start.elapsed().as_secs_f64() / 20_000.0 * 1e6;
    let range = knees.iter().fold((f64::MAX, f64::MIN), |(low, high), k| (low.min(*k), high.max(*k)));
    assert!(range.1 - range.0 > 0.4, "{range:?}");
    println!("live, {} examples: {set_us:.0} us to turn a knob, {next_us:.2} us a posture", space.members.len());
}

/// Five steps of one measured attribute, the other within a standard deviation of the examples'.
fn moves_alone(space: &Space, attribute: usize) {
    let vector = direction(space, attribute, Method::Joint, &[0, 1]).unwrap();
    let deviation = spread(&space.attributes[attribute]).1;
    let (other_mean, other_deviation, _) = spread(&space.attributes[1 - attribute]);
    let steps = [-1.0, -0.5, 0.0, 0.5, 1.0].map(|by| {
        let amount = by * deviation;
        measure(&space.play(&space.mean().plus(&vector, amount, amount)))
    });
    let values = |k: usize| steps.map(|s| s[k]);
    println!("{}: {:.3?}, the other {:.3?}", space.attributes[attribute].name, values(attribute), values(1 - attribute));
    println!("  standard deviation {deviation:.3}; the other {other_mean:.3} and {other_deviation:.3}");
    assert!(steps.windows(2).all(|w| w[1][attribute] > w[0][attribute] + 0.02 * deviation));
    assert!(steps[4][attribute] - steps[0][attribute] > 0.5 * deviation);
    assert!(steps.iter().all(|s| (s[1 - attribute] - other_mean).abs() < other_deviation));
}

/// R.m.s. angle between the joints of two motions at equal parts of their durations, read from what is played.
fn posture_distance_deg(a: &Blend, b: &Blend) -> f64 {
    let squares: Vec<f64> = (0..50)
        .flat_map(|k| {
            let [a, b] = [a, b].map(|m| m.posture(k as f64 / 50.0).0);
            std::array::from_fn::<f64, 26, _>(|j| a[j].angle_to(&b[j]).to_degrees().powi(2))
        })
        .collect();
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

/// Nearly every joint at nearly every instant comes back; one that jumps from one sample to the next, as recorded toes do at
/// times, cannot be sampled at other instants.
fn round_trip(blend: &Blend, example: &Example) {
    let count = example.postures.len();
    let mut off_deg = Vec::new();
    for (k, (joints, root)) in example.postures.iter().enumerate() {
        let (found, found_root) = blend.posture(k as f64 / count as f64);
        off_deg.extend(found.iter().zip(joints).map(|(a, b)| a.angle_to(b).to_degrees()));
        assert!((found_root.position - root.position).norm() < 3e-3, "{}", example.name);
    }
    off_deg.sort_by(f64::total_cmp);
    let at = |share: f64| off_deg[(share * (off_deg.len() - 1) as f64) as usize];
    assert!(at(0.5) < 0.1 && at(0.98) < 1.0, "{}: {} {}", example.name, at(0.5), at(0.98));
}

/// A folder with the synthetic walkers 1 to 4 as BVH files and their labels.
fn walkers() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let shape = Shape::template(1.75);
    for seed in 1..5u64 {
        let cycle = muybridge::motion_model::synthetic::subject(Activity::Walking, seed).cycle(0.8 + 0.2 * seed as f64, 0);
        let clip = muybridge::motion::play_cycle(&cycle, &shape.offsets(), 100.0, muybridge::motion::Length::Cycles(4));
        muybridge::io::bvh::write_clip(&dir.path().join(format!("w{seed}.bvh")), &clip, None).unwrap();
    }
    std::fs::write(dir.path().join("labels.csv"), "file,pace\nw1,1\nw2.bvh,2\nw3,3\nw4#1,4\n").unwrap();
    dir
}

#[test]
fn the_command_builds_mixes_and_changes() {
    let dir = walkers();
    let at = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (space, labels) = (at("space.npz"), at("labels.csv"));
    let files: Vec<String> = (1..5).map(|k| at(&format!("w{k}.bvh"))).collect();
    let build: Vec<&str> = ["blend", "build"].into_iter().chain(files.iter().map(String::as_str)).collect();
    let (done, said, error) = run(&[&build[..], &["--labels", &labels, "-o", &space][..]].concat());
    assert!(done && said.contains("attribute pace") && said.contains("w4: "), "{said}{error}");
    let bytes = std::fs::read(&space).unwrap();
    run(&[&["--threads", "1"][..], &build[..], &["--labels", &labels, "-o", &space][..]].concat());
    assert!(std::fs::read(&space).unwrap() == bytes, "the same bytes with one thread");

    let cell = |out: &str, row: usize, column: usize| {
        let text = std::fs::read_to_string(Path::new(out).join("motions.csv")).unwrap();
        let line: Vec<String> = text.lines().nth(row + 1).unwrap().split(',').map(String::from).collect();
        line[column].parse::<f64>().unwrap()
    };
    let mixed = at("mixed");
    let (done, _, error) = run(&["blend", "mix", &space, "--shape", "w1=1,w4=1", "--timing", "w2=1", "-o", &mixed]);
    assert!(done, "{error}");
    // Rows: the mix, then w1, w4, w2; the mix lasts as long as w2.
    assert!((cell(&mixed, 0, 1) - cell(&mixed, 3, 1)).abs() < 2e-4 && (cell(&mixed, 0, 1) - cell(&mixed, 1, 1)).abs() > 0.05);
    let out = at("pace");
    let (done, _, error) = run(&["blend", "attribute", &space, "pace", "--method", "slope", "--by=-1,0,1", "-o", &out]);
    assert!(done, "{error}");
    let speeds: Vec<f64> = (0..3).map(|row| cell(&out, row, 2)).collect();
    assert!(speeds[1] > speeds[0] + 0.1 && speeds[2] > speeds[1] + 0.1, "{speeds:?}");
    let (done, _, error) = run(&["blend", "attribute", &space, "--at", "pace=3.5", "-o", &at("at")]);
    assert!(done && cell(&at("at"), 0, 2) > speeds[1], "{error}");
    // A caricature of a written motion: read, cut and warped again.
    let own = at("w4.bvh");
    let (done, _, error) = run(&["blend", "caricature", &space, "--of", &own, "--degree", "0.5,1.5,2", "-o", &at("car")]);
    let degrees: Vec<f64> = (0..5).map(|row| cell(&at("car"), row, 3)).collect();
    assert!(done, "{error}");
    // The strongest first, then the original and the mean.
    for (row, degree) in [(0, 2.0), (1, 1.5), (2, 0.5), (4, 0.0)] {
        assert!((degrees[row] / degrees[3] - degree).abs() < 0.01, "{degrees:?}");
    }
    let (done, ..) = run(&["blend", "vary", &space, "--count", "3", "--cycles", "2", "-o", &at("crowd")]);
    assert!(done && ["person_1.bvh", "person_3.json", "strip.png"].iter().all(|f| dir.path().join("crowd").join(f).is_file()));
    let (done, said, _) = run(&["blend", "info", &space, "-o", &at("info")]);
    assert!(done && said.contains("warped to w") && dir.path().join("info/eigenmotions.png").is_file());
    assert_eq!(std::fs::read_to_string(dir.path().join("info/members.csv")).unwrap().lines().count(), 1 + space_members(&said));
}

/// Mean height of the right wrist (hip heights) and mean speed of all joints against the root (m/s) in a written motion.
fn read_off(file: &Path) -> [f64; 2] {
    let clip = read_clip(file).unwrap().clip;
    let placed: Vec<_> = clip.poses.iter().map(|p| clip.place(p).positions).collect();
    let hand = placed.iter().map(|p| p[Joint::RWrist as usize].y).sum::<f64>() / (placed.len() as f64 * clip.hip_height_m);
    let speeds = placed.windows(2).flat_map(|w| (1..w[0].len()).map(|k| ((w[1][k] - w[1][0]) - (w[0][k] - w[0][0])).norm() * clip.fps));
    [hand, speeds.sum::<f64>() / ((placed.len() - 1) * (placed[0].len() - 1)) as f64]
}

#[test]
fn two_attributes_of_the_stylised_set_move_one_at_a_time() {
    let Some(m21) = mocap("stylised-cmu-m21") else { return };
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (space, parts) = (at("space.npz"), at("parts.csv"));
    // The parts of the set in which somebody walks a whole cycle.
    let rows = [("content/walk", ","), ("content/female-walk", ","), ("style/ZOMBIE", "0,2.6"), ("style/DEPRESSED", "5.2,8.5")];
    let row = |(file, part): &(&str, &str)| format!("{},walking,{part}\n", m21.join(file).with_extension("bvh").display());
    std::fs::write(&parts, format!("file,activity,start_s,end_s\n{}", rows.iter().map(row).collect::<String>())).unwrap();
    let (done, _, error) = run(&["blend", "build", &at(""), "--manifest", &parts, "-o", &space]);
    assert!(done, "{error}");
    let members = "walk=1,female-walk=1,ZOMBIE=1,DEPRESSED=1";
    let (done, _, error) = run(&["blend", "mix", &space, "--shape", members, "-o", &at("members")]);
    assert!(done, "{error}");
    let own = members.split(',').map(|m| read_off(&dir.path().join(format!("members/part_{}.bvh", m.trim_end_matches("=1")))));
    let own: Vec<[f64; 2]> = own.collect();
    let spread = |k: usize| {
        let mean = own.iter().map(|m| m[k]).sum::<f64>() / own.len() as f64;
        (mean, (own.iter().map(|m| (m[k] - mean).powi(2)).sum::<f64>() / own.len() as f64).sqrt())
    };
    println!("| more of | steps of 0.5 s.d. | right hand, hip heights | mean joint speed, m/s |\n|---|---|---|---|");
    for (moved, name) in ["hand-height", "energy"].into_iter().enumerate() {
        let out = at(name);
        let (done, _, error) = run(&["blend", "attribute", &space, name, "--by=-1,-0.5,0,0.5,1", "-o", &out]);
        assert!(done, "{error}");
        let steps = ["-1", "-0.5", "+0", "+0.5", "+1"].map(|by| read_off(&Path::new(&out).join(format!("{name}_{by}.bvh"))));
        println!("| {name} | -1 to 1 | {:.3?} | {:.3?} |", steps.map(|s| s[0]), steps.map(|s| s[1]));
        let ((_, deviation), (mean, other)) = (spread(moved), spread(1 - moved));
        assert!(steps.windows(2).all(|w| w[1][moved] > w[0][moved] + 0.1 * deviation), "{steps:?} {deviation}");
        assert!(steps[4][moved] - steps[0][moved] > deviation);
        assert!(steps.iter().all(|s| (s[1 - moved] - mean).abs() < other), "{steps:?} {mean} {other}");
    }
    println!("| the four recordings | mean and s.d. | {:.3?} | {:.3?} |", spread(0), spread(1));
}

fn space_members(said: &str) -> usize {
    said.split(": ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap()
}

#[test]
fn what_cannot_be_done_is_said_in_one_sentence() {
    let dir = walkers();
    let at = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let space = at("space.npz");
    assert!(run(&["blend", "build", &at("w1.bvh"), &at("w2.bvh"), &at("w3.bvh"), "-o", &space]).0);
    std::fs::write(dir.path().join("wrong.csv"), "file,mood\nw9,1\n").unwrap();
    let out = at("out");
    let (w1, w2, wrong, none) = (at("w1.bvh"), at("w2.bvh"), at("wrong.csv"), at("none.bvh"));
    let cases: [(&[&str], &str); 9] = [
        (&["build", &w1, &w2, "--labels", &wrong, "-o", &out], "line 2: `w9` is no motion"),
        (&["build", &w1, &w2, "--activity", "jumping", "-o", &out], "at least two"),
        (&["build", &w1, &w2, "--reference", "w7", "-o", &out], "no motion `w7`"),
        (&["mix", &space, "--shape", "w1=1,nobody=1", "-o", &out], "no motion `nobody`; it has w1#1"),
        (&["mix", &space, "--shape", "w1=1,w2=-1", "-o", &out], "add up to"),
        (&["attribute", &space, "grace", "-o", &out], "no attribute `grace`; it has hand-height, energy"),
        (&["attribute", &space, "energy", "--by", "1,1", "-o", &out], "+1 is asked for twice"),
        (&["caricature", &space, "--of", &none, "-o", &out], "none.bvh"),
        (&["info", &w1], "no space of motions"),
    ];
    for (arguments, part) in cases {
        let (done, _, error) = run(&[&["blend"][..], arguments].concat());
        let last = error.lines().last().unwrap_or_default();
        assert!(!done && last.starts_with("error: ") && last.contains(part), "{arguments:?}: {error}");
        assert!(!Path::new(&out).exists(), "{arguments:?}");
    }
}
