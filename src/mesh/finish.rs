//! From the extracted surface to the mesh an artist opens: fewer triangles, an atlas, textures.

mod appearance;
mod atlas;
pub mod bake;
mod shells;
mod simplify;

pub use appearance::{Appearance, AppearanceReport, Colors, Photograph, fit as fit_appearance};
pub use atlas::{AtlasConfig, AtlasReport, atlas};
pub use shells::{ShellsReport, fit as fit_shells};
pub use simplify::{SimplifyConfig, SimplifyReport, VertexPlacement, simplify};
