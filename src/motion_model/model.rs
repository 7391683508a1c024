//! PCA model of a motion database (style paper §3, equations 1 to 3).
//!
//! Ψ ≈ Θ0 + Σ α_i Θ_i over the 7800 joint coordinates; the root channels ride on the same weights by least squares.

use nalgebra::{DMatrix, DVector, UnitQuaternion};

use super::cycle::Activity;
use crate::body::BALL_JOINTS;

/// A cycle as it stands in the database.
#[derive(Clone, Debug)]
pub struct Member {
    pub subject: String,
    pub source: String,
    /// Speed in m/s, for jumps the length in m.
    pub parameter: f64,
    pub hip_height_m: f64,
    pub duration_s: f64,
    /// Angular motion vector Ψ: log(mean_rotation⁻¹ · joint), length SAMPLES·DOF, index `(sample·26 + joint−1)·3 + axis`.
    pub vector: DVector<f64>,
    /// Root channels, length SAMPLES·ROOT_CHANNELS, index `sample·6 + channel`: rotation x y z, position x y z.
    pub root: DVector<f64>,
}

/// Mean, principal components and members of one activity's database.
#[derive(Clone, Debug)]
pub struct Model {
    pub activity: Activity,
    /// True for the embedded synthetic database.
    pub synthetic: bool,
    /// Mean rotation of every ball joint over all samples of all members; Ψ is relative to it.
    pub mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
    /// Θ0, length SAMPLES·DOF.
    pub mean: DVector<f64>,
    /// Θ_i as orthonormal columns.
    pub basis: DMatrix<f64>,
    /// λ_i of all components, largest first, also of those not kept in `basis`: variances of the α_i.
    pub eigenvalues: Vec<f64>,
    /// Mean root channels, length SAMPLES·ROOT_CHANNELS.
    pub root_mean: DVector<f64>,
    /// Change of the root channels per unit of α_i, one column each.
    pub root_basis: DMatrix<f64>,
    pub members: Vec<Member>,
}
