//! The training loop of the `iface` stage.

use super::checkpoint::{self, State};
use super::hull_start::HullDistance;
use super::infer::IFace;
use super::losses::{Marched, losses};
use super::model::shape;
use super::{IfaceError, schedule};
use crate::Monitor;
use crate::config::iface::{IfaceConfig, OccupancyRule, Start};
use crate::field;
use crate::field::optimizer::update;
use crate::field::pixels::{Batch, Pixels, TrainView};
use crate::kernel::adam::AdamStep;
use crate::kernel::march::{self, Bitmask};
use crate::kernel::mlp::Weights;
use crate::kernel::rng;
use crate::kernel::sdf::{self, FieldShape};
use burn::tensor::{Device, Tensor};
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What training did.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    /// Optimiser steps.
    pub steps: u64,
    /// Seconds in this process (less than the whole when resumed).
    pub seconds: f64,
    /// Final sharpness.
    pub inv_s: f32,
    /// PSNR of the last training batches, dB.
    pub train_psnr: f64,
    /// Share of the occupancy grid that was marched at the end.
    pub occupied: f64,
    /// Oddities on the way: a damaged checkpoint, a restored step.
    pub warnings: Vec<String>,
}

/// Steps in a row without a single sample after which nothing can bring the surface back.
const LOST_AFTER: u64 = 20;

/// A batch keeps at most so many times the sample budget: the ray count lags behind when cells come back.
const MOST_BUDGETS: usize = 4;

/// Drops the last rays of a batch until at most `most` samples are left (one ray always stays).
fn shorten(batch: &mut Batch, samples: &mut march::Samples, most: usize) {
    if samples.t.len() <= most {
        return;
    }
    let kept = samples.offsets.iter().rposition(|&o| o as usize <= most).unwrap_or(0).max(1);
    samples.offsets.truncate(kept + 1);
    samples.t.truncate(samples.offsets[kept] as usize);
    batch.rays.truncate(kept);
    batch.color.truncate(kept);
    batch.alpha.truncate(kept);
}

/// Figures of one step on the host.
struct Figures {
    rgb: f32,
    mask: f32,
    eikonal: f32,
    sparsity: f32,
    samples: usize,
}

struct Trainer<'a> {
    config: &'a IfaceConfig,
    seed: u64,
    device: Device,
    shape: FieldShape,
    pixels: Pixels<'a>,
    state: State,
}

