//! Training of `iface` on a GPU: the step of [`super::train`] with nobody waiting for the device.
//!
//! Rays are drawn, marched, shaded, compared and applied there; the host asks for the figures of one step in
//! [`READ_EVERY`]. What a checkpoint holds is the same as on the CPU, so that either goes on from it.

use super::losses::KNEE;
use super::model::{SdfModel, shape};
use super::schedule;
use super::state::{FORMAT, SdfState};
use super::train::{LOST_AFTER, MOST_BUDGETS, STEREO_POINTS, SdfTraining, TERMS, VARIANCE, adam_steps, lost};
use crate::config::iface::{Background, IfaceConfig, OccupancyRule};
use crate::field::checkpoint::{Checkpoint, TrainingProgress};
use crate::field::drawing::{self, DeviceRays};
use crate::field::parameters::Parameter;
use crate::field::training::{Learner, StepError, StepReport};
use crate::kernel::gpu::{
    self, Band, Batch, Buffer, Device, Drawing, Gate, LossWeights, Losses, Nerfacc, Neus, Norm, Occupancy,
    Pitch, RayBudget, Rays, Samples, Schedule, Sdf, SurfacePoints,
};
use crate::kernel::hash;
use crate::kernel::mlp::TILE;
use crate::kernel::sdf::FieldShape;
use crate::{Error, Result};

/// Steps between two looks at losses and flags: what goes wrong is known that much later.
const READ_EVERY: u64 = 50;

/// Values, moments and gradient of one group of parameters.
struct Group {
    state: [Buffer; 3],
    gradient: Buffer,
}

impl Group {
    fn new(device: &Device, parts: &[Parameter]) -> Group {
        let mut state = [Vec::new(), Vec::new(), Vec::new()];
        for p in parts {
            let values = p.state();
            state.iter_mut().zip(values).for_each(|(all, own)| all.extend(own));
        }
        let gradient = device.zeros(state[0].len());
        Group { state: state.map(|v| device.upload(&v)), gradient }
    }

    /// Gives parameters of these shapes what is there now.
    fn read(&self, device: &Device, parts: &mut [Parameter]) -> Result<()> {
        let [values, first, second] = &self.state;
        let [values, first, second] = [device.fetch(values)?, device.fetch(first)?, device.fetch(second)?];
        let mut at = 0;
        for p in parts {
            let own = at..at + p.len();
            p.set([&values, &first, &second].map(|v: &Vec<f32>| v[own.clone()].to_vec()));
            at = own.end;
        }
        Ok(())
    }

    fn value(&self) -> &Buffer {
        &self.state[0]
    }

    fn parts(&self) -> [&Buffer; 3] {
        self.state.each_ref()
    }
}

/// How the cells to march through are looked at again.
enum CellRule {
    Band(Box<Band>),
    Nerfacc(Box<Nerfacc>),
}

impl CellRule {
    fn new(device: &Device, host: &SdfTraining, there: &Occupancy, capacity: usize) -> CellRule {
        let (config, occupancy) = (host.config, &host.state.occupancy);
        match config.occupancy {
            OccupancyRule::Band => {
                let rule = Band::new(device, occupancy.allowed(), config.band, config.soften as f32);
                CellRule::Band(Box::new(rule))
            }
            OccupancyRule::Nerfacc => {
                let step = schedule::march_step(config, 1.0);
                CellRule::Nerfacc(Box::new(Nerfacc::new(device, there, &occupancy.history, step, capacity)))
            }
        }
    }
}

/// What a training has on its device.
struct There {
    table: Group,
    network: Group,
    variance: Group,
    flat: Buffer,
    g_flat: Buffer,
    inv_s: Buffer,
    g_inv_s: Buffer,
    broken: Buffer,
    schedule: Schedule,
    occupancy: Occupancy,
    cells: CellRule,
    /// Has a step been made since?
    stepped: bool,
}

pub(super) struct OnDevice<'a> {
    /// What the CPU trains with; its state is older than that on the device.
    host: SdfTraining<'a>,
    device: Device,
    rays: DeviceRays,
    batch: Batch,
    samples: Samples,
    points: SurfacePoints,
    norm: Norm,
    sdf: Sdf,
    neus: Neus,
    losses: Losses,
    there: There,
}

impl<'a> OnDevice<'a> {
    /// Refuses a training that a device cannot take: it knows no such field, or has too little memory.
    pub fn fits(host: &SdfTraining, device: &Device) -> Result<()> {
        if !Sdf::knows(&host.shape) {
            let problem = format!("a device has no room for {} levels in a tile", host.config.levels);
            return Err(Error::usage(problem, "lower iface.levels, or train with `--device cpu`"));
        }
        room(host, device, points(host.config)).map(|_| ())
    }

