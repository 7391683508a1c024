//! One motion file of any kind as a [`Clip`].

use std::path::{Path, PathBuf};

use super::asf_amc::{self, AsfAmcError};
use super::bvh::{self, BvhError};
use super::mapping::{MappingError, Recording, clip_from_recording};
use super::markers::{self, MarkersError};
use super::mot::{self, MotError};
use super::sidecar::Sidecar;
use crate::body::Clip;

#[derive(Debug, thiserror::Error)]
pub enum MocapError {
    #[error(transparent)]
    Bvh(#[from] BvhError),
    #[error(transparent)]
    AsfAmc(#[from] AsfAmcError),
    #[error(transparent)]
    Mot(#[from] MotError),
    #[error(transparent)]
    Markers(#[from] MarkersError),
    #[error("{path}: {cause}")]
    Mapping { path: PathBuf, cause: MappingError },
    #[error("{path}: not a motion file that can be read; give .bvh, .amc (with its .asf beside it), .c3d, .trc, .mot or .sto")]
    Kind { path: PathBuf },
}

/// A motion file's content.
#[derive(Clone, Debug)]
pub struct ReadClip {
    /// The file's name without its ending.
    pub trial: String,
    pub clip: Clip,
    /// What the user should know, one sentence each.
    pub notices: Vec<String>,
}

/// True for the endings that [`read_clip`] reads.
pub fn is_motion_file(path: &Path) -> bool {
    matches!(ending(path).as_str(), "bvh" | "amc" | "mot" | "sto" | "c3d" | "trc")
}

/// Reads `.bvh`, `.amc` (with the `.asf` found beside it), `.mot`, `.sto`, or markers (`.c3d`, `.trc`) by inverse kinematics.
pub fn read_clip(path: &Path) -> Result<ReadClip, MocapError> {
    let mapped = |recording: Recording| clip_from_recording(&recording).map_err(|cause| MocapError::Mapping { path: path.into(), cause });
    let (mut clip, notices) = match ending(path).as_str() {
        "bvh" => mapped(bvh::read(path)?)?,
        "amc" => mapped(asf_amc::read(path)?)?,
        "mot" | "sto" => mot::read(path)?,
        "c3d" | "trc" => markers::read_clip(path)?,
        _ => return Err(MocapError::Kind { path: path.into() }),
    };
    if let Some(sidecar) = Sidecar::beside(path) {
        clip.hip_height_m = sidecar.hip_height_m;
        clip.offsets[0].y = sidecar.hip_height_m - clip.offsets[crate::body::Joint::LHip as usize].y;
    }
    Ok(ReadClip { trial: path.file_stem().unwrap_or_default().to_string_lossy().into_owned(), clip, notices })
}

fn ending(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Joint, Placement};
    use crate::math::order::quantile;
    use crate::math::rotation::log;
    use nalgebra::Vector3;
    use std::collections::BTreeMap;

    fn shared(folder: &str) -> Option<PathBuf> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(folder);
        if !path.is_dir() {
            println!("skipped: no ../shared/data/{folder}");
        }
        path.is_dir().then_some(path)
    }

    fn files(folder: &Path, ending: &str) -> Vec<PathBuf> {
        let mut found = Vec::new();
        for entry in std::fs::read_dir(folder).unwrap().flatten().map(|e| e.path()) {
            if entry.is_dir() {
                found.extend(files(&entry, ending));
            } else if super::ending(&entry) == ending {
                found.push(entry);
            }
        }
        found.sort();
        found
    }

    fn direction(p: &Placement, upper: Joint, lower: Joint) -> Vector3<f64> {
        (p.position(lower) - p.position(upper)).normalize()
    }

    /// Angle between the segments that meet in a joint, degrees.
    fn included(p: &Placement, [a, b, c]: [Joint; 3]) -> f64 {
        (p.position(a) - p.position(b)).angle(&(p.position(c) - p.position(b))).to_degrees()
    }

    const KNEES: [[Joint; 3]; 2] = [[Joint::LHip, Joint::LKnee, Joint::LAnkle], [Joint::RHip, Joint::RKnee, Joint::RAnkle]];
    const ELBOWS: [[Joint; 3]; 2] = [[Joint::LShoulder, Joint::LElbow, Joint::LWrist], [Joint::RShoulder, Joint::RElbow, Joint::RWrist]];

    fn correlation(a: &[f64], b: &[f64]) -> f64 {
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
        let (ma, mb) = (mean(a), mean(b));
        let dot = |x: &[f64], mx: f64, y: &[f64], my: f64| x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum::<f64>();
        dot(a, ma, b, mb) / (dot(a, ma, a, ma) * dot(b, mb, b, mb)).sqrt()
    }

    #[test]
    fn every_cmu_walk_keeps_its_limb_directions_and_walks_like_a_person() {
        let Some(folder) = shared("mocap/cmu-asfamc") else { return };
        let walks = files(&folder, "amc");
        assert_eq!(walks.len(), 69);
        let mut counter_swings = Vec::new();
        for path in walks {
            let recording = asf_amc::read(&path).unwrap();
            let clip = read_clip(&path).unwrap().clip;
            let skipped = recording.frames.len() - clip.poses.len();
            assert!(skipped <= 1);
            let bone = |name: &str| recording.joints.iter().position(|j| j.name == name).unwrap();
            let limbs = [
                (Joint::LHip, Joint::LKnee, "lfemur", "ltibia"),
                (Joint::RHip, Joint::RKnee, "rfemur", "rtibia"),
                (Joint::LKnee, Joint::LAnkle, "ltibia", "lfoot"),
                (Joint::RKnee, Joint::RAnkle, "rtibia", "rfoot"),
                (Joint::LShoulder, Joint::LElbow, "lhumerus", "lradius"),
                (Joint::RElbow, Joint::RWrist, "rradius", "rwrist"),
            ]
            .map(|(a, b, upper, lower)| (a, b, bone(upper), bone(lower)));
            let (hip_l, hip_r) = (bone("lfemur"), bone("rfemur"));
            for (pose, frame) in clip.poses.iter().zip(&recording.frames[skipped..]) {
                let placed = clip.place(pose);
                for (a, b, upper, lower) in limbs {
                    let source = (frame.positions[lower] - frame.positions[upper]).normalize();
                    // CMU's two forearm bones are parallel to 4e-5 only.
                    let tolerance = if b == Joint::RWrist { 1e-4 } else { 1e-6 };
                    assert!((direction(&placed, a, b) - source).norm() < tolerance, "{} {}", path.display(), b.name());
                }
                let hips = 0.5 * (placed.position(Joint::LHip) + placed.position(Joint::RHip));
                let theirs = 0.5 * (frame.positions[hip_l] + frame.positions[hip_r]) * (0.0254 / 0.45);
                assert!((hips - theirs).xz().norm() < 1e-9, "{}", path.display());
            }
            // Upright hips stand as high as the straight leg says; none of this uses the recorded floor.
            let heights: Vec<f64> = clip.poses.iter().map(|p| clip.place(p).position(Joint::LHip).y).collect();
            let high = quantile(heights, 0.95).unwrap() / clip.hip_height_m;
            assert!((0.92..1.06).contains(&high), "{}: {high}", path.display());
            let knee: Vec<f64> = clip.poses.iter().map(|p| log(p.joint(Joint::RKnee)).x.to_degrees()).collect();
            let hip: Vec<f64> = clip.poses.iter().map(|p| log(p.joint(Joint::LHip)).x).collect();
            let shoulder: Vec<f64> = clip.poses.iter().map(|p| log(p.joint(Joint::RShoulder)).x).collect();
            let peak = knee.iter().copied().fold(0.0, f64::max);
            assert!((45.0..95.0).contains(&peak) && knee.iter().all(|k| *k > -5.0), "{}: {peak}", path.display());
            counter_swings.push(correlation(&hip, &shoulder));
            let travel = clip.poses[clip.poses.len() - 1].root - clip.poses[0].root;
            if travel.norm() > 2.5 {
                let facing: Vector3<f64> = clip.poses.iter().map(|p| p.world_from_root * Vector3::z()).sum();
                assert!(facing.normalize().dot(&travel.normalize()) > 0.93, "{}", path.display());
            }
        }
        // Left leg and right arm swing together; a few people hardly swing their arms.
        counter_swings.sort_by(f64::total_cmp);
        assert!(counter_swings[counter_swings.len() / 4] > 0.7, "{counter_swings:?}");
    }

    /// Mean absolute difference of included angles over the common frames, degrees.
    fn difference(a: &Clip, b: &Clip, skip: usize, angles: &[[Joint; 3]]) -> f64 {
        let pairs: Vec<_> = a.poses[skip..].iter().zip(&b.poses).map(|(x, y)| (a.place(x), b.place(y))).collect();
        let total: f64 = pairs.iter().flat_map(|(x, y)| angles.iter().map(|&j| (included(x, j) - included(y, j)).abs())).sum();
        total / (pairs.len() * angles.len()) as f64
    }

    #[test]
    fn one_trial_in_three_files_is_one_motion() {
        let (Some(asf), Some(daz), Some(other)) =
            (shared("mocap/cmu-asfamc"), shared("mocap/cmu-bvh"), shared("mocap/parser-torture/bvh/pybvh"))
        else {
            return;
        };
        let asf = read_clip(&asf.join("12/12_01.amc")).unwrap().clip;
        let converted = read_clip(&other.join("bvh_data/cmu_12_01_walk.bvh")).unwrap();
        assert!(converted.notices[0].starts_with("dropped frame 0:"), "{:?}", converted.notices);
        let largest = asf.poses.iter().zip(&converted.clip.poses).flat_map(|(a, b)| {
            assert!((a.root - b.root).norm() < 0.002);
            [Joint::LHip, Joint::RKnee, Joint::LAnkle, Joint::Vl5, Joint::LShoulder, Joint::RElbow, Joint::Skullbase]
                .map(|j| a.joint(j).angle_to(b.joint(j)).to_degrees())
        });
        let largest = largest.fold(0.0, f64::max);
        println!("12_01, ASF/AMC against BVH: largest joint difference {largest:.3} degrees");
        assert!(largest < 0.2, "{largest}");
        let daz = read_clip(&daz.join("12/12_01.bvh")).unwrap().clip;
        let (knees, elbows) = (difference(&asf, &daz, 4, &KNEES), difference(&asf, &daz, 4, &ELBOWS));
        println!("12_01, ASF/AMC against Daz BVH: knees {knees:.2}, elbows {elbows:.2} degrees");
        assert!(knees < 3.5 && elbows < 0.3, "{knees} {elbows}");
    }

    #[test]
    fn filmed_walkers_agree_with_their_true_joints() {
        let Some(footage) = shared("footage") else { return };
        for session in ["p02_run_lab", "p12_walk_lab", "p35_walk_lab_slow", "p39_walk_digiclops"] {
            let truth = footage.join(session).join("truth");
            let clip = read_clip(&truth.join("motion.bvh")).unwrap().clip;
            let csv = std::fs::read_to_string(truth.join("joints.csv")).unwrap();
            let mut joints: BTreeMap<(usize, String), Vector3<f64>> = BTreeMap::new();
            for row in csv.lines().skip(1).map(|l| l.split(',').collect::<Vec<_>>()) {
                let v = |i: usize| row[i].parse::<f64>().unwrap();
                joints.insert((v(0) as usize, row[2].to_string()), Vector3::new(v(3), v(5), -v(4)));
            }
            let (mut hip_offsets, mut knee, mut elbow) = (Vec::new(), 0f64, 0f64);
            for (i, pose) in clip.poses.iter().enumerate() {
                let placed = clip.place(pose);
                let truth = |name: &str| joints[&(i, name.to_string())];
                let angle = |[a, b, c]: [&str; 3]| (truth(a) - truth(b)).angle(&(truth(c) - truth(b))).to_degrees();
                knee = knee.max((angle(["l_hip", "l_knee", "l_ankle"]) - included(&placed, KNEES[0])).abs());
                elbow = elbow.max((angle(["r_shoulder", "r_elbow", "r_wrist"]) - included(&placed, ELBOWS[1])).abs());
                hip_offsets.push(placed.position(Joint::LHip) - truth("l_hip"));
                assert!((placed.position(Joint::RAnkle) - placed.position(Joint::RHip) - truth("r_ankle") + truth("r_hip")).norm() < 2e-4);
            }
            println!("{session}: largest difference from the truth: knee {knee:.4}, elbow {elbow:.4} degrees");
            assert!(knee < 0.02 && elbow < 0.02);
            let vertical = hip_offsets.iter().map(|o| o.y).sum::<f64>() / hip_offsets.len() as f64;
            assert!(vertical.abs() < 0.03, "floor off by {vertical}");
            assert!(hip_offsets.iter().all(|o| o.xz().norm() < 0.012), "{session}");
        }
    }

    #[test]
    fn no_file_of_any_tool_panics_and_people_are_read() {
        let Some(folder) = shared("mocap") else { return };
        let mut failed = Vec::new();
        let bvh = files(&folder, "bvh");
        for path in bvh.iter().chain(&files(&folder, "mot")) {
            match read_clip(path) {
                Ok(read) => {
                    assert!(read.clip.poses.iter().all(|p| p.root.iter().all(|v| v.is_finite())), "{}", path.display());
                    assert!((0.75..1.1).contains(&read.clip.hip_height_m), "{}", path.display());
                }
                Err(error) => failed.push(format!("{error}")),
            }
        }
        println!("{} BVH files, refused:\n{}", bvh.len(), failed.join("\n"));
        let refused = |what: &str| assert!(failed.iter().any(|e| e.contains(what)), "{what}: {failed:?}");
        refused("09_10.bvh: the hips jump by 2.39 m from frame 4");
        refused("rotation_first_root.bvh: no joint found for left hip, left ankle");
        refused("idle1.bvh: the leg measures");
        assert_eq!(failed.len(), 7, "{failed:?}");
    }

    #[test]
    fn kinds_that_cannot_be_read_are_named() {
        let error = read_clip(Path::new("walk.fbx")).map(|_| ()).unwrap_err().to_string();
        assert!(error.starts_with("walk.fbx: not a motion file") && !is_motion_file(Path::new("walk.fbx")));
        let error = read_clip(Path::new("/nowhere/walk.BVH")).map(|_| ()).unwrap_err().to_string();
        assert!(error.starts_with("cannot read /nowhere/walk.BVH"), "{error}");
    }
}
