//! Instant-NeRF, the row that the paper's I-Face is compared with: a density where I-Face has a distance.
//!
//! instant-nsr-pl's `nerf-blender` configuration for these captures: hash grid of base 16, smooth-L1 on the colors of
//! rays that met something, the distortion loss, no mask loss, masked photographs over black; AdamW at 0.01, which three
//! milestones take to a third each. Meshed where the density is 5. On the CPU alone.

use super::occupancy::Occupancy;
use super::schedule::{self, march_step};
use super::train::IfaceReport;
use crate::config::DeviceChoice;
use crate::config::iface::{Foreground, IfaceConfig, OccupancyRule};
use crate::field::checkpoint::{self, Checkpoint, TrainingProgress};
use crate::field::pixels::{Batch, Pixels, TrainView};
use crate::field::training::{self, Learner, StepError, StepReport, TrainingSession};
use crate::geom::{Ray, RayResult};
use crate::kernel::adam::{AdamStep, adam};
use crate::kernel::density::{self, DensityShape, DensityWeights};
use crate::kernel::march::{Bitmask, MarchRay, Samples};
use crate::kernel::{hash, rng};
use crate::{Error, Result};
use glam::Vec3;
use std::path::Path;
use std::time::Instant;

/// Version of the checkpoints' layout.
const FORMAT: &str = "tiface-density-1";

/// Weight of the distortion.
const DISTORTION: f64 = 0.001;

/// Milestones of the learning rate, as shares of the steps (10, 15 and 18 of 20 thousand), and what each leaves of it.
const MILESTONES: ([f64; 3], f64) = ([0.5, 0.75, 0.9], 0.33);

/// The density that the surface has.
const LEVEL: f32 = 5.0;

/// Cells above so much opacity of a march step are marched through.
const OCCUPIED: f32 = 0.01;

/// A ray ends where less of its light is left.
const DARK: f32 = 1e-4;

/// What is learned, and the cells to march through.
struct DensityState {
    /// Hash table and networks: values, first and second moments.
    parameters: [[Vec<f32>; 3]; 2],
    occupancy: Occupancy,
    rays: usize,
}

const NAMES: [&str; 2] = ["table", "network"];

fn shape(config: &IfaceConfig) -> DensityShape {
    let levels = hash::levels(config.levels, config.base_resolution, config.growth, config.log2_table);
    DensityShape { levels, radius: config.radius }
}

impl DensityState {
    /// U(±1e-4) for the table, Xavier's bounds for the networks, the last layer's as if it had 16 outputs: tiny-cuda-nn.
    fn new(config: &IfaceConfig, seed: u64) -> DensityState {
        let shape = shape(config);
        let entries = hash::entries(&shape.levels) as u64;
        let table: Vec<f32> = (0..2 * entries).map(|i| 2e-4 * rng::uniform(seed, 121, i) - 1e-4).collect();
        let mut network = Vec::new();
        for (k, (rows, columns)) in shape.shapes().into_iter().enumerate() {
            let bound = (6.0 / (rows.max(16) + columns) as f32).sqrt();
            let uniform = |i| bound * (2.0 * rng::uniform(seed, 122 + k as u64, i) - 1.0);
            network.extend((0..(rows * columns) as u64).map(uniform));
        }
        let parameters = [table, network].map(|v| [v.clone(), vec![0.0; v.len()], vec![0.0; v.len()]]);
        DensityState { parameters, occupancy: Occupancy::new(config, None), rays: config.rays }
    }

    fn table(&self) -> &[[f32; 2]] {
        bytemuck::cast_slice(&self.parameters[0][0])
    }

    fn weights(&self, shape: &DensityShape) -> DensityWeights {
        DensityWeights::new(shape, &self.parameters[1][0])
    }

    fn save(&self, into: &mut Checkpoint) {
        for (name, values) in NAMES.iter().zip(&self.parameters) {
            for (kind, values) in ["model", "first", "second"].iter().zip(values) {
                into.put_floats(&format!("{kind}.{name}"), &[values.len()], values.clone());
            }
        }
        into.put_words("occupancy.occupied", self.occupancy.occupied.bits.clone());
        into.put_floats("occupancy.history", &[self.occupancy.history.len()], self.occupancy.history.clone());
        into.set("rays", self.rays);
    }

