//! Strides and steps of a clip: the numbers a gait laboratory writes down.
//!
//! Heel strikes and toe-offs after Zeni et al. (2008), Gait & Posture 27(4): heel farthest before, toe tip farthest behind
//! the root. A foot's place is its heel's mean position while the foot is flat, from 10 to 20 % of the stride after the
//! strike, because at the strike found the heel still glides. With d the direction of the root's way over a stride or step:
//!   stride length = d · (place − the same foot's place before),
//!   step length, width = along and across d from the other foot's place before.                                    (1)
//!
//! Of walkers the stance comes out long by 1 to 3 % of the cycle, because both events are those of a foot that moves like the
//! root; of runners by 15 to 20 %, so their tables have none (measured on synthetic people whose support is known).
//! Fails when: the person turns on the spot.
//! Checked against synthetic walkers whose strides, steps and support are known.

use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::segment::{Track, farthest_behind, ground, strikes};
use crate::body::{Clip, Joint, Pose};

/// While the foot is flat, shares of a stride after the strike.
const FLAT: [f64; 2] = [0.10, 0.20];
/// A stride lasts at least this long, seconds; wiggles are shorter.
const SHORTEST_S: f64 = 0.4;
/// Samples of a cycle's curve: 0 to 100 %.
pub const PERCENTS: usize = 101;

/// From one strike of a foot to its next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stride {
    pub from_s: f64,
    pub to_s: f64,
    pub toe_off_s: Option<f64>,
    /// `None` where the clip ends before the foot is flat.
    pub length_m: Option<f64>,
}

/// From a strike of the other foot to this one's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    pub at_s: f64,
    pub time_s: f64,
    /// Along and across the way; positive widths have the left foot on the left.
    pub length_width_m: Option<[f64; 2]>,
}

/// Events of one foot, seconds from the clip's start.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Foot {
    pub strikes_s: Vec<f64>,
    pub toe_offs_s: Vec<f64>,
    pub strides: Vec<Stride>,
    pub steps: Vec<Step>,
}

/// Events of the left and the right foot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gait {
    pub feet: [Foot; 2],
}

/// Mean, standard deviation (`None` for fewer than two) and number of what was measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measure {
    pub mean: f64,
    pub sd: Option<f64>,
    pub n: usize,
}

/// One line of the spatio-temporal table, SI units and shares.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    pub name: &'static str,
    pub unit: &'static str,
    /// Left, right; both feet together.
    pub sides: [Option<Measure>; 2],
    pub both: Option<Measure>,
}

impl Line {
    /// 100 (left − right) / mean of both, percent (Robinson et al. 1987); 0 is symmetric.
    pub fn asymmetry_percent(&self) -> Option<f64> {
        let [left, right] = [self.sides[0]?.mean, self.sides[1]?.mean];
        let mean = 0.5 * (left + right);
        (mean.abs() > 1e-9).then(|| 100.0 * (left - right) / mean)
    }
}

/// Events, strides and steps of a clip of walking or running.
pub fn gait(clip: &Clip) -> Gait {
    if clip.poses.len() < 3 || clip.fps.is_nan() || clip.fps <= 0.0 {
        return Gait::default();
    }
    let track = Track::new(clip, 0..clip.poses.len());
    let toes = [Joint::LMidtarsal, Joint::RMidtarsal].map(|joint| {
        let tip = clip.end_site(joint).unwrap_or_default();
        let at = |pose: &Pose| {
            let placed = clip.place(pose);
            placed.position(joint) + placed.world_from_node[joint as usize] * tip
        };
        clip.poses.iter().map(at).collect::<Vec<Vector3<f64>>>()
    });
    let seconds = |frames: Vec<f64>| frames.into_iter().map(|f| f / clip.fps).collect::<Vec<f64>>();
    // The track has the right foot first.
    let strikes_s = [1, 0].map(|side| seconds(strikes(&track, side)));
    let toe_offs_s = [0, 1].map(|k| seconds(farthest_behind(&track, &toes[k])));
    let stride_s = stride_time(&strikes_s);
    let places: [Vec<Option<Vector2<f64>>>; 2] =
        [0, 1].map(|k| strikes_s[k].iter().map(|at| place(&track, &track.heels[1 - k], *at, stride_s?)).collect());
    let feet = [0, 1].map(|k| Foot {
        strides: strides(&track, &strikes_s[k], &toe_offs_s[k], &places[k]),
        steps: steps(&track, [&strikes_s[k], &strikes_s[1 - k]], [&places[k], &places[1 - k]], k == 0, stride_s),
        strikes_s: strikes_s[k].clone(),
        toe_offs_s: toe_offs_s[k].clone(),
    });
    Gait { feet }
}

