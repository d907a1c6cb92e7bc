//! Meshes as files: GLB, OBJ and PLY, written and read, and whether what is in them is sound.
//!
//! [`to_glb`], [`to_obj`] and [`to_ply`] write; [`read()`] reads all three, whoever wrote them. [`check()`] examines
//! a surface, [`uv_check()`] its texture coordinates. [`ExtractedSurface`] and [`HeadMesh`] are what the stages after
//! this one read.

mod check;
mod compact;
mod extracted;
mod faults;
mod file_mesh;
mod glb;
mod glb_document;
mod glb_json;
mod glb_read;
mod head;
mod obj;
mod obj_read;
mod open;
mod ply;
mod ply_read;
mod read;
mod source;
mod stored;
mod tangents;
mod texture;
mod uv_check;
mod weld;

pub use check::{BARS, CheckReport, check, check_around};
pub use compact::compact_glb;
pub use extracted::ExtractedSurface;
pub(crate) use file_mesh::turn_to_y_up;
pub use file_mesh::{ExportOptions, ExportedFiles};
pub use glb::to_glb;
pub use head::HeadMesh;
pub use obj::to_obj;
pub use obj_read::picture_of_mtl;
pub use open::{OpenedMesh, open_mesh, picture_beside};
pub use ply::to_ply;
pub use read::{ReadMesh, read, read_with};
pub use source::{PictureSource, ReadOptions};
pub(crate) use stored::FORMAT;
pub use tangents::tangents;
pub use texture::{HeadTexture, Lobes};
pub use uv_check::{NO_AREA_PX, UvReport, seams_facing, uv_check};
pub use weld::weld;

#[cfg(test)]
pub(crate) use head::tests::head as test_head;
