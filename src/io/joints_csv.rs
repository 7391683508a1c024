//! `joints.csv`: joint centres over time, `frame,time_s,joint,x_m,y_m,z_m`, in the rig's world.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::write_atomic;
use crate::body::{Joint, NODES};

#[derive(Debug, thiserror::Error)]
pub enum JointsCsvError {
    #[error("cannot write {path}: {error}")]
    Io { path: PathBuf, error: std::io::Error },
    #[error("{path}: {numbers} frame numbers but {positions} frames of positions")]
    Counts { path: PathBuf, numbers: usize, positions: usize },
    #[error("{path}: frame {frame}: position of {joint} is not finite")]
    NotFinite { path: PathBuf, frame: usize, joint: &'static str },
}

/// Joints in the order of the file with their names there.
pub fn columns() -> impl Iterator<Item = (Joint, &'static str)> {
    use Joint::*;
    const NAMED: [(Joint, &str); 15] = [
        (Root, "pelvis"),
        (LHip, "l_hip"),
        (LKnee, "l_knee"),
        (LAnkle, "l_ankle"),
        (RHip, "r_hip"),
        (RKnee, "r_knee"),
        (RAnkle, "r_ankle"),
        (Vt1, "neck"),
        (Skullbase, "head"),
        (LShoulder, "l_shoulder"),
        (LElbow, "l_elbow"),
        (LWrist, "l_wrist"),
        (RShoulder, "r_shoulder"),
        (RElbow, "r_elbow"),
        (RWrist, "r_wrist"),
    ];
    let others = Joint::ALL.into_iter().filter(|j| !NAMED.iter().any(|(named, _)| named == j));
    NAMED.into_iter().chain(others.map(|j| (j, j.name())))
}

/// Writes one row per frame and joint; `frames` are the input's frame numbers with their times in seconds, `positions`
/// index by `joint as usize` in metres.
pub fn write(path: &Path, frames: &[(usize, f64)], positions: &[[Vector3<f64>; NODES]]) -> Result<(), JointsCsvError> {
    if frames.len() != positions.len() {
        return Err(JointsCsvError::Counts { path: path.into(), numbers: frames.len(), positions: positions.len() });
    }
    let mut text = String::from("frame,time_s,joint,x_m,y_m,z_m\n");
    for ((frame, time_s), placed) in frames.iter().zip(positions) {
        for (joint, name) in columns() {
            let x = placed[joint as usize];
            if !x.iter().all(|v| v.is_finite()) {
                return Err(JointsCsvError::NotFinite { path: path.into(), frame: *frame, joint: name });
            }
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{frame},{time_s:.6},{name},{:.5},{:.5},{:.5}", x.x, x.y, x.z);
        }
    }
    write_atomic(path, text.as_bytes()).map_err(|error| JointsCsvError::Io { path: path.into(), error })
}

/// Writes the standard deviations of the positions of [`write`], `frame,time_s,joint,sigma_x_m,sigma_y_m,sigma_z_m`;
/// empty cells where they are not known.
pub fn write_sigmas(path: &Path, frames: &[(usize, f64)], sigmas_m: &[[Vector3<f64>; NODES]]) -> Result<(), JointsCsvError> {
    let mut text = String::from("frame,time_s,joint,sigma_x_m,sigma_y_m,sigma_z_m\n");
    for (t, (frame, time_s)) in frames.iter().enumerate() {
        for (joint, name) in columns() {
            let known = sigmas_m.get(t).map(|s| s[joint as usize]).filter(|s| s.iter().all(|v| v.is_finite()));
            let _ = match known {
                Some(s) => writeln!(text, "{frame},{time_s:.6},{name},{:.5},{:.5},{:.5}", s.x, s.y, s.z),
                None => writeln!(text, "{frame},{time_s:.6},{name},,,"),
            };
        }
    }
    write_atomic(path, text.as_bytes()).map_err(|error| JointsCsvError::Io { path: path.into(), error })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Pose, Shape, place};

    #[test]
    fn every_node_has_one_row_per_frame_in_the_order_of_the_design() {
        let offsets = Shape::template(1.7).offsets();
        let placed = place(&offsets, &Pose::rest(Vector3::new(0.25, 3.0, 0.9))).positions;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("joints.csv");
        write(&path, &[(4, 0.0), (6, 2.0 / 30.0)], &[placed, placed]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let rows: Vec<&str> = text.lines().collect();
        assert_eq!(rows.len(), 1 + 2 * NODES);
        assert_eq!(rows[1], "4,0.000000,pelvis,0.25000,3.00000,0.90000");
        assert!(rows[15].starts_with("4,0.000000,r_wrist,") && rows[16].starts_with("4,0.000000,sacroiliac,"));
        assert!(rows[1 + NODES].starts_with("6,0.066667,pelvis,"));
        let names: std::collections::BTreeSet<_> = columns().map(|(_, name)| name).collect();
        assert_eq!(names.len(), NODES);
    }

    #[test]
    fn what_is_not_finite_is_refused_and_nothing_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("joints.csv");
        let mut placed = [Vector3::zeros(); NODES];
        placed[Joint::LKnee as usize].y = f64::NAN;
        let error = write(&path, &[(3, 0.1)], &[placed]).unwrap_err();
        assert!(error.to_string().ends_with("frame 3: position of l_knee is not finite"), "{error}");
        assert!(write(&path, &[], &[placed]).is_err() && !path.exists());
    }
}
