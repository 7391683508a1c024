//! What stereo found in one frame, kept on disk exactly, so that work that was stopped goes on with the same numbers.
//!
//! Little endian: `MBFRAME1`; the cloud (u64 count; per point position 3 f64, colour 3 u8, confidence f64, covariance 9 f64 by
//! columns); masks (u64 count; per mask u8 present or not, picture); disparity and matched (planes); changed (picture);
//! BLAKE3 of all before it. A picture is width, height (u32) and runs of u32 length and u8 value; a plane is width, height and
//! pairs of runs, u32 so many NaN and u32 so many values with the values (f32) behind.

use std::path::Path;

use image::{GrayImage, ImageBuffer};
use nalgebra::{Matrix3, Vector3};

use super::write_atomic;
use crate::clouds::{Cloud, CloudPoint, FrameCloud};
use crate::rig::rectify::Plane;

const MAGIC: &[u8; 8] = b"MBFRAME1";
const POINT_BYTES: usize = 13 * 8 + 3;

/// Writes a frame; the file appears whole or not at all.
pub fn write(path: &Path, frame: &FrameCloud) -> std::io::Result<()> {
    let mut bytes = MAGIC.to_vec();
    put_cloud(&mut bytes, &frame.cloud);
    bytes.extend((frame.masks.len() as u64).to_le_bytes());
    for mask in &frame.masks {
        bytes.push(mask.is_some().into());
        mask.iter().for_each(|m| put_picture(&mut bytes, m));
    }
    put_plane(&mut bytes, &frame.disparity);
    put_plane(&mut bytes, &frame.matched);
    put_picture(&mut bytes, &frame.changed);
    let hash = blake3::hash(&bytes);
    bytes.extend(hash.as_bytes());
    write_atomic(path, &bytes)
}

/// Reads a frame that [`write`] wrote; `None` where there is none, or a damaged one: it is to be made again.
pub fn read(path: &Path) -> Option<FrameCloud> {
    let bytes = std::fs::read(path).ok()?;
    let (body, hash) = bytes.split_last_chunk::<32>()?;
    if blake3::hash(body).as_bytes() != hash {
        return None;
    }
    let mut rest = Bytes(body.strip_prefix(MAGIC)?);
    let cloud = take_cloud(&mut rest)?;
    let masks =
        (0..rest.u64()?).map(|_| Some(if rest.u8()? == 0 { None } else { Some(take_picture(&mut rest)?) })).collect::<Option<_>>()?;
    let (disparity, matched) = (take_plane(&mut rest)?, take_plane(&mut rest)?);
    Some(FrameCloud { cloud, masks, disparity, matched, changed: take_picture(&mut rest)? })
}

/// What is left to read.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, tail) = self.0.split_first_chunk()?;
        self.0 = tail;
        Some(*head)
    }

    fn u8(&mut self) -> Option<u8> {
        self.take::<1>().map(|[byte]| byte)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.take()?);
        }
        Some(values)
    }
}

