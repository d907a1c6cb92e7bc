//! The head of a finished run, written again: in another format, material, frame or size.
//!
//! Only what the run keeps is read, `mesh/parts` and the cameras; nothing of the run is written.
//! With the run's own settings the files are those of the stage `mesh`, byte by byte. A mesh of
//! fewer triangles gets an atlas of its own, and everything that it shows from the nearest points
//! of the kept one ([`Original`]).

use super::advice::{advised, sentence};
use super::cameras::CameraCheck;
use super::frames::{Export, center};
use super::mesh::{finished_mesh, read_finished};
use super::scene_file::read_capture;
use super::session::{check_feasible, unusable};
use crate::capture::Capture;
use crate::config::{Config, Hair, Material, MeshFormat, Stage, key};
use crate::run::Fingerprint;
use std::path::{Path, PathBuf};
use tiface_base::{Error, Monitor, Result};
use tiface_surface::bake::{Original, tangent_space};
use tiface_surface::files::{ExportedFiles, HeadMesh, HeadTexture, LOBE_TEXEL, Lobes, tangents};
use tiface_surface::{SimplifyConfig, atlas, simplify};

/// Keys that affect how the files of a mesh are written, each with what it is and the formats that
/// show it.
const FILE_KEYS: [(&str, &str, &[MeshFormat]); 6] = [
    (key!(mesh.format), "format", &[MeshFormat::Glb, MeshFormat::Obj, MeshFormat::Ply, MeshFormat::Usdz]),
    (key!(mesh.material), "choice of material", &[MeshFormat::Glb, MeshFormat::Usdz]),
    (key!(mesh.frame), "frame but the dataset's", TEXTURED),
    (key!(mesh.height_m), "height in meters", TEXTURED),
    (key!(capture.unit_m), "length in meters", TEXTURED),
    (key!(mesh.texture_format), "picture", TEXTURED),
];

/// Formats of a textured mesh in meters; the others keep the dataset's world.
const TEXTURED: &[MeshFormat] = &[MeshFormat::Glb, MeshFormat::Obj, MeshFormat::Usdz];

/// Keys that affect how much of the kept head the files show.
const PART_KEYS: [&str; 5] =
    [key!(mesh.triangles), key!(mesh.texture_px), key!(mesh.hair), key!(mesh.lobes), key!(mesh.normal_map)];

/// Returns whether a key affects only how the files of a mesh are written.
pub(super) fn is_file_key(key: &str) -> bool {
    FILE_KEYS.iter().any(|(name, ..)| *name == key)
}

