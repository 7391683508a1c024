//! A skinned skeleton of any make, its motions, and its forward kinematics.
//!
//! world_from_bone(k) = world_from_bone(parent) · T · R · S;  vertex: Σ_b w_b world_from_bone(b) · bone_from_mesh(b) · v
//! (linear blend skinning, as glTF has it). y up, the creature looks along +z. Units are the file's, metres in glTF.

use nalgebra::{Matrix4, UnitQuaternion, Vector3};

use crate::math::rotation::{exp, log};

/// A bone against its parent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Local {
    pub translation: Vector3<f64>,
    pub rotation: UnitQuaternion<f64>,
    pub scale: Vector3<f64>,
}

impl Local {
    pub fn at(translation: Vector3<f64>) -> Local {
        Local { translation, rotation: UnitQuaternion::identity(), scale: Vector3::repeat(1.0) }
    }

    pub fn matrix(&self) -> Matrix4<f64> {
        Matrix4::new_translation(&self.translation) * self.rotation.to_homogeneous() * Matrix4::new_nonuniform_scaling(&self.scale)
    }

    fn towards(&self, other: &Local, part: f64) -> Local {
        Local {
            translation: self.translation.lerp(&other.translation, part),
            rotation: self.rotation * exp(&(log(&(self.rotation.inverse() * other.rotation)) * part)),
            scale: self.scale.lerp(&other.scale, part),
        }
    }
}

/// Every bone of a creature at one instant.
pub type Posture = Vec<Local>;

#[derive(Clone, Debug, PartialEq)]
pub struct Bone {
    pub name: String,
    /// Smaller than the bone's own index.
    pub parent: Option<usize>,
    pub rest: Local,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vertex {
    pub position: Vector3<f64>,
    pub bones: [u16; 4],
    /// Sum 1.
    pub weights: [f32; 4],
    pub colour: [u8; 3],
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Skin {
    pub vertices: Vec<Vertex>,
    pub triangles: Vec<[u32; 3]>,
    /// One per bone; bones that carry no vertex have the identity.
    pub bone_from_mesh: Vec<Matrix4<f64>>,
}

/// Postures at their own times.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    pub name: String,
    /// Increasing, as many as postures.
    pub times_s: Vec<f64>,
    pub postures: Vec<Posture>,
}

impl Motion {
    /// At a constant rate from 0.
    pub fn at_rate(name: &str, fps: f64, postures: Vec<Posture>) -> Motion {
        Motion { name: name.into(), times_s: (0..postures.len()).map(|i| i as f64 / fps).collect(), postures }
    }

    /// Time from the first to the last posture.
    pub fn duration_s(&self) -> f64 {
        self.times_s.last().zip(self.times_s.first()).map_or(0.0, |(b, a)| b - a)
    }

