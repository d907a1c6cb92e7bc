//! Stage `mesh`: the zero level set of the trained distance field, smoothed, moved to the outlines
//! of the masks and closed, in the dataset's world; and the head mesh made from it.
//!
//! ```text
//! mesh/surface.ply   the whole extraction with colors at its vertices, in the dataset's world
//!      parts         the same and the head mesh, for the stages after this one
//!      head.glb …    the head mesh as files
//!      seen_by.png   how many cameras see each texel: black for none, white for three and more
//!      frames.json   the transform from the dataset's world to GLB and OBJ files
//! ```

use super::advice::{advised, sentence};
use super::finish::{Finish, FinishedHead, REACH, photographs};
use super::learn;
use super::mesh_files::Export;
use super::surface::{CappedField, Fields, Surface};
use crate::config::{ColorSource, Config, Genus, Hair, MeshConfig, Stage};
use crate::run::{Phase, Record, Run, StageDir, StageStatus, Status};
use glam::{DVec3, Vec3};
use serde_json::{Value, json};
use std::path::Path;
use tiface_base::geom::{Aabb, Camera, Mesh, Similarity};
use tiface_base::image::Image;
use tiface_base::io::{self, Limits};
use tiface_base::{Error, ErrorKind, Monitor, Result};
use tiface_capture::scene::Scene;
use tiface_capture::{self as capture, Capture, Split};
use tiface_surface::bake::{Seen, seen_colors, seen_map, seen_shares};
use tiface_surface::files::{ExportOptions, ExportedFiles, ExtractedSurface, HeadMesh, read, to_ply};
use tiface_surface::{
    self, Cap, HandleReport, MAX_HANDLE, MeshDistance, MeshReport, OutlineReport, Photograph,
};

/// Runs the stage `mesh`: writes the whole surface as `surface.ply` in the dataset's world, and the
/// head mesh in the configured formats.
pub(super) fn mesh(
    capture: &Capture,
    scene: &Scene,
    fields: &dyn Fields,
    config: &Config,
    dir: &StageDir,
) -> Result<Value> {
    let (c, field) = (&config.mesh, fields.surface()?);
    let (world_from_scene, export) = (scene.scene_from_world.inverse(), Export::new(capture, config));
    let cameras: Vec<Camera> = capture.split(Split::Train).map(|v| v.camera.clone()).collect();
    let views = match c.color {
        ColorSource::Network if c.hair == Hair::None => Vec::new(),
        _ => learn::training_views(capture, scene, config)?,
    };
    let photographs = photographs(&views);
    let mut extracted = extract(scene, field, &cameras, capture.up, c, dir.monitor())?;
    let outlines = if c.dense { None } else { extracted.fit_outlines(&photographs, dir.monitor())? };
    let mm = world_from_scene.scale * export.unit_m * 1000.0;
    extracted.announce(c.cap, mm, dir);
    extracted.end(c.cap);
    let cameras: Vec<Camera> = cameras.iter().map(|c| c.transformed(&scene.scene_from_world)).collect();
    let reach = REACH * extracted.report.cell_size;
    extracted.mesh.seen_by = Seen::of(&extracted.mesh, &cameras, &[], reach).cameras;
    // the extraction took longest, so it is kept even if a later step fails
    let in_world = ExportOptions {
        stem: "surface".into(),
        world_from_mesh: world_from_scene,
        ..ExportOptions::default()
    };
    write_files(&to_ply(&extracted.mesh, None, &in_world).map_err(advised)?, dir.folder())?;
    // vertices have the color seen along the normal; textures and rays, and so their cap, have the
    // color that cameras see
    extracted.shade_cap(field, &cameras);
    let finish = Finish {
        surface: &extracted.mesh,
        cell: extracted.report.cell_size,
        field: &extracted.distance(field),
        cap: extracted.cap.as_ref().filter(|_| c.cap),
        cameras: &cameras,
        photographs: &photographs,
        fields,
        scene,
        export: &export,
        config: c,
        monitor: dir.monitor(),
    };
    let FinishedHead { head, linear, report: steps, warnings } = finish.run()?;
    warnings.iter().for_each(|w| dir.warn(w));
    let Extraction { mesh: surface, report, cap } = extracted;
    let surface_triangles = surface.triangles.len();
    let plain = Mesh { colors: Vec::new(), seen_by: Vec::new(), ..surface };
    ExtractedSurface { mesh: plain, cap: cap.filter(|_| c.cap) }.save(&dir.folder().join("parts"))?;
    write_head(&head, linear, &export, c, dir)?;
    let shares = seen_shares(&head.mesh);
    seen_note(shares).iter().for_each(|text| dir.note(text));
    let mut summary = shape(&head, &export);
    summary["seen_by"] = json!(shares);
    summary["surface_triangles"] = json!(surface_triangles);
    summary["handles"] = handles(&report.handles, mm);
    summary["report"] = json!(report);
    summary["outlines"] = json!(outlines);
    summary["steps"] = Value::Object(steps);
    Ok(summary)
}

