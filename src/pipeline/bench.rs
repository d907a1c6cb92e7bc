//! The command `tiface bench`: speed against error of design decisions, measured on a capture.
//!
//! Every sweep runs the stages' own code on the same photographs and changes one setting. Errors
//! are measured as masked PSNR of some held-out views. Some sweeps vary the cost of training
//! (steps, photographs' size, the hash grid), others the path from a surface to the head mesh
//! (simplification, texture).

use super::finish::{Finish, photographs};
use super::mesh::{Extraction, extract};
use super::mesh_files::Export;
use super::renderer::{Meshes, Renderer};
use super::session::Session;
use super::surface::Fields;
use super::{complete, learn, pictures};
use crate::config::{ColorSource, Config, Hair, MeshConfig, Method, Stage, ViewBackground};
use crate::field::training::TrainingSession;
use crate::metrics::{compare, distance};
use crate::report::bench::{BenchResult, Measure, Row, Sweep, WorkCost};
use crate::run::{Run, Stop};
use std::borrow::Cow;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;
use tiface_base::geom::{Camera, Mesh, SdfField};
use tiface_base::image::Photo;
use tiface_base::io::{self, Limits};
use tiface_base::math::rank::median;
use tiface_base::{Error, Monitor, Quiet, Result};
use tiface_capture::scene::Scene;
use tiface_capture::{LoadedView, Split, View};
use tiface_surface::files::HeadMesh;
use tiface_surface::{SimplifyConfig, simplify};

/// The available sweeps, in order.
pub const SWEEPS: [&str; 5] = ["steps", "photographs", "hash", "triangles", "texture"];

/// A capture on which decisions are measured.
pub struct Bench<'l> {
    /// The session in which fields are trained; its run is deleted.
    session: &'l Session<'l>,
    /// A run whose finished fields are used instead of training new ones.
    finished: Option<&'l Session<'l>>,
    scene: Scene,
    evaluator: Evaluator,
    /// Set when the user asks to stop.
    watch: StopAt<'l>,
}

impl<'l> Bench<'l> {
    /// Returns a bench on a session whose run is deleted. The finished fields of another run of the
    /// same capture are used where training itself is not measured.
    ///
    /// # Errors
    ///
    /// Fails if the photographs cannot be read, or if there is no held-out view.
    pub fn new(session: &'l Session<'l>, finished: Option<&'l Session<'l>>) -> Result<Bench<'l>> {
        complete(session, Stage::Mask, &learn::trained_fields(session))?;
        let (scene, evaluator) = (session.scene()?, Evaluator::new(session)?);
        let watch = StopAt::new(u64::MAX, session.run.stop());
        Ok(Bench { session, finished, scene, evaluator, watch })
    }

    /// Returns an empty report of a bench with these settings: program, machine, and the sweeps
    /// that it is to have.
    pub fn begin(config: &Config, sweeps: &[&str]) -> BenchResult {
        BenchResult {
            version: env!("CARGO_PKG_VERSION").into(),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            processor: io::processor(),
            threads: rayon::current_num_threads(),
            capture: String::new(),
            settings: config.to_toml(),
            asked: sweeps.iter().map(|sweep| sweep.to_string()).collect(),
            sweeps: Vec::new(),
        }
    }

    /// Measures one of [`SWEEPS`].
    pub fn measure(&self, name: &str) -> Result<Sweep> {
        match name {
            "steps" => self.steps(),
            "photographs" => self.photographs(),
            "hash" => self.hash(),
            "triangles" => self.triangles(),
            "texture" => self.texture(),
            other => {
                let hint = format!("choose among {}", SWEEPS.join(", "));
                Err(Error::usage(format!("there is no sweep `{other}`"), hint))
            }
        }
    }

    fn config(&self) -> &Config {
        self.session.config
    }

    fn monitor(&self) -> &dyn Monitor {
        &self.watch
    }

    fn check_stop(&self) -> Result<()> {
        match self.session.run.stop().requested() {
            Some(kind) => Err(Error::stopped("what was measured is kept").with_kind(kind)),
            None => Ok(()),
        }
    }

    /// Returns trained fields: those of a finished run, else those of this one, trained now if
    /// necessary.
    fn fields(&self, stages: &[Stage]) -> Result<impl Fields + 'l> {
        let done = |session: &&&'l Session<'l>| stages.iter().all(|s| session.run.is_done(&session.plan(*s)));
        let session: &'l Session<'l> = match self.finished.as_ref().filter(done) {
            Some(session) => session,
            None => {
                stages.iter().try_for_each(|stage| train_to_end(self.session, *stage))?;
                self.session
            }
        };
        Ok(learn::trained_fields(session))
    }

    /// Returns the training cameras, in the scene.
    fn cameras(&self) -> Vec<Camera> {
        let capture = self.session.refined_capture().unwrap_or(&self.session.capture);
        let views = capture.split(Split::Train);
        views.map(|v| v.camera.transformed(&self.scene.scene_from_world)).collect()
    }

    /// Returns the extracted surface with its cap and patches.
    fn extracted(&self, fields: &dyn Fields, c: &MeshConfig) -> Result<Extraction> {
        let capture = self.session.refined_capture()?;
        let cameras: Vec<Camera> = capture.split(Split::Train).map(|v| v.camera.clone()).collect();
        extract(&self.scene, fields.surface()?, &cameras, capture.up, c, self.monitor())
    }

    /// Returns the number of millimeters in a scene unit.
    fn mm(&self) -> f64 {
        1000.0 * self.config().capture.unit_m / self.scene.scene_from_world.scale
    }
}

