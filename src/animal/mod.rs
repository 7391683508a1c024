//! Animal gaits from one video: silhouettes, their principal components, key images, and the animation of an artist's
//! key poses in the clip's rhythm.
//!
//! The "animal paper" is L. Favreau, L. Reveret, C. Depraz and M.-P. Cani, "Animal gaits from video", Symposium on Computer
//! Animation 2004.

pub mod ambiguity;
pub mod analysis;
pub mod blend;
pub mod change;
pub mod creature;
pub mod eigen;
pub mod field;
pub mod horse;
pub mod keys;
pub mod masks;
pub mod mixture;
pub mod path;
pub mod region;
pub mod render;
pub mod rhythm;
pub mod study;
pub mod switching;
