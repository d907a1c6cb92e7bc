//! Speed against error of each decision, measured on a capture: what `tiface bench` does.
//!
//! Every sweep runs the code of the stages themselves on the same photographs and changes one thing. Errors are taken
//! where nothing was learned from: masked PSNR of some held-out views, and the distance to the true surface where it
//! is known. Times stand beside those of a fixed piece of arithmetic (`meter`).

mod judge;
mod masks;
mod meter;
mod surface;
mod training;
mod views;

use super::line::Line;
use super::surface::Fields;
use super::{Stage, complete, learn};
use crate::capture::Split;
use crate::capture::scene::Scene;
use crate::config::{Config, MeshConfig};
use crate::geom::{Camera, Mesh};
use crate::io;
use crate::mesh::{Cap, MeshReport, Patches};
use crate::report::bench::{BenchResult, Machine, Measure, Sweep};
use crate::run::Fingerprint;
use crate::{Error, Monitor, Result};
use judge::Judge;

/// What can be swept, in order.
pub const SWEEPS: [&str; 9] =
    ["steps", "photographs", "hash", "devices", "extraction", "triangles", "texture", "render", "masks"];

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
    /// training some where that is not what is measured. `truth` is the true surface in the dataset's world.
    ///
    /// # Errors
    ///
    /// The photographs cannot be read, or there is no held-out view.
    pub fn new(
        line: &'l Line<'l>,
        finished: Option<&'l Line<'l>>,
        truth: Option<&Mesh>,
    ) -> Result<Bench<'l>> {
        complete(line, Stage::Mask, &learn::trained_fields(line))?;
        let (scene, judge) = (line.scene()?, Judge::new(line, truth)?);
        let watch = training::StopAt::new(u64::MAX, line.run.stop());
        Ok(Bench { line, finished, scene, judge, watch })
    }

    /// Nothing measured yet: machine, capture, and what shapes the figures.
    pub fn begin(&self) -> BenchResult {
        let machine = Machine {
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            processor: io::processor(),
            threads: rayon::current_num_threads(),
        };
        let mut all = self.line.config.clone();
        all.capture.path.clear();
        let identity = Fingerprint::of_bytes(format!("{} {}", self.line.digest, all.to_toml()).as_bytes());
        BenchResult::new(machine, self.line.capture.name.clone(), identity)
    }

    /// Measures one of [`SWEEPS`] into a result; `None` and a sentence if this capture does not allow it.
    pub fn measure(&self, name: &str, into: &mut BenchResult) -> Result<Option<String>> {
        let sweep = match name {
            "steps" => self.steps()?,
            "photographs" => self.photographs()?,
            "hash" => self.hash()?,
            "devices" => self.devices()?,
            "extraction" => self.extraction()?,
            "triangles" => self.triangles()?,
            "texture" => self.texture()?,
            "render" => self.render()?,
            "masks" => match self.masks()? {
                Some(sweep) => sweep,
                None => return Ok(Some("this capture has no masks to compare with".into())),
            },
            other => {
                let hint = format!("choose among {}", SWEEPS.join(", "));
                return Err(Error::usage(format!("there is no sweep `{other}`"), hint));
            }
        };
        into.sweeps.push(sweep);
        Ok(None)
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

/// The figure that views are judged by.
fn psnr() -> Measure {
    // fields of the same settings and other random numbers differ by as much
    Measure::more("PSNR, dB", 2, 0.2)
}

/// The figure that surfaces are judged by.
fn off_truth() -> Measure {
    Measure::less("off the truth, mm", 3, 0.03)
}

/// One line per place where a sweep's words come together.
fn sweep(name: &str, title: &str, note: String, measures: Vec<Measure>) -> Sweep {
    Sweep { name: name.into(), title: title.into(), note, measures, by_wall: false, rows: Vec::new() }
}