/// The metric that views of fields are evaluated by: two trainings with the same settings and
/// different seeds differ by as much as its noise.
const PSNR: Measure =
    Measure { name: Cow::Borrowed("PSNR, dB"), digits: 2, more_is_better: Some(true), noise: (0.2, 0.0) };

/// Returns the result of `work`, and the time it took.
fn timed<T>(work: impl FnOnce() -> Result<T>) -> Result<(T, WorkCost)> {
    io::forget_peak_memory();
    let (start, cpu) = (Instant::now(), io::cpu_seconds());
    let result = work()?;
    let (wall_s, cpu_s) = (start.elapsed().as_secs_f64(), io::cpu_seconds() - cpu);
    let memory_mib = io::peak_memory().map(|bytes| bytes as f64 / f64::from(1 << 20));
    Ok((result, WorkCost { wall_s, cpu_s, memory_mib }))
}

/// Number of held-out views that are evaluated: each costs seconds for each choice of a sweep.
const VIEWS: usize = 4;

/// A few held-out photographs.
struct Evaluator {
    views: Vec<(View, LoadedView, Photo)>,
    background: ViewBackground,
}

impl Evaluator {
    /// Loads some of a session's.
    pub fn new(session: &Session) -> Result<Evaluator> {
        let capture = session.evaluation_capture()?;
        let held_out = [Split::Test, Split::Val].map(|s| capture.split(s).collect::<Vec<_>>());
        let Some(all) = held_out.into_iter().find(|views| !views.is_empty()) else {
            return Err(Error::cannot(
                "no view of this capture is held out: there is nothing to judge by",
                "name some as `test` in its transforms.json",
            ));
        };
        let count = all.len().min(VIEWS);
        let background = session.config.render.background;
        let views = (0..count).map(|i| {
            let view = all[i * all.len() / count];
            let loaded = view.load(&Limits::default())?;
            let expected = pictures::expected(&loaded.photo, loaded.mask.as_ref(), background);
            Ok((view.clone(), loaded, expected))
        });
        Ok(Evaluator { views: views.collect::<Result<_>>()?, background })
    }

    /// Returns the mean PSNR of the views by a method, inside the mask (of the frame without one),
    /// dB.
    pub fn psnr(&self, scene: &Scene, renderer: &Renderer, method: Method) -> Result<Option<f64>> {
        let mut found = Vec::new();
        for (view, loaded, expected) in &self.views {
            let camera = view.camera.transformed(&scene.scene_from_world);
            let mut rendered = renderer.view(method, &camera)?.ok_or_else(|| {
                Error::cannot(format!("no view can be rendered for `{}`", method.as_str()), "")
            })?;
            if let Some(background) = pictures::background_color(self.background) {
                pictures::over(&mut rendered, background);
            }
            let (mask, valid) = (loaded.mask.as_ref(), loaded.valid.as_ref());
            let figures = compare(&view.name, &rendered.color, expected, mask, valid)?;
            found.extend(if mask.is_some() { figures.psnr_masked } else { figures.psnr });
        }
        Ok((!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64))
    }
}

/// Shares of the training after which a field is evaluated.
const EVALUATED_SHARES: [f64; 5] = [0.125, 0.25, 0.5, 0.75, 1.0];

