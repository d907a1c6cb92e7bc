//! The head of a finished run in files: in another format, material, frame or size.
//!
//! Only what the run keeps is read, `mesh/parts`, the cameras and the settings of the stage;
//! nothing of the run is written, and nothing is remembered. A mesh file can take the place of a
//! run. A request that names nothing gives the files of the stage `mesh`, byte by byte. A mesh of
//! fewer triangles gets an atlas of its own, and everything that it shows from the nearest points
//! of the kept one ([`resized`]).

mod request;

use super::advice::{advised, sentence};
use super::cameras::CameraCheck;
use super::frames::{MeshFrame, center};
use super::mesh::{finished_mesh, read_finished};
use super::mesh_files::{Export, Material};
use super::scene_file::read_capture;
use super::session::unusable;
use crate::config::{Config, MeshFormat, Stage, key};
use glam::{DVec3, Vec3};
pub use request::{Cut, ExportRequest, Size};
use request::{TEXTURED, not_shown};
use std::path::{Path, PathBuf};
use tiface_base::geom::{ShellLayer, Similarity};
use tiface_base::{Error, Fingerprint, Monitor, Result};
use tiface_surface::files::{
    ExportedFiles, ExtractedSurface, HeadMesh, LOBE_TEXEL, OpenedMesh, open_mesh, weld,
};
use tiface_surface::{
    AtlasConfig, CutReport, DetailLevel, HeadMeasures, Plane, Resize, Warning, cut, lods, measure,
    most_levels, resized,
};

/// A head to be exported: that of a finished run, as the stage `mesh` left it, or that of a file.
pub struct KeptHead {
    /// `None` for a file.
    run: Option<PathBuf>,
    head: HeadMesh,
    /// Texels that repeat a chart's border around it.
    gutter_px: u32,
    export: Export,
    /// Why the texture of a file is not there.
    texture_problem: Option<String>,
    /// Files beside a mesh file that were read.
    pub beside: Vec<PathBuf>,
    /// Its smaller levels of detail.
    levels: Vec<DetailLevel>,
    /// Where its parts are before it is cut, in scene coordinates; `None` if its shape does not
    /// say.
    measures: Option<HeadMeasures>,
    /// How it was cut, if it was.
    cut: Option<CutReport>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

impl KeptHead {
    /// Reads the head of a run that was made with the settings `made`.
    ///
    /// # Errors
    ///
    /// Fails if the run has no finished mesh, or if a file is missing, damaged, or not the one that
    /// the stage left.
    pub fn read(run: &Path, made: &Config) -> Result<KeptHead> {
        let (head, warnings) = read_finished(run, |record| {
            let folder = run.join(Stage::Mesh);
            for name in record.products.keys().filter(|name| name.starts_with("parts/")) {
                if let Some(fault) = record.verify(&folder, name)? {
                    return Err(record.error(&fault));
                }
            }
            // the other files are not read
            let problem = record.require_products(&folder).err();
            let warnings = problem.map(|e| format!("{e}; {}", e.hint())).into_iter().collect();
            Ok((HeadMesh::load(&folder.join("parts")).map_err(advised)?, warnings))
        })?;
        let mut capture = read_capture(&run.join("cameras.json"), &made.capture.path)
            .map_err(|e| Error::cannot(&e, format!("`tiface mask {}` writes it again", run.display())))?;
        let check = CameraCheck::read(&run.join(Stage::Mask)).map_err(|e| unusable(e, Stage::Mask))?;
        check.iter().for_each(|check| check.apply(&mut capture));
        let export = Export::new(&capture, made);
        Ok(KeptHead { run: Some(run.into()), warnings, ..KeptHead::new(head, made.mesh.gutter_px, export) })
    }

    fn new(head: HeadMesh, gutter_px: u32, export: Export) -> KeptHead {
        let (levels, beside, warnings) = (Vec::new(), Vec::new(), Vec::new());
        let (run, texture_problem, measures, cut) = (None, None, None, None);
        KeptHead { run, head, gutter_px, export, texture_problem, beside, levels, measures, cut, warnings }
    }

