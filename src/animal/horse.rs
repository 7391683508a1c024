//! A horse of ellipsoids that walks, canters and gallops: known truth for the method's study.
//!
//! 36 bones, each an ellipsoid, each turning about the axis across the body; joint curves are monotone cubics over the
//! limb's own cycle, which begins when the hoof lands. Footfalls: walk left hind, left fore, right hind, right fore a
//! quarter apart; canter on the right lead with the diagonal pair together; transverse gallop with one suspension, on
//! gathered legs. Ranges of the joints follow published sagittal curves of sound horses in size, not in detail: the horse is
//! a test subject, not a model of horses. Proportions are a saddle horse's, withers at 1.6 m.

use nalgebra::{Matrix3, Matrix4, Vector3};

use super::creature::{Bone, Creature, Local, Motion, Posture, Skin, Vertex};
use crate::math::curves::Pchip;
use crate::math::rotation::{between, exp};

/// Bone, parent, place of its joint, where it ends (x left, y up, z forward, metres), radius across.
type Part = (&'static str, &'static str, [f64; 3], [f64; 3], f64);

const TRUNK: [Part; 14] = [
    ("pelvis", "", [0.0, 1.40, -0.62], [0.0, 1.42, -0.36], 0.235),
    ("lumbar_1", "pelvis", [0.0, 1.42, -0.36], [0.0, 1.38, -0.18], 0.25),
    ("lumbar_2", "lumbar_1", [0.0, 1.38, -0.18], [0.0, 1.34, 0.02], 0.275),
    ("thoracic_1", "lumbar_2", [0.0, 1.34, 0.02], [0.0, 1.32, 0.22], 0.29),
    ("thoracic_2", "thoracic_1", [0.0, 1.32, 0.22], [0.0, 1.34, 0.42], 0.29),
    ("thoracic_3", "thoracic_2", [0.0, 1.34, 0.42], [0.0, 1.42, 0.60], 0.25),
    ("neck_1", "thoracic_3", [0.0, 1.42, 0.60], [0.0, 1.56, 0.73], 0.19),
    ("neck_2", "neck_1", [0.0, 1.56, 0.73], [0.0, 1.71, 0.84], 0.155),
    ("neck_3", "neck_2", [0.0, 1.71, 0.84], [0.0, 1.85, 0.92], 0.13),
    ("neck_4", "neck_3", [0.0, 1.85, 0.92], [0.0, 1.95, 0.99], 0.11),
    ("head", "neck_4", [0.0, 1.95, 0.99], [0.0, 1.65, 1.36], 0.11),
    ("tail_1", "pelvis", [0.0, 1.44, -0.84], [0.0, 1.28, -0.94], 0.05),
    ("tail_2", "tail_1", [0.0, 1.28, -0.94], [0.0, 1.06, -0.98], 0.06),
    ("tail_3", "tail_2", [0.0, 1.06, -0.98], [0.0, 0.78, -0.98], 0.07),
];