/// Share of a whole training's steps at which trainings of different settings are compared: the
/// setting that leads after so many steps leads at the end in most cases, and all sweeps should
/// finish in reasonable time.
const COMPARED_SHARE: f64 = 0.2;

/// Asks a training to stop at a step, or when the user asks.
struct StopAt<'a> {
    at: u64,
    reached: AtomicU64,
    stop: &'a Stop,
}

impl<'a> StopAt<'a> {
    /// Returns a limit with no steps done.
    pub fn new(at: u64, stop: &'a Stop) -> StopAt<'a> {
        StopAt { at, reached: AtomicU64::new(0), stop }
    }
}

impl Monitor for StopAt<'_> {
    fn step(&self, step: u64, _: u64, _: &[(&str, f64)]) {
        self.reached.store(step, Ordering::Relaxed);
    }

    fn stop(&self) -> bool {
        self.reached.load(Ordering::Relaxed) >= self.at || self.stop.requested().is_some()
    }
}

/// Returns the number of steps of a stage's whole training.
fn steps(config: &Config, stage: Stage) -> u64 {
    match stage {
        Stage::Iface => config.iface.steps,
        _ => {
            let c = config.radiance(stage);
            c.steps * c.learned() as u64
        }
    }
}

/// Trains a field of a session up to a step, resuming from the current one.
fn train_until(session: &Session, stage: Stage, step: u64) -> Result<()> {
    let monitor = StopAt::new(step, session.run.stop());
    let folder = session.run.path(stage);
    io::create_folder(&folder)?;
    let training = TrainingSession {
        stage: stage.as_str(),
        seed: learn::seed(stage, session.config),
        device: &session.config.device,
        dir: &folder,
        identity: "bench",
        monitor: &monitor,
    };
    match learn::train(stage, session.refined_capture()?, &session.scene()?, session.config, &training) {
        Ok(_) => Ok(()),
        Err(e) if e.kind().is_stop() => match session.run.stop().requested() {
            Some(kind) => Err(Error::stopped("what was measured is kept").with_kind(kind)),
            None => Ok(()),
        },
        Err(e) => Err(e),
    }
}

/// Trains a field of a session to its end.
fn train_to_end(session: &Session, stage: Stage) -> Result<()> {
    train_until(session, stage, u64::MAX)
}

/// Returns the metrics of the views of a session's field.
fn evaluate(session: &Session, stage: Stage, evaluator: &Evaluator) -> Result<Vec<Option<f64>>> {
    let (fields, scene, meshes) =
        (learn::trained_fields(session), session.scene()?, Meshes::load(session.run, session.config, &[])?);
    let method = if stage == Stage::Iface { Method::Volume } else { Method::Tface };
    let renderer = Renderer::new(&scene, &fields, &meshes, 1, &Quiet);
    Ok(vec![evaluator.psnr(&scene, &renderer, method)?])
}

