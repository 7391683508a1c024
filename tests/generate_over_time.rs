//! `generate` along profiles and bends, with planted feet, and recorded jumps at other lengths, as a user runs it.

use std::path::{Path, PathBuf};

use crate::common::{cycles, mocap, path, run};
use muybridge::body::{Joint, Pose};
use muybridge::io::model_npz::{model_hash, read_model};
use muybridge::io::{bvh, read_clip, style_json};
use muybridge::motion::{Length, play_cycle, synthesize};
use muybridge::motion_model::{Activity, Cycle, Detail, Label, Model, database, segment, synthetic};
use muybridge::style::{Method, Metric, Population, Style};
use nalgebra::DVector;

/// The synthetic model of an activity and the style of one who is not in it.
fn model_and_style(folder: &Path, activity: Activity, speed: f64) -> (String, String) {
    let (model, style) = (path(folder, &format!("{activity}.npz")), path(folder, &format!("{activity}.json")));
    assert!(run(&["model", "synthetic", "--activity", &activity.to_string(), "-o", &model]).0);
    let read = read_model(Path::new(&model)).unwrap();
    let of = Style::of_cycles(&read, &model_hash(&read), &[synthetic::subject(activity, 70).mean_cycle(speed)]).unwrap();
    style_json::write_style(Path::new(&style), &of).unwrap();
    (model, style)
}

/// Root positions (x, z) of a BVH file from its channels alone, and the frames per second.
fn roots(bvh: &Path) -> (Vec<[f64; 2]>, f64) {
    let text = std::fs::read_to_string(bvh).unwrap();
    let motion: Vec<&str> = text.split("MOTION").nth(1).unwrap().lines().filter(|l| !l.trim().is_empty()).collect();
    let frame_s: f64 = motion[1].trim_start_matches("Frame Time:").trim().parse().unwrap();
    let row = |line: &&str| -> Vec<f64> { line.split_whitespace().take(3).map(|v| v.parse().unwrap()).collect() };
    (motion[2..].iter().map(row).map(|r| [r[0], r[2]]).collect(), 1.0 / frame_s)
}

/// Mean speed along the way between two times, m/s.
fn speed(roots: &[[f64; 2]], fps: f64, from_s: f64, to_s: f64) -> f64 {
    let frame = |t: f64| (t * fps).round() as usize;
    // Steps of a fifth of a second, over which the pelvis hardly sways.
    let step = frame(0.2);
    let points: Vec<[f64; 2]> = (frame(from_s)..=frame(to_s)).step_by(step).map(|k| roots[k]).collect();
    let way: f64 = points.windows(2).map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1])).sum();
    way * fps / ((points.len() - 1) * step) as f64
}

#[test]
fn a_profile_is_walked_and_run_on_planted_feet() {
    let dir = tempfile::tempdir().unwrap();
    let (walking, style) = model_and_style(dir.path(), Activity::Walking, 1.2);
    let (running, run_style) = model_and_style(dir.path(), Activity::Running, 2.5);
    let out = path(dir.path(), "out");
    let profile = "0:0,2:1.4,5:1.4,7:3,10:3,12:5.04km/h,14:0,15:0";
    let options = ["--run-model", &running, "--run-style", &run_style, "--plant-feet"];
    let mut arguments = vec!["generate", "--model", &walking, "--style", &style, "--profile", profile, "-o", &out];
    arguments.extend(options);
    let (done, said, error) = run(&arguments);
    assert!(done && said.contains("contacts of feet planted"), "{said} {error}");
    let (way, fps) = roots(&Path::new(&out).join("profile.bvh"));
    assert_eq!((way.len(), fps.round()), (901, 60.0));
    for (from, to, wanted) in [(3.0, 5.0, 1.4), (8.0, 10.0, 3.0)] {
        let found = speed(&way, fps, from, to);
        assert!((found / wanted - 1.0).abs() < 0.03, "{from} s: {found}");
    }
    assert!(speed(&way, fps, 14.6, 15.0) < 0.1);
    let csv = std::fs::read_to_string(Path::new(&out).join("profile.csv")).unwrap();
    let rows: Vec<Vec<f64>> = csv.lines().skip(1).map(|l| l.split(',').map(|c| c.parse().unwrap()).collect()).collect();
    assert!(csv.starts_with("frame,time_s,wanted_m_s,speed_m_s,heading_deg,lean_deg,running,phase\n") && rows.len() == 901);
    assert!(rows.iter().all(|r| (r[2] - r[3]).abs() < 0.15));
    assert_eq!((rows[240][6], rows[540][6], rows[760][6]), (0.0, 1.0, 0.0));
}