    /// Moves a training that [`fits`](OnDevice::fits) to a device.
    ///
    /// # Errors
    ///
    /// Where the device has too little memory.
    pub fn new(host: SdfTraining<'a>, device: Device) -> Result<OnDevice<'a>> {
        let config = host.config;
        let rays = config.rays.max(config.max_rays);
        let points = points(config);
        let (capacity, resident) = room(&host, &device, points)?;
        let weights = LossWeights {
            rgb_mse: config.rgb_mse as f32,
            rgb_l1: config.rgb_l1 as f32,
            rgb_sample: config.rgb_sample as f32,
            mask: if host.pixels.masked { config.mask as f32 } else { 0.0 },
            eikonal: config.eikonal as f32,
            sparsity: config.sparsity as f32,
            sparsity_scale: config.sparsity_scale as f32,
        };
        let drawing = Drawing {
            every: host.pixels.is_published(),
            jitter: config.jitter,
            background: config.background == Background::Random,
            behind: 3,
        };
        Ok(OnDevice {
            rays: DeviceRays::new(&host.pixels, &device, drawing, resident),
            batch: Batch::new(&device, rays),
            samples: Samples::new(&device, rays, capacity),
            points: SurfacePoints::new(&device, points, config.stereo as f32, KNEE as f32),
            norm: Norm::new(&device, host.shape.layout()),
            sdf: Sdf::new(&device, &host.shape, capacity),
            neus: Neus::new(&device, rays, capacity),
            losses: Losses::new(&device, weights, rays, capacity),
            there: There::new(&device, &host, capacity),
            host,
            device,
        })
    }

    /// Ends the training on the device: what the CPU would have come to.
    pub fn finish(mut self) -> Result<SdfTraining<'a>> {
        self.host.state = self.pulled()?;
        Ok(self.host)
    }

    /// Waits for the device; the state as it is there.
    fn pulled(&self) -> Result<SdfState> {
        let (host, there, config) = (&self.host, &self.there, self.host.config);
        let mut model = SdfModel::new(config, 0, &host.device);
        let [table, network @ .., variance] = &mut model.0;
        there.table.read(&self.device, std::slice::from_mut(table))?;
        there.network.read(&self.device, network)?;
        there.variance.read(&self.device, std::slice::from_mut(variance))?;
        variance.keep_within(VARIANCE);
        let mut occupancy = host.state.occupancy.clone();
        [occupancy.occupied, occupancy.solid] = there.occupancy.read(&self.device)?;
        if let CellRule::Nerfacc(rule) = &there.cells {
            occupancy.history = rule.read(&self.device)?;
        }
        let mut rays = self.device.fetch::<u32>(&there.schedule.rays)?[0] as usize;
        if there.stepped {
            let wanted = self.device.fetch::<u32>(&self.samples.count)?[1] as usize;
            rays = host.next_rays(rays, wanted);
        }
        Ok(SdfState { model, occupancy, rays, stereo: host.state.stereo.clone() })
    }

    /// Copies the host's state to the device.
    fn push(&mut self) {
        self.there = There::new(&self.device, &self.host, self.samples.t.words());
        self.push_points();
    }

    fn push_points(&mut self) {
        let rows: Vec<[f32; 5]> = self.host.state.stereo.iter().map(|p| p.row()).collect();
        self.points.put(&self.device, &rows);
    }

    fn update_occupancy(&self, at: (u64, u64)) {
        let (there, device) = (&self.there, &self.device);
        let field = [there.table.value(), &there.flat, &there.inv_s];
        let over = [&self.samples.x, &self.samples.direction];
        match &there.cells {
            CellRule::Band(rule) => rule.update(device, &there.occupancy, &self.sdf, field, over),
            CellRule::Nerfacc(rule) => rule.update(device, at, &there.occupancy, &self.sdf, field, over),
        }
    }