/// Writes the head mesh, its frames, its linear color, and its files in the configured formats.
fn write_head(
    head: &HeadMesh,
    linear: Option<Image>,
    export: &Export,
    c: &MeshConfig,
    dir: &StageDir,
) -> Result<()> {
    let frames = export.frames(&head.mesh, &head.world_from_scene)?;
    let frames = json!({"file_from_world": frames.file_from_world()});
    io::write_atomic(&dir.folder().join("frames.json"), format!("{frames:#}\n").as_bytes())?;
    head.save(&dir.folder().join("parts"))?;
    if let Some(texture) = &head.texture {
        let map = seen_map(&head.mesh, &texture.atlas, c.gutter_px);
        io::write_png_gray(&dir.folder().join("seen_by.png"), &map)?;
    }
    if let Some(linear) = linear {
        write_exr(&linear, &dir.folder().join("head.exr"))?;
    }
    for &format in &c.format {
        let exported = export.files(head, format, "head")?;
        exported.warnings.iter().for_each(|w| dir.warn(w));
        write_files(&exported, dir.folder())?;
    }
    Ok(())
}

/// Returns the figures of a head mesh for the stage's record.
fn shape(head: &HeadMesh, export: &Export) -> Value {
    let HeadMesh { mesh, world_from_scene, texture, .. } = head;
    // without the translation, which f32 may not represent
    let in_place = Similarity { translation: DVec3::ZERO, ..*world_from_scene };
    let size = mesh.transformed(&in_place).bounds().size() * export.unit_m as f32;
    let height = export.height(mesh, world_from_scene);
    json!({
        "shows": export.shows(mesh, world_from_scene),
        "height_units": height,
        "height_m": height * export.unit_m,
        "vertices": mesh.positions.len(),
        "triangles": mesh.triangles.len(),
        "closed": mesh.is_closed(),
        "texture_px": texture.as_ref().map_or(0, |t| t.color.width),
        "size_m": size.to_array(),
    })
}

/// Shares of the surface below which it is not said who saw it.
const WORTH_SAYING: f64 = 0.01;

/// Says how much of a surface no camera and only one saw, by the shares that 0, 1, 2, and 3 or more
/// cameras see; `None` where all but a hundredth was seen.
pub(super) fn seen_note([none, one, ..]: [f64; 4]) -> Option<String> {
    (none >= WORTH_SAYING).then(|| {
        format!(
            "{:.0} % of this surface was seen by no camera, {:.0} % by one: shape and color there follow what lies around",
            100.0 * none,
            100.0 * one
        )
    })
}

/// The whole surface of a field, in scene coordinates.
pub(super) struct Extraction {
    pub mesh: Mesh,
    pub report: MeshReport,
    /// The cap where the frames cut the body; `None` for a dense extraction.
    pub cap: Option<Cap>,
}

