//! Signed distance to a mesh, in the place of the field that it was extracted from.
//!
//! An extracted surface is more than the zero set of its field: it is smoothed, handles are cut,
//! and a cap closes it. What holds vertices on a surface, or moves samples onto it, takes this
//! field then. Colors and sharpness stay those of the learned field.

use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{Bvh, Hit, Mesh, SdfField};

/// The signed distance to a mesh whose triangles are wound outward, with its shading normals as
/// gradients.
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::{Aabb, SdfField};
/// use tiface_surface::{ExtractOptions, MeshDistance, extract};
///
/// let ball = |p: Vec3| p.length() - 0.7;
/// let options = ExtractOptions { resolution: 32, ..ExtractOptions::default() };
/// let (mesh, _) = extract(&ball, Aabb::SCENE, &options, &tiface_base::Quiet)?;
/// let distance = MeshDistance::new(&mesh, ball);
/// assert!((distance.sdf(&[Vec3::X])[0] - 0.3).abs() < 0.01);
/// # Ok::<(), tiface_base::Error>(())
/// ```
pub struct MeshDistance<'a, F> {
    mesh: &'a Mesh,
    bvh: Bvh,
    /// Where colors and sharpness come from.
    field: F,
}

impl<'a, F: SdfField> MeshDistance<'a, F> {
    /// Prepares a mesh that was extracted from `field`.
    pub fn new(mesh: &'a Mesh, field: F) -> MeshDistance<'a, F> {
        MeshDistance { mesh, bvh: Bvh::new(mesh), field }
    }

    /// Returns the signed distance of a point and the normal of the nearest point; infinite for a
    /// mesh without triangles.
    fn at(&self, p: Vec3) -> (f32, Vec3) {
        let Some(near) = self.bvh.closest_point(p) else { return (f32::INFINITY, Vec3::ZERO) };
        let normal = self.mesh.shading_normal(&hit_at(self.mesh, near.triangle, near.point));
        let side = if (p - near.point).dot(normal) < 0.0 { -1.0 } else { 1.0 };
        (side * near.distance, normal)
    }
}

impl<F: SdfField> SdfField for MeshDistance<'_, F> {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        points.par_iter().with_min_len(64).map(|&p| self.at(p).0).collect()
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        points.par_iter().with_min_len(64).map(|&p| self.at(p)).unzip()
    }

    fn colors(&self, points: &[Vec3], normals: &[Vec3], counts: &[u32], away: &[Vec3]) -> Vec<[f32; 3]> {
        self.field.colors(points, normals, counts, away)
    }

    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        self.field.sharpness(points)
    }
}

/// Returns the place of a point of a triangle.
pub(crate) fn hit_at(mesh: &Mesh, triangle: u32, point: Vec3) -> Hit {
    let [a, b, c] = mesh.corners(triangle).map(|p| p.as_dvec3());
    let (e, f, p) = (b - a, c - a, point.as_dvec3() - a);
    let det = e.length_squared() * f.length_squared() - e.dot(f).powi(2);
    let share = |x: f64| if det > 0.0 { (x / det).clamp(0.0, 1.0) } else { 0.0 };
    let u = share(f.length_squared() * p.dot(e) - e.dot(f) * p.dot(f));
    let v = share(e.length_squared() * p.dot(f) - e.dot(f) * p.dot(e)).min(1.0 - u);
    Hit { t: 0.0, triangle, u: u as f32, v: v as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ExtractOptions, extract};
    use tiface_base::Quiet;
    use tiface_base::geom::Aabb;

    #[test]
    fn the_distance_is_signed_and_its_gradient_is_the_shading_normal() {
        // a square whose normals lean by 0.1 towards +x at x = 1
        let lean = Vec3::new(0.1, 0.0, 1.0).normalize();
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
            normals: vec![Vec3::Z, lean, lean, Vec3::Z],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        };
        let field = MeshDistance::new(&mesh, |_: Vec3| 9.0);
        let points = [Vec3::new(0.5, 0.2, 0.25), Vec3::new(0.5, 0.8, -0.25), Vec3::new(1.0, 0.5, 0.0)];
        let (values, gradients) = field.sdf_gradient(&points);
        assert_eq!((&values[..], field.sdf(&points)), (&[0.25, -0.25, 0.0][..], values.clone()));
        // half of the lean in the middle
        let half = (Vec3::Z + lean).normalize();
        assert!(gradients.iter().zip([half, half, lean]).all(|(g, n)| g.distance(n) < 1e-6), "{gradients:?}");
        // what is known of color is the field's
        assert_eq!(field.color(&points, &gradients, &[Vec3::Z; 3]), [[0.5; 3]; 3]);
    }

    #[test]
    fn the_cap_of_a_column_belongs_to_the_surface() {
        let column = |p: Vec3| (p.x.hypot(p.z) - 0.3).max(p.y - 0.5);
        let options = ExtractOptions { resolution: 48, ..ExtractOptions::default() };
        let (mesh, report) = extract(&column, Aabb::SCENE, &options, &Quiet).unwrap();
        let field = MeshDistance::new(&mesh, column);
        // within the cap, on the side, below the cap
        let points = [Vec3::new(0.02, -1.0, 0.01), Vec3::new(0.3, 0.0, 0.0), Vec3::new(0.0, -1.25, 0.0)];
        let (values, gradients) = field.sdf_gradient(&points);
        let off = [0.0, 0.0, 0.25].iter().zip(&values).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 0.1 * report.cell_size, "{values:?}");
        let apart = [-Vec3::Y, Vec3::X, -Vec3::Y].into_iter().zip(&gradients).map(|(a, b)| a.distance(*b));
        assert!(apart.fold(0.0, f32::max) < 0.01, "{gradients:?}");
    }

    #[test]
    fn a_mesh_without_triangles_is_nowhere() {
        let mesh = Mesh::default();
        assert_eq!(MeshDistance::new(&mesh, |_: Vec3| 0.0).sdf(&[Vec3::ZERO]), [f32::INFINITY]);
    }
}
