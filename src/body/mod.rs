//! The body: skeleton of 26 ball joints (78 DOF), pose and forward kinematics, shape, implicit surface, motion clip.

pub mod clip;
pub mod mesh;
pub mod pose;
pub mod shape;
pub mod skeleton;
pub mod surface;

pub use clip::Clip;
pub use pose::{Placement, Pose, place};
pub use shape::{Length, Shape};
pub use skeleton::{BALL_JOINTS, DOF, Joint, NODES};
pub use surface::{PosedSurface, Surface};