/// Of the left side, without the side's mark.
const HIND: [Part; 5] = [
    ("hip", "pelvis", [0.14, 1.24, -0.66], [0.15, 0.98, -0.44], 0.155),
    ("stifle", "hip", [0.15, 0.98, -0.44], [0.14, 0.60, -0.82], 0.095),
    ("hock", "stifle", [0.14, 0.60, -0.82], [0.14, 0.23, -0.76], 0.048),
    ("hind_fetlock", "hock", [0.14, 0.23, -0.76], [0.14, 0.09, -0.68], 0.042),
    ("hind_hoof", "hind_fetlock", [0.14, 0.09, -0.68], [0.14, 0.03, -0.58], 0.055),
];
const FORE: [Part; 6] = [
    ("scapula", "thoracic_3", [0.12, 1.46, 0.40], [0.15, 1.14, 0.62], 0.12),
    ("shoulder", "scapula", [0.15, 1.14, 0.62], [0.15, 0.96, 0.42], 0.105),
    ("elbow", "shoulder", [0.15, 0.96, 0.42], [0.14, 0.55, 0.45], 0.07),
    ("carpus", "elbow", [0.14, 0.55, 0.45], [0.14, 0.24, 0.46], 0.045),
    ("fore_fetlock", "carpus", [0.14, 0.24, 0.46], [0.14, 0.09, 0.53], 0.042),
    ("fore_hoof", "fore_fetlock", [0.14, 0.09, 0.53], [0.14, 0.03, 0.62], 0.055),
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gait {
    Walk,
    Canter,
    Gallop,
}

impl Gait {
    pub const ALL: [Gait; 3] = [Gait::Walk, Gait::Canter, Gait::Gallop];

    pub fn name(self) -> &'static str {
        match self {
            Gait::Walk => "walk",
            Gait::Canter => "canter",
            Gait::Gallop => "gallop",
        }
    }

    /// Length of a stride, seconds.
    pub fn stride_s(self) -> f64 {
        match self {
            Gait::Walk => 1.06,
            Gait::Canter => 0.64,
            Gait::Gallop => 0.51,
        }
    }

    /// Share of the stride that a hoof is on the ground.
    fn duty(self) -> f64 {
        match self {
            Gait::Walk => 0.62,
            Gait::Canter => 0.40,
            Gait::Gallop => 0.28,
        }
    }

    /// When left hind, right hind, left fore, right fore land, parts of a stride.
    fn landings(self) -> [f64; 4] {
        match self {
            Gait::Walk => [0.0, 0.5, 0.25, 0.75],
            Gait::Canter => [0.0, 0.24, 0.26, 0.48],
            Gait::Gallop => [0.0, 0.14, 0.30, 0.44],
        }
    }

    /// Half of the swing of the limbs to and fro, degrees: hind, fore; flexion in the swing against the walk's.
    fn swing(self) -> (f64, f64, f64) {
        match self {
            Gait::Walk => (21.0, 19.0, 1.0),
            Gait::Canter => (26.0, 25.0, 1.45),
            Gait::Gallop => (25.0, 25.0, 1.0),
        }
    }

    /// Amplitudes of trunk pitch, spine flexion, neck and tail, degrees, and the turns of the trunk's wave per stride.
    fn trunk(self) -> ([f64; 4], f64) {
        match self {
            Gait::Walk => ([0.8, 0.7, 5.0, 5.0], 2.0),
            Gait::Canter => ([6.0, 4.0, 8.0, 9.0], 1.0),
            Gait::Gallop => ([4.5, 7.0, 9.0, 10.0], 1.0),
        }
    }
}

/// A [`Part`] of one side: name, parent, joint, end, radius.
type Sided = (String, String, Vector3<f64>, Vector3<f64>, f64);

fn parts() -> Vec<Sided> {
    let trunk = TRUNK.iter().map(|p| (p.0.to_string(), p.1.to_string(), Vector3::from(p.2), Vector3::from(p.3), p.4));
    let side = |mark: &'static str, sign: f64| {
        HIND.iter().chain(&FORE).map(move |p| {
            let mirror = |v: [f64; 3]| Vector3::new(sign * v[0], v[1], v[2]);
            let parent = if p.1 == "pelvis" || p.1 == "thoracic_3" { p.1.to_string() } else { format!("{mark}{}", p.1) };
            (format!("{mark}{}", p.0), parent, mirror(p.2), mirror(p.3), p.4)
        })
    };
    trunk.chain(side("l_", 1.0)).chain(side("r_", -1.0)).collect()
}

