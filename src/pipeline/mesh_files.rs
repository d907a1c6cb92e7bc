//! The files of a head mesh: in which formats and coordinates, of which unit, name and material.

use super::advice::advised;
use super::frames::{Frames, MeshFrame, center, front};
use crate::config::{Config, MeshFormat};
use glam::{DMat3, DVec3, Vec3};
use tiface_base::Result;
use tiface_base::geom::{Mesh, Similarity};
use tiface_capture::Capture;
use tiface_surface::AtlasConfig;
use tiface_surface::files::{ExportOptions, ExportedFiles, HeadMesh, to_glb, to_obj, to_ply, to_usdz};

/// What light does to the mesh in other programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Material {
    /// Nothing: the photographs' light is in its colors already.
    Unlit,
    /// It shades a rough surface that is no metal.
    Lit,
}

/// The quality of textures that are stored as JPEG.
const JPEG_QUALITY: u8 = 92;

/// Returns the least and the largest of some values.
fn extent(values: impl Iterator<Item = f32>) -> (f32, f32) {
    values.fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(v), high.max(v)))
}

/// Width over that of the head from which on the lower part of a mesh is shoulders.
const SHOULDERS: f32 = 1.25;

/// How a mesh is exported from the dataset's world.
#[derive(Clone, Debug)]
pub struct Export {
    /// The name that viewers show.
    pub name: String,
    /// The up direction in the world.
    pub up: Vec3,
    /// Meters per dataset unit.
    pub unit_m: f64,
    /// Meters per unit of an OBJ, which states none.
    pub obj_unit_m: f64,
    /// The coordinate frame of the files.
    pub frame: MeshFrame,
    /// Whether the color is stored as JPEG, not PNG.
    pub jpeg: bool,
    /// Whether a GLB is compressed.
    pub compress: bool,
    /// The material of GLB and USDZ, lit or unlit.
    pub material: Material,
    /// Camera positions in the world; a face is assumed to look at the cameras.
    pub cameras: Vec<DVec3>,
}

impl Export {
    /// Returns how the stage `mesh` exports the head of a capture.
    pub fn new(capture: &Capture, config: &Config) -> Export {
        Export {
            unit_m: config.capture.unit_m,
            cameras: capture.views.iter().map(|v| v.camera.position).collect(),
            ..Export::of_file(capture.name.clone(), capture.up)
        }
    }

    /// Returns how a mesh from a file is exported, whose unit is the meter.
    pub(super) fn of_file(name: String, up: Vec3) -> Export {
        Export {
            name,
            up,
            unit_m: 1.0,
            obj_unit_m: 1.0,
            frame: MeshFrame::Dataset,
            jpeg: false,
            compress: false,
            material: Material::Unlit,
            cameras: Vec::new(),
        }
    }

    /// Returns the files of a head mesh in a format, the mesh first. `stem` is their base name.
    pub(super) fn files(&self, head: &HeadMesh, format: MeshFormat, stem: &str) -> Result<ExportedFiles> {
        self.files_beside(head, &head.mesh, format, stem)
    }

    /// Returns the files of a head mesh that are placed as those of another mesh of the same scene.
    pub(super) fn files_beside(
        &self,
        head: &HeadMesh,
        other: &Mesh,
        format: MeshFormat,
        stem: &str,
    ) -> Result<ExportedFiles> {
        let HeadMesh { mesh, world_from_scene, texture, shells, .. } = head;
        let options = ExportOptions {
            name: self.name.clone(),
            stem: stem.into(),
            // an unlit material shows no normal map, so a normal map implies a lit one
            unlit: self.material == Material::Unlit && texture.as_ref().is_none_or(|t| t.normal.is_none()),
            jpeg_quality: self.jpeg.then_some(JPEG_QUALITY),
            compress: self.compress,
            ..self.placed(other, world_from_scene)
        };
        match format {
            MeshFormat::Glb => {
                let bytes = to_glb(mesh, texture.as_ref(), shells.as_ref(), &options);
                bytes.map(|bytes| ExportedFiles {
                    files: vec![(format!("{stem}.glb"), bytes)],
                    warnings: Vec::new(),
                })
            }
            MeshFormat::Obj => {
                let unit_m = options.unit_m / self.obj_unit_m;
                to_obj(mesh, texture.as_ref(), &ExportOptions { unit_m, ..options })
            }
            // always in the dataset's world, with colors at the vertices: one index per vertex, so
            // that the surface stays closed for every reader
            MeshFormat::Ply => {
                to_ply(mesh, None, &ExportOptions { world_from_mesh: *world_from_scene, ..options })
            }
            MeshFormat::Usdz => to_usdz(mesh, texture.as_ref(), &options),
        }
        .map_err(advised)
    }

