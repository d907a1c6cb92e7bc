//! Mesh files: GLB, OBJ and PLY, written, read and checked.
//!
//! [`to_glb`], [`to_obj`] and [`to_ply`] write; [`read()`] reads all three formats from any program. [`check()`]
//! examines a surface, [`uv_check()`] its texture coordinates. [`ExtractedSurface`] and [`HeadMesh`] are the meshes
//! that later stages read.

mod check;
mod file_mesh;
mod glb;
mod glb_read;
mod obj;
mod ply;
mod read;
mod source;
mod stored;

pub use check::{
    BARS, CheckReport, MIN_AREA_PX, PieceReport, UvReport, check, check_around, seams_facing, uv_check,
};
pub use file_mesh::{ExportOptions, ExportedFiles, HeadTexture, Lobes, tangents, weld};
pub use glb::to_glb;
pub use obj::{picture_of_mtl, to_obj};
pub use ply::to_ply;
pub use read::{OpenedMesh, open_mesh, picture_beside, read, read_with};
pub use source::{PictureSource, ReadMesh, ReadOptions};
pub(crate) use stored::FORMAT;
pub use stored::{ExtractedSurface, HeadMesh};

#[cfg(test)]
pub(crate) use stored::tests::head as test_head;
