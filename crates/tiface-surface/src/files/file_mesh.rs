//! Preparation of a mesh for any file format: index checks, finite numbers, unit normals, the
//! file's up direction and unit.
//!
//! The dataset's world stays untouched until here. glTF and OBJ are right-handed with +Y up, so a
//! capture with another `up` is turned once, in the vertices: `(x, y, z) → (x, z, −y)` for +Z up.
//!
//! A scene may lie kilometers from its origin, where f32 steps over a whole head. So meshes come in
//! coordinates of their own with the way into the world in f64, and are prepared around their own
//! middle.
//!
//! `Mesh` and [`Atlas`](tiface_base::geom::Atlas) are indexed apart, as OBJ is: a vertex on a seam
//! has one position and several texture coordinates, and the surface stays closed. GLB and textured
//! PLY have one index for everything, so vertices are split where corners disagree. The copies are
//! bit-identical in position and normal: welding equal positions closes the surface again.
//!
//! All problems that prevent a mesh or a texture from being written are found before any bytes are
//! produced.

use super::head_texture::{HeadTexture, check_atlas};
use super::meshopt::in_cache_order;
use super::tangents::tangents_of;
use super::{DAMAGED, wrong_length};
use crate::check_indices;
use glam::{DMat3, DVec3, Vec2, Vec3, Vec4};
use std::collections::HashMap;
use std::path::Path;
use tiface_base::error::Cause;
use tiface_base::geom::{Mesh, ShellLayer, Similarity};
use tiface_base::image::Photo;
use tiface_base::{Error, Result, io};

/// Coordinates and names of an exported mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportOptions {
    /// The object's name in viewers.
    pub name: String,
    /// Base name of the files. Characters other than ASCII letters, digits, `-`, `_` and `.` become
    /// `_`, since readers of MTL take a space for the end of a name.
    pub stem: String,
    /// The up direction in the dataset's world; any length but 0.
    pub up: Vec3,
    /// Meters per dataset unit.
    pub unit_m: f64,
    /// Whether the colors already contain the light, so that viewers should not light them again.
    pub unlit: bool,
    /// The transform from the mesh's own coordinates into the dataset's world.
    pub world_from_mesh: Similarity,
    /// Quality, 1..=100, of colors stored as JPEG, which is smaller but lossy. `None` stores PNG,
    /// which is lossless; normal maps and lobes are always PNG.
    pub jpeg_quality: Option<u8>,
    /// Whether a GLB's arrays are compressed (`EXT_meshopt_compression`), which not every program
    /// reads: positions are rounded to a 65 534th of the longest side of the box, and lobes are
    /// half as fine.
    pub compress: bool,
}

impl Default for ExportOptions {
    fn default() -> ExportOptions {
        ExportOptions {
            name: "head".into(),
            stem: "head".into(),
            up: Vec3::Y,
            unit_m: 1.0,
            unlit: true,
            world_from_mesh: Similarity::IDENTITY,
            jpeg_quality: None,
            compress: false,
        }
    }
}

impl ExportOptions {
    /// Returns the transform from the mesh's own coordinates to meters with +Y up.
    pub fn file_from_mesh(&self) -> Result<Similarity> {
        if !(self.unit_m.is_finite() && self.unit_m > 0.0) {
            return Err(wrong_option("unit_m", self.unit_m, "meters per unit, above 0"));
        }
        let rotation = turn_to_y_up(self.up)?;
        let turned = Similarity { scale: self.unit_m, rotation, translation: DVec3::ZERO };
        Ok(turned.after(&self.world_from_mesh))
    }
}

/// Files that belong together, to be written side by side.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExportedFiles {
    /// Bare names and bytes; the mesh comes first.
    pub files: Vec<(String, Vec<u8>)>,
    /// Features that the format could not represent.
    pub warnings: Vec<String>,
}

/// A mesh ready to be written: checked, turned and scaled.
#[derive(Default)]
pub(super) struct FileMesh {
    pub positions: Vec<Vec3>,
    /// Unit, or empty.
    pub normals: Vec<Vec3>,
    /// sRGB-coded, or empty.
    pub colors: Vec<[f32; 3]>,
    /// Number of cameras that see each vertex, or empty.
    pub seen_by: Vec<u8>,
    /// The index of each vertex in the original mesh.
    pub source: Vec<u32>,
    /// The triangles, without those that use a vertex twice.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates, 0..=1; empty without a texture. Zeros are positive, so that equal
    /// coordinates have equal bytes.
    pub uvs: Vec<Vec2>,
    /// Indices into `uvs` for the corners of the triangles; empty once the mesh is split.
    pub corners: Vec<[u32; 3]>,
    /// Tangents, one for each vertex of a mesh that was split for a normal map, else empty.
    pub tangents: Vec<Vec4>,
    /// Offset of all positions, in f64; zero unless the mesh lies far from the origin. Every
    /// coordinate is representable as f32.
    pub translation: DVec3,
}

