//! The training loop of the stages `baseline` and `tface`.

use super::TfaceError;
use super::checkpoint;
use super::grow::{update_mask, upsample};
use super::state::State;
use crate::Monitor;
use crate::config::{MaskLoss, MaskUse, VmBackground, VmConfig, VmStart};
use crate::field;
use crate::field::ops::{self, GridPenalty, VmBatch};
use crate::field::optimizer::update;
use crate::field::pixels::{Batch, Pixels, TrainView};
use crate::geom::Aabb;
use crate::image::Gray;
use crate::kernel::adam::AdamStep;
use crate::kernel::march::Bitmask;
use crate::kernel::rng;
use crate::kernel::vm::mask::VmRay;
use crate::kernel::vm::{Penalty, RAY_WIDTH};
use burn::tensor::{Device, Tensor};
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// What training did.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    /// Fields learned.
    pub fields: usize,
    /// Optimiser steps of each field.
    pub steps: u64,
    /// Seconds in this process (less than the whole when resumed).
    pub seconds: f64,
    /// PSNR of the last training batches, dB; mean over the fields.
    pub train_psnr: f64,
    /// Share of the box's cells that are marched at the end; mean over the fields.
    pub occupied: f64,
    /// Vertices of the first field's final grid along x, y, z.
    pub size: [usize; 3],
    /// Rays of this process.
    pub rays: u64,
    /// Points of their lattices inside the box, were nothing skipped.
    pub lattice_samples: u64,
    /// Those whose density was looked up.
    pub density_samples: u64,
    /// Those whose colour was decoded.
    pub color_samples: u64,
    /// Oddities on the way.
    pub warnings: Vec<String>,
}

impl TrainReport {
    /// With what another field's training did.
    pub(super) fn and(self, other: TrainReport) -> TrainReport {
        let fields = self.fields + other.fields;
        let mean = |a: f64, b: f64| (a * self.fields as f64 + b * other.fields as f64) / fields as f64;
        TrainReport {
            fields,
            steps: self.steps,
            seconds: self.seconds + other.seconds,
            train_psnr: mean(self.train_psnr, other.train_psnr),
            occupied: mean(self.occupied, other.occupied),
            size: self.size,
            rays: self.rays + other.rays,
            lattice_samples: self.lattice_samples + other.lattice_samples,
            density_samples: self.density_samples + other.density_samples,
            color_samples: self.color_samples + other.color_samples,
            warnings: [self.warnings, other.warnings].concat(),
        }
    }
}

/// Samples of this process.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    rays: u64,
    lattice: u64,
    density: u64,
    color: u64,
}

/// Figures of one step on the host.
struct Figures {
    rgb: f32,
    mask: f32,
    outside: Option<f32>,
}

struct Trainer<'a> {
    config: &'a VmConfig,
    seed: u64,
    device: Device,
    pixels: Pixels<'a>,
    state: State,
    counts: Counts,
}

