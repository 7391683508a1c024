//! A person as a skinned creature, for [`glb`](super::glb): the skeleton's nodes under their H-Anim names, the skin of the
//! implicit surface, one motion per clip.
//!
//! The file's rest is the [stance](crate::body::mesh::stance) in which the skin was taken; every motion sets the rotations of all
//! nodes and the translation of the root. y up, metres, the person looks along +z at rest.
//! Limbs lie on the implicit surface within 2 mm at rest; the trunk, which the few primitives that are enough to fit clouds
//! leave ringed, and the head, are drawn evenly. Linear blending leaves 4 mm on average in a walk and 7 mm in a run, most
//! of it where limbs touch and the implicit surface swells. Checked against the clip's forward kinematics and that surface.

use nalgebra::{Matrix4, Vector3};

use crate::animal::creature::{Bone, Creature, Local, Motion, Posture, Skin, Vertex};
use crate::body::mesh::{Mesh, Shares, mesh, stance};
use crate::body::surface::Primitive;
use crate::body::{Clip, Joint, Length, Pose, PosedSurface, Shape, Surface, place};

/// Cells of the skin's grid across a body's height.
const CELLS: f64 = 125.0;

/// Skull and jaw: centres from the skull base and semi-axes, fractions of stature.
const HEAD: [([f64; 3], [f64; 3]); 2] = [([0.0, 0.047, -0.006], [0.070, 0.070, 0.086]), ([0.0, -0.004, 0.019], [0.050, 0.056, 0.056])];

/// Slices of the trunk, every [`TRUNK_STEP`]: node, height and depth of the centre, half width and half depth of the skin, fractions of
/// stature; hips 0.19, waist 0.165 and chest 0.18 wide as in [`surface`](crate::body::surface).
const TRUNK: [(Joint, f64, f64, f64, f64); 11] = [
    (Joint::Sacroiliac, 0.505, 0.003, 0.060, 0.064),
    (Joint::Sacroiliac, 0.535, 0.002, 0.086, 0.069),
    (Joint::Sacroiliac, 0.565, 0.002, 0.093, 0.067),
    (Joint::Vl5, 0.595, 0.005, 0.087, 0.062),
    (Joint::Vl5, 0.625, 0.008, 0.082, 0.058),
    (Joint::Vl5, 0.655, 0.010, 0.082, 0.058),
    (Joint::Vt10, 0.685, 0.012, 0.086, 0.061),
    (Joint::Vt10, 0.715, 0.013, 0.089, 0.064),
    (Joint::Vt10, 0.745, 0.012, 0.089, 0.065),
    (Joint::Vt5, 0.775, 0.007, 0.083, 0.061),
    (Joint::Vt5, 0.805, 0.001, 0.064, 0.050),
];
const TRUNK_STEP: f64 = 0.03;
/// Lateral skin radius of a chain over its semi-axis.
const CHAIN: f64 = 0.678;

/// Skin, shirt, trousers and shoes.
const SKIN: [u8; 3] = [219, 178, 152];
const SHIRT: [u8; 3] = [94, 129, 172];
const TROUSERS: [u8; 3] = [76, 86, 106];
const SHOES: [u8; 3] = [46, 52, 64];

/// A person without motions.
pub fn person(shape: &Shape) -> Creature {
    let offsets = shape.offsets();
    let stance = stance(&offsets);
    let mut skin = mesh(&PosedSurface::new(&drawn(shape), &place(&offsets, &stance)), shape.stature_m / CELLS);
    skin.smooth();
    let bone = |(joint, rest): (Joint, Local)| Bone { name: joint.name().into(), parent: joint.parent().map(|p| p as usize), rest };
    let bones = Joint::ALL.into_iter().zip(locals(&stance, &offsets)).map(bone).collect();
    let mut creature = Creature { bones, skin: Skin::default(), motions: Vec::new() };
    let bone_from_mesh =
        creature.world_from_bones(&creature.rest()).iter().map(|m| m.try_inverse().unwrap_or_else(Matrix4::identity)).collect();
    creature.skin = Skin { vertices: vertices(&skin), triangles: skin.triangles, bone_from_mesh };
    creature
}