impl Extraction {
    /// Returns the surface as a field, with its cap: what the steps after the extraction are held
    /// against. It is smoother than the zero set of `field`, whose colors it has, and as large as
    /// the masks say.
    pub fn distance<'a>(&'a self, field: &'a dyn Surface) -> MeshDistance<'a, CappedField<'a>> {
        MeshDistance::new(&self.mesh, CappedField { field, hull: None, cap: self.cap.as_ref() })
    }

    /// Moves the surface to the outlines of the photographs' masks; the cap stays.
    fn fit_outlines(
        &mut self,
        photographs: &[Photograph],
        monitor: &dyn Monitor,
    ) -> Result<Option<OutlineReport>> {
        let Extraction { mesh, report, cap } = self;
        let capped = |p: &Vec3| cap.as_ref().is_some_and(|cap| cap.holds(*p));
        let fixed: Vec<bool> = mesh.positions.iter().map(capped).collect();
        let fitted = tiface_surface::fit_outlines(mesh, &fixed, photographs, monitor)?;
        // the skin around the cap has moved
        *cap = cap.as_ref().and_then(|_| Cap::find(mesh, report.bounds(), report.cell_size));
        report.volume = mesh.signed_volume();
        Ok(fitted)
    }

    /// Tells how the surface ends and what is doubtful of it; `mm` is the number of millimeters in
    /// a scene unit.
    fn announce(&self, capped: bool, mm: f64, dir: &StageDir) {
        self.report.end(capped).iter().for_each(|text| dir.note(text));
        let warnings = self.report.warnings().into_iter().chain(self.report.handles.warning(mm));
        warnings.for_each(|w| dir.warn(&sentence(&w)));
    }

    /// Paints the cap, or opens the surface where it is.
    fn end(&mut self, capped: bool) {
        match &self.cap {
            Some(cap) if capped => cap.paint(&mut self.mesh),
            Some(cap) => {
                cap.open(&mut self.mesh);
            }
            None => {}
        }
    }

    /// Gives the cap the colors that cameras see of the surface; the cameras are in the scene.
    fn shade_cap(&mut self, field: &dyn Surface, cameras: &[Camera]) {
        let reach = REACH * self.report.cell_size;
        if let Some(cap) = &mut self.cap {
            cap.shade(|p, n| seen_colors(&self.mesh, p, n, field, cameras, reach));
        }
    }
}

/// Extracts the whole surface with colors at its vertices, closed where the training cameras'
/// frames end.
pub(super) fn extract(
    scene: &Scene,
    field: &dyn Surface,
    cameras: &[Camera],
    up: Vec3,
    c: &MeshConfig,
    monitor: &dyn Monitor,
) -> Result<Extraction> {
    let (mesh, report) = if c.dense {
        tiface_surface::extract_dense(field, Aabb::SCENE, c.resolution as usize, monitor)
    } else {
        let options = tiface_surface::ExtractOptions {
            resolution: c.resolution as usize,
            longest_handle: if c.genus == Genus::Simple { MAX_HANDLE } else { 0.0 },
            smooth: true,
            ..tiface_surface::ExtractOptions::default()
        };
        let field = CappedField { field, hull: scene.hull.as_ref(), cap: None };
        // below the frames' border the surface is a guess: close the mesh where enough cameras see
        // it
        let kept = capture::well_seen(scene, cameras, up, c.seen_by);
        tiface_surface::extract(&field, kept, &options, monitor)
    }
    .map_err(advised)?;
    let cap = (!c.dense).then(|| Cap::find(&mesh, report.bounds(), report.cell_size));
    Ok(Extraction { mesh, report, cap: cap.flatten() })
}

/// Writes files; the mesh file comes last, because it refers to the others.
fn write_files(exported: &ExportedFiles, folder: &Path) -> Result<()> {
    for (name, bytes) in exported.files.iter().rev() {
        io::write_atomic(&folder.join(name), bytes)?;
    }
    Ok(())
}

fn write_exr(linear: &Image, path: &Path) -> Result<()> {
    let [r, g, b] = [0, 1, 2].map(|k| linear.channel(k));
    let channels = [("R", &r[..]), ("G", &g[..]), ("B", &b[..])];
    Ok(io::write_exr(path, linear.width, linear.height, &channels)?)
}

/// Returns the stage's record in a run.
///
/// # Errors
///
/// Fails if the stage is not done; the error says whether a process works on it.
pub(super) fn finished_mesh(run: &Path) -> Result<Record> {
    let StageStatus { phase, status, record, .. } = StageStatus::read(&run.join(Stage::Mesh), Stage::Mesh);
    let shown = run.display();
    record.ok_or_else(|| match status.filter(|_| phase == Phase::Running) {
        Some(Status { pid, host, .. }) => Error::not_now(
            format!("the mesh of the run `{shown}` is being made right now, by process {pid} on {host}"),
            format!("wait for it: `tiface status {shown}` says how far it is; then repeat the command"),
        ),
        None => Error::cannot(
            format!("the run `{shown}` has no mesh yet"),
            format!("make one: `tiface mesh {shown}`"),
        ),
    })
}

