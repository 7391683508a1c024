//! Leave-one-subject-out validation (style paper §5.2).
//!
//! For every subject the model is built anew without it. Its motions at s1 are projected and carried to s2, for all ordered
//! pairs of its parameters, and compared with the projection of what was recorded there. Baselines: the population's mean at
//! s2 (`mean`), the own motion unchanged (`unchanged`), the own motion plus the population's mean change (`mean-change`).
//! `intra` compares cycles of the subject at one parameter, `inter` its cycles with everybody else's at any.
//! `rms_deg` is the rotation angle between synthesized and recorded joint rotations, pooled over cases, samples and the
//! joints that move in the recordings, against the recorded mean cycle itself.

use nalgebra::{DVector, Vector3};

use super::curves::{JUST_BEYOND, Knot, Population, knots, mean_vector};
use super::distance::Metric;
use super::extrapolate::extrapolate;
use crate::body::{BALL_JOINTS, DOF};
use crate::math::rotation::{exp, log};
use crate::motion_model::{Cycle, Member, Model, ModelError, SAMPLES};

/// A joint whose coordinates vary less than this over the subject's recordings is held still by the capture, radians.
const STILL_RAD: f64 = 0.003;

/// One line of `validation.csv`.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    pub method: &'static str,
    pub metric: &'static str,
    /// A subject or `all`.
    pub left_out: String,
    pub value: f64,
}

/// Scores, and how many of the cases needed the population's change because too few subjects were recorded at both ends.
#[derive(Clone, Debug)]
pub struct Validation {
    pub scores: Vec<Score>,
    pub cases: usize,
    pub sparse_cases: usize,
}

const METHODS: [&str; 6] = ["paper", "mean", "unchanged", "mean-change", "intra", "inter"];
const METRICS: [&str; 3] = ["eq6", "mahalanobis", "rms_deg"];

/// Sums of one left-out subject: per method and metric the sum and the count (squares for `rms_deg`).
#[derive(Clone, Default)]
struct Sums {
    sums: [[(f64, f64); METRICS.len()]; METHODS.len()],
    cases: usize,
    sparse_cases: usize,
}

impl Sums {
    fn add(&mut self, method: usize, eigenvalues: &[f64], a: &DVector<f64>, b: &DVector<f64>) {
        for (m, metric) in [Metric::Paper, Metric::Mahalanobis].into_iter().enumerate() {
            self.sums[method][m].0 += metric.distance(eigenvalues, a, b);
            self.sums[method][m].1 += 1.0;
        }
    }

    fn add_angles(&mut self, method: usize, squares: (f64, f64)) {
        let sum = &mut self.sums[method][2];
        *sum = (sum.0 + squares.0, sum.1 + squares.1);
    }
}

/// Scores of every subject and of all (means over subjects; angles pooled). `variance` chooses the components of every
/// rebuilt model.
pub fn validate(model: &Model, variance: f64) -> Result<Validation, ModelError> {
    let subjects: Vec<String> = model.subjects().into_iter().map(String::from).collect();
    let sums: Vec<Sums> = subjects.iter().map(|s| leave_out(model, s, variance)).collect::<Result<_, _>>()?;
    let mut scores = Vec::new();
    for (i, method) in METHODS.into_iter().enumerate() {
        for (j, metric) in METRICS.into_iter().enumerate() {
            let value = |(sum, count): (f64, f64)| if metric == "rms_deg" { (sum / count).sqrt().to_degrees() } else { sum / count };
            let found: Vec<(&String, (f64, f64))> =
                subjects.iter().zip(&sums).map(|(s, r)| (s, r.sums[i][j])).filter(|f| f.1.1 > 0.0).collect();
            if found.is_empty() {
                continue;
            }
            let mut push = |left_out: &str, value| scores.push(Score { method, metric, left_out: left_out.to_string(), value });
            found.iter().for_each(|(subject, sum)| push(subject, value(*sum)));
            let pooled = found.iter().fold((0.0, 0.0), |all, (_, s)| (all.0 + s.0, all.1 + s.1));
            let mean = found.iter().map(|(_, s)| value(*s)).sum::<f64>() / found.len() as f64;
            push("all", if metric == "rms_deg" { value(pooled) } else { mean });
        }
    }
    let total = |f: fn(&Sums) -> usize| sums.iter().map(f).sum();
    Ok(Validation { scores, cases: total(|s| s.cases), sparse_cases: total(|s| s.sparse_cases) })
}

fn leave_out(model: &Model, subject: &str, variance: f64) -> Result<Sums, ModelError> {
    let cycles =
        |own: bool| -> Vec<Cycle> { model.members.iter().filter(|m| (m.subject == subject) == own).map(|m| model.cycle_of(m)).collect() };
    let others = Model::build(model.activity, model.synthetic, &cycles(false))?;
    let others = others.truncated(others.components(variance));
    let own: Vec<Member> = cycles(true).iter().map(|c| others.member_of(c)).collect();
    let mut sums = Sums::default();
    let own_knots = knots(&own);
    interpolation(&others, &own_knots, &mut sums);
    variability(&others, &own, &own_knots, &mut sums);
    Ok(sums)
}

