//! What training costs and brings: steps, photographs' size, the hash grid.

use super::{Bench, Judge, PSNR, timed};
use crate::config::{Config, Method};
use crate::field::training::TrainingSession;
use crate::io;
use crate::pipeline::line::Line;
use crate::pipeline::render::{Meshes, Renderer};
use crate::pipeline::{Stage, complete, learn};
use crate::report::bench::{Row, Sweep, WorkCost};
use crate::run::{Run, Stop};
use crate::{Error, Monitor, Quiet, Result};
use std::sync::atomic::{AtomicU64, Ordering};

/// Shares of the training after which a field is looked at.
const SHARES: [f64; 5] = [0.125, 0.25, 0.5, 0.75, 1.0];

/// Of the steps of a whole training, where trainings of other settings are compared: what is ahead after so many
/// steps is ahead at the end in most cases, and all sweeps are to end while somebody waits.
const SHORT: f64 = 0.2;

/// Asks a training to stop at a step, or when the user asks.
pub(super) struct StopAt<'a> {
    at: u64,
    reached: AtomicU64,
    stop: &'a Stop,
}

impl<'a> StopAt<'a> {
    /// No step is done yet.
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

/// Steps of a stage's whole training.
fn steps(config: &Config, stage: Stage) -> u64 {
    match stage {
        Stage::Iface => config.iface.steps,
        _ => {
            let c = config.radiance(stage);
            c.steps * c.learned() as u64
        }
    }
}

/// Trains a field of a line up to a step; goes on from where it is.
fn train_until(line: &Line, stage: Stage, step: u64) -> Result<()> {
    let monitor = StopAt::new(step, line.run.stop());
    let folder = line.run.path(stage);
    io::create_folder(&folder)?;
    let session = TrainingSession {
        stage: stage.word(),
        seed: learn::seed(stage, line.config),
        device: &line.config.device,
        dir: &folder,
        identity: "bench",
        monitor: &monitor,
    };
    match learn::train(stage, &line.capture, &line.scene()?, line.config, &session) {
        Ok(_) => Ok(()),
        Err(e) if e.kind().is_stop() => match line.run.stop().requested() {
            Some(kind) => Err(Error::stopped("what was measured is kept").with_kind(kind)),
            None => Ok(()),
        },
        Err(e) => Err(e),
    }
}

/// Trains a field of a line to its end.
pub(super) fn finish(line: &Line, stage: Stage) -> Result<()> {
    train_until(line, stage, u64::MAX)
}

/// What views of a line's field are worth.
fn judged(line: &Line, stage: Stage, judge: &Judge) -> Result<Vec<Option<f64>>> {
    let (fields, scene, meshes) = (learn::trained_fields(line), line.scene()?, Meshes::load(line, &[])?);
    let method = if stage == Stage::Iface { Method::Volume } else { Method::Tface };
    let renderer = Renderer::new(&scene, &fields, &meshes, 1, &Quiet);
    Ok(vec![judge.psnr(&scene, &renderer, method)?])
}

impl Bench<'_> {
    /// Both fields after shares of their training.
    pub(super) fn steps(&self) -> Result<Sweep> {
        let line = self.line;
        let mut rows = Vec::new();
        for (series, stage) in [("I-Face", Stage::Iface), ("T-Face", Stage::Tface)] {
            let all = steps(line.config, stage);
            let mut cost = WorkCost::default();
            for share in SHARES {
                let step = ((all as f64 * share) as u64).max(1);
                cost = cost + timed(|| train_until(line, stage, step))?.1;
                let figures = judged(line, stage, &self.judge)?;
                rows.push(Row { series, choice: format!("{step} steps"), cost, figures });
            }
        }
        let note = "One training of each field, looked at on its way; a time is that of all steps so far, with opening photographs and \
                    checkpoint once for each look.";
        Ok(Sweep { name: "steps", title: "Training steps", note: note.into(), measures: vec![PSNR], rows })
    }

    /// I-Face trained from smaller photographs, judged on whole ones.
    pub(super) fn photographs(&self) -> Result<Sweep> {
        let mut rows = Vec::new();
        for times in [4, 2, 1] {
            let mut config = self.short();
            config.capture.downscale *= times;
            let camera = &self.line.capture.views[0].camera;
            rows.push(self.row(format!("{} × {}", camera.width / times, camera.height / times), &config)?);
        }
        let (note, measures) = (self.note("Judged on photographs of full size."), vec![PSNR]);
        Ok(Sweep { name: "photographs", title: "Size of the photographs", note, measures, rows })
    }

    /// I-Face trained with other hash grids.
    pub(super) fn hash(&self) -> Result<Sweep> {
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
        Ok(Sweep { name: "hash", title: "Hash grid", note, measures: vec![PSNR], rows })
    }

    /// The configuration for a share of its steps.
    fn short(&self) -> Config {
        let mut config = self.config().clone();
        config.iface.steps = ((config.iface.steps as f64 * SHORT) as u64).max(1);
        config
    }

    fn note(&self, more: &str) -> String {
        format!("I-Face, {} steps. {more}", self.short().iface.steps)
    }

    /// Trains and judges I-Face of other settings.
    fn row(&self, choice: String, config: &Config) -> Result<Row> {
        self.check_stop()?;
        let scratch = tempfile::tempdir_in(self.line.run.dir()).map_err(|e| {
            Error::cannot(format!("no scratch folder: {e}"), "free space, or name another place in TMPDIR")
        })?;
        let run = Run::open(scratch.path(), self.line.run.stop().clone(), std::sync::Arc::new(Quiet));
        let line = Line::open(config, &run)?;
        complete(&line, Stage::Mask, &learn::trained_fields(&line))?;
        let ((), cost) = timed(|| train_until(&line, Stage::Iface, config.iface.steps))?;
        Ok(Row { series: "I-Face", choice, cost, figures: judged(&line, Stage::Iface, &self.judge)? })
    }
}