/// The horse at rest, with a motion of one stride of each gait.
pub fn horse() -> Creature {
    let parts = parts();
    let index = |name: &str| parts.iter().position(|p| p.0 == name);
    let bones = parts.iter().map(|(name, parent, place, _, _)| {
        let parent = index(parent);
        let from = parent.map_or(Vector3::zeros(), |p| parts[p].2);
        Bone { name: name.clone(), parent, rest: Local::at(place - from) }
    });
    let mut skin = Skin::default();
    for (bone, (_, _, from, to, radius)) in parts.iter().enumerate() {
        let half = (to - from) / 2.0;
        // Ellipsoids overlap at the joints; the far side of a pair is darker.
        let radii = Vector3::new(*radius, *radius, half.norm() + 0.45 * radius);
        let flat = if parts[bone].0.starts_with("l_") || parts[bone].0.starts_with("r_") { 0.8 } else { 0.75 };
        let colour = if parts[bone].0.starts_with("l_") { [122, 84, 58] } else { [164, 116, 80] };
        add_ellipsoid(&mut skin, bone as u16, from + half, half.normalize(), Vector3::new(flat * radii.x, radii.y, radii.z), colour);
    }
    let mut creature = Creature { bones: bones.collect(), skin, motions: Vec::new() };
    bind_at_rest(&mut creature);
    creature.motions = Gait::ALL
        .map(|gait| {
            let times_s: Vec<f64> = (0..=24).map(|k| gait.stride_s() * f64::from(k) / 24.0).collect();
            let postures = times_s.iter().map(|t| posture(&creature, gait, t / gait.stride_s())).collect();
            Motion { name: gait.name().into(), times_s, postures }
        })
        .into();
    creature
}

fn bind_at_rest(creature: &mut Creature) {
    let world = creature.world_from_bones(&creature.rest());
    creature.skin.bone_from_mesh = world.iter().map(|w| w.try_inverse().unwrap_or_else(Matrix4::identity)).collect();
}

/// A creature of free ellipsoids: centre, direction of the third axis, half axes.
pub fn ellipsoids(list: &[(Vector3<f64>, Vector3<f64>, Vector3<f64>)]) -> Creature {
    let mut skin = Skin::default();
    for (centre, direction, radii) in list {
        add_ellipsoid(&mut skin, 0, *centre, *direction, *radii, [150, 150, 150]);
    }
    let bones = vec![Bone { name: "root".into(), parent: None, rest: Local::at(Vector3::zeros()) }];
    let mut creature = Creature { bones, skin, motions: Vec::new() };
    bind_at_rest(&mut creature);
    creature
}

/// 24×12 facets; the third half axis lies along `direction`.
fn add_ellipsoid(skin: &mut Skin, bone: u16, centre: Vector3<f64>, direction: Vector3<f64>, radii: Vector3<f64>, colour: [u8; 3]) {
    const AROUND: u32 = 24;
    const ALONG: u32 = 12;
    let world_from_axes: Matrix3<f64> = *between(&Vector3::z(), &direction).to_rotation_matrix().matrix();
    let first = skin.vertices.len() as u32;
    for j in 0..=ALONG {
        for i in 0..AROUND {
            let (latitude, longitude) =
                (std::f64::consts::PI * f64::from(j) / f64::from(ALONG), std::f64::consts::TAU * f64::from(i) / f64::from(AROUND));
            let unit = Vector3::new(latitude.sin() * longitude.cos(), latitude.sin() * longitude.sin(), latitude.cos());
            let position = centre + world_from_axes * unit.component_mul(&radii);
            skin.vertices.push(Vertex { position, bones: [bone, 0, 0, 0], weights: [1.0, 0.0, 0.0, 0.0], colour });
        }
    }
    for j in 0..ALONG {
        for i in 0..AROUND {
            let at = |j: u32, i: u32| first + j * AROUND + i % AROUND;
            skin.triangles.push([at(j, i), at(j + 1, i), at(j + 1, i + 1)]);
            skin.triangles.push([at(j, i), at(j + 1, i + 1), at(j, i + 1)]);
        }
    }
}

/// The horse's posture at a phase of the stride, in place; phase 0: the left hind hoof lands.
pub fn posture(horse: &Creature, gait: Gait, phase: f64) -> Posture {
    horse
        .bones
        .iter()
        .map(|bone| {
            let mut local = bone.rest;
            local.rotation *= exp(&Vector3::new(angle_deg(gait, &bone.name, phase).to_radians(), 0.0, 0.0));
            if bone.parent.is_none() {
                local.translation.y += bob_m(gait, phase);
            }
            local
        })
        .collect()
}

