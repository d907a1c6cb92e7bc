//! From the extracted surface to the mesh an artist opens: fewer triangles, an atlas, textures.

mod atlas;
pub mod bake;
mod simplify;

pub use atlas::{AtlasConfig, AtlasReport, atlas};
pub use simplify::{SimplifyConfig, SimplifyReport, VertexPlacement, simplify};
