use super::*;
use crate::math::rotation::{exp, log};
use crate::motion_model::synthetic;
use manipulate::{FARTHEST, caricature, eigenmotion, vary};
use nalgebra::Vector3;

/// Cycles of a few synthetic walkers at two speeds.
fn walks() -> Vec<Example> {
    let cycles = (1..5).flat_map(|seed| [0.9, 1.5].map(|v| (seed, v, synthetic::subject(Activity::Walking, seed).cycle(v, 0))));
    cycles.map(|(seed, v, cycle)| Example::of_cycle(&format!("w{seed}#{}", if v < 1.0 { 1 } else { 2 }), &cycle)).collect()
}

fn space(per_curve: bool) -> Space {
    Space::build(&walks(), &Options { activity: Some(Activity::Walking), per_curve, ..Options::default() }).unwrap()
}

/// Largest differences of a motion from an example at the example's own samples: joints and root in radians, root in hip heights.
fn differences(blend: &Blend, example: &Example) -> (f64, f64) {
    let steps = if example.cyclic { example.postures.len() } else { example.postures.len() - 1 } as f64;
    let mut worst: (f64, f64) = (0.0, 0.0);
    for (k, (joints, root)) in example.postures.iter().enumerate() {
        let (found, found_root) = blend.posture(k as f64 / steps);
        let angle = found.iter().zip(joints).map(|(a, b)| a.angle_to(b)).fold(0.0, f64::max);
        worst.0 = worst.0.max(angle).max(exp(&found_root.rotation).angle_to(&exp(&root.rotation)));
        worst.1 = worst.1.max((found_root.position - root.position).norm());
    }
    worst
}

#[test]
fn shape_played_at_its_timing_is_the_motion_itself() {
    let examples = walks();
    for per_curve in [false, true] {
        let space = space(per_curve);
        for (member, example) in space.members.iter().zip(&examples) {
            let blend = space.play(&member.vectors);
            let (angle, length) = differences(&blend, example);
            assert!(angle < 0.7f64.to_radians() && length < 1e-3, "{}: {} {length}", member.name, angle.to_degrees());
            assert!((blend.duration_s() - example.duration_s).abs() < 1e-9);
            assert!((blend.speed_m_s(example.hip_height_m) * example.duration_s / example.hip_height_m - example.stride).abs() < 1e-9);
            // Another walker's shape would not pass.
            let other = space.play(&space.members[(space.reference + 1) % 8].vectors);
            assert!(member.name == space.members[(space.reference + 1) % 8].name || differences(&other, example).0 > 0.05);
        }
        assert_ne!(space.members[0].vectors.timing, space.members[1].vectors.timing);
    }
}

#[test]
fn whole_clips_come_back_too() {
    let mut clips = Vec::new();
    for (name, seconds, lift) in [("low", 1.0f64, 0.8f64), ("high", 1.6, 2.5), ("middle", 1.3, 1.5)] {
        let frames = (seconds * 100.0) as usize + 1;
        let poses = (0..frames).map(|k| {
            let part = k as f64 / (frames - 1) as f64;
            let raised = lift * 0.5 * (1.0 - (std::f64::consts::TAU * part).cos());
            let mut pose = crate::body::Pose::rest(Vector3::new(2.0 + 0.1 * part, 0.95, -1.0));
            pose.world_from_root = exp(&Vector3::new(0.0, 0.7, 0.0));
            pose.joints[crate::body::Joint::RShoulder as usize - 1] = exp(&Vector3::new(-raised, 0.0, 0.0));
            pose
        });
        let shape = crate::body::Shape::template(1.7);
        let clip = crate::body::Clip { fps: 100.0, poses: poses.collect(), offsets: shape.offsets(), hip_height_m: shape.hip_height_m() };
        clips.push(Example::of_clip(name, &clip).unwrap());
    }
    let space = Space::build(&clips, &Options { intervals: Some(60), ..Options::default() }).unwrap();
    assert!(!space.layout.cyclic && space.layout.knots() == 61);
    for (member, clip) in space.members.iter().zip(&clips) {
        let (angle, length) = differences(&space.play(&member.vectors), clip);
        assert!(angle < 0.3f64.to_radians() && length < 1e-3, "{} {length}", angle.to_degrees());
    }
    // The gain of the arm's swing is the only thing that differs in shape, so half way between lies the middle.
    let half = space.mix(&[(0, 1.0), (1, 0.7)], &[(2, 1.0)]).unwrap();
    let blend = space.play(&half);
    let raised = blend.posture(0.5).0[crate::body::Joint::RShoulder as usize - 1].angle();
    assert!((raised - (0.8 + 0.7 * 2.5) / 1.7).abs() < 0.02 && (blend.duration_s() - 1.3).abs() < 1e-9, "{raised}");
    let heights = &space.attributes[space.attribute(measure::HAND_HEIGHT).unwrap()].labels;
    assert!(heights[0] < heights[2] && heights[2] < heights[1], "{heights:?}");
}