/// The body's surface with an even trunk, a skull and a jaw in place of the few discs that are enough to fit clouds.
fn drawn(shape: &Shape) -> Surface {
    let mut surface = Surface::new(shape);
    surface.primitives.retain(|p| !TRUNK.iter().any(|(node, ..)| p.node == *node) && p.node != Joint::Skullbase);
    let mut add = |node: Joint, centre: [f64; 3], radii: [f64; 3]| {
        let limb = Length::of(node);
        let [length, width] = [shape.lengths, shape.widths].map(|f| shape.stature_m * f[limb as usize]);
        let semi_axes = Vector3::from(radii).component_mul(&Vector3::new(width, length, width));
        surface.primitives.push(Primitive { node, limb, axis: 1, centre: Vector3::from(centre) * length, semi_axes });
    };
    for (node, y, z, half_width, half_depth) in TRUNK {
        let at = node.rest_position();
        add(node, [0.0, y - at.y, z - at.z], [half_width / CHAIN, TRUNK_STEP, half_depth / CHAIN]);
    }
    for (centre, radii) in HEAD {
        add(Joint::Skullbase, centre, radii);
    }
    surface
}

/// A clip's poses as a motion of [`person`]; `name` is the animation's.
pub fn motion(name: &str, clip: &Clip) -> Motion {
    Motion::at_rate(name, clip.fps, clip.poses.iter().map(|pose| locals(pose, &clip.offsets)).collect())
}

fn locals(pose: &Pose, offsets: &[Vector3<f64>]) -> Posture {
    let local = |joint: Joint| match joint {
        Joint::Root => Local { rotation: pose.world_from_root, ..Local::at(pose.root) },
        _ => Local { rotation: *pose.joint(joint), ..Local::at(offsets[joint as usize]) },
    };
    Joint::ALL.map(local).into()
}

fn vertices(mesh: &Mesh) -> Vec<Vertex> {
    let vertex = |(position, shares): (&Vector3<f64>, &Shares)| Vertex {
        position: *position,
        bones: shares.map(|(joint, _)| joint as u16),
        weights: shares.map(|(_, weight)| weight as f32),
        colour: colour(shares),
    };
    mesh.vertices.iter().zip(&mesh.shares).map(vertex).collect()
}