    /// Opens a mesh file. `up` is its up direction; its unit is the meter.
    ///
    /// # Errors
    ///
    /// Fails if the surface cannot be read.
    pub fn open(file: &Path, up: Vec3) -> Result<KeptHead> {
        let OpenedMesh { mut head, texture_problem, soft_layers, beside, notes: warnings, .. } =
            open_mesh(file).map_err(advised)?;
        // files have a vertex for each side of a seam, along which a simpler mesh would open
        head.mesh = weld(&head.mesh);
        let name = file.file_stem().map_or_else(|| "head".into(), |stem| stem.to_string_lossy().into_owned());
        let kept = KeptHead::new(head, AtlasConfig::default().gutter_px, Export::of_file(name, up));
        let mut kept = KeptHead { texture_problem, beside, warnings, ..kept };
        if soft_layers > 0 {
            kept.warnings.push(format!(
                "soft layers of `{}` are not read, and the head under them may end below the surface of hair; a run has both",
                file.display()
            ));
        }
        Ok(kept)
    }

    /// Returns the head as it is asked for.
    ///
    /// # Errors
    ///
    /// Fails if more is asked for than the run keeps, or something that none of the formats shows;
    /// the error names the option.
    pub fn changed(mut self, asked: &ExportRequest, monitor: &dyn Monitor) -> Result<KeptHead> {
        for (option, what, shown_by) in asked.options() {
            self.warnings.extend(not_shown(option, what, shown_by, &asked.formats)?);
        }
        let without: Vec<String> = asked
            .formats
            .iter()
            .filter(|format| **format != MeshFormat::Glb)
            .map(|format| format!(".{}", format.as_str()))
            .collect();
        if asked.layers && self.head.shells.is_some() && !without.is_empty() {
            self.warnings
                .push(format!("soft layers are left out of {}; a .glb has them", without.join(", ")));
        }
        let by_face = [(matches!(asked.size, Size::Head(_)), "--height"), (asked.cut != Cut::None, "--cut")];
        let by_face = by_face.into_iter().find_map(|(asked, option)| asked.then_some(option));
        let framed = (asked.frame == MeshFrame::Head).then_some("--frame head");
        if let Some(option) = by_face.or(framed).filter(|_| self.run.is_none()) {
            return Err(Error::usage(
                format!(
                    "`{option}` needs to know where the face looks, and a file has no cameras that say it"
                ),
                "leave it out, or export from a run",
            ));
        }
        if let Some(problem) = self.texture_problem.take().filter(|_| asked.texture_px != Some(0)) {
            return Err(Error::cannot(problem, "mend it, or leave the texture out: `--texture 0`"));
        }
        let measures = self.run.is_some().then(|| self.measure());
        if let Some(option) = by_face
            && let Some(Err(e)) = &measures
        {
            let hint =
                format!("leave `{option}` out; `--measure A B METERS` gives the size by a known distance");
            return Err(Error::usage(format!("`{option}`: {e}"), hint));
        }
        self.measures = measures.and_then(Result::ok);
        self.export.unit_m = self.unit_m(asked.size)?;
        let plane = self.plane(asked.cut)?;
        self.leave_out(asked);
        self.resize(asked, monitor)?;
        if let Some(plane) = plane {
            let hint = "leave `--cut` out, or choose another; an open mesh is closed by `--fresh mesh --set mesh.cap=true`";
            let (head, done) =
                cut(&self.head, &plane, self.gutter_px).map_err(|e| advised(e).with_hint(hint))?;
            self.head = head;
            if done.dropped > 0 {
                self.warnings.push(format!("{} smaller pieces above the cut are left out", done.dropped));
            }
            self.cut = Some(done);
        }
        self.make_levels(asked.levels, monitor)?;
        let has_normals = self.head.texture.as_ref().is_some_and(|t| t.normal.is_some());
        if asked.material == Some(Material::Unlit) && has_normals {
            self.warnings.push(
                "the material stays lit, for a normal map needs light; `--no-normal-map` leaves it out"
                    .into(),
            );
        }
        self.export = Export {
            obj_unit_m: asked.obj_unit_m,
            frame: asked.frame,
            jpeg: asked.jpeg || asked.compress,
            compress: asked.compress,
            material: asked.material.unwrap_or(Material::Unlit),
            ..self.export
        };
        Ok(self)
    }

