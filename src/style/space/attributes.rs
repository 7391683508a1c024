//! Attribute vectors from labels, and a network from attributes to motions.
//!
//! With labels μ_i of m examples the paper's attribute vector is the sum
//!   ΔS = Σ μ_i (S_i − S̄),   ΔT = Σ μ_i (T_i − T̄),                                                               (1)
//! whose length grows with the number of examples. Divided by Σ (μ_i − μ̄)² it is the least-squares slope, the change per unit of
//! the label. Where labels correlate (who is lively also lifts the hands) either drags the other attributes along; `Joint`
//! regresses the motions on all labels Z (centred) at once,
//!   Δ = (ZᵀZ)⁻¹ Zᵀ (S − S̄),                                                                                       (2)
//! and its a-th row changes attribute a while the labels of the others stay. All three are weights of examples.
//!
//! The network maps wanted values of several attributes to a motion: (2) plus Gaussian basis functions at the labelled examples
//! for what is left, in units of each label's standard deviation, with a ridge. Far from the examples (2) is all that remains.
//! Checked against sums by hand, a QR of the same regression, and synthetic spaces whose attributes are known.

use nalgebra::DMatrix;

use super::{Attribute, Space, SpaceError, Vectors};
use crate::math::rbf::Rbf;

/// Correlation matrices with a smaller eigenvalue than this belong to labels that are one.
const COLLINEAR: f64 = 1e-3;
/// Ridge of the network: labels are not exact, and examples with nearly equal labels must not fight. 0 would go through every example,
/// 1 would average over about a standard deviation.
const RIDGE: f64 = 0.3;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// The paper's sum (1), labels as they are.
    Sum,
    /// Change per unit of the label, this attribute alone.
    Slope,
    /// Change per unit of the label while the labels of others stay (2).
    Joint,
}

/// The attribute vector; `keep` are the attributes that [`Method::Joint`] holds, the attribute itself need not be among them.
pub fn direction(space: &Space, attribute: usize, method: Method, keep: &[usize]) -> Result<Vectors, SpaceError> {
    let weights = match method {
        Method::Sum => weights_of_sum(&space.attributes[attribute])?,
        Method::Slope => weights_of_slope(&space.attributes[attribute])?,
        Method::Joint => {
            let others = keep.iter().copied().filter(|&k| k != attribute);
            weights_of_joint(space, &std::iter::once(attribute).chain(others).collect::<Vec<_>>())?.remove(0)
        }
    };
    Ok(combine(space, &weights))
}

/// Σ w_i (x_i − x̄).
fn combine(space: &Space, weights: &[f64]) -> Vectors {
    let mean = space.mean();
    let total: f64 = weights.iter().sum();
    let terms = space.members.iter().zip(weights).map(|(m, w)| (*w, &m.vectors));
    Vectors::sum(&mean, terms).plus(&mean, -total, -total)
}

/// Mean and standard deviation of the labels, and their number.
pub fn spread(attribute: &Attribute) -> (f64, f64, usize) {
    let labels: Vec<f64> = attribute.labels.iter().flatten().copied().collect();
    let count = labels.len().max(1) as f64;
    let mean = labels.iter().sum::<f64>() / count;
    (mean, (labels.iter().map(|l| (l - mean).powi(2)).sum::<f64>() / count).sqrt(), labels.len())
}

/// Mean and standard deviation of labels that differ.
fn varying(attribute: &Attribute) -> Result<(f64, f64), SpaceError> {
    let (mean, deviation, labelled) = spread(attribute);
    if labelled >= 2 && deviation > 1e-9 * mean.abs().max(1e-9) {
        return Ok((mean, deviation));
    }
    Err(SpaceError::Constant { name: attribute.name.clone(), labelled })
}

fn weights_of_sum(attribute: &Attribute) -> Result<Vec<f64>, SpaceError> {
    varying(attribute)?;
    Ok(attribute.labels.iter().map(|l| l.unwrap_or(0.0)).collect())
}

fn weights_of_slope(attribute: &Attribute) -> Result<Vec<f64>, SpaceError> {
    let (mean, deviation) = varying(attribute)?;
    let squares = deviation * deviation * attribute.labels.iter().flatten().count() as f64;
    Ok(attribute.labels.iter().map(|l| l.map_or(0.0, |l| (l - mean) / squares)).collect())
}

/// Labels of some attributes, centred and in standard deviations: members that have all of them × attributes.
struct Standard {
    members: Vec<usize>,
    z: DMatrix<f64>,
    means: Vec<f64>,
    deviations: Vec<f64>,
}