#[test]
fn a_bend_turns_by_its_way_over_its_radius() {
    let dir = tempfile::tempdir().unwrap();
    let (walking, style) = model_and_style(dir.path(), Activity::Walking, 1.2);
    let out = path(dir.path(), "out");
    let options = ["--at", "1.3", "--turn-radius", "-3", "--seconds", "6", "--plant-feet"];
    let mut arguments = vec!["generate", "--model", &walking, "--style", &style, "-o", &out];
    arguments.extend(options);
    let (done, _, error) = run(&arguments);
    assert!(done, "{error}");
    let (way, fps) = roots(&Path::new(&out).join("walking_1.30.bvh"));
    assert!((speed(&way, fps, 0.0, 6.0) / 1.3 - 1.0).abs() < 0.03);
    // All of the way lies on the circle about the point 3 m to the right, which is -x for somebody who goes along +z.
    let off = way.iter().map(|p| ((p[0] + 3.0).hypot(p[1]) - 3.0).abs()).fold(0.0, f64::max);
    assert!(off < 0.08, "{off}");
}

/// A space of synthetic walkers.
fn walkers_space(folder: &Path) -> String {
    let space = path(folder, "space.npz");
    let files: Vec<String> = (1..5u64)
        .map(|seed| {
            let subject = synthetic::subject(Activity::Walking, seed);
            let cycle = subject.cycle(0.8 + 0.2 * seed as f64, 0);
            let clip = play_cycle(&cycle, &subject.shape().offsets(), 100.0, Length::Cycles(4));
            let file = path(folder, &format!("w{seed}.bvh"));
            bvh::write_clip(Path::new(&file), &clip, None).unwrap();
            file
        })
        .collect();
    let build: Vec<&str> = ["blend", "build", "-o", &space].into_iter().chain(files.iter().map(String::as_str)).collect();
    assert!(run(&build).0);
    space
}

/// Height of the right wrist over that of the hip joints in every frame of a file.
fn hand_heights(bvh: &Path) -> Vec<f64> {
    let clip = read_clip(bvh).unwrap().clip;
    clip.poses.iter().map(|p| clip.place(p).position(Joint::RWrist).y / clip.hip_height_m).collect()
}

