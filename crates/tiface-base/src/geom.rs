//! The vocabulary: plain f32 geometry on glam; no files, no tensors.

mod aabb;
mod atlas;
mod bit_grid;
mod boxes;
mod bvh;
mod camera;
mod cell_cube;
mod chart_distance;
pub mod distance;
mod field;
mod harmonics;
mod intersect;
mod meeting_point;
mod mesh;
mod overlap;
mod pieces;
mod ray;
mod shells;
mod similarity;
pub mod sphharm;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
mod topology;

pub use aabb::Aabb;
pub use atlas::{Atlas, bilinear_taps};
pub use bit_grid::{BitGrid, dilated_cells};
pub use boxes::{Boxes, DBox, DEFAULT_EFFORT, Effort, share_out};
pub use bvh::{Bvh, Closest};
pub use camera::{Camera, Distortion, Projection};
pub use cell_cube::{CellCube, cells_around, drop_small_components, extent_of_cells};
pub use chart_distance::{OutlineSide, nearest_charts};
pub use field::SdfField;
pub use harmonics::Harmonics;
pub use intersect::intersect;
pub use meeting_point::meeting_point;
pub use mesh::{Mesh, area_vector, shape};
pub use overlap::{THOROUGH_EFFORT, overlaps, shared_area, turn};
pub use pieces::{WrongPiece, wrong_pieces};
pub use ray::{Hit, Ray, RayResult};
pub use shells::{ShellCaster, ShellLayer, Shells};
pub use similarity::Similarity;
pub use topology::{Sets, Topology, fans, side_ends, sorted_sides, topology};

/// Returns the cofactors, themselves symmetric, and the determinant of a symmetric 3 × 3 matrix of
/// entries `xx xy xz yy yz zz`: their quotient is the inverse.
#[inline]
pub fn cofactors([xx, xy, xz, yy, yz, zz]: [f64; 6]) -> ([f64; 6], f64) {
    let c = [
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    ];
    (c, xx * c[0] + xy * c[1] + xz * c[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_matrix_times_its_cofactors_is_its_determinant() {
        let (m, [xx, xy, xz, yy, yz, zz]) = {
            let m = [4.0, 1.0, -2.0, 3.0, 0.5, 5.0];
            (m, m)
        };
        let (c, determinant) = cofactors(m);
        // 4 · (15 − 0.25) − 1 · (5 + 1) − 2 · (0.5 + 6)
        assert_eq!(determinant, 40.0);
        let rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        let columns = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]];
        for (i, row) in rows.iter().enumerate() {
            for (j, column) in columns.iter().enumerate() {
                let sum: f64 = row.iter().zip(column).map(|(a, b)| a * b).sum();
                assert_eq!(sum, if i == j { determinant } else { 0.0 });
            }
        }
    }
}