/// Mean time of a stride, from those of both feet, else twice that from one foot's strike to the other's.
fn stride_time(strikes_s: &[Vec<f64>; 2]) -> Option<f64> {
    let whole: Vec<f64> = strikes_s.iter().flat_map(|s| s.windows(2).map(|w| w[1] - w[0])).filter(|s| *s > SHORTEST_S).collect();
    if !whole.is_empty() {
        return Some(whole.iter().sum::<f64>() / whole.len() as f64);
    }
    Some(2.0 * (strikes_s[0].first()? - strikes_s[1].first()?).abs()).filter(|s| *s > SHORTEST_S)
}

/// Where a foot that strikes at `at_s` stands on the floor.
fn place(track: &Track, heels: &[Vector3<f64>], at_s: f64, stride_s: f64) -> Option<Vector2<f64>> {
    let [from, to] = FLAT.map(|share| (at_s + share * stride_s) * track.fps);
    let flat = heels.get(from.ceil() as usize..=to.floor().max(from.ceil()) as usize)?;
    Some(flat.iter().map(ground).sum::<Vector2<f64>>() / flat.len() as f64)
}

/// Direction of the root's way between two times.
fn way(track: &Track, from_s: f64, to_s: f64) -> Option<Vector2<f64>> {
    let [a, b] = [from_s, to_s].map(|t| track.pose_at(t * track.fps).root);
    ground(&(b - a)).try_normalize(1e-3)
}

fn strides(track: &Track, strikes_s: &[f64], toe_offs_s: &[f64], places: &[Option<Vector2<f64>>]) -> Vec<Stride> {
    let one = |i: usize| {
        let (from_s, to_s) = (strikes_s[i], strikes_s[i + 1]);
        let direction = way(track, from_s, to_s)?;
        let length_m = places[i].zip(places[i + 1]).map(|(a, b)| direction.dot(&(b - a)));
        let toe_off_s = toe_offs_s.iter().copied().find(|t| *t > from_s && *t < to_s);
        (to_s - from_s > SHORTEST_S).then_some(Stride { from_s, to_s, toe_off_s, length_m })
    };
    (0..strikes_s.len().saturating_sub(1)).filter_map(one).collect()
}

/// Steps of the first foot; strikes and places of it and of the other one.
fn steps(track: &Track, strikes_s: [&[f64]; 2], places: [&[Option<Vector2<f64>>]; 2], left: bool, stride_s: Option<f64>) -> Vec<Step> {
    let one = |(i, at_s): (usize, &f64)| {
        let before = strikes_s[1].iter().rposition(|t| t < at_s)?;
        let time_s = at_s - strikes_s[1][before];
        // The other foot's strike is missing where a step takes nearly a stride.
        if time_s > 0.75 * stride_s? {
            return None;
        }
        // Over a whole stride, in which the root sways to both sides.
        let (stride_s, last_s) = (stride_s?, (track.poses.len() - 1) as f64 / track.fps);
        let from_s = (at_s - 0.5 * (time_s + stride_s)).clamp(0.0, (last_s - stride_s).max(0.0));
        let d = way(track, from_s, from_s + stride_s)?;
        let length_width_m = places[0][i].zip(places[1][before]).map(|(here, there)| {
            let step = here - there;
            // x left, z forward: the left of (0, 1) is (1, 0).
            let to_left = step.dot(&Vector2::new(d.y, -d.x));
            [step.dot(&d), if left { to_left } else { -to_left }]
        });
        Some(Step { at_s: *at_s, time_s, length_width_m })
    };
    strikes_s[0].iter().enumerate().filter_map(one).collect()
}

fn measure(values: impl IntoIterator<Item = f64>) -> Option<Measure> {
    let values: Vec<f64> = values.into_iter().filter(|v| v.is_finite()).collect();
    let n = values.len();
    let mean = values.iter().sum::<f64>() / n as f64;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    (n > 0).then(|| Measure { mean, sd: (n > 1).then(|| (square / (n - 1) as f64).sqrt()), n })
}

