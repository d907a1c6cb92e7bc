//! A triangle mesh with what the pipeline attaches to its vertices, and where its triangles lie in
//! its texture.

use super::aabb::Aabb;
use super::ray::Hit;
use super::similarity::Similarity;
use super::topology::topology;
use glam::Vec3;

/// Triangles over shared vertices, counter-clockwise seen from outside.
///
/// `normals`, `colors` and `seen_by` are either empty or as long as `positions`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertex positions.
    pub positions: Vec<Vec3>,
    /// Unit vertex normals, pointing out.
    pub normals: Vec<Vec3>,
    /// Vertex colors, sRGB-coded, 0..=1.
    pub colors: Vec<[f32; 3]>,
    /// Number of cameras that see each vertex, up to 255.
    pub seen_by: Vec<u8>,
    /// Vertex indices, three a triangle.
    pub triangles: Vec<[u32; 3]>,
}

/// Returns twice the area of a triangle along its normal.
#[inline]
pub fn area_vector([a, b, c]: [Vec3; 3]) -> Vec3 {
    (b - a).cross(c - a)
}

/// Returns the shape of a triangle, 1 for equilateral, 0 for none: `4 √3 area / Σ length²`.
#[inline]
pub fn shape([a, b, c]: [Vec3; 3]) -> f32 {
    let sum = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
    if sum > 0.0 { 2.0 * 3f32.sqrt() * area_vector([a, b, c]).length() / sum } else { 0.0 }
}

impl Mesh {
    /// Returns the box around all vertices.
    pub fn bounds(&self) -> Aabb {
        Aabb::around(self.positions.iter().copied())
    }

    /// Returns the three corners of a triangle.
    #[inline]
    pub fn corners(&self, triangle: u32) -> [Vec3; 3] {
        self.triangles[triangle as usize].map(|i| self.positions[i as usize])
    }

    /// Returns the area of a triangle, in f64.
    pub fn area(&self, triangle: u32) -> f64 {
        let [a, b, c] = self.corners(triangle).map(|p| p.as_dvec3());
        0.5 * (b - a).cross(c - a).length()
    }

    /// Watertight: every edge shared by exactly two triangles, oppositely wound. False where an
    /// index is out of range.
    pub fn is_closed(&self) -> bool {
        let count = self.positions.len();
        let in_range = self.triangles.as_flattened().iter().all(|&v| (v as usize) < count);
        in_range && topology(&self.positions, &self.triangles).closed
    }

    /// Unit vertex normals, weighted by the angles of the triangles at each vertex (Thürmer,
    /// Wüthrich 1998); +z where all of them are degenerate.
    pub fn angle_weighted_normals(&self) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO; self.positions.len()];
        for t in &self.triangles {
            let normal = area_vector(t.map(|v| self.positions[v as usize])).normalize_or_zero();
            for k in 0..3 {
                let [p, q, r] = [0, 1, 2].map(|o| self.positions[t[(k + o) % 3] as usize]);
                let (u, v) = ((q - p).normalize_or_zero(), (r - p).normalize_or_zero());
                sums[t[k] as usize] += u.dot(v).clamp(-1.0, 1.0).acos() * normal;
            }
        }
        sums.into_iter().map(|n| n.normalize_or(Vec3::Z)).collect()
    }

    /// Enclosed volume, signed: positive when triangles are wound outward. f64 sum.
    pub fn signed_volume(&self) -> f64 {
        let sum: f64 = (0..self.triangles.len() as u32)
            .map(|t| {
                let [a, b, c] = self.corners(t).map(|p| p.as_dvec3());
                a.dot(b.cross(c))
            })
            .sum();
        sum / 6.0
    }

    /// Returns the unit normal of a point of a triangle, interpolated between its vertices; `None`
    /// without normals, or where they cancel.
    #[inline]
    pub fn normal_at(&self, hit: &Hit) -> Option<Vec3> {
        let corners = self.triangles[hit.triangle as usize];
        hit.mix(corners.map(|v| self.normals.get(v as usize).copied().unwrap_or_default())).try_normalize()
    }

    /// Returns the same, or the triangle's own normal.
    #[inline]
    pub fn shading_normal(&self, hit: &Hit) -> Vec3 {
        self.normal_at(hit).unwrap_or_else(|| area_vector(self.corners(hit.triangle)).normalize_or_zero())
    }

    /// Returns the position of a point of a triangle.
    #[inline]
    pub fn point_at(&self, hit: &Hit) -> Vec3 {
        hit.mix(self.corners(hit.triangle))
    }

    /// Returns the color of a point of a triangle, interpolated between its vertices; black without
    /// colors.
    #[inline]
    pub fn color_at(&self, hit: &Hit) -> [f32; 3] {
        let color = |v: u32| Vec3::from(self.colors.get(v as usize).copied().unwrap_or_default());
        hit.mix(self.triangles[hit.triangle as usize].map(color)).to_array()
    }

    /// Drops vertices no triangle uses.
    pub fn drop_unused_vertices(&mut self) {
        let mut to = vec![u32::MAX; self.positions.len()];
        self.triangles.iter().flatten().for_each(|&v| to[v as usize] = 0);
        for (next, slot) in to.iter_mut().filter(|s| **s == 0).enumerate() {
            *slot = next as u32;
        }
        self.triangles.iter_mut().flatten().for_each(|v| *v = to[*v as usize]);
        fn pick<T>(of: &mut Vec<T>, to: &[u32]) {
            let mut slots = to.iter();
            of.retain(|_| slots.next().is_some_and(|&s| s != u32::MAX));
        }
        pick(&mut self.positions, &to);
        pick(&mut self.normals, &to);
        pick(&mut self.colors, &to);
        pick(&mut self.seen_by, &to);
    }

    /// Returns the same mesh in another coordinate system.
    pub fn transformed(&self, b_from_a: &Similarity) -> Mesh {
        Mesh {
            positions: self.positions.iter().map(|&p| b_from_a.point(p)).collect(),
            normals: self.normals.iter().map(|&n| b_from_a.direction(n).normalize_or_zero()).collect(),
            colors: self.colors.clone(),
            seen_by: self.seen_by.clone(),
            triangles: self.triangles.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tetrahedron() -> Mesh {
        Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            ..Mesh::default()
        }
    }

    #[test]
    fn a_tetrahedron_is_closed_and_has_a_sixth_of_the_cube() {
        let m = tetrahedron();
        assert!(m.is_closed());
        assert!((m.signed_volume() - 1.0 / 6.0).abs() < 1e-7);
    }

    #[test]
    fn vertex_normals_of_an_octahedron_point_away_from_its_middle() {
        let m = Mesh {
            positions: vec![Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z],
            triangles: vec![
                [0, 1, 2],
                [1, 3, 2],
                [3, 4, 2],
                [4, 0, 2],
                [1, 0, 5],
                [3, 1, 5],
                [4, 3, 5],
                [0, 4, 5],
            ],
            ..Mesh::default()
        };
        let n = m.angle_weighted_normals();
        assert!(n.iter().zip(&m.positions).all(|(n, p)| n.distance(*p) < 1e-6));
    }

    #[test]
    fn a_missing_or_turned_face_opens_it() {
        let mut m = tetrahedron();
        m.triangles[0].swap(0, 1);
        assert!(!m.is_closed());
        m.triangles.remove(0);
        assert!(!m.is_closed());
        assert!(!Mesh::default().is_closed());
        let mut m = tetrahedron();
        m.positions.pop();
        assert!(!m.is_closed());
    }
}