impl Bench<'_> {
    /// Evaluates both fields after shares of their training.
    fn steps(&self) -> Result<Sweep> {
        let session = self.session;
        let mut rows = Vec::new();
        for (series, stage) in [("I-Face", Stage::Iface), ("T-Face", Stage::Tface)] {
            let all = steps(session.config, stage);
            let mut cost = WorkCost::default();
            for share in EVALUATED_SHARES {
                let step = ((all as f64 * share) as u64).max(1);
                cost = cost + timed(|| train_until(session, stage, step))?.1;
                let figures = evaluate(session, stage, &self.evaluator)?;
                rows.push(Row { series: series.into(), choice: format!("{step} steps"), cost, figures });
            }
        }
        let note = "One training of each field, looked at on its way; a time is that of all steps so far, with opening photographs and \
                    checkpoint once for each look.";
        Ok(Sweep {
            name: "steps".into(),
            title: "Training steps".into(),
            note: note.into(),
            measures: vec![PSNR],
            rows,
        })
    }

    /// Evaluates I-Face trained from smaller photographs on full-size ones.
    fn photographs(&self) -> Result<Sweep> {
        let mut rows = Vec::new();
        for times in [4, 2, 1] {
            let mut config = self.short();
            config.capture.downscale *= times;
            let camera = &self.session.capture.views[0].camera;
            rows.push(self.row(format!("{} × {}", camera.width / times, camera.height / times), &config)?);
        }
        let (note, measures) = (self.note("Judged on photographs of full size."), vec![PSNR]);
        Ok(Sweep {
            name: "photographs".into(),
            title: "Size of the photographs".into(),
            note,
            measures,
            rows,
        })
    }

    /// Evaluates I-Face trained with different hash grids.
    fn hash(&self) -> Result<Sweep> {
        let mut rows = Vec::new();
        let whole = (self.config().iface.levels, self.config().iface.log2_table);
        let fewer =
            |n: usize, log2: u32| (whole.0.saturating_sub(n).max(1), whole.1.saturating_sub(log2).max(4));
        for (levels, log2_table) in [fewer(6, 4), fewer(0, 4), fewer(0, 2), whole, (whole.0, whole.1 + 2)] {
            let mut config = self.short();
            (config.iface.levels, config.iface.log2_table) = (levels, log2_table.min(24));
            rows.push(self.row(format!("{levels} levels, 2^{}", config.iface.log2_table), &config)?);
        }
        let note = self.note("Levels, and entries of the largest table.");
        Ok(Sweep { name: "hash".into(), title: "Hash grid".into(), note, measures: vec![PSNR], rows })
    }

    /// Returns the configuration for a share of its steps.
    fn short(&self) -> Config {
        let mut config = self.config().clone();
        config.iface.steps = ((config.iface.steps as f64 * COMPARED_SHARE) as u64).max(1);
        config
    }

    fn note(&self, more: &str) -> String {
        format!("I-Face, {} steps. {more}", self.short().iface.steps)
    }

    /// Trains and evaluates I-Face with other settings.
    fn row(&self, choice: String, config: &Config) -> Result<Row> {
        self.check_stop()?;
        let scratch = tempfile::tempdir_in(self.session.run.dir()).map_err(|e| {
            Error::cannot(format!("no scratch folder: {e}"), "free space, or set TMPDIR to another folder")
        })?;
        let run = Run::open(scratch.path(), self.session.run.stop().clone(), std::sync::Arc::new(Quiet));
        let session = Session::open(config, &run)?;
        complete(&session, Stage::Mask, &learn::trained_fields(&session))?;
        let ((), cost) = timed(|| train_until(&session, Stage::Iface, config.iface.steps))?;
        Ok(Row {
            series: "I-Face".into(),
            choice,
            cost,
            figures: evaluate(&session, Stage::Iface, &self.evaluator)?,
        })
    }
}

/// Number of mesh points that are compared with the field.
const POINTS: usize = 20_000;

/// Numbers of triangles of a simplified mesh.
const TRIANGLES: [usize; 6] = [2000, 5000, 10_000, 20_000, 50_000, 100_000];

