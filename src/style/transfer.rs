//! The same person at another speed or length, own motion kept: the default.
//!
//! A person is the mean of like people plus a deviation of its own, and deviations last while the parameter s changes:
//!   α^x(s) = m(s) + d(s),   m(s) = Σ_p w_p α^{p,s},   cov(d(s), d(t)) = e^{β(s+t)} e^{−κ|s−t|} Σ                    (1)
//! with the weights (7) of the style paper from the distances at the observed parameters. Given the observations α_k at s_k
//! the best linear prediction is
//!   α̃(s2) = m(s2) + Σ_k c_k (α_k − m(s_k)),   c = K⁻¹ k                                                           (2)
//! which for one observation is the own motion plus the weighted change, the deviation scaled by g = e^{βδ−κ|δ|}, δ = s2−s1.
//! What the weights do not hold of a recorded motion ([`Detail`]) is part of the deviation. Everybody in the database takes part
//! at every parameter, carried beyond the own recordings by the population's change: the few who were recorded at both make a
//! poorer mean, and one that jumps where somebody's recordings end. β (faster people differ more) and
//! κ (nobody's change is quite everybody's) are those that best predict every database subject from the others, [`Lasting`].
//!
//! Variance of weight i: Σ_k c_k² var(α_k,i) + v_i h + b² u_i. h is the part of the deviation's variance that the observations
//! leave open in (1), v_i the scale that makes it right for the database's subjects, b how far s2 lies outside what anybody
//! recorded and u_i the variance between the subjects' slopes, since there the change is a straight line.
//!
//! Kriging with an Ornstein-Uhlenbeck covariance (Rasmussen and Williams, Gaussian Processes for Machine Learning, 4.2).
//! The paper's own scheme, without the deviation, is `extrapolate`.
//! Fails when: fewer than three subjects were recorded at two parameters; then β = κ = 0, and a notice says so.
//! Checked against a population drawn from (1), the closed form for two observations, and numpy on recorded runners.

use nalgebra::{DMatrix, DVector};

use super::curves::{Curve, Population};
use super::distance::{Metric, inverse_distance_weights};
use super::extrapolate::{Extrapolation, StyleError, shared_subjects};
use super::{Detail, Observation};

/// κ below which the variance left open is no measure, per m/s or m.
const LEAST_FADE: f64 = 1e-3;
/// Part added to the diagonal of K against observations at nearly one parameter.
const NUGGET: f64 = 1e-6;

/// How deviations from like people last over the parameter.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Lasting {
    /// β of (1).
    pub growth: f64,
    /// κ of (1), not negative.
    pub fade: f64,
    /// v_i, per component.
    pub scale: Vec<f64>,
    /// u_i: variance between subjects of the change per unit of the parameter.
    pub slope_variance: Vec<f64>,
    /// Ordered pairs of parameters of one subject that β and κ were found with.
    pub pairs: usize,
}

/// A subject's deviations from the others at two of its parameters.
struct Pair {
    s1: f64,
    s2: f64,
    d1: DVector<f64>,
    d2: DVector<f64>,
}

impl Lasting {
    /// Every subject predicted from the others, at all ordered pairs of its parameters.
    pub fn of(population: &Population) -> Lasting {
        let count = population.components();
        let pairs: Vec<Pair> = (0..population.curves.len()).flat_map(|p| pairs(population, p)).collect();
        let sums: Vec<[f64; 4]> = pairs.iter().map(|p| [p.s2 - p.s1, p.d1.norm_squared(), p.d1.dot(&p.d2), p.d2.norm_squared()]).collect();
        let (growth, fade) = if pairs.is_empty() { (0.0, 0.0) } else { best(&sums) };
        let slope_variance = slopes(population);
        let mut lasting = Lasting { growth, fade, scale: vec![0.0; count], slope_variance, pairs: pairs.len() };
        let (mut squares, mut open) = (DVector::zeros(count), 0.0);
        for pair in &pairs {
            let (c, h) = lasting.prediction(&[pair.s1], pair.s2);
            let missed = &pair.d2 - &pair.d1 * c[0];
            squares += missed.component_mul(&missed);
            open += h;
        }
        if open > 0.0 {
            lasting.scale = (squares / open).as_slice().to_vec();
        }
        lasting
    }

    fn covariance(&self, s: f64, t: f64, fade: f64) -> f64 {
        (self.growth * (s + t) - fade * (s - t).abs()).exp()
    }

