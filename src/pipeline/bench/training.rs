//! What training costs and brings: steps, photographs' size, the hash grid, devices.

use super::judge::Judge;
use super::meter::{self, peak_mib};
use super::{Bench, off_truth, psnr, sweep};
use crate::capture::scene::Scene;
use crate::config::{Config, Method};
use crate::field::training::TrainingSession;
use crate::io::{self, forget_peak_memory};
use crate::pipeline::line::Line;
use crate::pipeline::render::{Meshes, Renderer};
use crate::pipeline::surface::Fields;
use crate::pipeline::{Stage, complete, learn};
use crate::report::bench::{Round, Row, Sweep};
use crate::run::{Run, Stop};
use crate::{Error, Monitor, Quiet, Result};
use std::sync::atomic::{AtomicU64, Ordering};

/// Shares of the training after which a field is looked at.
const SHARES: [f64; 5] = [0.125, 0.25, 0.5, 0.75, 1.0];

/// Of the steps of a whole training, where trainings of other settings are compared: what is ahead after so many
/// steps is ahead at the end in most cases, and all sweeps are to end while somebody waits.
const SHORT: f64 = 0.2;

/// The same where only the time of a step is asked for.
const SHORTER: f64 = 0.05;

/// Cells along the longest side of the surfaces that are measured after a training.
const RESOLUTION: u32 = 192;

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

/// What views and the surface of a line's field are worth.
fn judged(line: &Line, stage: Stage, judge: &Judge) -> Result<Vec<Option<f64>>> {
    let (fields, scene) = (learn::trained_fields(line), line.scene()?);
    let method = if stage == Stage::Iface { Method::Volume } else { Method::Tface };
    let meshes = Meshes::load(line, &[])?;
    let renderer = Renderer::new(&scene, &fields, &meshes, 1, &Quiet);
    let psnr = judge.psnr(judge.render(&scene, &renderer, method)?)?;
    let off = if stage == Stage::Iface { surface_off(line, &fields, &scene, judge)? } else { None };
    Ok(vec![psnr, off])
}

/// How far the surface of a line's field is from the truth; `None` also while there is no surface yet.
fn surface_off(line: &Line, fields: &dyn Fields, scene: &Scene, judge: &Judge) -> Result<Option<f64>> {
    let cameras: Vec<_> =
        line.capture.split(crate::capture::Split::Train).map(|v| v.camera.clone()).collect();
    let config = crate::config::MeshConfig { resolution: RESOLUTION, ..line.config.mesh.clone() };
    let (field, up) = (fields.surface()?, line.capture.up);
    match crate::pipeline::mesh::extract(scene, field, &cameras, up, &config, &Quiet) {
        Ok((mesh, _)) => Ok(judge.off_truth(&mesh, scene)),
        Err(e) if e.kind().is_stop() => Err(e),
        Err(_) => Ok(None),
    }
}

