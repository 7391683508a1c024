//! Skinned skeletons and their motions as binary glTF 2.0 (GLB), read and written.
//!
//! Written: every bone a node, one skin over all of them, one mesh with normals and vertex colours, one animation per motion with
//! rotations of all bones and translations of those that move; y up, metres if the creature is in metres, seconds.
//! Read: nodes, skins, triangles and base colours of all meshes, animations (step, linear, cubic spline) at the union of
//! their key times. Everything must be inside the one file. Checked against the `gltf` crate's own validation and by
//! reading back what was written.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix4, Quaternion, UnitQuaternion, Vector3};
use serde_json::{Value, json};

use super::glb_kinds::{check_kinds, check_references};
use super::glb_tracks::motions;
use super::write_atomic;
use crate::animal::creature::{Bone, Creature, Local, Motion, Skin, Vertex};

/// Bytes of a GLB file's header.
const HEADER: u32 = 12;
/// Values of corners, key times, and places of bones that a byte of a file may stand for; most files have less than one.
const UNFOLDED: usize = 16;
/// Places of bones beyond that, for large skeletons of which little moves.
const UNFOLDED_FREELY: usize = 1_000_000;
const TOO_LARGE: &str = "its meshes or motions unfold to far more than its size; write what is repeated once";

#[derive(Debug, thiserror::Error)]
pub enum GlbError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path} is no glTF 2.0 binary: {why}; export as GLB with everything inside")]
    Format { path: PathBuf, why: String },
    #[error("{path}: {what}")]
    Content { path: PathBuf, what: String },
    #[error("cannot write {path}: {cause}")]
    Write { path: PathBuf, cause: std::io::Error },
}

/// Reads a creature with all its motions.
pub fn read(path: &Path) -> Result<Creature, GlbError> {
    let bytes = std::fs::read(path).map_err(|cause| GlbError::Read { path: path.into(), cause })?;
    // The crate takes the header's own size off the length without a look.
    let length = bytes.first_chunk::<12>().map_or(u32::MAX, |h| u32::from_le_bytes([h[8], h[9], h[10], h[11]]));
    if bytes.starts_with(b"glTF") && length < HEADER {
        return Err(GlbError::Format { path: path.into(), why: "its header promises less than itself".into() });
    }
    let format = |e: gltf::Error| GlbError::Format { path: path.into(), why: e.to_string() };
    let file = gltf::Gltf::from_slice_without_validation(&bytes).map_err(format)?;
    let content = |what: &str| GlbError::Content { path: path.into(), what: what.into() };
    check_references(file.document.as_json()).map_err(|what| content(&what))?;
    let document = gltf::Document::from_json(file.document.into_json()).map_err(format)?;
    let blob = file.blob.as_deref().unwrap_or_default();
    check_extents(&document, blob).and_then(|()| check_kinds(&document)).map_err(|what| content(&what))?;
    let (bones, bone_of_node) = bones(&document).ok_or_else(|| content("the nodes form a loop"))?;
    if bones.is_empty() || bones.len() > usize::from(u16::MAX) {
        return Err(content("it holds no node, or too many"));
    }
    if unfolded(&document) > UNFOLDED * bytes.len() {
        return Err(content(TOO_LARGE));
    }
    let skin = skin(&document, blob, bones.len(), &bone_of_node);
    let room = UNFOLDED * bytes.len() + UNFOLDED_FREELY;
    let motions = motions(&document, blob, &bones, &bone_of_node, room).ok_or_else(|| content(TOO_LARGE))?;
    Ok(Creature { bones, skin, motions })
}