fn put_cloud(bytes: &mut Vec<u8>, cloud: &Cloud) {
    bytes.extend((cloud.points.len() as u64).to_le_bytes());
    for point in &cloud.points {
        bytes.extend(point.position.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(point.colour);
        bytes.extend(point.confidence.to_le_bytes());
        bytes.extend(point.covariance.iter().flat_map(|v| v.to_le_bytes()));
    }
}

fn take_cloud(rest: &mut Bytes) -> Option<Cloud> {
    let count = usize::try_from(rest.u64()?).ok().filter(|count| *count <= rest.0.len() / POINT_BYTES)?;
    let mut points = Vec::with_capacity(count);
    for _ in 0..count {
        points.push(CloudPoint {
            position: Vector3::from(rest.f64s::<3>()?),
            colour: rest.take()?,
            confidence: rest.f64s::<1>()?[0],
            covariance: Matrix3::from_column_slice(&rest.f64s::<9>()?),
        });
    }
    Some(Cloud { points })
}

fn put_size(bytes: &mut Vec<u8>, width: u32, height: u32) {
    bytes.extend(width.to_le_bytes());
    bytes.extend(height.to_le_bytes());
}

fn put_picture(bytes: &mut Vec<u8>, picture: &GrayImage) {
    put_size(bytes, picture.width(), picture.height());
    for run in picture.as_raw().chunk_by(|a, b| a == b) {
        bytes.extend((run.len() as u32).to_le_bytes());
        bytes.push(run[0]);
    }
}

fn take_picture(rest: &mut Bytes) -> Option<GrayImage> {
    let (width, height) = (rest.u32()?, rest.u32()?);
    let size = width as usize * height as usize;
    let mut pixels = Vec::new();
    while pixels.len() < size {
        let length = rest.u32()? as usize;
        let value = rest.u8()?;
        pixels.resize((pixels.len() + length).min(size), value);
    }
    GrayImage::from_raw(width, height, pixels)
}

/// The one NaN that planes hold where they know nothing; any other value is kept as it is.
fn is_gap(value: f32) -> bool {
    value.to_bits() == f32::NAN.to_bits()
}

fn put_plane(bytes: &mut Vec<u8>, plane: &Plane) {
    put_size(bytes, plane.width(), plane.height());
    let mut values: &[f32] = plane;
    while !values.is_empty() {
        let gap = values.iter().take_while(|v| is_gap(**v)).count();
        let known = values[gap..].iter().take_while(|v| !is_gap(**v)).count();
        put_size(bytes, gap as u32, known as u32);
        bytes.extend(values[gap..gap + known].iter().flat_map(|v| v.to_le_bytes()));
        values = &values[gap + known..];
    }
}

fn take_plane(rest: &mut Bytes) -> Option<Plane> {
    let (width, height) = (rest.u32()?, rest.u32()?);
    let size = width as usize * height as usize;
    let mut values = Vec::new();
    while values.len() < size {
        let (gap, known) = (rest.u32()? as usize, rest.u32()? as usize);
        values.resize((values.len() + gap).min(size), f32::NAN);
        for _ in 0..known {
            values.push(f32::from_le_bytes(rest.take()?));
        }
    }
    ImageBuffer::from_raw(width, height, values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;

    fn frame() -> FrameCloud {
        let point = |i: i32| CloudPoint {
            position: Vector3::new(1.0 / f64::from(i + 3), -0.0, f64::MIN_POSITIVE),
            colour: [i as u8, 128, 255],
            confidence: 0.1 + f64::from(i),
            covariance: Matrix3::from_fn(|r, c| 1.0 / f64::from(i + 1 + (3 * r + c) as i32)),
        };
        let plane = |gap: u32| Plane::from_fn(7, 5, |x, y| Luma([if (x + y) % 4 < gap { f32::NAN } else { 0.1 * (x * y) as f32 }]));
        let mask = GrayImage::from_fn(9, 4, |x, y| Luma([if x > 3 && y > 1 { 255 } else { 0 }]));
        FrameCloud {
            cloud: Cloud { points: (0..4).map(point).collect() },
            masks: vec![Some(mask.clone()), None, Some(GrayImage::new(0, 0))],
            disparity: plane(2),
            matched: plane(0),
            changed: mask,
        }
    }

    fn bits(plane: &Plane) -> Vec<u32> {
        plane.iter().map(|v| v.to_bits()).collect()
    }

    #[test]
    fn comes_back_bit_by_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("work/000003.frame");
        let mut gaps = frame();
        gaps.disparity.iter_mut().for_each(|v| *v = f32::NAN);
        gaps.cloud.points.clear();
        for frame in [frame(), gaps] {
            write(&path, &frame).unwrap();
            let back = read(&path).unwrap();
            assert_eq!((&back.cloud, &back.masks, &back.changed), (&frame.cloud, &frame.masks, &frame.changed));
            assert!(back.cloud.points.iter().all(|p| p.position.y.is_sign_negative()));
            assert_eq!((bits(&back.disparity), bits(&back.matched)), (bits(&frame.disparity), bits(&frame.matched)));
        }
    }

    #[test]
    fn damage_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.frame");
        assert!(read(&path).is_none());
        write(&path, &frame()).unwrap();
        let good = std::fs::read(&path).unwrap();
        for at in (0..good.len()).step_by(7) {
            std::fs::write(&path, &good[..at]).unwrap();
            assert!(read(&path).is_none(), "cut at {at}");
            let mut other = good.clone();
            other[at] ^= 4;
            std::fs::write(&path, &other).unwrap();
            assert!(read(&path).is_none(), "byte {at}");
        }
        // A count that no hash protects: still no memory for what is not there.
        let mut lying = MAGIC.to_vec();
        lying.extend(u64::MAX.to_le_bytes());
        let hash = blake3::hash(&lying);
        lying.extend(hash.as_bytes());
        std::fs::write(&path, &lying).unwrap();
        assert!(read(&path).is_none());
    }
}
