//! Leave-one-subject-out validation (style paper §5.2, Figure 8).
//!
//! For every subject the model is built anew without it. Its mean motions at s1 are carried to s2, for all ordered pairs of its
//! parameters, and compared with what was recorded there. Methods: `default` ([`transfer`]), `paper` (equations 6 to 8 over the
//! components that hold `variance`), `several` (the default from all its other parameters at once); baselines: the population's
//! mean at s2 (`mean`), the own motion (`unchanged`), the own motion plus the population's mean change (`mean-change`). `intra`
//! compares cycles of the subject at one parameter, `inter` its cycles with everybody else's: at any parameter in weights, mean
//! cycles at one parameter in degrees and mm.
//!
//! Metrics: distances of weights, `eq6` and `mahalanobis`, over the components that hold `variance`; `rms_deg`, the root mean
//! square over cases, samples and the angles that the recordings hold ([`Angles`]); `rms_mm`, the root mean square distance of
//! [`errors::JOINTS`] on the template body with the subject's hip height, pelvis on pelvis. The last two are against the mean of the
//! recorded cycles, not its projection; methods that keep the own motion keep what the weights do not hold of it.

use nalgebra::{DVector, Vector3};
use rayon::prelude::*;

use super::angles::{Angles, wrapped};
use super::curves::{JUST_BEYOND, Knot, Population, knots, mean_root, mean_vector};
use super::distance::Metric;
use super::errors::{self, positions};
use super::extrapolate::extrapolate;
use super::transfer::transfer;
use super::{Observation, StyleError};
use crate::body::{NODES, Shape};
use crate::motion_model::{Cycle, Detail, Member, Model, ModelError};

/// In the order of [`METHODS`].
#[derive(Clone, Copy)]
enum Row {
    Default,
    Paper,
    Several,
    Mean,
    Unchanged,
    MeanChange,
    Intra,
    Inter,
}

const METHODS: [&str; 8] = ["default", "paper", "several", "mean", "unchanged", "mean-change", "intra", "inter"];
pub const METRICS: [&str; 4] = ["eq6", "mahalanobis", "rms_deg", "rms_mm"];

/// One line of `validation.csv`.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    pub method: &'static str,
    /// One of [`METRICS`], in [`Validation::angles`] the name of an angle.
    pub metric: String,
    /// A subject or `all`.
    pub left_out: String,
    pub value: f64,
}

/// One line of `pairs.csv`: a left-out subject's motion at one parameter carried to another.
#[derive(Clone, Debug, PartialEq)]
pub struct PairScore {
    pub left_out: String,
    /// m/s or m.
    pub from: f64,
    pub to: f64,
    pub method: &'static str,
    pub rms_deg: f64,
    pub rms_mm: f64,
}

/// What the validation found.
#[derive(Clone, Debug)]
pub struct Validation {
    pub scores: Vec<Score>,
    /// Degrees of every angle.
    pub angles: Vec<Score>,
    /// Every ordered pair of parameters.
    pub pairs: Vec<PairScore>,
    pub cases: usize,
    /// Cases in which too few other subjects were recorded at both ends.
    pub sparse_cases: usize,
    /// Root mean square of the default's errors over their predicted standard deviations; 1 is exact.
    pub sd_ratio: f64,
}

/// A sum and how many it has.
type Sum = (f64, f64);

/// Sums of one method.
#[derive(Clone, Default)]
struct Sums {
    distances: [Sum; 2],
    /// Squares per angle.
    angles: Vec<Sum>,
    /// Squared distances, m².
    positions: Sum,
}

/// Sums of one left-out subject.
struct LeftOut {
    methods: Vec<Sums>,
    pairs: Vec<PairScore>,
    cases: usize,
    sparse_cases: usize,
    /// Squared error over variance, of the default's weights.
    spread: Sum,
}

/// Weights and what they do not hold.
type Motion = (DVector<f64>, Option<Detail>);

/// A motion in the three forms that are compared.
struct Shown {
    weights: DVector<f64>,
    angles: DVector<f64>,
    positions: Vec<Vector3<f64>>,
}

