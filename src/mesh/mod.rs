//! Stage: a surface an artist can open. The zero level set of a signed distance becomes a closed mesh.
//!
//! [`marching`] meshes a dense grid, [`sparse`] asks a field only near its surface, [`clean`] keeps the
//! head and drops the dust, `handles` makes it simple, [`extract`] is all of it, with normals and colours; [`Cap`] closes what the frames
//! cut. [`simplify`], [`atlas`] and [`bake`] make of it what an artist opens; [`files`] its
//! files.

mod error;
mod extract;
pub mod files;
mod finish;

pub use error::MeshError;
pub use extract::{
    Asking, Cap, CleanReport, Grid, HandleReport, LONGEST_HANDLE, MeshConfig, MeshReport, Patches, Skin,
    Sparse, Surface, Verified, Volume, clean, extract, marching, sparse,
};
pub use finish::{
    AtlasConfig, AtlasReport, Placement, SimplifyConfig, SimplifyReport, atlas, bake, simplify,
};
