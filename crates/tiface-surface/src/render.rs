//! Ray casting and rasterizing: color, depth and normals of a mesh from a camera.

mod hits;
mod look;
mod pixel_filter;
mod raster;
mod raycast;
mod residual;
mod texture;
mod view;

pub use hits::RayHits;
pub use look::{Look, Surface};
pub use pixel_filter::PixelFilterFit;
pub use raster::{RasterLayers, RasterOptions, RasterView, raster, raster_into};
pub use raycast::{RaycastOptions, raycast, raycast_each};
pub use residual::{ResidualSource, ResidualView, Residuals};
pub use texture::MeshTexture;
pub use view::RenderedView;
