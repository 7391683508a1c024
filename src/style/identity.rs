//! Whether a person is one of the database's subjects or a stranger, by evidence.
//!
//! Of a motion vector Ψ only the joints J that footage shows count, and a constant of each of their axes c is the business
//! of skeletons and marker sets as much as the person's:
//!   Ψ_J = Θ0_J + Θ_J α + c + ε,   c ~ N(0, σ_c²),   ε ~ N(0, σ_j²) at N_e independent samples of the cycle.          (1)
//! A subject's weights at the parameter s are N(ᾱ_p + β (s − s̄_p), (1 + 1/k) W): the mean of its k cycles, moved as within all
//! subjects the weights change with the parameter on average, β, and W the spread of all cycles about that; a stranger's
//! are the population's N(0, Λ). For each subject
//!   log odds = ln ∫ p(Ψ_J|α) p(α|subject) dα − ln ∫ p(Ψ_J|α) p(α|stranger) dα.                                       (2)
//! With everybody in the database and a stranger equally likely beforehand the weights that recordings of the person would have are
//!   E[α|Ψ_J] = Σ_k r_k α̂_k,   cov = Σ_k r_k (P_k⁻¹ + (α̂_k − E)(α̂_k − E)ᵀ),                                       (3)
//! over subjects and stranger, r_k ∝ the odds, α̂_k and P_k mean and precision of p(α|Ψ_J, k).
//! Departure: equation (6) of the style paper weighs a weight by its λ². The first weights of marker sets hold how wrists
//! and heads were marked, so between the weights of a tracked motion and recordings it compares what two skeletons do not share;
//! between (3) and recordings it does not.
//! Fails when nobody of the database has two cycles: then W is not known. Of a body that is the database's own, as a phantom's, (3)
//! gives away what the constants tell, and the plain weights are nearer.
//! Checked against the densities written out and quadrature, and on people with cycles in the database and without.

use nalgebra::{DMatrix, DVector};

use super::curves::Population;
use crate::body::{DOF, Joint};
use crate::motion_model::{Model, SAMPLES};

/// Joints of equation (1) with σ_j, rad: what tracked walks, whose skeleton was another, missed of joint angles.
const SEEN: [(Joint, f64); 11] = [
    (Joint::LHip, LEG),
    (Joint::LKnee, LEG),
    (Joint::LAnkle, LEG),
    (Joint::RHip, LEG),
    (Joint::RKnee, LEG),
    (Joint::RAnkle, LEG),
    (Joint::Vl1, LEG),
    (Joint::LShoulder, ARM),
    (Joint::LElbow, ARM),
    (Joint::RShoulder, ARM),
    (Joint::RElbow, ARM),
];
const LEG: f64 = 0.1;
const ARM: f64 = 0.2;
/// σ_c, rad: joint zeros of two marker sets differ by 10 degrees and more.
const CONSTANT: f64 = 0.2;
/// N_e: five harmonics.
const INDEPENDENT: f64 = 10.0;
/// Share of each weight's own variance added to W, which has fewer cycles than it has numbers.
const RIDGE: f64 = 0.05;

/// What a motion says of the weights: −½ αᵀ I α + bᵀ α, up to a constant.
struct Information {
    precision: DMatrix<f64>,
    pull: DVector<f64>,
}

/// Who somebody is, by a motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Recognised {
    /// Equation (2) for the subjects of the model, in the order of the population.
    pub odds: Vec<(String, f64)>,
    /// Equation (3): components, and components x components.
    pub weights: DVector<f64>,
    pub covariance: DMatrix<f64>,
}

/// Equations (2) and (3) with `vector` the motion Ψ at `parameter`; `None` where W is not known.
pub fn recognise(population: &Population, model: &Model, vector: &DVector<f64>, parameter: f64) -> Option<Recognised> {
    let count = population.components();
    let information = information(model, vector, count);
    let subjects = Subjects::of(population, model)?;
    let stranger = DMatrix::from_diagonal(&DVector::from_column_slice(&population.eigenvalues));
    let stranger = believe(&information, &DVector::zeros(count), &stranger)?;
    let of_subject = |own: &Centre| {
        let mean = &own.weights + &subjects.change * (parameter - own.parameter);
        believe(&information, &mean, &(&subjects.spread * (1.0 + 1.0 / own.cycles)))
    };
    let known = subjects.centres.iter().map(of_subject).collect::<Option<Vec<Belief>>>()?;
    let odds: Vec<f64> = known.iter().map(|k| k.evidence - stranger.evidence).collect();
    let all: Vec<Belief> = known.into_iter().chain([stranger]).collect();
    let (weights, covariance) = mixed(&all);
    Some(Recognised { odds: subjects.names.into_iter().zip(odds).collect(), weights, covariance })
}