    /// Returns the length of a dataset unit that gives the head a size, meters.
    fn unit_m(&self, size: Size) -> Result<f64> {
        match size {
            Size::Dataset => Ok(self.export.unit_m),
            Size::Head(meters) => {
                let height = self.measures.as_ref().map_or(f32::NAN, HeadMeasures::height);
                Ok(meters / (f64::from(height) * self.head.world_from_scene.scale))
            }
            Size::Between([a, b], meters) => {
                let distance = a.distance(b);
                if distance.is_finite() && distance > 0.0 {
                    return Ok(meters / distance);
                }
                let text = format!("the points {a} and {b} of `--measure` have no distance");
                Err(Error::usage(
                    text,
                    "give two points of the head in the dataset's coordinates, as in its .ply",
                ))
            }
        }
    }

    /// Returns where the parts of the head are, in scene coordinates.
    fn measure(&self) -> Result<HeadMeasures> {
        let HeadMesh { mesh, world_from_scene, .. } = &self.head;
        let scene_from_world = world_from_scene.inverse();
        let front = self.export.front(center(mesh, world_from_scene)).unwrap_or(Vec3::ZERO);
        measure(mesh, scene_from_world.direction(self.export.up), scene_from_world.direction(front))
    }

    /// Returns the plane at which the head is cut, in scene coordinates.
    fn plane(&self, cut: Cut) -> Result<Option<Plane>> {
        let measures = self.measures.as_ref();
        match cut {
            Cut::None => Ok(None),
            Cut::Chin => Ok(measures.map(HeadMeasures::chin_plane)),
            Cut::Collar => measures
                .map(HeadMeasures::collar_plane)
                .transpose()
                .map_err(|e| e.with_hint("leave `--cut` out, or use `--cut chin`")),
        }
    }

    /// Returns the files of a level of detail in a format, the mesh first; all levels lie in the
    /// same place. `stem` is their base name.
    ///
    /// # Errors
    ///
    /// Fails if the mesh is damaged.
    pub fn files(&self, level: usize, format: MeshFormat, stem: &str) -> Result<ExportedFiles> {
        self.export.files_beside(self.level(level), &self.head.mesh, format, stem)
    }

    /// Returns a level of detail, of which the first is the head itself.
    fn level(&self, level: usize) -> &HeadMesh {
        level.checked_sub(1).map_or(&self.head, |smaller| &self.levels[smaller].head)
    }

    /// Fails unless the files of a format are those that the stage `mesh` left in the run, by their
    /// recorded digests; older records have sizes alone.
    pub fn require_recorded(&self, format: MeshFormat) -> Result<()> {
        let Some(run) = &self.run else { return Ok(()) };
        let record = finished_mesh(run)?;
        let written = self.files(0, format, "head")?.files;
        let is_own = |(name, bytes): &(String, Vec<u8>)| match record.sha256.get(name) {
            Some(digest) => *digest == Fingerprint::of_bytes(bytes),
            None => record.products.get(name) == Some(&(bytes.len() as u64)),
        };
        match written.iter().all(is_own) {
            true => Ok(()),
            false => Err(Error::usage(
                format!("these options write another `head.{}` than the run's", format.as_str()),
                "choose a place beside the run with `--out`, or leave the options out",
            )),
        }
    }

    /// Returns the number of triangles of a level of detail.
    pub fn triangles(&self, level: usize) -> usize {
        self.level(level).mesh.triangles.len()
    }