impl FileMesh {
    /// Checks, turns and scales a mesh with its texture. A mesh far from the origin is returned
    /// around its own center, with that center as `translation`.
    pub fn new(mesh: &Mesh, texture: Option<&HeadTexture>, file_from_mesh: &Similarity) -> Result<FileMesh> {
        let vertices = mesh.positions.len();
        texture.map_or(Ok(()), |t| check_atlas(mesh, &t.atlas))?;
        check_indices(mesh)?;
        let [normals, colors, seen_by] = [mesh.normals.len(), mesh.colors.len(), mesh.seen_by.len()];
        for (what, found) in [("normals", normals), ("colors", colors), ("numbers of cameras", seen_by)] {
            if found != 0 && found != vertices {
                return Err(wrong_length(found, what, vertices));
            }
        }
        let has_three_corners = |[a, b, c]: &[u32; 3]| a != b && b != c && c != a;
        let triangles: Vec<[u32; 3]> = mesh.triangles.iter().copied().filter(has_three_corners).collect();
        if triangles.is_empty() {
            let hint = "an empty surface has no file";
            return Err(
                Error::cannot("the mesh has no triangles to write", hint).with_cause(Cause::NoTriangles)
            );
        }
        let (center, _, far) = middle(placed_box(mesh, file_from_mesh));
        // rounded, so that readers in f32 and in f64 get the same value
        let translation = if far { center.as_vec3().as_dvec3() } else { DVec3::ZERO };
        let mut positions = Vec::with_capacity(vertices);
        for (vertex, p) in mesh.positions.iter().enumerate() {
            // + 0 turns −0 into 0, so that equal positions are equal bytes
            let q = (file_from_mesh.point_f64(p.as_dvec3()) - translation).as_vec3() + Vec3::ZERO;
            if !q.is_finite() || !translation.is_finite() {
                return Err(not_finite(vertex, "position", p.to_string()));
            }
            positions.push(q);
        }
        if let Some(vertex) = mesh.colors.iter().position(|c| !c.iter().all(|v| v.is_finite())) {
            return Err(not_finite(vertex, "color", format!("{:?}", mesh.colors[vertex])));
        }
        let turned =
            |n: &Vec3| (file_from_mesh.rotation * n.as_dvec3()).normalize_or_zero().as_vec3() + Vec3::ZERO;
        let mut normals: Vec<Vec3> = mesh.normals.iter().map(turned).collect();
        repair_normals(&mut normals, &positions, &triangles);
        let (mut uvs, mut corners) = (Vec::new(), Vec::new());
        if let Some(texture) = texture {
            texture.check_pictures()?;
            if texture.normal.is_some() && normals.is_empty() {
                return Err(wrong_length(0, "normals", vertices)); // nothing to be tangent to
            }
            let kept = mesh.triangles.iter().zip(&texture.atlas.triangles);
            corners = kept.filter(|(t, _)| has_three_corners(t)).map(|(_, c)| *c).collect();
            uvs = texture.atlas.uvs.iter().map(|&uv| uv + Vec2::ZERO).collect();
        }
        let (colors, seen_by) = (mesh.colors.clone(), mesh.seen_by.clone());
        let source = (0..vertices as u32).collect();
        let mut file =
            FileMesh { positions, normals, colors, seen_by, source, triangles, ..FileMesh::default() };
        (file.uvs, file.corners, file.translation) = (uvs, corners, translation);
        Ok(file)
    }

    /// Adds a copy of a vertex of another mesh, and returns its index.
    fn copy(&mut self, of: &FileMesh, vertex: u32) -> u32 {
        let v = vertex as usize;
        self.source.push(of.source[v]);
        self.positions.push(of.positions[v]);
        self.normals.extend(of.normals.get(v));
        self.colors.extend(of.colors.get(v));
        self.seen_by.extend(of.seen_by.get(v));
        self.positions.len() as u32 - 1
    }