/// Equation (3).
fn mixed(all: &[Belief]) -> (DVector<f64>, DMatrix<f64>) {
    let most = all.iter().map(|k| k.evidence).fold(f64::NEG_INFINITY, f64::max);
    let likely: Vec<f64> = all.iter().map(|k| (k.evidence - most).exp()).collect();
    let share = |k: usize| likely[k] / likely.iter().sum::<f64>();
    let weights = all.iter().enumerate().map(|(k, b)| &b.mean * share(k)).sum::<DVector<f64>>();
    let about = |b: &Belief| {
        let off = &b.mean - &weights;
        &b.covariance + &off * off.transpose()
    };
    let covariance = all.iter().enumerate().map(|(k, b)| about(b) * share(k)).sum::<DMatrix<f64>>();
    (weights, covariance)
}

/// The mean of one subject's cycles.
struct Centre {
    cycles: f64,
    parameter: f64,
    weights: DVector<f64>,
}

/// ᾱ_p, β and W.
struct Subjects {
    names: Vec<String>,
    centres: Vec<Centre>,
    change: DVector<f64>,
    spread: DMatrix<f64>,
}

impl Subjects {
    fn of(population: &Population, model: &Model) -> Option<Subjects> {
        let count = population.components();
        let weights = model.leading_weights(count);
        let names: Vec<String> = population.curves.iter().map(|curve| curve.subject.clone()).collect();
        let own = |name: &String| -> Vec<(f64, DVector<f64>)> {
            let members = model.members.iter().zip(weights.column_iter()).filter(|(m, _)| m.subject == *name);
            members.map(|(m, weights)| (m.parameter, weights.into_owned())).collect()
        };
        let cycles: Vec<Vec<(f64, DVector<f64>)>> = names.iter().map(own).collect();
        let centre = |own: &Vec<(f64, DVector<f64>)>| {
            let cycles = own.len() as f64;
            let sum = own.iter().fold((0.0, DVector::zeros(count)), |sum, c| (sum.0 + c.0, sum.1 + &c.1));
            Centre { cycles, parameter: sum.0 / cycles, weights: sum.1 / cycles }
        };
        let centres: Vec<Centre> = cycles.iter().map(centre).collect();
        let about = || cycles.iter().zip(&centres).flat_map(|(own, c)| own.iter().map(move |(s, a)| (s - c.parameter, a - &c.weights)));
        let travelled: f64 = about().map(|(s, _)| s * s).sum();
        let mut change = DVector::zeros(count);
        if travelled > 0.0 {
            about().for_each(|(s, off)| change += off * (s / travelled));
        }
        let free: f64 = centres.iter().map(|c| c.cycles - 1.0).sum();
        let mut spread = DMatrix::zeros(count, count);
        for (s, off) in about() {
            let off = off - &change * s;
            spread += &off * off.transpose();
        }
        (free > 0.0).then(|| {
            spread /= free;
            (0..count).for_each(|i| spread[(i, i)] += RIDGE * spread[(i, i)] + 1e-9 * population.eigenvalues[i]);
            Subjects { names, centres, change, spread }
        })
    }
}

/// Equation (1) with c eliminated: what varies of each axis, and its constant with variance σ_c².
fn information(model: &Model, vector: &DVector<f64>, count: usize) -> Information {
    let mut found = Information { precision: DMatrix::zeros(count, count), pull: DVector::zeros(count) };
    let shown = vector - &model.mean;
    for (joint, sigma) in SEEN {
        for axis in 0..3 {
            let first = 3 * (joint as usize - 1) + axis;
            let mut basis = DMatrix::from_fn(SAMPLES, count, |t, i| model.basis[(t * DOF + first, i)]);
            let mut motion = DVector::from_fn(SAMPLES, |t, _| shown[t * DOF + first]);
            let (constants, constant) = (basis.row_mean().transpose(), motion.mean());
            basis.row_iter_mut().for_each(|mut row| row -= constants.transpose());
            motion.add_scalar_mut(-constant);
            let (varying, fixed) = (INDEPENDENT / SAMPLES as f64 / (sigma * sigma), 1.0 / (CONSTANT * CONSTANT));
            found.precision += basis.tr_mul(&basis) * varying + &constants * constants.transpose() * fixed;
            found.pull += basis.tr_mul(&motion) * varying + constants * (constant * fixed);
        }
    }
    found
}

