//! Stage · ways to make a view.

pub mod path;
mod raycast;
mod texture;

pub use raycast::{RaycastOptions, RenderedView, Struck, raycast, raycast_hits};
pub use texture::{LobePictures, Texture};
