//! Mesh files: GLB, OBJ and PLY, written, read and checked; USDZ, written; glTF and STL, read.
//!
//! [`to_glb`], [`to_obj`], [`to_ply`] and [`to_usdz`] write; [`open_mesh`] opens the other formats
//! from any program, with the pictures beside them, and [`read()`] the surface in bytes.
//! [`check()`] examines a surface, [`uv_check()`] its texture coordinates. [`ExtractedSurface`] and
//! [`HeadMesh`] are the meshes that later stages read.

mod beside;
mod check;
mod check_report;
mod color_range;
mod file_mesh;
mod foreign;
mod glb;
mod glb_document;
mod glb_read;
mod gltf_document;
mod gltf_text;
mod head_texture;
mod meshopt;
mod mtl;
mod obj;
mod obj_read;
mod open;
mod ply;
mod ply_element;
mod ply_read;
mod read;
mod source;
mod stl;
mod stored;
mod stored_zip;
mod tangents;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
mod uri;
mod usdz;
mod uv_check;
mod weld;

pub use check::{check, check_around};
pub use check_report::{CheckReport, PieceReport, REQUIREMENTS};
pub use file_mesh::{ExportOptions, ExportedFiles};
pub use glb::to_glb;
pub use head_texture::{HeadTexture, LOBE_TEXEL, Lobes};
pub use mtl::{Material, materials_of_mtl};
pub use obj::to_obj;
pub use open::{OpenedMesh, open_mesh, open_surface};
pub use ply::to_ply;
pub use read::{read, read_with};
pub use source::{LobeSource, PictureSource, ReadMesh, ReadOptions};
pub use stored::FORMAT;
pub use stored::{ExtractedSurface, HeadMesh};
pub use tangents::tangents;
pub use usdz::to_usdz;
pub use uv_check::{MIN_AREA_PX, UvReport, seams_facing, uv_check};
pub use weld::weld;

use tiface_base::Error;

/// Hint for a mesh whose parts do not fit each other.
const DAMAGED: &str = "the mesh is damaged; extract it again";

/// Returns an error if only some vertices have normals or colors.
fn wrong_length(found: usize, what: &str, vertices: usize) -> Error {
    Error::cannot(format!("{found} {what} for {vertices} vertices"), DAMAGED)
}