/// What is believed of the weights after seeing the motion, if the person is a certain one.
struct Belief {
    /// ln ∫ exp(−½ αᵀ I α + bᵀ α) p(α) dα.
    evidence: f64,
    /// α̂ and P⁻¹.
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

/// With N(mean, covariance) for p(α); `None` where the covariance is singular.
fn believe(information: &Information, mean: &DVector<f64>, covariance: &DMatrix<f64>) -> Option<Belief> {
    let prior = covariance.clone().cholesky()?;
    let pulled = prior.solve(mean);
    let posterior = (&information.precision + prior.inverse()).cholesky()?;
    let rhs = &information.pull + &pulled;
    let found = posterior.solve(&rhs);
    let log_det = |l: DMatrix<f64>| 2.0 * l.diagonal().iter().map(|v| v.ln()).sum::<f64>();
    let evidence = 0.5 * (rhs.dot(&found) - mean.dot(&pulled) - log_det(posterior.l()) - log_det(prior.l()));
    Some(Belief { evidence, mean: found, covariance: posterior.inverse() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::{Activity, Cycle, synthetic};
    use crate::style::Metric;

    #[test]
    fn evidence_is_that_of_the_densities_written_out() {
        let spd = |seed: f64| {
            let a = DMatrix::from_fn(4, 4, |i, j| (seed * (1 + 3 * i + 7 * j) as f64).sin());
            &a * a.transpose() + DMatrix::identity(4, 4) * 0.3
        };
        let (precision, mode) = (spd(0.7), DVector::from_vec(vec![0.4, -1.1, 0.2, 0.9]));
        let information = Information { pull: &precision * &mode, precision: precision.clone() };
        // The motion says α = mode with covariance I⁻¹, so that mode is N(mean, covariance + I⁻¹).
        let density = |mean: &DVector<f64>, covariance: &DMatrix<f64>| {
            let whole = covariance + precision.clone().try_inverse().unwrap();
            let off = &mode - mean;
            -0.5 * ((off.transpose() * whole.clone().try_inverse().unwrap() * &off)[0] + whole.determinant().ln())
        };
        let (a, b) = (DVector::from_vec(vec![0.5, -0.8, 0.0, 1.0]), DVector::zeros(4));
        let (narrow, wide) = (spd(1.3) * 0.1, spd(0.4) * 5.0);
        let [a_known, b_known] = [(&a, &narrow), (&b, &wide)].map(|(mean, covariance)| believe(&information, mean, covariance).unwrap());
        let found = a_known.evidence - b_known.evidence;
        assert!((found - (density(&a, &narrow) - density(&b, &wide))).abs() < 1e-9);
    }

    #[test]
    fn expected_weights_are_those_of_quadrature() {
        let information =
            Information { precision: DMatrix::from_row_slice(2, 2, &[1.4, -0.5, -0.5, 0.6]), pull: DVector::from_vec(vec![0.9, 0.3]) };
        let priors = [
            (DVector::from_vec(vec![1.5, -0.5]), DMatrix::from_row_slice(2, 2, &[0.2, 0.05, 0.05, 0.1])),
            (DVector::from_vec(vec![-0.6, 1.1]), DMatrix::from_row_slice(2, 2, &[0.3, -0.1, -0.1, 0.4])),
            (DVector::zeros(2), DMatrix::from_row_slice(2, 2, &[2.0, 0.0, 0.0, 1.0])),
        ];
        let (mut sum, mut first, mut second) = (0.0, DVector::zeros(2), DMatrix::zeros(2, 2));
        for (i, k) in (-200..=200).flat_map(|i| (-200..=200).map(move |k| (i, k))) {
            let x = DVector::from_vec(vec![0.04 * f64::from(i), 0.04 * f64::from(k)]);
            let prior = priors.iter().map(|(mean, covariance)| {
                let off = &x - mean;
                (-0.5 * off.dot(&(covariance.clone().try_inverse().unwrap() * &off))).exp() / covariance.determinant().sqrt()
            });
            let share = (information.pull.dot(&x) - 0.5 * x.dot(&(&information.precision * &x))).exp() * prior.sum::<f64>();
            sum += share;
            first += &x * share;
            second += &x * x.transpose() * share;
        }
        let first = first / sum;
        let second = second / sum - &first * first.transpose();
        let (weights, covariance) = mixed(&priors.map(|(mean, covariance)| believe(&information, &mean, &covariance).unwrap()));
        assert!((&weights - &first).amax() < 1e-6, "{weights} {first}");
        assert!((&covariance - &second).amax() < 1e-6, "{covariance} {second}");
    }

    /// Subjects 1 to 9 at three speeds, three cycles each, with their names.
    fn nine_walkers() -> (Model, Population, Vec<String>) {
        let own = |s: u64| {
            [0.9, 1.2, 1.5].into_iter().flat_map(move |v| (0..3).map(move |k| synthetic::subject(Activity::Walking, s).cycle(v, k)))
        };
        let cycles: Vec<Cycle> = (1..=9).flat_map(own).collect();
        let model = Model::build(Activity::Walking, true, &cycles).unwrap();
        let population = Population::new(&model, 12);
        (model, population, cycles.chunks(9).map(|own| own[0].subject.clone()).collect())
    }

    #[test]
    fn known_people_are_found_and_strangers_are_less_like_anybody() {
        let (model, population, names) = nine_walkers();
        let odds = |s: u64| {
            let vector = model.vector_of(&synthetic::subject(Activity::Walking, s).cycle(1.35, 7));
            let mut found = recognise(&population, &model, &vector, 1.35).unwrap().odds;
            found.sort_by(|a, b| b.1.total_cmp(&a.1));
            found
        };
        let mut own = Vec::new();
        for subject in 1..=9 {
            let found = odds(subject);
            let name = &names[subject as usize - 1];
            assert!(found.len() == 9 && found[0].0 == *name && found[0].1 > 3.0 && found[0].1 > found[1].1 + 3.0, "{name}: {found:?}");
            own.push(found[0].1);
        }
        // Nine people leave room for somebody who moves much like one of them, but not for many.
        let strangers: Vec<f64> = (1000..1008).map(|stranger| odds(stranger)[0].1).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        assert!(mean(&strangers) < mean(&own) - 3.0, "{strangers:?} {own:?}");
    }

    #[test]
    fn another_skeleton_does_not_move_a_person_away_from_the_own_recordings() {
        let (model, population, names) = nine_walkers();
        // Distances of the plain projection and of the expected weights from the person's own, by (6) and by Mahalanobis.
        let distances = |s: u64| {
            let vector = model.vector_of(&synthetic::subject(Activity::Walking, s).cycle(1.2, 7));
            let own = model.project(&vector).rows(0, 12).into_owned();
            let zero = |axis: usize| 0.2 * 2f64.sqrt() * (1.3 * s as f64 + 2.7 * axis as f64).sin();
            let tracked = DVector::from_fn(vector.len(), |i, _| vector[i] + zero(i % DOF));
            let plain = model.project(&tracked).rows(0, 12).into_owned();
            let expected = recognise(&population, &model, &tracked, 1.2).unwrap().weights;
            let nearest = population.neighbours(&model, &expected, 1.2).swap_remove(0).subject;
            let far = |metric: Metric, weights: &DVector<f64>| metric.distance(&population.eigenvalues, weights, &own);
            (nearest, [Metric::Paper, Metric::Mahalanobis].map(|m| [far(m, &plain), far(m, &expected)]))
        };
        for s in 1..=9 {
            let (nearest, [paper, mahalanobis]) = distances(s);
            assert!(nearest == names[s as usize - 1], "{s}: {nearest}");
            assert!(paper[1] < 0.5 * paper[0] && mahalanobis[1] < 0.5 * mahalanobis[0], "{s}: {paper:?} {mahalanobis:?}");
        }
        // Somebody who is taken for another gains least by (6), which looks at the first weights only.
        let strangers: Vec<_> = (1000..1008).map(|s| distances(s).1).collect();
        let mean = |metric: usize, which: usize| strangers.iter().map(|d| d[metric][which]).sum::<f64>() / strangers.len() as f64;
        assert!(mean(0, 1) < mean(0, 0) && mean(1, 1) < 0.75 * mean(1, 0), "{strangers:?}");
    }

    #[test]
    fn one_cycle_each_says_nothing_of_their_spread() {
        let cycles: Vec<Cycle> = (1..=4).map(|s| synthetic::subject(Activity::Walking, s).cycle(1.2, 0)).collect();
        let model = Model::build(Activity::Walking, true, &cycles).unwrap();
        assert_eq!(recognise(&Population::new(&model, 3), &model, &model.vector_of(&cycles[0]), 1.2), None);
    }
}