impl Gait {
    /// The spatio-temporal table; lines without any value are `None` on all sides. `walks` adds the shares of stance, swing
    /// and double support.
    pub fn table(&self, walks: bool) -> Vec<Line> {
        let of_strides = |f: &dyn Fn(&Stride) -> Option<f64>| self.feet.each_ref().map(|foot| measure(foot.strides.iter().filter_map(f)));
        let of_steps = |f: &dyn Fn(&Step) -> Option<f64>| self.feet.each_ref().map(|foot| measure(foot.steps.iter().filter_map(f)));
        let seconds = |s: &Stride| s.to_s - s.from_s;
        let stance = |s: &Stride| Some((s.toe_off_s? - s.from_s) / seconds(s));
        let line = |name, unit, sides: [Option<Measure>; 2]| Line { name, unit, sides, both: together(sides) };
        let steps_per_minute = self.feet.iter().flat_map(|f| &f.strides).map(|s| 120.0 / seconds(s));
        let mut lines = vec![
            Line { name: "cadence", unit: "steps/min", sides: [None; 2], both: measure(steps_per_minute) },
            line("speed", "m/s", of_strides(&|s| Some(s.length_m? / seconds(s)))),
            line("stride time", "s", of_strides(&|s| Some(seconds(s)))),
            line("stride length", "m", of_strides(&|s| s.length_m)),
            line("step time", "s", of_steps(&|s| Some(s.time_s))),
            line("step length", "m", of_steps(&|s| Some(s.length_width_m?[0]))),
            line("step width", "m", of_steps(&|s| Some(s.length_width_m?[1]))),
        ];
        if walks {
            lines.push(line("stance", "share of the cycle", of_strides(&stance)));
            lines.push(line("swing", "share of the cycle", of_strides(&|s| Some(1.0 - stance(s)?))));
            let both = lines[7].sides[0].zip(lines[7].sides[1]).map(|(l, r)| l.mean + r.mean - 1.0);
            lines.push(Line { name: "double support", unit: "share of the cycle", sides: [None; 2], both: measure(both) });
        }
        lines
    }
}

/// Every side counts once; the standard deviation is within the sides.
fn together([left, right]: [Option<Measure>; 2]) -> Option<Measure> {
    let (Some(l), Some(r)) = (left, right) else { return left.or(right) };
    let freedom = (l.n + r.n).saturating_sub(2);
    let square: f64 = [l, r].iter().filter_map(|m| Some(m.sd?.powi(2) * (m.n - 1) as f64)).sum();
    Some(Measure { mean: 0.5 * (l.mean + r.mean), sd: (freedom > 0).then(|| (square / freedom as f64).sqrt()), n: l.n + r.n })
}

/// Hip, knee and ankle of one leg, left or right.
pub const LEGS: [[Joint; 3]; 2] = [[Joint::LHip, Joint::LKnee, Joint::LAnkle], [Joint::RHip, Joint::RKnee, Joint::RAnkle]];

/// Flexion of hip (0) and knee (1), dorsiflexion of the ankle (2), radians: with the rotation R = Rx Rz Ry (x left, y up,
/// z forward) the angle of Rx.
pub fn flexion(rotation: &UnitQuaternion<f64>, joint: usize) -> f64 {
    let up = rotation * Vector3::y();
    let about_left = up.z.atan2(up.y);
    if joint == 1 { about_left } else { -about_left }
}

/// Hip, knee and ankle of the left (0) or right (1) leg over a stride of the clip, 0 to 100 %, radians.
pub fn cycle_angles(clip: &Clip, foot: usize, stride: &Stride) -> [[f64; PERCENTS]; 3] {
    let poses: Vec<Pose> =
        (0..PERCENTS).map(|k| pose_at(clip, stride.from_s + (stride.to_s - stride.from_s) * k as f64 / (PERCENTS - 1) as f64)).collect();
    [0, 1, 2].map(|j| std::array::from_fn(|k| flexion(poses[k].joint(LEGS[foot][j]), j)))
}