#[test]
fn mixing_is_the_sum_of_the_vectors_with_weights_that_sum_to_one() {
    let space = space(false);
    let mixed = space.mix(&[(0, 2.0), (3, 1.0), (5, 1.0)], &[(4, 1.0), (1, -0.25)]).unwrap();
    let x = |i: usize| &space.members[i].vectors;
    for k in [0, 77, 4000, 8400] {
        let expected = 0.5 * x(0).shape[k] + 0.25 * x(3).shape[k] + 0.25 * x(5).shape[k];
        assert!((mixed.shape[k] - expected).abs() < 1e-12);
    }
    assert!((mixed.timing[40] - (x(4).timing[40] - 0.25 * x(1).timing[40]) / 0.75).abs() < 1e-12);
    assert!(matches!(space.mix(&[(0, 1.0), (1, -1.0)], &[(0, 1.0)]), Err(SpaceError::Weights(_))));
    assert!(matches!(space.mix(&[], &[(0, 1.0)]), Err(SpaceError::Weights(_))));
    assert_eq!(space.members_called("w2").unwrap(), [2, 3]);
    assert_eq!(space.members_called("w2#2").unwrap(), [3]);
    assert!(space.members_called("w").unwrap_err().to_string().contains("w1#1, w1#2"));
}

#[test]
fn a_motion_from_outside_is_warped_like_a_member() {
    let examples = walks();
    let space = space(false);
    let again = space.project(&examples[6]).unwrap();
    assert!((&again.timing - &space.members[6].vectors.timing).amax() < 0.01 * examples[6].duration_s);
    assert!((space.distance_from_mean(&again).0 / space.distance_from_mean(&space.members[6].vectors).0 - 1.0).abs() < 0.03);
    let open = Example { cyclic: false, stride: 0.0, ..examples[0].clone() };
    assert!(matches!(space.project(&open), Err(SpaceError::Mixed { .. })));
}

#[test]
fn caricatures_move_along_the_line_from_the_mean_and_their_clock_never_stops() {
    let space = space(false);
    let (mean, own) = (space.mean(), space.members[7].vectors.clone());
    let (degrees, seconds) = space.distance_from_mean(&own);
    for degree in [-1.0, 0.0, 0.5, 1.0, 2.0, 3.5f64] {
        let found = caricature(&mean, &own, degree, 2.0 * degree);
        let (angle, time) = space.distance_from_mean(&found);
        assert!((angle - degree.abs() * degrees).abs() < 1e-9 && (time - 2.0 * degree.abs() * seconds).abs() < 1e-9);
        assert!((found.shape[1234] - mean.shape[1234] - degree * (own.shape[1234] - mean.shape[1234])).abs() < 1e-12);
    }
    assert!(degrees > 1.0 && seconds > 0.01);
    // Forty times the timing's difference runs backwards in places.
    let wild = caricature(&mean, &own, 1.0, 40.0);
    assert!(wild.timing.as_slice().windows(2).any(|w| w[1] <= w[0]));
    for per_curve in [false, true] {
        let layout = Layout { per_curve, ..space.layout };
        let repeat = |t: &DVector<f64>| DVector::from_fn(layout.timing_len(), |k, _| t[k % 100] * (1.0 + 1e-3 * (k / 100) as f64));
        let (mean, wild) = (repeat(&mean.timing), repeat(&wild.timing));
        let kept = blend::increasing(&layout, &mean, &wild);
        for c in 0..layout.timing_len() / 100 {
            let one = kept.rows(c * 100, 100);
            assert!(one[0] > 0.0 && one.as_slice().windows(2).all(|w| w[1] > w[0]));
            assert!((one[99] - kept[99]).abs() < 1e-9, "curves end together");
        }
        // What increases well already stays.
        assert!((blend::increasing(&layout, &mean, &mean) - &mean).amax() < if per_curve { 0.1 } else { 1e-15 });
    }
}

