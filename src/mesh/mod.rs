//! Stage: a surface an artist can open. The zero level set of a signed distance becomes a closed mesh.
//!
//! [`marching`] meshes a dense grid, [`sparse`] asks a field only near its surface, [`clean`] keeps the
//! head and drops the dust, [`extract`] is the stage: all of it with normals and colours.

mod error;
mod marching;
mod marching_bits;
mod marching_cell;
mod sparse;
mod sparse_blocks;

pub use error::MeshError;
pub use marching::{Surface, Volume, marching};
pub use sparse::{Asking, Grid, Sparse, sparse};