/// Trains one field until `config.steps`, saving checkpoints into its own folder `dir` and continuing from the one
/// that lies there; a finished one is left as it is. Arguments as in [`super::mean::train`].
pub fn train(
    stage: &'static str,
    views: &[TrainView],
    bounds: Aabb,
    hull: Option<&Bitmask>,
    config: &VmConfig,
    seed: u64,
    device: &str,
    dir: &Path,
    identity: &str,
    monitor: &dyn Monitor,
) -> Result<TrainReport, TfaceError> {
    let device = field::device(device)?;
    let began = Instant::now();
    check(stage, config)?;
    let restored = checkpoint::restore(dir, config, identity, &device)?;
    if let Some((state, warnings)) = &restored
        && state.step == config.steps
    {
        checkpoint::finish(dir)?;
        monitor.step(config.steps, config.steps, &[]);
        return Ok(report(config, state, Counts::default(), began, warnings.clone()));
    }
    let views = masked_as_configured(views, config.masks);
    let hull = hull.filter(|_| config.start == VmStart::Hull && config.masks != MaskUse::None);
    // rays that meet the hull, grown by the cells around it
    let reach = hull.map_or(f32::INFINITY, |h| 4.0 * 2.0 / h.resolution.min(128) as f32);
    let pixels = Pixels::new(&views, reach, 1.0, config.foreground, config.whole_frame);
    if pixels.count() == 0 {
        return Err(TfaceError::NoPixels);
    }
    let mut warnings = Vec::new();
    let bounds = [bounds.min.to_array(), bounds.max.to_array()];
    let fresh = || State::new(config, seed, bounds, hull, &device);
    let state = match restored {
        Some((state, notes)) => {
            warnings.extend(notes);
            state
        }
        None => fresh(),
    };
    let mut trainer =
        Trainer { config, seed, device: device.clone(), pixels, state, counts: Counts::default() };
    let mut saved = Instant::now();
    let mut diverged_before = trainer.state.salt > 0;
    let mut density = 0;
    while trainer.state.step < config.steps {
        let step = trainer.state.step;
        let every = Duration::from_secs_f64(config.checkpoint_s);
        let result = trainer.step().and_then(|figures| {
            let saving = saved.elapsed() > every || monitor.stop() || trainer.state.step == config.steps;
            // a poisoned field must not take the place of a good checkpoint
            if saving && !trainer.state.is_finite() { Err(("grid", f32::NAN)) } else { Ok(figures) }
        });
        match result {
            Ok(figures) => {
                let old = trainer.state.mean_square;
                let keep = if old == 0.0 { 0.0 } else { 0.98 };
                trainer.state.mean_square = keep * old + (1.0 - keep) * figures.rgb as f64;
                if !trainer.after(step) {
                    return Err(TfaceError::Empty { step, threshold: config.mask_threshold });
                }
                let mut shown = vec![
                    ("rgb", figures.rgb as f64),
                    ("mask", figures.mask as f64),
                    ("psnr", -10.0 * trainer.state.mean_square.max(1e-12).log10()),
                    ("samples", (trainer.counts.density - density) as f64),
                ];
                if let Some(outside) = figures.outside {
                    shown.push(("outside", outside as f64));
                }
                density = trainer.counts.density;
                monitor.step(step + 1, config.steps, &shown);
            }
            Err((term, value)) => {
                if diverged_before {
                    return Err(TfaceError::Diverged { term, value, step });
                }
                diverged_before = true;
                warnings.push(format!(
                    "the {term} loss became {value} at step {step}; went back to the last checkpoint once"
                ));
                trainer.state = match checkpoint::restore(dir, config, identity, &device)? {
                    Some((state, _)) => state,
                    None => fresh(),
                };
                // other rays, or the same step would break in the same way
                trainer.state.salt = 1;
            }
        }
        if monitor.stop() {
            checkpoint::save(dir, &trainer.state, config, identity, false)?;
            return Err(TfaceError::Stopped { step: trainer.state.step, steps: config.steps });
        }
        if saved.elapsed() > every {
            checkpoint::save(dir, &trainer.state, config, identity, false)?;
            saved = Instant::now();
        }
    }
    checkpoint::save(dir, &trainer.state, config, identity, true)?;
    checkpoint::finish(dir)?;
    Ok(report(config, &trainer.state, trainer.counts, began, warnings))
}

fn report(
    config: &VmConfig,
    state: &State,
    counts: Counts,
    began: Instant,
    warnings: Vec<String>,
) -> TrainReport {
    TrainReport {
        fields: 1,
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        train_psnr: -10.0 * state.mean_square.max(1e-12).log10(),
        occupied: state.mask.as_ref().map_or(1.0, |m| m.share()),
        size: state.size,
        rays: counts.rays,
        lattice_samples: counts.lattice,
        density_samples: counts.density,
        color_samples: counts.color,
        warnings,
    }
}

/// What ranges of single keys cannot say.
fn check(stage: &'static str, config: &VmConfig) -> Result<(), TfaceError> {
    let wrong = |key, problem: &str| Err(TfaceError::Settings { stage, key, problem: problem.into() });
    for (key, rank) in [("density_rank", &config.density_rank), ("color_rank", &config.color_rank)] {
        if rank.len() != 3 || rank.iter().all(|&r| r == 0) {
            return wrong(key, "needs three numbers, not all 0: channels of the planes xy, xz, yz");
        }
    }
    for (key, list) in [("upsample_steps", &config.upsample_steps), ("mask_steps", &config.mask_steps)] {
        if list.windows(2).any(|w| w[0] >= w[1]) {
            return wrong(key, "must rise");
        }
    }
    if !config.hidden.is_multiple_of(8) {
        return wrong("hidden", "must be a multiple of 8");
    }
    if config.voxels_final < config.voxels_start {
        return wrong("voxels_final", "is less than voxels_start");
    }
    Ok(())
}

