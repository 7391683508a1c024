//! Video files through OpenCV's videoio, grey, one frame after the other.
//!
//! Frame counts in file headers can be estimates, so [`count_frames`] decodes; a file that promises more than it holds
//! was cut off. Checked against videos written by OpenCV and cut by hand.

use image::{GrayImage, RgbImage};
use opencv::core::Mat;
use opencv::prelude::*;
use opencv::{imgproc, videoio};
use std::path::{Path, PathBuf};

/// Why a video cannot be used; every message names the file.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    #[error("{}: cannot be opened as a video; is it whole, and can OpenCV play it", path.display())]
    Open { path: PathBuf },
    #[error("{}: frame {frame} cannot be decoded: {message}", path.display())]
    Decode { path: PathBuf, frame: usize, message: String },
}

/// Whether the file name says video.
pub fn is_video_name(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    ["mp4", "avi", "mov", "mkv", "m4v", "mpg", "mpeg", "webm"].contains(&extension.as_str())
}

/// What the header of a video promises, and what it holds.
#[derive(Clone, Debug, PartialEq)]
pub struct VideoFacts {
    pub size_px: [u32; 2],
    /// `None` where the file does not say.
    pub fps: Option<f64>,
    /// Number of frames by the header; 0 where the file does not say.
    pub promised: usize,
    /// Number of frames that decode.
    pub decoded: usize,
    /// Their time stamps, seconds; empty where the file has none that grow.
    pub times_s: Vec<f64>,
}

/// Opens a video, decodes it to its end and counts.
pub fn count_frames(path: &Path) -> Result<VideoFacts, VideoError> {
    let mut video = Video::open(path)?;
    let property = |id| video.capture.get(id).unwrap_or(0.0);
    let size_px = [property(videoio::CAP_PROP_FRAME_WIDTH) as u32, property(videoio::CAP_PROP_FRAME_HEIGHT) as u32];
    let fps = Some(property(videoio::CAP_PROP_FPS)).filter(|f| (1.0..=10_000.0).contains(f));
    let promised = property(videoio::CAP_PROP_FRAME_COUNT).max(0.0) as usize;
    let mut times_s = Vec::new();
    while video.capture.grab().unwrap_or(false) {
        times_s.push(video.capture.get(videoio::CAP_PROP_POS_MSEC).unwrap_or(0.0) / 1e3);
    }
    let decoded = times_s.len();
    if times_s.windows(2).any(|pair| !pair[0].is_finite() || pair[1] <= pair[0]) {
        times_s.clear();
    }
    Ok(VideoFacts { size_px, fps, promised, decoded, times_s })
}

/// Number of frames by the header; `None` where it does not say or cannot be read.
pub fn promised_frames(path: &Path) -> Option<usize> {
    let count = Video::open(path).ok()?.capture.get(videoio::CAP_PROP_FRAME_COUNT).ok()?;
    (count > 0.0).then_some(count as usize)
}

/// A video being read.
pub struct Video {
    path: PathBuf,
    capture: videoio::VideoCapture,
    next: usize,
}

impl Video {
    pub fn open(path: &Path) -> Result<Video, VideoError> {
        let failed = || VideoError::Open { path: path.into() };
        let capture = videoio::VideoCapture::from_file(path, videoio::CAP_ANY).map_err(|_| failed())?;
        if capture.is_opened().unwrap_or(false) { Ok(Video { path: path.into(), capture, next: 0 }) } else { Err(failed()) }
    }

    /// The next frame; `None` at the end.
    pub fn read_grey(&mut self) -> Result<Option<GrayImage>, VideoError> {
        self.read(grey)
    }

    /// The next frame in colour; `None` at the end.
    pub fn read_rgb(&mut self) -> Result<Option<RgbImage>, VideoError> {
        self.read(rgb)
    }

    fn read<T>(&mut self, convert: fn(&Mat) -> opencv::Result<T>) -> Result<Option<T>, VideoError> {
        let frame = self.next;
        self.next += 1;
        let failed = |message: String| VideoError::Decode { path: self.path.clone(), frame, message };
        let mut picture = Mat::default();
        if !self.capture.read(&mut picture).map_err(|e| failed(e.message))? || picture.empty() {
            return Ok(None);
        }
        convert(&picture).map_err(|e| failed(e.message)).map(Some)
    }
}

fn rgb(picture: &Mat) -> opencv::Result<RgbImage> {
    let mut rgb = Mat::default();
    let code = match picture.channels() {
        1 => imgproc::COLOR_GRAY2RGB,
        4 => imgproc::COLOR_BGRA2RGB,
        _ => imgproc::COLOR_BGR2RGB,
    };
    imgproc::cvt_color_def(picture, &mut rgb, code)?;
    RgbImage::from_raw(rgb.cols() as u32, rgb.rows() as u32, rgb.data_bytes()?.to_vec())
        .ok_or_else(|| opencv::Error::new(opencv::core::StsUnmatchedFormats, "not 8 bits per channel"))
}

fn grey(picture: &Mat) -> opencv::Result<GrayImage> {
    let mut grey = Mat::default();
    match picture.channels() {
        1 => picture.copy_to(&mut grey)?,
        4 => imgproc::cvt_color_def(picture, &mut grey, imgproc::COLOR_BGRA2GRAY)?,
        _ => imgproc::cvt_color_def(picture, &mut grey, imgproc::COLOR_BGR2GRAY)?,
    }
    let bytes = grey.data_bytes()?.to_vec();
    GrayImage::from_raw(grey.cols() as u32, grey.rows() as u32, bytes)
        .ok_or_else(|| opencv::Error::new(opencv::core::StsUnmatchedFormats, "not 8 bits per channel"))
}
