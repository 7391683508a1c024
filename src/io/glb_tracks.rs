//! Animations of glTF files: channels of step, linear and cubic spline keys, read at the union of their key times.

use gltf::animation::Interpolation;
use gltf::animation::util::ReadOutputs;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::glb::quaternion;
use crate::animal::creature::{Bone, Motion, Posture};

/// Values of one channel at its key times; for cubic splines in-tangent, value, out-tangent.
struct Track {
    times: Vec<f64>,
    values: Vec<[f64; 4]>,
    interpolation: Interpolation,
    turns: bool,
}

impl Track {
    fn at(&self, time: f64) -> [f64; 4] {
        let knots = self.times.len();
        let next = self.times.partition_point(|t| *t <= time);
        let cubic = self.interpolation == Interpolation::CubicSpline;
        let value = |k: usize| self.values[if cubic { 3 * k + 1 } else { k }];
        if next == 0 || next >= knots || self.interpolation == Interpolation::Step {
            return value(next.saturating_sub(1).min(knots - 1));
        }
        let span = self.times[next] - self.times[next - 1];
        let t = (time - self.times[next - 1]) / span;
        let (a, b) = (value(next - 1), value(next));
        if cubic {
            let (out, into) = (self.values[3 * (next - 1) + 2], self.values[3 * next]);
            let (t2, t3) = (t * t, t * t * t);
            let weights = [2.0 * t3 - 3.0 * t2 + 1.0, span * (t3 - 2.0 * t2 + t), 3.0 * t2 - 2.0 * t3, span * (t3 - t2)];
            return [0, 1, 2, 3].map(|k| weights[0] * a[k] + weights[1] * out[k] + weights[2] * b[k] + weights[3] * into[k]);
        }
        if self.turns {
            let q = |v: [f64; 4]| UnitQuaternion::new_normalize(Quaternion::new(v[3], v[0], v[1], v[2]));
            let turned = q(a).try_slerp(&q(b), t, 1e-12).unwrap_or(q(a));
            return [turned.i, turned.j, turned.k, turned.w];
        }
        [0, 1, 2, 3].map(|k| a[k] + (b[k] - a[k]) * t)
    }
}

/// All motions; `None` where they would place bones more often than there is `room` for.
pub(super) fn motions(document: &gltf::Document, blob: &[u8], bones: &[Bone], place: &[usize], room: usize) -> Option<Vec<Motion>> {
    let (mut motions, mut room) = (Vec::new(), room);
    for animation in document.animations() {
        let tracks = tracks(&animation, blob, place).unwrap_or_default();
        let mut times_s: Vec<f64> = tracks.iter().flat_map(|t| t.2.times.iter().copied()).collect();
        times_s.sort_by(f64::total_cmp);
        times_s.dedup_by(|b, a| (*b - *a).abs() < 1e-5);
        room = room.checked_sub(times_s.len().checked_mul(bones.len())?)?;
        let postures = times_s.iter().map(|time| posture(bones, &tracks, *time)).collect();
        let name = animation.name().map_or_else(|| format!("animation_{}", animation.index()), String::from);
        if !times_s.is_empty() {
            motions.push(Motion { name, times_s, postures });
        }
    }
    Some(motions)
}

/// Bone, 0 translation, 1 rotation or 2 scale, and values of every channel that moves a bone.
type Tracks = Vec<(usize, usize, Track)>;

/// `None` where a channel has no times or no values.
fn tracks(animation: &gltf::Animation, blob: &[u8], place: &[usize]) -> Option<Tracks> {
    let mut tracks = Vec::new();
    for channel in animation.channels() {
        let reader = channel.reader(|_| Some(blob));
        let times: Vec<f64> = reader.read_inputs()?.map(f64::from).collect();
        let pad = |v: [f32; 3]| [v[0], v[1], v[2], 0.0].map(f64::from);
        let (kind, values): (usize, Vec<[f64; 4]>) = match reader.read_outputs()? {
            ReadOutputs::Translations(v) => (0, v.map(pad).collect()),
            ReadOutputs::Rotations(v) => (1, v.into_f32().map(|q| q.map(f64::from)).collect()),
            ReadOutputs::Scales(v) => (2, v.map(pad).collect()),
            ReadOutputs::MorphTargetWeights(_) => continue,
        };
        let interpolation = channel.sampler().interpolation();
        let each = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        let sound = times.windows(2).all(|w| w[0] < w[1]) && times.iter().all(|t| t.is_finite());
        let known = place[channel.target().node().index()] != usize::MAX;
        if known && !times.is_empty() && sound && values.len() == each * times.len() {
            tracks.push((place[channel.target().node().index()], kind, Track { times, values, interpolation, turns: kind == 1 }));
        }
    }
    Some(tracks)
}

/// The bones at a time, at rest where no channel says otherwise.
fn posture(bones: &[Bone], tracks: &Tracks, time: f64) -> Posture {
    let mut posture: Posture = bones.iter().map(|b| b.rest).collect();
    for (bone, kind, track) in tracks {
        let v = track.at(time);
        match kind {
            0 => posture[*bone].translation = Vector3::new(v[0], v[1], v[2]),
            1 => posture[*bone].rotation = quaternion(v.map(|c| c as f32)),
            _ => posture[*bone].scale = Vector3::new(v[0], v[1], v[2]),
        }
    }
    posture
}
