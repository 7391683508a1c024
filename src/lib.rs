//! muybridge: video to editable 3D motion.
//!
//! Three synchronized cameras film a person; correlation stereo turns each frame into a point cloud ([`clouds`]); a body
//! of implicit surfaces on a 78-DOF skeleton ([`body`]) is fitted to all clouds at once over root poses, phases and the
//! weights of a PCA motion model ([`fit`], [`motion_model`]). The weights are the person's style ([`style`]); with them the
//! same person walks, runs or jumps at speeds and lengths never filmed ([`motion`]).
//!
//! An animal needs one camera only, and an artist's key poses ([`animal`]).
//!
//! The "style paper" of the modules' texts is R. Urtasun, P. Glardon, R. Boulic, D. Thalmann and P. Fua, "Style-Based Motion
//! Synthesis", Computer Graphics Forum 23(4), 2004.
//!
//! The same person at another speed, from the embedded synthetic database:
//!
//! ```
//! use muybridge::body::Shape;
//! use muybridge::motion::{Length, play, synthesize};
//! use muybridge::motion_model::{Activity, Model, synthetic};
//! use muybridge::style::{Method, Population, Style};
//!
//! let model = Model::build(Activity::Running, true, &synthetic::database(Activity::Running))?;
//! let filmed = [synthetic::subject(Activity::Running, 100).cycle(2.5, 0)];
//! let style = Style::of_cycles(&model, "", &filmed).ok_or("no cycles")?;
//! let population = Population::new(&model, style.weights.len());
//! let faster = synthesize(&model, &population, Method::Default, &style, 3.0, style.hip_height_m)?;
//! let clip = play(&model, &faster, &Shape::template(1.75).offsets(), 60.0, Length::Seconds(2.0));
//! let way = clip.poses[clip.poses.len() - 1].root - clip.poses[0].root;
//! assert!((way.z / 2.0 - 3.0).abs() < 0.1, "three metres per second");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
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

pub mod animal;

pub mod phantom;

pub mod io;

pub mod report;