/// Accessors that reach beyond their buffer would be read past its end.
fn check_extents(document: &gltf::Document, blob: &[u8]) -> Result<(), String> {
    if let Some(buffer) = document.buffers().find(|b| !matches!(b.source(), gltf::buffer::Source::Bin)) {
        return Err(format!("buffer {} lies outside the file; export as GLB with everything inside", buffer.index()));
    }
    for view in document.views() {
        if view.offset().checked_add(view.length()).is_none_or(|end| end > blob.len()) {
            return Err(format!("buffer view {} reaches beyond the file's end; it is cut off, copy it again", view.index()));
        }
    }
    for accessor in document.accessors() {
        let beyond = || format!("accessor {} reaches beyond its buffer view; the file is damaged", accessor.index());
        if let Some(sparse) = accessor.sparse() {
            let (places, values) = (sparse.indices(), sparse.values());
            let fits = reaches(sparse.count(), &places.view(), places.offset(), places.index_type().size())
                && reaches(sparse.count(), &values.view(), values.offset(), accessor.size());
            if !fits {
                return Err(beyond());
            }
        }
        let fits = match accessor.view() {
            Some(view) => reaches(accessor.count(), &view, accessor.offset(), accessor.size()),
            None => accessor.count() <= blob.len(),
        };
        if accessor.count() == 0 || !fits {
            return Err(beyond());
        }
    }
    Ok(())
}

/// Whether so many items lie within a buffer view, none over another.
fn reaches(count: usize, view: &gltf::buffer::View, offset: usize, size: usize) -> bool {
    let stride = view.stride().unwrap_or(size);
    let reach = count.saturating_sub(1).checked_mul(stride).and_then(|r| r.checked_add(size)?.checked_add(offset));
    stride >= size && reach.is_some_and(|r| r <= view.length())
}

/// Nodes may share meshes and skins, and channels key times: values, joints and keys that the file unfolds to, before any is read.
fn unfolded(document: &gltf::Document) -> usize {
    let values = |p: gltf::Primitive| p.attributes().map(|(_, a)| a).chain(p.indices()).map(|a| a.count()).fold(0, usize::saturating_add);
    let drawn = document.nodes().filter_map(|node| node.mesh()).flat_map(|mesh| mesh.primitives()).map(values);
    let joints = document.nodes().filter_map(|node| node.skin()).map(|skin| skin.joints().count());
    let keys = document.animations().flat_map(|a| a.channels()).map(|c| c.sampler().input().count());
    drawn.chain(joints).chain(keys).fold(0, usize::saturating_add)
}

/// Whether a node only holds a skinned mesh, which moves with its joints: such nodes are no bones.
fn is_holder(node: &gltf::Node) -> bool {
    node.skin().is_some() && node.mesh().is_some() && node.children().len() == 0
}

/// Nodes with parents first, and every node's place among them; `usize::MAX` for holders of skins.
fn bones(document: &gltf::Document) -> Option<(Vec<Bone>, Vec<usize>)> {
    let count = document.nodes().count();
    let mut parent = vec![None; count];
    for node in document.nodes() {
        for child in node.children() {
            parent[child.index()] = Some(node.index());
        }
    }
    let (mut bones, mut place) = (Vec::new(), vec![usize::MAX; count]);
    let holders = document.nodes().filter(is_holder).count();
    let mut waiting: Vec<gltf::Node> = document.nodes().filter(|n| parent[n.index()].is_none() && !is_holder(n)).collect();
    waiting.reverse();
    while let Some(node) = waiting.pop() {
        if place[node.index()] != usize::MAX {
            return None;
        }
        place[node.index()] = bones.len();
        let (t, r, s) = node.transform().decomposed();
        let rest = Local { translation: vector(t), rotation: quaternion(r), scale: vector(s) };
        let name = node.name().map_or_else(|| format!("node_{}", node.index()), String::from);
        bones.push(Bone { name, parent: parent[node.index()].map(|p| place[p]), rest });
        let mut children: Vec<gltf::Node> = node.children().filter(|n| !is_holder(n)).collect();
        children.reverse();
        waiting.extend(children);
    }
    (bones.len() + holders == count).then_some((bones, place))
}

pub(super) fn vector(v: [f32; 3]) -> Vector3<f64> {
    Vector3::from(v.map(f64::from))
}

pub(super) fn quaternion(q: [f32; 4]) -> UnitQuaternion<f64> {
    let [x, y, z, w] = q.map(f64::from);
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-12).unwrap_or_default()
}

