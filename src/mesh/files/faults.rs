//! What is wrong with a mesh or a texture that cannot become a file. Found before there are any bytes.

use crate::geom::{Atlas, Mesh};
use crate::{Error, Result};

const DAMAGED: &str = "the mesh is damaged; extract it again";

/// Every triangle names vertices that are there.
pub(super) fn check_indices(mesh: &Mesh) -> Result<()> {
    let vertices = mesh.positions.len();
    for (triangle, t) in mesh.triangles.iter().enumerate() {
        if let Some(index) = t.iter().find(|&&i| i as usize >= vertices) {
            let what = format!("triangle {triangle} uses vertex {index}, but there are only {vertices}");
            return Err(Error::cannot(what, DAMAGED));
        }
    }
    Ok(())
}

/// The atlas belongs to this mesh, and stays on its texture.
pub(super) fn check_atlas(mesh: &Mesh, atlas: &Atlas) -> Result<()> {
    let wrong = |what: String| {
        Err(Error::cannot(what, "the atlas is damaged or belongs to another mesh; unwrap it again"))
    };
    let (found, expected) = (atlas.triangles.len(), mesh.triangles.len());
    if found != expected {
        return wrong(format!("the atlas has {found} triangles, the mesh {expected}"));
    }
    let uvs = atlas.uvs.len();
    for (triangle, t) in atlas.triangles.iter().enumerate() {
        if let Some(index) = t.iter().find(|&&i| i as usize >= uvs) {
            return wrong(format!(
                "triangle {triangle} uses texture coordinate {index}, but there are only {uvs}"
            ));
        }
    }
    let outside = |v: &f32| !(0.0..=1.0).contains(v);
    match atlas.uvs.iter().position(|uv| uv.to_array().iter().any(outside)) {
        Some(index) => wrong(format!(
            "texture coordinate {index} is {}, expected 0 to 1 in both directions",
            atlas.uvs[index]
        )),
        None => Ok(()),
    }
}

/// Normals or colors for some vertices only.
pub(super) fn wrong_length(found: usize, what: &str, vertices: usize) -> Error {
    Error::cannot(format!("{found} {what} for {vertices} vertices"), DAMAGED)
}

/// A coordinate that is NaN or infinite, as it is or after turning and scaling.
pub(super) fn not_finite(vertex: usize, what: &str, found: String) -> Error {
    let what = format!("vertex {vertex} has the {what} {found}, which is not finite in single precision");
    Error::cannot(what, DAMAGED)
}

/// An up direction without direction, or a unit without size.
pub(super) fn wrong_option(what: &str, found: impl ToString, expected: &str) -> Error {
    let hint = "set it in the configuration, or leave it to the capture";
    Error::cannot(format!("`{what}` is {}, expected {expected}", found.to_string()), hint)
}

/// A picture that does not fit its own size or the atlas.
pub(super) fn wrong_picture(what: &str, found: String, expected: &str) -> Error {
    let hint = "bake it again, for this atlas";
    Error::cannot(format!("the {what} is {found}, expected {expected}"), hint)
}
