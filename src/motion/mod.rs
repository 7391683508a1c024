//! Synthesis of a style at a wanted parameter, playback in time, size of the target body.

pub mod playback;

pub use playback::{Length, Synthesis, play, play_cycle, synthesize};
