//! Attributes that are turned while the player walks, against the motions that a space blends offline.

use super::player::{Eased, Gaits, Player};
use super::tests::{hip_height_m, offsets, roughness, turns};
use super::{Course, Gait, Profile, ProfileError, Synthesis, follow};
use crate::motion_model::{Activity, Model, synthetic};
use crate::style::space::attributes::{self, direction, spread};
use crate::style::space::{Blend, Example, Options, Space, Vectors};

/// The first `people` synthetic walkers at two speeds as a space.
fn space(people: u64) -> Space {
    let cycles = (1..=people).flat_map(|seed| [0.9, 1.5].map(|v| (seed, v, synthetic::subject(Activity::Walking, seed).cycle(v, 0))));
    let examples: Vec<Example> = cycles.map(|(seed, v, cycle)| Example::of_cycle(&format!("w{seed} {v}"), &cycle)).collect();
    Space::build(&examples, &Options { activity: Some(Activity::Walking), ..Options::default() }).unwrap()
}

/// A gait that walks as `blend` does, and its speed.
fn gait_of(blend: &Blend) -> (Gait, f64) {
    let speed_m_s = blend.speed_m_s(hip_height_m());
    let mut cycle = synthetic::subject(Activity::Walking, 1).cycle(1.2, 0);
    (cycle.parameter, cycle.hip_height_m, cycle.duration_s) = (speed_m_s, hip_height_m(), blend.duration_s());
    (cycle.joints, cycle.root) = (0..100).map(|k| blend.posture(f64::from(k) / 100.0)).unzip();
    let model = Model::build(Activity::Walking, true, &[cycle.clone(), synthetic::subject(Activity::Walking, 8).cycle(1.3, 2)]).unwrap();
    let (weights, frequency_hz) = (model.project(&model.vector_of(&cycle)), 1.0 / cycle.duration_s);
    let (shares, detail, sd, notice) = (Vec::new(), None, None, None);
    let hip_height_m = cycle.hip_height_m;
    let synthesis = Synthesis { weights, detail, sd, parameter: speed_m_s, hip_height_m, frequency_hz, shares, notice };
    (Gait::steady(&model, &synthesis, &offsets()).unwrap(), speed_m_s)
}

/// One standard deviation of every attribute, the others held.
fn units(space: &Space) -> Vec<Vectors> {
    let of = |a: usize| {
        let (vector, deviation) = (direction(space, a, attributes::Method::Joint, &[0, 1]).unwrap(), spread(&space.attributes[a]).1);
        Vectors::sum(&vector, [(deviation, &vector)].into_iter())
    };
    (0..space.attributes.len()).map(of).collect()
}

#[test]
fn attributes_that_play_live_are_those_that_were_blended() {
    let space = space(4);
    let (mean, units) = (space.mean(), units(&space));
    let (mut gait, speed_m_s) = gait_of(&space.play(&mean));
    let blend = |amounts: [f64; 2]| space.play(&units.iter().zip(amounts).fold(mean.clone(), |sum, (unit, a)| sum.plus(unit, a, a)));
    for amounts in [[1.5, 0.0], [0.0, -1.5]] {
        gait.add_change(gait.change(&blend([0.0; 2]), &blend(amounts))).unwrap();
    }
    let gaits = Gaits::one(gait);
    for parts in [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.0, 0.5], [1.0, 1.0]] {
        let offline = blend([1.5 * parts[0], -1.5 * parts[1]]);
        // Slower than the gait's only cycle it would be on its way to a stand.
        let stride_m = offline.speed_m_s(hip_height_m()) * offline.duration_s();
        let faster_m_s = speed_m_s.max(offline.speed_m_s(hip_height_m()));
        let mut player = Player::new(&gaits, faster_m_s, 0.0);
        player.amounts.iter_mut().zip(parts).for_each(|(to, amount)| *to = Eased::at(amount));
        let (mut off, mut changed) = (0.0f64, 0.0f64);
        for _ in 0..100 {
            let pose = player.next(0.01 * stride_m / faster_m_s);
            let largest = |to: &Blend| {
                let wanted = to.posture(player.phase()).0;
                pose.joints.iter().zip(&wanted).map(|(p, q)| p.angle_to(q).to_degrees()).fold(0.0, f64::max)
            };
            (off, changed) = (off.max(largest(&offline)), changed.max(largest(&blend([0.0; 2]))));
        }
        let late = (player.phase() + 0.5).rem_euclid(1.0) - 0.5;
        println!("{parts:?}: off by {off:.3} of {changed:.1} degrees, a cycle later at phase {late:.4}");
        // All of a change is exact; of parts and of both the blend's clock is bent in time.
        if parts == [1.0, 0.0] || parts == [0.0, 1.0] {
            let same = |k: usize| {
                let live = gaits.slow.posture(speed_m_s, k as f64 / 100.0, parts.into_iter()).joints;
                live.iter().zip(&offline.posture(k as f64 / 100.0).0).all(|(p, q)| p.angle_to(q) < 1e-6)
            };
            assert!((0..100).all(same) && off < 0.01, "{parts:?}: {off}");
        }
        assert!(off < 3.0 && (off < 0.15 * changed || changed < 0.1), "{parts:?}: {off} of {changed}");
        // Strides as long as the blend's.
        assert!(late.abs() < 0.01, "{late}");
    }
}

