//! Color at the vertices of a mesh that changes with the direction of view.

use super::ray::Hit;
use super::sphharm::combine;
use glam::{Mat3, Vec3};

/// Spherical harmonics of the direction to the viewer at the vertices of a mesh, to be added to its
/// base color.
#[derive(Clone, Debug, PartialEq)]
pub struct Harmonics {
    /// Functions a vertex, 1, 4 or 9: those of [`sh16`](super::sphharm::sh16) up to a degree.
    pub functions: usize,
    /// `[vertices, functions]` coefficients, sRGB-coded.
    pub coefficients: Vec<[f32; 3]>,
    /// Turns directions of the mesh's coordinates into those of the harmonics.
    pub turned: Mat3,
}

impl Harmonics {
    /// Returns what is added where a ray along the unit `direction`, away from the camera, met the
    /// triangle of these vertices.
    #[inline]
    pub fn seen_along(&self, direction: Vec3, hit: &Hit, triangle: [u32; 3]) -> [f32; 3] {
        let d = (self.turned * -direction).to_array();
        let of = |v: u32| &self.coefficients[v as usize * self.functions..][..self.functions];
        hit.mix(triangle.map(|v| Vec3::from(combine(of(v), d)))).to_array()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_corner_shows_its_own_color_in_the_direction_it_is_seen_from() {
        // -0.4886 x is the fourth function: red towards -x at the second vertex, nothing at the
        // others
        let mut coefficients = vec![[0.0; 3]; 12];
        coefficients[4 + 3] = [1.0, 0.0, 0.0];
        let quarter = Mat3::from_rotation_z(std::f32::consts::FRAC_PI_2); // y -> -x
        let harmonics = Harmonics { functions: 4, coefficients, turned: quarter };
        let hit = |u: f32, v: f32| Hit { t: 1.0, triangle: 0, u, v };
        // seen along -y: the viewer is at +y, turned to -x
        let at = |u: f32, v: f32, d: Vec3| harmonics.seen_along(d, &hit(u, v), [0, 1, 2])[0];
        assert!((at(1.0, 0.0, Vec3::NEG_Y) - 0.488_602_5).abs() < 1e-6);
        assert!((at(0.25, 0.5, Vec3::NEG_Y) - 0.25 * 0.488_602_5).abs() < 1e-6);
        assert!((at(1.0, 0.0, Vec3::Y) + 0.488_602_5).abs() < 1e-6);
        assert_eq!(at(0.0, 1.0, Vec3::NEG_Y), 0.0);
    }
}