#[test]
fn eigenmotions_are_standard_deviations_of_the_examples() {
    let space = space(false);
    let changed = eigenmotion(&space, Some(0), None, 3.0).unwrap();
    assert_eq!(changed.timing, space.timing.mean);
    // The variance of the members along the direction, by hand.
    let direction = (&changed.shape - &space.shape.mean) / 3.0;
    let along: Vec<f64> = space.members.iter().map(|m| (&m.vectors.shape - &space.shape.mean).dot(&direction) / direction.norm()).collect();
    let variance = along.iter().map(|a| a * a).sum::<f64>() / along.len() as f64;
    assert!((variance.sqrt() / direction.norm() - 1.0).abs() < 1e-9);
    assert!(eigenmotion(&space, Some(99), None, 1.0).is_none());
}

#[test]
fn crowds_have_the_examples_covariance_and_stay_within_it() {
    let space = space(false);
    let mean = space.mean();
    let people = vary(&space, &mean, 1.0, 3000, 11);
    let (pca, count) = (&space.shape, 3);
    for k in 0..count {
        let weights: Vec<f64> = people.iter().map(|p| pca.basis.column(k).dot(&(&p.shape - &pca.mean))).collect();
        let deviation = (weights.iter().map(|w| w * w).sum::<f64>() / weights.len() as f64).sqrt() / pca.eigenvalues[k].sqrt();
        // A normal deviate clamped at ±2 has the variance 0.9204.
        assert!((deviation - 0.9204f64.sqrt()).abs() < 0.03, "{k}: {deviation}");
        assert!(weights.iter().all(|w| w.abs() <= FARTHEST * pca.eigenvalues[k].sqrt() * (1.0 + 1e-9)));
    }
    // Shape and timing vary together as the examples do: who is slow takes other steps.
    let first = |v: &Vectors| (space.shape.basis.column(0).dot(&(&v.shape - &mean.shape)), v.timing[99] - mean.timing[99]);
    let correlation = |all: Vec<(f64, f64)>| {
        let sum = |f: fn(&(f64, f64)) -> f64| all.iter().map(f).sum::<f64>();
        sum(|p| p.0 * p.1) / (sum(|p| p.0 * p.0) * sum(|p| p.1 * p.1)).sqrt()
    };
    let own = correlation(space.members.iter().map(|m| first(&m.vectors)).collect());
    let drawn = correlation(people.iter().map(first).collect());
    assert!((own - drawn).abs() < 0.08 && own.abs() > 0.3, "{own} {drawn}");
    assert_eq!(vary(&space, &mean, 0.5, 3, 4), vary(&space, &mean, 0.5, 3, 4));
    assert_ne!(vary(&space, &mean, 0.5, 3, 4), vary(&space, &mean, 0.5, 3, 5));
}

/// A space whose members are known mixtures of two directions, with the labels (μ, ν) that made them.
fn labelled() -> (Space, Vectors, Vectors) {
    let space = space(false);
    let base = space.mean();
    let (a, b) = (space.members[0].vectors.minus(&base), space.members[3].vectors.minus(&base));
    // The labels correlate: ν rises with μ.
    let labels = [(1.0, 1.1), (2.0, 1.9), (3.0, 2.5), (4.0, 4.4), (5.0, 4.6), (6.0, 6.3), (7.0, 6.5)];
    let member = |(i, &(mu, nu)): (usize, &(f64, f64))| Member {
        name: format!("m{i}"),
        source: String::new(),
        hip_height_m: 0.9,
        vectors: base.plus(&a, 0.1 * mu, 0.1 * mu).plus(&b, 0.2 * nu, 0.2 * nu),
    };
    let members = labels.iter().enumerate().map(member).collect();
    let mut known = Space::of_members(space.layout, None, space.mean_rotations, 0, members).unwrap();
    known.set_attribute(Attribute { name: "mu".into(), labels: labels.iter().map(|l| Some(l.0)).collect() });
    known.set_attribute(Attribute { name: "nu".into(), labels: labels.iter().map(|l| Some(l.1)).collect() });
    (known, a, b)
}

