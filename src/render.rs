//! Stage: the ways to render a view.

mod look;
pub mod path;
mod raster;
mod raycast;
mod texture;

pub use look::{Look, Surface};
pub use raster::{RasterLayers, RasterOptions, RasterView, raster, raster_into};
pub use raycast::{RayHits, RaycastOptions, RenderedView, raycast};
pub use texture::{LobePictures, MeshTexture};