    /// c of (2) and h, the variance that stays open.
    fn prediction(&self, observed: &[f64], s2: f64) -> (DVector<f64>, f64) {
        let solve = |fade: f64| {
            let k = DVector::from_iterator(observed.len(), observed.iter().map(|&s| self.covariance(s, s2, fade)));
            let between = DMatrix::from_fn(observed.len(), observed.len(), |i, j| {
                self.covariance(observed[i], observed[j], fade) * if i == j { 1.0 + NUGGET } else { 1.0 }
            });
            let c = between.cholesky().map_or_else(|| DVector::from_element(observed.len(), 1.0 / observed.len() as f64), |l| l.solve(&k));
            let open = self.covariance(s2, s2, fade) - k.dot(&c);
            (c, open.max(0.0))
        };
        let (c, _) = solve(self.fade);
        (c, solve(self.fade.max(LEAST_FADE)).1)
    }
}

/// All ordered pairs of subject `p`'s parameters with its deviations from the others.
fn pairs(population: &Population, p: usize) -> Vec<Pair> {
    let (own, others) = (&population.curves[p], population.without(p));
    let mut found = Vec::new();
    if others.curves.iter().filter(|c| c.parameters().len() > 1).count() < 2 {
        return found;
    }
    for &s1 in own.parameters() {
        for &s2 in own.parameters().iter().filter(|&&s2| s2 != s1) {
            let (a1, a2) = (own.at(s1), own.at(s2));
            let like = like(&others, &[(s1, a1.clone())]);
            found.push(Pair { s1, s2, d1: a1 - mean(&others, &like, s1), d2: a2 - mean(&others, &like, s2) });
        }
    }
    found
}

/// Everybody with the weights (7).
fn like<'a>(population: &'a Population, observed: &[(f64, DVector<f64>)]) -> Vec<(&'a Curve, f64)> {
    let distance = |c: &Curve| {
        let to = |(s, a): &(f64, DVector<f64>)| Metric::Paper.distance(&population.eigenvalues, a, &population.extended(c, *s));
        observed.iter().map(to).sum::<f64>() / observed.len() as f64
    };
    let shares = inverse_distance_weights(&population.curves.iter().map(distance).collect::<Vec<_>>());
    population.curves.iter().zip(shares).collect()
}

fn mean(population: &Population, like: &[(&Curve, f64)], parameter: f64) -> DVector<f64> {
    let mut sum = DVector::zeros(population.components());
    like.iter().for_each(|(curve, share)| sum.axpy(*share, &population.extended(curve, parameter), 1.0));
    sum
}

/// β and κ with the least squared error of g d1 against d2, from rows δ, d1·d1, d1·d2, d2·d2.
/// For a gain g per sign and size of δ the error is a parabola; two numbers are found by ever finer grids.
fn best(sums: &[[f64; 4]]) -> (f64, f64) {
    let error = |growth: f64, fade: f64| -> f64 {
        let one = |[delta, aa, ab, bb]: &[f64; 4]| {
            let gain = (growth * delta - fade * delta.abs()).exp();
            bb - 2.0 * gain * ab + gain * gain * aa
        };
        sums.iter().map(one).sum()
    };
    let far = sums.iter().map(|s| s[0].abs()).fold(0.0, f64::max);
    // From the longest step's gains of e^±2 down to a thousandth.
    let (mut at, mut step) = ((0.0, 0.0), 0.5 / far);
    let mut least = error(at.0, at.1);
    for _ in 0..12 {
        loop {
            let around = (-1..=1).flat_map(|i| (-1..=1).map(move |k| (i, k)));
            let near = around.map(|(i, k)| (at.0 + f64::from(i) * step, (at.1 + f64::from(k) * step).max(0.0)));
            let Some((value, place)) = near.map(|p| (error(p.0, p.1), p)).min_by(|a, b| a.0.total_cmp(&b.0)) else { break };
            if value >= least * (1.0 - 1e-12) {
                break;
            }
            (least, at) = (value, place);
        }
        step *= 0.5;
    }
    at
}

/// Variance between the subjects of the straight line through their own weights.
fn slopes(population: &Population) -> Vec<f64> {
    let own: Vec<DVector<f64>> = population.curves.iter().filter_map(Curve::slope).collect();
    let mut sum = DVector::zeros(population.components());
    own.iter().map(|s| s - &population.slope).for_each(|d| sum += d.component_mul(&d));
    (sum / (own.len().max(2) - 1) as f64).as_slice().to_vec()
}

