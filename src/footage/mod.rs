//! Simultaneous images with times, synchronization check, foreground.

pub mod board;
pub mod check;
pub mod corner;
pub mod epipolar;
pub mod foreground;
pub mod misfit;
pub mod pattern;
pub mod person;
pub mod reduce;
pub mod regions;
pub mod synchrony;

pub use foreground::{ForegroundOptions, foreground, spread, stage_from_frames};

use image::GrayImage;

/// What all cameras saw at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameSet {
    /// The number in the file names, or the position in the videos from 0.
    pub number: usize,
    /// Time since the first frame; dropped frames count.
    pub time_s: f64,
    /// One picture per camera, in the rig's order and of the rig's sizes.
    pub images: Vec<GrayImage>,
}
