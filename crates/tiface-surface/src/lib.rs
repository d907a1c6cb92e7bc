#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! - `extract`: [`sparse`] evaluates a field only near its surface, [`clean`] keeps the largest
//!   surface and drops loose pieces; [`extract`] runs both, adds normals and colors, and removes
//!   small handles. [`Cap`] closes the surface where the frames cut it. [`extract_dense`] evaluates
//!   a field at all nodes of a grid, which [`marching`] meshes.
//! - [`smooth()`] takes the noise of a learned field out of the surface, and [`fit_outlines`] moves
//!   it to the outlines in photographs; [`MeshDistance`] is the result as a field, for the steps
//!   after it.
//! - [`simplify`], [`atlas`] and [`bake`] turn the surface into a textured mesh.
//! - [`resized`] makes smaller meshes of a finished one and [`lods`] a chain of them; [`cut`] cuts
//!   it by a plane, such as those that [`measure`] finds below the chin and above the shoulders.
//! - [`files`] writes, reads and checks GLB, OBJ and PLY, writes USDZ, and reads glTF and STL.
//! - [`render`] shows a mesh from a camera.

mod appearance;
mod atlas;
pub mod bake;
mod cut;
mod extract;
pub mod files;
#[cfg(test)]
mod fixtures;
mod measure;
mod mesh_distance;
mod moves;
mod neck;
mod outline;
mod regularized;
pub mod render;
mod resize;
mod shells;
mod simplify;
mod smooth;
mod warning;

pub use appearance::{Appearance, AppearanceReport, Colors, Photograph, fit as fit_appearance};
pub use atlas::{AtlasConfig, AtlasReport, PartReport, atlas, resolved};
pub use cut::{CutReport, Plane, cut};
pub use extract::{
    Cap, CleanReport, ExtractOptions, HandleReport, LevelSet, MAX_HANDLE, MeshReport, NodeGrid, RimVertex,
    Sparse, Volume, clean, extract, extract_dense, marching, sparse,
};
pub use measure::{HeadMeasures, measure};
pub use mesh_distance::MeshDistance;
pub use outline::{OutlineReport, fit as fit_outlines};
pub use resize::{DetailLevel, Resize, lods, most_levels, resized};
pub use shells::{FittedShells, ShellsReport, fit as fit_shells, importance as shell_importance};
pub use simplify::{SimplifyConfig, SimplifyReport, simplify};
pub use smooth::{SmoothReport, smooth};
pub use warning::Warning;

use glam::Vec3;
use std::fmt::Display;
use tiface_base::error::Cause;
use tiface_base::geom::{Mesh, SdfField};
use tiface_base::{Error, Monitor, Result};

/// Refuses a parameter or field `name` that is not `ok`.
fn setting(ok: bool, name: &str, expected: &str, found: impl Display) -> Result<()> {
    if ok { Ok(()) } else { Err(Error::cannot(format!("`{name}` is {found}, expected {expected}"), "")) }
}

fn damaged(what: String) -> Error {
    Error::cannot(what, "the mesh is damaged: export it again, or remove these vertices and triangles")
}

/// Refuses vertices that are not finite, whether or not a triangle names them.
fn finite(mesh: &Mesh) -> Result<()> {
    let Some(first) = mesh.positions.iter().position(|p| !p.is_finite()) else { return Ok(()) };
    Err(not_finite(mesh, first))
}

fn not_finite(mesh: &Mesh, first: usize) -> Error {
    let count = mesh.positions.iter().filter(|p| !p.is_finite()).count();
    damaged(format!(
        "{count} vertices of the mesh have a coordinate that is not finite, the first is vertex {first}"
    ))
}

/// Refuses triangles with missing or non-finite vertices.
fn check_indices(mesh: &Mesh) -> Result<()> {
    let vertices = mesh.positions.len();
    for (i, &v) in mesh.triangles.as_flattened().iter().enumerate() {
        match mesh.positions.get(v as usize) {
            None => {
                let t = i / 3;
                return Err(damaged(format!("triangle {t} names vertex {v}, but the mesh has {vertices}")));
            }
            Some(p) if !p.is_finite() => return Err(not_finite(mesh, v as usize)),
            _ => {}
        }
    }
    Ok(())
}

/// Refuses more vertices than 32-bit indices can name.
fn check_count(vertices: u64, triangles: u64) -> Result<()> {
    if vertices.max(triangles) <= u64::from(u32::MAX) {
        return Ok(());
    }
    let message = format!("the surface has {vertices} vertices, more than 32-bit indices can name");
    Err(Error::cannot(message, "use larger cells").with_cause(Cause::Resolution))
}

/// Refuses a field's values if their number differs from the number of points.
fn check_len(what: &str, points: usize, answers: usize) -> Result<()> {
    if points == answers {
        return Ok(());
    }
    let message = format!("the {what} was evaluated at {points} points and returned {answers} values");
    Err(Error::cannot(message, "a field must return one value a point, in order"))
}

/// Returns values and gradients of a field at points, evaluated at most `batch` of them a call.
fn evaluate(
    field: &dyn SdfField,
    points: &[Vec3],
    batch: usize,
    monitor: &dyn Monitor,
) -> Result<(Vec<f32>, Vec<Vec3>)> {
    let (mut values, mut gradients) = (Vec::with_capacity(points.len()), Vec::with_capacity(points.len()));
    for points in points.chunks(batch) {
        monitor.check_stop()?;
        let (f, g) = field.sdf_gradient(points);
        check_len("gradient", points.len(), f.len().min(g.len()))?;
        values.extend(f);
        gradients.extend(g);
    }
    Ok((values, gradients))
}
