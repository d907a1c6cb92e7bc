//! Stage · ways to make a view.

pub mod path;
mod raycast;

pub use raycast::{RaycastOptions, RenderedView, raycast};
