//! Motion models: PCA of 324 cycles beside scikit-learn's, and postures per second.
//!
//! The peer is `peers/pca_sklearn.py`, full PCA of the same 324 x 7800 matrix, all threads that it wants; PYTHON names the
//! interpreter with numpy and scikit-learn (`python3` without it). Where it does not run, that is said.
//! Postures run on one thread, from weights and a phase to the 26 joint rotations and the root, phases in no order: by the tables
//! for many of them and by the model itself.
//! The player walks in real time without and with two attributes, learnt from few and from many examples.

use std::hint::black_box;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use muybridge::body::Shape;
use muybridge::math::pca::pca;
use muybridge::motion::{Gait, Gaits, Player};
use muybridge::motion_model::{Activity, Model, Postures, synthetic};
use muybridge::style::Population;
use muybridge::style::space::attributes::{direction, spread};
use muybridge::style::space::{Example, Method, Options, Space};
use nalgebra::DMatrix;

const ROUNDS: usize = 7;
const POSTURES: usize = 200_000;

fn main() {
    let model = Model::build(Activity::Walking, true, &synthetic::database(Activity::Walking)).expect("the embedded database");
    let columns: Vec<_> = model.members.iter().map(|m| m.vector.clone()).collect();
    let vectors = DMatrix::from_columns(&columns);
    let ours_ms = (0..ROUNDS).map(|_| timed_ms(|| black_box(pca(&vectors)).eigenvalues.len())).fold(f64::MAX, f64::min);
    println!("PCA of {} cycles x {}: {ours_ms:.1} ms", vectors.ncols(), vectors.nrows());
    match peer_ms(&vectors) {
        Ok(theirs_ms) => println!("scikit-learn, full: {theirs_ms:.1} ms, ratio {:.2}", ours_ms / theirs_ms),
        Err(why) => println!("scikit-learn: {why}; PYTHON=... names an interpreter that has it"),
    }
    println!("\n| weights | ns per posture | postures per second | ns by the model itself |\n|---|---|---|---|");
    let weights = model.member_weights(&model.members[100]);
    for count in [0, 2, 5, 10, 20, 40, 60] {
        let used = &weights.as_slice()[..count.min(weights.len())];
        let tables = Postures::new(&model, used.len(), None);
        let ns = |posture: &dyn Fn(f64)| {
            let best = (0..ROUNDS).map(|_| timed_ms(|| postures(posture))).fold(f64::MAX, f64::min);
            1e6 * best / POSTURES as f64
        };
        let fast_ns = ns(&|phase| {
            black_box(tables.at(black_box(used), phase));
        });
        let exact_ns = ns(&|phase| {
            black_box(model.posture(black_box(used), phase));
        });
        println!("| {} | {fast_ns:.0} | {:.2} million | {exact_ns:.0} |", used.len(), 1e3 / fast_ns);
    }
    players(&model);
}

/// Time of `Player::next` by the examples that its attributes were learnt from.
fn players(model: &Model) {
    let shape = Shape::template(1.75);
    let population = Population::new(model, 10);
    let plain = Gait::typical(model, &population, shape.hip_height_m(), &shape.offsets()).expect("walking has speeds");
    let alone_ns = next_ns(&Gaits::one(plain.clone()));
    println!("\n| examples | ns per next(dt) | against no attributes |\n|---|---|---|\n| none | {alone_ns:.0} | 1 |");
    for people in [2, 32] {
        let mut gait = plain.clone();
        let examples = teach(&mut gait, people);
        let each_ns = next_ns(&Gaits::one(gait));
        println!("| {examples} | {each_ns:.0} | {:.2} |", each_ns / alone_ns);
    }
}

/// Adds both measured attributes of a space of synthetic walkers; returns the number of its examples.
fn teach(gait: &mut Gait, people: u64) -> usize {
    let cycles = (1..=people).flat_map(|seed| [0.9, 1.5].map(|v| (seed, v, synthetic::subject(Activity::Walking, seed).cycle(v, 0))));
    let examples: Vec<Example> = cycles.map(|(seed, v, cycle)| Example::of_cycle(&format!("{seed} {v}"), &cycle)).collect();
    let space = Space::build(&examples, &Options { activity: Some(Activity::Walking), ..Options::default() }).expect("walks");
    let mean = space.mean();
    for (k, attribute) in space.attributes.iter().enumerate() {
        let (vector, deviation) = (direction(&space, k, Method::Joint, &[0, 1]).expect("measured"), spread(attribute).1);
        let change = gait.change(&space.play(&mean), &space.play(&mean.plus(&vector, deviation, deviation)));
        gait.add_change(change).expect("a walking cycle");
    }
    examples.len()
}

fn next_ns(gaits: &Gaits) -> f64 {
    let mut player = Player::new(gaits, 1.3, 0.0);
    player.amounts.iter_mut().for_each(|a| a.target = 1.0);
    let walk = |player: &mut Player| (0..POSTURES).map(|_| black_box(player.next(0.01)).root.z).last();
    let best = (0..ROUNDS).map(|_| timed_ms(|| walk(&mut player))).fold(f64::MAX, f64::min);
    1e6 * best / POSTURES as f64
}

fn postures(posture: &dyn Fn(f64)) -> usize {
    // Steps of the golden section fill the cycle evenly and in no order.
    let mut phase = 0.0;
    for _ in 0..POSTURES {
        phase = (phase + 0.618_033_988_749_895) % 1.0;
        posture(phase);
    }
    POSTURES
}

fn timed_ms<T>(run: impl FnOnce() -> T) -> f64 {
    let start = Instant::now();
    black_box(run());
    1e3 * start.elapsed().as_secs_f64()
}

/// Least time of the peer over its own rounds.
fn peer_ms(vectors: &DMatrix<f64>) -> Result<f64, String> {
    let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
    let file = folder.path().join("vectors.f64");
    let bytes: Vec<u8> = vectors.as_slice().iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(&file, bytes).map_err(|e| e.to_string())?;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/pca_sklearn.py");
    let python = std::env::var("PYTHON").unwrap_or("python3".into());
    let output = Command::new(python).arg(script).arg(&file).arg(vectors.ncols().to_string()).output().map_err(|e| e.to_string())?;
    let (text, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    text.trim().parse().map_err(|_| error.lines().last().unwrap_or("no output").to_string())
}