    /// What the last step came to.
    fn report(&self, lr: f64, step: u64) -> Result<StepReport, StepError> {
        let there = &self.there;
        let sums = self.losses.sums(&self.device, &self.samples.count, self.points.terms());
        let count = &self.samples.count;
        let figures =
            there.schedule.figures(&self.device, sums, there.variance.value(), count, &there.broken)?;
        let [mse, _, _, mask, eikonal, sparsity, stereo] = figures.losses;
        let config = self.host.config;
        let only = |weight: f64, value: f32| if weight > 0.0 { value } else { 0.0 };
        let mask = only(if self.host.pixels.masked { config.mask } else { 0.0 }, mask);
        let terms = [mse, mask, eikonal, only(config.sparsity, sparsity), only(config.stereo, stereo)];
        if figures.broken {
            let term = "gradient of the";
            return Err(StepError::NotFinite { term, value: f32::NAN, lr });
        }
        if figures.blind as u64 >= LOST_AFTER {
            return Err(StepError::Failed(lost(step)));
        }
        if figures.samples == 0 {
            return Ok(StepReport { square_error: None, figures: Vec::new() });
        }
        for (term, value) in TERMS.into_iter().zip(terms) {
            if !value.is_finite() {
                return Err(StepError::NotFinite { term, value, lr });
            }
        }
        let mut named: Vec<_> = TERMS.into_iter().zip(terms.map(|v| v as f64)).collect();
        named.extend([
            ("inv_s", (10.0 * figures.variance as f64).exp()),
            ("rays", self.host.next_rays(figures.rays as usize, figures.samples as usize) as f64),
            ("samples", figures.samples as f64),
        ]);
        Ok(StepReport { square_error: Some(mse), figures: named })
    }

    /// Launches the step; waits for nothing.
    fn launch(&mut self, seed: (u64, u64), factor: f64) {
        let device = &self.device;
        let (there, config) = (&self.there, self.host.config);
        let samples = &self.samples;
        let step = seed.1;
        there.schedule.advance(device, &there.inv_s, &samples.count, !there.stepped);
        let detail = schedule::detail(config, step);
        self.rays.draw(device, &self.host.pixels, seed, &there.schedule.rays, &mut self.batch, detail);
        let (rays, offsets, count) = (&self.batch, &samples.offsets, &samples.count);
        samples.march(device, &there.occupancy, rays, &there.schedule.pitch, usize::MAX, self.points.most());
        let both = self.points.append(device, seed, samples);
        let (x, toward) = (&samples.x, &samples.direction);
        let field = self.sdf.forward(device, there.table.value(), &there.flat, x, toward, both);
        let anneal = schedule::anneal(config, step);
        let bundle = Rays { offsets, direction: &rays.direction, t: &samples.t, dt: &samples.dt };
        let composed = self.neus.forward(device, bundle, field, &there.inv_s, anneal);
        let g_out = self.losses.of_rays(device, composed, rays, offsets);
        let g_field = self.neus.backward(device, bundle, field, &there.inv_s, anneal, g_out, &there.g_inv_s);
        self.losses.of_samples(device, field, count, g_field);
        self.points.losses(device, field, count, g_field);
        let (table, network, variance) = (&there.table, &there.network, &there.variance);
        self.sdf.backward(device, x, toward, both, g_field, &table.gradient, &there.g_flat);
        let from = [&there.g_flat, &there.g_inv_s];
        let into = [&network.gradient, &variance.gradient];
        self.norm.backward(device, network.value(), &there.inv_s, from, into, &there.broken);
        let gate = Gate { count, broken: &there.broken };
        let steps = adam_steps(config, factor, step + 1);
        for (group, step) in
            [table, network, variance].into_iter().zip([steps.table, steps.network, steps.variance])
        {
            gpu::adam(device, group.parts(), &group.gradient, &step, gate);
        }
    }
}

/// Stereo points that a step has room for.
fn points(config: &IfaceConfig) -> usize {
    if config.stereo > 0.0 { STEREO_POINTS as usize } else { 1 }
}

/// Samples that a step has room for, as many as on the CPU where the device's memory and buffers are large enough; and do
/// photographs lie there, too?
fn room(host: &SdfTraining, device: &Device, points: usize) -> Result<(usize, bool)> {
    /// Samples with their rays, compositing and losses, and the cells that are looked at in their place.
    const BESIDE: usize = 3 + 3 + 2 + 9 + 2 + 1;
    let config = host.config;
    let [words, widest] = Sdf::words_per_sample(&host.shape);
    let sample = 4 * (words + BESIDE) as u64;
    // values, moments and gradient; cells with their number, distance and reach or history and last draw, and bits
    let cells = config.occupancy_resolution.pow(3) as u64;
    let fixed_with = |shape: &FieldShape| 32 * hash::entries(&shape.levels) as u64 + 13 * cells;
    let fixed = fixed_with(&host.shape);
    let spare = device.spare().saturating_sub(fixed);
    let wanted = (MOST_BUDGETS * config.samples + points) as u64;
    let resident = drawing::resident(&host.pixels, device, spare.saturating_sub(wanted * sample));
    let by_buffer = device.limits().largest_buffer / (4 * widest as u64);
    let capacity = wanted.min(by_buffer).min((spare - resident.unwrap_or(0)) / sample) as usize;
    let least = config.samples + points;
    if capacity < least {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        let problem = format!(
            "the device `{}` has room for {capacity} samples of a step beside {} MiB of hash tables and cells, {least} are \
             needed",
            device.name(),
            mib(fixed),
        );
        let table = |log2: u32| fixed_with(&shape(&IfaceConfig { log2_table: log2, ..config.clone() }));
        let beside = device.spare().checked_sub(least as u64 * sample).filter(|_| by_buffer >= least as u64);
        let smaller = beside.and_then(|room| (4..config.log2_table).rev().find(|&log2| table(log2) <= room));
        let remedy = match (capacity.saturating_sub(points), smaller) {
            (fits @ 64.., _) => format!("iface.samples to {fits}"),
            (_, Some(log2)) => format!("iface.log2_table to {log2}"),
            _ => "iface.samples, then iface.log2_table".into(),
        };
        return Err(Error::cannot(problem, format!("lower {remedy}, or give more with `--memory`")));
    }
    // the last tile is a whole one
    let whole =
        if capacity as u64 == wanted { capacity.next_multiple_of(TILE) } else { capacity / TILE * TILE };
    Ok((whole, resident.is_some()))
}

