//! What every file format asks of a mesh before it becomes bytes: sound indices, finite numbers,
//! unit normals, the right way up, the right size.
//!
//! The dataset's world stays untouched until here. glTF and OBJ are right-handed with +Y up, so a
//! capture with another `up` is turned once, in the vertices: `(x, y, z) → (x, z, −y)` for +Z up.
//!
//! A scene may lie kilometres from its origin, where f32 steps over a whole head. So meshes come in
//! coordinates of their own with the way into the world in f64, and are made ready around their own middle.

use crate::geom::{Mesh, Similarity};
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
    /// From the mesh's own coordinates into the dataset's world.
    pub world_from_mesh: Similarity,
}

impl Default for ExportOptions {
    fn default() -> ExportOptions {
        ExportOptions {
            name: "head".into(),
            up: Vec3::Y,
            unit_m: 1.0,
            unlit: true,
            world_from_mesh: Similarity::IDENTITY,
        }
    }
}

impl ExportOptions {
    /// From the mesh's own coordinates to metres with +Y up.
    pub(super) fn file_from_mesh(&self) -> Result<Similarity, ExportError> {
        check_unit(self.unit_m)?;
        let rotation = turn_to_y_up(self.up)?;
        let turned = Similarity { scale: self.unit_m, rotation, translation: DVec3::ZERO };
        Ok(turned.after(&self.world_from_mesh))
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

crate::error::error_from!(ExportError, Cannot);

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
    /// To be added to every position, in f64; zero unless the mesh lies far from the origin. Every
    /// coordinate is a number of f32.
    pub translation: DVec3,
}

impl Ready {
    /// Does f32 lose visible precision where this mesh lies?
    pub fn is_far(&self) -> bool {
        self.translation != DVec3::ZERO
    }

    /// Where a position really is.
    pub fn place(&self, position: Vec3) -> DVec3 {
        self.translation + position.as_dvec3()
    }
}

/// From how many of its own sizes away on a mesh counts as far: up to there f32 rounds by less than a
/// millionth of the size.
const FAR_IN_SIZES: f64 = 15.0;

/// The box of a mesh where it goes.
fn placed_box(mesh: &Mesh, file_from_mesh: &Similarity) -> (DVec3, DVec3) {
    let empty = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let place = |p: &Vec3| file_from_mesh.point_f64(p.as_dvec3());
    mesh.positions.iter().map(place).fold(empty, |(low, high), q| (low.min(q), high.max(q)))
}

/// Middle and size of a box, and whether it is far from the origin.
pub(super) fn middle((low, high): (DVec3, DVec3)) -> (DVec3, f64, bool) {
    let (center, size) = (0.5 * (low + high), (high - low).max_element());
    (center, size, center.abs().max_element() > FAR_IN_SIZES * size)
}

/// What becomes of a mesh far from the origin in a format that keeps every vertex where it is: the files hold
/// enough digits, but many readers do not. `None` where nothing is lost.
pub fn distance_warning(mesh: &Mesh, options: &ExportOptions, ending: &str) -> Option<String> {
    let (center, size, far) = middle(placed_box(mesh, &options.file_from_mesh().ok()?));
    let away = center.abs().max_element();
    // the distance between neighbouring numbers of f32
    let step = 2f64.powf(away.log2().floor() - 23.0);
    (far && away.is_finite()).then(|| {
        format!(
            "the .{ending} lies {away:.3e} from the origin, {:.1e} times its own size: readers in single precision \
             round its vertices to {step:.1e}, {:.1e} of its size; the .glb is written around its own middle",
            away / size,
            step / size
        )
    })
}

/// Checks, turns and scales. A mesh far from the origin comes back around its own middle, with that middle as
/// `translation`.
pub(super) fn ready(mesh: &Mesh, file_from_mesh: &Similarity) -> Result<Ready, ExportError> {
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
    let (center, _, far) = middle(placed_box(mesh, file_from_mesh));
    // rounded, so that those who keep it in f32 and those who do not have the same
    let translation = if far { center.as_vec3().as_dvec3() } else { DVec3::ZERO };
    let mut positions = Vec::with_capacity(vertices);
    for (vertex, p) in mesh.positions.iter().enumerate() {
        // + 0 turns −0 into 0, so that equal positions are equal bytes
        let q = (file_from_mesh.point_f64(p.as_dvec3()) - translation).as_vec3() + Vec3::ZERO;
        if !q.is_finite() || !translation.is_finite() {
            return Err(ExportError::NotFinite { vertex, what: "position", found: p.to_string() });
        }
        positions.push(q);
    }
    if let Some(vertex) = mesh.colors.iter().position(|c| !c.iter().all(|v| v.is_finite())) {
        let found = format!("{:?}", mesh.colors[vertex]);
        return Err(ExportError::NotFinite { vertex, what: "color", found });
    }
    let turned =
        |n: &Vec3| (file_from_mesh.rotation * n.as_dvec3()).normalize_or_zero().as_vec3() + Vec3::ZERO;
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
        let go = |m: &Mesh| ready(m, &Similarity::IDENTITY).map(|_| ());
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
                &Similarity::scale_translate(1e3, DVec3::ZERO),
            ),
            Err(ExportError::NotFinite { vertex: 1, .. })
        ));
        assert!(check_unit(0.0).is_err() && check_unit(f64::NAN).is_err() && check_unit(0.001).is_ok());
    }

    #[test]
    fn normals_come_out_unit_and_missing_ones_are_mended() {
        let mut m = triangle();
        m.normals = vec![Vec3::ZERO, Vec3::new(0.0, 0.0, 3.0), Vec3::NAN];
        let r = ready(&m, &Similarity::IDENTITY).unwrap();
        assert_eq!(r.normals, vec![Vec3::Z; 3]);
    }

    #[test]
    fn a_scene_ten_kilometres_away_keeps_its_millimetres() {
        let far = Vec3::new(10_000.0, 0.0, -10_000.0);
        let mut m = triangle();
        m.positions = vec![far, far + Vec3::X, far + Vec3::new(0.0, 0.25, 0.0)];
        let r = ready(&m, &Similarity::IDENTITY).unwrap();
        // the middle of the box
        assert_eq!(r.translation, DVec3::new(10_000.5, 0.125, -10_000.0));
        assert_eq!(r.positions[0], Vec3::new(-0.5, -0.125, 0.0));
        assert_eq!(r.place(r.positions[1]), (far + Vec3::X).as_dvec3());
    }

    #[test]
    fn only_what_is_far_is_warned_of_and_in_numbers() {
        let at = |x: f64| ExportOptions {
            world_from_mesh: Similarity::scale_translate(0.25, DVec3::new(x, 0.0, 0.0)),
            ..ExportOptions::default()
        };
        // half a unit wide: the middle of the box is 0.125 further
        assert_eq!(distance_warning(&triangle(), &at(3.0), "obj"), None);
        // f32 above 2²² has steps of a half
        let text = distance_warning(&triangle(), &at(5e6), "obj").unwrap();
        assert!(text.contains("the .obj lies 5.000e6") && text.contains("to 5.0e-1, 2.0e0 of its"), "{text}");
    }
}