fn skin(document: &gltf::Document, blob: &[u8], bones: usize, place: &[usize]) -> Skin {
    let mut skin = Skin { bone_from_mesh: vec![Matrix4::identity(); bones], ..Skin::default() };
    let mut bound = vec![false; bones];
    // A holder of a skin is no bone, whoever names it as a joint; its vertices go with the first one.
    let bone = |node: usize| if place[node] < bones { place[node] } else { 0 };
    for node in document.nodes() {
        let Some(mesh) = node.mesh() else { continue };
        let joints: Vec<usize> = node.skin().map_or_else(|| vec![bone(node.index())], |s| s.joints().map(|j| bone(j.index())).collect());
        let mut binds: Vec<Matrix4<f64>> = vec![Matrix4::identity(); joints.len()];
        if let Some(read) = node.skin().and_then(|s| s.reader(|_| Some(blob)).read_inverse_bind_matrices().map(|m| m.collect::<Vec<_>>())) {
            binds.iter_mut().zip(read).for_each(|(b, m)| *b = Matrix4::from_fn(|r, c| f64::from(m[c][r])));
        }
        for (joint, bind) in joints.iter().zip(&binds) {
            if !std::mem::replace(&mut bound[*joint], true) {
                skin.bone_from_mesh[*joint] = *bind;
            }
        }
        mesh.primitives().filter(|p| p.mode() == gltf::mesh::Mode::Triangles).for_each(|p| primitive(&p, blob, &joints, &binds, &mut skin));
    }
    skin
}

fn primitive(primitive: &gltf::Primitive, blob: &[u8], joints: &[usize], binds: &[Matrix4<f64>], skin: &mut Skin) {
    let reader = primitive.reader(|_| Some(blob));
    let positions: Vec<[f32; 3]> = reader.read_positions().map(|p| p.collect()).unwrap_or_default();
    let bones: Vec<[u16; 4]> = reader.read_joints(0).map(|j| j.into_u16().collect()).unwrap_or_default();
    let weights: Vec<[f32; 4]> = reader.read_weights(0).map(|w| w.into_f32().collect()).unwrap_or_default();
    let base = primitive.material().pbr_metallic_roughness().base_color_factor();
    let material = [base[0], base[1], base[2]].map(srgb);
    let colours: Vec<[u8; 3]> = reader.read_colors(0).map(|c| c.into_rgb_f32().map(|c| c.map(srgb)).collect()).unwrap_or_default();
    let first = skin.vertices.len() as u32;
    for (i, position) in positions.iter().enumerate() {
        let own = bones.get(i).copied().unwrap_or([0; 4]).map(|b| usize::from(b).min(joints.len().saturating_sub(1)));
        let raw = weights.get(i).copied().unwrap_or([1.0, 0.0, 0.0, 0.0]).map(|w| if w.is_finite() { w.max(0.0) } else { 0.0 });
        let sum: f32 = raw.iter().sum();
        let weights = if sum > 0.0 { raw.map(|w| w / sum) } else { [1.0, 0.0, 0.0, 0.0] };
        let Some(&joint) = joints.get(own[0]) else { continue };
        // A second skin of the same joint with another bind pose: the vertex is moved into the first one's mesh space.
        let position =
            skin.bone_from_mesh[joint].try_inverse().map_or(vector(*position), |m| (m * binds[own[0]] * vector(*position).push(1.0)).xyz());
        let colour = colours.get(i).copied().unwrap_or(material);
        skin.vertices.push(Vertex { position, bones: own.map(|b| joints[b] as u16), weights, colour });
    }
    let count = skin.vertices.len() as u32 - first;
    let corners: Vec<u32> = reader.read_indices().map_or_else(|| (0..count).collect(), |i| i.into_u32().collect());
    let whole = corners.chunks_exact(3).filter(|t| t.iter().all(|i| *i < count));
    skin.triangles.extend(whole.map(|t| [first + t[0], first + t[1], first + t[2]]));
}

/// Colours of glTF are linear.
fn srgb(linear: f32) -> u8 {
    (linear.clamp(0.0, 1.0).powf(1.0 / 2.2) * 255.0).round() as u8
}

/// Writes a creature with all its motions.
pub fn write(path: &Path, creature: &Creature) -> Result<(), GlbError> {
    write_atomic(path, &encode(creature)).map_err(|cause| GlbError::Write { path: path.into(), cause })
}

