//! Meshes as files: GLB, OBJ and PLY, written and read, and whether what is in them is sound.
//!
//! [`glb`], [`obj`] and [`ply`] write; [`read()`] reads all three, whoever wrote them. [`check()`] examines a surface,
//! [`uv_check()`] its texture coordinates.

mod check;
mod export;
mod glb;
mod glb_document;
mod glb_read;
mod glb_texture;
mod obj;
mod obj_read;
mod ply;
mod ply_read;
mod read;
mod tangents;
mod textured;
mod uv_check;
mod weld;

pub use check::{BARS, CheckReport, RequireError, check, check_around};
pub(crate) use export::turn_to_y_up;
pub use export::{ExportError, ExportOptions, distance_warning};
pub use glb::{textured_to_glb, to_glb};
pub use obj::{textured_to_obj, to_obj};
pub use obj_read::picture_of_mtl;
pub use ply::{placed_to_ply, textured_to_ply, to_ply};
pub use read::{Limits, ReadMesh, ReadMeshError, Texture, read, read_limited, read_placed, read_whole};
pub use tangents::tangents;
pub use textured::{Exported, Lobe, PictureFormat, TextureOptions, Textured};
pub use uv_check::{NO_AREA_PX, UvReport, seams_facing, uv_check};
pub use weld::weld;