    /// Returns whether f32 would lose visible precision at this mesh's position.
    pub fn is_far(&self) -> bool {
        self.translation != DVec3::ZERO
    }

    /// Returns a position with the translation added.
    pub fn translated(&self, position: Vec3) -> DVec3 {
        self.translation + position.as_dvec3()
    }

    /// Converts to a single index: vertices are split where corners disagree about the texture
    /// coordinate or, for a normal map, the tangent. Vertices come in the order of their first use;
    /// unused ones are left out. A mesh without a texture is unchanged.
    pub fn split(self, with_tangents: bool) -> FileMesh {
        if self.corners.is_empty() {
            return self;
        }
        let tangents = with_tangents
            .then(|| tangents_of(&self.positions, &self.normals, &self.triangles, &self.uvs, &self.corners));
        let mut out = FileMesh { translation: self.translation, ..FileMesh::default() };
        let mut known: HashMap<(u32, [u32; 2], [u32; 4]), u32> = HashMap::with_capacity(self.positions.len());
        for (t, (vertices, corner)) in self.triangles.iter().zip(&self.corners).enumerate() {
            let mut triangle = [0; 3];
            for k in 0..3 {
                let (vertex, uv) = (vertices[k], self.uvs[corner[k] as usize]);
                let tangent = tangents.as_ref().map(|all| all[t][k]);
                let bits = tangent.unwrap_or(Vec4::ZERO).to_array().map(f32::to_bits);
                let key = (vertex, uv.to_array().map(f32::to_bits), bits);
                triangle[k] = *known.entry(key).or_insert_with(|| {
                    out.uvs.push(uv);
                    out.tangents.extend(tangent);
                    out.copy(&self, vertex)
                });
            }
            out.triangles.push(triangle);
        }
        out
    }

    /// Returns the part of this mesh that has this soft layer. The mesh must have been split.
    pub fn under(&self, layer: &ShellLayer) -> FileMesh {
        let of_mesh = |t: &[u32; 3]| t.map(|v| self.source[v as usize]);
        self.part(self.triangles.iter().filter(|t| layer.has(&of_mesh(t))))
    }

    /// Returns the mesh with triangles in an order in which neighbors follow each other, and
    /// vertices in the order of their first use. The mesh must have been split.
    pub fn in_cache_order(&self) -> FileMesh {
        self.part(in_cache_order(&self.triangles, self.positions.len()).iter())
    }

    /// Returns a mesh of these triangles, with vertices in the order of their first use. The mesh
    /// must have been split.
    fn part<'a>(&self, triangles: impl Iterator<Item = &'a [u32; 3]>) -> FileMesh {
        let mut out = FileMesh { translation: self.translation, ..FileMesh::default() };
        let mut known = vec![u32::MAX; self.positions.len()];
        for triangle in triangles {
            let own = triangle.map(|v| {
                if known[v as usize] == u32::MAX {
                    out.uvs.extend(self.uvs.get(v as usize));
                    out.tangents.extend(self.tangents.get(v as usize));
                    known[v as usize] = out.copy(self, v);
                }
                known[v as usize]
            });
            out.triangles.push(own);
        }
        out
    }

    /// Returns the positions of a layer over this part of a mesh: `scale` converts lengths of the
    /// mesh to those of the file.
    pub fn moved(&self, layer: &ShellLayer, scale: f32) -> Vec<Vec3> {
        let offset = |v: &u32| scale * layer.offsets[*v as usize];
        let each = self.positions.iter().zip(&self.normals).zip(&self.source);
        each.map(|((p, n), source)| *p + offset(source) * *n).collect()
    }
}

/// Distance from the origin, in the mesh's own sizes, beyond which a mesh counts as far: up to it
/// f32 rounds by less than a millionth of the size.
const FAR_ORIGIN: f64 = 15.0;

/// Returns the box of a mesh in the file's coordinates.
fn placed_box(mesh: &Mesh, file_from_mesh: &Similarity) -> (DVec3, DVec3) {
    let empty = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let place = |p: &Vec3| file_from_mesh.point_f64(p.as_dvec3());
    mesh.positions.iter().map(place).fold(empty, |(low, high), q| (low.min(q), high.max(q)))
}

/// Returns center and size of a box, and whether it is far from the origin.
pub(super) fn middle((low, high): (DVec3, DVec3)) -> (DVec3, f64, bool) {
    let (center, size) = (0.5 * (low + high), (high - low).max_element());
    (center, size, center.abs().max_element() > FAR_ORIGIN * size)
}