    fn restore(config: &IfaceConfig, from: &mut Checkpoint) -> Result<DensityState> {
        let mut state = DensityState::new(config, 0);
        for (name, [value, first, second]) in NAMES.iter().zip(&mut state.parameters) {
            let n = [value.len()];
            *value = from.floats(&format!("model.{name}"), &n)?;
            *first = from.floats(&format!("first.{name}"), &n)?;
            *second = from.squares(&format!("second.{name}"), &n)?;
        }
        let o = &mut state.occupancy;
        o.history = from.floats("occupancy.history", &[o.history.len()])?;
        let bits = from.words("occupancy.occupied")?;
        o.occupied = Bitmask::of(o.occupied.resolution, bits)
            .ok_or_else(|| from.wrong("tensor `occupancy.occupied` has another size".into()))?;
        let most = config.rays.max(config.max_rays) as u64;
        state.rays = from.number("rays", 1..=most)? as usize;
        Ok(state)
    }

    /// Samples along rays in marked cells, up to where the light is gone.
    fn march(
        &self,
        config: &IfaceConfig,
        shape: &DensityShape,
        weights: &DensityWeights,
        rays: &[MarchRay],
    ) -> Samples {
        let dt = march_step(config, 0.0);
        let all = self.occupancy.march(config, dt, rays);
        let (x, _) = all.points(rays, 0);
        let found = density::evaluate(shape, self.table(), weights, &x, None).density;
        let mut kept = Samples { offsets: vec![0], t: Vec::new() };
        for own in all.offsets.windows(2) {
            let mut thickness = 0f32;
            for s in own[0] as usize..own[1] as usize {
                if (-thickness).exp() < DARK {
                    break;
                }
                kept.t.push(all.t[s]);
                thickness += found[s] * dt;
            }
            kept.offsets.push(kept.t.len() as i32);
        }
        kept
    }
}

struct DensityTraining<'a> {
    config: &'a IfaceConfig,
    session: TrainingSession<'a>,
    shape: DensityShape,
    pixels: Pixels<'a>,
    state: DensityState,
}

