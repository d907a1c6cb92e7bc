//! Stage: extraction of a signed distance's zero level set as a closed mesh, and its preparation for artists.
//!
//! - `extract`: [`marching`] meshes a dense grid, [`sparse`] evaluates a field only near its surface, [`clean`] keeps
//!   the head and drops loose pieces; [`extract`] runs all of this, adds normals and colors, and removes small handles.
//!   [`Cap`] closes the surface where the frames cut it.
//! - `finish`: [`simplify`], [`atlas`] and [`bake`] turn the surface into a textured head mesh.
//! - [`files`]: reads, writes and checks GLB, OBJ and PLY.

mod extract;
pub mod files;
mod finish;
mod input;
mod moves;

pub use extract::{
    Cap, CleanReport, ExtractOptions, HandleReport, LONGEST_HANDLE, LevelSet, MeshReport, NodeGrid, Patches,
    RimVertex, Sparse, Verified, Volume, clean, extract, extract_dense, marching, sparse,
};
pub use finish::{
    Appearance, AppearanceReport, AtlasConfig, AtlasReport, Colors, Photograph, ShellsReport, SimplifyConfig,
    SimplifyReport, VertexPlacement, atlas, bake, fit_appearance, fit_shells, simplify,
};
