//! Inverse kinematics of markers against the data sets' own (OpenSim), and of a known clip through noise, gaps and exchanges.

use std::path::Path;

use crate::common::mocap;
use muybridge::body::{Clip, Joint, Pose};
use muybridge::io::manifest::find_motions;
use muybridge::io::markers::read;
use muybridge::io::read_clip;
use muybridge::math::rotation::exp;
use muybridge::motion_model::markers::set::SetMarker;
use muybridge::motion_model::markers::{MarkerSet, Markers, Solved, choose, solve};
use muybridge::motion_model::{Activity, Label, segment, synthetic};
use nalgebra::{UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn solved(markers: &Markers) -> Solved {
    let sets = MarkerSet::supplied().unwrap();
    let (set, matches) = choose(&sets, &markers.names).unwrap();
    solve(markers, set, &matches).unwrap()
}

/// First angle of OpenSim's Z-X-Y sequence (X forward, Y up, Z right), degrees: flexion of the hip, dorsiflexion.
fn sagittal_deg(q: &UnitQuaternion<f64>) -> f64 {
    // In our axes (x left, y up, z forward): R = Rx(-a) Rz(b) Ry(c).
    let r = q.to_rotation_matrix();
    let (forward_by_up, up_by_up) = (r[(2, 1)], r[(1, 1)]);
    (-forward_by_up).atan2(up_by_up).to_degrees()
}

/// Columns of an OpenSim table; times and values.
fn column(path: &Path, name: &str) -> Vec<(f64, f64)> {
    let text = std::fs::read_to_string(path).unwrap();
    let mut rows = text.lines().skip_while(|l| l.trim() != "endheader").skip(1).filter(|l| !l.trim().is_empty());
    let at = rows.next().unwrap().split_whitespace().position(|c| c == name).unwrap();
    let value = |row: &str, at: usize| row.split_whitespace().nth(at).unwrap().parse::<f64>().unwrap();
    rows.map(|row| (value(row, 0), value(row, at))).collect()
}

/// The reference's hips cannot extend further; while one stands at its stop, the whole pelvis gives way and it is no reference.
const HIP_STOP_DEG: f64 = -29.5;

/// R.m.s. difference of hip, knee and ankle (both sides) after the mean difference is removed, and these means, degrees.
fn differences(clip: &Clip, first_s: f64, mot: &Path, knee_sign: f64) -> [(f64, f64); 6] {
    use Joint::*;
    let hips = [column(mot, "hip_flexion_r"), column(mot, "hip_flexion_l")];
    let free: Vec<bool> = (0..hips[0].len()).map(|i| hips.iter().all(|h| h[i].1 > HIP_STOP_DEG)).collect();
    [
        ("hip_flexion_r", RHip, 1.0),
        ("knee_angle_r", RKnee, -knee_sign),
        ("ankle_angle_r", RAnkle, 1.0),
        ("hip_flexion_l", LHip, 1.0),
        ("knee_angle_l", LKnee, -knee_sign),
        ("ankle_angle_l", LAnkle, 1.0),
    ]
    .map(|(name, joint, sign)| {
        let off: Vec<f64> = column(mot, name)
            .iter()
            .zip(&free)
            .filter(|(_, free)| **free)
            .map(|(row, _)| row)
            .filter_map(|(time_s, angle)| {
                let pose: &Pose = clip.poses.get(((time_s - first_s) * clip.fps).round() as usize)?;
                Some(sagittal_deg(pose.joint(joint)) - sign * angle)
            })
            .collect();
        assert!(off.len() > 15, "{} frames in common", off.len());
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        ((off.iter().map(|o| (o - mean).powi(2)).sum::<f64>() / off.len() as f64).sqrt(), mean)
    })
}

const HEAD: &str = "r.m.s. (mean) difference, degrees: hip r, knee r, ankle r, hip l, knee l, ankle l";

fn agree(name: &str, solved: &Solved, found: &[(f64, f64); 6]) {
    let line: Vec<String> = found.iter().map(|(rms, mean)| format!("{rms:5.2} ({mean:+6.1})")).collect();
    println!("{name}: markers {:.1} mm; {}", 1e3 * solved.rms_m, line.join("  "));
    // Hips and knees move by 40 degrees and more: a still pose is off by over 10.
    assert!(found.iter().all(|(rms, _)| *rms < 5.0), "{name}: {found:?}");
    assert!(solved.rms_m < 0.010 && solved.let_go < 0.01, "{name}: {} {}", solved.rms_m, solved.let_go);
}

#[test]
fn runners_agree_with_their_own_inverse_kinematics() {
    let Some(data) = mocap("hamner-running") else { return };
    println!("{HEAD}");
    for (subject, speed) in [("subject01", 3), ("subject01", 5), ("subject03", 2), ("subject03", 4)] {
        let (mut markers, _) = read(&data.join(subject).join(format!("expData/Run_{speed}.trc"))).unwrap();
        markers.frames.truncate(100);
        let solved = solved(&markers);
        let mot = data.join(subject).join(format!("ik/Run_{speed}.mot"));
        let first_s = column(&mot, "hip_flexion_r")[0].0 + solved.first_frame as f64 / markers.fps;
        agree(&format!("{subject} {speed} m/s"), &solved, &differences(&solved.clip, first_s, &mot, -1.0));
    }
}

const WALKS: [&str; 18] = [
    "2014001_C4_05",
    "2014001_C5_01",
    "2014007_C4_04",
    "2014007_C5_04",
    "2014015_C4_04",
    "2014015_C5_03",
    "2014022_C4_04",
    "2014022_C5_02",
    "2014029_C4_05",
    "2014029_C5_05",
    "2014031_C4_02",
    "2014031_C5_05",
    "2014050_C4_04",
    "2014050_C5_05",
    "2015026_C4_04",
    "2015026_C5_03",
    "2015035_C4_03",
    "2015035_C5_03",
];

#[test]
fn walkers_agree_with_their_own_inverse_kinematics() {
    let Some(data) = mocap("schreiber-walking") else { return };
    println!("{HEAD}");
    for trial in WALKS {
        let (subject, name) = trial.split_at(7);
        let (markers, _) = read(&data.join(subject).join(format!("dynamic/{trial}.c3d"))).unwrap();
        let solved = solved(&markers);
        let mot = data.join(subject).join(format!("ik{name}/{}_ik.mot", &name[1..]).replace("ik_", "ik/"));
        agree(trial, &solved, &differences(&solved.clip, solved.first_frame as f64 / markers.fps, &mot, 1.0));
    }
}

/// A walker's clip at 100 Hz.
fn walker(frames: usize) -> Clip {
    let person = synthetic::subject(Activity::Walking, 5);
    let (cycle, offsets) = (person.mean_cycle(1.3), person.shape().offsets());
    let poses = (0..frames).map(|i| {
        let (joints, root) = cycle.posture(0.2 + i as f64 / 100.0 / cycle.duration_s);
        let way = Vector3::new(0.0, 1.0, 1.3 * i as f64 / 100.0 / cycle.hip_height_m);
        Pose { root: (root.position + way) * cycle.hip_height_m, world_from_root: exp(&root.rotation), joints }
    });
    Clip { fps: 100.0, poses: poses.collect(), offsets, hip_height_m: cycle.hip_height_m }
}

/// What a laboratory would record of `clip`: z up, millimetres, walking along y, markers off their nominal places by the
/// set's spread, noise of 1.5 mm, a gap in every marker, knees exchanged for 15 frames, one marker fallen off at half time.
fn recorded(clip: &Clip, set: &MarkerSet) -> Markers {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut random = |size: f64| Vector3::from_fn(|_, _| size * rng.random_range(-1.7..1.7));
    let places: Vec<Vector3<f64>> = set.markers.iter().map(|m| m.at + random(0.5 * m.spread_m)).collect();
    let names: Vec<String> = set.markers.iter().map(|m| format!("Jo:{}", m.names[0])).collect();
    let mut frames = Vec::new();
    for (f, pose) in clip.poses.iter().enumerate() {
        let placed = clip.place(pose);
        let seen = |(i, m): (usize, &SetMarker)| {
            let near = if m.near == m.on { Vector3::zeros() } else { clip.offsets[m.near as usize] };
            let x = placed.position(m.on) + placed.world_from_node[m.on as usize] * (near + places[i]) + random(0.0015);
            let gap = (11 * i) % 130;
            let fallen = names[i].ends_with("RTHI") && f > 75;
            let x = if fallen { Vector3::new(0.3, 0.01, 0.8) } else { x };
            (!(gap..gap + 12).contains(&f)).then(|| Vector3::new(x.x, -x.z, x.y) * 1000.0)
        };
        let mut frame: Vec<Option<Vector3<f64>>> = set.markers.iter().enumerate().map(seen).collect();
        if (40..55).contains(&f) {
            let [l, r] = ["Jo:LKNE", "Jo:RKNE"].map(|n| names.iter().position(|x| x == n).unwrap());
            frame.swap(l, r);
        }
        frames.push(frame);
    }
    Markers { names, fps: 100.0, metres_per_unit: Some(0.001), frames }
}

fn worst_sagittal_deg(a: &Clip, b: &Clip) -> f64 {
    use Joint::*;
    let rms = |joint: Joint| {
        let off: Vec<f64> =
            a.poses.iter().zip(&b.poses).map(|(a, b)| sagittal_deg(a.joint(joint)) - sagittal_deg(b.joint(joint))).collect();
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        (off.iter().map(|o| (o - mean).powi(2)).sum::<f64>() / off.len() as f64).sqrt()
    };
    [LHip, LKnee, LAnkle, RHip, RKnee, RAnkle, LShoulder, RElbow].map(rms).into_iter().fold(0.0, f64::max)
}

#[test]
fn a_known_walk_comes_back_through_noise_gaps_and_exchanged_markers() {
    let clip = walker(150);
    let sets = MarkerSet::supplied().unwrap();
    let mut markers = recorded(&clip, &sets[0]);
    let found = solved(&markers);
    assert_eq!(found.clip.poses.len(), 150, "{:?}", found.notices);
    let worst = worst_sagittal_deg(&found.clip, &clip);
    let still = Clip { poses: vec![clip.poses[0].clone(); 150], ..clip.clone() };
    let leg = found.clip.leg_m() / clip.leg_m();
    let knee = |c: &Clip, f: usize| c.place(&c.poses[f]).position(Joint::RKnee) - c.place(&c.poses[0]).position(Joint::RHip);
    println!("markers {:.1} mm, let go {:.3}, worst angle {worst:.2} degrees, leg x {leg:.3}", 1e3 * found.rms_m, found.let_go);
    assert!(worst < 3.0 && worst_sagittal_deg(&still, &clip) > 10.0, "{worst}");
    assert!((leg - 1.0).abs() < 0.05 && found.rms_m < 0.012, "{leg} {}", found.rms_m);
    assert!(found.let_go > 0.015 && found.let_go < 0.04, "30 exchanged and 75 fallen of 6000: {}", found.let_go);
    assert!((0..150).step_by(10).all(|f| (knee(&found.clip, f) - knee(&clip, f)).norm() < 0.06));
    // The same file said to be in metres: a person of 1700 m is seen through.
    markers.metres_per_unit = Some(1.0);
    let again = solved(&markers);
    assert!(again.notices[0].ends_with("taken as mm"), "{:?}", again.notices);
    assert_eq!(again.clip.poses, found.clip.poses);
    // Left and right names exchanged throughout: no body fits.
    for name in &mut markers.names {
        *name = match name.strip_prefix("Jo:L") {
            Some(rest) => format!("Jo:R{rest}"),
            None => name.replacen("Jo:R", "Jo:L", 1),
        };
    }
    let (set, matches) = choose(&sets, &markers.names).unwrap();
    let error = solve(&markers, set, &matches).map(|s| s.let_go).unwrap_err().to_string();
    assert!(error.contains("left and right or other names are exchanged"), "{error}");
}

/// A TRC file of markers in the axes and units that they have.
fn trc(markers: &Markers) -> String {
    let (n, m) = (markers.frames.len(), markers.names.len());
    let mut text = format!("PathFileType\t4\t(X/Y/Z)\tx.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n100\t100\t{n}\t{m}\tmm\n");
    text += &format!("Frame#\tTime\t{}\n\t\tX1\n\n", markers.names.join("\t\t\t"));
    for (f, frame) in markers.frames.iter().enumerate() {
        let cell = |x: &Option<Vector3<f64>>| x.map_or("\t\t".into(), |x| format!("{:.3}\t{:.3}\t{:.3}", x.x, x.y, x.z));
        text += &format!("{}\t{:.2}\t{}\n", f + 1, f as f64 / 100.0, frame.iter().map(cell).collect::<Vec<_>>().join("\t"));
    }
    text
}

#[test]
fn a_folder_of_treadmill_markers_becomes_cycles_at_the_manifests_speed() {
    let clip = walker(230);
    let mut markers = recorded(&clip, &MarkerSet::supplied().unwrap()[0]);
    for (f, frame) in markers.frames.iter_mut().enumerate() {
        // Walking along -y of the file, 13 mm a frame: the belt takes it back.
        frame.iter_mut().flatten().for_each(|x| x.y += 13.0 * f as f64);
    }
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(folder.path().join("p1/markers")).unwrap();
    std::fs::write(folder.path().join("p1/markers/walk.trc"), trc(&markers)).unwrap();
    let cycles = |speed_m_s: Option<f64>| {
        let entries = find_motions(&[folder.path().to_path_buf()], None).unwrap();
        let read = read_clip(&entries[0].path).unwrap();
        let parameter = speed_m_s.and(entries[0].parameter);
        let (subject, source) = (entries[0].subject.clone(), "walk".to_string());
        let label = Label { subject, source, activity: Activity::Walking, parameter, start_s: None, end_s: None };
        segment(&read.clip, &label).map(|s| (s.cycles, entries[0].subject.clone()))
    };
    std::fs::write(folder.path().join("subjects.csv"), "file,subject,speed_m_s\np1/markers/walk.trc,,1.3\n").unwrap();
    let (found, subject) = cycles(Some(1.3)).unwrap();
    assert!(!found.is_empty() && subject == "p1" && found.iter().all(|c| c.parameter == 1.3), "{} {subject}", found.len());
    let truth = synthetic::subject(Activity::Walking, 5).mean_cycle(1.3);
    assert!((found[0].duration_s / truth.duration_s - 1.0).abs() < 0.02, "{}", found[0].duration_s);
    assert!((found[0].hip_height_m / truth.hip_height_m - 1.0).abs() < 0.05, "{}", found[0].hip_height_m);
    assert!(cycles(None).is_err(), "without the belt's speed it stands");
}