fn there_occupancy(device: &Device, host: &SdfTraining) -> Occupancy {
    let occupancy = &host.state.occupancy;
    let solid = (host.config.occupancy == OccupancyRule::Band).then_some(&occupancy.solid);
    Occupancy::new(device, &occupancy.occupied, solid, host.config.radius)
}

/// How march steps follow the sharpness: see [`schedule::march_step`].
fn pitch(config: &IfaceConfig) -> Pitch {
    match config.occupancy {
        OccupancyRule::Nerfacc => Pitch::Constant(schedule::march_step(config, 1.0)),
        OccupancyRule::Band => {
            Pitch::OfSharpness { units: config.march, min: config.min_step, max: config.max_step }
        }
    }
}

impl There {
    /// `capacity`: samples that a step has room for.
    fn new(device: &Device, host: &SdfTraining, capacity: usize) -> There {
        let [table, network @ .., variance] = &host.state.model.0;
        let flat = host.shape.layout().len();
        let config = host.config;
        let budget = RayBudget { samples: config.samples, min: host.fewest_rays(), max: config.max_rays };
        let occupancy = there_occupancy(device, host);
        There {
            table: Group::new(device, std::slice::from_ref(table)),
            network: Group::new(device, network),
            variance: Group::new(device, std::slice::from_ref(variance)),
            flat: device.zeros(flat),
            g_flat: device.zeros(flat),
            inv_s: device.zeros(1),
            g_inv_s: device.zeros(1),
            broken: device.zeros(1),
            schedule: Schedule::new(device, pitch(config), budget, host.state.rays),
            cells: CellRule::new(device, host, &occupancy, capacity),
            occupancy,
            stepped: false,
        }
    }
}

impl Learner for OnDevice<'_> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = SdfTraining::RATES;
    const EVERY: u64 = READ_EVERY;

    fn step(&mut self, progress: &TrainingProgress) -> Result<StepReport, StepError> {
        let config = self.host.config;
        let step = progress.step;
        let seed = (self.host.seed(progress), step);
        let factor = schedule::learning_rate(config, step);
        self.sdf.activate(schedule::active_levels(config, step));
        let range = [*VARIANCE.start(), *VARIANCE.end()];
        let there = &self.there;
        self.norm.forward(
            &self.device,
            there.network.value(),
            there.variance.value(),
            range,
            &there.flat,
            &there.inv_s,
        );
        if self.host.looks_again(step) {
            self.update_occupancy(seed);
        }
        if schedule::stereo_step(config) == Some(step) {
            self.host.state = self.pulled()?;
            let shape = self.host.shape_at(step);
            self.host.find_stereo(&shape);
            self.push_points();
        }
        self.launch(seed, factor);
        self.there.stepped = true;
        if (step + 1).is_multiple_of(READ_EVERY) || step + 1 == config.steps {
            return self.report(config.lr_network * factor, step);
        }
        Ok(StepReport { square_error: None, figures: Vec::new() })
    }

    fn save(&self, progress: &TrainingProgress, into: &mut Checkpoint, _: bool) -> Result<(), StepError> {
        let lr = self.host.config.lr_network * schedule::learning_rate(self.host.config, progress.step);
        if self.device.fetch::<u32>(&self.there.broken)?[0] != 0 {
            return Err(StepError::NotFinite { term: "gradient of the", value: f32::NAN, lr });
        }
        self.pulled()?.save(into);
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        self.host.restore(from)?;
        self.push();
        Ok(())
    }
}

#[cfg(test)]
#[path = "on_device_tests.rs"]
mod tests;
