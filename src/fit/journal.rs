//! What a long fit has done, so that a stopped one goes on where it was and ends with the same bytes.
//!
//! Argmin's checkpoints belong to one executor; here every solver iteration has an executor of its own, since the weights are
//! frozen anew after each. So the journal holds the results of the finished stages and the state of the one under way.
//! Everything else is computed again from the observations, which takes a tenth of the time.
//! Checked by a fit taken up in the middle.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::state::{Carrier, DEVIATING, State, Turns};
use crate::body::{Length, Shape};

/// A stage of the solver that is under way.
#[derive(Clone, Debug)]
pub struct Under {
    pub state: State,
    /// How often the weights were frozen.
    pub refreshes: usize,
    /// Cost at the last freezing.
    pub cost: f64,
}

/// How far a fit has come.
#[derive(Clone, Debug, Default)]
pub struct Journal {
    /// Results of the finished stages, in order.
    pub done: Vec<State>,
    pub under: Option<Under>,
    pub iterations: u64,
}

/// First bytes of a journal.
const MAGIC: &[u8; 8] = b"mbfit\x00\x00\x01";

impl Journal {
    /// Little-endian numbers behind a mark and the `key` of what is fitted.
    pub fn to_bytes(&self, key: &[u8; 32]) -> Vec<u8> {
        let mut numbers = vec![self.iterations as f64, self.done.len() as f64];
        self.done.iter().for_each(|state| push(state, &mut numbers));
        if let Some(under) = &self.under {
            numbers.extend([under.refreshes as f64, under.cost]);
            push(&under.state, &mut numbers);
        }
        let count = numbers.len() as f64;
        numbers.insert(0, count);
        let mut bytes = [MAGIC, &key[..]].concat();
        bytes.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
        bytes
    }

    /// `None` where the bytes are no journal, are those of another `key`, or are cut.
    pub fn from_bytes(bytes: &[u8], key: &[u8; 32]) -> Option<Journal> {
        let rest = bytes.strip_prefix(&MAGIC[..])?.strip_prefix(&key[..])?;
        let (numbers, cut) = rest.as_chunks::<8>();
        let mut numbers = numbers.iter().map(|b| f64::from_le_bytes(*b));
        if !cut.is_empty() || numbers.next()? as usize != numbers.len() {
            return None;
        }
        let iterations = numbers.next()? as u64;
        let stages = numbers.next()? as usize;
        let mut done = Vec::new();
        for _ in 0..stages {
            done.push(pull(&mut numbers)?);
        }
        let under = match numbers.next() {
            Some(refreshes) => Some(Under { refreshes: refreshes as usize, cost: numbers.next()?, state: pull(&mut numbers)? }),
            None => None,
        };
        numbers.next().is_none().then_some(Journal { done, under, iterations })
    }
}

fn push(state: &State, numbers: &mut Vec<f64>) {
    numbers.extend([state.carriers.len() as f64, state.weights.len() as f64, f64::from(u8::from(!state.deviations.is_empty()))]);
    for c in &state.carriers {
        numbers.extend(c.position.iter().chain(c.world_from_carrier.coords.iter()).chain([&c.phase]));
    }
    numbers.extend(&state.weights);
    numbers.push(state.shape.stature_m);
    numbers.extend(state.shape.lengths.iter().chain(&state.shape.widths));
    for turns in std::iter::once(&state.posture).chain(&state.deviations) {
        numbers.extend(turns.iter().flat_map(|turn| turn.iter()));
    }
}

fn pull(numbers: &mut impl Iterator<Item = f64>) -> Option<State> {
    let mut next = || numbers.next();
    let (frames, weights, deviates) = (next()? as usize, next()? as usize, next()? != 0.0);
    let mut carriers = Vec::new();
    for _ in 0..frames {
        let position = Vector3::new(next()?, next()?, next()?);
        let (i, j, k, w) = (next()?, next()?, next()?, next()?);
        let world_from_carrier = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
        carriers.push(Carrier { position, world_from_carrier, phase: next()? });
    }
    let weights = (0..weights).map(|_| next()).collect::<Option<_>>()?;
    let mut shape = Shape::template(next()?);
    for size in shape.lengths.iter_mut().chain(&mut shape.widths) {
        *size = next()?;
    }
    let mut turns = || -> Option<Turns> {
        let mut turns = Turns::default();
        for turn in turns.iter_mut().flat_map(|turn| turn.iter_mut()) {
            *turn = next()?;
        }
        Some(turns)
    };
    let posture = turns()?;
    let deviations = (0..if deviates { frames } else { 0 }).map(|_| turns()).collect::<Option<_>>()?;
    Some(State { carriers, weights, shape, posture, deviations })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::problem::tests::state;

    #[test]
    fn comes_back_bit_by_bit_and_only_for_its_own_key() {
        let under = Under { state: State { weights: vec![0.1, -2e-300], ..state() }, refreshes: 3, cost: 1.0 / 3.0 };
        let journal = Journal { done: vec![state(), State { deviations: Vec::new(), ..state() }], under: Some(under), iterations: 41 };
        let bytes = journal.to_bytes(&[7; 32]);
        let back = Journal::from_bytes(&bytes, &[7; 32]).unwrap();
        assert_eq!(format!("{journal:?}"), format!("{back:?}"));
        assert_eq!(back.to_bytes(&[7; 32]), bytes);
        assert!(Journal::from_bytes(&bytes, &[8; 32]).is_none());
        assert!((0..bytes.len()).all(|n| Journal::from_bytes(&bytes[..n], &[7; 32]).is_none()));
        let lengths = [DEVIATING.len(), Length::COUNT];
        assert_eq!(lengths, [11, 10], "the mark in the file is to change with them");
    }
}