/// Scores of every subject and of all (distances: means over subjects; degrees and mm pooled). `variance` chooses the components
/// of the distances and of `paper` in every rebuilt model.
pub fn validate(model: &Model, variance: f64) -> Result<Validation, ModelError> {
    let subjects: Vec<&str> = model.subjects();
    let angles = Angles::of_recordings(model);
    let found: Vec<LeftOut> = subjects.par_iter().map(|s| leave_out(model, &angles, s, variance)).collect::<Result<_, _>>()?;
    let (mut scores, mut by_angle) = (Vec::new(), Vec::new());
    for (row, method) in METHODS.into_iter().enumerate() {
        let one: Vec<&Sums> = found.iter().map(|f| &f.methods[row]).collect();
        for (m, metric) in METRICS.into_iter().enumerate() {
            let sums: Vec<Sum> = one.iter().map(|s| metric_sum(s, m)).collect();
            table(&mut scores, method, metric, &subjects, &sums, (m > 1).then_some(if m == 2 { 1f64.to_degrees() } else { 1e3 }));
        }
        for (i, name) in angles.names().into_iter().enumerate() {
            let sums: Vec<Sum> = one.iter().map(|s| s.angles[i]).collect();
            table(&mut by_angle, method, name, &subjects, &sums, Some(1f64.to_degrees()));
        }
    }
    let spread = found.iter().map(|f| f.spread).fold((0.0, 0.0), plus);
    Ok(Validation {
        scores,
        angles: by_angle,
        pairs: found.iter().flat_map(|f| f.pairs.clone()).collect(),
        cases: found.iter().map(|f| f.cases).sum(),
        sparse_cases: found.iter().map(|f| f.sparse_cases).sum(),
        sd_ratio: (spread.0 / spread.1).sqrt(),
    })
}

fn plus(a: Sum, b: Sum) -> Sum {
    (a.0 + b.0, a.1 + b.1)
}

fn metric_sum(sums: &Sums, metric: usize) -> Sum {
    match metric {
        0 | 1 => sums.distances[metric],
        2 => sums.angles.iter().copied().fold((0.0, 0.0), plus),
        _ => sums.positions,
    }
}

/// Lines of all subjects and of `all`: roots of pooled squares in a unit, or means.
fn table(scores: &mut Vec<Score>, method: &'static str, metric: &str, subjects: &[&str], sums: &[Sum], root_unit: Option<f64>) {
    let value = |(sum, count): Sum| root_unit.map_or(sum / count, |unit| unit * (sum / count).sqrt());
    let there: Vec<(&str, Sum)> = subjects.iter().copied().zip(sums.iter().copied()).filter(|s| s.1.1 > 0.0).collect();
    if there.is_empty() {
        return;
    }
    let mut push = |left_out: &str, value| scores.push(Score { method, metric: metric.to_string(), left_out: left_out.to_string(), value });
    there.iter().for_each(|(subject, sum)| push(subject, value(*sum)));
    let pooled = there.iter().map(|s| s.1).fold((0.0, 0.0), plus);
    let mean = there.iter().map(|s| value(s.1)).sum::<f64>() / there.len() as f64;
    push("all", if root_unit.is_some() { value(pooled) } else { mean });
}

/// The model without the subject and what comparing needs.
struct Bench<'a> {
    others: Model,
    /// All stored components.
    population: Population,
    /// Those of `variance`.
    truncated: Population,
    angles: &'a Angles,
    offsets: [Vector3<f64>; NODES],
}

fn leave_out(model: &Model, angles: &Angles, subject: &str, variance: f64) -> Result<LeftOut, ModelError> {
    let cycles =
        |own: bool| -> Vec<Cycle> { model.members.iter().filter(|m| (m.subject == subject) == own).map(|m| model.cycle_of(m)).collect() };
    let others = Model::build(model.activity, model.synthetic, &cycles(false))?;
    let own: Vec<Member> = cycles(true).iter().map(|c| others.member_of(c)).collect();
    let stature = own.first().map_or(1.0, |m| m.hip_height_m) / errors::HIP_OF_STATURE;
    let bench = Bench {
        population: Population::new(&others, others.basis.ncols()),
        truncated: Population::new(&others, others.components(variance)),
        others,
        angles,
        offsets: Shape::template(stature).offsets(),
    };
    let sums = Sums { angles: vec![(0.0, 0.0); angles.names().len()], ..Sums::default() };
    let mut found = LeftOut { methods: vec![sums; METHODS.len()], pairs: Vec::new(), cases: 0, sparse_cases: 0, spread: (0.0, 0.0) };
    let own_knots = knots(&own);
    bench.interpolation(&own_knots, &mut found);
    bench.variability(&own, &own_knots, &mut found);
    Ok(found)
}

