//! The vocabulary: plain f32 geometry on glam; no files, no tensors.

mod aabb;
mod atlas;
mod bvh;
mod camera;
mod mesh;
mod ray;
mod similarity;
mod symmetric;
mod topology;

pub use aabb::Aabb;
pub use atlas::Atlas;
pub use bvh::{Bvh, Closest};
pub use camera::{Camera, Distortion};
pub use mesh::Mesh;
pub use ray::{Hit, Ray};
pub use similarity::Similarity;
pub(crate) use symmetric::cofactors;
pub(crate) use topology::{Sets, fans, sorted_sides};
pub use topology::{Topology, topology};