fn pose_at(clip: &Clip, time_s: f64) -> Pose {
    let at = (time_s * clip.fps).clamp(0.0, (clip.poses.len() - 1) as f64);
    let i = (at as usize).min(clip.poses.len().saturating_sub(2));
    clip.poses[i].towards(&clip.poses[(i + 1).min(clip.poses.len() - 1)], at - i as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rotation::exp;
    use crate::motion_model::{Activity, Cycle, synthetic};

    /// Three cycles of a synthetic walker on a straight way.
    fn walk(cycle: &Cycle, subject: &synthetic::SyntheticSubject, fps: f64) -> Clip {
        let (offsets, h) = (subject.shape().offsets(), cycle.hip_height_m);
        let poses = (0..(3.0 * cycle.duration_s * fps) as usize).map(|f| {
            let time_s = f as f64 / fps;
            let (joints, root) = cycle.posture(time_s / cycle.duration_s);
            let p = root.position;
            let at = Vector3::new(p.x, 1.0 + p.y, p.z) * h + Vector3::z() * (cycle.parameter * time_s);
            Pose { root: at, world_from_root: exp(&root.rotation), joints }
        });
        Clip { fps, poses: poses.collect(), offsets, hip_height_m: h }
    }

    /// Where the heel of the left (0) or right (1) foot stands a phase of 0.15 after its strike in the first cycle.
    fn stands(clip: &Clip, cycle: &Cycle, foot: usize) -> Vector2<f64> {
        let phase = if foot == 0 { 0.65 } else { 0.15 };
        let placed = clip.place(&pose_at(clip, phase * cycle.duration_s));
        let ankle = LEGS[foot][2];
        let heel = Vector3::new(0.0, -0.07, -0.06) * clip.hip_height_m;
        ground(&(placed.position(ankle) + placed.world_from_node[ankle as usize] * heel))
    }

    #[test]
    fn a_known_walker_has_the_known_table() {
        for (seed, speed) in [(1, 1.0), (4, 1.3), (7, 1.6)] {
            let subject = synthetic::subject(Activity::Walking, seed);
            let cycle = subject.mean_cycle(speed);
            for fps in [30.0, 120.0] {
                let clip = walk(&cycle, &subject, fps);
                let table = gait(&clip).table(true);
                let line = |name: &str| table.iter().find(|l| l.name == name).unwrap();
                let both = |name: &str| line(name).both.unwrap().mean;
                let stride_m = speed * cycle.duration_s;
                assert!((both("stride time") / cycle.duration_s - 1.0).abs() < 0.005, "{seed} {fps}");
                assert!((both("cadence") * cycle.duration_s / 120.0 - 1.0).abs() < 0.005);
                assert!((both("speed") / speed - 1.0).abs() < 0.01 && (both("stride length") - stride_m).abs() < 0.01);
                let to_left = stands(&clip, &cycle, 0) - stands(&clip, &cycle, 1);
                for (side, length_m) in [to_left.y, stride_m - to_left.y].into_iter().enumerate() {
                    let found = line("step length").sides[side].unwrap().mean;
                    assert!((found - length_m).abs() < 0.012, "{seed} {fps} {side}: {found} {length_m}");
                    let width = line("step width").sides[side].unwrap().mean;
                    assert!((width - to_left.x).abs() < 0.012, "{seed} {fps} {side}: {width} {}", to_left.x);
                }
                // The share of the cycle that the synthetic walkers' feet stand.
                let support = 0.752 - 0.143 / cycle.duration_s;
                assert!((-0.005..0.04).contains(&(both("stance") - support)), "{seed} {fps}: {} {support}", both("stance"));
                assert!((both("double support") - 2.0 * both("stance") + 1.0).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_limp_shows_on_its_side() {
        let line = |l, r| Line { name: "x", unit: "s", sides: [measure([l]), measure([r])], both: None };
        assert_eq!(line(1.1, 0.9).asymmetry_percent().map(f64::round), Some(20.0));
        assert_eq!(Line { sides: [None, measure([1.0])], ..line(1.0, 1.0) }.asymmetry_percent(), None);
        let both = together([measure([1.0, 3.0]), measure([4.0])]).unwrap();
        assert_eq!((both.mean, both.sd, both.n), (3.0, Some(2f64.sqrt()), 3));
    }

    #[test]
    fn flexion_is_that_of_the_sagittal_axis() {
        let (rx, ry, rz) = (Vector3::x(), Vector3::y(), Vector3::z());
        let turned = exp(&(rx * -0.6)) * exp(&(rz * 0.2)) * exp(&(ry * 0.4));
        assert!((flexion(&turned, 0) - 0.6).abs() < 1e-12);
        assert!((flexion(&exp(&(rx * 1.1)), 1) - 1.1).abs() < 1e-12 && (flexion(&exp(&(rx * -0.2)), 2) - 0.2).abs() < 1e-12);
    }

    #[test]
    fn a_clip_without_strides_has_no_numbers() {
        let subject = synthetic::subject(Activity::Walking, 2);
        let offsets = subject.shape().offsets();
        let standing = Clip { fps: 30.0, poses: vec![Pose::rest(offsets[0]); 60], offsets, hip_height_m: 0.9 };
        assert!(gait(&standing).table(true).iter().all(|l| l.both.is_none()));
        assert_eq!(gait(&Clip { poses: Vec::new(), ..standing }), Gait::default());
    }
}
