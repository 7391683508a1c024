//! Motion models from recorded walks and runs. Data lie beside the project; without them the tests say so and pass.

use crate::common::{cut, cycles, mocap};
use muybridge::body::{Clip, Pose};
use muybridge::io::manifest::find_motions;
use muybridge::math::rotation::exp;
use muybridge::motion_model::{Activity, CadenceLaw, Cycle, Label, Model, SAMPLES, database, segment, synthetic};
use muybridge::style::validate::validate;
use nalgebra::Vector3;

/// Trial, median speed in m/s and number of left strides, as another program measured them.
fn table(source: &str) -> Vec<(String, f64, usize)> {
    let text = std::fs::read_to_string(mocap("TABLE.csv").unwrap()).unwrap();
    let rows = text.lines().map(|l| l.split(',').collect::<Vec<_>>()).filter(|r| r[0] == source);
    rows.map(|r| (r[2].to_string(), r[4].parse().unwrap(), r[5].parse().unwrap())).collect()
}

#[test]
fn speeds_and_strides_of_recorded_walks() {
    let Some(folder) = mocap("cmu-asfamc") else { return };
    let table = table("cmu-asfamc-walk");
    let (mut checked, mut found, mut strides) = (0, 0, 0);
    for entry in find_motions(&[folder], None).unwrap() {
        let trial = entry.path.file_stem().unwrap().to_string_lossy().into_owned();
        let (_, speed_m_s, left_strides) = table.iter().find(|row| row.0 == trial).unwrap();
        let mut speeds: Vec<f64> = cut(&entry, Activity::Walking).iter().map(|c| c.parameter).collect();
        speeds.sort_by(f64::total_cmp);
        assert!(speeds.len() <= left_strides + 1, "{trial}: {} cycles, {left_strides} strides", speeds.len());
        found += speeds.len();
        strides += left_strides;
        // A median over all frames of a trial is no measure for the few strides between its turns or stops.
        let steady = speeds.len() >= 2 && speeds[speeds.len() - 1] < 1.15 * speeds[0];
        if steady && !["26", "27", "29", "46"].contains(&entry.subject.as_str()) {
            let median = (speeds[(speeds.len() - 1) / 2] + speeds[speeds.len() / 2]) / 2.0;
            assert!((median / speed_m_s - 1.0).abs() < 0.05, "{trial}: {speeds:?} against {speed_m_s}");
            checked += 1;
        }
    }
    assert!(checked > 45, "{checked} trials compared");
    assert!(found as f64 > 0.65 * strides as f64, "{found} cycles of {strides} strides");
}

#[test]
fn cadence_of_recorded_walks_follows_inmans_law() {
    let Some(cycles) = cycles("cmu-asfamc", Activity::Walking) else { return };
    let (cycles, _) = database::thin(cycles);
    let model = Model::build(Activity::Walking, false, &cycles).unwrap();
    let (fitted, inman) = (model.cadence(), CadenceLaw::prior(Activity::Walking));
    for v in [0.8, 1.2, 1.6] {
        let ratio = fitted.frequency_hz(v, 0.9) / inman.frequency_hz(v, 0.9);
        assert!((ratio - 1.0).abs() < 0.06, "{v} m/s: {ratio}");
    }
    let scatter: Vec<f64> = model.members.iter().map(|m| (m.duration_s * inman.frequency_hz(m.parameter, m.hip_height_m)).ln()).collect();
    let rms = (scatter.iter().map(|s| s * s).sum::<f64>() / scatter.len() as f64).sqrt();
    assert!(rms < 0.08, "{rms}");
    assert!((8..14).contains(&model.components(0.90)) && (12..22).contains(&model.components(0.95)));
}

