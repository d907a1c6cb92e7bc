//! The line: from photographs to a mesh, views and numbers. The only place where stages meet.
//!
//! ```text
//! mask     which pixels are the head, and where that puts it in space
//! iface    a signed distance learned from the masked photographs
//! mesh     its zero level set, closed, in the dataset's world
//! render   held-out (or other) views, by casting rays at the mesh and by marching the field
//! metrics  those views against the photographs
//! ```
//!
//! What shapes a stage is known before it runs: its settings, and the same of the stages before it.
//! So all fingerprints can be computed at once ([`Line::plan`]), a dry run tells what would be done,
//! and a finished stage is skipped without loading anything. The device is not part of it: it decides
//! how fast a field is learned, not what it is.

mod export;
mod pictures;
mod scene_file;
mod surface;
mod truth;

pub use export::mesh_bytes;
pub use surface::{Exact, Surface};
pub use truth::{Truth, against_truth};

use crate::capture::scene::{self, Scene, SceneError, SceneOptions};
use crate::capture::{self, Capture, CaptureError, CaptureOptions, MaskChoice, Split, View};
use crate::config::{Config, MaskMeaning, MaskSource, MeshFormat, Method};
use crate::geom::{Bvh, Camera, Mesh};
use crate::image::Gray;
use crate::io::{self, Limits};
use crate::mesh::read::ReadMeshError;
use crate::mesh::{self, MeshError};
use crate::metrics::{Metrics, MetricsError, compare};
use crate::render::path::{NamedCamera, PathError, from_json, orbit};
use crate::render::{RaycastOptions, raycast};
use crate::report::{self, Pair, Report};
use crate::run::{Done, Exit, Failure, Fingerprint, Plan, Run, RunError, Stage, read_record};
use glam::Vec3;
use rayon::prelude::*;
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The stages in order.
pub const STAGES: &[&str] = &["mask", "iface", "mesh", "render", "metrics"];

/// Raised when the meaning of a stage's files changes.
const FORMAT: u32 = 1;

/// Why the line stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// The capture cannot be used.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// A stage, or the run folder.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A file the line needs before its stages.
    #[error(transparent)]
    Read(#[from] io::ReadError),
}

impl PipelineError {
    /// How the process should end.
    pub fn exit(&self) -> Exit {
        match self {
            PipelineError::Run(e) => e.exit(),
            _ => Exit::Cannot,
        }
    }

    /// The way out; may be empty.
    pub fn hint(&self) -> String {
        match self {
            PipelineError::Capture(e) => e.hint(),
            PipelineError::Run(e) => e.hint(),
            PipelineError::Read(e) => e.hint(),
        }
    }
}

/// Every stage up to and including `until`, each only if it is not done.
#[cfg(feature = "cpu")]
pub fn reconstruct(line: &Line, until: &str) -> Result<Vec<(&'static str, Done)>, PipelineError> {
    use std::cell::OnceCell;
    let last = STAGES.iter().position(|s| *s == until).unwrap_or(STAGES.len() - 1);
    let field: OnceCell<crate::iface::IFace> = OnceCell::new();
    let learned = || -> Result<&dyn Surface, Failure> {
        if field.get().is_none() {
            let _ = field.set(line.load_field()?);
        }
        field.get().map(|f| f as &dyn Surface).ok_or_else(|| Failure::cannot("no field", ""))
    };
    let mut done = Vec::new();
    for name in &STAGES[..=last] {
        let stage = match *name {
            "mask" => line.mask()?,
            "iface" => line.iface()?,
            "mesh" => line.mesh(&learned)?,
            "render" => line.render(&learned)?,
            _ => line.metrics()?,
        };
        done.push((*name, stage));
    }
    line.report(&done)?;
    Ok(done)
}

/// A capture, its configuration and its run folder.
pub struct Line<'a> {
    capture: Capture,
    config: &'a Config,
    run: &'a Run,
    /// Digest of everything read from the capture.
    digest: String,
    /// Digest of the camera file, if `render.cameras` names one.
    path_digest: String,
    /// Is the capture the demo head, whose surface is known?
    synthetic: bool,
}