#[test]
fn a_posture_costs_the_same_however_many_examples_were_seen() {
    let costs = [2, 6].map(|people| {
        let space = space(people);
        let mean = space.play(&space.mean());
        let (mut gait, speed_m_s) = gait_of(&mean);
        for unit in units(&space) {
            let change = gait.change(&mean, &space.play(&space.mean().plus(&unit, 1.0, 1.0)));
            assert!(change.rows.iter().any(|x| x.abs() > 1e-3));
            gait.add_change(change).unwrap();
        }
        // The examples are gone; the gait has what it needs.
        drop((space, mean));
        let gaits = Gaits::one(gait);
        let mut player = Player::new(&gaits, speed_m_s, 0.0);
        player.amounts.iter_mut().for_each(|a| a.target = 1.0);
        let (before, after) = (player.next(0.1), player.next(2.0));
        assert!(turns(&before, &after).iter().any(|t| t.norm() > 0.05));
        gaits.slow.numbers()
    });
    assert_eq!(costs[0], costs[1]);
}

#[test]
fn attributes_follow_their_course_without_a_jump() {
    let space = space(4);
    let (mean, units) = (space.mean(), units(&space));
    let (mut gait, speed_m_s) = gait_of(&space.play(&mean));
    gait.add_change(gait.change(&space.play(&mean), &space.play(&mean.plus(&units[0], 1.0, 1.0)))).unwrap();
    let gaits = Gaits::one(gait);
    let play = |points: &[(f64, f64)], fps: f64| {
        let profile = Profile::steady(speed_m_s, 0.0, 4.0).unwrap().with_amounts(vec![Course::new(points.to_vec()).unwrap()]);
        follow(&gaits, &profile, &offsets(), fps).0
    };
    // From less to more at once: velocities and their changes are those of finer steps.
    let [coarse, fine] = [500.0, 1000.0].map(|fps| roughness(&play(&[(0.0, -1.5), (2.0, -1.5), (2.001, 1.5)], fps)));
    assert!(fine[0] < 1.02 * coarse[0] && fine[1] < 0.65 * coarse[1] && fine[3] < 0.65 * coarse[3], "{coarse:?} {fine:?}");
    // Before and after it is what it would be with the amount all along; the clock is at another phase by then.
    let (changing, less) = (play(&[(1.0, -1.5), (1.5, 1.5)], 60.0), play(&[(0.0, -1.5)], 60.0));
    let off = |k: usize| turns(&changing.poses[k], &less.poses[k]).iter().map(|t| t.norm()).fold(0.0, f64::max);
    assert!(off(20) < 1e-3 && off(200) > 0.05, "{} {}", off(20), off(200));
    assert_eq!(Course::new(vec![]), Err(ProfileError::Empty));
    assert!(matches!(Course::new(vec![(1.0, 0.0), (0.5, 1.0)]), Err(ProfileError::Backwards(0.5, 1.0))));
    let course = Course::new(vec![(1.0, 2.0), (3.0, 6.0)]).unwrap();
    assert_eq!([0.0, 1.0, 1.5, 3.0, 9.0].map(|t| course.at(t)), [2.0, 2.0, 3.0, 6.0, 6.0]);
}