    /// Returns the length of a unit of the scene in GLB, OBJ and USDZ files, meters.
    fn scene_unit_m(&self) -> f64 {
        self.head.world_from_scene.scale * self.export.unit_m
    }

    /// Returns the largest and the mean distance of each smaller level of detail from the first, in
    /// the units of GLB, OBJ and USDZ files, meters.
    pub fn level_distances_m(&self) -> Vec<[f64; 2]> {
        let meters = self.scene_unit_m();
        self.levels
            .iter()
            .map(|level| [level.largest, level.mean].map(|distance| meters * distance))
            .collect()
    }

    /// Returns how the head was cut, if it was, with lengths in GLB, OBJ and USDZ files, meters.
    pub fn cut_m(&self) -> Option<CutReport> {
        self.cut.as_ref().map(|cut| CutReport { moved: self.scene_unit_m() * cut.moved, ..cut.clone() })
    }

    /// Returns the number of triangles of its soft layers, which a GLB alone has.
    pub fn layer_triangles(&self) -> usize {
        let HeadMesh { mesh, shells, .. } = &self.head;
        let count = |layer: &ShellLayer| mesh.triangles.iter().filter(|t| layer.has(t)).count();
        shells.iter().flat_map(|shells| &shells.layers).map(count).sum()
    }

    /// Returns the height of the head from chin to crown in GLB, OBJ and USDZ files, meters, as it
    /// is before triangles are taken away and the head is cut; `None` if its shape does not say
    /// where the chin is.
    pub fn head_height_m(&self) -> Option<f64> {
        let measures = self.measures.as_ref()?;
        Some(f64::from(measures.height()) * self.scene_unit_m())
    }

    /// Returns the width, height and depth of the mesh in GLB, OBJ and USDZ files, meters.
    ///
    /// # Errors
    ///
    /// Fails if the mesh has no up direction.
    pub fn size_m(&self) -> Result<[f32; 3]> {
        let HeadMesh { mesh, world_from_scene, .. } = &self.head;
        let file_from_scene = self.export.frames(mesh, world_from_scene)?.file_from_scene;
        // without the translation, which f32 may not represent
        let in_place = Similarity { translation: DVec3::ZERO, ..file_from_scene };
        Ok(mesh.transformed(&in_place).bounds().size().to_array())
    }

    /// Refuses a value that asks for more than the run keeps, which it would with these settings.
    fn more(&self, option: &str, value: u32, kept: &str, settings: &str) -> Error {
        let what = if self.run.is_some() { "run keeps" } else { "file has" };
        let again = |run: &PathBuf| {
            let run = run.display();
            format!("leave it out, or make the mesh again: `tiface mesh {run} --fresh mesh --set {settings}`")
        };
        Error::usage(
            format!("`{option}` is {value}, but the {what} {kept}"),
            self.run.as_ref().map_or("leave it out".into(), again),
        )
    }

    /// Leaves out what is not asked for: soft layers, lobes, the normal map.
    fn leave_out(&mut self, asked: &ExportRequest) {
        self.head.shells = self.head.shells.take().filter(|_| asked.layers);
        if let Some(texture) = &mut self.head.texture {
            texture.normal = texture.normal.take().filter(|_| asked.normal_map);
            texture.lobes = texture.lobes.take().filter(|_| asked.lobes);
        }
    }

