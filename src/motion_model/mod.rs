//! Motion models: cycles cut from clips, the database, PCA by motion parameter (speed or jump length).

pub mod cadence;
pub mod cycle;
pub mod database;
pub mod departure;
pub mod gait;
pub mod markers;
pub mod model;
pub mod postures;
pub mod segment;
pub mod synthetic;

pub use cadence::CadenceLaw;
pub use cycle::{Activity, Cycle, ROOT_CHANNELS, RootSample, SAMPLES};
pub use departure::Departure;
pub use gait::{Gait, gait};
pub use model::{Detail, Member, Model, ModelError};
pub use postures::Postures;
pub use segment::{Label, Segments, overground, segment};
