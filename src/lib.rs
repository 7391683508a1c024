//! muybridge: video to editable 3D motion.
//!
//! Three synchronized cameras film a person; correlation stereo turns each frame into a point cloud ([`clouds`]); a body
//! of implicit surfaces on a 78-DOF skeleton ([`body`]) is fitted to all clouds at once over root poses, phases and the
//! weights of a PCA motion model ([`fit`], [`motion_model`]). The weights are the person's style ([`style`]); with them the
//! same person walks, runs or jumps at speeds and lengths never filmed ([`motion`]).
//!
//! The "style paper" of the modules' texts is R. Urtasun, P. Glardon, R. Boulic, D. Thalmann and P. Fua, "Style-Based Motion
//! Synthesis", Computer Graphics Forum 23(4), 2004.
//!
//! # Conventions
//!
//! - SI units and radians inside; any other unit is a suffix (`focal_px`, `angle_deg`). `io` converts.
//! - Cameras: x right, y down, z forward, integer pixel = pixel centre (OpenCV).
//!   `x_in_camera = camera_from_world * x_in_world`.
//! - World: the calibration's own, right-handed, metres; its up axis is the rig file's (`z` unless it says `y`).
//! - Body frame: x to the person's left, y up, z forward (H-Anim, glTF). Motion clips and models live in a y-up world.
//! - Names say frames: `target_from_source`, `x_in_frame`. Rotations act on column vectors; a joint's rotation is
//!   `parent_from_joint`. At rest (arms hanging, palms in) every joint frame is parallel to the body frame.
//! - Phase 0 of a walking or running cycle is the right heel strike; the left one follows near 0.5.

pub mod math;

pub mod rig;

pub mod body;

pub mod motion_model;

pub mod footage;

pub mod clouds;

pub mod fit;

pub mod style;

pub mod motion;

pub mod phantom;

pub mod io;

pub mod report;
