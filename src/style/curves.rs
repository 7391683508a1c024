//! Database subjects as curves of weights over the motion parameter.
//!
//! α^{p,s} is the mean over subject p's cycles at s. Recorded speeds scatter in real databases, so cycles closer than
//! [`SAME_PARAMETER`] make one knot; between knots runs a natural cubic spline. Splines are linear in their values: on a full
//! grid of parameters the weighted sum of subjects' splines is the paper's spline of the weighted sums.
//! A subject takes part at s inside the recorded range and [`JUST_BEYOND`] it. Farther out a subject keeps its own end and
//! follows the population's change, the regression of α on s within subjects, each of which counts once: between subjects the
//! same line would take for a change what is a difference of people who were recorded at other speeds.
//! Checked against the grid case of the paper and a population with a known slope.

use nalgebra::DVector;

use super::Neighbour;
use super::distance::Metric;
use super::transfer::Lasting;
use crate::math::spline::Spline;
use crate::motion_model::{Member, Model};

/// Parameters (m/s or m) closer than this are one knot. Wider loses real speeds (the paper's are 0.14 m/s apart), narrower
/// makes splines swing between scattered trials.
pub const SAME_PARAMETER: f64 = 0.1;
/// How far outside its recordings (m/s or m) a subject still takes part.
pub const JUST_BEYOND: f64 = 0.15;

/// Cycles of one subject at one parameter.
#[derive(Clone, Debug)]
pub struct Knot<'a> {
    /// Mean parameter of the cycles.
    pub parameter: f64,
    pub members: Vec<&'a Member>,
}

/// Groups one subject's cycles by parameter, smallest first.
pub fn knots<'a>(members: impl IntoIterator<Item = &'a Member>) -> Vec<Knot<'a>> {
    let mut sorted: Vec<&Member> = members.into_iter().collect();
    sorted.sort_by(|a, b| a.parameter.total_cmp(&b.parameter));
    let mut groups: Vec<Vec<&Member>> = Vec::new();
    for member in sorted {
        match groups.last_mut() {
            Some(group) if member.parameter - group[0].parameter < SAME_PARAMETER => group.push(member),
            _ => groups.push(vec![member]),
        }
    }
    let mean = |group: &[&Member]| group.iter().map(|m| m.parameter).sum::<f64>() / group.len() as f64;
    groups.into_iter().map(|members| Knot { parameter: mean(&members), members }).collect()
}

/// One subject's weights over the parameter.
#[derive(Clone, Debug)]
pub struct Curve {
    pub subject: String,
    spline: Spline,
}

impl Curve {
    /// Whether the subject was recorded at `parameter` or just beside it.
    pub fn takes_part(&self, parameter: f64) -> bool {
        let (first, last) = self.spline.range();
        (first - JUST_BEYOND..=last + JUST_BEYOND).contains(&parameter)
    }

    /// Weights at a parameter at which the subject takes part.
    pub fn at(&self, parameter: f64) -> DVector<f64> {
        self.spline.at(parameter)
    }

    /// First and last parameter of the recordings.
    pub fn range(&self) -> (f64, f64) {
        self.spline.range()
    }

    /// Parameters of the recordings, smallest first.
    pub fn parameters(&self) -> &[f64] {
        self.spline.knots()
    }

    /// Change of the weights per unit of the parameter over the own recordings; `None` with one parameter only.
    pub fn slope(&self) -> Option<DVector<f64>> {
        let points: Vec<(f64, f64, DVector<f64>)> = self.parameters().iter().map(|&s| (1.0, s, self.at(s))).collect();
        (points.len() > 1).then(|| slope(&points, points[0].2.len()))
    }
}

/// All subjects of a database, as far as `count` components show them.
#[derive(Clone, Debug)]
pub struct Population {
    pub curves: Vec<Curve>,
    /// λ of the components in use.
    pub eigenvalues: Vec<f64>,
    /// Change of the weights per unit of the parameter over the whole database.
    pub slope: DVector<f64>,
    /// How a person's deviation from the others lasts.
    pub lasting: Lasting,
}

impl Population {
    /// Curves over the first `count` components of the model.
    pub fn new(model: &Model, count: usize) -> Population {
        let count = count.clamp(1, model.basis.ncols());
        let basis = model.basis.columns(0, count);
        let mut curves = Vec::new();
        for subject in model.subjects() {
            let knots = knots(model.members.iter().filter(|m| m.subject == subject));
            let weights: Vec<DVector<f64>> = knots.iter().map(|k| basis.tr_mul(&(mean_vector(k) - &model.mean))).collect();
            let parameters: Vec<f64> = knots.iter().map(|k| k.parameter).collect();
            if let Some(spline) = Spline::natural(parameters, weights) {
                curves.push(Curve { subject: subject.to_string(), spline });
            }
        }
        let (eigenvalues, slope) = (model.eigenvalues[..count].to_vec(), change(&curves, count));
        let mut population = Population { curves, eigenvalues, slope, lasting: Lasting::default() };
        population.lasting = Lasting::of(&population);
        population
    }

    /// All but subject `p`, without how deviations last.
    pub(super) fn without(&self, p: usize) -> Population {
        let mut curves = self.curves.clone();
        curves.remove(p);
        let slope = change(&curves, self.components());
        Population { curves, slope, eigenvalues: self.eigenvalues.clone(), lasting: Lasting::default() }
    }