/// Height of the trunk over its mean.
fn bob_m(gait: Gait, phase: f64) -> f64 {
    match gait {
        Gait::Walk => 0.018 * wave(2.0 * phase - 0.1),
        Gait::Canter => 0.07 * wave(phase - 0.86),
        Gait::Gallop => 0.05 * wave(phase - 0.84),
    }
}

fn wave(turns: f64) -> f64 {
    (std::f64::consts::TAU * turns).cos()
}

/// Turn about the axis to the left, degrees: positive carries a hanging limb backward.
fn angle_deg(gait: Gait, bone: &str, phase: f64) -> f64 {
    let limb = |left: usize, name: &str| {
        let (mark, joint) = name.split_at(2);
        let landing = gait.landings()[left + usize::from(mark == "r_")];
        limb_deg(gait, joint, (phase - landing).rem_euclid(1.0))
    };
    let ([pitch, spine, neck, tail], per_stride) = gait.trunk();
    // The trunk is flexed when the hind legs reach forward under it, and rises in front before they land.
    let (flex, rise) = (wave(per_stride * (phase - 0.02)), wave(per_stride * (phase - 0.90)));
    match bone {
        "pelvis" => -pitch * rise - 1.2 * spine * flex,
        "lumbar_1" | "lumbar_2" => 0.5 * spine * flex,
        "thoracic_1" | "thoracic_2" | "thoracic_3" => 0.25 * spine * flex,
        "neck_1" | "neck_2" => 0.45 * neck * wave(per_stride * (phase - 0.15)),
        "neck_3" | "neck_4" => 0.2 * neck * wave(per_stride * (phase - 0.2)),
        "head" => -0.6 * neck * wave(per_stride * (phase - 0.2)),
        "tail_1" => (if gait == Gait::Walk { 2.0 } else { 25.0 }) + 0.4 * tail * wave(per_stride * (phase - 0.4)),
        "tail_2" => 0.6 * tail * wave(per_stride * (phase - 0.5)),
        "tail_3" => 0.8 * tail * wave(per_stride * (phase - 0.6)),
        _ if HIND.iter().any(|p| &bone[2..] == p.0) => limb(0, bone),
        _ => limb(2, bone),
    }
}

/// Joint curves of a limb over its own cycle: landing at 0, lift-off at the duty factor.
fn limb_deg(gait: Gait, joint: &str, phase: f64) -> f64 {
    let d = gait.duty();
    let (hind, fore, flexion) = gait.swing();
    // Parts of the swing.
    let s = |part: f64| d + (1.0 - d) * part;
    let points: Vec<(f64, f64)> = match joint {
        "hip" => vec![(0.0, -hind), (d, 0.85 * hind), (s(0.35), 0.1 * hind), (s(0.8), -1.1 * hind)],
        "stifle" => vec![(0.0, -4.0), (0.5 * d, 4.0), (d, 6.0 * flexion), (s(0.42), 34.0 * flexion), (s(0.85), 2.0)],
        "hock" => vec![(0.0, 0.0), (0.45 * d, -6.0), (d, 6.0), (s(0.42), -38.0 * flexion), (s(0.85), -4.0)],
        "hind_fetlock" => vec![(0.0, 5.0), (0.5 * d, -22.0), (d, 8.0), (s(0.4), 38.0 * flexion), (s(0.85), 4.0)],
        "hind_hoof" => vec![(0.0, 0.0), (0.5 * d, 14.0), (d, 16.0), (s(0.4), 20.0), (s(0.85), 0.0)],
        "scapula" => vec![(0.0, -0.45 * fore), (d, 0.4 * fore), (s(0.8), -0.5 * fore)],
        "shoulder" => vec![(0.0, -0.55 * fore), (d, 0.5 * fore), (s(0.35), 0.3 * fore), (s(0.75), -0.7 * fore)],
        "elbow" => vec![(0.0, 2.0), (0.6 * d, 6.0), (d, -2.0), (s(0.38), -30.0 * flexion), (s(0.8), -4.0)],
        "carpus" => vec![(0.0, 0.0), (0.9 * d, -2.0), (s(0.4), 52.0 * flexion), (s(0.85), 2.0)],
        "fore_fetlock" => vec![(0.0, 2.0), (0.5 * d, -24.0), (d, 6.0), (s(0.35), 36.0 * flexion), (s(0.85), 0.0)],
        _ => vec![(0.0, 0.0), (0.5 * d, 14.0), (d, 18.0), (s(0.4), 22.0), (s(0.85), 0.0)],
    };
    Pchip::periodic(&points).at(phase)
}