/// Trains until `config.steps`, saving checkpoints into `dir` and continuing from the one that lies there.
///
/// `views` have their cameras in scene coordinates; `hull` is the masks' visual hull over the scene's box.
/// `identity` names settings and inputs: a checkpoint of another identity is refused.
pub fn train(
    views: &[TrainView],
    hull: Option<&Bitmask>,
    config: &IfaceConfig,
    seed: u64,
    device: &str,
    dir: &Path,
    identity: &str,
    monitor: &dyn Monitor,
) -> Result<(IFace, TrainReport), IfaceError> {
    let device = field::device(device)?;
    let began = Instant::now();
    // without a hull every ray may meet a sample; with one, cells reach some four beyond the outline
    let reach = match hull {
        Some(_) => 4.0 * 2.0 / config.occupancy_resolution.min(128) as f32,
        None => f32::INFINITY,
    };
    let published = config.occupancy == OccupancyRule::Nerfacc;
    let pixels = Pixels::new(views, reach, config.radius, config.foreground, published);
    if pixels.count() == 0 {
        return Err(IfaceError::NoPixels);
    }
    let mut warnings = Vec::new();
    let restored = checkpoint::restore(dir, config, hull, identity, &device)?;
    let fresh = restored.is_none();
    let state = match restored {
        Some((state, notes)) => {
            warnings.extend(notes);
            state
        }
        None => State::new(config, seed, hull, &device),
    };
    let mut trainer = Trainer { config, seed, device, shape: shape(config), pixels, state };
    if fresh {
        if let (Start::Hull, Some(hull)) = (config.start, hull) {
            trainer.fit_hull(hull, monitor)?;
        }
        // a run that breaks early goes back to here, not to a start without the hull
        checkpoint::save(dir, &trainer.state, identity)?;
    }
    let mut saved = Instant::now();
    let mut nothing_seen = 0;
    let mut diverged_before = trainer.state.salt > 0;
    while trainer.state.step < config.steps {
        let step = trainer.state.step;
        match trainer.step()? {
            Ok(figures) => {
                nothing_seen = if figures.samples == 0 { nothing_seen + 1 } else { 0 };
                if nothing_seen == LOST_AFTER {
                    return Err(IfaceError::SurfaceLost { step, steps_without: LOST_AFTER });
                }
                if figures.samples > 0 {
                    let old = trainer.state.mean_square;
                    let keep = if old == 0.0 { 0.0 } else { 0.98 };
                    trainer.state.mean_square = keep * old + (1.0 - keep) * figures.rgb as f64;
                }
                let mean_square = trainer.state.mean_square;
                monitor.step(
                    step + 1,
                    config.steps,
                    &[
                        ("rgb", figures.rgb as f64),
                        ("mask", figures.mask as f64),
                        ("eikonal", figures.eikonal as f64),
                        ("sparsity", figures.sparsity as f64),
                        ("psnr", -10.0 * mean_square.max(1e-12).log10()),
                        ("inv_s", trainer.inv_s() as f64),
                        ("rays", trainer.state.rays as f64),
                        ("samples", figures.samples as f64),
                    ],
                );
            }
            Err((term, value)) => {
                let lr = config.lr_network * schedule::learning_rate(config, step);
                if diverged_before {
                    return Err(IfaceError::Diverged { term, value, step, lr });
                }
                diverged_before = true;
                warnings.push(format!(
                    "the {term} loss became {value} at step {step}; went back to the last checkpoint once"
                ));
                let again = checkpoint::restore(dir, config, hull, identity, &trainer.device)?;
                trainer.state = match again {
                    Some((state, _)) => state,
                    None => State::new(config, seed, hull, &trainer.device),
                };
                // other rays, or the same step would break in the same way
                trainer.state.salt = 1;
            }
        }
        if monitor.stop() {
            checkpoint::save(dir, &trainer.state, identity)?;
            return Err(IfaceError::Stopped { step: trainer.state.step, steps: config.steps });
        }
        if saved.elapsed() > Duration::from_secs_f64(config.checkpoint_s) {
            checkpoint::save(dir, &trainer.state, identity)?;
            saved = Instant::now();
        }
    }
    checkpoint::save(dir, &trainer.state, identity)?;
    checkpoint::finish(dir)?;
    let report = TrainReport {
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        inv_s: trainer.inv_s(),
        train_psnr: -10.0 * trainer.state.mean_square.max(1e-12).log10(),
        occupied: trainer.state.occupancy.share(),
        warnings,
    };
    Ok((IFace::new(config, &trainer.state), report))
}