    /// Between its postures, held at the ends; `None` without postures.
    pub fn at(&self, time_s: f64) -> Option<Posture> {
        let next = self.times_s.partition_point(|t| *t <= time_s);
        let (Some(b), Some(a)) = (self.postures.get(next), next.checked_sub(1).and_then(|k| self.postures.get(k))) else {
            return if next == 0 { self.postures.first() } else { self.postures.last() }.cloned();
        };
        let part = (time_s - self.times_s[next - 1]) / (self.times_s[next] - self.times_s[next - 1]);
        Some(a.iter().zip(b).map(|(a, b)| a.towards(b, part)).collect())
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct Creature {
    pub bones: Vec<Bone>,
    pub skin: Skin,
    pub motions: Vec<Motion>,
}

impl Creature {
    pub fn rest(&self) -> Posture {
        self.bones.iter().map(|b| b.rest).collect()
    }

    pub fn world_from_bones(&self, posture: &[Local]) -> Vec<Matrix4<f64>> {
        let mut world: Vec<Matrix4<f64>> = Vec::with_capacity(self.bones.len());
        for (bone, local) in self.bones.iter().zip(posture) {
            let own = local.matrix();
            world.push(bone.parent.and_then(|p| world.get(p)).map_or(own, |parent| parent * own));
        }
        world
    }

    /// Skin vertices in the world.
    pub fn vertices(&self, posture: &[Local]) -> Vec<Vector3<f64>> {
        let world_from_mesh: Vec<Matrix4<f64>> =
            self.world_from_bones(posture).iter().zip(&self.skin.bone_from_mesh).map(|(w, b)| w * b).collect();
        let place = |v: &Vertex| {
            let parts = v.bones.iter().zip(&v.weights).filter(|(_, w)| **w > 0.0);
            let sum: Vector3<f64> =
                parts.filter_map(|(b, w)| Some((world_from_mesh.get(usize::from(*b))? * v.position.push(1.0)).xyz() * f64::from(*w))).sum();
            sum
        };
        self.skin.vertices.iter().map(place).collect()
    }

    /// Turn of every bone since rest about an axis of the world (at rest), radians: the angle that a view along the axis
    /// shows.
    pub fn angles_about(&self, axis: &Vector3<f64>, posture: &[Local]) -> Vec<f64> {
        let rest = self.world_from_bones(&self.rest());
        self.bones
            .iter()
            .zip(posture)
            .zip(&rest)
            .map(|((bone, now), world)| {
                let axis_in_bone = world.fixed_view::<3, 3>(0, 0).transpose() * axis;
                let turn = bone.rest.rotation.inverse() * now.rotation;
                // Twist about the axis.
                let along = turn.imag().dot(&axis_in_bone.normalize());
                let angle = 2.0 * along.atan2(turn.w);
                angle - std::f64::consts::TAU * (angle / std::f64::consts::TAU).round()
            })
            .collect()
    }

    /// Least and greatest coordinates of the skin at rest.
    pub fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        let vertices = self.vertices(&self.rest());
        let first = *vertices.first()?;
        Some(vertices.iter().fold([first, first], |[low, high], v| [low.inf(v), high.sup(v)]))
    }
}

/// Why poses of one skeleton cannot be given to another.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum TransferError {
    #[error("the poses are of another skeleton: bones {missing} of the template are missing; pose the template itself")]
    Missing { missing: String },
}

impl Creature {
    /// Without a skin, an octahedron along every bone, so that viewers show something and the skeleton imports as one.
    pub fn with_sticks(mut self) -> Creature {
        if !self.skin.vertices.is_empty() {
            return self;
        }
        let world = self.world_from_bones(&self.rest());
        let places: Vec<Vector3<f64>> = world.iter().map(|w| w.column(3).xyz()).collect();
        for (child, bone) in self.bones.iter().enumerate() {
            let Some(parent) = bone.parent else { continue };
            let along = places[child] - places[parent];
            let Some(across) =
                along.cross(&if along.x.abs() > 0.9 * along.norm() { Vector3::y() } else { Vector3::x() }).try_normalize(1e-9)
            else {
                continue;
            };
            let third = along.normalize().cross(&across);
            let (waist, thick) = (places[parent] + along * 0.15, 0.08 * along.norm());
            let corners = [
                places[parent],
                waist + across * thick,
                waist + third * thick,
                waist - across * thick,
                waist - third * thick,
                places[child],
            ];
            let first = self.skin.vertices.len() as u32;
            let vertex =
                |position| Vertex { position, bones: [parent as u16, 0, 0, 0], weights: [1.0, 0.0, 0.0, 0.0], colour: [190, 190, 200] };
            self.skin.vertices.extend(corners.map(vertex));
            for k in 0..4 {
                let (a, b) = (first + 1 + k, first + 1 + (k + 1) % 4);
                self.skin.triangles.extend([[first, b, a], [a, b, first + 5]]);
            }
        }
        self.skin.bone_from_mesh = world.iter().map(|w| w.try_inverse().unwrap_or_else(Matrix4::identity)).collect();
        self
    }

    /// Greatest extent of the bones at rest.
    pub fn span(&self) -> f64 {
        let places: Vec<Vector3<f64>> = self.world_from_bones(&self.rest()).iter().map(|w| w.column(3).xyz()).collect();
        let far = |k: usize| {
            let range = places.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), p| (a.min(p[k]), b.max(p[k])));
            range.1 - range.0
        };
        if places.is_empty() { 0.0 } else { far(0).max(far(1)).max(far(2)) }
    }

    /// A posture of `other`, a copy of this skeleton that went through another program: bones are found by name; each one's
    /// turn since rest in the world, and its shift against its parent, are what counts, so that the programs' own bone axes,
    /// units and extra nodes do not matter.
    pub fn posture_from(&self, other: &Creature, posture: &[Local]) -> Result<Posture, TransferError> {
        let found: Vec<Option<usize>> = self.bones.iter().map(|b| other.bones.iter().position(|o| o.name == b.name)).collect();
        let missing: Vec<&str> = self.bones.iter().zip(&found).filter(|(_, f)| f.is_none()).map(|(b, _)| b.name.as_str()).collect();
        if !missing.is_empty() {
            let more = if missing.len() > 4 { format!(" and {} more", missing.len() - 4) } else { String::new() };
            return Err(TransferError::Missing { missing: missing[..missing.len().min(4)].join(", ") + &more });
        }
        let (rest, their_rest) = (rotations(self, &self.rest()), rotations(other, &other.rest()));
        let theirs = rotations(other, posture);
        let ratio = self.span() / other.span().max(1e-12);
        let (world, their_world) = (self.world_from_bones(&self.rest()), other.world_from_bones(&other.rest()));
        let mut now: Vec<UnitQuaternion<f64>> = Vec::new();
        let mut result = Posture::new();
        for (k, (bone, o)) in self.bones.iter().zip(found.into_iter().flatten()).enumerate() {
            let turned = theirs[o] * their_rest[o].inverse() * rest[k];
            let parent = bone.parent.map_or(UnitQuaternion::identity(), |p| now[p]);
            now.push(turned);
            let basis = |world: &[Matrix4<f64>], parent: Option<usize>| {
                parent.map_or(nalgebra::Matrix3::identity(), |p| world[p].fixed_view::<3, 3>(0, 0).into_owned())
            };
            let shift = basis(&their_world, other.bones[o].parent) * (posture[o].translation - other.bones[o].rest.translation) * ratio;
            let own = basis(&world, bone.parent).try_inverse().map_or(shift, |inverse| inverse * shift);
            result.push(Local { translation: bone.rest.translation + own, rotation: parent.inverse() * turned, scale: bone.rest.scale });
        }
        Ok(result)
    }
}

