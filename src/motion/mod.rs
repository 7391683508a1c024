//! Synthesis of a style at a wanted parameter, playback in time, size of the target body.
//!
//! `playback` plays one speed or jump, `gait` holds a person's gait over all speeds, `player` steps through it in real time
//! (starts, stops, walk and run, bends), `profile` makes clips of that, `plant` keeps feet from sliding (`footing`).

pub mod contact;
pub mod footing;
pub mod gait;
pub mod plant;
pub mod playback;
pub mod player;
pub mod profile;

pub use gait::{Change, Gait};
pub use plant::{Planted, plant_feet};
pub use playback::{Length, Synthesis, play, play_cycle, synthesize};
pub use player::{Gaits, Player};
pub use profile::{Course, Profile, ProfileError, Step, Waypoint, follow};

#[cfg(test)]
mod live_tests;
#[cfg(test)]
mod tests;
