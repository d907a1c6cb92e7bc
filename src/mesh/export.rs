//! What every file format asks of a mesh before it becomes bytes: sound indices, finite numbers,
//! unit normals, the right way up, the right size.
//!
//! The dataset's world stays untouched until here. glTF and OBJ are right-handed with +Y up, so a
//! capture with another `up` is turned once, in the vertices: `(x, y, z) → (x, z, −y)` for +Z up.

use crate::geom::Mesh;
use glam::{DMat3, DVec3, Vec3};

/// How a mesh leaves the dataset's world.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportOptions {
    /// What viewers call the object.
    pub name: String,
    /// Where up is in the dataset's world; any length but 0.
    pub up: Vec3,
    /// Metres per dataset unit.
    pub unit_m: f64,
    /// Do the colours already contain the light? Then viewers should not light them again.
    pub unlit: bool,
}

impl Default for ExportOptions {
    fn default() -> ExportOptions {
        ExportOptions { name: "head".into(), up: Vec3::Y, unit_m: 1.0, unlit: true }
    }
}

/// Why a mesh cannot become a file. Found before there are any bytes.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// No triangle with three different corners.
    #[error("the mesh has no triangles to write")]
    Empty,
    /// A triangle names a vertex that is not there.
    #[error("triangle {triangle} uses vertex {index}, but there are only {vertices}")]
    Index {
        /// Which triangle.
        triangle: usize,
        /// What it names.
        index: u32,
        /// How many vertices there are.
        vertices: usize,
    },
    /// A coordinate that is NaN or infinite, as it is or after turning and scaling.
    #[error("vertex {vertex} has the {what} {found}, which is not finite in single precision")]
    NotFinite {
        /// Which vertex.
        vertex: usize,
        /// `position` or `color`.
        what: &'static str,
        /// The value.
        found: String,
    },
    /// Normals or colours for some vertices only.
    #[error("{found} {what} for {expected} vertices")]
    Length {
        /// `normals` or `colors`.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there should be, if any.
        expected: usize,
    },
    /// An atlas for another mesh.
    #[error("the atlas has {found} triangles, the mesh {expected}")]
    AtlasLength {
        /// Triangles of the atlas.
        found: usize,
        /// Triangles of the mesh.
        expected: usize,
    },
    /// A triangle names a texture coordinate that is not there.
    #[error("triangle {triangle} uses texture coordinate {index}, but there are only {uvs}")]
    AtlasIndex {
        /// Which triangle.
        triangle: usize,
        /// What it names.
        index: u32,
        /// How many texture coordinates there are.
        uvs: usize,
    },
    /// A texture coordinate that is NaN or off the texture.
    #[error("texture coordinate {index} is {found}, expected 0 to 1 in both directions")]
    Uv {
        /// Which one.
        index: usize,
        /// Its value.
        found: String,
    },
    /// A picture that does not fit its own size, the atlas, or its encoder.
    #[error("the {what} is {found}, expected {expected}")]
    Picture {
        /// Which picture.
        what: String,
        /// What it is.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// An up direction without direction, or a unit without size.
    #[error("`{what}` is {found}, expected {expected}")]
    Option {
        /// Which option.
        what: &'static str,
        /// Its value.
        found: String,
        /// What it may be.
        expected: &'static str,
    },
    /// GLB counts its bytes in 32 bits.
    #[error("the file would have {bytes} bytes, but a GLB holds at most {}", u32::MAX)]
    TooLarge {
        /// How many it needs.
        bytes: u64,
    },
}

impl ExportError {
    /// The way out.
    pub fn hint(&self) -> &'static str {
        match self {
            ExportError::Empty => "train longer, or check the mask: an empty surface has no file",
            ExportError::Option { .. } => "set it in the configuration, or leave it to the capture",
            ExportError::TooLarge { .. } => "ask for fewer triangles, or write a .ply",
            ExportError::AtlasLength { .. } | ExportError::AtlasIndex { .. } | ExportError::Uv { .. } => {
                "the atlas is damaged or belongs to another mesh; unwrap it again"
            }
            ExportError::Picture { .. } => "bake it again, for this atlas",
            _ => "the mesh is damaged; extract it again",
        }
    }
}

/// A mesh that can be written: checked, turned and scaled.
pub(super) struct Ready {
    pub positions: Vec<Vec3>,
    /// Unit, or empty.
    pub normals: Vec<Vec3>,
    /// sRGB-coded, or empty.
    pub colors: Vec<[f32; 3]>,
    /// Without those that use a vertex twice.
    pub triangles: Vec<[u32; 3]>,
    /// To be added to every position; zero unless asked for and worth it.
    pub translation: Vec3,
}