/// The binary chunk under construction with its views and accessors.
#[derive(Default)]
struct Binary {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

/// Component types of glTF.
const U8: u32 = 5121;
const U16: u32 = 5123;
const U32: u32 = 5125;
const F32: u32 = 5126;
/// What buffer views of vertices and of triangles are for.
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

impl Binary {
    /// Adds an accessor over `bytes` and returns its index.
    fn push(&mut self, bytes: Vec<u8>, component: u32, kind: &str, count: usize, more: Value) -> usize {
        self.views.push(json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() }));
        self.bytes.extend(bytes);
        while !self.bytes.len().is_multiple_of(4) {
            self.bytes.push(0);
        }
        let mut accessor = json!({ "bufferView": self.views.len() - 1, "componentType": component, "type": kind, "count": count });
        if let (Value::Object(to), Value::Object(from)) = (&mut accessor, more) {
            to.extend(from);
        }
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn floats<const N: usize>(&mut self, rows: &[[f64; N]], kind: &str, with_range: bool) -> usize {
        let bytes = rows.iter().flatten().flat_map(|v| (*v as f32).to_le_bytes()).collect();
        let extreme = |pick: fn(f32, f32) -> f32, start: f32| -> Vec<f32> {
            (0..N).map(|k| rows.iter().map(|r| r[k] as f32).fold(start, pick)).collect()
        };
        let range = if with_range {
            json!({ "min": extreme(f32::min, f32::INFINITY), "max": extreme(f32::max, f32::NEG_INFINITY) })
        } else {
            json!({})
        };
        self.push(bytes, F32, kind, rows.len(), range)
    }
}

