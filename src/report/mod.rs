//! Pictures people look at: overlays, depth maps, stick figures, clouds, curves; and the pages that hold them.
//!
//! Left is blue and right is vermilion everywhere (Okabe and Ito's palette, which colour-blind readers tell apart), the
//! middle of the body is neutral. Lengths have the same scale along both axes; axes carry their units.

use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageFormat, RgbImage};

use crate::footage::board::BoardError;
use crate::io::write_atomic;

pub mod animal;
pub mod animal_page;
pub mod board;
pub mod calibration;
pub mod canvas;
pub mod chart;
pub mod clouds;
pub mod clusters;
pub mod curves;
pub mod figures;
pub mod generated;
pub mod maps;
pub mod marks;
pub mod model;
pub mod overlay;
pub mod page;
pub mod person;
#[cfg(feature = "rerun")]
pub mod recording;
pub mod rig;
pub mod strips;
pub mod study;
pub mod style_charts;
pub mod track;
mod track_charts;
pub mod validation;
pub mod view3d;
pub mod walk;

pub use calibration::calibration;
pub use clouds::{CloudDot, cloud_and_body};
pub use clusters::{clusters, database_clusters};
pub use curves::{Curve, curves};
pub use figures::stick_figures;
pub use maps::{depth_map, person_depth};
pub use overlay::{overlay, strip};
pub use rig::rig_views;

#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error("drawing failed: {0}")]
    Draw(#[from] opencv::Error),
    #[error(transparent)]
    Board(#[from] BoardError),
    #[error("cannot encode {path}: {error}")]
    Encode { path: PathBuf, error: image::ImageError },
    #[error("cannot write {path}: {error}")]
    Write { path: PathBuf, error: std::io::Error },
}

/// Writes a picture as PNG.
pub fn save(path: &Path, picture: &RgbImage) -> Result<(), ReportError> {
    let png = png_bytes(path, &DynamicImage::from(picture.clone()))?;
    write_atomic(path, &png).map_err(|error| ReportError::Write { path: path.into(), error })
}

/// Writes a drawing as SVG.
pub fn save_drawing(path: &Path, drawing: &marks::Drawing) -> Result<(), ReportError> {
    write_atomic(path, drawing.svg().as_bytes()).map_err(|error| ReportError::Write { path: path.into(), error })
}

/// The PNG file that `path` is to be.
fn png_bytes(path: &Path, picture: &DynamicImage) -> Result<Vec<u8>, ReportError> {
    let mut png = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut png, ImageFormat::Png).map_err(|error| ReportError::Encode { path: path.into(), error })?;
    Ok(png.into_inner())
}
