//! The fit's solver beside Ceres (`peers/fit_ceres.cpp`, Debian's `libceres-dev`): the same frozen problem from one file, one thread
//! each, to the same minimum. Then the time and memory of our iteration over the number of frames.
//!
//! A synthetic walker goes round in a circle; points lie on its skin, 5 mm of noise added. Without Ceres that part is skipped, and
//! that is said.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use muybridge::body::surface::Evaluation;
use muybridge::body::{Joint, Length, PosedSurface, Shape, Surface};
use muybridge::fit::SETTINGS;
use muybridge::fit::curve::Curve;
use muybridge::fit::problem::{Frame, Free, Known, Problem, Target};
use muybridge::fit::state::{Carrier, Posture, State};
use muybridge::math::arrow::{ArrowProblem, LmOptions, minimise};
use muybridge::math::rotation::exp;
use muybridge::motion_model::{Activity, Model, SAMPLES, synthetic};
use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

const NOISE_M: f64 = 0.005;
const FREE: Free = Free { rotation: true, phase: true, weights: true, stature: true, lengths: true, widths: true, posture: false };
const KNOWN: Known = Known { viewpoint: Vector3::new(0.0, 1.2, -6.0), up: Vector3::new(0.0, 1.0, 0.0), stature_m: 1.75, floor_m: None };
const ROUNDS: usize = 3;
const ITERATIONS: usize = 8;

fn main() {
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    let model = Model::build(Activity::Walking, true, &synthetic::database(Activity::Walking)).expect("the embedded database");
    let curve = Curve::new(&model, 20);
    let truth = |frames| walker(&model, &curve, frames);
    compare(&one, &curve, &truth(100));
    println!("\n| frames | points | ms per iteration | us per frame | peak memory of an iteration, MB |\n|---|---|---|---|---|");
    for frames in [100, 200, 500, 1000, 2000] {
        let truth = truth(frames);
        let (frames, start) = (film(&curve, &truth, 500), away(&truth));
        let problem = Problem::new(&curve, &frames, &SETTINGS, FREE, &KNOWN, &start);
        let before = reset_peak_mb();
        let [linearise, step, cost] = one.install(|| iteration_s(&problem, &start));
        let [ms, us] = [1e3, 1e6 / frames.len() as f64].map(|unit| unit * (linearise + step + cost));
        println!("| {} | 500 | {ms:.1} | {us:.0} | {:.0} |", frames.len(), status_mb("VmHWM") - before);
    }
}

/// A person of the database on a circle of 1.5 m, 25 frames per second.
fn walker(model: &Model, curve: &Curve, frames: usize) -> State {
    let weights = model.member_weights(&model.members[7]).as_slice()[..curve.components()].to_vec();
    let mut shape = Shape::template(1.78);
    shape.lengths = std::array::from_fn(|i| 1.0 + 0.03 * (i as f64).sin());
    shape.widths = std::array::from_fn(|i| 1.0 + 0.08 * (2.0 * i as f64).cos());
    let carriers = (0..frames).map(|t| {
        let (time_s, radius) = (t as f64 / 25.0, 1.5);
        let angle = 1.3 * time_s / radius;
        let position = Vector3::new(radius * angle.sin(), shape.hip_height_m(), -radius * angle.cos());
        let heading = exp(&Vector3::new(0.0, std::f64::consts::FRAC_PI_2 - angle, 0.0));
        Carrier { position, world_from_carrier: heading, phase: 0.93 * time_s }
    });
    State { carriers: carriers.collect(), weights, shape, posture: Posture::default(), deviations: Vec::new() }
}

/// Where the solver starts: the mean person, turned, shifted and out of step.
fn away(truth: &State) -> State {
    let mut start = truth.clone();
    start.weights.fill(0.0);
    start.shape = Shape::template(KNOWN.stature_m);
    for carrier in &mut start.carriers {
        carrier.position += Vector3::new(0.02, -0.01, 0.015);
        carrier.world_from_carrier = exp(&Vector3::new(0.01, 0.04, -0.01)) * carrier.world_from_carrier;
        carrier.phase += 0.01;
    }
    start
}

/// Frames of `points` noisy points on the sides of the skin that the cameras see.
fn film(curve: &Curve, truth: &State, points: usize) -> Vec<Frame> {
    let body = Surface::new(&truth.shape);
    let film = |t: usize| {
        let surface = truth.posed(curve, &body, t).surface;
        let mut rng = ChaCha8Rng::seed_from_u64(t as u64);
        let mut scratch = Evaluation::default();
        let mut targets = Vec::with_capacity(points);
        while targets.len() < points {
            if let Some(x) = skin_point(&surface, &mut rng, &mut scratch) {
                targets.push(Target::Point { x: x + normal(&mut rng) * NOISE_M, covariance: Matrix3::identity() * (NOISE_M * NOISE_M) });
            }
        }
        Frame { time_s: t as f64 / 25.0, targets, ..Frame::default() }
    };
    (0..truth.carriers.len()).into_par_iter().map(film).collect()
}