/// The head of a finished run, as the stage `mesh` left it.
pub struct KeptHead {
    run: PathBuf,
    /// The settings that it was made with.
    made: Config,
    capture: Capture,
    head: HeadMesh,
    export: Export,
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
        Ok(KeptHead { run: run.into(), made: made.clone(), capture, head, export, warnings })
    }

    /// Returns the head as the settings `asked` have it in files of these formats.
    ///
    /// # Errors
    ///
    /// Fails if a setting asks for more than the run keeps, or for something that none of the
    /// formats shows; the error names it.
    pub fn changed(
        mut self,
        asked: &Config,
        formats: &[MeshFormat],
        monitor: &dyn Monitor,
    ) -> Result<KeptHead> {
        check_feasible(asked)?;
        for [key, value, _] in asked.differences(&self.made) {
            if let Some((_, what, shown_by)) = FILE_KEYS.iter().find(|(name, ..)| *name == key) {
                self.warnings.extend(not_shown(&key, what, shown_by, formats)?);
            } else if !PART_KEYS.contains(&key.as_str()) && key != key!(device) {
                let what =
                    format!("`{key}` affects what is made, and `export` only writes what has been made");
                return Err(Error::usage(what, self.made_again(&key, &value)));
            }
        }
        self.export = Export::new(&self.capture, asked);
        self.leave_out(asked)?;
        self.resize(asked, formats, monitor)?;
        let has_normals = self.head.texture.as_ref().is_some_and(|t| t.normal.is_some());
        if asked.mesh.material == Material::Unlit && self.made.mesh.material == Material::Lit && has_normals {
            let left_out = key!(mesh.normal_map);
            self.warnings.push(format!(
                "the material stays lit, for a normal map needs light; `--set {left_out}=false` leaves it out"
            ));
        }
        Ok(self)
    }

    /// Returns the files of the head in a format, the mesh first. `stem` is their base name.
    ///
    /// # Errors
    ///
    /// Fails if the mesh is damaged.
    pub fn files(&self, format: MeshFormat, stem: &str) -> Result<ExportedFiles> {
        self.export.files(&self.head, format, stem)
    }

    /// Fails unless the files of a format are those that the stage `mesh` left in the run, by their
    /// recorded digests; older records have sizes alone.
    pub fn require_recorded(&self, format: MeshFormat) -> Result<()> {
        let record = finished_mesh(&self.run)?;
        let written = self.files(format, "head")?.files;
        let is_own = |(name, bytes): &(String, Vec<u8>)| match record.sha256.get(name) {
            Some(digest) => *digest == Fingerprint::of_bytes(bytes),
            None => record.products.get(name) == Some(&(bytes.len() as u64)),
        };
        match written.iter().all(is_own) {
            true => Ok(()),
            false => Err(Error::usage(
                format!("these settings write another `head.{}` than the run's", format.as_str()),
                "choose a place beside the run with `--out`, or leave the settings out",
            )),
        }
    }

    /// Returns the number of triangles.
    pub fn triangles(&self) -> usize {
        self.head.mesh.triangles.len()
    }

    /// Returns what to do about a setting that needs a mesh of its own.
    fn made_again(&self, key: &str, value: &str) -> String {
        match key.split_once('.') {
            Some(("mesh", _)) => {
                let run = self.run.display();
                format!(
                    "leave it out, or make the mesh again: `tiface mesh {run} --fresh mesh --set {key}={value}`"
                )
            }
            _ => "leave it out".into(),
        }
    }

    /// Refuses a value that asks for more than the run keeps.
    fn more(&self, key: &str, value: impl ToString, kept: &str) -> Error {
        let value = value.to_string();
        Error::usage(format!("`{key}` is {value}, but the run keeps {kept}"), self.made_again(key, &value))
    }

    /// Leaves out what is asked to be left out: soft layers, lobes, the normal map.
    fn leave_out(&mut self, asked: &Config) -> Result<()> {
        let (was, is) = (&self.made.mesh, &asked.mesh);
        if is.hair != was.hair {
            if is.hair == Hair::Shells {
                return Err(self.more(key!(mesh.hair), "shells", "no soft layers"));
            }
            self.head.shells = None;
        }
        if is.normal_map && !was.normal_map {
            return Err(self.more(key!(mesh.normal_map), true, "no normal map"));
        }
        if is.lobes != was.lobes && is.lobes != 0 {
            return Err(self.more(key!(mesh.lobes), is.lobes, &format!("lobes of degree {}", was.lobes)));
        }
        if let Some(texture) = &mut self.head.texture {
            texture.normal = texture.normal.take().filter(|_| is.normal_map);
            texture.lobes = texture.lobes.take().filter(|_| is.lobes > 0);
        }
        Ok(())
    }

    /// Brings the mesh and its texture to the size that is asked for.
    fn resize(&mut self, asked: &Config, formats: &[MeshFormat], monitor: &dyn Monitor) -> Result<()> {
        let (was, is) = (&self.made.mesh, &asked.mesh);
        let kept_px = self.head.texture.as_ref().map_or(0, |t| t.color.width);
        let kept = self.triangles();
        let px = if is.texture_px == was.texture_px { kept_px } else { is.texture_px };
        if px > kept_px {
            let kept = match kept_px {
                0 => "no texture".into(),
                kept => format!("a texture of {kept}"),
            };
            return Err(self.more(key!(mesh.texture_px), px, &kept));
        }
        if px == 0 && kept_px > 0 && self.head.mesh.colors.is_empty() {
            return Err(self.more(key!(mesh.texture_px), px, "no colors at the vertices"));
        }
        if px > 0 && px < kept_px {
            self.warnings.extend(not_shown(key!(mesh.texture_px), "texture", TEXTURED, formats)?);
        }
        let count = is.triangles as usize;
        let more = was.triangles != 0 && is.triangles > was.triangles && count > kept;
        if is.triangles != was.triangles && (count == 0 || more) {
            return Err(self.more(
                key!(mesh.triangles),
                is.triangles,
                &format!("a mesh of {kept} triangles"),
            ));
        }
        if is.triangles != was.triangles && count < kept {
            return self.simplify(count, px, monitor);
        }
        match self.head.texture.take() {
            Some(texture) if px == kept_px => self.head.texture = Some(texture),
            Some(_) if px > 0 && px * was.gutter_px < kept_px => {
                let least = kept_px.div_ceil(was.gutter_px);
                return Err(Error::usage(
                    format!(
                        "`{}` is {px}: charts of the kept texture of {kept_px} would run into each other",
                        key!(mesh.texture_px)
                    ),
                    format!("use {least} or more"),
                ));
            }
            Some(texture) if px > 0 => self.head.texture = Some(texture.reduced(px, px / LOBE_TEXEL)),
            _ => {}
        }
        Ok(())
    }

    /// Simplifies the mesh and carries what it shows over to a new atlas of `px` texels.
    fn simplify(&mut self, triangles: usize, px: u32, monitor: &dyn Monitor) -> Result<()> {
        let HeadMesh { mesh: kept, world_from_scene, texture, .. } = &self.head;
        let mut mesh = kept.clone();
        let config = SimplifyConfig { triangles, ..SimplifyConfig::default() };
        let done = simplify(&mut mesh, None, &config, monitor)?;
        self.warnings.extend(done.warnings(&config).iter().map(sentence));
        let original = Original::new(&self.head);
        let shells = original.carry_vertices(&mut mesh);
        let gutter_px = self.made.mesh.gutter_px;
        let carry = |texture: &HeadTexture| -> Result<HeadTexture> {
            let scene_from_world = world_from_scene.inverse();
            let config =
                self.export.atlas_config(center(kept, world_from_scene), &scene_from_world, px, gutter_px);
            let (layout, done) = atlas(&mesh, &config, monitor)?;
            self.warnings.extend(done.warnings().iter().map(sentence));
            let side = texture.color.width.div_ceil(px).clamp(1, 2);
            let carried = original.carry_texture(texture, &mesh, &layout, side, gutter_px, monitor)?;
            let bend = |normals| -> Result<_> {
                Ok(tangent_space(&mesh, &layout, &tangents(&mesh, &layout)?, normals, gutter_px))
            };
            let normal = carried.normal.as_ref().map(bend).transpose()?;
            let lobes = texture.lobes.as_ref().and_then(|l| Lobes::new(&carried.lobes, l.turned));
            let lobes = lobes.map(|l| l.reduced(px / LOBE_TEXEL));
            Ok(HeadTexture { color: carried.color.encoded(), normal, lobes, atlas: layout })
        };
        let texture = texture.as_ref().filter(|_| px > 0).map(carry).transpose()?;
        // no file holds the harmonics of vertices
        self.head = HeadMesh { mesh, world_from_scene: *world_from_scene, texture, harmonics: None, shells };
        Ok(())
    }
}