    /// Returns the options that place a mesh in its files, whatever it is called and shows.
    fn placed(&self, mesh: &Mesh, world_from_scene: &Similarity) -> ExportOptions {
        let (up, world_from_mesh) = match self.frame {
            MeshFrame::Dataset => (self.up, *world_from_scene),
            MeshFrame::Head => (Vec3::Y, self.head_from_mesh(mesh, world_from_scene)),
        };
        ExportOptions { up, unit_m: self.unit_m, world_from_mesh, ..ExportOptions::default() }
    }

    /// Returns the height of a mesh along the up direction, dataset units.
    pub(super) fn height(&self, mesh: &Mesh, world_from_scene: &Similarity) -> f64 {
        let up = world_from_scene.inverse().direction(self.up.normalize_or(Vec3::Y));
        let (low, high) = extent(mesh.positions.iter().map(|p| p.dot(up)));
        f64::from(high - low) * world_from_scene.scale
    }

    /// Returns what a mesh shows: it has shoulders where its lowest quarter is wider than its upper
    /// half.
    pub(super) fn shows(&self, mesh: &Mesh, world_from_scene: &Similarity) -> &'static str {
        let up = world_from_scene.inverse().direction(self.up.normalize_or(Vec3::Y));
        let (low, high) = extent(mesh.positions.iter().map(|p| p.dot(up)));
        let share = |p: &Vec3| (p.dot(up) - low) / (high - low);
        let (a, b) = up.any_orthonormal_pair();
        let width = |is_part: &dyn Fn(f32) -> bool| {
            let part: Vec<Vec3> = mesh.positions.iter().copied().filter(|p| is_part(share(p))).collect();
            let along = |k: u8| {
                let (sin, cos) = (f32::from(k) * std::f32::consts::PI / 8.0).sin_cos();
                let (low, high) = extent(part.iter().map(|p| p.dot(cos * a + sin * b)));
                high - low
            };
            (0..8).map(along).fold(0.0, f32::max)
        };
        match width(&|share| share < 0.25) > SHOULDERS * width(&|share| share > 0.5) {
            true => "head and shoulders",
            false => "head",
        }
    }

    /// Returns the frames of a mesh, its scene, and its GLB, OBJ and USDZ files.
    pub(super) fn frames(&self, mesh: &Mesh, world_from_scene: &Similarity) -> Result<Frames> {
        let file_from_scene = self.placed(mesh, world_from_scene).file_from_mesh()?;
        Ok(Frames { world_from_scene: *world_from_scene, file_from_scene })
    }

    /// Returns the direction in which the face of a head at `center` looks; see `front`.
    pub fn front(&self, center: DVec3) -> Option<Vec3> {
        front(self.up, &self.cameras, center)
    }

    /// Returns the options for the atlas of a head at `center`, in scene coordinates: the face is
    /// one upright chart.
    pub(super) fn atlas_config(
        &self,
        center: DVec3,
        scene_from_world: &Similarity,
        size_px: u32,
        gutter_px: u32,
    ) -> AtlasConfig {
        let front = self.front(center).map(|d| scene_from_world.direction(d));
        let up = front.map(|_| scene_from_world.direction(self.up.normalize_or(Vec3::Y)));
        AtlasConfig { size_px, gutter_px, front, up, resolved: None }
    }

    /// Returns the rotation that brings up to +Y and the face of a head at `center` towards +Z.
    fn head_from_world(&self, center: DVec3) -> DMat3 {
        let up = self.up.as_dvec3().normalize_or(DVec3::Y);
        // if the cameras stand all around, any direction perpendicular to `up` will do
        let front = self.front(center).map_or_else(|| up.any_orthonormal_vector(), |f| f.as_dvec3());
        let front = front.reject_from_normalized(up).normalize_or(up.any_orthonormal_vector());
        DMat3::from_cols(up.cross(front), up, front).transpose()
    }

    /// +Y up through the crown, the face towards +Z, the origin at the middle of the box.
    fn head_from_mesh(&self, mesh: &Mesh, world_from_mesh: &Similarity) -> Similarity {
        let rotation = self.head_from_world(center(mesh, world_from_mesh));
        let turned = Similarity { rotation, ..Similarity::IDENTITY }.after(world_from_mesh);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for p in &mesh.positions {
            let q = turned.point_f64(p.as_dvec3());
            (low, high) = (low.min(q), high.max(q));
        }
        Similarity { translation: turned.translation - 0.5 * (low + high), ..turned }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::PI;
    use tiface_surface::files::testing::tetrahedron;

    /// Returns an export of unlit meshes in the dataset's frame, whose unit is the meter.
    fn export(up: Vec3, cameras: Vec<DVec3>) -> Export {
        Export { cameras, ..Export::of_file("x".into(), up) }
    }

    #[test]
    fn a_mesh_that_widens_below_the_head_is_called_head_and_shoulders() {
        // a ball of radius 1; and the same on a box of 4 x 4 x 1, whatever is up
        let world_from_scene = Similarity { scale: 0.1, ..Similarity::IDENTITY };
        for up in [Vec3::Y, Vec3::Z] {
            let (a, b) = up.any_orthonormal_pair();
            let export = export(up, Vec::new());
            let mut positions: Vec<Vec3> = [a, -a, b, -b, up, -up].into();
            let ball = Mesh { positions: positions.clone(), ..Mesh::default() };
            assert_eq!(export.shows(&ball, &world_from_scene), "head");
            positions.extend([-1.0, -2.0].iter().flat_map(|h| [a, -a, b, -b].map(|d| 2.0 * d + h * up)));
            let bust = Mesh { positions, ..Mesh::default() };
            assert_eq!(export.shows(&bust, &world_from_scene), "head and shoulders");
            // from 1 to -2, of 0.1 units each
            assert!((export.height(&bust, &world_from_scene) - 0.3).abs() < 1e-6);
        }
    }

    #[test]
    fn in_the_head_frame_the_face_looks_along_z_and_the_crown_is_up() {
        // Z-up world, cameras at −Y: the corner of the box nearest to the cameras, at the top
        let corners: Vec<Vec3> = (0..8)
            .map(|i| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32 * 2.0, (i >> 2) as f32 * 3.0))
            .collect();
        let mesh = Mesh { positions: corners.clone(), ..Mesh::default() };
        let export = Export { frame: MeshFrame::Head, ..export(Vec3::Z, vec![DVec3::new(0.5, -9.0, 4.0)]) };
        let head_from_world = export.head_from_mesh(&mesh, &Similarity::IDENTITY);
        // (0, 0, 3): x = 0.5 left of the middle, y = 1 towards the cameras, z = 1.5 above
        let p = head_from_world.point(Vec3::new(0.0, 0.0, 3.0));
        assert!(p.distance(Vec3::new(-0.5, 1.5, 1.0)) < 1e-5, "{p}");
    }

    /// Returns a wrinkled ball, closed, a scene of its own.
    fn ball() -> Mesh {
        let (across, down) = (40u32, 20u32);
        let at = |i: u32, j: u32| {
            let (a, b) = (i as f32 / across as f32 * 2.0 * PI, j as f32 / down as f32 * PI);
            let r = 0.95 + 0.05 * (7.0 * a).sin() * b.sin();
            r * Vec3::new(b.sin() * a.cos(), b.sin() * a.sin(), b.cos())
        };
        let mut mesh = Mesh { positions: vec![at(0, 0), at(0, down)], ..Mesh::default() };
        mesh.positions.extend((0..across * (down - 1)).map(|k| at(k % across, 1 + k / across)));
        let ring = |i: u32, j: u32| 2 + (j - 1) * across + i % across;
        for i in 0..across {
            mesh.triangles.push([0, ring(i, 1), ring(i + 1, 1)]);
            mesh.triangles.push([1, ring(i + 1, down - 1), ring(i, down - 1)]);
            for j in 1..down - 1 {
                let [a, b] = [ring(i, j), ring(i + 1, j)];
                let [c, d] = [ring(i + 1, j + 1), ring(i, j + 1)];
                mesh.triangles.extend([[a, d, c], [a, c, b]]);
            }
        }
        mesh.normals = mesh.positions.iter().map(|p| p.normalize()).collect();
        mesh.colors = vec![[0.5; 3]; mesh.positions.len()];
        mesh
    }

    /// Corners of the triangles of a GLB, relative to the node, and the node's translation.
    fn corners_of(glb: &[u8]) -> (Vec<[Vec3; 3]>, DVec3) {
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
        let bin = &glb[28 + length..];
        let primitive = &json["meshes"][0]["primitives"][0];
        let bytes = |accessor: &serde_json::Value| {
            let accessor = &json["accessors"][accessor.as_u64().unwrap() as usize];
            let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
            let at = view["byteOffset"].as_u64().unwrap() as usize;
            &bin[at..at + view["byteLength"].as_u64().unwrap() as usize]
        };
        let number = |b: &[u8; 4]| f32::from_le_bytes(*b);
        let positions = bytes(&primitive["attributes"]["POSITION"]).as_chunks::<4>().0;
        let positions: Vec<Vec3> =
            positions.as_chunks::<3>().0.iter().map(|p| Vec3::from(p.each_ref().map(number))).collect();
        let indices = bytes(&primitive["indices"]).as_chunks::<2>().0; // fewer than 65 535
        let index = |b: &[u8; 2]| positions[u16::from_le_bytes(*b) as usize];
        let corners = indices.as_chunks::<3>().0.iter().map(|t| t.each_ref().map(index)).collect();
        let translation = &json["nodes"][0]["translation"];
        let k = |k: usize| translation[k].as_f64().unwrap_or(0.0);
        (corners, DVec3::new(k(0), k(1), k(2)))
    }

    /// A head of a quarter of a meter, six thousand kilometers from the origin: where f32 has steps
    /// of half a meter.
    #[test]
    fn a_head_at_the_end_of_the_world_keeps_its_shape_in_every_file() {
        let mesh = ball();
        assert!(mesh.is_closed());
        let mut far = tetrahedron();
        far.texture.as_mut().unwrap().atlas.triangles = vec![[0, 1, 2]; mesh.triangles.len()];
        (far.mesh, far.harmonics, far.shells) = (mesh.clone(), None, None);
        // as it is when it has been kept for a while
        let dir = tempfile::tempdir().unwrap();
        far.save(dir.path()).unwrap();
        let far = HeadMesh::load(dir.path()).unwrap();
        let place = far.world_from_scene;
        let exact = |p: Vec3| place.point_f64(p.as_dvec3());
        let mut export = export(Vec3::Z, vec![place.translation + DVec3::new(0.3, -0.6, 0.1)]);
        let bare = HeadMesh { texture: None, ..far.clone() };
        let close = 1e-6 * 0.25;
        for head in [&far, &bare] {
            export.frame = MeshFrame::Dataset;
            let glb = export.files(head, MeshFormat::Glb, "head").unwrap();
            assert_eq!(glb.warnings, Vec::<String>::new());
            let (corners, translation) = corners_of(&glb.files[0].1);
            // a document that is put together by hand for its node keeps what readers of lobes must
            // know
            let notes =
                String::from_utf8_lossy(&glb.files[0].1).contains("\"extras\":{\"tiface\":{\"lobes\":[{");
            assert_eq!(notes, head.texture.is_some());
            let file_from_world =
                export.frames(&head.mesh, &head.world_from_scene).unwrap().file_from_world();
            for (found, t) in corners.iter().zip(0..) {
                let expected = mesh.corners(t).map(exact);
                // a reader of the file must find the world coordinates
                let wanted = file_from_world.point_f64(expected[0]) - translation;
                assert!(wanted.distance(found[0].as_dvec3()) < close, "{wanted}");
                for (p, e) in found.iter().zip(expected) {
                    // z up: (x, y, z) becomes (x, z, −y)
                    let e = DVec3::new(e.x, e.z, -e.y) - translation;
                    assert!(p.as_dvec3().distance(e) < close, "{p} {e}");
                }
                let area = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a).length();
                let ratio = area(found.map(|p| p.as_dvec3())) / area(expected);
                assert!((ratio - 1.0).abs() < 1e-3, "triangle {t}: {ratio}");
            }
            // around the middle, looking at the camera
            export.frame = MeshFrame::Head;
            let glb = export.files(head, MeshFormat::Glb, "head").unwrap();
            let (corners, translation) = corners_of(&glb.files[0].1);
            assert_eq!(translation, DVec3::ZERO);
            let center = exact(mesh.bounds().center());
            let front = ((export.cameras[0] - center) * DVec3::new(1.0, 1.0, 0.0)).normalize();
            let axes = [DVec3::Z.cross(front), DVec3::Z, front];
            let turned = |p: Vec3| DVec3::from(axes.map(|a| a.dot(exact(p) - place.translation)));
            let file_from_world =
                export.frames(&head.mesh, &head.world_from_scene).unwrap().file_from_world();
            let all = || mesh.positions.iter().map(|&p| turned(p));
            let middle = 0.5 * (all().reduce(DVec3::min).unwrap() + all().reduce(DVec3::max).unwrap());
            for (found, t) in corners.iter().zip(0..) {
                for (p, e) in found.iter().zip(mesh.corners(t)) {
                    assert!(p.as_dvec3().distance(turned(e) - middle) < close, "{p}");
                    assert!(file_from_world.point_f64(exact(e)).distance(p.as_dvec3()) < close, "{p}");
                }
            }
            assert!(
                export
                    .files(head, MeshFormat::Obj, "head")
                    .unwrap()
                    .warnings
                    .iter()
                    .all(|w| !w.contains("origin"))
            );

            export.frame = MeshFrame::Dataset;
            let obj = export.files(head, MeshFormat::Obj, "head").unwrap();
            assert!(
                obj.warnings.last().unwrap().contains("round its vertices to 5.0e-1"),
                "{:?}",
                obj.warnings
            );
            let text = String::from_utf8(obj.files[0].1.clone()).unwrap();
            let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("v ")).collect();
            assert_eq!(lines.len(), mesh.positions.len());
            for (line, &p) in lines.iter().zip(&mesh.positions) {
                let v: Vec<f64> = line[2..].split(' ').map(|v| v.parse().unwrap()).collect();
                let e = exact(p);
                assert!(DVec3::new(v[0], v[1], v[2]).distance(DVec3::new(e.x, e.z, -e.y)) < close, "{line}");
            }

            let ply = export.files(head, MeshFormat::Ply, "head").unwrap();
            assert!(ply.warnings.last().unwrap().contains("the .ply lies"), "{:?}", ply.warnings);
            let bytes = &ply.files[0].1;
            let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
            assert!(String::from_utf8_lossy(&bytes[..end]).contains("property double x\n"));
            // three doubles, a normal, a color
            for (row, &p) in bytes[end..].chunks(24 + 12 + 3).zip(&mesh.positions) {
                let v = row.as_chunks::<8>().0;
                let found =
                    DVec3::new(f64::from_le_bytes(v[0]), f64::from_le_bytes(v[1]), f64::from_le_bytes(v[2]));
                assert!(found.distance(exact(p)) < close);
            }
        }
    }

    #[test]
    fn every_format_has_its_files() {
        let export = export(Vec3::Z, vec![DVec3::new(0.0, -3.0, 0.0)]);
        let names = |format| {
            let files = export.files(&tetrahedron(), format, "head").unwrap().files;
            files.into_iter().map(|(name, _)| name).collect::<Vec<_>>()
        };
        assert_eq!(names(MeshFormat::Glb), ["head.glb"]);
        assert_eq!(names(MeshFormat::Obj), ["head.obj", "head.mtl", "head.png"]);
        assert_eq!(names(MeshFormat::Ply), ["head.ply"]);
        assert_eq!(names(MeshFormat::Usdz), ["head.usdz"]);
    }
}
