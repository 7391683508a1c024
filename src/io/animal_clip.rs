//! Clips in colour and masks: videos, folders of pictures, folders of binary PNGs.
//!
//! Files sort naturally (`2.png` before `10.png`). A mask pixel is on where it is brighter than 127 and, in a layer with
//! transparency, opaque by more than half. Checked by reading back, and against OpenCV's decoding.

use std::path::{Path, PathBuf};

use image::{DynamicImage, GrayImage, Luma, RgbImage, imageops};

use super::images::{ImageError, is_image_name, read_any};
use super::video::{Video, VideoError, count_frames, is_video_name};
use super::write_atomic;

#[derive(Debug, thiserror::Error)]
pub enum ClipError {
    #[error("cannot read {path}: {cause}")]
    Folder { path: PathBuf, cause: std::io::Error },
    #[error("{path} is neither a video nor a folder of PNG or JPEG pictures")]
    Kind { path: PathBuf },
    #[error("{path} holds no PNG or JPEG picture")]
    Empty { path: PathBuf },
    #[error("frames {from} to {to} are asked of {path}, which has frames 0 to {last}")]
    Range { path: PathBuf, from: usize, to: usize, last: usize },
    #[error("{path} has {found:?} pixels where the first frame has {wanted:?}; bring all frames to one size")]
    Size { path: PathBuf, found: (u32, u32), wanted: (u32, u32) },
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Video(#[from] VideoError),
    #[error("cannot write {path}: {cause}")]
    Write { path: PathBuf, cause: std::io::Error },
}

/// A clip in memory.
pub struct ColourClip {
    pub frames: Vec<RgbImage>,
    /// The video's own, where it says.
    pub fps: Option<f64>,
    /// One sentence each.
    pub notices: Vec<String>,
}

/// Pictures of a folder in natural order.
pub fn pictures(folder: &Path) -> Result<Vec<PathBuf>, ClipError> {
    let entries = folder.read_dir().map_err(|cause| ClipError::Folder { path: folder.into(), cause })?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| p.is_file() && is_image_name(p)).collect();
    let name = |p: &Path| p.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    paths.sort_by(|a, b| natord::compare(&name(a), &name(b)).then_with(|| a.cmp(b)));
    if paths.is_empty() { Err(ClipError::Empty { path: folder.into() }) } else { Ok(paths) }
}

/// Frames of a video or of a folder of pictures; `range` keeps frames from the first to the second, both inclusive.
pub fn read_clip(path: &Path, range: Option<(usize, usize)>) -> Result<ColourClip, ClipError> {
    let (mut frames, fps) = if path.is_dir() {
        let files = cut(path, pictures(path)?, range)?;
        (files.iter().map(|f| Ok(read_any(f)?.into_rgb8())).collect::<Result<Vec<_>, ClipError>>()?, None)
    } else if is_video_name(path) {
        let mut video = Video::open(path)?;
        let mut frames = Vec::new();
        while let Some(frame) = video.read_rgb()? {
            frames.push(frame);
        }
        (cut(path, frames, range)?, count_frames(path)?.fps)
    } else {
        return Err(ClipError::Kind { path: path.into() });
    };
    let mut notices = Vec::new();
    let wanted = frames.first().map_or((0, 0), |f| f.dimensions());
    let near = |a: u32, b: u32| a.abs_diff(b) * 10 <= b;
    for (i, frame) in frames.iter_mut().enumerate() {
        let found = frame.dimensions();
        if found == wanted {
            continue;
        }
        // Scans of plates differ by a few pixels.
        if !near(found.0, wanted.0) || !near(found.1, wanted.1) {
            return Err(ClipError::Size { path: path.join(format!("(frame {i})")), found, wanted });
        }
        *frame = imageops::resize(frame, wanted.0, wanted.1, imageops::FilterType::Triangle);
        notices.push(format!("frame {i} was scaled from {}x{} to the first one's {}x{}", found.0, found.1, wanted.0, wanted.1));
    }
    Ok(ColourClip { frames, fps, notices })
}

