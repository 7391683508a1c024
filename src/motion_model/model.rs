//! PCA model of a motion database (style paper §3, equations 1 to 5).
//!
//!   Ψ ≈ Θ0 + Σ α_i Θ_i   (2),   α_i = (Ψ − Θ0)·Θ_i   (5)
//! over the 7800 joint coordinates, rotation vectors about each joint's mean rotation. Root channels r ride on the same
//! weights: their loadings are the least-squares ones, and as the α of the database are orthogonal,
//!   ρ_i = Σ_m α_i^m (r^m − r̄) / (M λ_i).                                                                          (6)
//! Departure: the paper does not say how rotations become numbers; vectors about the mean stay far from the wrap at π.
//! Checked against exact reconstruction with all components, the normal equations of (6), and numpy on the stored vectors.

use nalgebra::{DMatrix, DVector, Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::cadence::CadenceLaw;
use super::cycle::{Activity, Cycle, ROOT_CHANNELS, RootSample, SAMPLES, neighbours};
use crate::body::{BALL_JOINTS, DOF};
use crate::math::pca::{self, Pca};
use crate::math::rotation::{exp, log, mean};

/// Part of the variance that the stored basis holds.
pub const STORED_VARIANCE: f64 = 0.99;

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

/// What of a cycle the weights of a model do not hold, as vectors of [`Member::vector`] and [`Member::root`].
#[derive(Clone, Debug, PartialEq)]
pub struct Detail {
    pub vector: DVector<f64>,
    pub root: DVector<f64>,
}

impl Detail {
    /// Weighted sum; `None` of nothing.
    pub fn sum<'a>(parts: impl Iterator<Item = (&'a Detail, f64)>) -> Option<Detail> {
        parts.fold(None, |sum: Option<Detail>, (part, weight)| {
            let mut sum =
                sum.unwrap_or_else(|| Detail { vector: DVector::zeros(part.vector.len()), root: DVector::zeros(part.root.len()) });
            sum.vector.axpy(weight, &part.vector, 1.0);
            sum.root.axpy(weight, &part.root, 1.0);
            Some(sum)
        })
    }
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

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum ModelError {
    #[error("a model needs at least two cycles, the database has {0}")]
    TooFew(usize),
    #[error("{origin} has {found} samples, a cycle has {SAMPLES}")]
    Samples { origin: String, found: usize },
    #[error("{origin} is {found}, the model is for {wanted}")]
    Activity { origin: String, found: Activity, wanted: Activity },
    #[error("all cycles of the database are equal, there is nothing to model")]
    NoVariance,
    #[error("the model holds {origin} already; leave it out")]
    Twice { origin: String },
}

impl Model {
    /// PCA of a database of one activity; the basis keeps [`STORED_VARIANCE`].
    pub fn build(activity: Activity, synthetic: bool, cycles: &[Cycle]) -> Result<Model, ModelError> {
        check(activity, cycles)?;
        let mean_rotations = mean_rotations(cycles);
        let members: Vec<Member> = cycles.par_iter().map(|c| member(&mean_rotations, c)).collect();
        Model::from_members(activity, synthetic, mean_rotations, members)
    }

    /// PCA of members whose vectors are already relative to `mean_rotations`.
    pub fn from_members(
        activity: Activity,
        synthetic: bool,
        mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
        members: Vec<Member>,
    ) -> Result<Model, ModelError> {
        if members.len() < 2 {
            return Err(ModelError::TooFew(members.len()));
        }
        let mut centred = columns(&members, |m| &m.vector);
        let Pca { mean, basis, eigenvalues } = pca::leading(&mut centred, STORED_VARIANCE);
        if basis.is_empty() {
            return Err(ModelError::NoVariance);
        }
        let roots = columns(&members, |m| &m.root);
        let root_mean = roots.column_mean();
        // A product with a transposed copy runs in blocks, `tr_mul` does not.
        let weights = basis.transpose() * centred;
        let root_basis = root_loadings(&roots, &root_mean, &weights);
        Ok(Model { activity, synthetic, mean_rotations, mean, basis, eigenvalues, root_mean, root_basis, members })
    }