impl Trainer<'_> {
    fn inv_s(&self) -> f32 {
        field::values(self.state.model.inv_s().inner())[0].clamp(1e-6, 1e6)
    }

    /// The field's shape at a step (levels come in one by one).
    fn shape_at(&self, step: u64) -> Arc<FieldShape> {
        Arc::new(FieldShape { active: schedule::active_levels(self.config, step), ..self.shape.clone() })
    }

    fn march_step(&self, inv_s: f32) -> f32 {
        march_step(self.config, inv_s)
    }

    /// One optimiser step. The inner error names a loss that is not finite; nothing was updated then.
    fn step(&mut self) -> Result<Result<Figures, (&'static str, f32)>, IfaceError> {
        let config = self.config;
        let step = self.state.step;
        let seed = self.seed ^ self.state.salt << 32;
        let shape = self.shape_at(step);
        let inv_s = self.inv_s();
        let dt = self.march_step(inv_s);
        // a new level, and the end of the hull's fit, move the surface: look again at once
        let level_came = config.level_every > 0 && step.is_multiple_of(config.level_every);
        if step.is_multiple_of(config.occupancy_every)
            || (config.occupancy == OccupancyRule::Band && level_came)
        {
            self.update_occupancy(&shape, seed, inv_s, dt);
        }
        let mut batch = self.pixels.draw(seed, step, self.state.rays, config.jitter);
        let o = &self.state.occupancy;
        let solid = (config.occupancy == OccupancyRule::Band).then_some(&o.solid);
        let limit = (3.6 * config.radius / dt) as usize + 2;
        let mut samples = march::march(&o.occupied, solid, config.radius, dt, &batch.rays, limit);
        let n = samples.t.len();
        let floor = if config.occupancy == OccupancyRule::Band { 64 } else { 1 };
        self.state.rays = schedule::next_rays(self.state.rays, n, config.samples, floor, config.max_rays);
        shorten(&mut batch, &mut samples, MOST_BUDGETS * config.samples);
        let n = samples.t.len();
        if n == 0 {
            // nothing in sight of these rays: no gradient, but the schedule goes on
            self.state.step += 1;
            return Ok(Ok(Figures { rgb: 0.0, mask: 0.0, eikonal: 0.0, sparsity: 0.0, samples: 0 }));
        }
        let model = &self.state.model;
        let marched = Marched { batch: &batch, samples, dt, masked: self.pixels.masked };
        let losses = losses(config, model, &shape, marched, (seed, step), &self.device);
        let read = |t: &Tensor<1>| field::values(t.clone().inner())[0];
        let figures = Figures {
            rgb: read(&losses.rgb),
            mask: losses.mask.as_ref().map_or(0.0, read),
            eikonal: read(&losses.eikonal),
            sparsity: losses.sparsity.as_ref().map_or(0.0, read),
            samples: n,
        };
        for (term, value) in [
            ("rgb", figures.rgb),
            ("mask", figures.mask),
            ("eikonal", figures.eikonal),
            ("sparsity", figures.sparsity),
        ] {
            if !value.is_finite() {
                return Ok(Err((term, value)));
            }
        }
        if !self.apply(losses.total, step) {
            return Ok(Err(("gradient of the", f32::NAN)));
        }
        self.state.step += 1;
        Ok(Ok(figures))
    }

    fn update_occupancy(&mut self, shape: &FieldShape, seed: u64, inv_s: f32, dt: f32) {
        let weights = Weights::new(shape.layout(), &field::values(self.state.model.weights().inner()));
        let table = field::values(self.state.model.table.val().inner());
        let table: &[[f32; 2]] = bytemuck::cast_slice(&table);
        let step = self.state.step;
        let distances = |x: &[[f32; 3]]| sdf::values(shape, table, &weights, x);
        let soft = |x: &[[f32; 3]]| sdf::softness(shape, table, &weights, x);
        self.state.occupancy.update(self.config, (seed, step), inv_s, dt, distances, soft);
    }

    /// Backward and AdamW, each group at its own rate.
    fn apply(&mut self, loss: Tensor<1>, step: u64) -> bool {
        let config = self.config;
        let factor = schedule::learning_rate(config, step);
        self.descend(loss, factor, step + 1, true)
    }

    /// False, and nothing updated, where a gradient is not finite: a finite loss does not promise one.
    fn descend(&mut self, loss: Tensor<1>, factor: f64, adam_step: u64, color: bool) -> bool {
        let config = self.config;
        let mut gradients = loss.backward();
        drop(loss);
        let model = &self.state.model;
        let finite = |t: Option<Tensor<2>>| t.is_none_or(|t| field::values(t).iter().all(|g| g.is_finite()));
        // what breaks the table's gradient passes through the layers above it
        let sound = [&model.v1, &model.v2, &model.c1, &model.c2, &model.c3]
            .iter()
            .all(|p| finite(p.val().grad(&gradients)))
            && model.variance.val().grad(&gradients).is_none_or(|t| field::values(t)[0].is_finite());
        if !sound {
            return false;
        }
        let network = AdamStep {
            lr: (config.lr_network * factor) as f32,
            beta1: 0.9,
            beta2: 0.99,
            epsilon: 1e-15,
            weight_decay: config.weight_decay as f32,
            step: adam_step,
            skip_zero: false,
        };
        let table = AdamStep {
            lr: (config.lr_table * factor) as f32,
            weight_decay: config.table_decay as f32,
            skip_zero: config.touched_rows,
            ..network
        };
        let variance = AdamStep { lr: (config.lr_variance * factor) as f32, ..network };
        let (m, o, g) = (&mut self.state.model, &mut self.state.moments, &mut gradients);
        update(&mut m.table, &mut o.table, g, table);
        update(&mut m.v1, &mut o.v1, g, network);
        update(&mut m.g1, &mut o.g1, g, network);
        update(&mut m.b1, &mut o.b1, g, network);
        update(&mut m.v2, &mut o.v2, g, network);
        update(&mut m.g2, &mut o.g2, g, network);
        update(&mut m.b2, &mut o.b2, g, network);
        if color {
            update(&mut m.c1, &mut o.c1, g, network);
            update(&mut m.c2, &mut o.c2, g, network);
            update(&mut m.c3, &mut o.c3, g, network);
            update(&mut m.variance, &mut o.variance, g, variance);
        }
        true
    }

    /// Fits the field to the hull's distance: half of the points in a band around its boundary.
    fn fit_hull(&mut self, hull: &Bitmask, monitor: &dyn Monitor) -> Result<(), IfaceError> {
        /// Enough for errors well below a cell of the hull with the coarse levels.
        const STEPS: u64 = 250;
        const POINTS: usize = 8192;
        let distance = HullDistance::new(hull);
        let config = self.config;
        let shape = self.shape_at(0);
        for step in 0..STEPS {
            let mut x = Vec::with_capacity(3 * POINTS);
            let mut target = Vec::with_capacity(POINTS);
            let mut k = 0;
            while target.len() < POINTS {
                let u = |a: u64| 2.0 * rng::uniform(self.seed, 201 + (step << 10), 4 * k + a) - 1.0;
                let p = [u(0), u(1), u(2)];
                k += 1;
                let f = distance.at(p);
                // every second point anywhere, the others near the boundary
                if k % 2 == 0 && f.abs() > 0.1 {
                    continue;
                }
                x.extend(p.map(|c| c * config.radius));
                target.push(f * config.radius);
            }
            let n = target.len();
            let device = &self.device;
            let directions = field::tensor([0.0, 0.0, 1.0].repeat(n), [n, 3], device);
            let out = self.state.model.field(&shape, field::tensor(x, [n, 3], device), directions);
            let target: Tensor<2> = field::tensor(target, [n, 1], device).autodiff();
            let error = (out.clone().narrow(1, 0, 1) - target).abs().mean();
            let length = (out.narrow(1, 1, 3).square().sum_dim(1) + 1e-12).sqrt();
            let loss = error * 10.0 + (length - 1.0).square().mean() * 0.1;
            let factor = 0.1f64.powf(step as f64 / STEPS as f64) * ((step + 1) as f64 / 20.0).min(1.0);
            if !self.descend(loss, factor, step + 1, false) {
                let (term, value, lr) = ("hull", f32::NAN, config.lr_network * factor);
                return Err(IfaceError::Diverged { term, value, step: 0, lr });
            }
            if monitor.stop() {
                return Err(IfaceError::Stopped { step: 0, steps: config.steps });
            }
        }
        // training starts with its own moments
        let fresh = State::new(config, self.seed, Some(hull), &self.device);
        self.state.moments = fresh.moments;
        Ok(())
    }
}

/// March step at a sharpness.
pub fn march_step(config: &IfaceConfig, inv_s: f32) -> f32 {
    match config.occupancy {
        // nerfacc's constant 1.732 where √3 is meant, kept for the published step length
        OccupancyRule::Nerfacc => 1.732 * 2.0 * config.radius / config.samples_per_ray as f32,
        OccupancyRule::Band => (config.march / inv_s).min(config.max_step).max(config.min_step),
    }
}

#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
