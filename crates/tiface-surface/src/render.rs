//! Ray casting and rasterizing: color, depth and normals of a mesh from a camera.

mod look;
mod raster;
mod raycast;
mod residual;
mod texture;

pub use look::{Look, Surface};
pub use raster::{RasterLayers, RasterOptions, RasterView, raster, raster_into};
pub use raycast::{RayHits, RaycastOptions, RenderedView, raycast, raycast_each};
pub use residual::{ResidualSource, ResidualView, Residuals};
pub use texture::MeshTexture;
