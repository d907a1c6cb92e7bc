//! Display modes of a mesh: its color, or a visualization of its shape, normals or texture
//! coordinates.

use super::hits::RayHits;
use super::texture::MeshTexture;
use glam::{Vec2, Vec3};
use tiface_base::geom::{Atlas, Camera, Harmonics, Hit, Mesh};
use tiface_base::image::{linear_from_srgb, srgb_from_linear};

/// sRGB-coded color of a surface that has no color of its own.
const GRAY: [f32; 3] = [0.8; 3];

/// Squares of the checker along each side of a texture.
const CHECKER_SQUARES: f32 = 32.0;

/// sRGB-coded colors of a surface that no camera sees, one, two, and three or more; their
/// brightness rises, too. The viewer of pages has the same.
const SEEN_BY: [[f32; 3]; 4] = [[0.55, 0.1, 0.15], [0.85, 0.45, 0.1], [0.95, 0.8, 0.3], [0.75, 0.9, 0.8]];

/// Lamps that follow the camera: direction (right, up, to the viewer; not unit) and brightness.
/// Key, fill and rim.
const LAMPS: [([f32; 3], f32); 3] =
    [([-0.6, 0.7, 0.8], 0.75), ([0.9, 0.1, 0.6], 0.25), ([0.3, 0.8, -0.8], 0.3)];

/// Ambient light.
const AMBIENT: f32 = 0.18;

/// Half the width of a line of the wireframe, pixels.
const LINE_HALF_WIDTH_PX: f32 = 0.4;

/// Triangles lower than this many pixels get fainter lines.
const FADE_HEIGHT_PX: f32 = 8.0;

/// The display mode of a surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Look {
    /// Color under three lamps.
    Studio,
    /// Color as it is stored.
    Unlit,
    /// Normals in camera coordinates: right red, up green, to the viewer blue.
    Normals,
    /// Shape, shaded as clay.
    Matcap,
    /// Texture coordinates, as a checker.
    Uv,
    /// Triangles, as a wireframe.
    Wire,
    /// Number of cameras that see the surface: none, 1, 2, 3 and more.
    Seen,
}

impl Look {
    /// All looks.
    pub const ALL: [Look; 7] =
        [Look::Studio, Look::Unlit, Look::Normals, Look::Matcap, Look::Uv, Look::Wire, Look::Seen];

    /// Returns whether the soft layers are shown too. They have a color and no shape of their own.
    pub fn has_layers(self) -> bool {
        matches!(self, Look::Studio | Look::Unlit)
    }

    /// Returns whether the look needs only the color of a hit, not its point and normal.
    pub fn is_bare(self) -> bool {
        matches!(self, Look::Unlit | Look::Uv | Look::Seen)
    }

    /// Returns the look's name on the command line.
    pub fn word(self) -> &'static str {
        ["studio", "unlit", "normals", "matcap", "uv", "wire", "seen"][self as usize]
    }
}

/// A surface with all its color data.
#[derive(Clone, Copy)]
pub struct Surface<'a> {
    /// The triangles, with normals, and colors at the vertices.
    pub mesh: &'a Mesh,
    /// Its texture.
    pub texture: Option<&'a MeshTexture>,
    /// The texture coordinates, with or without a texture.
    pub atlas: Option<&'a Atlas>,
    /// View-dependent color at the vertices, for a surface without a texture.
    pub harmonics: Option<&'a Harmonics>,
}