impl Bench<'_> {
    /// The six methods over all ordered pairs of the subject's parameters.
    fn interpolation(&self, own: &[Knot], found: &mut LeftOut) {
        let recorded: Vec<Shown> = own.iter().map(|k| self.recorded(k)).collect();
        let seen: Vec<Observation> = own.iter().map(|k| Observation::of_knot(&self.others, k)).collect();
        for (to, target) in own.iter().zip(&recorded) {
            for (from, observed) in own.iter().zip(&seen).filter(|(k, _)| k.parameter != to.parameter) {
                let Ok(motions) = self.carried(observed, from.parameter, to.parameter, target, found) else { continue };
                for (row, (weights, detail)) in motions {
                    let shown = self.shown(&weights, detail.as_ref());
                    found.methods[row as usize].add(self, &shown, target);
                    found.pairs.push(self.pair(from, to, METHODS[row as usize], &shown, target));
                }
            }
            let rest: Vec<Observation> = seen.iter().filter(|o| o.parameter != to.parameter).cloned().collect();
            if rest.len() > 1
                && let Ok(several) = transfer(&self.population, &rest, to.parameter)
            {
                let shown = self.shown(&several.weights, several.detail.as_ref());
                found.methods[Row::Several as usize].add(self, &shown, target);
            }
        }
    }

    fn pair(&self, from: &Knot, to: &Knot, method: &'static str, found: &Shown, target: &Shown) -> PairScore {
        let mut sums = Sums { angles: vec![(0.0, 0.0); self.angles.names().len()], ..Sums::default() };
        sums.add_shapes(found, target);
        let rms = |(sum, count): Sum| (sum / count).sqrt();
        PairScore {
            left_out: from.members[0].subject.clone(),
            from: from.parameter,
            to: to.parameter,
            method,
            rms_deg: rms(metric_sum(&sums, 2)).to_degrees(),
            rms_mm: 1e3 * rms(metric_sum(&sums, 3)),
        }
    }

    /// What each method makes of one observation.
    fn carried(
        &self,
        observed: &Observation,
        s1: f64,
        s2: f64,
        target: &Shown,
        found: &mut LeftOut,
    ) -> Result<[(Row, Motion); 5], StyleError> {
        let (own, detail) = (DVector::from_column_slice(&observed.weights), observed.detail.clone());
        let default = transfer(&self.population, std::slice::from_ref(observed), s2)?;
        let paper = extrapolate(&self.truncated, Metric::Paper, &observed.weights, s1, s2)?;
        found.cases += 1;
        found.sparse_cases += usize::from(paper.notice.is_some());
        for ((a, b), sd) in default.weights.iter().zip(&target.weights).zip(default.sd.iter().flatten()).filter(|(_, sd)| **sd > 0.0) {
            found.spread = plus(found.spread, (((a - b) / sd).powi(2), 1.0));
        }
        Ok([
            (Row::Default, (default.weights, default.detail)),
            (Row::Paper, (paper.weights, None)),
            (Row::Mean, (self.population_mean(s2), None)),
            (Row::Unchanged, (own.clone(), detail.clone())),
            (Row::MeanChange, (own + self.mean_change(s1, s2), detail)),
        ])
    }

    fn variability(&self, own: &[Member], own_knots: &[Knot], found: &mut LeftOut) {
        let rest: Vec<DVector<f64>> =
            self.others.leading_weights(self.others.basis.ncols()).column_iter().map(|weights| weights.into_owned()).collect();
        let all: Vec<Shown> = own.iter().map(|m| self.shown_member(m)).collect();
        for (i, a) in own.iter().enumerate() {
            let same = |b: &&Member| own_knots.iter().any(|k| [a, *b].iter().all(|m| k.members.iter().any(|n| std::ptr::eq(*n, *m))));
            for (k, _) in own[..i].iter().enumerate().filter(|(_, b)| same(b)) {
                found.methods[Row::Intra as usize].add(self, &all[i], &all[k]);
            }
            rest.iter().for_each(|b| found.methods[Row::Inter as usize].add_distances(self, &all[i].weights, b));
        }
        let recorded: Vec<Shown> = own_knots.iter().map(|k| self.recorded(k)).collect();
        for subject in self.others.subjects() {
            for b in knots(self.others.members.iter().filter(|m| m.subject == subject)) {
                let near = own_knots.iter().zip(&recorded).filter(|(a, _)| (a.parameter - b.parameter).abs() <= JUST_BEYOND);
                let other = self.recorded(&b);
                near.for_each(|(_, a)| found.methods[Row::Inter as usize].add_shapes(a, &other));
            }
        }
    }

    /// The mean of recorded cycles.
    fn recorded(&self, knot: &Knot) -> Shown {
        let cycles: Vec<Cycle> = knot.members.iter().map(|m| self.others.cycle_of(m)).collect();
        let mean = Member { vector: mean_vector(knot), root: mean_root(knot), ..(*knot.members[0]).clone() };
        let shown = self.shown_member(&mean);
        Shown { angles: self.angles.mean(&cycles).unwrap_or(shown.angles), ..shown }
    }

    fn shown_member(&self, member: &Member) -> Shown {
        let cycle = self.others.cycle_of(member);
        Shown { weights: self.others.member_weights(member), angles: self.angles.of(&cycle), positions: positions(&cycle, &self.offsets) }
    }

    fn shown(&self, weights: &DVector<f64>, detail: Option<&Detail>) -> Shown {
        let cycle = self.others.cycle_with(weights.as_slice(), detail, 0.0, 1.0, 1.0);
        Shown { weights: weights.clone(), angles: self.angles.of(&cycle), positions: positions(&cycle, &self.offsets) }
    }

    /// Mean over the subjects that take part at `parameter`, over all (extended) where nobody does.
    fn population_mean(&self, parameter: f64) -> DVector<f64> {
        let population = &self.population;
        let nobody = !population.curves.iter().any(|c| c.takes_part(parameter));
        let there: Vec<DVector<f64>> =
            population.curves.iter().filter(|c| nobody || c.takes_part(parameter)).map(|c| population.extended(c, parameter)).collect();
        let n = there.len() as f64;
        there.into_iter().sum::<DVector<f64>>() / n
    }

    /// Mean change from s1 to s2 of the subjects recorded at both, the regression's where there are none.
    fn mean_change(&self, s1: f64, s2: f64) -> DVector<f64> {
        let both = self.population.curves.iter().filter(|c| c.takes_part(s1) && c.takes_part(s2));
        let changes: Vec<DVector<f64>> = both.map(|c| c.at(s2) - c.at(s1)).collect();
        if changes.is_empty() {
            return &self.population.slope * (s2 - s1);
        }
        let n = changes.len() as f64;
        changes.into_iter().sum::<DVector<f64>>() / n
    }
}

impl Sums {
    fn add(&mut self, bench: &Bench, a: &Shown, b: &Shown) {
        self.add_distances(bench, &a.weights, &b.weights);
        self.add_shapes(a, b);
    }

    fn add_distances(&mut self, bench: &Bench, a: &DVector<f64>, b: &DVector<f64>) {
        for (sum, metric) in self.distances.iter_mut().zip([Metric::Paper, Metric::Mahalanobis]) {
            *sum = plus(*sum, (metric.distance(&bench.truncated.eigenvalues, a, b), 1.0));
        }
    }

    fn add_shapes(&mut self, a: &Shown, b: &Shown) {
        let count = self.angles.len();
        for (i, (a, b)) in a.angles.iter().zip(&b.angles).enumerate() {
            let sum = &mut self.angles[i % count];
            *sum = plus(*sum, (wrapped(a - b).powi(2), 1.0));
        }
        for (a, b) in a.positions.iter().zip(&b.positions) {
            self.positions = plus(self.positions, ((a - b).norm_squared(), 1.0));
        }
    }
}