/// Equation (2): one person's `observations`, wanted at `s2` (m/s or m).
pub fn transfer(population: &Population, observations: &[Observation], s2: f64) -> Result<Extrapolation, StyleError> {
    let count = population.components();
    for observation in observations {
        observation.check(count)?;
    }
    let observed: Vec<(f64, DVector<f64>)> =
        observations.iter().map(|o| (o.parameter, DVector::from_column_slice(&o.weights[..count]))).collect();
    let parameters: Vec<f64> = observed.iter().map(|o| o.0).collect();
    let notice = notice(population, &parameters, s2);
    let like = like(population, &observed);
    let lasting = &population.lasting;
    let (c, open) = lasting.prediction(&parameters, s2);
    let mut weights = mean(population, &like, s2);
    for ((s, alpha), c) in observed.iter().zip(&c) {
        weights.axpy(*c, &(alpha - mean(population, &like, *s)), 1.0);
    }
    let beyond = population.beyond(s2);
    let variance = |i: usize| {
        let seen: f64 = observations.iter().zip(&c).map(|(o, c)| c * c * o.variance(i)).sum();
        seen + lasting.scale[i] * open + beyond * beyond * lasting.slope_variance[i]
    };
    let sd = (0..count).map(|i| variance(i).sqrt()).collect();
    let detail = Detail::sum(observations.iter().zip(&c).filter_map(|(o, c)| Some((o.detail.as_ref()?, *c))));
    let shares = like.iter().map(|(curve, share)| (curve.subject.clone(), *share)).collect();
    Ok(Extrapolation { weights, detail, sd: Some(sd), shares, notice })
}