/// Returns the warning for a mesh far from the origin in a format that keeps absolute positions:
/// the files hold enough digits, but many readers do not. `None` if no precision is lost.
pub(super) fn distance_warning(mesh: &Mesh, file_from_mesh: &Similarity, ending: &str) -> Option<String> {
    let (center, size, far) = middle(placed_box(mesh, file_from_mesh));
    let away = center.abs().max_element();
    // the distance between neighboring f32 values
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

/// Replaces every normal that is zero or not finite by the area-weighted mean of its faces, or +Y.
fn repair_normals(normals: &mut [Vec3], positions: &[Vec3], triangles: &[[u32; 3]]) {
    // already turned and normalized: unit, zero or NaN
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

/// Returns the smallest rotation that brings `up` to +Y; exact for the six axes.
fn turn_to_y_up(up: Vec3) -> Result<DMat3> {
    let u = up.as_dvec3().try_normalize();
    let u = u.ok_or_else(|| wrong_option("up", up, "a direction, such as [0, 0, 1]"))?;
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

/// Returns an encoded picture: its bytes and its file extension.
pub(super) fn encode(
    what: &str,
    picture: &Photo,
    jpeg_quality: Option<u8>,
) -> Result<(Vec<u8>, &'static str)> {
    let name = Path::new(what); // of no file yet
    match jpeg_quality {
        None => Ok((io::png_bytes(picture, name)?, "png")),
        Some(quality @ 1..=100) => Ok((io::jpeg_bytes(picture, quality, name)?, "jpg")),
        Some(quality) => Err(wrong_option("quality", quality, "1 to 100")),
    }
}

/// Returns a name, also for files, that every reader of OBJ and MTL understands.
pub(super) fn safe_name(name: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let name: String = name.trim().chars().map(safe).collect();
    // a leading dot hides a file, and `..` leaves the folder
    let name = name.trim_start_matches('.');
    if name.is_empty() { "mesh".into() } else { name.into() }
}

/// Returns warnings about the parts of a texture that a format of one picture leaves out.
pub(super) fn left_out(texture: Option<&HeadTexture>, ending: &str) -> Vec<String> {
    let mut warnings = Vec::new();
    if texture.is_some_and(|t| t.normal.is_some()) {
        warnings.push(format!("a .{ending} has no place for the normal map; it is in the .glb alone"));
    }
    warnings.extend(lobes_left_out(texture, ending));
    warnings
}

/// Returns a warning about lobes, which the format leaves out.
pub(super) fn lobes_left_out(texture: Option<&HeadTexture>, ending: &str) -> Option<String> {
    let lobes = texture.map_or(0, |t| t.lobe_pictures().len());
    (lobes > 0).then(|| {
        format!(
            "a .{ending} has no place for {lobes} textures that depend on the view; they are in the .glb alone"
        )
    })
}

/// Returns an error if a coordinate is NaN or infinite, before or after turning and scaling.
fn not_finite(vertex: usize, what: &str, found: String) -> Error {
    let what = format!("vertex {vertex} has the {what} {found}, which is not finite in single precision");
    Error::cannot(what, DAMAGED)
}

/// Returns an error for an up direction without direction, or a unit without size.
fn wrong_option(what: &str, found: impl ToString, expected: &str) -> Error {
    let hint = "correct it in the options";
    Error::cannot(format!("`{what}` is {}, expected {expected}", found.to_string()), hint)
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::head_texture::Lobes;
    use super::*;
    use tiface_base::geom::Atlas;

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
        let message = |m: &Mesh, place: &Similarity| FileMesh::new(m, None, place).err().unwrap().to_string();
        let at_home = |m: &Mesh| message(m, &Similarity::IDENTITY);
        assert_eq!(at_home(&Mesh::default()), "the mesh has no triangles to write");
        let folded = Mesh { triangles: vec![[0, 0, 1]], ..triangle() };
        assert_eq!(at_home(&folded), "the mesh has no triangles to write");
        let outside = Mesh { triangles: vec![[0, 1, 3]], ..triangle() };
        assert_eq!(at_home(&outside), "triangle 0 names vertex 3, but the mesh has 3");
        let mut nan = triangle();
        nan.positions[1].y = f32::NAN;
        assert!(at_home(&nan).ends_with("a coordinate that is not finite, the first is vertex 1"));
        let short = Mesh { colors: vec![[0.0; 3]], ..triangle() };
        assert_eq!(at_home(&short), "1 colors for 3 vertices");
        let large = Mesh { positions: vec![Vec3::ZERO, Vec3::splat(1e38), Vec3::Y], ..triangle() };
        let place = Similarity::scale_translate(1e3, DVec3::ZERO);
        assert!(message(&large, &place).starts_with("vertex 1 has the position"));
        let unit = |unit_m| ExportOptions { unit_m, ..ExportOptions::default() }.file_from_mesh();
        assert!(unit(0.0).is_err() && unit(f64::NAN).is_err() && unit(0.001).is_ok());
    }

    #[test]
    fn normals_come_out_unit_and_missing_ones_are_repaired() {
        let mut m = triangle();
        m.normals = vec![Vec3::ZERO, Vec3::new(0.0, 0.0, 3.0), Vec3::NAN];
        let r = FileMesh::new(&m, None, &Similarity::IDENTITY).unwrap();
        assert_eq!(r.normals, vec![Vec3::Z; 3]);
    }

    #[test]
    fn a_scene_ten_kilometers_away_keeps_its_millimeters() {
        let far = Vec3::new(10_000.0, 0.0, -10_000.0);
        let mut m = triangle();
        m.positions = vec![far, far + Vec3::X, far + Vec3::new(0.0, 0.25, 0.0)];
        let r = FileMesh::new(&m, None, &Similarity::IDENTITY).unwrap();
        // the middle of the box
        assert_eq!(r.translation, DVec3::new(10_000.5, 0.125, -10_000.0));
        assert_eq!(r.positions[0], Vec3::new(-0.5, -0.125, 0.0));
        assert_eq!(r.translated(r.positions[1]), (far + Vec3::X).as_dvec3());
    }

    #[test]
    fn only_what_is_far_is_warned_of_and_in_numbers() {
        let at = |x: f64| Similarity::scale_translate(0.25, DVec3::new(x, 0.0, 0.0));
        // half a unit wide: the middle of the box is 0.125 further
        assert_eq!(distance_warning(&triangle(), &at(3.0), "obj"), None);
        // f32 above 2²² has steps of a half
        let text = distance_warning(&triangle(), &at(5e6), "obj").unwrap();
        assert!(text.contains("the .obj lies 5.000e6") && text.contains("to 5.0e-1, 2.0e0 of its"), "{text}");
    }

    /// Returns a tetrahedron of which every face has a corner of the texture to itself, and its
    /// pictures.
    pub fn tetrahedron() -> (Mesh, HeadTexture) {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
            normals: vec![-Vec3::ONE.normalize(), Vec3::X, Vec3::Y, Vec3::Z],
            colors: vec![[0.0, 0.2, 0.4], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            ..Mesh::default()
        };
        let mut atlas = Atlas { width: 8, height: 4, ..Atlas::default() };
        for i in 0..4 {
            let low = Vec2::new((i % 2) as f32 * 0.5, (i / 2) as f32 * 0.5);
            let first = atlas.uvs.len() as u32;
            atlas.uvs.extend([low, low + Vec2::new(0.0, 0.375), low + Vec2::new(0.375, 0.0)]);
            atlas.triangles.push([first, first + 1, first + 2]);
        }
        let rgb = (0..32u8).map(|i| [i * 8, 255 - i, i]).collect();
        (mesh, HeadTexture::new(atlas, Photo { width: 8, height: 4, rgb, alpha: None }))
    }

    fn prepare(mesh: &Mesh, texture: &HeadTexture) -> Result<FileMesh> {
        FileMesh::new(mesh, Some(texture), &Similarity::IDENTITY)
    }

    #[test]
    fn a_seam_splits_vertices_into_bit_identical_copies() {
        let (mesh, texture) = tetrahedron();
        // every face is a chart: 4 · 3 corners, none shared
        let apart = prepare(&mesh, &texture).unwrap().split(false);
        assert_eq!((apart.positions.len(), apart.normals.len(), apart.uvs.len()), (12, 12, 12));
        for (t, s) in mesh.triangles.iter().zip(&apart.triangles) {
            for k in 0..3 {
                assert_eq!(apart.positions[s[k] as usize], mesh.positions[t[k] as usize]);
                assert_eq!(apart.colors[s[k] as usize], mesh.colors[t[k] as usize]);
            }
        }
        // one coordinate per vertex: nothing to split, though the atlas names each corner apart
        let shared = Atlas {
            uvs: mesh.triangles.iter().flatten().map(|&v| Vec2::splat(v as f32 / 4.0)).collect(),
            triangles: (0..4).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..texture.atlas
        };
        let shared = HeadTexture { atlas: shared, ..texture };
        assert_eq!(prepare(&mesh, &shared).unwrap().split(false).positions.len(), 4);
    }

    #[test]
    fn an_atlas_that_does_not_fit_is_an_error() {
        let (mesh, texture) = tetrahedron();
        let fails = |change: &dyn Fn(&mut HeadTexture)| {
            let mut texture = texture.clone();
            change(&mut texture);
            prepare(&mesh, &texture).err().map(|e| e.to_string())
        };
        let message = |change: &dyn Fn(&mut HeadTexture)| fails(change).unwrap();
        let short = |t: &mut HeadTexture| t.atlas.triangles.truncate(3);
        assert_eq!(message(&short), "the atlas has 3 triangles, the mesh 4");
        assert_eq!(
            message(&|t| t.atlas.triangles[2][1] = 12),
            "triangle 2 uses texture coordinate 12, but there are only 12"
        );
        for bad in [f32::NAN, -1e-6, 1.000_001, f32::INFINITY] {
            assert!(message(&|t| t.atlas.uvs[5].y = bad).starts_with("texture coordinate 5 is"), "{bad}");
        }
        assert_eq!(
            message(&|t| t.color.rgb.truncate(31)),
            "the base color is 31 pixels for 8 × 4, expected one for each, and at least one"
        );
        let square = Photo { width: 1, height: 1, rgb: vec![[0; 3]], alpha: None };
        assert!(message(&|t| t.color = square.clone()).contains("the shape of its atlas, 8 × 4"));
        let half = Photo { width: 2, height: 1, rgb: vec![[0; 3]; 2], alpha: None };
        assert_eq!(fails(&|t| t.color = half.clone()), None);
        // lobes may be coarser than the color, but all of them have one size
        let lobes = |t: &mut HeadTexture, pictures: &[&Photo]| {
            let pictures: Vec<Photo> = pictures.iter().map(|p| (*p).clone()).collect();
            let scale = vec![0.5; pictures.len()];
            t.lobes = Some(Lobes { pictures, scale, turned: glam::Mat3::IDENTITY });
        };
        assert_eq!(fails(&|t| lobes(t, &[&half, &half])), None);
        let mixed = message(&|t| lobes(t, &[&half, &t.color.clone()]));
        assert_eq!(mixed, "the texture `lobe 1` is 8 × 4 pixels, expected the size of the first, 2 × 1");
        let bare = Mesh { normals: vec![], ..mesh.clone() };
        let mapped = HeadTexture { normal: Some(texture.color.clone()), ..texture.clone() };
        assert_eq!(prepare(&bare, &mapped).err().unwrap().to_string(), "0 normals for 4 vertices");
    }

    #[test]
    fn folded_triangles_leave_mesh_and_atlas_together() {
        let (mut mesh, texture) = tetrahedron();
        mesh.triangles[1] = [0, 0, 3];
        let atlas = &texture.atlas;
        assert_eq!(
            prepare(&mesh, &texture).unwrap().corners,
            [atlas.triangles[0], atlas.triangles[2], atlas.triangles[3]]
        );
    }

    #[test]
    fn names_of_files_are_plain() {
        let safe = safe_name;
        assert_eq!(safe("my head/../Büste"), "my_head_.._B_ste");
        assert_eq!(
            (safe(".."), safe(""), safe("head-2.v")),
            ("mesh".into(), "mesh".into(), "head-2.v".into())
        );
    }

    #[test]
    fn pictures_are_stored_exactly_or_as_asked() {
        let color = tetrahedron().1.color;
        let limits = tiface_base::io::Limits::default();
        let path = std::path::Path::new("a");
        let (png, _) = encode("x", &color, None).unwrap();
        assert_eq!(tiface_base::io::parse_photo(&png, path, &limits).unwrap(), color);
        let (jpeg, ending) = encode("x", &color, Some(95)).unwrap();
        assert_eq!(ending, "jpg");
        assert_eq!(tiface_base::io::parse_photo(&jpeg, path, &limits).unwrap().width, 8);
        assert!(encode("x", &color, Some(0)).is_err());
    }
}
