//! Where the triangles of a mesh lie in its texture.

use glam::Vec2;

/// Texture coordinates, indexed apart from the vertices: a vertex on a seam has several.
///
/// glTF's convention: the origin is the texture's top left corner, v runs down, and the centre of the texel
/// in column i and row j is at ((i + 0.5) / width, (j + 0.5) / height).
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
    /// The corners of a triangle, in texels: (0, 0) is the top left corner of the top left texel.
    pub fn corners(&self, triangle: u32) -> [Vec2; 3] {
        let size = Vec2::new(self.width as f32, self.height as f32);
        self.triangles[triangle as usize].map(|i| self.uvs[i as usize] * size)
    }
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
