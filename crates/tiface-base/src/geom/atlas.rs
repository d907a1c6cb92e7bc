//! Where the triangles of a mesh lie in its texture.

use glam::Vec2;

/// Texture coordinates, indexed apart from the vertices: a vertex on a seam has several.
///
/// glTF's convention: the origin is the texture's top left corner, v runs down, and the center of
/// the texel in column i and row j is at ((i + 0.5) / width, (j + 0.5) / height).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Atlas {
    /// Coordinates, 0..=1.
    pub uvs: Vec<Vec2>,
    /// Indices into `uvs`, triangle by triangle and corner by corner those of `Mesh::triangles`.
    pub triangles: Vec<[u32; 3]>,
    /// Texels across.
    pub width: u32,
    /// Texels down.
    pub height: u32,
}

impl Atlas {
    /// Returns the corners of a triangle, in texels: (0, 0) is the top left corner of the top left
    /// texel.
    #[inline]
    pub fn corners(&self, triangle: u32) -> [Vec2; 3] {
        let size = Vec2::new(self.width as f32, self.height as f32);
        self.triangles[triangle as usize].map(|i| self.uvs[i as usize] * size)
    }
}

/// Returns the texels that a bilinear look-up mixes, row-major, and their weights. `at` is in
/// texels, whose centers are at whole numbers here; beyond the border the picture continues.
#[inline]
pub fn bilinear_taps(at: Vec2, [width, height]: [u32; 2]) -> [(u32, f32); 4] {
    let along = |p: f32, n: u32| {
        let p = p.clamp(0.0, (n - 1) as f32);
        (p as u32, (p as u32 + 1).min(n - 1), p.fract())
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (along(at.x, width), along(at.y, height));
    [
        (y0 * width + x0, (1.0 - fx) * (1.0 - fy)),
        (y0 * width + x1, fx * (1.0 - fy)),
        (y1 * width + x0, (1.0 - fx) * fy),
        (y1 * width + x1, fx * fy),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_are_in_texels() {
        let atlas = Atlas {
            uvs: vec![Vec2::ZERO, Vec2::X, Vec2::splat(0.5)],
            triangles: vec![[0, 1, 2]],
            width: 4,
            height: 2,
        };
        assert_eq!(atlas.corners(0), [Vec2::ZERO, Vec2::new(4.0, 0.0), Vec2::new(2.0, 1.0)]);
    }
}