    /// Smallest and largest parameter of the recordings.
    pub fn range(&self) -> (f64, f64) {
        let ends = self.curves.iter().map(|c| c.spline.range());
        ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), (first, last)| (lo.min(first), hi.max(last)))
    }

    /// How far outside everybody's recordings `parameter` lies, 0 inside and just beyond.
    pub fn beyond(&self, parameter: f64) -> f64 {
        let (lo, hi) = self.range();
        (lo - JUST_BEYOND - parameter).max(parameter - hi - JUST_BEYOND).max(0.0)
    }

    /// Number of components in use.
    pub fn components(&self) -> usize {
        self.eigenvalues.len()
    }

    /// A curve anywhere: its own recordings as far as they reach, the population's change from there.
    pub fn extended(&self, curve: &Curve, parameter: f64) -> DVector<f64> {
        let (first, last) = curve.spline.range();
        let nearest = if curve.takes_part(parameter) { parameter } else { parameter.clamp(first, last) };
        curve.at(nearest) + &self.slope * (parameter - nearest)
    }

    /// Subjects that take part at `parameter`; all where none does.
    pub(super) fn present(&self, parameter: f64) -> impl Iterator<Item = &Curve> {
        let nobody = !self.curves.iter().any(|c| c.takes_part(parameter));
        self.curves.iter().filter(move |c| nobody || c.takes_part(parameter))
    }

    /// Distances from weights at `parameter` to the subjects that take part there (to all, extended, where none does),
    /// nearest first.
    pub fn distances(&self, weights: &DVector<f64>, parameter: f64, metric: Metric) -> Vec<f64> {
        let to = |c: &Curve| metric.distance(&self.eigenvalues, weights, &self.extended(c, parameter));
        let mut found: Vec<f64> = self.present(parameter).map(to).collect();
        found.sort_by(f64::total_cmp);
        found
    }

    /// The same subjects with their distances and how far their own cycles lie from their curves, nearest first.
    pub fn neighbours(&self, model: &Model, weights: &DVector<f64>, parameter: f64) -> Vec<Neighbour> {
        let of_members = model.leading_weights(self.components());
        let to = |c: &Curve| {
            let own = model.members.iter().zip(of_members.column_iter()).filter(|(m, _)| m.subject == c.subject);
            let own =
                own.map(|(m, weights)| Metric::Paper.distance(&self.eigenvalues, &weights.into_owned(), &self.extended(c, m.parameter)));
            let here = self.extended(c, parameter);
            let distance = Metric::Paper.distance(&self.eigenvalues, weights, &here);
            let own_spread = own.fold(0.0, f64::max);
            let mahalanobis = Metric::Mahalanobis.distance(&self.eigenvalues, weights, &here);
            Neighbour { subject: c.subject.clone(), distance, mahalanobis, own_spread, inside: distance <= own_spread, log_odds: None }
        };
        let mut found: Vec<Neighbour> = self.present(parameter).map(to).collect();
        found.sort_by(|a, b| a.distance.total_cmp(&b.distance));
        found
    }
}

/// Mean motion vector of a knot's cycles.
pub fn mean_vector(knot: &Knot) -> DVector<f64> {
    knot.members.iter().map(|m| &m.vector).sum::<DVector<f64>>() / knot.members.len() as f64
}

/// Mean root channels of a knot's cycles.
pub fn mean_root(knot: &Knot) -> DVector<f64> {
    knot.members.iter().map(|m| &m.root).sum::<DVector<f64>>() / knot.members.len() as f64
}

/// Change of the weights per unit of the parameter within subjects; where nobody was recorded at two parameters, between them.
fn change(curves: &[Curve], count: usize) -> DVector<f64> {
    let within = curves.iter().any(|c| c.parameters().len() > 1);
    let points = curves.iter().flat_map(|c| {
        let share = 1.0 / c.parameters().len() as f64;
        let own: Vec<(f64, DVector<f64>)> = c.parameters().iter().map(|&s| (s, c.at(s))).collect();
        let mut mean = (0.0, DVector::zeros(count));
        if within {
            own.iter().for_each(|(s, w)| mean = (mean.0 + share * s, &mean.1 + w * share));
        }
        own.into_iter().map(move |(s, w)| (share, s - mean.0, w - &mean.1)).collect::<Vec<_>>()
    });
    slope(&points.collect::<Vec<_>>(), count)
}

/// Least-squares slope of weighted points (share, parameter, weights); zero where the parameter does not vary.
fn slope(points: &[(f64, f64, DVector<f64>)], count: usize) -> DVector<f64> {
    let total: f64 = points.iter().map(|p| p.0).sum();
    let mean_s = points.iter().map(|p| p.0 * p.1).sum::<f64>() / total;
    let variance: f64 = points.iter().map(|p| p.0 * (p.1 - mean_s).powi(2)).sum();
    let mut sum = DVector::zeros(count);
    if variance > 1e-9 * total {
        points.iter().for_each(|p| sum.axpy(p.0 * (p.1 - mean_s) / variance, &p.2, 1.0));
    }
    sum
}