    /// Brings the mesh and its texture to the size that is asked for.
    fn resize(&mut self, asked: &ExportRequest, monitor: &dyn Monitor) -> Result<()> {
        let kept_px = self.head.texture.as_ref().map_or(0, |t| t.color.width);
        let kept = self.triangles(0);
        let px = asked.texture_px.unwrap_or(kept_px);
        if px > kept_px {
            let kept = match kept_px {
                0 => "no texture".into(),
                kept => format!("a texture of {kept}"),
            };
            return Err(self.more("--texture", px, &kept, &format!("{}={px}", key!(mesh.texture_px))));
        }
        if px == 0 && kept_px > 0 && self.head.mesh.colors.is_empty() {
            let settings = format!("{}=0", key!(mesh.texture_px));
            return Err(self.more("--texture", px, "no colors at the vertices", &settings));
        }
        if px > 0 && px < kept_px {
            self.warnings.extend(not_shown("--texture", "texture", TEXTURED, &asked.formats)?);
        }
        if let Some(triangles) = asked.triangles.filter(|n| *n as usize != kept)
            && self.simplify(triangles as usize, px, monitor)?
        {
            return Ok(());
        }
        let gutter_px = self.gutter_px;
        match self.head.texture.take() {
            Some(texture) if px == kept_px => self.head.texture = Some(texture),
            Some(_) if px > 0 && px * gutter_px < kept_px => {
                let least = kept_px.div_ceil(gutter_px);
                return Err(Error::usage(
                    format!(
                        "`--texture` is {px}: charts of the kept texture of {kept_px} would run into each other"
                    ),
                    format!("use {least} or more"),
                ));
            }
            Some(texture) if px > 0 => self.head.texture = Some(texture.reduced(px, px / LOBE_TEXEL)),
            _ => {}
        }
        Ok(())
    }

    /// Simplifies the surface that the run keeps, or the mesh of a file, and carries what the head
    /// shows over to a new atlas of `px` texels. Returns false where the head has as many triangles
    /// as the surface allows.
    fn simplify(&mut self, triangles: usize, px: u32, monitor: &dyn Monitor) -> Result<bool> {
        let surface = match &self.run {
            Some(run) => ExtractedSurface::load(&run.join(Stage::Mesh).join("parts")).map_err(advised)?.mesh,
            None => self.head.mesh.clone(),
        };
        let most = surface.triangles.len();
        if triangles > most {
            self.warnings.push(format!("the surface has {most} triangles, which are all written"));
        }
        if triangles.min(most) == self.triangles(0) {
            return Ok(false);
        }
        let resize = Resize { triangles: triangles.min(most), atlas: self.atlas_config(px) };
        let (head, warnings) = resized(&self.head, &surface, &resize, monitor).map_err(advised)?;
        self.head = head;
        self.warnings.extend(warnings.iter().map(as_options));
        Ok(true)
    }

    /// Returns the options of an atlas whose texture has `px` texels on a side; `None` without.
    fn atlas_config(&self, px: u32) -> Option<AtlasConfig> {
        let HeadMesh { mesh, world_from_scene, .. } = &self.head;
        let center = center(mesh, world_from_scene);
        let config = || self.export.atlas_config(center, &world_from_scene.inverse(), px, self.gutter_px);
        (px > 0).then(config)
    }