/// Returns a warning for each of the formats that does not show a changed setting. Fails if none
/// shows it.
fn not_shown(
    key: &str,
    what: &str,
    shown_by: &[MeshFormat],
    formats: &[MeshFormat],
) -> Result<Option<String>> {
    let endings = |list: &mut dyn Iterator<Item = &MeshFormat>| {
        list.map(|format| format!(".{}", format.as_str())).collect::<Vec<_>>().join(", ")
    };
    let without = endings(&mut formats.iter().filter(|f| !shown_by.contains(f)));
    if without.is_empty() {
        return Ok(None);
    }
    let problem = format!("`{key}` does not affect {without} files, which have no {what}");
    match formats.iter().any(|f| shown_by.contains(f)) {
        true => Ok(Some(problem)),
        false => {
            Err(Error::usage(problem, format!("leave it out, or write {}", endings(&mut shown_by.iter()))))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use glam::Vec3;
    use tiface_base::Quiet;
    use tiface_surface::bake::testing::ball;
    use tiface_surface::files::testing::tetrahedron;
    use tiface_surface::files::{read, weld};

    /// A head as a run would keep it that was made with these settings.
    fn kept(head: HeadMesh, change: impl Fn(&mut Config)) -> KeptHead {
        let mut made = Config::preset(Preset::Draft);
        change(&mut made);
        let capture = Capture {
            root: PathBuf::new(),
            name: "ball".into(),
            format: String::new(),
            reasons: Vec::new(),
            views: Vec::new(),
            up: Vec3::Z,
            focus: None,
            unit_m: 1.0,
            stray_masks: None,
            warnings: Vec::new(),
            readings: Vec::new(),
        };
        let export = Export::new(&capture, &made);
        KeptHead { run: "run".into(), made, capture, head, export, warnings: Vec::new() }
    }

    fn asked(kept: &KeptHead, change: impl Fn(&mut Config)) -> Config {
        let mut asked = kept.made.clone();
        change(&mut asked);
        asked
    }

    #[test]
    fn fewer_triangles_keep_layers_and_view_dependent_color() {
        let head = kept(ball(), |c| (c.mesh.texture_px, c.mesh.lobes) = (512, 1));
        let before = head.head.clone();
        let asked = asked(&head, |c| (c.mesh.triangles, c.mesh.texture_px) = (800, 256));
        let after = head.changed(&asked, &[MeshFormat::Glb], &Quiet).unwrap();
        let mesh = &after.head.mesh;
        assert!((700..=800).contains(&mesh.triangles.len()) && mesh.is_closed(), "{}", mesh.triangles.len());
        let texture = after.head.texture.as_ref().unwrap();
        let lobes = texture.lobes.as_ref().unwrap();
        assert_eq!((texture.color.width, lobes.pictures[0].width), (256, 256 / LOBE_TEXEL));
        assert_eq!(after.head.shells.as_ref().unwrap().layers[0].alphas.len(), mesh.positions.len());
        let glb = after.files(MeshFormat::Glb, "head").unwrap().files.remove(0).1;
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
        let head = || kept(ball(), |c| c.mesh.texture_px = 512);
        let change = |px: u32| {
            let head = head();
            let asked = asked(&head, |c| c.mesh.texture_px = px);
            head.changed(&asked, &[MeshFormat::Glb], &Quiet)
        };
        // an eighth, which is one texel of a gutter of eight
        assert_eq!(change(64).unwrap().head.texture.unwrap().atlas.width, 64);
        let e = change(32).err().unwrap();
        assert_eq!(e.kind().code(), 2, "{e}");
        let wide = {
            let mut head = head();
            head.made.mesh.gutter_px = 4;
            let asked = asked(&head, |c| c.mesh.texture_px = 100);
            head.changed(&asked, &[MeshFormat::Glb], &Quiet).err().unwrap()
        };
        assert!(
            wide.to_string().contains("would run into each other") && wide.hint() == "use 128 or more",
            "{wide:?}"
        );
    }

    #[test]
    fn the_normal_map_keeps_the_material_lit_and_says_so() {
        let head = kept(tetrahedron(), |c| (c.mesh.material, c.mesh.normal_map) = (Material::Lit, true));
        let unlit = asked(&head, |c| c.mesh.material = Material::Unlit);
        let without = asked(&head, |c| (c.mesh.material, c.mesh.normal_map) = (Material::Unlit, false));
        let lit = head.changed(&unlit, &[MeshFormat::Glb], &Quiet).unwrap();
        assert!(lit.warnings[0].contains("`--set mesh.normal_map=false`"), "{:?}", lit.warnings);
        let head = kept(tetrahedron(), |c| (c.mesh.material, c.mesh.normal_map) = (Material::Lit, true));
        let unlit = head.changed(&without, &[MeshFormat::Glb], &Quiet).unwrap();
        assert!(unlit.warnings.is_empty() && unlit.head.texture.as_ref().unwrap().normal.is_none());
        let glb = unlit.files(MeshFormat::Glb, "head").unwrap().files.remove(0).1;
        assert!(String::from_utf8_lossy(&glb).contains("KHR_materials_unlit"));
    }
}
