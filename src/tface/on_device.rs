//! Training of `baseline` and `tface` on a GPU: the step of [`super::train`] with nobody waiting for the device.
//!
//! Rays are drawn, marched, decoded, compared and applied there; the host asks what some [`READ_EVERY`] steps came to.
//! Masks and finer grids, a handful in a training, are made on the host. What a checkpoint holds is the same as on the
//! CPU, so that either goes on from it.

use super::record::FORMAT;
use super::state::VmState;
use super::train::{BEHIND, VmTraining, over_white};
use crate::config::{MaskLoss, VmBackground, VmConfig};
use crate::field::checkpoint::{Checkpoint, TrainingProgress};
use crate::field::drawing::{self, DeviceRays};
use crate::field::parameters::Parameter;
use crate::field::pixels::Pixels;
use crate::field::training::{Learner, StepError, StepReport};
use crate::kernel::gpu::{
    self, Batch, Behind, Buffer, Device, Drawing, Gate, MaskTerm, Vm, VmLosses, VmValues,
};
use crate::kernel::vm::VmField;
use crate::{Error, Result};

/// Steps between two looks at losses: what goes wrong is known that much later.
const READ_EVERY: u64 = 50;

/// Values, moments and gradient of a parameter.
struct Group {
    state: [Buffer; 3],
    gradient: Buffer,
}

impl Group {
    fn new(device: &Device, p: &Parameter, upload: impl Fn(&[f32]) -> Buffer) -> Group {
        let state = p.state().map(|v| upload(&v));
        Group { gradient: device.zeros(state[0].words()), state }
    }
}

/// What a training has on its device between two changes of its grids.
struct There {
    vm: Vm,
    groups: [Group; 3],
    broken: Buffer,
}

impl There {
    fn new(device: &Device, field: &VmField, parameters: &[Parameter; 3], rays: usize) -> There {
        let vm = Vm::new(device, field, rays, true);
        let [density, color, network] = parameters;
        let groups = [
            Group::new(device, density, |v| vm.density.upload(device, v)),
            Group::new(device, color, |v| vm.color.upload(device, v)),
            Group::new(device, network, |v| device.upload(v)),
        ];
        There { groups, vm, broken: device.zeros(1) }
    }

    fn values(&self) -> VmValues<'_> {
        let [density, color, network] = self.groups.each_ref().map(|g| &g.state[0]);
        VmValues { density, color, network }
    }

    fn gradients(&self) -> VmValues<'_> {
        let [density, color, network] = self.groups.each_ref().map(|g| &g.gradient);
        VmValues { density, color, network }
    }

    /// Waits for the device; parameters as they are there, in place of those that lay there before.
    fn fetch(&self, device: &Device, old: &[Parameter; 3]) -> Result<[Parameter; 3]> {
        let [density, color, network] = old;
        let group = |old: &Parameter, i: usize, fetch: &dyn Fn(&Buffer) -> Result<Vec<f32>>| {
            let [values, first, second] = &self.groups[i].state;
            Ok::<_, Error>(old.with([fetch(values)?, fetch(first)?, fetch(second)?]))
        };
        Ok([
            group(density, 0, &|b| self.vm.density.fetch(device, b))?,
            group(color, 1, &|b| self.vm.color.fetch(device, b))?,
            group(network, 2, &|b| device.fetch(b))?,
        ])
    }
}

pub(super) struct OnDevice<'a> {
    /// What the CPU trains with; its parameters are older than those on the device.
    host: VmTraining<'a>,
    device: Device,
    rays: DeviceRays,
    wanted: Buffer,
    batch: Batch,
    losses: VmLosses,
    /// None only while it is made anew.
    there: Option<There>,
    /// Steps since losses were read.
    unread: u64,
}

/// How opacity is held to the mask.
fn mask_term(config: &VmConfig, pixels: &Pixels) -> MaskTerm {
    let weight = config.mask_weight as f32;
    match config.mask_loss {
        _ if !pixels.masked => MaskTerm::None,
        MaskLoss::None => MaskTerm::None,
        MaskLoss::L2 => MaskTerm::L2(weight),
        MaskLoss::Ce => MaskTerm::Ce(weight),
    }
}