/// Lines along spine, neck and head and along each leg: what a user would draw over the horse, in the world.
pub fn lines(horse: &Creature, posture: &[Local]) -> Vec<(&'static str, Vec<Vector3<f64>>)> {
    let world = horse.world_from_bones(posture);
    let (parts, rest) = (parts(), horse.world_from_bones(&horse.rest()));
    let index = |name: &str| parts.iter().position(|p| p.0 == name);
    let joint = |name: &str| index(name).map(|k| world[k].column(3).xyz());
    let tip = |name: &str| index(name).and_then(|k| Some((world[k] * (rest[k].try_inverse()? * parts[k].3.push(1.0))).xyz()));
    let chain = |names: &[String]| -> Vec<Vector3<f64>> {
        names.iter().filter_map(|n| joint(n)).chain(names.last().and_then(|n| tip(n))).collect()
    };
    let names = |list: &[Part], mark: &str| list.iter().map(|p| format!("{mark}{}", p.0)).collect::<Vec<_>>();
    let trunk = names(&TRUNK[..10], "");
    let mut lines = vec![("spine", chain(&trunk)), ("head", chain(&names(&TRUNK[10..11], "")))];
    for mark in ["l_", "r_"] {
        lines.extend([("leg", chain(&names(&HIND, mark))), ("leg", chain(&names(&FORE, mark)))]);
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::render::{View, silhouette};

    #[test]
    fn thirty_six_bones_turn_about_the_axis_across_and_hooves_meet_the_ground() {
        let horse = horse();
        assert_eq!(horse.bones.len(), 36);
        assert!(horse.bones.iter().enumerate().all(|(i, b)| b.parent.is_none_or(|p| p < i)));
        for gait in Gait::ALL {
            let lowest: Vec<f64> = (0..40)
                .map(|k| horse.vertices(&posture(&horse, gait, f64::from(k) / 40.0)).iter().map(|v| v.y).fold(f64::INFINITY, f64::min))
                .collect();
            let (low, high) = lowest.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), y| (a.min(*y), b.max(*y)));
            assert!(low > -0.2 && high < 0.45, "{}: {low} {high}", gait.name());
            let now = posture(&horse, gait, 0.3);
            let angles = horse.angles_about(&Vector3::x(), &now);
            for (bone, angle) in horse.bones.iter().zip(angles) {
                assert!((angle.to_degrees() - angle_deg(gait, &bone.name, 0.3)).abs() < 1e-9, "{}", bone.name);
            }
            assert!(
                posture(&horse, gait, 0.1) != now
                    && posture(&horse, gait, 1.3).iter().zip(&now).all(|(a, b)| a.rotation.angle_to(&b.rotation) < 1e-9)
            );
        }
    }

    #[test]
    fn a_walks_half_strides_look_alike_and_a_gallops_do_not() {
        let horse = horse();
        let view = View::side(&horse, [320, 240]);
        let differing = |gait, a, b| {
            let [a, b] = [a, b].map(|phase| silhouette(&horse, &posture(&horse, gait, phase), &view));
            a.iter().zip(b.iter()).filter(|(a, b)| a != b).count() as f64 / a.iter().filter(|p| **p > 0).count() as f64
        };
        assert!(differing(Gait::Walk, 0.1, 0.6) < 0.02 && differing(Gait::Walk, 0.1, 0.35) > 0.08);
        assert!(differing(Gait::Gallop, 0.1, 0.6) > 0.2);
        assert_eq!(lines(&horse, &horse.rest()).len(), 6);
    }
}