/// Clothes go with the joints that a vertex follows, mostly the first.
fn colour(shares: &Shares) -> [u8; 3] {
    use Joint::*;
    let of = |joint: Joint| match joint {
        Skullbase | Vc4 | Vt1 | LElbow | RElbow | LWrist | RWrist => SKIN,
        LHip | RHip | LKnee | RKnee | Root | Sacroiliac => TROUSERS,
        LAnkle | RAnkle | LMidtarsal | RMidtarsal => SHOES,
        _ => SHIRT,
    };
    let sum: f64 = shares.iter().map(|s| s.1.powi(4)).sum();
    std::array::from_fn(|k| (shares.iter().map(|s| s.1.powi(4) * f64::from(of(s.0)[k])).sum::<f64>() / sum).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::glb;
    use crate::motion::play_cycle;
    use crate::motion_model::{Activity, synthetic};

    fn clip(activity: Activity, speed_m_s: f64, shape: &Shape) -> Clip {
        play_cycle(&synthetic::subject(activity, 1).cycle(speed_m_s, 0), &shape.offsets(), 60.0, crate::motion::Length::Cycles(1))
    }

    fn written(shape: &Shape, clips: &[(&str, &Clip)]) -> Creature {
        let mut creature = person(shape);
        creature.motions = clips.iter().map(|(name, clip)| motion(name, clip)).collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.glb");
        glb::write(&path, &creature).unwrap();
        glb::read(&path).unwrap()
    }

    #[test]
    fn joints_of_the_file_are_where_the_clip_has_them() {
        let shape = Shape::template(1.68);
        let [slow, fast] = [1.0, 1.6].map(|v| clip(Activity::Walking, v, &shape));
        let creature = written(&shape, &[("walking_1.00", &slow), ("walking_1.60", &fast)]);
        assert_eq!(creature.bones.len(), Joint::ALL.len());
        for (motion, (name, clip)) in creature.motions.iter().zip([("walking_1.00", &slow), ("walking_1.60", &fast)]) {
            assert_eq!((motion.name.as_str(), motion.postures.len()), (name, clip.poses.len()));
            for (k, (posture, pose)) in motion.postures.iter().zip(&clip.poses).enumerate() {
                assert!((motion.times_s[k] - k as f64 / clip.fps).abs() < 1e-6);
                let (world, placed) = (creature.world_from_bones(posture), clip.place(pose));
                for joint in Joint::ALL {
                    let bone = creature.bones.iter().position(|b| b.name == joint.name()).unwrap();
                    let off = (world[bone].column(3).xyz() - placed.position(joint)).norm();
                    assert!(off < 1e-5, "{name} frame {k} {}: {off} m", joint.name());
                }
            }
        }
    }

    fn is_limb(name: &str) -> bool {
        name.starts_with("l_") || name.starts_with("r_")
    }

    /// Distance of the skinned vertices of the limbs from the posed implicit surface: mean and 90th percentile in metres.
    fn off_the_surface(creature: &Creature, shape: &Shape, clip: &Clip, frame: usize) -> (f64, f64) {
        let skin = PosedSurface::new(&Surface::new(shape), &clip.place(&clip.poses[frame]));
        let placed = creature.vertices(&creature.motions[0].postures[frame]);
        let body = placed.iter().zip(&creature.skin.vertices).filter(|(_, v)| is_limb(&creature.bones[usize::from(v.bones[0])].name));
        let mut off: Vec<f64> = body.map(|(v, _)| skin.distance(v).abs()).collect();
        off.sort_by(f64::total_cmp);
        (off.iter().sum::<f64>() / off.len() as f64, off[off.len() * 9 / 10])
    }

    #[test]
    fn the_skin_follows_the_body() {
        let shape = Shape::template(1.75);
        let [walk, run] = [(Activity::Walking, 1.4), (Activity::Running, 3.5)].map(|(a, v)| clip(a, v, &shape));
        let standing = Clip { poses: vec![stance(&shape.offsets())], ..walk.clone() };
        for (name, clip, most_mean_m, most_m) in
            [("rest", &standing, 0.004, 0.01), ("walk", &walk, 0.006, 0.02), ("run", &run, 0.01, 0.035)]
        {
            let creature = written(&shape, &[(name, clip)]);
            let all: Vec<_> = (0..clip.poses.len()).step_by(6).map(|k| off_the_surface(&creature, &shape, clip, k)).collect();
            let mean = all.iter().map(|o| o.0).sum::<f64>() / all.len() as f64;
            let worst = all.iter().map(|o| o.1).fold(0.0, f64::max);
            println!("{name}: mean {:.2} mm, 90th percentile of the worst frame {:.1} mm", 1e3 * mean, 1e3 * worst);
            assert!(mean < most_mean_m && worst < most_m, "{name}: {mean} {worst}");
        }
    }

    #[test]
    fn vertices_carry_four_weights_and_normals_point_outwards() {
        let shape = Shape::template(1.6);
        let creature = written(&shape, &[]);
        let [low, high] = creature.bounds().unwrap();
        assert!(low.y.abs() < 0.02 && (1.5..1.62).contains(&high.y), "{low:?} {high:?}");
        let middle = (low + high) / 2.0;
        let away = creature.skin.triangles.iter().map(|t| {
            let [a, b, c] = t.map(|i| creature.skin.vertices[i as usize].position);
            (b - a).cross(&(c - a)).dot(&(Vector3::new(0.0, a.y, middle.z) - a))
        });
        assert!(away.sum::<f64>() < 0.0);
        assert!(creature.skin.vertices.iter().all(|v| (v.weights.iter().sum::<f32>() - 1.0).abs() < 1e-5));
    }
}