    /// The model of these cycles too, as if built of all: the members' own cycles are kept in it, no recording is read again.
    pub fn with(&self, cycles: &[Cycle]) -> Result<Model, ModelError> {
        let old = self.members.iter().map(|m| self.cycle_of(m));
        for cycle in cycles {
            let same = |m: &Member| m.subject == cycle.subject && m.source == cycle.source && m.parameter == cycle.parameter;
            if self.members.iter().any(same) {
                return Err(ModelError::Twice { origin: format!("{} ({})", cycle.source, cycle.subject) });
            }
        }
        Model::build(self.activity, self.synthetic, &old.chain(cycles.iter().cloned()).collect::<Vec<_>>())
    }

    /// Number of components that hold `variance` (0 to 1) of the database, at most those stored, at least one.
    pub fn components(&self, variance: f64) -> usize {
        pca::components(&self.eigenvalues, variance).clamp(1, self.basis.ncols())
    }

    /// Part of the variance that the first m components hold, σ(m) of equation (3), for m = 1, 2, …
    pub fn explained(&self) -> Vec<f64> {
        let total: f64 = self.eigenvalues.iter().sum();
        let running = self.eigenvalues.iter().scan(0.0, |sum, l| {
            *sum += l;
            Some(*sum / total)
        });
        running.collect()
    }

    /// The model with the first `count` components only.
    pub fn truncated(&self, count: usize) -> Model {
        let count = count.clamp(1, self.basis.ncols());
        let basis = self.basis.columns(0, count).into_owned();
        let root_basis = self.root_basis.columns(0, count).into_owned();
        Model { basis, root_basis, ..self.clone() }
    }

    /// α of a motion vector, equation (5).
    pub fn project(&self, vector: &DVector<f64>) -> DVector<f64> {
        self.basis.tr_mul(&(vector - &self.mean))
    }

    /// Ψ of weights, equation (2); fewer weights than components leave the rest zero, further ones are not used.
    pub fn vector(&self, weights: &[f64]) -> DVector<f64> {
        combine(&self.mean, &self.basis, weights)
    }

    /// Root channels of weights.
    pub fn root(&self, weights: &[f64]) -> DVector<f64> {
        combine(&self.root_mean, &self.root_basis, weights)
    }

    /// α of a member of the database.
    pub fn member_weights(&self, member: &Member) -> DVector<f64> {
        self.project(&member.vector)
    }

    /// The first `count` α of all members, a column each: as one product, which is much faster than one by one.
    pub fn leading_weights(&self, count: usize) -> DMatrix<f64> {
        let axes = self.basis.columns(0, count.min(self.basis.ncols())).transpose();
        if self.members.is_empty() {
            return DMatrix::zeros(axes.nrows(), 0);
        }
        let mut centred = columns(&self.members, |m| &m.vector);
        centred.column_iter_mut().for_each(|mut vector| vector -= &self.mean);
        axes * centred
    }

    /// Ψ of a cycle, relative to this model's mean rotations.
    pub fn vector_of(&self, cycle: &Cycle) -> DVector<f64> {
        vector_of(&self.mean_rotations, cycle)
    }

    /// Joint rotations (index `joint as usize - 1`) and root at `phase`, interpolated linearly between the neighbouring
    /// samples; a gait's phase wraps, a jump's is held at its ends.
    pub fn posture(&self, weights: &[f64], phase: f64) -> ([UnitQuaternion<f64>; BALL_JOINTS], RootSample) {
        self.posture_with(weights, None, phase)
    }

    /// [`Model::posture`] with what the weights do not hold.
    pub fn posture_with(&self, weights: &[f64], detail: Option<&Detail>, phase: f64) -> ([UnitQuaternion<f64>; BALL_JOINTS], RootSample) {
        let between = neighbours(self.activity, phase);
        let (mut joints, mut root) = ([0.0; DOF], [0.0; ROOT_CHANNELS]);
        blend(&mut joints, between, &self.mean, &self.basis, weights, detail.map(|d| &d.vector));
        blend(&mut root, between, &self.root_mean, &self.root_basis, weights, detail.map(|d| &d.root));
        (rotations(&self.mean_rotations, &joints), root_sample(&root))
    }