impl<'a> Line<'a> {
    /// Opens the capture and reads every byte of it once, for its digest. Nothing is written.
    pub fn open(config: &'a Config, run: &'a Run, synthetic: bool) -> Result<Line<'a>, PipelineError> {
        let capture = capture::open(Path::new(&config.capture.path), &capture_options(config))?;
        let digest = capture_digest(&capture)?;
        let path_digest = match config.render.cameras.as_str() {
            "test" | "train" | "orbit" => String::new(),
            file => Fingerprint::of_bytes(&io::read_bytes(Path::new(file), &Limits::default())?),
        };
        for warning in &capture.warnings {
            run.warn("capture", warning);
        }
        Ok(Line { capture, config, run, digest, path_digest, synthetic })
    }

    /// The capture.
    pub fn capture(&self) -> &Capture {
        &self.capture
    }

    /// What would be done: each stage with `None` if it has to be worked on, else what differs from
    /// the result that lies there (nothing, if it is done). Nothing is written.
    pub fn outlook(&self) -> Result<Vec<(&'static str, Option<Vec<String>>)>, PipelineError> {
        let look = |name: &'static str| {
            let record = read_record(&self.run.path(name))?;
            let now = self.plan(name).fingerprint;
            Ok((name, record.map(|r| now.differences(&r.fingerprint))))
        };
        STAGES.iter().map(|name| look(name)).collect()
    }

    /// Writes the complete configuration into the run: what repeats it. Refused, before anything is
    /// changed, if a stage up to `until` was made or begun with other settings.
    pub fn remember(&self, until: &str) -> Result<(), PipelineError> {
        let last = STAGES.iter().position(|s| *s == until).unwrap_or(STAGES.len() - 1);
        for name in &STAGES[..=last] {
            self.run.agrees(&self.plan(name))?;
        }
        Ok(self.run.write("config.toml", self.config.to_toml().as_bytes())?)
    }

    /// What a stage is about to do; its fingerprint holds those of the stages before it.
    pub fn plan(&self, name: &'static str) -> Plan<'_> {
        let mut settings = self.config.values(name);
        let mut needs_bytes = 16 << 20;
        let mut inputs = Vec::new();
        match name {
            "mask" => {
                settings.extend(self.config.values("capture"));
                settings.remove("capture.path"); // where it lies does not matter, what it holds does
                inputs.push(("capture", self.digest.clone()));
            }
            "iface" => {
                settings.remove("iface.checkpoint_s"); // how often is no matter of what
                settings.insert("seed".into(), self.config.seed.to_string());
                inputs.push(("mask", self.plan("mask").fingerprint.digest()));
                // weights and two moments, for two checkpoints and one being written
                let c = &self.config.iface;
                needs_bytes += (c.levels as u64) << c.log2_table.min(40) << 3 << 3;
            }
            "mesh" => {
                settings.insert("capture.unit_m".into(), self.config.capture.unit_m.to_string());
                inputs.push(("iface", self.plan("iface").fingerprint.digest()));
                // a few triangles per cell of a closed surface, three formats
                needs_bytes += (self.config.mesh.resolution as u64).pow(2) * 12 * 100;
            }
            "render" => {
                inputs.push(("mesh", self.plan("mesh").fingerprint.digest()));
                if !self.path_digest.is_empty() {
                    inputs.push(("cameras", self.path_digest.clone()));
                }
                let pixels = |v: &View| v.camera.width as u64 * v.camera.height as u64;
                needs_bytes += self.capture.views.iter().map(pixels).sum::<u64>() * 12;
            }
            _ => inputs.push(("render", self.plan("render").fingerprint.digest())),
        }
        let mut fingerprint = Fingerprint::new(FORMAT, settings);
        for (name, digest) in inputs {
            fingerprint = fingerprint.input(name, digest);
        }
        Plan { name, fingerprint, device: &self.config.device, needs_bytes }
    }

    /// Stage `mask`: the masks as pictures, and the box and hull they leave (`scene.json`).
    pub fn mask(&self) -> Result<Done, PipelineError> {
        let done = self.run.stage(self.plan("mask"), |stage| {
            let limits = Limits::default();
            let total = self.capture.views.len();
            let mut masks: Vec<Option<Gray>> = Vec::with_capacity(total);
            let mut coverage = Vec::new();
            // a few at a time: decoding is what takes time, and photographs are large
            for (i, views) in self.capture.views.chunks(8).enumerate() {
                let loaded: Vec<_> = views.par_iter().map(|v| v.load_mask(&limits)).collect();
                for (view, mask) in views.iter().zip(loaded) {
                    let mask = mask.map_err(capture_failure)?;
                    if let Some(mask) = &mask {
                        let file = stage.folder().join(format!("{}.png", view.name));
                        io::create_folder(file.parent().unwrap_or(stage.folder()))?;
                        io::write_png_gray(&file, mask)?;
                        coverage.push(capture::coverage(mask));
                    }
                    masks.push(mask);
                }
                stage.monitor().step((8 * (i + 1)).min(total) as u64, total as u64, &[]);
                self.stop_here()?;
            }
            if coverage.is_empty() {
                stage.warn(
                    "no view has a head mask: there is no visual hull to start from, nothing says which pixels \
                     are background, and the box learns whatever it holds; give masks for a head on its own",
                );
            }
            let scene = self.place(stage, masks)?;
            scene_file::write_scene(&stage.folder().join("scene.json"), &scene)?;
            let covered = coverage.iter().sum::<f64>() / coverage.len().max(1) as f64;
            Ok(json!({
                "views": total,
                "masks": coverage.len(),
                "coverage": covered,
                "box": scene::world_box(&scene),
            }))
        })?;
        self.run.write("cameras.json", &scene_file::cameras_json(&self.capture, &self.scene()?))?;
        Ok(done)
    }

    /// Where the head is, from the views that are learned from; held-out ones have no say.
    fn place(&self, stage: &Stage, masks: Vec<Option<Gray>>) -> Result<Scene, Failure> {
        let (mut cameras, mut carving, mut names) = (Vec::new(), Vec::new(), Vec::new());
        for (view, mask) in self.capture.views.iter().zip(masks) {
            if view.split == Split::Train {
                cameras.push(view.camera.clone());
                // what a mask calls "not looked at" may still hold head
                carving.push(mask.filter(|_| self.config.mask.meaning == MaskMeaning::Empty));
                names.push(view.name.clone());
            }
        }
        let options = SceneOptions { names, ..SceneOptions::default() };
        let (scene, warnings) = scene::fit(&cameras, &carving, &options).map_err(|e: SceneError| {
            let hint = e.hint();
            Failure::cannot(e, hint)
        })?;
        warnings.iter().for_each(|w| stage.warn(w));
        Ok(scene)
    }

    /// The box and hull that the stage `mask` found.
    pub fn scene(&self) -> Result<Scene, PipelineError> {
        Ok(scene_file::read_scene(&self.run.path("mask/scene.json"))?)
    }

    /// Stage `iface`: learns the field; goes on from its last checkpoint.
    #[cfg(feature = "cpu")]
    pub fn iface(&self) -> Result<Done, PipelineError> {
        use crate::field::pixels::TrainView;
        use crate::iface;
        let plan = self.plan("iface");
        let identity = plan.fingerprint.digest();
        Ok(self.run.stage(plan, |stage| {
            let scene = self.scene_or_fail()?;
            let limits = Limits::default();
            let train: Vec<&View> = self.capture.split(Split::Train).collect();
            let views: Vec<TrainView> = train
                .par_iter()
                .map(|view| {
                    let loaded = view.load(&limits).map_err(capture_failure)?;
                    Ok(TrainView {
                        camera: view.camera.transformed(&scene.scene_from_world),
                        photo: loaded.photo,
                        mask: loaded.mask,
                        valid: loaded.valid,
                    })
                })
                .collect::<Result<_, Failure>>()?;
            let (config, device) = (&self.config.iface, self.config.device.as_str());
            let hull = bitmask(&scene);
            let (folder, monitor) = (stage.folder(), stage.monitor());
            let trained = iface::train(
                &views,
                hull.as_ref(),
                config,
                self.config.seed,
                device,
                folder,
                &identity,
                monitor,
            );
            let (_, report) = trained.map_err(|e| self.iface_failure(e))?;
            report.warnings.iter().for_each(|w| stage.warn(w));
            Ok(to_value(&report))
        })?)
    }

    #[cfg(feature = "cpu")]
    fn load_field(&self) -> Result<crate::iface::IFace, Failure> {
        let scene = self.scene_or_fail()?;
        let hull = bitmask(&scene);
        crate::iface::IFace::load(&self.run.path("iface"), &self.config.iface, hull.as_ref())
            .map_err(|e| self.iface_failure(e))
    }

    #[cfg(feature = "cpu")]
    fn iface_failure(&self, e: crate::iface::IfaceError) -> Failure {
        use crate::iface::IfaceError;
        match e {
            IfaceError::Stopped { .. } => Failure::stopped(self.run.stop()),
            IfaceError::Device(_) => {
                Failure { exit: Exit::Usage, ..Failure::cannot(e, "choose another with `--device`") }
            }
            e => {
                let hint = e.hint().unwrap_or_default();
                Failure::cannot(e, hint)
            }
        }
    }

    /// Stage `mesh`: the surface in the dataset's world, `head.ply` always, other formats as asked.
    /// `field` is only called if there is something to do.
    pub fn mesh<'f>(&self, field: &Field<'f>) -> Result<Done, PipelineError> {
        Ok(self.run.stage(self.plan("mesh"), |stage| {
            let scene = self.scene_or_fail()?;
            let field = field()?;
            let c = &self.config.mesh;
            let config = mesh::MeshConfig {
                resolution: c.resolution as usize,
                coarse_step: c.coarse_step as usize,
                keep_share: c.keep_share,
                newton_steps: c.newton_steps as usize,
                relax: c.relax,
                verify: c.verify,
                ..mesh::MeshConfig::default()
            };
            let hull = scene.hull.as_ref().map(|hull| |p: Vec3| hull.contains(p));
            let inside_hull = hull.as_ref().map(|f| f as &(dyn Fn(Vec3) -> bool + Sync));
            // the colour of a vertex is what is seen looking straight at it
            let color = |points: &[Vec3], normals: &[Vec3]| {
                let directions: Vec<Vec3> = normals.iter().map(|n| -*n).collect();
                field.color(points, normals, &directions)
            };
            // below the frames' border the surface is a guess: close the mesh where enough cameras look
            let cameras: Vec<Camera> = self.capture.split(Split::Train).map(|v| v.camera.clone()).collect();
            let kept = capture::well_seen(&scene, &cameras, self.capture.up);
            let extracted = mesh::extract(
                |p: &[Vec3]| field.sdf(p),
                |p: &[Vec3]| field.sdf_gradient(p),
                color,
                kept,
                inside_hull,
                &config,
                stage.monitor(),
            );
            let (mesh, report) = extracted.map_err(|e| match e {
                MeshError::Stopped => Failure::stopped(self.run.stop()),
                e => {
                    let hint = e.hint().unwrap_or_default();
                    Failure::cannot(e, hint)
                }
            })?;
            report.warnings().iter().for_each(|w| stage.warn(w));
            let mesh = mesh.transformed(&scene.scene_from_world.inverse());
            let export = self.export();
            // the form that the next stages read comes last
            let formats = c.format.iter().filter(|f| **f != MeshFormat::Ply).chain([&MeshFormat::Ply]);
            for &format in formats {
                let bytes = mesh_bytes(&mesh, format, &export)?;
                io::write_atomic(&stage.folder().join(format!("head.{}", export::ending(format))), &bytes)?;
            }
            let size = mesh.bounds().size() * self.config.capture.unit_m as f32;
            Ok(json!({
                "vertices": mesh.positions.len(),
                "triangles": mesh.triangles.len(),
                "closed": mesh.is_closed(),
                "size_m": size.to_array(),
                "report": report,
            }))
        })?)
    }

    /// How meshes of this line are exported.
    pub fn export(&self) -> export::Export {
        export::Export {
            name: self.capture.name.clone(),
            up: self.capture.up,
            unit_m: self.config.capture.unit_m,
            frame: self.config.mesh.frame,
            cameras: self.capture.views.iter().map(|v| v.camera.position.as_vec3()).collect(),
        }
    }

    /// The mesh of the stage `mesh`, in the dataset's world.
    pub fn read_mesh(&self) -> Result<Mesh, Failure> {
        let path = self.run.path("mesh/head.ply");
        let bytes = io::read_bytes(&path, &Limits::default())?;
        mesh::read::read(&bytes, &path).map_err(|e: ReadMeshError| {
            let hint = e.hint();
            Failure::cannot(e, hint)
        })
    }

    /// Stage `render`: one folder per method, one picture per camera.
    pub fn render<'f>(&self, field: &Field<'f>) -> Result<Done, PipelineError> {
        Ok(self.run.stage(self.plan("render"), |stage| {
            let scene = self.scene_or_fail()?;
            let field = field()?;
            let mesh = self.read_mesh()?.transformed(&scene.scene_from_world);
            let bvh = Bvh::new(&mesh);
            let cameras = self.cameras(&scene)?;
            let c = &self.config.render;
            let world_from_scene = scene.scene_from_world.inverse();
            let background = pictures::behind(c.background);
            let options = RaycastOptions { background, samples: c.samples, world_from_scene };
            let total = (cameras.len() * c.method.len()) as u64;
            let mut made = 0;
            let mut seconds = Map::new();
            for &method in &c.method {
                let mut spent = Duration::ZERO;
                let folder = stage.folder().join(method.folder());
                for NamedCamera { name, camera } in &cameras {
                    let camera = camera.transformed(&scene.scene_from_world);
                    let begin = Instant::now();
                    let view = match method {
                        Method::Raycast => {
                            let color = |p: &[Vec3], n: &[Vec3], d: &[Vec3]| field.color(p, n, d);
                            Some(raycast(&bvh, &mesh, &camera, &options, color))
                        }
                        Method::Volume => field.volume(&camera, &world_from_scene).map(|mut view| {
                            if let Some(background) = background {
                                pictures::over(&mut view, background);
                            }
                            view
                        }),
                    };
                    spent += begin.elapsed();
                    if let Some(view) = view {
                        pictures::write(&folder, name, &view, c.format, self.config.capture.unit_m)?;
                    }
                    made += 1;
                    stage.monitor().step(made, total, &[]);
                    self.stop_here()?;
                }
                let per_view = spent.as_secs_f64() / cameras.len().max(1) as f64;
                seconds.insert(method.folder().to_owned(), json!(per_view));
            }
            let methods: Vec<_> = c.method.iter().map(|m| m.folder()).collect();
            Ok(json!({"cameras": cameras.len(), "methods": methods, "seconds_per_view": seconds}))
        })?)
    }

    /// The cameras to render: named like photographs where they have one.
    fn cameras(&self, scene: &Scene) -> Result<Vec<NamedCamera>, Failure> {
        let wrong = |e: PathError| {
            let hint = e.hint();
            Failure::cannot(e, hint)
        };
        let of = |split: Split| -> Vec<NamedCamera> {
            let named = |v: &View| NamedCamera { name: v.name.clone(), camera: v.camera.clone() };
            self.capture.split(split).map(named).collect()
        };
        let all: Vec<Camera> = self.capture.views.iter().map(|v| v.camera.clone()).collect();
        match self.config.render.cameras.as_str() {
            "test" => Ok([Split::Test, Split::Val, Split::Train]
                .map(of)
                .into_iter()
                .find(|cameras| !cameras.is_empty())
                .unwrap_or_default()),
            "train" => Ok(of(Split::Train)),
            "orbit" => {
                let centre = scene::world_box(scene).center();
                let count = self.config.render.orbit_views as usize;
                orbit(&all, centre, self.capture.up, count).map_err(wrong)
            }
            file => {
                let path = Path::new(file);
                let bytes = io::read_bytes(path, &Limits::default())?;
                let text = String::from_utf8_lossy(&bytes);
                from_json(&text, &all[0]).map_err(wrong)
            }
        }
    }

    /// The rendered pictures that have a photograph: method, view, file.
    fn comparable(&self) -> Vec<(Method, &View, PathBuf)> {
        let c = &self.config.render;
        if !matches!(c.cameras.as_str(), "test" | "train") {
            return Vec::new(); // the same name does not make it the same camera
        }
        let mut found = Vec::new();
        for &method in &c.method {
            let folder = self.run.path("render").join(method.folder());
            for view in &self.capture.views {
                let file = pictures::path(&folder, &view.name, c.format);
                if io::is_file(&file) {
                    found.push((method, view, file));
                }
            }
        }
        found
    }

    /// Stage `metrics`: `metrics.json`, every rendered view against its photograph, inside the mask
    /// and inside the capture's region of interest; and the mesh against the truth where it is known.
    pub fn metrics(&self) -> Result<Done, PipelineError> {
        Ok(self.run.stage(self.plan("metrics"), |stage| {
            let limits = Limits::default();
            let mut out = Map::new();
            let pairs = self.comparable();
            let background = self.config.render.background;
            for &method in &self.config.render.method {
                let ours: Vec<_> = pairs.iter().filter(|(m, ..)| *m == method).collect();
                if ours.is_empty() {
                    continue;
                }
                let measured = ours
                    .par_iter()
                    .map(|(_, view, file)| {
                        let loaded = view.load(&limits).map_err(capture_failure)?;
                        let render = pictures::read(file, self.config.render.format)?;
                        let photo = pictures::expected(&loaded.photo, loaded.mask.as_ref(), background);
                        let against = |mask: Option<&Gray>| {
                            compare(&view.name, &render, &photo, mask, loaded.valid.as_ref())
                                .map_err(metrics_failure)
                        };
                        let region = loaded.region.as_ref().map(|r| against(Some(r))).transpose()?;
                        Ok((against(loaded.mask.as_ref())?, region))
                    })
                    .collect::<Result<Vec<_>, Failure>>()?;
                let (views, regions): (Vec<_>, Vec<_>) = measured.into_iter().unzip();
                let regions: Vec<_> = regions.into_iter().flatten().collect();
                let mut entry = Map::new();
                entry.insert("head".into(), to_value(&Metrics::new(views)));
                if !regions.is_empty() {
                    entry.insert("region".into(), to_value(&Metrics::new(regions)));
                }
                out.insert(method.folder().into(), Value::Object(entry));
            }
            if self.synthetic {
                let points = self.config.metrics.surface_points as usize;
                let truth = against_truth(&self.read_mesh()?, points);
                out.insert("truth_percent_of_head".into(), to_value(&truth));
            }
            let value = Value::Object(out);
            io::write_atomic(&stage.folder().join("metrics.json"), format!("{value:#}\n").as_bytes())?;
            Ok(means(&value))
        })?)
    }

    /// `report.html`, from what lies in the run.
    pub fn report(&self, done: &[(&'static str, Done)]) -> Result<(), PipelineError> {
        let mut pairs = Vec::new();
        for (method, view, file) in self.comparable() {
            if self.config.render.format != crate::config::PictureFormat::Png {
                continue; // browsers show no EXR
            }
            pairs.push(Pair {
                caption: format!("{} · {}", view.name, method.folder()),
                photo: io::read_bytes(&view.photo, &Limits::default())?,
                render: io::read_bytes(&file, &Limits::default())?,
            });
        }
        let log = self.run.path("iface/log.jsonl");
        let log = if io::is_file(&log) { io::read_bytes(&log, &Limits::default())? } else { Vec::new() };
        let summaries: Vec<_> = done.iter().map(|(name, d)| (name.to_string(), d.summary.clone())).collect();
        let html = report::html(&Report {
            title: self.capture.name.clone(),
            summaries,
            curves: report::curves(&String::from_utf8_lossy(&log), &["psnr", "eikonal", "inv_s"]),
            pairs,
            settings: self.config.to_toml(),
        });
        Ok(self.run.write("report.html", html.as_bytes())?)
    }

    fn scene_or_fail(&self) -> Result<Scene, Failure> {
        Ok(scene_file::read_scene(&self.run.path("mask/scene.json"))?)
    }

    fn stop_here(&self) -> Result<(), Failure> {
        match self.run.stop().requested() {
            Some(_) => Err(Failure::stopped(self.run.stop())),
            None => Ok(()),
        }
    }
}

/// Gives the field when it is needed.
pub type Field<'f> = dyn Fn() -> Result<&'f dyn Surface, Failure> + 'f;

/// The part of a metrics file worth a line: means, without the single views.
fn means(metrics: &Value) -> Value {
    match metrics {
        Value::Object(map) => {
            let kept = map.iter().filter(|(key, _)| *key != "views");
            Value::Object(kept.map(|(key, value)| (key.clone(), means(value))).collect())
        }
        other => other.clone(),
    }
}

/// How the configuration opens a capture.
pub fn capture_options(config: &Config) -> CaptureOptions {
    let c = &config.capture;
    CaptureOptions {
        downscale: c.downscale,
        masks: match config.mask.source {
            MaskSource::Auto if c.mask_dir.is_empty() => MaskChoice::Auto,
            MaskSource::Auto | MaskSource::Folder => MaskChoice::Folder(c.mask_dir.clone()),
            MaskSource::Alpha => MaskChoice::Alpha,
            MaskSource::None => MaskChoice::None,
        },
        mask_meaning: match config.mask.meaning {
            MaskMeaning::Empty => capture::MaskMeaning::Empty,
            MaskMeaning::Ignore => capture::MaskMeaning::Ignore,
        },
        unit_m: c.unit_m,
        ..CaptureOptions::default()
    }
}

/// Digest of all that a capture means: cameras, splits and the bytes of every picture.
fn capture_digest(capture: &Capture) -> Result<String, PipelineError> {
    let limits = Limits::default();
    let views = capture
        .views
        .par_iter()
        .map(|view| {
            let mut text = format!("{} {:?} {:?} {}", view.name, view.split, view.camera, view.downscale);
            let mask = match &view.mask {
                capture::MaskSource::File(path) => Some(path),
                _ => None,
            };
            for path in [Some(&view.photo), mask, view.valid.as_ref(), view.region.as_ref()] {
                text += " ";
                if let Some(path) = path {
                    text += &Fingerprint::of_bytes(&io::read_bytes(path, &limits)?);
                }
            }
            Ok(text)
        })
        .collect::<Result<Vec<_>, io::ReadError>>()?;
    Ok(Fingerprint::of_bytes(format!("{} {}", capture.up, views.join("\n")).as_bytes()))
}

fn capture_failure(e: CaptureError) -> Failure {
    let hint = e.hint();
    Failure::cannot(e, hint)
}

fn metrics_failure(e: MetricsError) -> Failure {
    let hint = e.hint();
    Failure::cannot(e, hint)
}

/// Figures as JSON; what is not finite becomes null.
fn to_value(figures: &impl serde::Serialize) -> Value {
    serde_json::to_value(figures).unwrap_or(Value::Null)
}

#[cfg(feature = "cpu")]
fn bitmask(scene: &Scene) -> Option<crate::kernel::march::Bitmask> {
    let hull = scene.hull.as_ref()?;
    Some(crate::kernel::march::Bitmask { resolution: hull.resolution, bits: hull.bits.clone() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::synthetic::{SyntheticOptions, write_capture};
    use crate::config::{Background, Preset};
    use crate::run::{Quiet, Stop};
    use std::sync::Arc;

    /// The line on the demo head with its own formula in the place of a learned field: whatever is
    /// wrong then is not the learning.
    #[test]
    fn the_line_after_learning_keeps_the_exact_head_exact() {
        let dir = tempfile::tempdir().unwrap();
        let options = SyntheticOptions { width: 96, height: 120, train: 12, test: 2, seed: 1 };
        let root = dir.path().join("head");
        write_capture(&root, &options).unwrap();
        let mut config = Config::preset(Preset::Draft);
        config.capture.path = root.to_str().unwrap().into();
        config.mesh.resolution = 128;
        config.mesh.format = vec![MeshFormat::Glb];
        config.metrics.surface_points = 4000;
        config.render.background = Background::None;
        let run = Run::open(&dir.path().join("run"), Stop::new(), Arc::new(Quiet));
        let line = Line::open(&config, &run, true).unwrap();
        line.remember("metrics").unwrap();
        assert_eq!(line.mask().unwrap().summary["masks"], 14);
        let scene = line.scene().unwrap();
        let exact = Exact { world_from_scene: scene.scene_from_world.inverse() };
        let field = || -> Result<&dyn Surface, Failure> { Ok(&exact) };
        let mesh = line.mesh(&field).unwrap();
        assert_eq!(mesh.summary["closed"], true);
        line.render(&field).unwrap();
        let metrics = line.metrics().unwrap();

        // a cell is 0.35 m / 128 = 2.7 mm = 1.1 % of the head; vertices lie on the surface, and the
        // chords between them err by a small part of a cell
        let truth = &metrics.summary["truth_percent_of_head"];
        assert!(truth["accuracy_mean"].as_f64().unwrap() < 0.15, "{truth}");
        assert!(truth["completeness_mean"].as_f64().unwrap() < 0.25, "{truth}");
        // silhouettes agree with the masks: a flat brown head over black is no photograph, but its
        // outline is in the right place
        let file = run.path("render/raycast/012.png");
        let render = pictures::read(&file, config.render.format).unwrap();
        let view = line.capture().views.iter().find(|v| v.name == "012").unwrap();
        let mask = view.load_mask(&Limits::default()).unwrap().unwrap();
        let off = |(p, m): (&[f32; 4], &u8)| (p[3] - *m as f32 / 255.0).abs() as f64;
        let mean = render.data.as_chunks::<4>().0.iter().zip(&mask.values).map(off).sum::<f64>()
            / mask.values.len() as f64;
        assert!(mean < 0.01, "{mean}");

        // all of it again: nothing is loaded, nothing is done
        let never = || -> Result<&dyn Surface, Failure> { panic!("loaded for nothing") };
        for done in [line.mask(), line.mesh(&never), line.render(&never), line.metrics()] {
            assert!(done.unwrap().skipped);
        }
        line.report(&[("metrics", metrics)]).unwrap();
        assert!(run.path("report.html").is_file() && run.path("cameras.json").is_file());
        let glb = io::read_bytes(&run.path("mesh/head.glb"), &Limits::default()).unwrap();
        assert!(glb.starts_with(b"glTF"));
    }

    #[test]
    fn a_changed_setting_changes_its_stage_and_those_after_it_only() {
        let dir = tempfile::tempdir().unwrap();
        let options = SyntheticOptions { width: 32, height: 40, train: 3, test: 1, seed: 1 };
        write_capture(dir.path(), &options).unwrap();
        let run = Run::open(&dir.path().join("run"), Stop::new(), Arc::new(Quiet));
        let digests = |change: fn(&mut Config)| {
            let mut config = Config::preset(Preset::Draft);
            config.capture.path = dir.path().to_str().unwrap().into();
            change(&mut config);
            let line = Line::open(&config, &run, false).unwrap();
            [0, 1, 2, 3, 4].map(|i| line.plan(STAGES[i]).fingerprint.digest())
        };
        let same = |a: &[String; 5], b: &[String; 5]| (0..5).map(|i| a[i] == b[i]).collect::<Vec<_>>();
        let base = digests(|_| {});
        assert_eq!(same(&base, &digests(|c| c.mesh.resolution = 100)), [true, true, false, false, false]);
        assert_eq!(same(&base, &digests(|c| c.seed = 7)), [true, false, false, false, false]);
        assert_eq!(same(&base, &digests(|c| c.capture.downscale = 2)), [false; 5]);
        assert_eq!(same(&base, &digests(|c| c.device = "cpu".into())), [true; 5]);
    }
}