#[test]
fn treadmill_runs_have_the_belts_speed_and_every_stride() {
    let Some(folder) = mocap("hamner-running") else { return };
    let table = table("hamner-delp-2013-running");
    for entry in find_motions(&[folder], None).unwrap() {
        let trial = entry.path.file_stem().unwrap().to_string_lossy().into_owned();
        let cycles = cut(&entry, Activity::Running);
        let speed_m_s: f64 = trial.trim_start_matches("Run_").parse().unwrap();
        assert!(cycles.iter().all(|c| c.parameter == speed_m_s));
        // Strides agree with the recording's length at the run's own cadence.
        let seconds: f64 = cycles.iter().map(|c| c.duration_s).sum();
        let strides = table.iter().filter(|row| row.0 == trial).map(|row| row.2);
        assert!(cycles.len() + 2 >= strides.min().unwrap(), "{}: {}", entry.path.display(), cycles.len());
        assert!((0.5..1.0).contains(&(seconds / cycles.len() as f64)), "{seconds} s");
    }
}

/// The ordering that the paper found (style paper, figure 8) on people it was not made with.
#[test]
fn interpolation_lies_between_intra_and_inter_variability_for_recorded_runners() {
    let Some(cycles) = cycles("hamner-running", Activity::Running) else { return };
    let model = Model::build(Activity::Running, false, &cycles).unwrap();
    let scores = validate(&model, 0.95).unwrap().scores;
    let all = |method: &str| scores.iter().find(|s| s.method == method && s.metric == "eq6" && s.left_out == "all").unwrap().value;
    assert!(all("intra") < all("paper") && all("paper") < 0.5 * all("inter"), "{} {} {}", all("intra"), all("paper"), all("inter"));
    assert!(all("paper") < all("mean") && all("paper") < all("unchanged"));
}

/// A cycle played four times at 100 frames per second from a phase of 0.3.
fn played(cycle: &Cycle, offsets: &[Vector3<f64>; muybridge::body::NODES]) -> Clip {
    let h = cycle.hip_height_m;
    let poses = (0..(400.0 * cycle.duration_s) as usize).map(|i| {
        let phase = 0.3 + i as f64 / 100.0 / cycle.duration_s;
        let at = phase.fract() * SAMPLES as f64;
        let (k, part) = (at as usize, at.fract());
        let (a, b) = (k % SAMPLES, (k + 1) % SAMPLES);
        let position = cycle.root[a].position.lerp(&cycle.root[b].position, part);
        let progress = cycle.parameter * i as f64 / 100.0;
        Pose {
            root: h * (position + Vector3::y()) + Vector3::new(0.0, 0.0, progress),
            world_from_root: exp(&cycle.root[a].rotation.lerp(&cycle.root[b].rotation, part)),
            joints: std::array::from_fn(|j| cycle.joints[a][j].slerp(&cycle.joints[b][j], part)),
        }
    });
    Clip { fps: 100.0, poses: poses.collect(), offsets: *offsets, hip_height_m: h }
}

/// The synthetic people's phase 0 is the contact by construction; a clip of theirs must be cut near it.
#[test]
fn strikes_of_synthetic_people_lie_at_phase_zero() {
    for (activity, speeds, most) in [(Activity::Walking, [0.9, 1.3, 1.8], 0.035), (Activity::Running, [1.8, 2.5, 3.3], 0.09)] {
        for (seed, speed_m_s) in (1..5).flat_map(|seed| speeds.map(|v| (seed, v))) {
            let person = synthetic::subject(activity, seed);
            let cycle = person.mean_cycle(speed_m_s);
            let clip = played(&cycle, &person.shape().offsets());
            let label = Label { subject: "x".into(), source: "x".into(), activity, parameter: None, start_s: None, end_s: None };
            let segments = segment(&clip, &label).unwrap();
            let start_s: f64 = segments.cycles[0].source.split(['-', ' ']).nth(1).unwrap().parse().unwrap();
            let phase = (0.3 + start_s / cycle.duration_s + 0.5).fract() - 0.5;
            assert!(phase.abs() < most, "{activity} {seed} at {speed_m_s} m/s: phase {phase:.3}");
            assert!((segments.cycles[0].parameter / speed_m_s - 1.0).abs() < 0.02);
        }
    }
}