    /// The whole cycle of weights; subject, parameter and size as given.
    pub fn cycle(&self, weights: &[f64], subject: &str, parameter: f64, hip_height_m: f64, duration_s: f64) -> Cycle {
        let (vector, root) = (self.vector(weights), self.root(weights));
        self.cycle_of(&Member {
            subject: subject.to_string(),
            source: "synthesized".to_string(),
            parameter,
            hip_height_m,
            duration_s,
            vector,
            root,
        })
    }

    /// [`Model::cycle`] with what the weights do not hold, of nobody in particular.
    pub fn cycle_with(&self, weights: &[f64], detail: Option<&Detail>, parameter: f64, hip_height_m: f64, duration_s: f64) -> Cycle {
        let (mut vector, mut root) = (self.vector(weights), self.root(weights));
        if let Some(detail) = detail {
            vector += &detail.vector;
            root += &detail.root;
        }
        let (subject, source) = (String::new(), "synthesized".to_string());
        self.cycle_of(&Member { subject, source, parameter, hip_height_m, duration_s, vector, root })
    }

    /// A cycle as a member: its vector is relative to this model's mean rotations.
    pub fn member_of(&self, cycle: &Cycle) -> Member {
        member(&self.mean_rotations, cycle)
    }

    /// A member as the cycle it was, exactly.
    pub fn cycle_of(&self, member: &Member) -> Cycle {
        Cycle {
            subject: member.subject.clone(),
            source: member.source.clone(),
            activity: self.activity,
            parameter: member.parameter,
            hip_height_m: member.hip_height_m,
            duration_s: member.duration_s,
            joints: member.vector.as_slice().chunks_exact(DOF).map(|row| rotations(&self.mean_rotations, row)).collect(),
            root: member.root.as_slice().chunks_exact(ROOT_CHANNELS).map(root_sample).collect(),
        }
    }

    /// Names of the subjects in natural order.
    pub fn subjects(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.members.iter().map(|m| m.subject.as_str()).collect();
        names.sort_by(|a, b| natord::compare(a, b).then(a.cmp(b)));
        names.dedup();
        names
    }

    /// Smallest and largest parameter of the members, m/s or m.
    pub fn parameter_range(&self) -> (f64, f64) {
        self.members.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), m| (lo.min(m.parameter), hi.max(m.parameter)))
    }

    /// Law of cycle frequency of the members.
    pub fn cadence(&self) -> CadenceLaw {
        CadenceLaw::fit(self.activity, &self.members)
    }
}

fn check(activity: Activity, cycles: &[Cycle]) -> Result<(), ModelError> {
    for cycle in cycles {
        let origin = || format!("{} ({})", cycle.source, cycle.subject);
        if cycle.activity != activity {
            return Err(ModelError::Activity { origin: origin(), found: cycle.activity, wanted: activity });
        }
        if cycle.joints.len() != SAMPLES || cycle.root.len() != SAMPLES {
            return Err(ModelError::Samples { origin: origin(), found: cycle.joints.len().min(cycle.root.len()) });
        }
    }
    if cycles.len() < 2 { Err(ModelError::TooFew(cycles.len())) } else { Ok(()) }
}

fn mean_rotations(cycles: &[Cycle]) -> [UnitQuaternion<f64>; BALL_JOINTS] {
    let means: Vec<UnitQuaternion<f64>> = (0..BALL_JOINTS)
        .into_par_iter()
        .map(|j| {
            let all: Vec<_> = cycles.iter().flat_map(|c| c.joints.iter().map(move |sample| sample[j])).collect();
            mean(&all).unwrap_or_default()
        })
        .collect();
    std::array::from_fn(|j| means[j])
}

