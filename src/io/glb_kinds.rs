//! Whether accessors of a glTF file hold what their users need: the `gltf` crate takes it for granted and panics, or reads other
//! numbers than are meant.

use gltf::accessor::{Accessor, DataType, Dimensions};
use gltf::animation::Property;
use gltf::json::validation::Validate;
use gltf::mesh::Semantic;

use DataType::{F32, I8, I16, U8, U16, U32};
use Dimensions::{Mat4, Scalar, Vec3, Vec4};

/// Dimensions and numbers that an accessor may have.
type Kinds = (&'static [Dimensions], &'static [DataType]);

/// Rotations and weights of shapes may be parts of integers.
const PARTS: &[DataType] = &[I8, U8, I16, U16, F32];

pub(super) fn check_kinds(document: &gltf::Document) -> Result<(), String> {
    for primitive in document.meshes().flat_map(|mesh| mesh.primitives().collect::<Vec<_>>()) {
        for (semantic, accessor) in primitive.attributes() {
            check(&accessor, attribute(&semantic), &format!("{semantic:?}").to_lowercase())?;
        }
        if let Some(accessor) = primitive.indices() {
            check(&accessor, Some((&[Scalar], &[U8, U16, U32])), "corners of triangles")?;
        }
    }
    for accessor in document.skins().filter_map(|skin| skin.inverse_bind_matrices()) {
        check(&accessor, Some((&[Mat4], &[F32])), "bind matrices")?;
    }
    for channel in document.animations().flat_map(|animation| animation.channels().collect::<Vec<_>>()) {
        check(&channel.sampler().input(), Some((&[Scalar], &[F32])), "key times")?;
        let (kinds, what): (Kinds, &str) = match channel.target().property() {
            Property::Translation => ((&[Vec3], &[F32]), "translations"),
            Property::Scale => ((&[Vec3], &[F32]), "scales"),
            Property::Rotation => ((&[Vec4], PARTS), "rotations"),
            Property::MorphTargetWeights => ((&[Scalar], PARTS), "weights of shapes"),
        };
        check(&channel.sampler().output(), Some(kinds), what)?;
    }
    Ok(())
}

/// That what meshes and channels refer to is there. The crate's own checks take the first for granted and leave out the second.
pub(super) fn check_references(root: &gltf::json::Root) -> Result<(), String> {
    check_corners(root).and_then(|()| check_targets(root))
}

fn check_corners(root: &gltf::json::Root) -> Result<(), String> {
    let mut attributes = root.meshes.iter().flat_map(|mesh| &mesh.primitives).flat_map(|primitive| primitive.attributes.values());
    match attributes.find(|accessor| accessor.value() >= root.accessors.len()) {
        Some(accessor) => {
            Err(format!("a mesh asks for accessor {accessor} of {}; the file is damaged, export it again", root.accessors.len()))
        }
        None => Ok(()),
    }
}

fn check_targets(root: &gltf::json::Root) -> Result<(), String> {
    for (index, animation) in root.animations.iter().enumerate() {
        let mut sound = true;
        animation.channels.iter().for_each(|channel| channel.target.validate(root, gltf::json::Path::new, &mut |_, _| sound = false));
        if !sound {
            return Err(format!("a channel of animation {index} moves what is not there; the file is damaged, export it again"));
        }
    }
    Ok(())
}

/// `None` for what is not read.
fn attribute(semantic: &Semantic) -> Option<Kinds> {
    match semantic {
        Semantic::Positions => Some((&[Vec3], &[F32])),
        Semantic::Joints(_) => Some((&[Vec4], &[U8, U16])),
        Semantic::Weights(_) => Some((&[Vec4], &[U8, U16, F32])),
        Semantic::Colors(_) => Some((&[Vec3, Vec4], &[U8, U16, F32])),
        _ => None,
    }
}

fn check(accessor: &Accessor, kinds: Option<Kinds>, what: &str) -> Result<(), String> {
    match kinds {
        Some((dimensions, numbers)) if !dimensions.contains(&accessor.dimensions()) || !numbers.contains(&accessor.data_type()) => {
            Err(format!(
                "accessor {} holds {:?} of {:?}, which are no {what}; the file is damaged, export it again",
                accessor.index(),
                accessor.dimensions(),
                accessor.data_type()
            ))
        }
        _ => Ok(()),
    }
}
