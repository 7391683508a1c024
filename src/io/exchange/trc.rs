//! Joint centres as TRC, the track-row-column files of OpenSim: millimetres, y up, x forward.
//!
//! Checked by reading back, here by the plain rules of the format and once with other readers.

use std::fmt::Write;
use std::path::Path;

use super::{ExchangeError, centres_mm, labels, opensim_from_clip};
use crate::body::Clip;

/// Writes all joint centres, frames from 1, time from 0.
pub fn write(path: &Path, clip: &Clip) -> Result<(), ExchangeError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    super::write(path, text_of(clip, &name).as_bytes())
}

fn text_of(clip: &Clip, name: &str) -> String {
    let (labels, frames, fps) = (labels(), clip.poses.len(), clip.fps);
    let mut text = format!("PathFileType\t4\t(X/Y/Z)\t{name}\n");
    text += "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n";
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{fps}\t{fps}\t{frames}\t{}\tmm\t{fps}\t1\t{frames}", labels.len());
    let _ = writeln!(text, "Frame#\tTime\t{}\t\t", labels.join("\t\t\t"));
    let axes: Vec<String> = (1..=labels.len()).map(|k| format!("X{k}\tY{k}\tZ{k}")).collect();
    let _ = writeln!(text, "\t\t{}\n", axes.join("\t"));
    for (k, centres) in centres_mm(clip, &opensim_from_clip()).enumerate() {
        let _ = write!(text, "{}\t{:.6}", k + 1, k as f64 / fps);
        for x in centres {
            let _ = write!(text, "\t{:.4}\t{:.4}\t{:.4}", x.x, x.y, x.z);
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Joint;
    use crate::io::exchange::mot::tests::walk;

    #[test]
    fn joint_centres_read_back_in_opensims_axes() {
        let clip = walk();
        let text = text_of(&clip, "joints.trc");
        let lines: Vec<&str> = text.lines().collect();
        let cells = |line: usize| lines[line].split('\t').collect::<Vec<_>>();
        assert_eq!((cells(0)[3], cells(2)[2], cells(2)[3], cells(2)[4]), ("joints.trc", "90", "27", "mm"));
        assert_eq!((lines.len(), lines[5]), (6 + clip.poses.len(), ""));
        let knee = cells(3).iter().position(|c| *c == "l_knee").unwrap();
        assert_eq!((cells(3).len(), cells(4).len(), cells(4)[knee]), (2 + 81, 2 + 81, "X3"));
        for (k, pose) in clip.poses.iter().enumerate() {
            let row = cells(6 + k);
            let value = |c: usize| row[c].parse::<f64>().unwrap();
            assert!(row.len() == 83 && value(0) == (k + 1) as f64 && (value(1) - k as f64 / clip.fps).abs() < 1e-6);
            let x = clip.place(pose).position(Joint::LKnee);
            // Forward is x, the left side has negative z.
            for (column, expected) in [(knee, x.z), (knee + 1, x.y), (knee + 2, -x.x)] {
                assert!((value(column) / 1e3 - expected).abs() < 1e-7, "frame {k}");
            }
        }
    }
}
