//! A mesh that tests share.

use super::Mesh;
use glam::Vec3;

/// Returns a 2 × 1 rectangle at height z, of two triangles.
pub fn sheet(z: f32) -> Mesh {
    Mesh {
        positions: vec![
            Vec3::new(0.0, 0.0, z),
            Vec3::new(2.0, 0.0, z),
            Vec3::new(2.0, 1.0, z),
            Vec3::new(0.0, 1.0, z),
        ],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..Mesh::default()
    }
}