fn member(mean_rotations: &[UnitQuaternion<f64>; BALL_JOINTS], cycle: &Cycle) -> Member {
    Member {
        subject: cycle.subject.clone(),
        source: cycle.source.clone(),
        parameter: cycle.parameter,
        hip_height_m: cycle.hip_height_m,
        duration_s: cycle.duration_s,
        vector: vector_of(mean_rotations, cycle),
        root: root_of(cycle),
    }
}

fn vector_of(mean_rotations: &[UnitQuaternion<f64>; BALL_JOINTS], cycle: &Cycle) -> DVector<f64> {
    let coordinates = cycle.joints.iter().flat_map(|joints| {
        (0..BALL_JOINTS).flat_map(|j| {
            let v = log(&(mean_rotations[j].inverse() * joints[j]));
            [v.x, v.y, v.z]
        })
    });
    DVector::from_iterator(SAMPLES * DOF, coordinates)
}

/// Root channels of a cycle in the order of [`Member::root`].
pub fn root_of(cycle: &Cycle) -> DVector<f64> {
    let channels = cycle.root.iter().flat_map(|s| [s.rotation.x, s.rotation.y, s.rotation.z, s.position.x, s.position.y, s.position.z]);
    DVector::from_iterator(SAMPLES * ROOT_CHANNELS, channels)
}

/// Vectors of all members, of which there is one at least, as columns.
fn columns(members: &[Member], of: impl Fn(&Member) -> &DVector<f64>) -> DMatrix<f64> {
    let length = of(&members[0]).len();
    let mut all = Vec::with_capacity(members.len() * length);
    members.iter().for_each(|m| all.extend_from_slice(of(m).as_slice()));
    DMatrix::from_vec(length, members.len(), all)
}

/// Equation (6); `weights` is components x members with mean zero.
fn root_loadings(roots: &DMatrix<f64>, root_mean: &DVector<f64>, weights: &DMatrix<f64>) -> DMatrix<f64> {
    let mut centred = roots.clone();
    centred.column_iter_mut().for_each(|mut r| r -= root_mean);
    let mut loadings = centred * weights.transpose();
    for (i, mut column) in loadings.column_iter_mut().enumerate() {
        column /= weights.row(i).norm_squared();
    }
    loadings
}

fn combine(mean: &DVector<f64>, basis: &DMatrix<f64>, weights: &[f64]) -> DVector<f64> {
    let mut sum = mean.clone();
    for (i, w) in weights.iter().take(basis.ncols()).enumerate() {
        sum.axpy(*w, &basis.column(i), 1.0);
    }
    sum
}

/// Row `before` of mean + basis weights + detail towards row `after` by `part`; a row is as long as `out`.
fn blend(
    out: &mut [f64],
    (before, after, part): (usize, usize, f64),
    mean: &DVector<f64>,
    basis: &DMatrix<f64>,
    weights: &[f64],
    detail: Option<&DVector<f64>>,
) {
    let (width, length) = (out.len(), mean.len());
    let columns = weights.iter().copied().zip(basis.as_slice().chunks_exact(length));
    let fixed = [Some(mean), detail].into_iter().flatten().map(|v| (1.0, v.as_slice()));
    for (weight, column) in fixed.chain(columns) {
        let (a, b) = (&column[before * width..][..width], &column[after * width..][..width]);
        let (of_a, of_b) = (weight * (1.0 - part), weight * part);
        for ((out, a), b) in out.iter_mut().zip(a).zip(b) {
            *out += of_a * a + of_b * b;
        }
    }
}

fn rotations(means: &[UnitQuaternion<f64>; BALL_JOINTS], coordinates: &[f64]) -> [UnitQuaternion<f64>; BALL_JOINTS] {
    std::array::from_fn(|j| means[j] * turn(coordinates[3 * j], coordinates[3 * j + 1], coordinates[3 * j + 2]))
}