impl Bench<'_> {
    /// Returns the median distance of a mesh to the extracted surface, mm.
    fn off_surface(&self, mesh: &Mesh, field: &dyn SdfField) -> Option<f64> {
        let (values, gradients) = field.sdf_gradient(&distance::sample(mesh, POINTS));
        let mut off: Vec<f32> =
            values.iter().zip(&gradients).map(|(f, g)| f.abs() / g.length().max(0.05)).collect();
        median(&mut off, f32::total_cmp).map(|d| f64::from(d) * self.mm())
    }

    /// Measures decreasing numbers of triangles.
    fn triangles(&self) -> Result<Sweep> {
        let fields = self.fields(&[Stage::Iface])?;
        let c = &self.config().mesh;
        let extracted = self.extracted(&fields, c)?;
        let (mesh, surface) = (&extracted.mesh, extracted.distance(fields.surface()?));
        let note = format!(
            "From {} triangles, extracted at {} cells; distances are medians.",
            mesh.triangles.len(),
            c.resolution
        );
        let mut rows = Vec::new();
        for triangles in TRIANGLES.into_iter().filter(|n| *n < mesh.triangles.len()) {
            self.check_stop()?;
            let mut mesh = mesh.clone();
            let config = SimplifyConfig { triangles, ..SimplifyConfig::default() };
            let (_, cost) = timed(|| simplify(&mut mesh, Some(&surface), &config, self.monitor()))?;
            let figures = vec![self.off_surface(&mesh, &surface)];
            rows.push(Row { series: "".into(), choice: triangles.to_string(), cost, figures });
        }
        let measures = vec![Measure {
            name: "off the surface, mm".into(),
            digits: 4,
            more_is_better: Some(false),
            noise: (0.0, 0.03),
        }];
        Ok(Sweep {
            name: "triangles".into(),
            title: "Triangles after simplification".into(),
            note,
            measures,
            rows,
        })
    }

    /// Measures the texture's size, the source of its colors, and their view dependence.
    fn texture(&self) -> Result<Sweep> {
        let fields = self.fields(&[Stage::Iface])?;
        let base = &self.config().mesh;
        let finisher = Finisher::new(self, &fields, base)?;
        let note = format!(
            "`head.glb` of {} triangles as a viewer shows it, without soft layers; the time is that of laying out, baking and \
             fitting.",
            finisher.mesh.triangles.len()
        );
        let plain =
            MeshConfig { lobes: 0, hair: Hair::None, color: ColorSource::Photographs, ..base.clone() };
        let mut choices: Vec<(&'static str, String, MeshConfig)> = Vec::new();
        for texture_px in [256, 512, 1024, 2048] {
            choices.push((
                "from photographs",
                format!("{texture_px}²"),
                MeshConfig { texture_px, ..plain.clone() },
            ));
        }
        for lobes in [1, 2] {
            let word = format!("1024², degree {lobes}");
            choices.push(("view-dependent", word, MeshConfig { texture_px: 1024, lobes, ..plain.clone() }));
        }
        for samples in [1, 2] {
            let word = format!("1024², {} samples", samples * samples);
            let color = ColorSource::Network;
            let c = MeshConfig { texture_px: 1024, texture_samples: samples, color, ..plain.clone() };
            choices.push(("from the network", word, c));
        }
        let mut rows = Vec::new();
        for (series, choice, c) in choices {
            self.check_stop()?;
            let (head, cost) = timed(|| finisher.finish(self, &c))?;
            let triangles = head.mesh.triangles.len() as f64;
            let meshes = Meshes::of_head(head);
            let renderer = Renderer::new(&self.scene, &fields, &meshes, 2, self.monitor());
            let psnr = self.evaluator.psnr(&self.scene, &renderer, Method::Textured)?;
            let figures = vec![psnr, Some(triangles)];
            rows.push(Row { series: series.into(), choice, cost, figures });
        }
        let count = Measure { name: "triangles".into(), digits: 0, more_is_better: None, noise: (0.0, 0.0) };
        let measures = vec![Measure { noise: (0.05, 0.0), ..PSNR }, count];
        Ok(Sweep { name: "texture".into(), title: "Texture".into(), note, measures, rows })
    }
}

/// A simplified surface that is baked repeatedly.
struct Finisher<'f> {
    mesh: Mesh,
    extracted: Extraction,
    fields: &'f dyn Fields,
    views: Vec<LoadedView>,
}

impl<'f> Finisher<'f> {
    /// Extracts and simplifies a surface with the settings `c`.
    pub fn new(bench: &Bench, fields: &'f dyn Fields, c: &MeshConfig) -> Result<Finisher<'f>> {
        let extracted = bench.extracted(fields, c)?;
        let mut mesh = extracted.mesh.clone();
        if c.triangles > 0 && (c.triangles as usize) < mesh.triangles.len() {
            let surface = extracted.distance(fields.surface()?);
            let config = SimplifyConfig { triangles: c.triangles as usize, ..SimplifyConfig::default() };
            simplify(&mut mesh, Some(&surface), &config, bench.monitor())?;
        }
        let views = learn::training_views(bench.session.refined_capture()?, &bench.scene, bench.config())?;
        Ok(Finisher { mesh, extracted, fields, views })
    }

    /// Lays out, bakes and fits with the settings `c`.
    pub fn finish(&self, bench: &Bench, c: &MeshConfig) -> Result<HeadMesh> {
        let (capture, config) = (&bench.session.capture, bench.config());
        let (export, cell) = (Export::new(capture, config), self.extracted.report.cell_size);
        let (surface, cameras) = (self.extracted.distance(self.fields.surface()?), bench.cameras());
        let photographs = photographs(&self.views);
        let finish = Finish {
            surface: &self.mesh,
            cell,
            field: &surface,
            cap: self.extracted.cap.as_ref(),
            cameras: &cameras,
            photographs: &photographs,
            fields: self.fields,
            scene: &bench.scene,
            export: &export,
            config: &MeshConfig { triangles: 0, max_error: 0.0, ..c.clone() },
            monitor: bench.monitor(),
        };
        Ok(finish.run()?.head)
    }
}
