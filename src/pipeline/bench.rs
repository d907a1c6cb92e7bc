//! Speed against error of each decision, measured on a capture: what `tiface bench` does.
//!
//! Every sweep runs the code of the stages themselves on the same photographs and changes one thing. Errors are taken
//! where nothing was learned from: masked PSNR of some held-out views.

mod surface;
mod training;

use super::line::Line;
use super::render::Renderer;
use super::surface::Fields;
use super::{Stage, complete, learn, pictures};
use crate::capture::scene::Scene;
use crate::capture::{LoadedView, Split, View};
use crate::config::{Config, MeshConfig, Method, ViewBackground};
use crate::geom::{Camera, Mesh};
use crate::image::Photo;
use crate::io::{self, Limits};
use crate::mesh::{Cap, MeshReport, Patches};
use crate::metrics::compare;
use crate::report::bench::{BenchResult, Measure, Sweep, WorkCost};
use crate::{Error, Monitor, Result};
use std::time::Instant;

/// What can be swept, in order.
pub const SWEEPS: [&str; 5] = ["steps", "photographs", "hash", "triangles", "texture"];

/// A capture whose decisions are measured.
pub struct Bench<'l> {
    /// Where fields are trained for it; its run is thrown away.
    line: &'l Line<'l>,
    /// A run whose finished fields are taken instead.
    finished: Option<&'l Line<'l>>,
    scene: Scene,
    judge: Judge<'l>,
    /// Asks to stop when the user does.
    watch: training::StopAt<'l>,
}

impl<'l> Bench<'l> {
    /// On a line whose run is thrown away. The finished fields of another one of the same capture are taken instead of
    /// training some where that is not what is measured.
    ///
    /// # Errors
    ///
    /// The photographs cannot be read, or there is no held-out view.
    pub fn new(line: &'l Line<'l>, finished: Option<&'l Line<'l>>) -> Result<Bench<'l>> {
        complete(line, Stage::Mask, &learn::trained_fields(line))?;
        let (scene, judge) = (line.scene()?, Judge::new(line)?);
        let watch = training::StopAt::new(u64::MAX, line.run.stop());
        Ok(Bench { line, finished, scene, judge, watch })
    }

    /// Nothing measured yet: program, machine and capture.
    pub fn begin(&self) -> BenchResult {
        BenchResult {
            version: env!("CARGO_PKG_VERSION"),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            processor: io::processor(),
            threads: rayon::current_num_threads(),
            capture: self.line.capture.name.clone(),
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
        self.line.config
    }

    fn monitor(&self) -> &dyn Monitor {
        &self.watch
    }

    fn check_stop(&self) -> Result<()> {
        match self.line.run.stop().requested() {
            Some(kind) => Err(Error::stopped("what was measured is kept").with_kind(kind)),
            None => Ok(()),
        }
    }

    /// Trained fields: those of a finished run, else of this one, trained now if need be.
    fn fields(&self, stages: &[Stage]) -> Result<impl Fields + 'l> {
        let done = |line: &&&'l Line<'l>| stages.iter().all(|s| line.run.is_done(&line.plan(*s)));
        let line: &'l Line<'l> = match self.finished.as_ref().filter(done) {
            Some(line) => line,
            None => {
                stages.iter().try_for_each(|stage| training::finish(self.line, *stage))?;
                self.line
            }
        };
        Ok(learn::trained_fields(line))
    }

    /// Cameras that were learned from, in the scene.
    fn cameras(&self) -> Vec<Camera> {
        let views = self.line.capture.split(Split::Train);
        views.map(|v| v.camera.transformed(&self.scene.scene_from_world)).collect()
    }

    /// The extraction, and what closes it.
    fn extracted(&self, fields: &dyn Fields, c: &MeshConfig) -> Result<Extracted> {
        let capture = &self.line.capture;
        let cameras: Vec<Camera> = capture.split(Split::Train).map(|v| v.camera.clone()).collect();
        let field = fields.surface()?;
        let (mesh, report) =
            super::mesh::extract(&self.scene, field, &cameras, capture.up, c, self.monitor())?;
        let (cap, patches) =
            (Cap::of(&mesh, report.bounds(), report.cell_size), Patches::of(&mesh, &report.handles));
        Ok(Extracted { mesh, report, cap, patches })
    }

    /// Millimetres in a unit of the scene.
    fn mm(&self) -> f64 {
        1000.0 * self.config().capture.unit_m / self.scene.scene_from_world.scale
    }
}

/// The whole surface of a field.
struct Extracted {
    mesh: Mesh,
    report: MeshReport,
    cap: Option<Cap>,
    patches: Option<Patches>,
}

/// The figure that views of fields are judged by: those of the same settings and other random numbers differ by as much
/// as its noise.
const PSNR: Measure = Measure { name: "PSNR, dB", digits: 2, more_is_better: Some(true), noise: (0.2, 0.0) };

/// Returns what `work` returns, and what it took.
fn timed<T>(work: impl FnOnce() -> Result<T>) -> Result<(T, WorkCost)> {
    io::forget_peak_memory();
    let (start, cpu) = (Instant::now(), io::cpu_seconds());
    let result = work()?;
    let (wall_s, cpu_s) = (start.elapsed().as_secs_f64(), io::cpu_seconds() - cpu);
    let memory_mib = io::peak_memory().map(|bytes| bytes as f64 / f64::from(1 << 20));
    Ok((result, WorkCost { wall_s, cpu_s, memory_mib }))
}

/// Held-out views that are looked at: each costs seconds in each choice of a sweep.
const VIEWS: usize = 4;

/// Some held-out photographs.
struct Judge<'l> {
    views: Vec<(&'l View, LoadedView, Photo)>,
    background: ViewBackground,
}

impl<'l> Judge<'l> {
    /// Those of a line.
    pub fn new(line: &'l Line<'l>) -> Result<Judge<'l>> {
        let held_out = [Split::Test, Split::Val].map(|s| line.capture.split(s).collect::<Vec<_>>());
        let Some(all) = held_out.into_iter().find(|views| !views.is_empty()) else {
            return Err(Error::cannot(
                "no view of this capture is held out: there is nothing to judge by",
                "name some as `test` in its transforms.json",
            ));
        };
        let count = all.len().min(VIEWS);
        let background = line.config.render.background;
        let views = (0..count).map(|i| {
            let view = all[i * all.len() / count];
            let loaded = line.judged(view).load(&Limits::default())?;
            let expected = pictures::expected(&loaded.photo, loaded.mask.as_ref(), background);
            Ok((view, loaded, expected))
        });
        Ok(Judge { views: views.collect::<Result<_>>()?, background })
    }

    /// Mean PSNR of the views by a method, inside the mask (of the frame without one), dB.
    pub fn psnr(&self, scene: &Scene, renderer: &Renderer, method: Method) -> Result<Option<f64>> {
        let mut found = Vec::new();
        for (view, loaded, expected) in &self.views {
            let camera = view.camera.transformed(&scene.scene_from_world);
            let mut rendered = renderer.view(method, &camera)?.ok_or_else(|| {
                Error::cannot(format!("there is nothing to show for `{}`", method.folder()), "")
            })?;
            if let Some(background) = pictures::behind(self.background) {
                pictures::over(&mut rendered, background);
            }
            let (mask, valid) = (loaded.mask.as_ref(), loaded.valid.as_ref());
            let figures = compare(&view.name, &rendered.color, expected, mask, valid)?;
            found.extend(if mask.is_some() { figures.psnr_masked } else { figures.psnr });
        }
        Ok((!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64))
    }
}
