//! Creatures as BVH, read and written: any skeleton, zero rotations = its rest pose.
//!
//! BVH has no rest rotations and no scales: written are offsets between the rest places in the world, and
//! R'_k = W_p L_k W_k⁻¹ of a bone with local rotation L_k and rest rotations W, so that all axes are the world's at rest.
//! Translations of bones other than the root are not written. Skins are not part of the format. y up.
//! Checked by reading back, and by the places of all bones.

use std::fmt::Write;
use std::path::Path;

use nalgebra::{UnitQuaternion, Vector3};

use super::bvh::{self, BvhError};
use super::write_atomic;
use crate::animal::creature::{Bone, Creature, Local, Motion, Posture, Skin, rotations};
use crate::math::euler::{self, Order};

/// Reads a skeleton and its motion, named after the file.
pub fn read(path: &Path) -> Result<Creature, BvhError> {
    let recording = bvh::read(path)?;
    let bones: Vec<Bone> =
        recording.joints.iter().map(|j| Bone { name: j.name.clone(), parent: j.parent, rest: Local::at(j.offset) }).collect();
    let posture = |frame: &super::mapping::RecordedFrame| -> Posture {
        let local = |(k, bone): (usize, &Bone)| {
            let (parent, from) =
                bone.parent.map_or((UnitQuaternion::identity(), Vector3::zeros()), |p| (frame.rotations[p], frame.positions[p]));
            let rotation = parent.inverse() * frame.rotations[k];
            Local { rotation, ..Local::at(parent.inverse() * (frame.positions[k] - from)) }
        };
        bones.iter().enumerate().map(local).collect()
    };
    let postures = recording.frames.iter().map(posture).collect();
    let name = path.file_stem().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let motion = Motion::at_rate(&name, recording.fps, postures);
    Ok(Creature { bones, skin: Skin::default(), motions: vec![motion] })
}

/// Writes postures at a constant rate.
pub fn write(path: &Path, creature: &Creature, postures: &[Posture], fps: f64) -> Result<(), BvhError> {
    write_atomic(path, text_of(creature, postures, fps).as_bytes()).map_err(|cause| BvhError::Write { path: path.into(), cause })
}

fn text_of(creature: &Creature, postures: &[Posture], fps: f64) -> String {
    let places: Vec<Vector3<f64>> = creature.world_from_bones(&creature.rest()).iter().map(|w| w.column(3).xyz()).collect();
    let roots: Vec<usize> = (0..creature.bones.len()).filter(|k| creature.bones[*k].parent.is_none()).collect();
    let mut text = String::from("HIERARCHY\n");
    let mut order = Vec::new();
    // Only one ROOT: several become children of an unmoving one.
    let single = roots.len() == 1;
    if !single {
        text += "ROOT creature\n{\n  OFFSET 0 0 0\n  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n";
    }
    roots.iter().for_each(|r| write_bone(&mut text, creature, &places, *r, usize::from(!single), single, &mut order));
    if !single {
        text += "}\n";
    }
    // Writing to a String cannot fail.
    let _ = write!(text, "MOTION\nFrames: {}\nFrame Time: {:.8}\n", postures.len(), 1.0 / fps);
    let rest = rotations(creature, &creature.rest());
    let mut previous = vec![[0.0; 3]; creature.bones.len()];
    for posture in postures {
        let world = creature.world_from_bones(posture);
        let turned = rotations(creature, posture);
        let mut values: Vec<String> = if single { Vec::new() } else { vec!["0".into(); 6] };
        for &k in &order {
            if single && creature.bones[k].parent.is_none() {
                values.extend((0..3).map(|i| format!("{:.6}", world[k][(i, 3)])));
            }
            // Turns since rest in the world, against the parent's.
            let since = |k: usize| turned[k] * rest[k].inverse();
            let own = creature.bones[k].parent.map_or(since(k), |p| since(p).inverse() * since(k));
            previous[k] = euler::near(&own, Order::ZXY, &previous[k]);
            values.extend(previous[k].iter().map(|a| format!("{:.6}", a.to_degrees())));
        }
        let _ = writeln!(text, "{}", values.join(" "));
    }
    text
}

/// Bones depth first, as the format wants them; `order` gets theirs.
fn write_bone(text: &mut String, creature: &Creature, places: &[Vector3<f64>], k: usize, depth: usize, root: bool, order: &mut Vec<usize>) {
    let indent = "  ".repeat(depth);
    let bone = &creature.bones[k];
    let offset = bone.parent.map_or(places[k], |p| places[k] - places[p]);
    let (kind, channels) = if root {
        ("ROOT", "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation")
    } else {
        ("JOINT", "3 Zrotation Xrotation Yrotation")
    };
    let _ = writeln!(
        text,
        "{indent}{kind} {}\n{indent}{{\n{indent}  OFFSET {:.6} {:.6} {:.6}\n{indent}  CHANNELS {channels}",
        bone.name, offset.x, offset.y, offset.z
    );
    order.push(k);
    let children: Vec<usize> = (0..creature.bones.len()).filter(|c| creature.bones[*c].parent == Some(k)).collect();
    children.iter().for_each(|c| write_bone(text, creature, places, *c, depth + 1, false, order));
    if children.is_empty() {
        let end = offset * 0.5;
        let _ = writeln!(text, "{indent}  End Site\n{indent}  {{\n{indent}    OFFSET {:.6} {:.6} {:.6}\n{indent}  }}", end.x, end.y, end.z);
    }
    let _ = writeln!(text, "{indent}}}");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::horse::{Gait, horse, posture};
    use crate::math::rotation::exp;

    #[test]
    fn postures_of_a_skeleton_with_rest_rotations_and_scale_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("poses.bvh");
        let mut horse = horse();
        horse.bones[0].rest.rotation = exp(&Vector3::new(0.2, 0.1, -0.4));
        horse.bones[4].rest.rotation = exp(&Vector3::new(-0.6, 0.3, 0.2));
        horse.bones[0].rest.scale = Vector3::repeat(1.7);
        let poses: Vec<Posture> = [0.1, 0.45, 0.8].iter().map(|p| posture(&horse, Gait::Gallop, *p)).collect();
        write(&path, &horse, &poses, 25.0).unwrap();
        let back = read(&path).unwrap();
        assert_eq!((back.motions[0].name.as_str(), back.motions[0].postures.len()), ("poses", 3));
        for (wanted, found) in poses.iter().zip(&back.motions[0].postures) {
            let [ours, theirs] = [horse.world_from_bones(wanted), back.world_from_bones(found)];
            for (k, bone) in horse.bones.iter().enumerate() {
                let other = back.bones.iter().position(|b| b.name == bone.name).unwrap();
                assert!((ours[k].column(3) - theirs[other].column(3)).norm() < 1e-4, "{}", bone.name);
            }
            let returned = horse.posture_from(&back, found).unwrap();
            assert!(
                returned
                    .iter()
                    .zip(wanted)
                    .all(|(a, b)| a.rotation.angle_to(&b.rotation) < 1e-5 && (a.translation - b.translation).norm() < 1e-4)
            );
        }
    }
}
