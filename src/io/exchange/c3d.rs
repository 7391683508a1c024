//! Joint centres as C3D: millimetres, z up, x forward, single precision, Intel byte order.
//!
//! Layout of the C3D user guide: a header of 512 bytes, groups and parameters in blocks of 512 bytes, then x, y, z and the
//! residual (0: as good as it gets) of every point, frame by frame. Frames count from 1. Beyond 65535 frames, the most that the header can
//! say, TRIAL:ACTUAL_END_FIELD holds the number. The crate `c3dio`, which reads such files, writes parameters in the order of a hash
//! table, different from run to run. Checked by reading back with it, and once with ezc3d and Python's c3d.

use std::path::Path;

use super::{ExchangeError, c3d_from_clip, centres_mm, labels};
use crate::body::Clip;

const BLOCK: usize = 512;
/// The parameters start in the second block.
const PARAMETERS: u8 = 2;
const INTEL: u8 = 84;

/// Writes all joint centres.
pub fn write(path: &Path, clip: &Clip) -> Result<(), ExchangeError> {
    super::write(path, &bytes_of(clip))
}

fn bytes_of(clip: &Clip) -> Vec<u8> {
    // The data's first block depends on the parameters' length, not on what they say.
    let blocks = parameters(clip, 0).len() / BLOCK;
    let data_block = usize::from(PARAMETERS) + blocks;
    let mut bytes = header(clip, data_block as u16);
    bytes.extend(parameters(clip, data_block as u16));
    for centres in centres_mm(clip, &c3d_from_clip()) {
        for x in centres {
            bytes.extend([x.x, x.y, x.z, 0.0].iter().flat_map(|v| (*v as f32).to_le_bytes()));
        }
    }
    pad(&mut bytes);
    bytes
}

fn pad(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(BLOCK), 0);
}

fn last_frame(clip: &Clip) -> u16 {
    u16::try_from(clip.poses.len()).unwrap_or(u16::MAX)
}

fn header(clip: &Clip, data_block: u16) -> Vec<u8> {
    let mut bytes = vec![PARAMETERS, 0x50];
    let no_analog = 0u16;
    for word in [labels().len() as u16, no_analog, 1, last_frame(clip), 0] {
        bytes.extend(word.to_le_bytes());
    }
    // A negative scale says that the data are floats.
    bytes.extend((-1f32).to_le_bytes());
    bytes.extend([data_block, no_analog].iter().flat_map(|w| w.to_le_bytes()));
    bytes.extend((clip.fps as f32).to_le_bytes());
    pad(&mut bytes);
    bytes
}

/// What a parameter holds.
enum Value<'a> {
    Words(&'a [u16]),
    Word(u16),
    Float(f32),
    Text(&'a str),
    Texts(&'a [&'a str]),
}

fn parameters(clip: &Clip, data_block: u16) -> Vec<u8> {
    use Value::*;
    let (labels, count) = (labels(), clip.poses.len() as u32);
    let end = [count as u16, (count >> 16) as u16];
    let groups: [(&str, &[(&str, Value)]); 5] = [
        (
            "POINT",
            &[
                ("USED", Word(labels.len() as u16)),
                ("FRAMES", Word(last_frame(clip))),
                ("DATA_START", Word(data_block)),
                ("SCALE", Float(-1.0)),
                ("RATE", Float(clip.fps as f32)),
                ("UNITS", Text("mm")),
                ("X_SCREEN", Text("+X")),
                ("Y_SCREEN", Text("+Z")),
                ("LABELS", Texts(&labels)),
                ("DESCRIPTIONS", Texts(&labels)),
            ],
        ),
        ("ANALOG", &[("USED", Word(0)), ("GEN_SCALE", Float(1.0)), ("RATE", Float(0.0))]),
        ("FORCE_PLATFORM", &[("USED", Word(0))]),
        ("TRIAL", &[("ACTUAL_START_FIELD", Words(&[1, 0])), ("ACTUAL_END_FIELD", Words(&end)), ("CAMERA_RATE", Float(clip.fps as f32))]),
        ("MANUFACTURER", &[("SOFTWARE", Text("muybridge")), ("VERSION_LABEL", Text(env!("CARGO_PKG_VERSION")))]),
    ];
    let mut bytes = vec![1, 0x50, 0, INTEL];
    for (id, (group, members)) in (1u8..).zip(groups) {
        named(&mut bytes, group, id.wrapping_neg(), &[]);
        for (name, value) in members {
            named(&mut bytes, name, id, &encoded(value));
        }
    }
    // An empty name ends the list.
    bytes.push(0);
    pad(&mut bytes);
    bytes[2] = (bytes.len() / BLOCK) as u8;
    bytes
}