impl<'a> OnDevice<'a> {
    /// Refuses a training that a device cannot take: it knows no such field, or has too little memory for the last grids.
    /// Do photographs lie there, too?
    pub fn fits(host: &VmTraining, device: &Device) -> Result<bool> {
        let config = host.config;
        let known = match config.ortho > 0.0 {
            true => Err("lines that are orthogonal"),
            false => gpu::DeviceDecoder::knows(&super::record::decoder(config)),
        };
        known.map_err(|what| {
            let problem = format!("the device `{}` knows no {what}", device.name());
            Error::usage(problem, "train with `--device cpu`")
        })?;
        let sizes = [host.state.size, host.state.last_size(config)];
        let fields = sizes.map(|size| host.state.field_of(config, size, true));
        let [fixed, ray] = fields
            .each_ref()
            .map(|f| Vm::bytes(device, f))
            .into_iter()
            .fold([0; 2], |a, b| [a[0].max(b[0]), a[1].max(b[1])]);
        let widest = fields.iter().map(Vm::widest).max().unwrap_or(1);
        let spare = device.spare().saturating_sub(fixed);
        // lattice points of all steps between two looks are counted in 32 bits
        let most = (spare / ray).min(device.limits().largest_buffer / widest);
        let most = most.min(u32::MAX as u64 / READ_EVERY / (widest / 12 + 2));
        let rays = config.rays as u64;
        if rays > most {
            let mib = |bytes: u64| bytes.div_ceil(1 << 20);
            let problem = format!(
                "the device `{}` has room for {most} rays of a step beside {} MiB of grids and gradients, {rays} are asked \
                 for",
                device.name(),
                mib(fixed)
            );
            let stage = host.stage();
            let remedy = match most {
                0..64 => format!("{stage}.voxels_final ({})", config.voxels_final),
                _ => format!("{stage}.rays to {most}"),
            };
            return Err(Error::cannot(problem, format!("lower {remedy}, or give more with `--memory`")));
        }
        Ok(drawing::resident(host.pixels, device, spare - rays * ray).is_some())
    }

    /// Moves a training there.
    ///
    /// # Errors
    ///
    /// Where it does not [fit](OnDevice::fits).
    pub fn new(host: VmTraining<'a>, device: Device) -> Result<OnDevice<'a>> {
        let resident = OnDevice::fits(&host, &device)?;
        let config = host.config;
        let field = host.state.field(config, true);
        let drawing = Drawing {
            every: false,
            jitter: true,
            background: config.background == VmBackground::Random,
            behind: BEHIND,
        };
        Ok(OnDevice {
            rays: DeviceRays::new(host.pixels, &device, drawing, resident),
            wanted: device.upload(&[config.rays as u32]),
            batch: Batch::new(&device, config.rays),
            losses: VmLosses::new(&device, config.rays, mask_term(config, host.pixels)),
            there: Some(There::new(&device, &field, &host.state.parameters, config.rays)),
            host,
            device,
            unread: 0,
        })
    }

    /// Ends the training on the device: what there is on the host.
    pub fn finish(self) -> VmTraining<'a> {
        self.host
    }

    fn there(&self) -> &There {
        self.there.as_ref().expect("made anew where it was dropped")
    }

    /// Copies the host's state to the device.
    fn push(&mut self) {
        let (config, state) = (self.host.config, &self.host.state);
        // what lies there goes first, or there would have to be room for both
        self.there = None;
        self.device.tidy();
        let there = There::new(&self.device, &state.field(config, true), &state.parameters, config.rays);
        self.there = Some(there);
    }

    /// Rebuilds the mask and refines the grids, on the host.
    fn grow(&mut self, step: u64) -> Result<(), StepError> {
        if self.device.fetch::<u32>(&self.there().broken)?[0] != 0 {
            return Err(self.host.not_finite("gradient of the", f32::NAN, step));
        }
        self.host.state.parameters = self.there().fetch(&self.device, &self.host.state.parameters)?;
        self.host.grow(step)?;
        self.push();
        Ok(())
    }