#[test]
fn attribute_vectors_are_the_papers_sums_and_least_squares() {
    let (space, a, b) = labelled();
    let labels: Vec<f64> = space.attributes[0].labels.iter().map(|l| l.unwrap()).collect();
    let sum = attributes::direction(&space, 0, Method::Sum, &[]).unwrap();
    let by_hand = |k: usize| space.members.iter().zip(&labels).map(|(m, l)| l * (m.vectors.shape[k] - space.shape.mean[k])).sum::<f64>();
    for k in [5, 300, 8000] {
        assert!((sum.shape[k] - by_hand(k)).abs() < 1e-10);
    }
    // The slope is the sum over Σ(μ − μ̄)² = 28.
    let slope = attributes::direction(&space, 0, Method::Slope, &[]).unwrap();
    assert!((&sum.shape / 28.0 - &slope.shape).amax() < 1e-10 && (&sum.timing / 28.0 - &slope.timing).amax() < 1e-10);
    // Both labels together find what made the members; the slope alone drags ν along.
    let joint = attributes::direction(&space, 0, Method::Joint, &[0, 1]).unwrap();
    assert!((&joint.shape - &a.shape * 0.1).amax() < 1e-9 && (&joint.timing - &a.timing * 0.1).amax() < 1e-9);
    assert!((&slope.shape - &a.shape * 0.1).amax() > 1e-2);
    let other = attributes::direction(&space, 1, Method::Joint, &[0]).unwrap();
    assert!((&other.shape - &b.shape * 0.2).amax() < 1e-9);
    // The same regression by QR of [1 μ ν].
    let design = DMatrix::from_fn(7, 3, |i, k| if k == 0 { 1.0 } else { space.attributes[k - 1].labels[i].unwrap() });
    let values = DVector::from_iterator(7, space.members.iter().map(|m| m.vectors.shape[4242]));
    let qr = design.qr();
    let solution = qr.r().solve_upper_triangular(&(qr.q().transpose() * values)).unwrap();
    assert!((solution[1] - joint.shape[4242]).abs() < 1e-10 && (solution[2] - other.shape[4242]).abs() < 1e-10);
}

#[test]
fn the_network_goes_through_what_is_linear_and_bends_for_the_rest() {
    let (space, a, b) = labelled();
    let network = Network::new(&space, &[0, 1]).unwrap();
    let wanted = network.at(&[3.3, 8.0]);
    let base = space.members[0].vectors.plus(&a, -0.1, -0.1).plus(&b, -0.22, -0.22);
    assert!((&wanted.shape - base.plus(&a, 0.33, 0.33).plus(&b, 1.6, 1.6).shape).amax() < 1e-9);
    // A bend at the middle example: the network follows it there, not a far one; a line would spread it over all.
    let mut bent = space.clone();
    bent.members[3].vectors.shape[100] += 1.0;
    let bent = Space {
        attributes: space.attributes.clone(),
        ..Space::of_members(bent.layout, None, bent.mean_rotations, 0, bent.members).unwrap()
    };
    let network = Network::new(&bent, &[0]).unwrap();
    let at = |mu: f64| network.at(&[mu]).shape[100] - Network::new(&space, &[0]).unwrap().at(&[mu]).shape[100];
    assert!(at(4.0) > 0.3 && at(4.0) < 1.0 && at(4.0) > 2.0 * at(2.0), "{} {}", at(4.0), at(2.0));
    assert!((at(60.0) - 1.0 / 7.0).abs() < 1e-9, "far away the line is left");
}

#[test]
fn labels_that_show_nothing_are_refused() {
    let (mut space, ..) = labelled();
    space.set_attribute(Attribute { name: "same".into(), labels: vec![Some(2.0); 7] });
    space
        .set_attribute(Attribute { name: "twice".into(), labels: space.attributes[0].labels.iter().map(|l| l.map(|l| 2.0 * l)).collect() });
    let mut few = vec![None; 7];
    (few[0], few[4]) = (Some(1.0), Some(3.0));
    space.set_attribute(Attribute { name: "few".into(), labels: few });
    let direction = |name: &str, method, keep: &[usize]| attributes::direction(&space, space.attribute(name).unwrap(), method, keep);
    assert!(matches!(direction("same", Method::Slope, &[]), Err(SpaceError::Constant { labelled: 7, .. })));
    assert!(matches!(direction("mu", Method::Joint, &[3]), Err(SpaceError::Collinear(_))));
    assert!(matches!(direction("few", Method::Joint, &[0]), Err(SpaceError::Unlabelled { found: 2, wanted: 4, .. })));
    // Two labels are enough for a slope: half the difference of the two per unit.
    let slope = direction("few", Method::Slope, &[]).unwrap();
    let expected = (space.members[4].vectors.shape[700] - space.members[0].vectors.shape[700]) / 2.0;
    assert!((slope.shape[700] - expected).abs() < 1e-12);
    assert!(space.attribute("grace").unwrap_err().to_string().contains("mu, nu, same"));
}