impl Bench<'_> {
    /// Both fields after shares of their training.
    pub(super) fn steps(&self) -> Result<Sweep> {
        let line = self.line;
        let note = "One training of each field, looked at on its way; a time is that of all steps so far, with opening photographs and \
                    checkpoint once for each look.";
        let mut sweep = sweep("steps", "Training steps", note.into(), vec![psnr(), off_truth()]);
        for (series, stage) in [("I-Face", Stage::Iface), ("T-Face", Stage::Tface)] {
            let all = steps(line.config, stage);
            let (mut rounds, mut memory): (Vec<Round>, Option<f64>) = (Vec::new(), None);
            for share in SHARES {
                let step = ((all as f64 * share) as u64).max(1);
                let part = meter::once(|| train_until(line, stage, step));
                part.result?;
                rounds.extend(part.rounds);
                memory = memory.into_iter().chain(part.memory).reduce(f64::max);
                sweep.rows.push(Row {
                    series: series.into(),
                    choice: format!("{step} steps"),
                    rounds: rounds.clone(),
                    parts: true,
                    memory_mib: memory,
                    figures: judged(line, stage, &self.judge)?,
                });
            }
        }
        Ok(sweep)
    }

    /// I-Face trained from smaller photographs, judged on whole ones.
    pub(super) fn photographs(&self) -> Result<Sweep> {
        let note = self.short_note("Judged on photographs of full size.");
        let mut sweep = sweep("photographs", "Size of the photographs", note, vec![psnr(), off_truth()]);
        for times in [4, 2, 1] {
            let mut config = self.short(SHORT);
            config.capture.downscale *= times;
            let camera = &self.line.capture.views[0].camera;
            let choice = format!("{} × {}", camera.width / times, camera.height / times);
            sweep.rows.push(self.row("I-Face", choice, &config)?);
        }
        Ok(sweep)
    }

    /// I-Face trained with other hash grids.
    pub(super) fn hash(&self) -> Result<Sweep> {
        let note = self.short_note("Levels, and entries of the largest table.");
        let mut sweep = sweep("hash", "Hash grid", note, vec![psnr(), off_truth()]);
        let whole = (self.config().iface.levels, self.config().iface.log2_table);
        let fewer =
            |n: usize, log2: u32| (whole.0.saturating_sub(n).max(1), whole.1.saturating_sub(log2).max(4));
        for (levels, log2_table) in [fewer(6, 4), fewer(0, 4), fewer(0, 2), whole, (whole.0, whole.1 + 2)] {
            let mut config = self.short(SHORT);
            (config.iface.levels, config.iface.log2_table) = (levels, log2_table.min(24));
            let choice = format!("{levels} levels, 2^{}", config.iface.log2_table);
            sweep.rows.push(self.row("I-Face", choice, &config)?);
        }
        Ok(sweep)
    }

    /// I-Face trained on each device there is.
    pub(super) fn devices(&self) -> Result<Sweep> {
        let note = format!("{} steps of I-Face: the same result, sooner.", self.short(SHORTER).iface.steps);
        let mut sweep = sweep("devices", "Devices", note, vec![psnr()]);
        // more threads cost the same work and save waiting
        sweep.by_wall = true;
        let all = rayon::current_num_threads();
        let mut counts: Vec<usize> =
            std::iter::successors(Some(1), |n| Some(2 * n)).take_while(|n| *n < all).collect();
        counts.push(all);
        for threads in counts {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let pool = pool.map_err(|e| Error::cannot(format!("no {threads} threads: {e}"), "try again"))?;
            let mut row = pool.install(|| {
                self.row(
                    "CPU",
                    format!("{threads} {}", if threads == 1 { "thread" } else { "threads" }),
                    &self.short(SHORTER),
                )
            })?;
            row.figures.truncate(1);
            sweep.rows.push(row);
        }
        Ok(sweep)
    }

    /// The configuration for a share of its steps.
    fn short(&self, share: f64) -> Config {
        let mut config = self.config().clone();
        config.iface.steps = ((config.iface.steps as f64 * share) as u64).max(1);
        config
    }

    fn short_note(&self, more: &str) -> String {
        format!("I-Face, {} steps. {more}", self.short(SHORT).iface.steps)
    }

    /// Trains and judges I-Face of other settings.
    fn row(&self, series: &str, choice: String, config: &Config) -> Result<Row> {
        self.check_stop()?;
        let scratch = tempfile::tempdir_in(self.line.run.dir()).map_err(|e| {
            Error::cannot(format!("no scratch folder: {e}"), "free space, or name another place in TMPDIR")
        })?;
        let run = Run::open(scratch.path(), self.line.run.stop().clone(), std::sync::Arc::new(Quiet));
        let mut line = Line::open(config, &run)?;
        line.synthetic = self.line.synthetic;
        complete(&line, Stage::Mask, &learn::trained_fields(&line))?;
        forget_peak_memory();
        let mut rounds = Vec::new();
        let all = config.iface.steps;
        for step in [all.div_ceil(3), (2 * all).div_ceil(3), all] {
            let (done, round) = meter::round(|| train_until(&line, Stage::Iface, step));
            done?;
            rounds.push(round);
        }
        let memory_mib = peak_mib();
        let figures = judged(&line, Stage::Iface, &self.judge)?;
        Ok(Row { series: series.into(), choice, rounds, parts: true, memory_mib, figures })
    }
}