fn cut<T>(path: &Path, mut list: Vec<T>, range: Option<(usize, usize)>) -> Result<Vec<T>, ClipError> {
    if list.is_empty() {
        return Err(ClipError::Empty { path: path.into() });
    }
    let Some((from, to)) = range else { return Ok(list) };
    if from > to || to >= list.len() {
        return Err(ClipError::Range { path: path.into(), from, to, last: list.len() - 1 });
    }
    list.truncate(to + 1);
    Ok(list.split_off(from))
}

/// Binary images of a folder, all of one size, 0 or 255.
pub fn read_masks(folder: &Path, range: Option<(usize, usize)>) -> Result<Vec<GrayImage>, ClipError> {
    let files = cut(folder, pictures(folder)?, range)?;
    let masks = files.iter().map(|f| Ok(binary(&read_any(f)?))).collect::<Result<Vec<_>, ClipError>>()?;
    let wanted = masks[0].dimensions();
    match masks.iter().zip(&files).find(|(m, _)| m.dimensions() != wanted) {
        Some((mask, path)) => Err(ClipError::Size { path: path.clone(), found: mask.dimensions(), wanted }),
        None => Ok(masks),
    }
}

fn binary(picture: &DynamicImage) -> GrayImage {
    let layer = picture.to_luma_alpha8();
    GrayImage::from_fn(layer.width(), layer.height(), |x, y| {
        let [bright, opaque] = layer.get_pixel(x, y).0;
        Luma([if bright > 127 && opaque > 127 { 255 } else { 0 }])
    })
}

/// Writes `FOLDER/000000.png` …
pub fn write_masks(folder: &Path, masks: &[GrayImage]) -> Result<(), ClipError> {
    for (i, mask) in masks.iter().enumerate() {
        write_mask(&folder.join(format!("{i:06}.png")), mask)?;
    }
    Ok(())
}

pub fn write_mask(path: &Path, mask: &GrayImage) -> Result<(), ClipError> {
    let failed = |cause| ClipError::Write { path: path.into(), cause };
    let mut png = std::io::Cursor::new(Vec::new());
    mask.write_to(&mut png, image::ImageFormat::Png).map_err(|e| failed(std::io::Error::other(e)))?;
    write_atomic(path, png.get_ref()).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn folders_sort_naturally_and_ranges_cut() {
        let folder = tempfile::tempdir().unwrap();
        for i in [2u8, 10, 1] {
            RgbImage::from_pixel(20 + u32::from(i == 10), 10, Rgb([i; 3])).save(folder.path().join(format!("{i}.png"))).unwrap();
        }
        std::fs::write(folder.path().join("README.md"), "words").unwrap();
        let clip = read_clip(folder.path(), None).unwrap();
        assert_eq!(clip.frames.iter().map(|f| f.get_pixel(3, 3)[0]).collect::<Vec<_>>(), [1, 2, 10]);
        assert!(clip.notices.len() == 1 && clip.notices[0].starts_with("frame 2 was scaled from 21x10"));
        let last = read_clip(folder.path(), Some((1, 2))).unwrap();
        assert_eq!((last.frames.len(), last.frames[0].get_pixel(0, 0)[0]), (2, 2));
        assert!(read_clip(folder.path(), Some((1, 3))).err().unwrap().to_string().contains("which has frames 0 to 2"));
        assert!(matches!(read_clip(&folder.path().join("README.md"), None), Err(ClipError::Kind { .. })));
    }

    #[test]
    fn masks_come_back_and_layers_are_read_by_their_opacity() {
        let folder = tempfile::tempdir().unwrap();
        let mask = GrayImage::from_fn(9, 7, |x, y| Luma([if x > y { 255 } else { 0 }]));
        write_masks(folder.path(), &[mask.clone(), mask.clone()]).unwrap();
        assert!(read_masks(folder.path(), None).unwrap() == [mask.clone(), mask]);
        let layer = image::RgbaImage::from_fn(9, 7, |x, _| image::Rgba([255, 255, 255, if x < 4 { 255 } else { 0 }]));
        layer.save(folder.path().join("000001.png")).unwrap();
        let read = read_masks(folder.path(), Some((1, 1))).unwrap();
        assert_eq!((read[0].get_pixel(3, 0)[0], read[0].get_pixel(4, 0)[0]), (255, 0));
    }
}