fn notice(population: &Population, observed: &[f64], s2: f64) -> Option<String> {
    let list: Vec<String> = observed.iter().map(|s| format!("{s:.2}")).collect();
    let (lo, hi) = population.range();
    if population.beyond(s2) > 0.0 {
        return Some(format!(
            "nobody in the database was recorded at {s2:.2} ({lo:.2} to {hi:.2} were): the change goes on as a straight line, less certain the farther"
        ));
    }
    let all: Vec<&Curve> = population.curves.iter().collect();
    if shared_subjects(&all, observed.iter().copied().chain([s2])).is_none() {
        return Some(format!(
            "fewer than two database subjects were recorded both at {} and at {s2:.2}: the others are carried there by the \
             population's mean change",
            list.join(", ")
        ));
    }
    (population.lasting.pairs == 0)
        .then(|| "no three database subjects were recorded at two parameters each: the own deviation is kept whole".to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{BALL_JOINTS, DOF};
    use crate::motion_model::{Activity, Member, Model, ROOT_CHANNELS, SAMPLES};
    use nalgebra::UnitQuaternion;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const GRID: [f64; 4] = [2.0, 3.0, 4.0, 5.0];
    const SUBJECTS: usize = 40;
    /// Coordinates that differ between people.
    const WIDTH: usize = 30;

    /// Motion vectors of people drawn from equation (1): a common curve and a deviation that grows and fades.
    fn people(growth: f64, fade: f64) -> Vec<Member> {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut normal = || -> f64 { (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0 };
        let mut members = Vec::new();
        for subject in 0..SUBJECTS {
            let mut d: Vec<f64> = (0..WIDTH).map(|_| normal()).collect();
            for (k, s) in GRID.into_iter().enumerate() {
                if k > 0 {
                    let kept = (-fade * (s - GRID[k - 1])).exp();
                    d.iter_mut().for_each(|d| *d = kept * *d + (1.0 - kept * kept).sqrt() * normal());
                }
                let mut vector = DVector::zeros(SAMPLES * DOF);
                (0..WIDTH).for_each(|i| vector[i] = (growth * s).exp() * d[i] + 3.0 * (0.5 * s + i as f64).sin());
                members.push(Member {
                    subject: format!("{subject}"),
                    source: String::new(),
                    parameter: s,
                    hip_height_m: 0.9,
                    duration_s: 1.0,
                    vector,
                    root: DVector::zeros(SAMPLES * ROOT_CHANNELS),
                });
            }
        }
        members
    }

    fn model(members: &[Member]) -> Model {
        Model::from_members(Activity::Running, false, [UnitQuaternion::identity(); BALL_JOINTS], members.to_vec()).unwrap()
    }

    fn observed(model: &Model, member: &Member) -> Observation {
        let weights = model.member_weights(member).as_slice().to_vec();
        Observation { parameter: member.parameter, weights, covariance: None, cadence_factor: 1.0, detail: None }
    }

    #[test]
    fn the_populations_own_law_is_found() {
        for (growth, fade) in [(0.15, 0.1), (0.0, 0.4), (0.1, 0.0)] {
            let model = model(&people(growth, fade));
            let found = Population::new(&model, model.basis.ncols()).lasting;
            assert_eq!(found.pairs, 12 * SUBJECTS);
            assert!((found.growth - growth).abs() < 0.04 && (found.fade - fade).abs() < 0.06, "{growth} {fade}: {found:?}");
        }
    }

    /// For people of law (1) the prediction must beat both keeping the deviation whole and dropping it, with honest spread.
    #[test]
    fn people_never_seen_are_predicted_with_honest_spread() {
        let all = people(0.15, 0.3);
        let (known, new) = all.split_at(4 * (SUBJECTS - 10));
        let model = model(known);
        let population = Population::new(&model, model.basis.ncols());
        let mut errors = [0.0; 3];
        let (mut ratio, mut count) = (0.0, 0.0);
        for person in new.chunks_exact(4) {
            for (from, to) in (0..4).flat_map(|i| (0..4).map(move |k| (i, k))).filter(|(i, k)| i != k) {
                let own = observed(&model, &person[from]);
                let truth = model.member_weights(&person[to]);
                let found = transfer(&population, std::slice::from_ref(&own), GRID[to]).unwrap();
                assert!(found.notice.is_none());
                let mean = |s: f64| -> DVector<f64> {
                    population.curves.iter().map(|c| c.at(s)).sum::<DVector<f64>>() / population.curves.len() as f64
                };
                let kept = DVector::from_vec(own.weights.clone()) - mean(GRID[from]) + mean(GRID[to]);
                for (sum, other) in errors.iter_mut().zip([&found.weights, &kept, &mean(GRID[to])]) {
                    *sum += (other - &truth).norm_squared();
                }
                for (i, sd) in found.sd.unwrap().iter().enumerate() {
                    ratio += ((found.weights[i] - truth[i]) / sd).powi(2);
                    count += 1.0;
                }
            }
        }
        assert!(errors[0] < 0.85 * errors[1] && errors[0] < 0.85 * errors[2], "{errors:?}");
        let ratio: f64 = f64::sqrt(ratio / count);
        assert!((0.8..1.25).contains(&ratio), "errors are {ratio} of their deviations");
    }

    #[test]
    fn two_observations_by_the_closed_form() {
        let lasting = Lasting { growth: 0.0, fade: 0.5, scale: vec![], slope_variance: vec![], pairs: 1 };
        // Between two observations of an Ornstein-Uhlenbeck process: sinh of the distances to the other end.
        let (c, open) = lasting.prediction(&[2.0, 5.0], 4.0);
        let sinh = |x: f64| (0.5 * x).sinh();
        for (found, wanted) in c.iter().zip([sinh(1.0) / sinh(3.0), sinh(2.0) / sinh(3.0)]) {
            assert!((found - wanted).abs() < 1e-5, "{c:?}");
        }
        assert!((open - 2.0 * sinh(1.0) * sinh(2.0) / sinh(3.0)).abs() < 1e-5, "{open}");
        let lasting = Lasting { growth: 0.2, ..lasting };
        let (c, _) = lasting.prediction(&[3.0], 5.0);
        assert!((c[0] - (0.4f64 - 1.0).exp()).abs() < 1e-5);
    }

    #[test]
    fn an_observed_parameter_comes_back_and_spread_widens_outside() {
        let all = people(0.1, 0.2);
        let model = model(&all[4..]);
        let population = Population::new(&model, model.basis.ncols());
        let own: Vec<Observation> = [0, 2].map(|k| observed(&model, &all[k])).into();
        let at_seen = transfer(&population, &own, 4.0).unwrap();
        assert!((&at_seen.weights - DVector::from_vec(own[1].weights.clone())).norm() < 1e-3);
        let spread = |s: f64| -> f64 { transfer(&population, &own, s).unwrap().sd.unwrap().iter().map(|v| v * v).sum::<f64>().sqrt() };
        assert!(spread(4.0) < 0.1 * spread(3.0) && spread(3.0) < spread(5.0));
        assert!(spread(5.0) < 0.8 * spread(6.0) && spread(6.0) < 0.8 * spread(8.0), "{} {} {}", spread(5.0), spread(6.0), spread(8.0));
        assert!(transfer(&population, &own, 6.0).unwrap().notice.unwrap().contains("nobody in the database was recorded at 6.00"));
        let seen = Observation { covariance: Some(vec![vec![0.5, 0.0], vec![0.0, 0.1]]), ..own[1].clone() };
        let sd = transfer(&population, &[seen], 4.0).unwrap().sd.unwrap();
        assert!((sd[0] * sd[0] - 0.5).abs() < 1e-3 && (sd[1] * sd[1] - 0.1).abs() < 1e-3);
    }

    #[test]
    fn without_common_parameters_the_deviation_is_kept_whole() {
        let members: Vec<Member> = people(0.1, 0.2).into_iter().step_by(5).take(8).collect();
        let model = model(&members);
        let population = Population::new(&model, 2);
        assert_eq!((population.lasting.pairs, population.lasting.growth, population.lasting.fade), (0, 0.0, 0.0));
        let own = Observation { weights: vec![1.0, -2.0], ..observed(&model, &members[0]) };
        let found = transfer(&population, &[own], 3.0).unwrap();
        assert!(found.notice.is_some() && found.weights.iter().all(|w| w.is_finite()));
        let bad = Observation { weights: vec![1.0], ..observed(&model, &members[0]) };
        assert_eq!(transfer(&population, &[bad], 3.0).unwrap_err(), StyleError::Weights { found: 1, wanted: 2 });
    }
}
