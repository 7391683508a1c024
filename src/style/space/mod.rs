//! A vector space of motions (I. S. Lim and D. Thalmann, "A Vector-Space Representation of Motion Data for Example-Based Motion
//! Synthesis", 2001).
//!
//! Every example is warped to one reference ([`warp`]) and becomes a shape vector S, what the curves do at the reference's knots,
//! and a timing vector T, when they do it. Examples in full correspondence may be added:
//!   S = Σ a_i S_i,   T = Σ b_i T_i   (Σ a = Σ b = 1),                                                            (1)
//! and PCA of both about their means gives the coordinates in which they vary. On this stand attributes ([`attributes`]),
//! caricature and crowds ([`manipulate`]), and all of it live ([`live`]).
//!
//! Departures: rotations are vectors about each joint's mean rotation. The root's curves belong to the shape; its forward curve
//! is the way gone, not the deviation from uniform motion, so that shape and timing may be changed apart and feet stay
//! where they were. Of timing, only intervals that would come out too short are changed (`blend::increasing`).
//! Fails when: the examples do not do the same things in the same order; then warps have nothing to hold on to.
//! Checked by playing examples back from their vectors, closed-form sums, and known warps.

pub mod attributes;
pub mod blend;
pub mod example;
mod interpolate;
pub mod live;
pub mod manipulate;
pub mod measure;
pub mod warp;

pub use attributes::{Method, Network};
pub use blend::{Blend, Layout, Vectors};
pub use example::{CURVES, Example, Posture};
pub use live::Live;

use nalgebra::{DMatrix, DVector, UnitQuaternion};
use rayon::prelude::*;

use crate::body::BALL_JOINTS;
use crate::math::pca::{Pca, pca};
use crate::math::rotation::mean;
use crate::motion_model::Activity;
use example::Curves;

/// Knots of a space, unless its maker wants another number.
pub const INTERVALS: usize = 100;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum SpaceError {
    #[error("a space needs at least two motions, there is {0}")]
    TooFew(usize),
    #[error("{name} has {found} postures; a motion needs at least 8")]
    Short { name: String, found: usize },
    #[error("{name} lasts {duration_s} s with a hip height of {hip_height_m} m; both must be positive")]
    Size { name: String, duration_s: f64, hip_height_m: f64 },
    #[error("{name} is {}, the others are {}; build one space of each", kind(*.cyclic), kind(!*.cyclic))]
    Mixed { name: String, cyclic: bool },
    #[error("two motions are called {0}; name them differently")]
    SameName(String),
    #[error("all motions are equal, there is nothing to mix")]
    NoVariance,
    #[error("the space has no motion `{wanted}`; it has {known}")]
    NoMotion { wanted: String, known: String },
    #[error("the space has no attribute `{wanted}`; it has {known}")]
    NoAttribute { wanted: String, known: String },
    #[error("the weights add up to {0}; they are parts of one motion, so their sum must not be near zero")]
    Weights(f64),
    #[error("attribute `{name}` is the same for all {labelled} motions that have it, so nothing shows what it means")]
    Constant { name: String, labelled: usize },
    #[error("the attributes {0} rise and fall together, so they cannot be told apart; leave some out (--keep), or take the method `slope`")]
    Collinear(String),
    #[error("the attributes {names} stand together on {found} motions; a map from them needs at least {wanted}")]
    Unlabelled { names: String, found: usize, wanted: usize },
}

fn kind(cyclic: bool) -> &'static str {
    if cyclic { "a gait cycle" } else { "an open motion" }
}

/// An example as it stands in the space.
#[derive(Clone, Debug)]
pub struct Member {
    pub name: String,
    pub source: String,
    pub hip_height_m: f64,
    pub vectors: Vectors,
}

/// What the motions were labelled with.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    pub name: String,
    /// One per member; `None` where it is not known.
    pub labels: Vec<Option<f64>>,
}

#[derive(Clone, Debug)]
pub struct Space {
    pub layout: Layout,
    /// What the examples were cut as; `None` for whole clips.
    pub activity: Option<Activity>,
    /// Mean rotation of every ball joint over all examples; shapes are relative to it.
    pub mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
    /// Index of the member that the others were warped to.
    pub reference: usize,
    pub members: Vec<Member>,
    pub attributes: Vec<Attribute>,
    /// Means S̄ and T̄, eigenmotions and their variances.
    pub shape: Pca,
    pub timing: Pca,
}

/// How a space is built.
#[derive(Clone, Debug, Default)]
pub struct Options {
    pub activity: Option<Activity>,
    /// Intervals between knots; [`INTERVALS`] without it.
    pub intervals: Option<usize>,
    /// A timing for each curve in place of one for all.
    pub per_curve: bool,
    /// Name of the reference; without it the example that is nearest to all others.
    pub reference: Option<String>,
}