impl Standard {
    fn new(space: &Space, attributes: &[usize]) -> Result<Standard, SpaceError> {
        let label = |attribute: usize, member: usize| space.attributes[attribute].labels[member];
        let members: Vec<usize> = (0..space.members.len()).filter(|&m| attributes.iter().all(|&a| label(a, m).is_some())).collect();
        let names = || attributes.iter().map(|&a| space.attributes[a].name.as_str()).collect::<Vec<_>>().join(", ");
        if members.len() < attributes.len() + 2 {
            return Err(SpaceError::Unlabelled { names: names(), found: members.len(), wanted: attributes.len() + 2 });
        }
        let mut z = DMatrix::from_fn(members.len(), attributes.len(), |i, a| label(attributes[a], members[i]).unwrap_or_default());
        let (mut means, mut deviations) = (Vec::new(), Vec::new());
        for (a, mut column) in z.column_iter_mut().enumerate() {
            let own = Attribute { labels: column.iter().map(|l| Some(*l)).collect(), name: space.attributes[attributes[a]].name.clone() };
            let (mean, deviation) = varying(&own)?;
            column.apply(|l| *l = (*l - mean) / deviation);
            means.push(mean);
            deviations.push(deviation);
        }
        let correlation = z.tr_mul(&z) / members.len() as f64;
        if correlation.symmetric_eigenvalues().min() < COLLINEAR {
            return Err(SpaceError::Collinear(names()));
        }
        Ok(Standard { members, z, means, deviations })
    }

    /// (ZᵀZ)⁻¹ Zᵀ: attributes × members, per standard deviation.
    fn regression(&self) -> Option<DMatrix<f64>> {
        Some(self.z.tr_mul(&self.z).cholesky()?.solve(&self.z.transpose()))
    }
}

/// Weights of all members for each of `attributes`, per unit of the label.
fn weights_of_joint(space: &Space, attributes: &[usize]) -> Result<Vec<Vec<f64>>, SpaceError> {
    let standard = Standard::new(space, attributes)?;
    let names = || attributes.iter().map(|&a| space.attributes[a].name.as_str()).collect::<Vec<_>>().join(", ");
    let rows = standard.regression().ok_or_else(|| SpaceError::Collinear(names()))?;
    let of = |a: usize| {
        let mut weights = vec![0.0; space.members.len()];
        standard.members.iter().enumerate().for_each(|(i, &m)| weights[m] = rows[(a, i)] / standard.deviations[a]);
        weights
    };
    Ok((0..attributes.len()).map(of).collect())
}

/// From values of some attributes to a motion of the space.
#[derive(Clone, Debug)]
pub struct Network {
    mean: Vectors,
    means: Vec<f64>,
    deviations: Vec<f64>,
    /// Per standard deviation of each attribute.
    slopes: Vec<Vectors>,
    nodes: Rbf,
    /// What the slopes leave of each node's example.
    rests: Vec<Vectors>,
}

impl Network {
    pub fn new(space: &Space, attributes: &[usize]) -> Result<Network, SpaceError> {
        let standard = Standard::new(space, attributes)?;
        let names = || SpaceError::Collinear(attributes.iter().map(|&a| space.attributes[a].name.as_str()).collect::<Vec<_>>().join(", "));
        let weights = weights_of_joint(space, attributes)?;
        let slopes: Vec<Vectors> = weights
            .iter()
            .zip(&standard.deviations)
            .map(|(w, d)| {
                let per_deviation: Vec<f64> = w.iter().map(|w| w * d).collect();
                combine(space, &per_deviation)
            })
            .collect();
        // The line goes through the mean of the members that have these labels.
        let share = 1.0 / standard.members.len() as f64;
        let mean = Vectors::sum(&space.mean(), standard.members.iter().map(|&m| (share, &space.members[m].vectors)));
        let nodes: Vec<Vec<f64>> = standard.z.row_iter().map(|row| row.iter().copied().collect()).collect();
        let line = |z: &[f64]| slopes.iter().zip(z).fold(mean.clone(), |sum, (slope, z)| sum.plus(slope, *z, *z));
        let rests = standard.members.iter().zip(&nodes).map(|(&m, z)| space.members[m].vectors.minus(&line(z))).collect();
        let nodes = Rbf::smoothing(nodes, RIDGE).ok_or_else(names)?;
        Ok(Network { mean, means: standard.means, deviations: standard.deviations, slopes, nodes, rests })
    }

    /// The motion with these attributes, in the order they were given; outside the labels' range it goes on straight.
    pub fn at(&self, values: &[f64]) -> Vectors {
        let z: Vec<f64> = values.iter().zip(&self.means).zip(&self.deviations).map(|((v, m), d)| (v - m) / d).collect();
        let line = self.slopes.iter().zip(&z).fold(self.mean.clone(), |sum, (slope, z)| sum.plus(slope, *z, *z));
        let rest = Vectors::sum(&self.mean, self.nodes.weights(&z).into_iter().zip(&self.rests));
        line.plus(&rest, 1.0, 1.0)
    }
}