impl Surface<'_> {
    /// Returns the sRGB-coded colors of the hits of a camera.
    pub fn colors(&self, hits: &RayHits, camera: &Camera) -> Vec<[f32; 3]> {
        if let Some(texture) = self.texture {
            return texture.smooth_colors(hits, camera);
        }
        let mesh = self.mesh;
        let bare = mesh.colors.is_empty();
        let color = |(hit, &direction)| {
            let color = if bare { GRAY } else { mesh.color_at(hit) };
            match self.harmonics {
                None => color,
                Some(h) => {
                    let more = h.seen_along(direction, hit, mesh.triangles[hit.triangle as usize]);
                    std::array::from_fn(|k| (color[k] + more[k]).clamp(0.0, 1.0))
                }
            }
        };
        hits.hits.iter().zip(&hits.directions).map(color).collect()
    }

    /// Returns the colors of the hits in a look.
    pub fn shown(&self, look: Look, hits: &RayHits, camera: &Camera) -> Vec<[f32; 3]> {
        let from_world = camera.rotation.transpose().as_mat3();
        // in camera coordinates; if the surface is seen from behind, the normal of the visible side
        let normals = || {
            hits.normals
                .iter()
                .zip(&hits.directions)
                .map(move |(&n, &d)| from_world * if n.dot(d) > 0.0 { -n } else { n })
        };
        match look {
            Look::Unlit => self.colors(hits, camera),
            Look::Studio => {
                self.colors(hits, camera).into_iter().zip(normals()).map(|(c, n)| lit(c, n)).collect()
            }
            Look::Normals => normals().map(|n| (0.5 + 0.5 * n).to_array()).collect(),
            Look::Matcap => normals().map(clay).collect(),
            Look::Uv => (0..hits.hits.len()).map(|i| self.checker(hits, i)).collect(),
            Look::Seen => hits.hits.iter().map(|hit| self.seen(hit)).collect(),
            Look::Wire => {
                let on_line = |(i, n): (usize, Vec3)| {
                    let shade = 0.75 + 0.25 * n.z;
                    let line = self.line(hits, i, camera);
                    [0.93, 0.94, 0.96].map(|c: f32| shade * c * (1.0 - line) + 0.12 * line)
                };
                normals().enumerate().map(on_line).collect()
            }
        }
    }

    /// Returns the color that says how many cameras see a point; gray where the mesh does not know.
    fn seen(&self, hit: &Hit) -> [f32; 3] {
        let number = |v: u32| self.mesh.seen_by.get(v as usize).map(|&n| f32::from(n.min(3)));
        match self.mesh.triangles[hit.triangle as usize].map(number) {
            [Some(a), Some(b), Some(c)] => SEEN_BY[hit.mix([a, b, c]).round() as usize],
            _ => GRAY,
        }
    }

    fn uv(&self, hits: &RayHits, i: usize) -> Option<Vec2> {
        let (atlas, hit) = (self.atlas?, &hits.hits[i]);
        Some(hit.mix(atlas.triangles[hit.triangle as usize].map(|i| atlas.uvs[i as usize])))
    }

    /// Returns a checker that runs from red to green along u and from dark to light along v (down
    /// the texture).
    fn checker(&self, hits: &RayHits, i: usize) -> [f32; 3] {
        let Some(uv) = self.uv(hits, i) else { return GRAY };
        let square = (uv * CHECKER_SQUARES).floor();
        let dark = (square.x + square.y).rem_euclid(2.0) > 0.5;
        let c = [uv.x, 1.0 - uv.x, uv.y].map(|v| 0.35 + 0.6 * v.rem_euclid(1.0));
        c.map(|v| if dark { 0.55 * v } else { v })
    }

    /// Returns the coverage of a wireframe line at a point, 0..=1.
    fn line(&self, hits: &RayHits, i: usize, camera: &Camera) -> f32 {
        let hit = &hits.hits[i];
        let [a, b, c] = self.mesh.corners(hit.triangle);
        let pixel = hit.t * hits.directions[i].dot(camera.forward()) / camera.fx.abs() as f32;
        let area = (b - a).cross(c - a).length();
        // the distance to a side is the opposite corner's share times its height
        let [of_a, of_b, of_c] = hit.weights();
        let sides = [(of_a, c - b), (of_b, c - a), (of_c, b - a)];
        let heights = sides.map(|(share, side)| (share, area / side.length().max(1e-20) / pixel.max(1e-20)));
        let nearest = heights.iter().map(|(share, height)| share * height).fold(f32::INFINITY, f32::min);
        let low = heights.iter().map(|(_, height)| *height).fold(f32::INFINITY, f32::min);
        // lines of triangles as small as pixels would fill the picture
        (LINE_HALF_WIDTH_PX + 0.5 - nearest).clamp(0.0, 1.0) * (low / FADE_HEIGHT_PX).clamp(0.2, 1.0)
    }
}

/// Shades a color under the lamps; `n` is in camera coordinates.
fn lit(color: [f32; 3], n: Vec3) -> [f32; 3] {
    let lamps = LAMPS.iter().map(|(at, power)| power * n.dot(Vec3::from(*at).normalize()).max(0.0));
    let light = AMBIENT + lamps.sum::<f32>();
    color.map(|c| srgb_from_linear(linear_from_srgb(c) * light))
}

/// Returns the color of a clay that is warm in the light and cool in the shade, with a soft shine.
fn clay(n: Vec3) -> [f32; 3] {
    let toward = |i: usize| n.dot(Vec3::from(LAMPS[i].0).normalize());
    let key = (0.5 + 0.5 * toward(0)).powi(2);
    let shine = 0.25 * toward(0).max(0.0).powi(24);
    let rim = 0.15 * (1.0 - n.z.clamp(0.0, 1.0)).powi(3);
    [0.80, 0.62, 0.52].map(|c: f32| srgb_from_linear(c * (0.08 + 0.9 * key) + shine + rim))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_color_says_how_many_cameras_see_a_point() {
        let mut mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2]],
            seen_by: vec![0, 2, 200],
            ..Mesh::default()
        };
        let color = |mesh: &Mesh, u: f32, v: f32| {
            let surface = Surface { mesh, texture: None, atlas: None, harmonics: None };
            surface.seen(&Hit { t: 1.0, triangle: 0, u, v })
        };
        let at_corners = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.0)].map(|(u, v)| color(&mesh, u, v));
        assert_eq!(at_corners, [SEEN_BY[0], SEEN_BY[2], SEEN_BY[3], SEEN_BY[1]]);
        mesh.seen_by.clear();
        assert_eq!(color(&mesh, 0.2, 0.2), GRAY);
    }
}