/// Methods 0 to 3 over all ordered pairs of the subject's parameters.
fn interpolation(others: &Model, own: &[Knot], sums: &mut Sums) {
    let population = Population::new(others, others.basis.ncols());
    let moving = moving_joints(own);
    let recorded: Vec<DVector<f64>> = own.iter().map(mean_vector).collect();
    for (i, from) in own.iter().enumerate() {
        for (k, to) in own.iter().enumerate().filter(|(k, _)| *k != i) {
            let observed = others.project(&recorded[i]);
            let target = others.project(&recorded[k]);
            let change = mean_change(&population, from.parameter, to.parameter);
            let Ok(paper) = extrapolate(&population, Metric::Paper, observed.as_slice(), from.parameter, to.parameter) else {
                continue;
            };
            sums.cases += 1;
            sums.sparse_cases += usize::from(paper.notice.is_some());
            let mean = population_mean(&population, to.parameter);
            for (method, weights) in [paper.weights, mean, observed.clone(), observed + change].into_iter().enumerate() {
                sums.add(method, &population.eigenvalues, &weights, &target);
                sums.add_angles(method, angle_squares(others, &moving, &others.vector(weights.as_slice()), &recorded[k]));
            }
        }
    }
}

/// Methods 4 and 5. Angles of `inter` are taken between mean cycles at parameters not farther apart than a subject takes part.
fn variability(others: &Model, own: &[Member], own_knots: &[Knot], sums: &mut Sums) {
    let l = &others.eigenvalues;
    let moving = moving_joints(own_knots);
    for knot in own_knots {
        for (i, a) in knot.members.iter().enumerate() {
            for b in &knot.members[..i] {
                sums.add(4, l, &others.project(&a.vector), &others.project(&b.vector));
                sums.add_angles(4, angle_squares(others, &moving, &a.vector, &b.vector));
            }
        }
    }
    let rest: Vec<DVector<f64>> = others.members.iter().map(|m| others.member_weights(m)).collect();
    for a in own {
        let a = others.project(&a.vector);
        rest.iter().for_each(|b| sums.add(5, l, &a, b));
    }
    for subject in others.subjects() {
        for b in knots(others.members.iter().filter(|m| m.subject == subject)) {
            for a in own_knots.iter().filter(|a| (a.parameter - b.parameter).abs() <= JUST_BEYOND) {
                sums.add_angles(5, angle_squares(others, &moving, &mean_vector(a), &mean_vector(&b)));
            }
        }
    }
}

/// Mean over the subjects that take part at `parameter`, over all (extended) where nobody does.
fn population_mean(population: &Population, parameter: f64) -> DVector<f64> {
    let nobody = !population.curves.iter().any(|c| c.takes_part(parameter));
    let there: Vec<DVector<f64>> =
        population.curves.iter().filter(|c| nobody || c.takes_part(parameter)).map(|c| population.extended(c, parameter)).collect();
    let n = there.len() as f64;
    there.into_iter().sum::<DVector<f64>>() / n
}

/// Mean change from s1 to s2 of the subjects recorded at both, the regression's where there are none.
fn mean_change(population: &Population, s1: f64, s2: f64) -> DVector<f64> {
    let changes: Vec<DVector<f64>> =
        population.curves.iter().filter(|c| c.takes_part(s1) && c.takes_part(s2)).map(|c| c.at(s2) - c.at(s1)).collect();
    if changes.is_empty() {
        return &population.slope * (s2 - s1);
    }
    let n = changes.len() as f64;
    changes.into_iter().sum::<DVector<f64>>() / n
}

/// Which ball joints move in these recordings.
fn moving_joints(knots: &[Knot]) -> [bool; BALL_JOINTS] {
    std::array::from_fn(|j| {
        (0..3).any(|axis| {
            let values = knots.iter().flat_map(|k| &k.members).flat_map(|m| (0..SAMPLES).map(move |s| m.vector[s * DOF + 3 * j + axis]));
            let (lo, hi) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)));
            hi - lo > STILL_RAD
        })
    })
}

/// Sum of squared rotation angles between two motion vectors, and how many.
fn angle_squares(model: &Model, moving: &[bool; BALL_JOINTS], a: &DVector<f64>, b: &DVector<f64>) -> (f64, f64) {
    let rotation = |v: &DVector<f64>, sample: usize, j: usize| {
        let at = sample * DOF + 3 * j;
        model.mean_rotations[j] * exp(&Vector3::new(v[at], v[at + 1], v[at + 2]))
    };
    let (mut sum, mut count) = (0.0, 0.0);
    for sample in 0..SAMPLES {
        for j in (0..BALL_JOINTS).filter(|&j| moving[j]) {
            sum += log(&(rotation(a, sample, j).inverse() * rotation(b, sample, j))).norm_squared();
            count += 1.0;
        }
    }
    (sum, count)
}