/// Reads what the stage left in a run, with its record.
///
/// # Errors
///
/// Returns the same as [`finished_mesh`] and `read`. Files may be missing, or of two makings, if
/// another process began the stage again meanwhile; the error then says so instead.
pub(super) fn read_finished<T>(run: &Path, read: impl FnOnce(&Record) -> Result<T>) -> Result<T> {
    let record = finished_mesh(run)?;
    let found = read(&record);
    match finished_mesh(run) {
        Ok(now) if now == record => found,
        Err(e) if e.kind() == ErrorKind::NotNow => Err(e),
        _ => {
            let shown = run.display();
            Err(Error::not_now(
                format!("the mesh of the run `{shown}` was begun again while it was read"),
                format!("`tiface status {shown}` says how far it is; repeat the command when it is done"),
            ))
        }
    }
}

/// Returns the head mesh that the stage wrote.
pub(super) fn head_mesh(run: &Run) -> Result<HeadMesh> {
    HeadMesh::load(&run.path("mesh/parts")).map_err(advised)
}

/// Returns the extracted surface that the stage wrote, in scene coordinates, as it was before
/// export.
pub(super) fn extracted_surface(run: &Run) -> Result<ExtractedSurface> {
    ExtractedSurface::load(&run.path("mesh/parts")).map_err(advised)
}

/// Returns the extracted surface that the stage wrote, in the dataset's world.
pub(super) fn surface_in_world(run: &Run) -> Result<Mesh> {
    let path = run.path("mesh/surface.ply");
    read(&io::read_bytes(&path, &Limits::default())?, &path)
}

/// Describes how many handles were cut, filled or left, with lengths in millimeters.
fn handles(report: &HandleReport, mm: f64) -> Value {
    let each = |lengths: &[f32]| lengths.iter().map(|&l| f64::from(l) * mm).collect::<Vec<_>>();
    json!({
        "cut_mm": each(&report.cut),
        "filled_mm": each(&report.filled),
        "left": report.left,
        "left_mm": report.left_length.map(|l| f64::from(l) * mm),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::Plan;
    use tiface_base::Fingerprint;

    #[test]
    fn what_no_camera_saw_is_said_from_a_hundredth_on() {
        assert_eq!(seen_note([0.009, 0.5, 0.1, 0.391]), None);
        let said = seen_note([0.297, 0.081, 0.1, 0.522]).unwrap();
        assert!(said.starts_with("30 % of this surface was seen by no camera, 8 % by one"), "{said}");
    }

    #[test]
    fn a_mesh_that_is_made_again_is_not_read_half() {
        let dir = tempfile::tempdir().unwrap();
        let run = Run::quiet(dir.path());
        let plan = || Plan {
            name: "mesh",
            fingerprint: Fingerprint::default(),
            device: "cpu",
            needs_bytes: 0,
            saves: false,
        };
        let read = |found: Result<()>| read_finished(dir.path(), |_| found).unwrap_err();
        let damaged = || Err(Error::cannot("half a file", ""));
        assert!(read(Ok(())).to_string().contains("has no mesh yet"));
        run.stage(plan(), |_| Ok(Value::Null)).unwrap();
        assert_eq!(read_finished(dir.path(), |record| Ok(record.stage.clone())).unwrap(), "mesh");
        assert_eq!(read(damaged()).to_string(), "half a file");
        // cleared while it is read
        for found in [Ok(()), damaged()] {
            let anew = |_: &Record| run.fresh(&["mesh".into()]).and(found);
            let error = read_finished(dir.path(), anew).unwrap_err();
            assert_eq!(error.kind().code(), 75, "{error}");
            assert!(error.to_string().contains("was begun again while it was read"), "{error}");
            // at work on it
            let work = |_: &StageDir| {
                let error = read(damaged());
                assert!(error.kind().code() == 75 && error.to_string().contains("right now"), "{error}");
                Ok(Value::Null)
            };
            run.stage(plan(), work).unwrap();
        }
    }
}