    /// Makes the smaller levels of detail.
    fn make_levels(&mut self, levels: usize, monitor: &dyn Monitor) -> Result<()> {
        if levels == 1 {
            return Ok(());
        }
        let px = self.head.texture.as_ref().map_or(0, |t| t.color.width);
        let atlas = self.atlas_config(px).unwrap_or_default();
        let most = most_levels(self.triangles(0));
        if levels > most {
            return Err(Error::usage(
                format!(
                    "`--lod` is {levels}, but of {} triangles the last level would show no face",
                    self.triangles(0)
                ),
                if most == 1 { "leave `--lod` out".into() } else { format!("write {most} levels at most") },
            ));
        }
        self.levels = lods(&self.head, levels, &atlas, monitor).map_err(advised)?;
        let mut said: Vec<String> =
            self.levels.iter().flat_map(|level| level.warnings.iter().map(as_options)).collect();
        said.dedup();
        self.warnings.extend(said);
        Ok(())
    }
}

/// Returns a warning as a sentence that names the option of `tiface export` that helps.
fn as_options(warning: &Warning) -> String {
    let options = [(key!(mesh.triangles), "--triangles"), (key!(mesh.texture_px), "--texture")];
    options.iter().fold(sentence(warning), |text, (key, option)| text.replace(key, option))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::Quiet;
    use tiface_surface::bake::testing::ball;
    use tiface_surface::files::testing::tetrahedron;
    use tiface_surface::files::{read, weld};

    /// A head as a file has it, whose charts have such a gutter.
    fn kept(head: HeadMesh, gutter_px: u32) -> KeptHead {
        KeptHead::new(head, gutter_px, Export::of_file("ball".into(), Vec3::Z))
    }

    #[test]
    fn fewer_triangles_keep_layers_and_view_dependent_color() {
        let head = kept(ball(), 8);
        let before = head.head.clone();
        let asked = ExportRequest { triangles: Some(800), texture_px: Some(256), ..ExportRequest::default() };
        let after = head.changed(&asked, &Quiet).unwrap();
        let mesh = &after.head.mesh;
        assert!((700..=800).contains(&mesh.triangles.len()) && mesh.is_closed(), "{}", mesh.triangles.len());
        let texture = after.head.texture.as_ref().unwrap();
        let lobes = texture.lobes.as_ref().unwrap();
        assert_eq!((texture.color.width, lobes.pictures[0].width), (256, 256 / LOBE_TEXEL));
        assert_eq!(after.head.shells.as_ref().unwrap().layers[0].alphas.len(), mesh.positions.len());
        let glb = after.files(0, MeshFormat::Glb, "head").unwrap().files.remove(0).1;
        assert!(String::from_utf8_lossy(&glb).contains("ball soft layers"));
        assert!(weld(&read(&glb, Path::new("a.glb")).unwrap()).is_closed());
        // half of the sphere is under the layer, as before
        let share = |head: &HeadMesh| {
            let layer = &head.shells.as_ref().unwrap().layers[0];
            let area = |all: bool| -> f64 {
                let own = head.mesh.triangles.iter().enumerate().filter(|(_, t)| all || layer.has(t));
                own.map(|(t, _)| head.mesh.area(t as u32)).sum()
            };
            area(false) / area(true)
        };
        assert!(
            (share(&after.head) - share(&before)).abs() < 0.1,
            "{} {}",
            share(&after.head),
            share(&before)
        );
    }

    #[test]
    fn a_smaller_texture_that_would_mix_charts_is_refused() {
        let change = |gutter_px: u32, px: u32| {
            let head = kept(ball(), gutter_px);
            head.changed(&ExportRequest { texture_px: Some(px), ..ExportRequest::default() }, &Quiet)
        };
        // an eighth, which is one texel of a gutter of eight
        assert_eq!(change(8, 64).unwrap().head.texture.unwrap().atlas.width, 64);
        let e = change(8, 32).err().unwrap();
        assert_eq!(e.kind().code(), 2, "{e}");
        let wide = change(4, 100).err().unwrap();
        assert!(
            wide.to_string().contains("would run into each other") && wide.hint() == "use 128 or more",
            "{wide:?}"
        );
    }

    #[test]
    fn the_normal_map_keeps_the_material_lit_and_says_so() {
        let head = || kept(tetrahedron(), 8);
        let unlit = ExportRequest { material: Some(Material::Unlit), ..ExportRequest::default() };
        let lit = head().changed(&unlit, &Quiet).unwrap();
        assert!(lit.warnings[0].contains("`--no-normal-map`"), "{:?}", lit.warnings);
        assert!(head().changed(&ExportRequest::default(), &Quiet).unwrap().warnings.is_empty());
        let unlit = head().changed(&ExportRequest { normal_map: false, ..unlit }, &Quiet).unwrap();
        assert!(unlit.warnings.is_empty() && unlit.head.texture.as_ref().unwrap().normal.is_none());
        let glb = unlit.files(0, MeshFormat::Glb, "head").unwrap().files.remove(0).1;
        assert!(String::from_utf8_lossy(&glb).contains("KHR_materials_unlit"));
    }
}