impl Space {
    /// Warps all examples to the reference, and measures the attributes of [`measure`].
    pub fn build(examples: &[Example], options: &Options) -> Result<Space, SpaceError> {
        check(examples)?;
        let cyclic = examples[0].cyclic;
        let layout = Layout { intervals: options.intervals.unwrap_or(INTERVALS), cyclic, per_curve: options.per_curve };
        let mean_rotations = mean_rotations(examples);
        let curves: Vec<Curves> = examples.iter().map(|e| e.curves(&mean_rotations)).collect();
        let reference = match &options.reference {
            Some(name) => examples.iter().position(|e| e.name == *name).ok_or_else(|| no_motion(name, examples.iter().map(|e| &e.name)))?,
            None => medoid(&curves, layout.intervals),
        };
        let member = |(example, own): (&Example, &Curves)| Member {
            name: example.name.clone(),
            source: example.source.clone(),
            hip_height_m: example.hip_height_m,
            vectors: vectors(&layout, &curves[reference], own, example.duration_s),
        };
        let members: Vec<Member> = examples.par_iter().zip(&curves).map(member).collect();
        let mut space = Space::of_members(layout, options.activity, mean_rotations, reference, members)?;
        space.attributes = measure::attributes(&space);
        Ok(space)
    }

    /// A space of members that are in correspondence already; without attributes.
    pub fn of_members(
        layout: Layout,
        activity: Option<Activity>,
        mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
        reference: usize,
        members: Vec<Member>,
    ) -> Result<Space, SpaceError> {
        let columns = |f: fn(&Member) -> &DVector<f64>| DMatrix::from_columns(&members.iter().map(|m| f(m).clone()).collect::<Vec<_>>());
        if members.len() < 2 {
            return Err(SpaceError::TooFew(members.len()));
        }
        let [shape, timing] = [columns(|m| &m.vectors.shape), columns(|m| &m.vectors.timing)].map(|x| pca(&x));
        if shape.basis.ncols() == 0 {
            return Err(SpaceError::NoVariance);
        }
        Ok(Space { layout, activity, mean_rotations, reference, members, attributes: Vec::new(), shape, timing })
    }

    /// S̄ and T̄.
    pub fn mean(&self) -> Vectors {
        Vectors { shape: self.shape.mean.clone(), timing: self.timing.mean.clone() }
    }

    /// The vectors of a motion from outside, warped to this space's reference.
    pub fn project(&self, example: &Example) -> Result<Vectors, SpaceError> {
        if example.cyclic != self.layout.cyclic {
            return Err(SpaceError::Mixed { name: example.name.clone(), cyclic: example.cyclic });
        }
        check_one(example)?;
        let member = &self.members[self.reference];
        let reference = self.play(&member.vectors).example(&member.name, member.hip_height_m, self.layout.knots());
        let [reference, own] = [&reference, example].map(|e| e.curves(&self.mean_rotations));
        Ok(vectors(&self.layout, &reference, &own, example.duration_s))
    }

    /// Vectors as a motion.
    pub fn play(&self, vectors: &Vectors) -> Blend {
        Blend::new(self.layout, self.mean_rotations, &self.timing.mean, vectors)
    }

    /// Equation (1): members with their weights for shape and for timing, each divided by its sum.
    pub fn mix(&self, shape: &[(usize, f64)], timing: &[(usize, f64)]) -> Result<Vectors, SpaceError> {
        let [shape, timing] = [parts(shape)?, parts(timing)?];
        let of = |parts: &[(usize, f64)]| Vectors::sum(&self.mean(), parts.iter().map(|&(i, w)| (w, &self.members[i].vectors)));
        Ok(Vectors { shape: of(&shape).shape, timing: of(&timing).timing })
    }

    /// Members called `name`, or all whose name is `name` and a number (`walk` for `walk#1`, `walk#2`).
    pub fn members_called(&self, name: &str) -> Result<Vec<usize>, SpaceError> {
        let called = |m: &Member| m.name == name || m.name.rsplit_once('#').is_some_and(|(stem, _)| stem == name);
        let found: Vec<usize> = (0..self.members.len()).filter(|&i| called(&self.members[i])).collect();
        if found.is_empty() { Err(no_motion(name, self.members.iter().map(|m| &m.name))) } else { Ok(found) }
    }

    /// Index of an attribute.
    pub fn attribute(&self, name: &str) -> Result<usize, SpaceError> {
        let known = || self.attributes.iter().map(|a| a.name.as_str()).collect::<Vec<_>>().join(", ");
        let at = self.attributes.iter().position(|a| a.name == name);
        at.ok_or_else(|| SpaceError::NoAttribute { wanted: name.into(), known: known() })
    }

    /// Adds an attribute, or replaces the one of this name.
    pub fn set_attribute(&mut self, attribute: Attribute) {
        match self.attributes.iter_mut().find(|a| a.name == attribute.name) {
            Some(old) => *old = attribute,
            None => self.attributes.push(attribute),
        }
    }

    /// Mean hip height of the members, metres.
    pub fn hip_height_m(&self) -> f64 {
        self.members.iter().map(|m| m.hip_height_m).sum::<f64>() / self.members.len() as f64
    }