/// Terms of the series below: at half a turn the next one is 1e-17.
const TERMS: usize = 11;
/// 1/(2k)! and 1/(2k+1)! with alternating signs.
pub(super) const SERIES: ([f64; TERMS], [f64; TERMS]) = {
    let (mut even, mut odd) = ([1.0; TERMS], [1.0; TERMS]);
    let mut k = 1;
    while k < TERMS {
        let n = 2.0 * k as f64;
        even[k] = -odd[k - 1] / n;
        odd[k] = even[k] / (n + 1.0);
        k += 1;
    }
    (even, odd)
};

/// Squared angle, nearly half a turn, beyond which the series fade.
pub(super) const FADING: f64 = 9.8;

/// exp of a rotation vector by the series of cos and sin(h)/h, h half the angle: neither roots nor branches, which is what
/// many postures a second need. Beyond half a turn, where the series fades, the closed form.
fn turn(x: f64, y: f64, z: f64) -> UnitQuaternion<f64> {
    let square = x * x + y * y + z * z;
    if square > FADING {
        return exp(&Vector3::new(x, y, z));
    }
    let h2 = 0.25 * square;
    let sum = |series: &[f64; TERMS]| series.iter().rev().fold(0.0, |sum, c| sum * h2 + c);
    let (cos, sinc) = (sum(&SERIES.0), 0.5 * sum(&SERIES.1));
    UnitQuaternion::new_unchecked(Quaternion::new(cos, sinc * x, sinc * y, sinc * z))
}