/// A point beside a random primitive, brought to the skin along the gradient; `None` if that fails or the cameras do not see it.
fn skin_point(surface: &PosedSurface, rng: &mut ChaCha8Rng, scratch: &mut Evaluation) -> Option<Vector3<f64>> {
    let primitive = &surface.primitives[rng.random_range(0..surface.primitives.len())];
    let mut x = primitive.centre + primitive.world_from_node * primitive.semi_axes.component_mul(&normal(rng).normalize());
    for _ in 0..5 {
        surface.evaluate_into(&x, scratch);
        x -= scratch.gradient.normalize() * scratch.distance();
    }
    surface.evaluate_into(&x, scratch);
    let facing = scratch.gradient.normalize().dot(&(x - KNOWN.viewpoint).normalize());
    (scratch.distance().abs() < 1e-4 && facing < 0.1).then_some(x)
}

fn normal(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    let mut one = || (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt() * (std::f64::consts::TAU * rng.random::<f64>()).cos();
    Vector3::new(one(), one(), one())
}

/// Least seconds to linearise, to solve and to judge a step, over the first iterations from `start`: others may use the machine.
fn iteration_s(problem: &Problem, start: &State) -> [f64; 3] {
    let mut state = start.clone();
    let mut least = [f64::INFINITY; 3];
    for _ in 0..ITERATIONS {
        let began = Instant::now();
        let normal = problem.linearise(&state);
        let linearised = Instant::now();
        let (y, z) = normal.step(1e-4).expect("a regular problem");
        let stepped = Instant::now();
        state = problem.retract(&state, &y, &z);
        std::hint::black_box(problem.cost(&state));
        let seconds = [linearised - began, stepped - linearised, stepped.elapsed()];
        least.iter_mut().zip(seconds).for_each(|(least, s)| *least = least.min(s.as_secs_f64()));
    }
    least
}

/// 100 frames of 1500 points: least time of some rounds, ours and theirs by turns.
fn compare(one: &rayon::ThreadPool, curve: &Curve, truth: &State) {
    let (frames, start) = (film(curve, truth, 1500), away(truth));
    let problem = || Problem::new(curve, &frames, &SETTINGS, FREE, &KNOWN, &start);
    let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fit_problem.bin");
    std::fs::write(&file, bytes_of(&problem(), curve, &start)).expect("a writable target folder");
    let peer = build_peer();
    let (fitted, summary) = minimise(problem(), start.clone(), &LmOptions { max_iterations: 200, relative_cost: 1e-13 });
    let mut ours = [f64::INFINITY; 3];
    let mut theirs = [("schur", f64::INFINITY, f64::NAN), ("normal", f64::INFINITY, f64::NAN)];
    for _ in 0..ROUNDS {
        let times = one.install(|| iteration_s(&problem(), &start));
        if times.iter().sum::<f64>() < ours.iter().sum::<f64>() {
            ours = times;
        }
        if let Some(program) = &peer {
            for (solver, least, cost) in &mut theirs {
                let (seconds, final_cost) = run_peer(program, &file, solver, summary.initial_cost);
                (*least, *cost) = (least.min(seconds), final_cost);
            }
        }
    }
    let total: f64 = ours.iter().sum();
    let misses = fitted.carriers.iter().zip(&truth.carriers).map(|(a, b)| (a.position - b.position).norm_squared());
    println!("100 frames of 1500 points, 20 weights, one thread; {} iterations from cost {:.0}", summary.iterations, summary.initial_cost);
    println!("carrier {:.1} mm from the truth (it was 27)", 1e3 * (misses.sum::<f64>() / 100.0).sqrt());
    println!("\n| solver | ms per iteration | ours over it | final cost |\n|---|---|---|---|");
    println!("| muybridge | {:.1} | 1 | {:.7} |", 1e3 * total, summary.final_cost);
    for (solver, seconds, cost) in theirs.iter().filter(|_| peer.is_some()) {
        println!("| Ceres, {solver} | {:.1} | {:.2} | {cost:.7} |", 1e3 * seconds, total / seconds);
        assert!((cost / summary.final_cost - 1.0).abs() < 1e-6, "Ceres found another minimum");
    }
    println!("\nours: linearise {:.1}, solve {:.1}, judge {:.1} ms", 1e3 * ours[0], 1e3 * ours[1], 1e3 * ours[2]);
}

/// The compiled peer; `None` where there is no compiler or no Ceres.
fn build_peer() -> Option<PathBuf> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/fit_ceres.cpp");
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fit_ceres");
    let mut compiler = Command::new("g++");
    compiler.args(["-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-w", "-I/usr/include/eigen3"]);
    let built = compiler.arg(source).args(["-lceres", "-lglog", "-o"]).arg(&program).output();
    if built.is_ok_and(|output| output.status.success()) {
        return Some(program);
    }
    println!("skipped: Ceres; `apt-get install g++ libceres-dev` brings what its side of the comparison is compiled with\n");
    None
}