/// Which offset from the origin, in sizes of the mesh, makes f32 lose visible precision.
const FAR_IN_SIZES: f64 = 64.0;

/// Checks, turns and scales. With `recentre`, a mesh far from the origin is written around its own
/// middle, and that middle comes back as `translation`.
pub(super) fn ready(mesh: &Mesh, turn: DMat3, unit_m: f64, recentre: bool) -> Result<Ready, ExportError> {
    let vertices = mesh.positions.len();
    for (triangle, t) in mesh.triangles.iter().enumerate() {
        if let Some(&index) = t.iter().find(|&&i| i as usize >= vertices) {
            return Err(ExportError::Index { triangle, index, vertices });
        }
    }
    for (what, found) in [("normals", mesh.normals.len()), ("colors", mesh.colors.len())] {
        if found != 0 && found != vertices {
            return Err(ExportError::Length { what, found, expected: vertices });
        }
    }
    let triangles: Vec<[u32; 3]> = mesh.triangles.iter().copied().filter(has_three_corners).collect();
    if triangles.is_empty() {
        return Err(ExportError::Empty);
    }
    let there = turn * unit_m;
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for p in &mesh.positions {
        let q = there * p.as_dvec3();
        (low, high) = (low.min(q), high.max(q));
    }
    let (center, size) = (0.5 * (low + high), (high - low).max_element());
    let far = recentre && center.abs().max_element() > FAR_IN_SIZES * size;
    let translation = if far { center.as_vec3() } else { Vec3::ZERO };
    let mut positions = Vec::with_capacity(vertices);
    for (vertex, p) in mesh.positions.iter().enumerate() {
        // + 0 turns −0 into 0, so that equal positions are equal bytes
        let q = (there * p.as_dvec3() - translation.as_dvec3()).as_vec3() + Vec3::ZERO;
        if !q.is_finite() || !translation.is_finite() {
            return Err(ExportError::NotFinite { vertex, what: "position", found: p.to_string() });
        }
        positions.push(q);
    }
    if let Some(vertex) = mesh.colors.iter().position(|c| !c.iter().all(|v| v.is_finite())) {
        let found = format!("{:?}", mesh.colors[vertex]);
        return Err(ExportError::NotFinite { vertex, what: "color", found });
    }
    let turned = |n: &Vec3| (turn * n.as_dvec3()).normalize_or_zero().as_vec3() + Vec3::ZERO;
    let mut normals: Vec<Vec3> = mesh.normals.iter().map(turned).collect();
    mend_normals(&mut normals, &positions, &triangles);
    Ok(Ready { positions, normals, colors: mesh.colors.clone(), triangles, translation })
}

/// Does a triangle name three different vertices? The others are not written.
pub(super) fn has_three_corners([a, b, c]: &[u32; 3]) -> bool {
    a != b && b != c && c != a
}

/// Gives every normal that is zero or not finite the area-weighted mean of its faces, or +Y.
fn mend_normals(normals: &mut [Vec3], positions: &[Vec3], triangles: &[[u32; 3]]) {
    // turned and normalised above: unit or zero, or NaN
    let bad: Vec<bool> = normals.iter().map(|n| *n == Vec3::ZERO || n.is_nan()).collect();
    if !bad.contains(&true) {
        return;
    }
    let mut sums = vec![DVec3::ZERO; normals.len()];
    for t in triangles {
        let [a, b, c] = t.map(|i| positions[i as usize].as_dvec3());
        for &i in t {
            sums[i as usize] += (b - a).cross(c - a);
        }
    }
    for i in 0..normals.len() {
        if bad[i] {
            normals[i] = sums[i].try_normalize().map_or(Vec3::Y, |n| n.as_vec3());
        }
    }
}

/// The smallest rotation that brings `up` to +Y; exact for the six axes.
pub(crate) fn turn_to_y_up(up: Vec3) -> Result<DMat3, ExportError> {
    let bad = || ExportError::Option {
        what: "up",
        found: up.to_string(),
        expected: "a direction, such as [0, 0, 1]",
    };
    let u = up.as_dvec3().try_normalize().ok_or_else(bad)?;
    let axis = DVec3::from_array(u.to_array().map(f64::round));
    let u = if u.distance(axis) < 1e-6 { axis } else { u };
    if u.y <= -1.0 + 1e-12 {
        return Ok(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
    }
    // Rodrigues with v = u × y, cos = u.y: R = I + [v]ₓ + [v]ₓ² / (1 + cos)
    let v = u.cross(DVec3::Y);
    let skew =
        DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0));
    Ok(DMat3::IDENTITY + skew + skew * skew * (1.0 / (1.0 + u.y)))
}

