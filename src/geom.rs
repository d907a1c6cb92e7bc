//! The vocabulary: plain f32 geometry on glam; no files, no tensors.

mod aabb;
mod apart;
mod atlas;
mod boxes;
mod bvh;
mod camera;
mod harmonics;
mod intersect;
mod mesh;
mod overlap;
mod ray;
mod shells;
mod similarity;
pub mod sphharm;
mod symmetric;
mod topology;

pub use aabb::Aabb;
pub(crate) use apart::{OutlineSide, nearest_charts};
pub use atlas::Atlas;
pub(crate) use boxes::{Boxes, DBox, EFFORT, Effort, share_out};
pub use bvh::{Bvh, Closest};
pub use camera::{Camera, Distortion, Projection};
pub use harmonics::Harmonics;
pub(crate) use intersect::intersect;
pub use mesh::Mesh;
pub(crate) use mesh::{area_vector, shape};
pub(crate) use overlap::{THOROUGH, overlaps, shared_area, turn};
pub use ray::{Hit, Ray, RayResult};
pub use shells::{ShellCaster, ShellLayer, Shells};
pub use similarity::Similarity;
pub(crate) use symmetric::cofactors;
pub(crate) use topology::{Sets, fans, side_ends, sorted_sides};
pub use topology::{Topology, topology};
