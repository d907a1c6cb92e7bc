//! Stage · ways to make a view.

pub mod path;
mod raycast;
mod texture;

pub use raycast::{RayHits, RaycastOptions, RenderedView, raycast};
pub use texture::{LobePictures, MeshTexture};