/// Trains until `config.steps`, saving checkpoints and continuing from the one that lies in the session's folder.
/// `views` have their cameras in scene coordinates.
pub fn train_density(
    views: &[TrainView],
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(DensityField, IfaceReport)> {
    check(config, session.device)?;
    let began = Instant::now();
    let pixels = Pixels::new(views, f32::INFINITY, config.radius, Foreground::Photo, true);
    if pixels.count() == 0 {
        return Err(training::no_pixels());
    }
    let state = DensityState::new(config, session.seed);
    let mut learner = DensityTraining { config, session: *session, shape: shape(config), pixels, state };
    let (progress, warnings) = training::train(&mut learner, session, config.steps, config.checkpoint_s)?;
    let report = IfaceReport {
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        inv_s: 0.0,
        train_psnr: progress.psnr(),
        occupied: learner.state.occupancy.share(),
        device: crate::field::Place::Cpu(String::new()).told(),
        warnings,
    };
    Ok((DensityField::new(config, learner.state), report))
}

/// What ranges of single keys cannot say.
fn check(config: &IfaceConfig, device: &str) -> Result<()> {
    if DeviceChoice::parse(device).is_none_or(|choice| !["cpu", "auto"].contains(&choice.name.as_str())) {
        let problem = format!("device `{device}` has no kernels for `iface.field = \"density\"`");
        return Err(Error::usage(
            problem,
            "use `--device cpu`, or learn a distance: `iface.field = \"sdf\"`",
        ));
    }
    let wrong = |key: &str, why: &str, hint: &str| Err(Error::usage(format!("`iface.{key}` {why}"), hint));
    if !config.levels.is_multiple_of(4) {
        return wrong("levels", "must be a multiple of 4 for a density", "published are 16");
    }
    if config.occupancy != OccupancyRule::Nerfacc {
        return wrong("field", "is a density, which only preset `paper` learns", "add `--preset paper`");
    }
    Ok(())
}

/// Learning rate of a step, as a share of the first.
fn learning_rate(config: &IfaceConfig, step: u64) -> f64 {
    let (milestones, factor) = MILESTONES;
    let passed = milestones.iter().filter(|m| step as f64 >= **m * config.steps as f64).count();
    factor.powi(passed as i32)
}

/// Color and distortion losses of a batch, and their gradients by densities and colors of the samples.
fn losses(
    batch: &Batch,
    samples: &Samples,
    found: &density::DensitySamples,
    dt: f32,
) -> ([f32; 3], Vec<f32>, Vec<[f32; 3]>) {
    let rays = || samples.offsets.windows(2).map(|o| o[0] as usize..o[1] as usize).enumerate();
    let met = rays().filter(|(_, own)| !own.is_empty()).count().max(1) as f32;
    // nerfacc's mean is over the rays up to the last one that met something
    let last = samples.offsets.windows(2).rposition(|o| o[1] > o[0]).map_or(1, |r| r + 1) as f32;
    let (mut g_density, mut g_color) = (vec![0f32; samples.t.len()], vec![[0f32; 3]; samples.t.len()]);
    let (mut smooth, mut square, mut spread) = (0f64, 0f64, 0f64);
    for (r, own) in rays().filter(|(_, own)| !own.is_empty()) {
        let weight = density::weights(&found.density[own.clone()], dt);
        let color = &found.color[own.clone()];
        let mut seen = [0f32; 3];
        for (w, c) in weight.iter().zip(color) {
            (0..3).for_each(|k| seen[k] += w * c[k]);
        }
        let error: [f32; 3] = std::array::from_fn(|k| seen[k] - batch.color[r][k]);
        for e in error.map(f64::from) {
            square += e * e;
            smooth += if e.abs() < 1.0 { 0.5 * e * e } else { e.abs() - 0.5 };
        }
        let g = error.map(|e| e.clamp(-1.0, 1.0) / (3.0 * met));
        let (value, g_spread) = density::distortion(&weight, &samples.t[own.clone()], dt);
        spread += f64::from(value / last);
        let g_weight: Vec<f32> = g_spread
            .iter()
            .zip(color)
            .map(|(s, c)| DISTORTION as f32 / last * s + g[0] * c[0] + g[1] * c[1] + g[2] * c[2])
            .collect();
        for (g_color, w) in g_color[own.clone()].iter_mut().zip(&weight) {
            *g_color = g.map(|g| w * g);
        }
        let by_density = density::weights_backward(&found.density[own.clone()], &weight, &g_weight, dt);
        g_density[own].copy_from_slice(&by_density);
    }
    let n = f64::from(3.0 * met);
    ([(square / n) as f32, (smooth / n) as f32, spread as f32], g_density, g_color)
}

impl Learner for DensityTraining<'_> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = ["lr_network", "lr_table"];

    fn step(&mut self, progress: &TrainingProgress) -> Result<StepReport, StepError> {
        let (config, step) = (self.config, progress.step);
        let seed = self.session.seed ^ progress.salt << 32;
        let dt = march_step(config, 0.0);
        let weights = self.state.weights(&self.shape);
        if step.is_multiple_of(config.occupancy_every) {
            let (table, shape) = (self.state.parameters[0][0].clone(), &self.shape);
            let opacity = |x: &[[f32; 3]]| {
                let found = density::evaluate(shape, bytemuck::cast_slice(&table), &weights, x, None);
                found.density.into_iter().map(|s| s * dt).collect()
            };
            self.state.occupancy.look((seed, step), config.radius, OCCUPIED, opacity);
        }
        let batch = self.pixels.draw(seed, step, self.state.rays, config.jitter, 0.0);
        let samples = self.state.march(config, &self.shape, &weights, &batch.rays);
        let n = samples.t.len();
        self.state.rays = schedule::next_rays(self.state.rays, n, config.samples, 1, config.max_rays);
        let mut terms = [0f32; 3];
        if n > 0 {
            let (x, d) = samples.points(&batch.rays, 0);
            let found = density::evaluate(&self.shape, self.state.table(), &weights, &x, Some(&d));
            let (values, g_density, g_color) = losses(&batch, &samples, &found, dt);
            terms = values;
            let lr = config.lr_network * learning_rate(config, step);
            for (term, value) in ["rgb", "smooth", "distortion"].into_iter().zip(terms) {
                if !value.is_finite() {
                    return Err(StepError::NotFinite { term, value, lr });
                }
            }
            let mut g_table = vec![[0f32; 2]; self.state.table().len()];
            let by = (&g_density[..], &g_color[..]);
            let g_network = density::backward(&self.shape, &weights, &found, by, &mut g_table);
            if !g_network.iter().all(|g| g.is_finite()) {
                return Err(StepError::NotFinite { term: "gradient of the", value: f32::NAN, lr });
            }
            let adam_step = AdamStep {
                lr: lr as f32,
                beta1: 0.9,
                beta2: 0.99,
                epsilon: 1e-15,
                weight_decay: config.weight_decay as f32,
                step: step + 1,
                skip_zero: false,
            };
            let gradients = [g_table.into_flattened(), g_network];
            for ([value, first, second], mut g) in self.state.parameters.iter_mut().zip(gradients) {
                adam(value, first, second, &mut g, &adam_step);
            }
        }
        let figures = vec![
            ("rgb", f64::from(terms[0])),
            ("smooth", f64::from(terms[1])),
            ("distortion", f64::from(terms[2])),
            ("rays", self.state.rays as f64),
            ("samples", n as f64),
        ];
        Ok(StepReport { square_error: (n > 0).then_some(terms[0]), figures })
    }

    fn save(&self, _: &TrainingProgress, into: &mut Checkpoint, _: bool) -> Result<(), StepError> {
        self.state.save(into);
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        if let Some((from, ..)) = from {
            self.state = DensityState::restore(self.config, from)?;
        }
        Ok(())
    }
}