fn root_sample(c: &[f64]) -> RootSample {
    RootSample { rotation: Vector3::new(c[0], c[1], c[2]), position: Vector3::new(c[3], c[4], c[5]) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::synthetic;

    /// A few cycles of three synthetic walkers.
    fn cycles() -> Vec<Cycle> {
        let speeds = [0.9, 1.3, 1.7];
        (1..4).flat_map(|seed| speeds.map(|v| synthetic::subject(Activity::Walking, seed).cycle(v, 0))).collect()
    }

    fn model() -> Model {
        Model::build(Activity::Walking, true, &cycles()).unwrap()
    }

    #[test]
    fn all_components_give_a_member_back() {
        let model = model();
        let vectors: Vec<_> = model.members.iter().map(|m| m.vector.clone()).collect();
        let full = pca::pca(&DMatrix::from_columns(&vectors));
        for member in &model.members {
            let alpha = full.basis.tr_mul(&(&member.vector - &full.mean));
            assert!((&full.mean + &full.basis * alpha - &member.vector).norm() < 1e-9);
            // What the stored components leave out is at most the variance that they do not hold.
            let kept = model.vector(model.member_weights(member).as_slice());
            let total: f64 = model.eigenvalues.iter().sum();
            assert!((kept - &member.vector).norm_squared() <= (1.0 - STORED_VARIANCE) * total * model.members.len() as f64);
        }
        let back = model.cycle_of(&model.members[4]);
        assert!((model.vector_of(&back) - &model.members[4].vector).norm() < 1e-9);
        let angle = back.joints[30][1].angle_to(&cycles()[4].joints[30][1]);
        assert!(angle < 1e-9, "{angle}");
    }

    #[test]
    fn mean_rotations_leave_vectors_without_mean_angle() {
        let model = model();
        for joint in 0..BALL_JOINTS {
            let mut sum = Vector3::zeros();
            for sample in 0..SAMPLES {
                sum += model.mean.fixed_rows::<3>((sample * BALL_JOINTS + joint) * 3);
            }
            assert!(sum.norm() / (SAMPLES as f64) < 1e-9, "joint {joint}");
        }
        assert!(model.mean.amax() > 0.1);
    }

    #[test]
    fn root_loadings_leave_residuals_orthogonal_to_the_weights() {
        let model = model();
        let count = model.basis.ncols();
        let mut products = DMatrix::<f64>::zeros(SAMPLES * ROOT_CHANNELS, count);
        let (mut before, mut after) = (0.0, 0.0);
        for member in &model.members {
            let alpha = model.member_weights(member);
            let residual = &member.root - model.root(alpha.as_slice());
            before += (&member.root - &model.root_mean).norm_squared();
            after += residual.norm_squared();
            products += residual * alpha.transpose();
        }
        assert!(products.amax() < 1e-9, "{}", products.amax());
        assert!(after < 0.2 * before, "{after} of {before}");
    }

    #[test]
    fn postures_are_samples_and_interpolate_between_them_around_the_wrap() {
        let model = model();
        let alpha = model.member_weights(&model.members[0]);
        let cycle = model.cycle(alpha.as_slice(), "s", 0.9, 0.9, 1.2);
        let (joints, root) = model.posture(alpha.as_slice(), 3.37);
        assert!(joints[2].angle_to(&cycle.joints[37][2]) < 1e-9);
        assert!((root.position - cycle.root[37].position).norm() < 1e-12);
        let (between, _) = model.posture(alpha.as_slice(), -0.005);
        let half = cycle.joints[99][2].slerp(&cycle.joints[0][2], 0.5);
        assert!(between[2].angle_to(&half) < 1e-4 && between[2].angle_to(&cycle.joints[0][2]) > 1e-4);
        let jump = Model { activity: Activity::Jumping, ..model };
        assert_eq!(jump.posture(alpha.as_slice(), 1.7), jump.posture(alpha.as_slice(), 1.0));
        assert!(jump.posture(alpha.as_slice(), 1.0).0[2].angle_to(&cycle.joints[99][2]) < 1e-9);
    }

    #[test]
    fn series_turns_as_the_closed_form_does() {
        for k in 0..2000 {
            let t = f64::from(k);
            let v = Vector3::new((1.1 * t).sin(), (0.7 * t).cos(), (0.3 * t).sin()) * (0.0017 * t);
            let (found, wanted) = (turn(v.x, v.y, v.z), exp(&v));
            assert!((found.coords - wanted.coords).amax() < 1e-14 && (found.coords.norm() - 1.0).abs() < 1e-14, "{}", v.norm());
        }
    }

    #[test]
    fn a_model_with_a_new_subject_is_the_model_of_all() {
        let all = cycles();
        let (first, new): (Vec<Cycle>, Vec<Cycle>) = all.iter().cloned().partition(|c| c.subject != all[8].subject);
        assert_eq!((first.len(), new.len()), (6, 3));
        let updated = Model::build(Activity::Walking, true, &first).unwrap().with(&new).unwrap();
        let whole = Model::build(Activity::Walking, true, &all).unwrap();
        assert!((&updated.mean - &whole.mean).norm() < 1e-9 && updated.basis.ncols() == whole.basis.ncols());
        for (a, b) in updated.eigenvalues.iter().zip(&whole.eigenvalues) {
            assert!((a - b).abs() < 1e-9 * whole.eigenvalues[0]);
        }
        assert!((&updated.basis - &whole.basis).norm() < 1e-5, "{}", (&updated.basis - &whole.basis).norm());
        assert!((&updated.root_basis - &whole.root_basis).norm() < 1e-5);
        assert_eq!(updated.members[7].source, whole.members[7].source);
        let without = Model::build(Activity::Walking, true, &first).unwrap();
        assert!((&without.mean - &whole.mean).norm() > 0.1);
        assert!(matches!(whole.with(&new[..1]), Err(ModelError::Twice { .. })));
    }

    #[test]
    fn refuses_databases_that_are_no_database() {
        let cycles = cycles();
        assert_eq!(Model::build(Activity::Walking, true, &cycles[..1]).unwrap_err(), ModelError::TooFew(1));
        let equal = [cycles[0].clone(), cycles[0].clone()];
        assert_eq!(Model::build(Activity::Walking, true, &equal).unwrap_err(), ModelError::NoVariance);
        assert!(matches!(Model::build(Activity::Running, true, &cycles), Err(ModelError::Activity { .. })));
        let mut short = cycles;
        short[1].joints.pop();
        assert!(matches!(Model::build(Activity::Walking, true, &short), Err(ModelError::Samples { found: 99, .. })));
    }
}