#[test]
fn attributes_and_caricatures_are_turned_while_it_walks() {
    let dir = tempfile::tempdir().unwrap();
    let (walking, style) = model_and_style(dir.path(), Activity::Walking, 1.2);
    let space = walkers_space(dir.path());
    let generate = |name: &str, options: &[&str]| {
        let out = path(dir.path(), name);
        let (done, _, error) = run(&[&["generate", "--model", &walking, "--style", &style, "-o", &out][..], options].concat());
        (done, error, PathBuf::from(out))
    };
    let mean = |h: &[f64]| h.iter().sum::<f64>() / h.len() as f64;
    let steady = ["-1.5", "0", "0.75", "1.5"].map(|amount| {
        let attribute = format!("hand-height={amount}");
        let (done, error, out) = generate(amount, &["--at", "1.2", "--space", &space, "--attribute", &attribute]);
        assert!(done, "{error}");
        mean(&hand_heights(&out.join("walking_1.20.bvh")))
    });
    println!("right hand at {steady:.3?} hip heights");
    assert!(steady.windows(2).all(|w| w[1] > w[0] + 0.002), "{steady:?}");
    let course = ["--profile", "0:1.2,8:1.2", "--space", &space, "--attribute", "hand-height=2:-1.5,5:1.5", "--plant-feet"];
    let (done, error, out) = generate("course", &course);
    assert!(done, "{error}");
    let heights = hand_heights(&out.join("profile.bvh"));
    let (before, after) = (mean(&heights[..100]), mean(&heights[380..]));
    assert!((before - steady[0]).abs() < 0.25 * (steady[3] - steady[0]), "{before} {steady:?}");
    assert!((after - steady[3]).abs() < 0.25 * (steady[3] - steady[0]), "{after} {steady:?}");
    // At the same instant of the cycle, twice one's own is as far on the one side as nothing of it on the other.
    let first = |name: &str, options: &[&str]| {
        let (done, error, out) = generate(name, &[&["--at", "1.2"][..], options].concat());
        assert!(done, "{error}");
        read_clip(&out.join("walking_1.20.bvh")).unwrap().clip.poses.remove(0)
    };
    let own = first("own", &[]);
    let [mean, once, twice] = ["0", "1", "2"].map(|degree| first(&format!("car{degree}"), &["--caricature", degree]));
    let apart = |p: &Pose| p.joints.iter().zip(&own.joints).map(|(a, b)| a.angle_to(b).powi(2)).sum::<f64>().sqrt().to_degrees();
    println!("from the original {:.2}, {:.2}, {:.2} degrees", apart(&mean), apart(&once), apart(&twice));
    assert!(apart(&once) < 0.1 && apart(&mean) > 1.0 && (apart(&twice) / apart(&mean) - 1.0).abs() < 0.1);
    let (done, error, out) = generate("none", &["--at", "1.2", "--space", &space, "--attribute", "grace=1"]);
    assert!(!done && error.contains("no attribute `grace`; it has hand-height, energy") && !out.exists(), "{error}");
}

#[test]
fn what_cannot_be_followed_is_one_sentence() {
    let dir = tempfile::tempdir().unwrap();
    let (walking, style) = model_and_style(dir.path(), Activity::Walking, 1.2);
    let (jumping, jump) = model_and_style(dir.path(), Activity::Jumping, 0.8);
    let out = path(dir.path(), "none");
    let cases: [(&[&str], &str); 5] = [
        (&["--model", &jumping, "--style", &jump, "--profile", "0:0,1:1"], "holds jumps"),
        (&["--model", &jumping, "--style", &jump, "--at", "0.8", "--caricature", "2"], "holds jumps"),
        (&["--model", &walking, "--style", &style, "--profile", "0:0,1:1", "--run-model", &walking], "not of running"),
        (&["--model", &walking, "--style", &style, "--profile", "0:0,0:1"], "must increase"),
        (&["--model", &walking, "--style", &style, "--at", "1", "--turn-radius", "0.1"], "radius of 0.5 m or more"),
    ];
    for (options, part) in cases {
        let mut arguments = vec!["generate", "-o", &out];
        arguments.extend(options);
        let (done, _, error) = run(&arguments);
        assert!(!done && error.contains(part) && !Path::new(&out).exists(), "{options:?}: {error}");
    }
}

fn walks(file: &Path) -> Vec<Cycle> {
    let subject = file.parent().unwrap().file_name().unwrap().to_string_lossy().into_owned();
    let label = Label { subject, source: "x".into(), activity: Activity::Walking, parameter: None, start_s: None, end_s: None };
    segment(&read_clip(file).unwrap().clip, &label).map(|s| s.cycles).unwrap_or_default()
}

fn cycle_vector(model: &Model, weights: &[f64], detail: &Option<Detail>) -> DVector<f64> {
    let vector = model.vector(weights);
    detail.as_ref().map_or(vector.clone(), |d| vector + &d.vector)
}

/// Per style the distance of the walk at another speed to the style itself and to the nearest other one, degrees r.m.s.
fn kept(model: &Model, styles: &[Style], method: Method) -> Vec<(f64, f64)> {
    let own: Vec<DVector<f64>> = styles.iter().map(|s| cycle_vector(model, &s.weights, &s.detail)).collect();
    let remade = styles.iter().map(|style| {
        let speed = if style.parameter < 1.2 { 1.3 * style.parameter } else { style.parameter / 1.3 };
        let population = Population::new(model, style.weights.len());
        let made = synthesize(model, &population, method, style, speed, style.hip_height_m).unwrap();
        cycle_vector(model, made.weights.as_slice(), &made.detail)
    });
    let degrees = |a: &DVector<f64>, b: &DVector<f64>| ((a - b).norm_squared() / (a.len() / 3) as f64).sqrt().to_degrees();
    let distances = remade.enumerate().map(|(i, made)| {
        let others = own.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, o)| degrees(&made, o));
        (degrees(&made, &own[i]), others.fold(f64::INFINITY, f64::min))
    });
    distances.collect()
}

