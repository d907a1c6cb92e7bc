//! Stage: a surface an artist can open. The zero level set of a signed distance becomes a closed mesh.
//!
//! [`marching`] meshes a dense grid, [`sparse`] asks a field only near its surface, [`clean`] keeps the
//! head and drops the dust, `handles` makes it simple, [`extract`] is all of it, with normals and colours; [`Cap`] closes what the frames
//! cut. [`simplify`], [`atlas`] and [`bake`] make of it what an artist opens; [`files`] its
//! files.

mod extract;
pub mod files;
mod finish;
mod input;
mod moves;

pub use extract::{
    Cap, CleanReport, ExtractOptions, HandleReport, LONGEST_HANDLE, LevelSet, MeshReport, NodeGrid, Patches,
    Skin, Sparse, Verified, Volume, clean, extract, marching, sparse,
};
pub use finish::{
    AtlasConfig, AtlasReport, SimplifyConfig, SimplifyReport, VertexPlacement, atlas, bake, simplify,
};
