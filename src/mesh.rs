//! Stage: extraction of a signed distance's zero level set as a closed mesh, and its preparation for artists.
//!
//! - `extract`: [`marching`] meshes a dense grid, [`sparse`] evaluates a field only near its surface, [`clean`] keeps
//!   the head and drops loose pieces; [`extract`] runs all of this, adds normals and colors, and removes small handles.
//!   [`Cap`] closes the surface where the frames cut it.
//! - [`simplify`], [`atlas`] and [`bake`] turn the surface into a textured head mesh.
//! - [`files`]: reads, writes and checks GLB, OBJ and PLY.

mod appearance;
mod atlas;
pub mod bake;
mod extract;
pub mod files;
mod input;
mod moves;
mod shells;
mod simplify;

pub use appearance::{Appearance, AppearanceReport, Colors, Photograph, fit as fit_appearance};
pub use atlas::{AtlasConfig, AtlasReport, atlas};
pub use extract::{
    Cap, CleanReport, ExtractOptions, HandleReport, LevelSet, MAX_HANDLE, MeshReport, NodeGrid, Patches,
    RimVertex, Sparse, Volume, clean, extract, extract_dense, marching, sparse,
};
pub use shells::{ShellsReport, fit as fit_shells};
pub use simplify::{SimplifyConfig, SimplifyReport, simplify};