/// A group or parameter: lengths, number of the group (negative for the group itself), name, way to the next, content, and no description.
fn named(bytes: &mut Vec<u8>, name: &str, group: u8, content: &[u8]) {
    bytes.extend([name.len() as u8, group]);
    bytes.extend(name.as_bytes());
    bytes.extend((2 + content.len() as u16 + 1).to_le_bytes());
    bytes.extend(content);
    bytes.push(0);
}

/// Type (bytes per element, −1 for text), dimensions, elements.
fn encoded(value: &Value) -> Vec<u8> {
    const TEXT: u8 = (-1i8) as u8;
    match value {
        Value::Word(word) => [&[2, 0][..], &word.to_le_bytes()].concat(),
        Value::Words(words) => [2, 1, words.len() as u8].into_iter().chain(words.iter().flat_map(|w| w.to_le_bytes())).collect(),
        Value::Float(float) => [&[4, 0][..], &float.to_le_bytes()].concat(),
        Value::Text(text) => [&[TEXT, 1, text.len() as u8][..], text.as_bytes()].concat(),
        Value::Texts(texts) => {
            let width = texts.iter().map(|t| t.len()).max().unwrap_or(0);
            let rows: String = texts.iter().map(|t| format!("{t:width$}")).collect();
            [&[TEXT, 2, width as u8, texts.len() as u8][..], rows.as_bytes()].concat()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Joint;
    use crate::io::exchange::mot::tests::walk;
    use nalgebra::Vector3;

    #[test]
    fn another_reader_finds_rate_units_labels_and_joint_centres() {
        let clip = walk();
        let bytes = bytes_of(&clip);
        let read = c3dio::C3d::from_bytes(&bytes).unwrap();
        assert_eq!((read.points.frame_rate, read.points.first_frame, read.points.last_frame), (60.0, 1, 90));
        assert_eq!(read.points.units.iter().collect::<String>().trim(), "mm");
        let column = read.points.labels.iter().position(|l| l.trim() == "r_ankle").unwrap();
        assert_eq!((read.points.labels.len(), read.points.points.rows(), read.points.points.cols()), (27, 90, 27));
        for (k, pose) in clip.poses.iter().enumerate() {
            let marker = &read.points.points[(k, column)];
            let [x, y, z] = marker.point.map(|v| f64::from(v) / 1e3);
            assert!((Vector3::new(y, z, x) - clip.place(pose).position(Joint::RAnkle)).norm() < 1e-6 && marker.residual == 0.0);
        }
        assert!(bytes == bytes_of(&clip) && bytes.len().is_multiple_of(BLOCK));
    }

    #[test]
    fn long_recordings_say_their_length_elsewhere() {
        let mut clip = walk();
        clip.poses = vec![clip.poses[0].clone(); 70_000];
        let bytes = bytes_of(&clip);
        assert_eq!(&bytes[8..10], &[255, 255]);
        let name = b"ACTUAL_END_FIELD";
        let at = bytes.windows(name.len()).position(|w| w == name).unwrap() + name.len() + 5;
        let words = [0, 2].map(|k| u32::from(u16::from_le_bytes([bytes[at + k], bytes[at + k + 1]])));
        assert_eq!(words[0] + (words[1] << 16), 70_000);
    }
}