#[test]
fn live_it_is_the_same_motion_and_turning_a_knob_does_not_move_the_body_at_once() {
    let (space, a, _) = labelled();
    let base = space.members[2].vectors.clone();
    let mut live = Live::new(&space, &base, &[0, 1]).unwrap();
    let before = live.next(0.2);
    live.set(&[1.5, 0.0], 1.3);
    let exaggerated = caricature(&space.mean(), &base, 1.3, 1.3).plus(&a, 0.15, 0.15);
    let expected = space.play(&exaggerated);
    assert!((live.blend().duration_s() - expected.duration_s()).abs() < 1e-9);
    for phase in [0.1, 0.63] {
        assert!(live.posture(phase).0.iter().zip(&expected.posture(phase).0).all(|(a, b)| a.angle_to(b) < 1e-9));
    }
    // Setting and taking back brings the very posture back: the clock kept its place.
    live.set(&[0.0, 0.0], 1.0);
    assert!(live.next(0.0).0.iter().zip(&before.0).all(|(a, b)| a.angle_to(b) < 1e-9));
    let duration_s = live.blend().duration_s();
    assert!(live.next(duration_s).0.iter().zip(&before.0).all(|(a, b)| a.angle_to(b) < 1e-9), "one cycle later");
    assert!(live.next(0.3 * duration_s).0[2].angle_to(&before.0[2]) > 0.01);
}

#[test]
fn a_change_carries_one_motion_into_the_other_in_anothers_coordinates() {
    let space = space(false);
    let [from, to] = [1, 6].map(|m| space.play(&space.members[m].vectors));
    let others = std::array::from_fn(|j| exp(&Vector3::new(0.01 * j as f64, -0.2, 0.1)));
    let rows = live::change(&from, &to, &others, 50);
    for k in [0, 17, 49] {
        let (row, phase) = (&rows[k * CURVES..], k as f64 / 50.0);
        let ((a, root_a), (b, root_b)) = (from.posture(phase), to.posture(phase));
        for j in 0..BALL_JOINTS {
            let coordinates = log(&(others[j].inverse() * a[j])) + Vector3::from_column_slice(&row[3 * j..3 * j + 3]);
            assert!((others[j] * exp(&coordinates)).angle_to(&b[j]) < 1e-9);
        }
        let position = root_a.position + Vector3::from_column_slice(&row[CURVES - 3..CURVES]);
        assert!((position - root_b.position).norm() < 1e-12 && (root_a.position - root_b.position).norm() > 1e-4);
    }
}

#[test]
fn what_is_no_set_of_motions_is_refused() {
    let examples = walks();
    let build = |e: &[Example]| Space::build(e, &Options::default()).unwrap_err();
    assert_eq!(build(&examples[..1]), SpaceError::TooFew(1));
    assert_eq!(build(&[examples[0].clone(), examples[0].clone()]), SpaceError::SameName("w1#1".into()));
    let renamed = Example { name: "again".into(), ..examples[0].clone() };
    assert_eq!(build(&[examples[0].clone(), renamed]), SpaceError::NoVariance);
    let open = Example { cyclic: false, ..examples[1].clone() };
    assert!(matches!(build(&[examples[0].clone(), open]), SpaceError::Mixed { .. }));
    let short = Example { postures: examples[1].postures[..5].to_vec(), ..examples[1].clone() };
    assert!(matches!(build(&[examples[0].clone(), short]), SpaceError::Short { found: 5, .. }));
    let endless = Example { duration_s: f64::INFINITY, ..examples[1].clone() };
    assert!(matches!(build(&[examples[0].clone(), endless]), SpaceError::Size { .. }));
}
