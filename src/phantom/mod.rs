//! A known body and stage before a known rig, ray-cast to images: truth for tests and for the demo.

pub mod figure;
pub mod noise;
pub mod scene;
pub mod sighting;
pub mod stage;
pub mod staging;
pub mod truth;

pub use figure::Figure;
pub use scene::{DepthMap, Scene, View, depth, mask, render, render_stage, silhouette};
pub use sighting::{SightOptions, SightedPoint};
pub use stage::Stage;
pub use truth::{JointErrors, distance_to_skin, joint_errors};
