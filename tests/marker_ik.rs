//! Inverse kinematics of markers against the data sets' own (OpenSim), and of a known clip through noise, gaps and exchanges.

use std::path::{Path, PathBuf};

use muybridge::body::{Clip, Joint, Pose};
use muybridge::io::markers::read;
use muybridge::math::rotation::log;
use muybridge::motion_model::markers::{MarkerSet, Markers, Solved, choose, solve};
use nalgebra::UnitQuaternion;

fn shared(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap").join(folder);
    if !path.is_dir() {
        println!("skipped: no ../shared/data/mocap/{folder}");
    }
    path.is_dir().then_some(path)
}

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

/// R.m.s. difference of hip, knee and ankle (both sides) after the mean difference is removed, and these means, degrees.
fn differences(clip: &Clip, first_s: f64, mot: &Path, knee_sign: f64) -> [(f64, f64); 6] {
    use Joint::*;
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
            .filter_map(|(time_s, angle)| {
                let pose: &Pose = clip.poses.get(((time_s - first_s) * clip.fps).round() as usize)?;
                Some(sagittal_deg(pose.joint(joint)) - sign * angle)
            })
            .collect();
        assert!(off.len() > 40, "{} frames in common", off.len());
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        ((off.iter().map(|o| (o - mean).powi(2)).sum::<f64>() / off.len() as f64).sqrt(), mean)
    })
}

fn line(differences: &[(f64, f64); 6]) -> String {
    differences.iter().map(|(rms, mean)| format!("{rms:5.2} ({mean:+6.1})")).collect::<Vec<_>>().join("  ")
}

const HEAD: &str = "r.m.s. (mean) difference, degrees: hip r, knee r, ankle r, hip l, knee l, ankle l";

#[test]
fn runners_agree_with_their_own_inverse_kinematics() {
    let Some(data) = shared("hamner-running") else { return };
    println!("{HEAD}");
    for (subject, speed) in [("subject01", 3), ("subject01", 5), ("subject03", 2), ("subject03", 4)] {
        let trc = data.join(subject).join(format!("expData/Run_{speed}.trc"));
        let (mut markers, _) = read(&trc).unwrap();
        if std::env::var("WHOLE").is_err() {
            markers.frames.truncate(150);
        }
        let time = std::time::Instant::now();
        let solved = solved(&markers);
        eprintln!("{} frames {:.1} s", markers.frames.len(), time.elapsed().as_secs_f64());
        let mot = data.join(subject).join(format!("ik/Run_{speed}.mot"));
        let first_s = column(&mot, "hip_flexion_r")[0].0;
        let found = differences(&solved.clip, first_s + solved.first_frame as f64 / markers.fps, &mot, -1.0);
        println!("{subject} {speed} m/s: markers {:.1} mm; {}", 1e3 * solved.rms_m, line(&found));
        for j in [Joint::LKnee, Joint::LAnkle, Joint::RKnee, Joint::RAnkle] {
            print!(" {:.3}", solved.clip.offsets[j as usize].norm());
        }
        println!(" hips {:.3}", solved.clip.offsets[Joint::LHip as usize].x);
    }
}

#[test]
fn walkers_agree_with_their_own_inverse_kinematics() {
    let Some(data) = shared("schreiber-walking") else { return };
    println!("{HEAD}");
    let mut trials: Vec<PathBuf> = Vec::new();
    for subject in std::fs::read_dir(&data).unwrap().flatten().map(|e| e.path().join("dynamic")).filter(|p| p.is_dir()) {
        trials.extend(std::fs::read_dir(subject).unwrap().flatten().map(|e| e.path()));
    }
    trials.sort();
    for c3d in trials {
        let (markers, _) = read(&c3d).unwrap();
        let time = std::time::Instant::now();
        let solved = solved(&markers);
        eprintln!("{} frames {:.1} s", markers.frames.len(), time.elapsed().as_secs_f64());
        let stem = c3d.file_stem().unwrap().to_string_lossy().into_owned();
        let trial = &stem[8..];
        let mot = c3d.parent().unwrap().join(format!("../ik/{trial}/{trial}_ik.mot"));
        let found = differences(&solved.clip, solved.first_frame as f64 / markers.fps, &mot, 1.0);
        println!("{stem}: markers {:.1} mm; {}", 1e3 * solved.rms_m, line(&found));
        for j in [Joint::LKnee, Joint::LAnkle, Joint::RKnee, Joint::RAnkle] {
            print!(" {:.3}", solved.clip.offsets[j as usize].norm());
        }
        println!(" hips {:.3}", solved.clip.offsets[Joint::LHip as usize].x);
        let _ = log(&UnitQuaternion::identity());
    }
}