pub(super) fn check_unit(unit_m: f64) -> Result<(), ExportError> {
    if unit_m.is_finite() && unit_m > 0.0 {
        return Ok(());
    }
    Err(ExportError::Option {
        what: "unit_m",
        found: unit_m.to_string(),
        expected: "metres per unit, above 0",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> Mesh {
        Mesh { positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y], triangles: vec![[0, 1, 2]], ..Mesh::default() }
    }

    #[test]
    fn a_z_up_world_is_turned_by_exchanging_axes() {
        let p = DVec3::new(1.0, 2.0, 3.0);
        // (x, y, z) → (x, z, −y)
        assert_eq!(turn_to_y_up(Vec3::Z).unwrap() * p, DVec3::new(1.0, 3.0, -2.0));
        assert_eq!(turn_to_y_up(2.0 * Vec3::Y).unwrap() * p, p);
        assert_eq!(turn_to_y_up(Vec3::X).unwrap() * p, DVec3::new(-2.0, 1.0, 3.0));
        assert_eq!(turn_to_y_up(-Vec3::Z).unwrap() * p, DVec3::new(1.0, -3.0, 2.0));
        assert_eq!(turn_to_y_up(-Vec3::Y).unwrap() * p, DVec3::new(1.0, -2.0, -3.0));
    }

    #[test]
    fn any_up_goes_to_y_by_a_rotation() {
        for up in [Vec3::new(0.3, -0.9, 0.2), Vec3::new(1e-4, 0.0, 1.0), Vec3::new(0.01, -1.0, 0.0)] {
            let r = turn_to_y_up(up).unwrap();
            assert!((r * up.as_dvec3().normalize()).distance(DVec3::Y) < 1e-9);
            assert!((r.determinant() - 1.0).abs() < 1e-9);
            assert!((r * r.transpose() - DMat3::IDENTITY).to_cols_array().iter().all(|v| v.abs() < 1e-9));
        }
        assert!(turn_to_y_up(Vec3::ZERO).is_err());
        assert!(turn_to_y_up(Vec3::NAN).is_err());
    }

    #[test]
    fn a_mesh_that_is_empty_or_damaged_is_an_error_before_there_are_bytes() {
        let go = |m: &Mesh| ready(m, DMat3::IDENTITY, 1.0, true).map(|_| ());
        assert_eq!(go(&Mesh::default()), Err(ExportError::Empty));
        let folded = Mesh { triangles: vec![[0, 0, 1]], ..triangle() };
        assert_eq!(go(&folded), Err(ExportError::Empty));
        let outside = Mesh { triangles: vec![[0, 1, 3]], ..triangle() };
        assert!(matches!(go(&outside), Err(ExportError::Index { index: 3, vertices: 3, .. })));
        let mut nan = triangle();
        nan.positions[1].y = f32::NAN;
        assert!(matches!(go(&nan), Err(ExportError::NotFinite { vertex: 1, .. })));
        let short = Mesh { colors: vec![[0.0; 3]], ..triangle() };
        assert!(matches!(go(&short), Err(ExportError::Length { found: 1, expected: 3, .. })));
        assert!(matches!(
            ready(
                &Mesh { positions: vec![Vec3::ZERO, Vec3::splat(1e38), Vec3::Y], ..triangle() },
                DMat3::IDENTITY,
                1e3,
                false
            ),
            Err(ExportError::NotFinite { vertex: 1, .. })
        ));
        assert!(check_unit(0.0).is_err() && check_unit(f64::NAN).is_err() && check_unit(0.001).is_ok());
    }

    #[test]
    fn normals_come_out_unit_and_missing_ones_are_mended() {
        let mut m = triangle();
        m.normals = vec![Vec3::ZERO, Vec3::new(0.0, 0.0, 3.0), Vec3::NAN];
        let r = ready(&m, DMat3::IDENTITY, 1.0, false).unwrap();
        assert_eq!(r.normals, vec![Vec3::Z; 3]);
    }

    #[test]
    fn a_scene_ten_kilometres_away_keeps_its_millimetres() {
        let far = Vec3::new(10_000.0, 0.0, -10_000.0);
        let mut m = triangle();
        m.positions = vec![far, far + Vec3::X, far + Vec3::new(0.0, 0.25, 0.0)];
        let r = ready(&m, DMat3::IDENTITY, 1.0, true).unwrap();
        // the middle of the box
        assert_eq!(r.translation, Vec3::new(10_000.5, 0.125, -10_000.0));
        assert_eq!(r.positions[0], Vec3::new(-0.5, -0.125, 0.0));
        assert_eq!(ready(&m, DMat3::IDENTITY, 1.0, false).unwrap().positions, m.positions);
    }
}