    /// Launches a step; waits for nothing.
    fn launch(&mut self, seed: u64, step: u64) {
        let (device, config, there) = (&self.device, self.host.config, self.there.as_ref());
        let there = there.expect("made anew where it was dropped");
        let detail = self.host.detail(step);
        self.rays.draw(device, self.host.pixels, (seed, step), &self.wanted, &mut self.batch, detail);
        let (vm, batch, values) = (&there.vm, &self.batch, there.values());
        let composed = vm.render(device, values, batch);
        let white = config.background == VmBackground::Reference && over_white(seed, step);
        let behind = Behind { lift: f32::from(white), target: config.background == VmBackground::Random };
        let g_out = self.losses.of_rays(device, composed, batch, behind);
        vm.backward(device, values, batch, g_out, there.gradients(), &there.broken);
        let [of_density, of_color] = self.host.penalties(step);
        vm.density.penalize(device, values.density, &of_density, there.gradients().density);
        vm.color.penalize(device, values.color, &of_color, there.gradients().color);
        let gate = Gate { count: self.losses.rays(), broken: &there.broken };
        for (group, step) in there.groups.iter().zip(self.host.adam_steps(step)) {
            gpu::adam(device, group.state.each_ref(), &group.gradient, &step, gate);
        }
        self.losses.add(device, vm, &there.broken);
    }

    /// Waits for the device: means over the steps since the last time.
    fn report(&mut self, step: u64) -> Result<StepReport, StepError> {
        let figures = self.losses.fetch(&self.device)?;
        let steps = std::mem::take(&mut self.unread).max(1) as f64;
        let counts = &mut self.host.counts;
        counts.rays += figures.rays;
        counts.lattice += figures.lattice;
        counts.density += figures.density;
        counts.color += figures.color;
        let [rgb, mask, outside] = figures.terms.map(|t| t as f64 / steps);
        for (term, value) in [("rgb", rgb), ("mask", mask)] {
            if !value.is_finite() {
                return Err(self.host.not_finite(term, value as f32, step));
            }
        }
        if figures.broken {
            return Err(self.host.not_finite("gradient of the", f32::NAN, step));
        }
        let samples = figures.density as f64 / steps;
        let figures = vec![("rgb", rgb), ("mask", mask), ("samples", samples), ("outside", outside)];
        Ok(StepReport { square_error: Some(rgb as f32), figures })
    }
}

impl Learner for OnDevice<'_> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = VmTraining::RATES;
    const EVERY: u64 = READ_EVERY;

    fn step(&mut self, progress: &TrainingProgress) -> Result<StepReport, StepError> {
        let step = progress.step;
        self.launch(self.host.seed(progress), step);
        self.unread += 1;
        let done = step + 1;
        let mut report = StepReport { square_error: None, figures: Vec::new() };
        if done.is_multiple_of(READ_EVERY) || done == self.host.config.steps {
            report = self.report(step)?;
        }
        if self.host.grows(step) {
            self.grow(step)?;
        }
        Ok(report)
    }

    fn save(
        &self,
        progress: &TrainingProgress,
        into: &mut Checkpoint,
        finished: bool,
    ) -> Result<(), StepError> {
        let state = &self.host.state;
        let state = VmState {
            parameters: self.there().fetch(&self.device, &state.parameters)?,
            mask: state.mask.clone(),
            ..*state
        };
        let broken = self.device.fetch::<u32>(&self.there().broken)?[0] != 0;
        if broken || !state.is_finite() {
            return Err(self.host.not_finite("grid", f32::NAN, progress.step));
        }
        state.save(self.host.config, into, finished);
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        let finished = from.as_ref().is_some_and(|(.., finished)| *finished);
        self.host.restore(from)?;
        self.losses.forget(&self.device);
        self.unread = 0;
        // nobody goes on from a finished one, which has no moments
        if !finished {
            self.push();
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "on_device_tests.rs"]
mod tests;