fn encode(creature: &Creature) -> Vec<u8> {
    let mut binary = Binary::default();
    let mut nodes: Vec<Value> = creature.bones.iter().enumerate().map(|(k, bone)| node(creature, k, bone)).collect();
    let roots: Vec<usize> = (0..creature.bones.len()).filter(|k| creature.bones[*k].parent.is_none()).collect();
    let mut scene = roots.clone();
    let mut root = json!({
        "asset": { "version": "2.0", "generator": concat!("muybridge ", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
    });
    if !creature.skin.vertices.is_empty() && !creature.skin.triangles.is_empty() {
        scene.push(nodes.len());
        nodes.push(json!({ "name": "skin", "mesh": 0, "skin": 0 }));
        root["meshes"] = json!([{ "primitives": [mesh(&creature.skin, &mut binary)] }]);
        root["materials"] = json!([{ "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 0.9 }, "doubleSided": true }]);
        let binds: Vec<[f64; 16]> = creature.skin.bone_from_mesh.iter().map(|m| std::array::from_fn(|i| m[(i % 4, i / 4)])).collect();
        let binds = binary.floats(&binds, "MAT4", false);
        root["skins"] =
            json!([{ "joints": (0..creature.bones.len()).collect::<Vec<_>>(), "inverseBindMatrices": binds, "skeleton": roots[0] }]);
    }
    let animations: Vec<Value> =
        creature.motions.iter().filter(|m| !m.postures.is_empty()).map(|m| animation(creature, m, &mut binary)).collect();
    if !animations.is_empty() {
        root["animations"] = json!(animations);
    }
    root["nodes"] = json!(nodes);
    root["scenes"] = json!([{ "nodes": scene }]);
    if !binary.bytes.is_empty() {
        root["buffers"] = json!([{ "byteLength": binary.bytes.len() }]);
        root["bufferViews"] = json!(binary.views);
        root["accessors"] = json!(binary.accessors);
    }
    container(&root, &binary.bytes)
}

fn node(creature: &Creature, k: usize, bone: &Bone) -> Value {
    let Local { translation: t, rotation: r, scale: s } = &bone.rest;
    let children: Vec<usize> = (0..creature.bones.len()).filter(|c| creature.bones[*c].parent == Some(k)).collect();
    let mut node = json!({ "name": bone.name, "translation": [t.x, t.y, t.z], "rotation": [r.i, r.j, r.k, r.w], "scale": [s.x, s.y, s.z] });
    if !children.is_empty() {
        node["children"] = json!(children);
    }
    node
}

fn mesh(skin: &Skin, binary: &mut Binary) -> Value {
    let v = &skin.vertices;
    let positions: Vec<[f64; 3]> = v.iter().map(|v| v.position.into()).collect();
    let weights: Vec<[f64; 4]> = v.iter().map(|v| v.weights.map(f64::from)).collect();
    let normals = normals(skin);
    // Vertex colours are linear.
    let linear = |c: u8| ((f64::from(c) / 255.0).powf(2.2) * 255.0).round() as u8;
    let colours = v.iter().flat_map(|v| [linear(v.colour[0]), linear(v.colour[1]), linear(v.colour[2]), 255]).collect();
    // The format wants no bone where there is no weight.
    let carrying = |v: &Vertex| -> [u16; 4] { std::array::from_fn(|k| if v.weights[k] > 0.0 { v.bones[k] } else { 0 }) };
    let bones = v.iter().flat_map(carrying).flat_map(u16::to_le_bytes).collect();
    let corners = skin.triangles.iter().flatten().flat_map(|i| i.to_le_bytes()).collect();
    let first = binary.views.len();
    let primitive = json!({
        "attributes": {
            "POSITION": binary.floats(&positions, "VEC3", true),
            "NORMAL": binary.floats(&normals, "VEC3", false),
            "COLOR_0": binary.push(colours, U8, "VEC4", v.len(), json!({ "normalized": true })),
            "JOINTS_0": binary.push(bones, U16, "VEC4", v.len(), json!({})),
            "WEIGHTS_0": binary.floats(&weights, "VEC4", false),
        },
        "indices": binary.push(corners, U32, "SCALAR", 3 * skin.triangles.len(), json!({})),
        "material": 0,
    });
    let count = binary.views.len();
    for (k, view) in binary.views.iter_mut().enumerate().skip(first) {
        view["target"] = json!(if k + 1 == count { ELEMENT_ARRAY_BUFFER } else { ARRAY_BUFFER });
    }
    primitive
}

/// Means of the triangles' normals at their corners, by area; viewers shade faces flat without them.
fn normals(skin: &Skin) -> Vec<[f64; 3]> {
    let mut sums = vec![Vector3::zeros(); skin.vertices.len()];
    for corners in &skin.triangles {
        let place = |k: usize| skin.vertices.get(corners[k] as usize).map(|v| v.position);
        let (Some(a), Some(b), Some(c)) = (place(0), place(1), place(2)) else { continue };
        let area = (b - a).cross(&(c - a));
        corners.iter().for_each(|i| sums[*i as usize] += area);
    }
    sums.iter().map(|sum| sum.try_normalize(1e-12).unwrap_or_else(Vector3::y).into()).collect()
}

fn animation(creature: &Creature, motion: &Motion, binary: &mut Binary) -> Value {
    let times: Vec<[f64; 1]> = motion.times_s.iter().map(|t| [*t]).collect();
    let input = binary.floats(&times, "SCALAR", true);
    let (mut samplers, mut channels) = (Vec::new(), Vec::new());
    let mut add = |output: usize, bone: usize, path: &str| {
        channels.push(json!({ "sampler": samplers.len(), "target": { "node": bone, "path": path } }));
        samplers.push(json!({ "input": input, "output": output, "interpolation": "LINEAR" }));
    };
    for (k, bone) in creature.bones.iter().enumerate() {
        let mut last = UnitQuaternion::identity();
        let turns: Vec<[f64; 4]> = motion
            .postures
            .iter()
            .map(|p| {
                // The same hemisphere from key to key.
                let q = p[k].rotation;
                last = if q.coords.dot(&last.coords) < 0.0 { UnitQuaternion::new_unchecked(-q.into_inner()) } else { q };
                [last.i, last.j, last.k, last.w]
            })
            .collect();
        add(binary.floats(&turns, "VEC4", false), k, "rotation");
        if motion.postures.iter().any(|p| (p[k].translation - bone.rest.translation).norm() > 1e-9) {
            let places: Vec<[f64; 3]> = motion.postures.iter().map(|p| p[k].translation.into()).collect();
            add(binary.floats(&places, "VEC3", false), k, "translation");
        }
        if motion.postures.iter().any(|p| (p[k].scale - bone.rest.scale).norm() > 1e-9) {
            let scales: Vec<[f64; 3]> = motion.postures.iter().map(|p| p[k].scale.into()).collect();
            add(binary.floats(&scales, "VEC3", false), k, "scale");
        }
    }
    json!({ "name": motion.name, "samplers": samplers, "channels": channels })
}

fn container(root: &Value, binary: &[u8]) -> Vec<u8> {
    let mut json = root.to_string().into_bytes();
    while !json.len().is_multiple_of(4) {
        json.push(b' ');
    }
    let chunk = |kind: &[u8; 4], bytes: &[u8]| [&(bytes.len() as u32).to_le_bytes()[..], kind, bytes].concat();
    let mut body = chunk(b"JSON", &json);
    if !binary.is_empty() {
        body.extend(chunk(b"BIN\0", binary));
    }
    [&b"glTF"[..], &2u32.to_le_bytes(), &(12 + body.len() as u32).to_le_bytes(), &body].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::horse::horse;

    #[test]
    fn a_horse_comes_back_with_its_motions_and_skin() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("horse.glb");
        let horse = horse();
        write(&path, &horse).unwrap();
        let back = read(&path).unwrap();
        // The mesh's node is no bone.
        assert_eq!(back.bones.len(), 36);
        for bone in &horse.bones {
            let other = back.bones.iter().find(|b| b.name == bone.name).unwrap();
            let parent = |c: &Creature, b: &Bone| b.parent.map(|p| c.bones[p].name.clone());
            assert_eq!(parent(&horse, bone), parent(&back, other));
        }
        assert_eq!((back.skin.triangles.len(), back.motions.len()), (horse.skin.triangles.len(), 3));
        for (ours, theirs) in horse.motions.iter().zip(&back.motions) {
            assert_eq!((&ours.name, ours.times_s.len()), (&theirs.name, theirs.times_s.len()));
            let t = 0.4 * ours.duration_s();
            let [a, b] = [horse.vertices(&ours.at(t).unwrap()), back.vertices(&theirs.at(t).unwrap())];
            assert!(a.iter().zip(&b).all(|(a, b)| (a - b).norm() < 1e-5) && a.len() == b.len());
        }
        let colour = |c: &Creature| c.skin.vertices[0].colour.map(i32::from);
        assert!(colour(&horse).iter().zip(colour(&back)).all(|(a, b)| (a - b).abs() <= 3));
        assert!(encode(&horse) == encode(&horse));
    }

    #[test]
    fn damaged_files_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.glb");
        let whole = encode(&horse());
        for bytes in [&b"no glb at all"[..], &whole[..whole.len() / 2], &whole[..40]] {
            std::fs::write(&path, bytes).unwrap();
            assert!(matches!(read(&path), Err(GlbError::Format { .. } | GlbError::Content { .. })));
        }
        assert!(matches!(read(&folder.path().join("b.glb")), Err(GlbError::Read { .. })));
    }

    #[test]
    fn other_peoples_animals_stand_on_their_feet() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/animal/rigs");
        let Ok(entries) = folder.read_dir() else {
            println!("skipped: no {}", folder.display());
            return;
        };
        let files: Vec<PathBuf> = entries.map(|e| e.unwrap().path()).filter(|p| p.extension().is_some_and(|e| e == "glb")).collect();
        assert!(!files.is_empty());
        for file in files {
            let creature = read(&file).unwrap();
            let [low, high] = creature.bounds().unwrap();
            let size = high - low;
            println!(
                "{}: {} bones, {} triangles, {size:.2?}, {:?}",
                file.display(),
                creature.bones.len(),
                creature.skin.triangles.len(),
                creature.motions.iter().map(|m| (&m.name, m.duration_s())).collect::<Vec<_>>()
            );
            assert!(size.z > size.x && size.y > size.x && low.y.abs() < 0.1 * size.y);
            let gallop = creature.motions.iter().find(|m| m.name.ends_with("Gallop")).unwrap();
            assert!((0.4..0.8).contains(&gallop.duration_s()) && gallop.postures.len() > 5);
            let [a, b] = [0.0, 0.5].map(|t| creature.vertices(&gallop.at(t * gallop.duration_s()).unwrap()));
            let moved = a.iter().zip(&b).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
            assert!(moved > 0.1 * size.y && moved < size.z, "{moved}");
        }
    }
}