#[test]
fn stylised_walks_keep_their_style_at_another_speed() {
    let (Some(cycles), Some(stylised)) = (cycles("cmu-asfamc", Activity::Walking), mocap("bandai-namco-1/data")) else { return };
    let model = Model::build(Activity::Walking, false, &database::thin(cycles).0).unwrap();
    let mut files: Vec<PathBuf> = std::fs::read_dir(stylised).unwrap().map(|e| e.unwrap().path()).collect();
    files.retain(|f| f.to_string_lossy().contains("_walk_") && f.to_string_lossy().ends_with("_001.bvh"));
    files.sort();
    let styles: Vec<Style> = files.iter().filter_map(|f| Style::of_cycles(&model, "", &walks(f))).collect();
    assert_eq!(styles.len(), 15);
    let (ours, paper) = (kept(&model, &styles, Method::Default), kept(&model, &styles, Method::Paper(Metric::Paper)));
    for (name, found) in [("default", &ours), ("paper", &paper)] {
        let right = found.iter().filter(|(own, other)| own < other).count();
        let mean = |f: fn(&(f64, f64)) -> f64| found.iter().map(f).sum::<f64>() / 15.0;
        println!(
            "{name}: {right} of 15 nearest to their own style, {:.2} degrees, to the nearest other {:.2}",
            mean(|d| d.0),
            mean(|d| d.1)
        );
    }
    // Who keeps only what normal walkers span loses the style; that is what makes the first line worth having.
    let nearest = |found: &[(f64, f64)]| found.iter().filter(|(own, other)| own < other).count();
    assert!(nearest(&ours) >= 14 && nearest(&paper) <= 7, "{ours:?} {paper:?}");
}

#[test]
fn recorded_jumps_are_made_at_other_lengths() {
    let Some(folder) = mocap("cmu-bvh/13") else { return };
    let dir = tempfile::tempdir().unwrap();
    let model = path(dir.path(), "jumping.npz");
    assert!(run(&["model", "synthetic", "--activity", "jumping", "-o", &model]).0);
    // Net travel of the whole trial as another program measured it.
    for (trial, travel_m) in [("13_11", 1.27), ("13_13", 1.22), ("13_32", 1.25)] {
        let out = path(dir.path(), trial);
        let file = folder.join(format!("{trial}.bvh"));
        let file = file.to_string_lossy();
        let (done, said, error) = run(&["generate", "--model", &model, "--style", &file, "--at", "60cm,90cm", "-o", &out]);
        assert!(done, "{error}");
        let recorded: f64 = said.split(" at ").nth(1).unwrap().split(',').next().unwrap().parse().unwrap();
        assert!((recorded / travel_m - 1.0).abs() < 0.05, "{trial}: {recorded}");
        for (name, length) in [("jumping_0.60.bvh", 0.6), ("jumping_0.90.bvh", 0.9)] {
            let bvh = Path::new(&out).join(name);
            let (way, _) = roots(&bvh);
            let last = way[way.len() - 1];
            assert!(((last[0] - way[0][0]).hypot(last[1] - way[0][1]) / length - 1.0).abs() < 0.01, "{trial} {name}");
            // Cut again: it is one jump with a flight, of about that length; short ones are cut a little within.
            let label =
                Label { subject: "x".into(), source: "x".into(), activity: Activity::Jumping, parameter: None, start_s: None, end_s: None };
            let cycles = segment(&read_clip(&bvh).unwrap().clip, &label).unwrap().cycles;
            assert!(cycles.len() == 1 && (cycles[0].parameter / length - 1.0).abs() < 0.15, "{trial} {name}: {}", cycles[0].parameter);
        }
    }
}