/// The trained field. Positions are in scene units, the box is [-1, 1]³.
pub struct DensityField {
    config: IfaceConfig,
    shape: DensityShape,
    weights: DensityWeights,
    state: DensityState,
}

impl DensityField {
    fn new(config: &IfaceConfig, state: DensityState) -> DensityField {
        let shape = shape(config);
        DensityField { config: config.clone(), weights: state.weights(&shape), shape, state }
    }

    /// Loads the field from the checkpoint in a stage folder. `config` is what it was trained with.
    pub fn load(dir: &Path, config: &IfaceConfig) -> Result<DensityField> {
        let mut file = Checkpoint::read(&checkpoint::newest(dir), "iface", FORMAT)?;
        TrainingProgress::restore(&file, config.steps)?;
        Ok(DensityField::new(config, DensityState::restore(config, &mut file)?))
    }

    fn scaled(&self, points: &[Vec3]) -> Vec<[f32; 3]> {
        points.iter().map(|p| (*p * self.config.radius).to_array()).collect()
    }

    fn density(&self, points: &[Vec3]) -> Vec<f32> {
        let look = |points: &[Vec3]| {
            density::evaluate(&self.shape, self.state.table(), &self.weights, &self.scaled(points), None)
                .density
        };
        points.chunks(1 << 16).flat_map(look).collect()
    }

    /// What is left to the surface's density: negative inside. `[n]` points → `[n]`.
    pub fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.density(points).into_iter().map(|s| LEVEL - s).collect()
    }

    /// The same and its gradient, by differences over a thousandth of the box.
    pub fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        const STEP: f32 = 2e-3;
        let along = |axis: Vec3| -> Vec<f32> {
            let moved =
                |sign: f32| self.density(&points.iter().map(|p| *p + sign * STEP * axis).collect::<Vec<_>>());
            let difference = |(a, b): (f32, f32)| (a - b) / (2.0 * STEP);
            moved(-1.0).into_iter().zip(moved(1.0)).map(difference).collect()
        };
        let [x, y, z] = [Vec3::X, Vec3::Y, Vec3::Z].map(along);
        (self.sdf(points), (0..points.len()).map(|i| Vec3::new(x[i], y[i], z[i])).collect())
    }

    /// sRGB-coded colors of points, point `i` seen along `counts[i]` unit `directions`, all in one list.
    pub fn colors(&self, points: &[Vec3], counts: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        let places = self.scaled(points).into_iter().zip(counts);
        let x: Vec<[f32; 3]> = places.flat_map(|(p, n)| std::iter::repeat_n(p, *n as usize)).collect();
        let d: Vec<[f32; 3]> = directions.iter().map(|d| d.to_array()).collect();
        let look = |(x, d): (&[[f32; 3]], &[[f32; 3]])| {
            density::evaluate(&self.shape, self.state.table(), &self.weights, x, Some(d)).color
        };
        x.chunks(1 << 16).zip(d.chunks(1 << 16)).flat_map(look).collect()
    }

    /// Volume render of rays in scene coordinates.
    pub fn render(&self, rays: &[Ray]) -> Vec<RayResult> {
        const PASS: usize = 1 << 10;
        rays.chunks(PASS).flat_map(|rays| self.pass(rays)).collect()
    }

    fn pass(&self, rays: &[Ray]) -> Vec<RayResult> {
        let radius = self.config.radius;
        let march = |r: &Ray| MarchRay {
            origin: (r.origin * radius).to_array(),
            direction: r.direction.to_array(),
            jitter: 0.0,
        };
        let rays: Vec<MarchRay> = rays.iter().map(march).collect();
        let samples = self.state.march(&self.config, &self.shape, &self.weights, &rays);
        let (x, d) = samples.points(&rays, 0);
        let found = density::evaluate(&self.shape, self.state.table(), &self.weights, &x, Some(&d));
        let dt = march_step(&self.config, 0.0);
        let seen = |own: &[i32]| {
            let own = own[0] as usize..own[1] as usize;
            let weight = density::weights(&found.density[own.clone()], dt);
            let (mut color, mut opacity, mut depth) = ([0f32; 3], 0f32, 0f32);
            for ((w, c), t) in weight.iter().zip(&found.color[own.clone()]).zip(&samples.t[own]) {
                (0..3).for_each(|k| color[k] += w * c[k]);
                (opacity, depth) = (opacity + w, depth + w * t);
            }
            let depth = if opacity > 0.0 { depth / opacity / radius } else { 0.0 };
            RayResult { color, opacity: opacity.min(1.0), depth, normal: Vec3::ZERO }
        };
        samples.offsets.windows(2).map(seen).collect()
    }
}

#[cfg(test)]
#[path = "density_tests.rs"]
mod tests;