/// Seconds per iteration and final cost of Ceres, which must begin at our cost.
fn run_peer(program: &Path, file: &Path, solver: &str, initial_cost: f64) -> (f64, f64) {
    let output = Command::new(program).arg(file).arg(solver).output().expect("the peer runs");
    let text = String::from_utf8_lossy(&output.stdout);
    let number = |key: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(key)).and_then(|rest| rest.trim().parse::<f64>().ok());
        line.unwrap_or_else(|| panic!("no {key} from Ceres: {text} {}", String::from_utf8_lossy(&output.stderr)))
    };
    assert!((number("initial_cost ") / initial_cost - 1.0).abs() < 1e-9, "Ceres solves another problem");
    (number("seconds "), number("final_cost "))
}

/// Body, curve, priors, start and frozen points as 64-bit floats in the order in which the peer reads them.
fn bytes_of(problem: &Problem, curve: &Curve, start: &State) -> Vec<u8> {
    let mut out = vec![problem.frames.len() as f64, curve.components() as f64];
    body_into(&mut out);
    let none = vec![0.0; curve.components()];
    let samples: Vec<_> = (0..SAMPLES).map(|k| curve.sample(k as f64 / SAMPLES as f64, &none)).collect();
    samples.iter().for_each(|s| out.extend(s.value.iter()));
    (0..curve.components()).for_each(|i| samples.iter().for_each(|s| out.extend(s.components.column(i).iter())));
    curve.mean_rotations.iter().for_each(|q| out.extend([q.w, q.i, q.j, q.k]));
    out.extend(&curve.eigenvalues);
    let s = problem.settings;
    out.extend([s.tilt, s.acceleration, s.angular_acceleration, s.phase_acceleration, s.stature]);
    let arm = [Length::Shoulders, Length::UpperArm, Length::Forearm, Length::Hand];
    out.extend(Length::ALL.map(|limb| if arm.contains(&limb) { s.arm_length } else { s.length }));
    out.push(s.width);
    out.extend(problem.known.up.iter());
    out.push(problem.known.stature_m);
    out.extend(&start.weights);
    out.push(start.shape.stature_m.ln());
    out.extend(start.shape.lengths.iter().chain(&start.shape.widths));
    for ((frame, carrier), frozen) in problem.frames.iter().zip(&start.carriers).zip(problem.frozen()) {
        let (q, p) = (carrier.world_from_carrier, carrier.position);
        out.extend([frame.time_s, q.w, q.i, q.j, q.k, p.x, p.y, p.z, carrier.phase]);
        let counted: Vec<_> = frozen.iter().filter(|f| f.weight > 0.0).collect();
        out.push(counted.len() as f64);
        for f in counted {
            out.extend([f.x.x, f.x.y, f.x.z, f.offset_m, f.metres_per_root, f.weight, f.near.indices().count() as f64]);
            out.extend(f.near.indices().map(|i| i as f64));
        }
    }
    out.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// The body at stature 1, all of it linear in stature and its factor.
fn body_into(out: &mut Vec<f64>) {
    let template = Shape::template(1.0);
    for (joint, offset) in Joint::ALL.iter().zip(template.offsets()) {
        out.extend([joint.parent().map_or(-1.0, |p| p as usize as f64), Length::above(*joint) as usize as f64]);
        out.extend(offset.iter());
    }
    out.extend(Length::ALL.map(|limb| {
        let mut longer = template.clone();
        longer.lengths[limb as usize] += 1.0;
        longer.hip_height_m() - template.hip_height_m()
    }));
    let primitives = Surface::new(&template).primitives;
    out.push(primitives.len() as f64);
    for p in &primitives {
        out.extend([p.node as usize as f64, p.limb as usize as f64, p.axis as f64]);
        out.extend(p.centre.iter().chain(p.semi_axes.iter()));
    }
}

/// Forgets the peak of this process's memory, and says what it holds now, MB; NaN where there is no /proc.
fn reset_peak_mb() -> f64 {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    status_mb("VmRSS")
}

fn status_mb(key: &str) -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with(key)).and_then(|line| line.split_whitespace().nth(1)?.parse::<f64>().ok());
    line.map_or(f64::NAN, |kb| kb / 1024.0)
}
