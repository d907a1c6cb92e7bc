//! Stage: a surface an artist can open. The zero level set of a signed distance becomes a closed mesh.
//!
//! [`marching`] meshes a dense grid, [`sparse`] asks a field only near its surface, [`clean`] keeps the
//! head and drops the dust, `handles` makes it simple, [`extract`] is all of it, with normals and colours; [`Cap`] closes what the frames
//! cut. [`simplify`], [`atlas`] and [`bake`] make of it what an artist opens; [`gltf`], [`obj`] and [`ply`] its
//! files.

mod atlas;
pub mod bake;
mod boxes;
mod cap;
pub mod check;
mod clean;
mod error;
pub mod export;
mod extract;
pub mod gltf;
mod gltf_document;
mod handles;
mod holes;
mod loops;
mod marching;
mod marching_bits;
mod marching_cell;
pub mod obj;
pub mod ply;
mod polish;
pub mod read;
mod simplify;
mod sparse;
mod sparse_blocks;
pub mod textured;
pub mod textured_tangents;
pub mod uv_check;
mod verify;

pub use atlas::{AtlasConfig, AtlasReport, atlas};
pub use cap::{Cap, Skin};
pub use clean::{CleanReport, clean};
pub use error::MeshError;
pub use extract::{MeshReport, extract};
pub use handles::{HandleReport, Patches};
pub use marching::{Surface, Volume, marching};
pub use simplify::{Placement, SimplifyConfig, SimplifyReport, simplify};
pub use sparse::{Asking, Grid, Sparse, sparse};
pub use verify::Verified;

use serde::{Deserialize, Serialize};

/// How the surface is extracted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MeshConfig {
    /// Cells along the longest side of the box; 2..=8192.
    pub resolution: usize,
    /// Every how many cells the field is asked first: 2, 4 or 8. Smaller finds smaller loose pieces.
    pub coarse_step: usize,
    /// Most points in one call of the field; at least 1.
    pub batch: usize,
    /// Pieces beside the largest stay when they have at least this share of its volume; 0..=1, where 1
    /// keeps the largest alone.
    pub keep_share: f64,
    /// Newton steps that move vertices onto the field's zero; 0..=8, 0 leaves them where they are.
    pub newton_steps: usize,
    /// How far vertices slide towards the middle of their neighbours with the first step; 0..=1.
    pub relax: f32,
    /// Handles are cut, or their holes filled, where they have a loop no longer than this share of the surface's
    /// longest side; 0..=1, 0 leaves them all.
    pub longest_handle: f32,
    /// Also evaluate the whole grid and report what the sparse extraction lost: slow, for checking.
    pub verify: bool,
}

/// The loops of locks and between them, not those of a body: 45 mm of a head with its neck, 300 mm long, which
/// is a strand or a hole as thick as a thumb. A share, since not every capture knows its unit.
pub const LONGEST_HANDLE: f32 = 0.15;

impl Default for MeshConfig {
    fn default() -> MeshConfig {
        MeshConfig {
            resolution: 512,
            coarse_step: 8,
            batch: 1 << 16,
            keep_share: 1.0,
            newton_steps: 2,
            relax: 0.5,
            longest_handle: LONGEST_HANDLE,
            verify: false,
        }
    }
}

impl MeshConfig {
    /// Every value in its range, else [`MeshError::Config`] that names the key.
    pub fn check(&self) -> Result<(), MeshError> {
        let bad = |key, expected, found: String| Err(MeshError::Config { key, expected, found });
        if !(2..=8192).contains(&self.resolution) {
            return bad("resolution", "2..=8192", self.resolution.to_string());
        }
        if ![2, 4, 8].contains(&self.coarse_step) {
            return bad("coarse_step", "2, 4 or 8", self.coarse_step.to_string());
        }
        if self.batch == 0 {
            return bad("batch", "at least 1", self.batch.to_string());
        }
        if !(0.0..=1.0).contains(&self.keep_share) {
            return bad("keep_share", "0..=1", self.keep_share.to_string());
        }
        if self.newton_steps > 8 {
            return bad("newton_steps", "0..=8", self.newton_steps.to_string());
        }
        if !(0.0..=1.0).contains(&self.relax) {
            return bad("relax", "0..=1", self.relax.to_string());
        }
        if !(0.0..=1.0).contains(&self.longest_handle) {
            return bad("longest_handle", "0..=1", self.longest_handle.to_string());
        }
        Ok(())
    }
}

#[cfg(test)]
mod handles_tests;