/// Rotations of the bones in the world, scales left out.
pub fn rotations(creature: &Creature, posture: &[Local]) -> Vec<UnitQuaternion<f64>> {
    let mut world: Vec<UnitQuaternion<f64>> = Vec::with_capacity(posture.len());
    for (bone, local) in creature.bones.iter().zip(posture) {
        world.push(bone.parent.map_or(local.rotation, |p| world[p] * local.rotation));
    }
    world
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chain_is_placed_as_by_hand_and_its_skin_follows() {
        let bone = |parent, y: f64| Bone { name: format!("b{y}"), parent, rest: Local::at(Vector3::new(0.0, y, 0.0)) };
        let vertex = Vertex { position: Vector3::new(0.0, 3.0, 0.0), bones: [1, 0, 0, 0], weights: [0.75, 0.25, 0.0, 0.0], colour: [0; 3] };
        let bones = vec![bone(None, 1.0), bone(Some(0), 1.0)];
        let mut creature = Creature { bones, skin: Skin::default(), motions: Vec::new() };
        let at_rest = creature.world_from_bones(&creature.rest());
        creature.skin =
            Skin { vertices: vec![vertex], triangles: vec![], bone_from_mesh: at_rest.iter().map(|m| m.try_inverse().unwrap()).collect() };
        assert!((creature.vertices(&creature.rest())[0] - vertex.position).norm() < 1e-12);
        let mut posture = creature.rest();
        posture[1].rotation = exp(&Vector3::new(0.5, 0.0, 0.0));
        // The upper bone turns about y = 2; one metre above it goes to (cos, sin).
        let turned = Vector3::new(0.0, 2.0 + 0.5f64.cos(), 0.5f64.sin());
        let expected = turned * 0.75 + vertex.position * 0.25;
        assert!((creature.vertices(&posture)[0] - expected).norm() < 1e-12);
        let angles = creature.angles_about(&Vector3::x(), &posture);
        assert!(angles[0].abs() < 1e-12 && (angles[1] - 0.5).abs() < 1e-12);
        assert!(creature.angles_about(&Vector3::y(), &posture)[1].abs() < 1e-12);
        let motion = Motion::at_rate("turn", 2.0, vec![creature.rest(), posture]);
        let half = motion.at(0.25).unwrap();
        assert!(
            (log(&half[1].rotation).x - 0.25).abs() < 1e-12 && motion.at(9.0).unwrap() == motion.postures[1] && motion.duration_s() == 0.5
        );
    }

    #[test]
    fn postures_survive_other_bone_axes_units_and_extra_nodes() {
        let mut horse = crate::animal::horse::horse();
        let wanted = crate::animal::horse::posture(&horse, crate::animal::horse::Gait::Canter, 0.3);
        // The copy: all bones' axes turned, centimetres, one more root.
        let turn = exp(&Vector3::new(0.3, -0.8, 0.5));
        let rest = horse.rest();
        let reworked = |p: &[Local]| -> Posture {
            let mut list = vec![Local::at(Vector3::zeros())];
            list.extend(horse.bones.iter().zip(p).map(|(b, l)| {
                let from = if b.parent.is_some() { turn.inverse() } else { UnitQuaternion::identity() };
                Local { translation: from * l.translation * 100.0, rotation: from * l.rotation * turn, scale: l.scale }
            }));
            list
        };
        let mut bones = vec![Bone { name: "Armature".into(), parent: None, rest: Local::at(Vector3::zeros()) }];
        bones.extend(horse.bones.iter().zip(reworked(&rest).into_iter().skip(1)).map(|(b, rest)| Bone {
            name: b.name.clone(),
            parent: Some(b.parent.map_or(0, |p| p + 1)),
            rest,
        }));
        let copy = Creature { bones, skin: Skin::default(), motions: Vec::new() };
        let back = horse.posture_from(&copy, &reworked(&wanted)).unwrap();
        for (a, b) in back.iter().zip(&wanted) {
            assert!(a.rotation.angle_to(&b.rotation) < 1e-7 && (a.translation - b.translation).norm() < 1e-9);
        }
        let posed = reworked(&wanted);
        horse.bones[7].name = "other".into();
        assert!(horse.posture_from(&copy, &posed).unwrap_err().to_string().contains("bones other of the template"));
        assert!(copy.with_sticks().skin.triangles.len() > 200);
    }
}