    /// How far a motion is from the mean: r.m.s. over curves of rotation and knots in degrees, and over knots in seconds.
    pub fn distance_from_mean(&self, vectors: &Vectors) -> (f64, f64) {
        let shape = &vectors.shape - &self.shape.mean;
        let (mut sum, mut count) = (0.0, 0);
        for knot in 0..self.layout.knots() {
            let rotations = shape.rows(knot * CURVES, CURVES - 3);
            sum += rotations.norm_squared();
            count += rotations.len();
        }
        let timing = &vectors.timing - &self.timing.mean;
        ((sum / count as f64).sqrt().to_degrees(), (timing.norm_squared() / timing.len() as f64).sqrt())
    }
}

fn no_motion<'a>(wanted: &str, names: impl Iterator<Item = &'a String>) -> SpaceError {
    SpaceError::NoMotion { wanted: wanted.into(), known: names.map(String::as_str).collect::<Vec<_>>().join(", ") }
}

/// Weights divided by their sum.
fn parts(weights: &[(usize, f64)]) -> Result<Vec<(usize, f64)>, SpaceError> {
    let sum: f64 = weights.iter().map(|w| w.1).sum();
    let size: f64 = weights.iter().map(|w| w.1.abs()).sum();
    if sum.is_finite() && sum.abs() > 1e-3 * size {
        Ok(weights.iter().map(|&(i, w)| (i, w / sum)).collect())
    } else {
        Err(SpaceError::Weights(sum))
    }
}

fn check(examples: &[Example]) -> Result<(), SpaceError> {
    if examples.len() < 2 {
        return Err(SpaceError::TooFew(examples.len()));
    }
    for (i, example) in examples.iter().enumerate() {
        check_one(example)?;
        if example.cyclic != examples[0].cyclic {
            return Err(SpaceError::Mixed { name: example.name.clone(), cyclic: example.cyclic });
        }
        if examples[..i].iter().any(|e| e.name == example.name) {
            return Err(SpaceError::SameName(example.name.clone()));
        }
    }
    Ok(())
}

fn check_one(example: &Example) -> Result<(), SpaceError> {
    let &Example { duration_s, hip_height_m, .. } = example;
    let name = || example.name.clone();
    if example.postures.len() < 8 {
        return Err(SpaceError::Short { name: name(), found: example.postures.len() });
    }
    let positive = |v: f64| v > 0.0 && v.is_finite();
    if positive(duration_s) && positive(hip_height_m) { Ok(()) } else { Err(SpaceError::Size { name: name(), duration_s, hip_height_m }) }
}

fn mean_rotations(examples: &[Example]) -> [UnitQuaternion<f64>; BALL_JOINTS] {
    let of = |j: usize| {
        // Long clips count like short ones: as many postures of each.
        let of_one = |e: &Example| (0..40).map(|k| e.postures[k * e.postures.len() / 40].0[j]).collect::<Vec<_>>();
        mean(&examples.iter().flat_map(of_one).collect::<Vec<_>>()).unwrap_or_default()
    };
    std::array::from_fn(of)
}

/// The example with the smallest sum of distances to the others, without any warp.
fn medoid(curves: &[Curves], intervals: usize) -> usize {
    let sampled: Vec<DMatrix<f64>> = curves
        .par_iter()
        .map(|c| {
            let times = c.times();
            let columns: Vec<_> = (0..intervals).map(|k| c.at(&times, k as f64 / intervals as f64)).collect();
            DMatrix::from_columns(&columns).rows(0, CURVES - 3).into_owned()
        })
        .collect();
    let sum = |i: usize| sampled.iter().map(|other| (&sampled[i] - other).norm()).sum::<f64>();
    let sums: Vec<f64> = (0..sampled.len()).into_par_iter().map(sum).collect();
    (0..sums.len()).min_by(|&a, &b| sums[a].total_cmp(&sums[b])).unwrap_or(0)
}

/// Shape and timing of `own` after its warp to `reference`.
fn vectors(layout: &Layout, reference: &Curves, own: &Curves, duration_s: f64) -> Vectors {
    let warps = warp::warp(reference, own, layout.intervals, layout.per_curve);
    let (knots, times) = (layout.knots(), own.times());
    let mut shape = DVector::zeros(layout.shape_len());
    for knot in 0..knots {
        if let [common] = &warps[..] {
            shape.rows_mut(knot * CURVES, CURVES).copy_from(&own.at(&times, common[knot]));
        } else {
            for (curve, own_times) in warps.iter().enumerate() {
                shape[knot * CURVES + curve] = own.at(&times, own_times[knot])[curve];
            }
        }
    }
    shape[knots * CURVES] = own.stride;
    let timing = DVector::from_iterator(layout.timing_len(), warps.iter().flat_map(|w| w[1..].iter().map(|t| t * duration_s)));
    Vectors { shape, timing }
}

#[cfg(test)]
mod tests;
