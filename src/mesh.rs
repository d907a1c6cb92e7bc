//! Stage: a surface an artist can open. The zero level set of a signed distance becomes a closed mesh.
//!
//! - `extract`: [`marching`] meshes a dense grid, [`sparse`] evaluates a field only near its surface, [`clean`] keeps the
//!   head and drops the dust; [`extract`] is all of it, with normals and colors, and takes small handles away. [`Cap`]
//!   closes what the frames cut.
//! - `finish`: [`simplify`], [`atlas`] and [`bake`] make of it what an artist opens.
//! - [`files`]: GLB, OBJ and PLY in and out, and whether a mesh is sound.

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
