//! The vocabulary: plain f32 geometry on glam; no files, no tensors.

mod bvh;
mod camera;
mod field;
mod mesh;
mod overlap;
mod ray;
mod shells;
mod similarity;
pub mod sphharm;
mod symmetric;
mod topology;

pub use bvh::{Bvh, Closest};
pub use camera::{Camera, Distortion, Projection};
pub use field::SdfField;
pub use mesh::{Atlas, Mesh};
pub(crate) use mesh::{area_vector, bilinear_taps, shape};
pub(crate) use overlap::{
    Boxes, DBox, DEFAULT_EFFORT, Effort, OutlineSide, THOROUGH_EFFORT, intersect, nearest_charts, overlaps,
    share_out, shared_area, turn,
};
pub use ray::{Aabb, Hit, Ray, RayResult};
pub use shells::{ShellCaster, ShellLayer, Shells};
pub use similarity::Similarity;
pub use sphharm::Harmonics;
pub(crate) use symmetric::cofactors;
pub(crate) use topology::{Sets, side_ends, sorted_sides};
pub use topology::{Topology, topology};

#[cfg(test)]
pub(crate) use field::Painted;