/// Learning rate as a share of its first value, `since` steps after it last started.
fn learning_rate(config: &VmConfig, since: u64) -> f64 {
    config.lr_final.powf(since as f64 / config.steps as f64)
}

/// What is left of the TV weights at a step: they fade by the published 0.1 over the whole training and,
/// unlike the learning rate, never start again.
fn tv_fade(config: &VmConfig, step: u64) -> f64 {
    0.1f64.powf((step + 1) as f64 / config.steps as f64)
}

/// The views with their masks as the setting wants them.
fn masked_as_configured(views: &[TrainView], masks: MaskUse) -> Vec<TrainView> {
    let change = |mask: &Gray| match masks {
        MaskUse::None => None,
        MaskUse::Soft => Some(mask.clone()),
        MaskUse::Binary => {
            let values = mask.values.iter().map(|&a| if a > 0 { 255 } else { 0 }).collect();
            Some(Gray { values, ..mask.clone() })
        }
    };
    views
        .iter()
        .map(|v| TrainView {
            camera: v.camera.clone(),
            photo: v.photo.clone(),
            mask: v.mask.as_ref().and_then(change),
            valid: v.valid.clone(),
        })
        .collect()
}

impl Trainer<'_> {
    /// One optimiser step. The error names a loss that is not finite; nothing was updated then.
    fn step(&mut self) -> Result<Figures, (&'static str, f32)> {
        let config = self.config;
        let step = self.state.step;
        let seed = self.seed ^ self.state.salt << 32;
        let batch = self.pixels.draw(seed, step, config.rays, true);
        let rays: Vec<VmRay> = batch
            .rays
            .iter()
            .map(|r| VmRay { origin: r.origin, direction: r.direction, jitter: r.jitter })
            .collect();
        let field = self.state.field(config, true);
        self.counts.rays += rays.len() as u64;
        self.counts.lattice += rays.iter().map(|r| field.lattice.points(r)).sum::<u64>();
        let vm = Arc::new(VmBatch::new(field.clone(), rays));
        let (density, color) = self.penalised(&field, step);
        let out = ops::vm_render(density, color, self.state.network.val(), vm.clone());
        self.counts.density += vm.density_samples.load(Ordering::Relaxed);
        self.counts.color += vm.color_samples.load(Ordering::Relaxed);

        let (total, rgb, mask, outside) = self.losses(out, &batch, step, seed);
        let value = |t: &Tensor<1>| field::values(t.clone().inner())[0];
        let figures = Figures { rgb: value(&rgb), mask: mask.as_ref().map_or(0.0, value), outside };
        for (term, value) in [("rgb", figures.rgb), ("mask", figures.mask)] {
            if !value.is_finite() {
                return Err((term, value));
            }
        }
        drop((rgb, mask));
        self.descend(total, step)?;
        self.state.step += 1;
        Ok(figures)
    }

    /// Both grids with their regularisers attached.
    fn penalised(&self, field: &Arc<crate::kernel::vm::VmField>, step: u64) -> (Tensor<1>, Tensor<1>) {
        let config = self.config;
        let faded = tv_fade(config, step);
        let tv = |weight: f64| (0.01 * weight * faded) as f32;
        let l1 = if self.state.masked { config.l1_rest } else { config.l1_start } as f32;
        let ortho = config.ortho as f32;
        let of_density = Penalty { tv: tv(config.tv_density), l1, ortho };
        let of_color = Penalty { tv: tv(config.tv_color), l1: 0.0, ortho };
        let attach = |p: Tensor<1>, grid, penalty: Penalty| {
            if penalty.is_zero() { p } else { ops::penalised(p, Arc::new(GridPenalty { grid, penalty })) }
        };
        (
            attach(self.state.density.val(), field.density, of_density),
            attach(self.state.color.val(), field.color, of_color),
        )
    }

    /// Total, colour and mask losses; mean opacity² of the batch's background rays.
    fn losses(
        &self,
        out: Tensor<2>,
        batch: &Batch,
        step: u64,
        seed: u64,
    ) -> (Tensor<1>, Tensor<1>, Option<Tensor<1>>, Option<f32>) {
        let config = self.config;
        let device = &self.device;
        let n = batch.rays.len();
        let stream = step << 4;
        let opacity = out.clone().narrow(1, 3, 1); // [n, 1]
        let mut color = out.clone().narrow(1, 0, 3); // [n, 3]
        let mut target: Vec<f32> = batch.color.iter().flatten().copied().collect();
        let open = || opacity.clone().neg() + 1.0;
        match config.background {
            VmBackground::Black => {}
            // the published flip: the render is over white, the target stays over black
            VmBackground::Reference => {
                if rng::uniform(seed, stream | 9, 0) < 0.5 {
                    color = color + open();
                }
            }
            VmBackground::Random => {
                let behind: Vec<f32> = (0..3 * n as u64).map(|i| rng::uniform(seed, stream | 8, i)).collect();
                for ((t, b), i) in target.iter_mut().zip(&behind).zip(0..) {
                    let i: usize = i;
                    *t += (1.0 - batch.alpha[i / 3]) * b;
                }
                color = color + open() * field::tensor(behind, [n, 3], device).autodiff();
            }
        }
        let target: Tensor<2> = field::tensor(target, [n, 3], device).autodiff();
        let rgb = (color.clamp(0.0, 1.0) - target).square().mean();
        let mut total = rgb.clone();

        let is_background = |a: &f32| f32::from(*a == 0.0);
        let background: Vec<f32> = batch.alpha.iter().map(is_background).collect();
        let count: f32 = background.iter().sum();
        let collected = field::values(opacity.clone().inner());
        let outside = (count > 0.0).then(|| {
            let sum: f32 = collected.iter().zip(&background).map(|(o, b)| o * o * b).sum();
            sum / count
        });
        let mask = match config.mask_loss {
            _ if !self.pixels.masked => None,
            MaskLoss::None => None,
            // a batch without a background ray has no such loss (the published mean is NaN then)
            MaskLoss::L2 => (count > 0.0).then(|| {
                let background = field::tensor(background, [n, 1], device).autodiff();
                (opacity.clone().square() * background).sum() / count as f64
            }),
            MaskLoss::Ce => Some({
                let alpha: Tensor<2> = field::tensor(batch.alpha.clone(), [n, 1], device).autodiff();
                let p = opacity.clone().clamp(1e-3, 1.0 - 1e-3);
                let cross = alpha.clone() * p.clone().log() + (alpha.neg() + 1.0) * (p.neg() + 1.0).log();
                cross.mean().neg()
            }),
        };
        if let Some(mask) = &mask {
            total = total + mask.clone() * config.mask_weight;
        }
        debug_assert_eq!(out.dims()[1], RAY_WIDTH);
        (total, rgb, mask, outside)
    }

    /// Backward and Adam. Nothing is updated where the decoder's gradient is not finite; the grids are looked
    /// at before every checkpoint.
    fn descend(&mut self, loss: Tensor<1>, step: u64) -> Result<(), (&'static str, f32)> {
        let config = self.config;
        let state = &mut self.state;
        let mut gradients = loss.backward();
        drop(loss);
        let network = state.network.val().grad(&gradients);
        if network.is_some_and(|g| field::values(g).iter().any(|g| !g.is_finite())) {
            return Err(("gradient of the", f32::NAN));
        }
        let since = step - state.reset;
        let factor = learning_rate(config, since);
        let grid = AdamStep {
            lr: (config.lr_grid * factor) as f32,
            beta1: 0.9,
            beta2: 0.99,
            epsilon: 1e-8,
            weight_decay: 0.0,
            step: step - state.moments_from + 1,
            skip_zero: false,
        };
        let network = AdamStep { lr: (config.lr_network * factor) as f32, ..grid };
        let [density, color, weights] = &mut state.moments;
        update(&mut state.density, density, &mut gradients, grid);
        update(&mut state.color, color, &mut gradients, grid);
        update(&mut state.network, weights, &mut gradients, network);
        Ok(())
    }

    /// What is due after the optimiser step of iteration `step`; false if the field has become empty.
    fn after(&mut self, step: u64) -> bool {
        let config = self.config;
        if config.mask_steps.contains(&step) && !update_mask(&mut self.state, config, &self.device) {
            return false;
        }
        if let Some(which) = config.upsample_steps.iter().position(|&s| s == step) {
            upsample(&mut self.state, config, which, &self.device);
        }
        true
    }
}

#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
