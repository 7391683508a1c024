//! The state of a fit between two iterations, kept on disk exactly, so that a fit that was stopped goes on with the same numbers.
//!
//! One file per stage of the fit, little endian: `MBFIT003`; rounds and iterations (u64), how far the last round moved joints (f64);
//! stature, lengths, widths, posture; number of weights (u64) and weights; number of frames (u64) and per frame position,
//! rotation (x y z w), phase; number of deviations (u64) and deviations (all f64); BLAKE3 of all before it.

use std::path::{Path, PathBuf};

use nalgebra::{Quaternion, Unit, Vector3};

use super::write_atomic;
use crate::body::Shape;
use crate::fit::Checkpoint;
use crate::fit::state::{Carrier, State};

const MAGIC: &[u8; 8] = b"MBFIT003";

fn path(folder: &Path, stage: usize) -> PathBuf {
    folder.join(format!("{stage:02}.fit"))
}

/// Writes the state within a stage; the file appears whole or not at all.
pub fn write(folder: &Path, stage: usize, at: &Checkpoint) -> std::io::Result<()> {
    let mut bytes = MAGIC.to_vec();
    bytes.extend((at.rounds as u64).to_le_bytes());
    bytes.extend(at.iterations.to_le_bytes());
    let State { carriers, weights, shape, posture, deviations } = &at.state;
    put(&mut bytes, &[at.moved_m, shape.stature_m]);
    put(&mut bytes, &shape.lengths);
    put(&mut bytes, &shape.widths);
    put_turns(&mut bytes, posture);
    bytes.extend((weights.len() as u64).to_le_bytes());
    put(&mut bytes, weights);
    bytes.extend((carriers.len() as u64).to_le_bytes());
    for carrier in carriers {
        put(&mut bytes, carrier.position.as_slice());
        put(&mut bytes, carrier.world_from_carrier.coords.as_slice());
        put(&mut bytes, &[carrier.phase]);
    }
    bytes.extend((deviations.len() as u64).to_le_bytes());
    deviations.iter().for_each(|turns| put_turns(&mut bytes, turns));
    let hash = blake3::hash(&bytes);
    bytes.extend(hash.as_bytes());
    write_atomic(&path(folder, stage), &bytes)
}

/// Reads what [`write`] wrote; `None` where there is nothing, or something damaged: that stage begins anew.
pub fn read(folder: &Path, stage: usize) -> Option<Checkpoint> {
    let bytes = std::fs::read(path(folder, stage)).ok()?;
    let (body, hash) = bytes.split_last_chunk::<32>()?;
    if blake3::hash(body).as_bytes() != hash {
        return None;
    }
    let mut rest = body.strip_prefix(MAGIC)?;
    let (rounds, iterations) = (usize::try_from(take_count(&mut rest)?).ok()?, take_count(&mut rest)?);
    let [moved_m, stature_m] = take(&mut rest)?;
    let shape = Shape { stature_m, lengths: take(&mut rest)?, widths: take(&mut rest)? };
    let posture = take_turns(&mut rest)?;
    let weights = (0..take_count(&mut rest)?).map(|_| take::<1>(&mut rest).map(|[w]| w)).collect::<Option<_>>()?;
    let carriers = (0..take_count(&mut rest)?).map(|_| take_carrier(&mut rest)).collect::<Option<_>>()?;
    let deviations = (0..take_count(&mut rest)?).map(|_| take_turns(&mut rest)).collect::<Option<_>>()?;
    Some(Checkpoint { rounds, iterations, moved_m, state: State { carriers, weights, shape, posture, deviations } })
}

fn put(bytes: &mut Vec<u8>, values: &[f64]) {
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
}

fn put_turns(bytes: &mut Vec<u8>, turns: &[Vector3<f64>]) {
    turns.iter().for_each(|turn| put(bytes, turn.as_slice()));
}

fn take_count(rest: &mut &[u8]) -> Option<u64> {
    let (head, tail) = rest.split_first_chunk()?;
    *rest = tail;
    Some(u64::from_le_bytes(*head))
}

fn take<const N: usize>(rest: &mut &[u8]) -> Option<[f64; N]> {
    let mut values = [0.0; N];
    for value in &mut values {
        *value = f64::from_bits(take_count(rest)?);
    }
    Some(values)
}

fn take_turns<const N: usize>(rest: &mut &[u8]) -> Option<[Vector3<f64>; N]> {
    let mut turns = [Vector3::zeros(); N];
    for turn in &mut turns {
        *turn = Vector3::from(take::<3>(rest)?);
    }
    Some(turns)
}

fn take_carrier(rest: &mut &[u8]) -> Option<Carrier> {
    let position = Vector3::from(take::<3>(rest)?);
    // Not normalised again: that would change the last digit.
    let world_from_carrier = Unit::new_unchecked(Quaternion::from(take::<4>(rest)?));
    Some(Carrier { position, world_from_carrier, phase: take::<1>(rest)?[0] })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    fn checkpoint() -> Checkpoint {
        let third = |k: usize| Vector3::new(1.0 / (3 + k) as f64, -0.1, f64::MIN_POSITIVE);
        let turns = |k: usize| std::array::from_fn(|j| third(j + k));
        let carrier = |k: usize| Carrier {
            position: third(k),
            world_from_carrier: UnitQuaternion::from_scaled_axis(third(k) * 2.0),
            phase: 0.1 * k as f64,
        };
        let mut shape = Shape::template(1.7);
        shape.lengths[3] = 1.0 / 0.97;
        shape.widths[7] = 0.3;
        let state = State {
            carriers: (0..5).map(carrier).collect(),
            weights: vec![0.1, -1.0 / 7.0],
            shape,
            posture: std::array::from_fn(third),
            deviations: (1..6).map(turns).collect(),
        };
        Checkpoint { rounds: 3, iterations: 4, moved_m: 1e-3 / 3.0, state }
    }

    #[test]
    fn comes_back_bit_by_bit_and_damage_is_found() {
        let folder = tempfile::tempdir().unwrap();
        assert!(read(folder.path(), 0).is_none());
        let mut plain = checkpoint();
        plain.state.deviations.clear();
        for (stage, at) in [checkpoint(), plain].iter().enumerate() {
            write(folder.path(), stage, at).unwrap();
            let back = read(folder.path(), stage).unwrap();
            assert_eq!((back.rounds, back.iterations, back.moved_m.to_bits()), (3, 4, at.moved_m.to_bits()));
            let (a, b) = (&back.state, &at.state);
            assert_eq!((&a.weights, &a.shape, &a.posture, &a.deviations), (&b.weights, &b.shape, &b.posture, &b.deviations));
            for (a, b) in a.carriers.iter().zip(&b.carriers) {
                assert_eq!((a.position, a.world_from_carrier.coords, a.phase), (b.position, b.world_from_carrier.coords, b.phase));
            }
            assert_eq!(a.carriers.len(), 5);
        }
        let good = std::fs::read(path(folder.path(), 0)).unwrap();
        for at in (0..good.len()).step_by(11) {
            std::fs::write(path(folder.path(), 0), &good[..at]).unwrap();
            assert!(read(folder.path(), 0).is_none(), "cut at {at}");
        }
    }
}
