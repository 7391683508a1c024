//! Motion models: cycles cut from clips, the database, PCA by motion parameter (speed or jump length).

pub mod cycle;
pub mod model;
pub mod synthetic;

pub use cycle::{Activity, Cycle, ROOT_CHANNELS, SAMPLES};
pub use model::{Member, Model};
