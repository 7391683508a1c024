//! The same person at another speed or length.
//!
//!   α̃^{x,s2} = Σ_p w_p α^{p,s2}                                                                                  (8)
//! with the weights (7) from the distances at s1, over the subjects who take part both at s1 and at s2. Where fewer than two
//! do (sparse databases, or an s2 that nobody moved at), every subject takes part with its curve extended by the
//! population's change, and a notice says so.
//! Fails when: the person is far from everybody; then the weights are nearly equal and the style fades into the mean.
//! That is the paper's scheme; the default, which keeps the own motion, is `transfer`.

use nalgebra::DVector;

use super::Detail;
use super::curves::{Curve, Population};
use super::distance::{Metric, inverse_distance_weights};

/// Subjects needed at both parameters for equation (8) as it stands.
const ENOUGH: usize = 2;

/// Weights of a person at a new parameter.
#[derive(Clone, Debug)]
pub struct Extrapolation {
    /// α̃, as many as the population has components.
    pub weights: DVector<f64>,
    /// What of a recorded motion the weights do not hold, at the new parameter.
    pub detail: Option<Detail>,
    /// Standard deviation of every weight; the paper's scheme has none.
    pub sd: Option<Vec<f64>>,
    /// Database subjects and their weights w_p.
    pub shares: Vec<(String, f64)>,
    /// What the reader of the result should know.
    pub notice: Option<String>,
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum StyleError {
    #[error("the style has {found} weights and the model uses {wanted} components; make the style with this model")]
    Weights { found: usize, wanted: usize },
    #[error("the style holds a weight that is not finite; make it again")]
    NotFinite,
}

/// Equation (8): `weights` observed at `s1`, wanted at `s2` (m/s or m).
pub fn extrapolate(population: &Population, metric: Metric, weights: &[f64], s1: f64, s2: f64) -> Result<Extrapolation, StyleError> {
    let wanted = population.components();
    if weights.len() < wanted {
        return Err(StyleError::Weights { found: weights.len(), wanted });
    }
    if weights.iter().any(|w| !w.is_finite()) {
        return Err(StyleError::NotFinite);
    }
    let observed = DVector::from_column_slice(&weights[..wanted]);
    let all: Vec<&Curve> = population.curves.iter().collect();
    let both = shared_subjects(&all, [s1, s2]);
    let sparse = both.is_none();
    let subjects = both.unwrap_or(all);
    let notice = sparse.then(|| {
        format!(
            "fewer than {ENOUGH} database subjects were recorded both at {s1:.2} and at {s2:.2}: all {} take part, carried \
             beyond their recordings by the population's mean change",
            subjects.len()
        )
    });
    let distances: Vec<f64> =
        subjects.iter().map(|c| metric.distance(&population.eigenvalues, &observed, &population.extended(c, s1))).collect();
    let shares = inverse_distance_weights(&distances);
    let mut sum = DVector::zeros(wanted);
    for (curve, share) in subjects.iter().zip(&shares) {
        sum.axpy(*share, &population.extended(curve, s2), 1.0);
    }
    let shares = subjects.iter().map(|c| c.subject.clone()).zip(shares).collect();
    Ok(Extrapolation { weights: sum, detail: None, sd: None, shares, notice })
}

/// Those of `subjects` that take part at every one of `parameters`, where they are enough.
pub(super) fn shared_subjects<'a>(subjects: &[&'a Curve], parameters: impl IntoIterator<Item = f64> + Clone) -> Option<Vec<&'a Curve>> {
    let everywhere = |c: &Curve| parameters.clone().into_iter().all(|s| c.takes_part(s));
    let shared: Vec<&Curve> = subjects.iter().copied().filter(|c| everywhere(c)).collect();
    (shared.len() >= ENOUGH).then_some(shared)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{BALL_JOINTS, DOF};
    use crate::math::spline::Spline;
    use crate::motion_model::{Activity, Member, Model, ROOT_CHANNELS, SAMPLES};
    use nalgebra::UnitQuaternion;

    /// Subjects (name, offset of the first coordinate) whose two coordinates run over the parameter as given.
    fn model(subjects: &[(&str, f64, &[f64])], curve: fn(f64) -> (f64, f64)) -> Model {
        let members = subjects.iter().flat_map(|(subject, offset, parameters)| {
            parameters.iter().map(move |&parameter| {
                let mut vector = DVector::zeros(SAMPLES * DOF);
                (vector[0], vector[7]) = curve(parameter);
                vector[0] += offset;
                let root = DVector::zeros(SAMPLES * ROOT_CHANNELS);
                let (subject, source) = (subject.to_string(), String::new());
                Member { subject, source, parameter, hip_height_m: 0.9, duration_s: 1.0, vector, root }
            })
        });
        Model::from_members(Activity::Walking, false, [UnitQuaternion::identity(); BALL_JOINTS], members.collect()).unwrap()
    }

    const GRID: [f64; 4] = [0.8, 1.1, 1.4, 1.7];

    #[test]
    fn on_a_grid_it_is_the_papers_scheme() {
        let model = model(&[("a", 0.0, &GRID), ("b", 1.0, &GRID), ("c", 3.0, &GRID)], |s| (s * s, (3.0 * s).sin()));
        let population = Population::new(&model, 2);
        let alpha = |subject: usize, k: usize| model.member_weights(&model.members[4 * subject + k]);
        let observed = (alpha(0, 1) + alpha(2, 1)) * 0.45 + alpha(1, 1) * 0.1;
        let distances: Vec<f64> = (0..3).map(|p| Metric::Paper.distance(&model.eigenvalues, &observed, &alpha(p, 1))).collect();
        let w = inverse_distance_weights(&distances);
        let at = |k: usize| alpha(0, k) * w[0] + alpha(1, k) * w[1] + alpha(2, k) * w[2];
        let found = extrapolate(&population, Metric::Paper, observed.as_slice(), 1.1, 1.7).unwrap();
        assert!((&found.weights - at(3)).norm() < 1e-12);
        assert!(found.notice.is_none());
        // Between the database's parameters: the spline of the sums.
        let spline = Spline::natural(GRID.to_vec(), (0..4).map(at).collect()).unwrap();
        let between = extrapolate(&population, Metric::Paper, observed.as_slice(), 1.1, 1.53).unwrap();
        assert!((&between.weights - spline.at(1.53)).norm() < 1e-12);
        assert!((&between.weights - &found.weights).norm() > 0.01);
    }

    #[test]
    fn the_populations_change_is_peoples_own() {
        // Whoever was recorded at higher speeds stands lower: between people the line falls, within them it rises.
        let subjects: [(&str, f64, &[f64]); 3] = [("a", 6.0, &[0.8, 1.1]), ("b", 3.0, &[1.1, 1.4, 1.5]), ("c", 0.0, &[1.4])];
        let change = |subjects: &[(&str, f64, &[f64])]| {
            let model = model(subjects, |s| (2.0 * s, -20.0 * s));
            let population = Population::new(&model, model.basis.ncols());
            let moved = model.basis.columns(0, population.components()) * &population.slope;
            (moved[0], moved[7])
        };
        let (first, second) = change(&subjects);
        assert!((first - 2.0).abs() < 1e-9 && (second + 20.0).abs() < 1e-9, "{first} {second}");
        let alone: [(&str, f64, &[f64]); 3] = [("a", 6.0, &[0.8]), ("b", 3.0, &[1.1]), ("c", 0.0, &[1.4])];
        assert!((change(&alone).0 + 8.0).abs() < 1e-9, "{:?}", change(&alone));
    }

    #[test]
    fn a_database_subject_comes_back_exactly() {
        let model = model(&[("a", 0.0, &GRID), ("b", 1.0, &GRID)], |s| (s, s * s));
        let population = Population::new(&model, 2);
        let [own, target] = [&model.members[5], &model.members[7]].map(|m| model.member_weights(m));
        let found = extrapolate(&population, Metric::Mahalanobis, own.as_slice(), 1.1, 1.7).unwrap();
        assert!((found.weights - target).norm() < 1e-12);
        assert_eq!(found.shares[1], ("b".to_string(), 1.0));
    }

    #[test]
    fn only_subjects_at_both_parameters_take_part() {
        let subjects: [(&str, f64, &[f64]); 3] = [("a", 0.0, &GRID), ("b", 2.0, &GRID), ("slow", 1.0, &[0.8, 1.1])];
        let population = Population::new(&model(&subjects, |s| (s, 0.1 * s * s)), 2);
        let found = extrapolate(&population, Metric::Paper, &[0.3, 0.1], 1.0, 1.7).unwrap();
        assert_eq!(found.shares.iter().map(|s| s.0.as_str()).collect::<Vec<_>>(), ["a", "b"]);
    }

    #[test]
    fn without_common_subjects_the_populations_change_carries_everybody() {
        let subjects: [(&str, f64, &[f64]); 3] = [("a", 0.0, &[0.8]), ("b", 0.0, &[1.1]), ("c", 0.0, &[1.4])];
        let model = model(&subjects, |s| (2.0 * s, -s));
        let population = Population::new(&model, 1);
        let observed = model.member_weights(&model.members[0]);
        let found = extrapolate(&population, Metric::Paper, &observed.as_slice()[..1], 0.8, 1.7).unwrap();
        let expected = {
            let mut vector = model.members[0].vector.clone();
            (vector[0], vector[7]) = (3.4, -1.7);
            model.project(&vector)
        };
        assert!((found.weights - expected.rows(0, 1)).norm() < 1e-9);
        assert!(found.notice.unwrap().contains("all 3 take part"));
    }

    #[test]
    fn too_few_or_bad_weights_are_refused() {
        let population = Population::new(&model(&[("a", 0.0, &GRID), ("b", 1.0, &GRID)], |s| (s, s * s)), 2);
        let run = |w: &[f64]| extrapolate(&population, Metric::Paper, w, 1.0, 1.2).unwrap_err();
        assert_eq!(run(&[1.0]), StyleError::Weights { found: 1, wanted: 2 });
        assert_eq!(run(&[1.0, f64::NAN]), StyleError::NotFinite);
    }
}
