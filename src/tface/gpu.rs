//! A training step of the vector-matrix field on a GPU. Sampling, marching, decoding, losses and
//! optimizer all run on the device, so the host never waits within a step. Alpha masks and refined
//! grids, a handful per training, are computed on the host.

use super::ops::{BACKGROUND_STREAM, VmGroups, VmOps, mask_term, random_background};
use super::record::decoder;
use super::state::first_and_last;
use crate::config::VmConfig;
use crate::field::drawing::DeviceSampler;
use crate::field::memory::MemoryNeed;
use crate::field::ops::{ArrayDevice, Ops};
use crate::field::parameters::{HostGroup, ParameterGroup};
use crate::field::pixels::RaySampler;
use crate::field::training::StepAt;
use std::sync::Arc;
use tiface_base::{Error, Result};
use tiface_kernels::cpu::vm::VmField;
use tiface_kernels::cpu::vm::losses::{BackgroundMode, VmFigures};
use tiface_kernels::gpu::{
    self, Buffer, Device, DeviceBatch, DeviceDecoder, Gate, SamplingOptions, Vm, VmLosses, VmValues,
};

/// Returns the settings with so few voxels that a cube of them takes no more memory than a box of
/// any shape does with those of `config`. A cube has the shortest diagonal, and the smallest planes
/// if all have as many channels; else a box may have smaller ones, at least those of the geometric
/// mean of the channels.
fn with_fewest_voxels(config: &VmConfig) -> VmConfig {
    let share = |ranks: &[usize]| {
        let ranks = || ranks.iter().map(|rank| rank.next_multiple_of(4) as f64);
        (3.0 * ranks().product::<f64>().cbrt() / ranks().sum::<f64>()).powf(1.5).min(1.0)
    };
    let share = share(&config.density_rank).min(share(&config.color_rank));
    let [voxels_start, voxels_final] =
        [config.voxels_start, config.voxels_final].map(|voxels| (voxels as f64 * share) as u64);
    VmConfig { voxels_start, voxels_final, ..config.clone() }
}

/// The operations of [`VmOps`] on a GPU, with their device memory.
pub struct GpuVm<'a> {
    sampler: &'a RaySampler<'a>,
    pub(super) device: Device,
    photographs: DeviceSampler,
    /// Number of rays of a step, and the same on the device, `[1]`.
    rays: usize,
    ray_count: Buffer,
    batch: DeviceBatch,
    losses: VmLosses,
    /// Kernels and buffers of the field; `None` while no field is loaded.
    vm: Option<Vm>,
    /// `[1]`: not 0 once a gradient was not finite.
    non_finite: Buffer,
}

impl<'a> GpuVm<'a> {
    /// Checks that a device supports the field of a training in a box and has enough memory for its
    /// largest grids. Returns whether the photographs fit as well.
    pub fn fits(
        stage: &str,
        config: &VmConfig,
        sampler: &RaySampler,
        bounds: [[f32; 3]; 2],
        device: &Device,
    ) -> Result<bool> {
        Self::fits_fields(stage, config, sampler, &first_and_last(config, bounds), device)
    }

    /// The same before a box is known: refuses what fits in none.
    pub fn fits_some_box(
        stage: &str,
        config: &VmConfig,
        sampler: &RaySampler,
        device: &Device,
    ) -> Result<bool> {
        let fields = first_and_last(&with_fewest_voxels(config), [[-1.0; 3], [1.0; 3]]);
        Self::fits_fields(stage, config, sampler, &fields, device)
    }

    fn fits_fields(
        stage: &str,
        config: &VmConfig,
        sampler: &RaySampler,
        fields: &[VmField; 2],
        device: &Device,
    ) -> Result<bool> {
        DeviceDecoder::supports(&decoder(config)).map_err(|what| {
            let problem = format!("the device `{}` does not support {what}", device.name());
            Error::usage(problem, "train with `--device cpu`")
        })?;
        let [fixed, ray] = fields
            .each_ref()
            .map(|f| Vm::bytes(device, f, config.rays))
            .into_iter()
            .fold([0; 2], |a, b| [a[0].max(b[0]), a[1].max(b[1])]);
        let widest = fields.iter().map(Vm::widest).max().unwrap_or(1);
        let rays = config.rays as u64;
        // A 32-bit counter sums the lattice points of all steps between two readbacks.
        let countable = u32::MAX as u64 / Device::READ_EVERY / (widest / 12 + 2);
        let need = MemoryNeed {
            fixed: (fixed, "grids and gradients"),
            unit: "rays",
            each: [ray, widest.max(device.limits().largest_buffer.div_ceil(countable))],
            wanted: rays,
            minimum: rays,
        };
        // the grids of both stages are those of `tface`
        let plan = need.plan(sampler, device, |fits| match fits {
            0..64 => format!("tface.voxels_final ({})", config.voxels_final),
            _ => format!("{stage}.rays to {fits}"),
        });
        plan.map(|(_, resident)| resident)
    }

    /// Creates the operations of a training that [`fits`](GpuVm::fits) a device. `resident` copies
    /// the photographs to the device.
    pub fn new(
        config: &'a VmConfig,
        sampler: &'a RaySampler<'a>,
        device: Device,
        resident: bool,
    ) -> GpuVm<'a> {
        let drawing = SamplingOptions {
            jitter: true,
            background: random_background(config),
            background_stream: BACKGROUND_STREAM,
        };
        GpuVm {
            sampler,
            photographs: DeviceSampler::new(sampler, &device, drawing, resident),
            rays: config.rays,
            ray_count: device.upload(&[config.rays as u32]),
            batch: DeviceBatch::new(&device, config.rays),
            losses: VmLosses::new(&device, config.rays, mask_term(config, sampler)),
            vm: None,
            non_finite: device.zeros::<u32>(1),
            device,
        }
    }

    fn vm(&self) -> &Vm {
        self.vm.as_ref().expect("a field is loaded before the first step")
    }
}

/// Selects one array of each group.
fn arrays<'g>(
    groups: &'g VmGroups<GpuVm>,
    which: impl Fn(&'g ParameterGroup<Device>) -> &'g Buffer,
) -> VmValues<'g> {
    let [density, color, network] = groups;
    VmValues { density: which(density), color: which(color), network: which(network) }
}

impl Ops for GpuVm<'_> {
    type Device = Device;

    fn device(&self) -> &Device {
        &self.device
    }

    fn gate(&self) -> Gate<'_> {
        Gate { count: self.losses.rays(), non_finite: &self.non_finite }
    }
}

impl VmOps for GpuVm<'_> {
    fn load(&mut self, field: &Arc<VmField>, groups: [HostGroup; 3]) -> VmGroups<Self> {
        self.vm = Some(Vm::new(&self.device, field, self.batch.rays(), true));
        self.non_finite = self.device.zeros::<u32>(1);
        let [density, color, network] = groups;
        let pad = |mut group: HostGroup, grid: &gpu::DeviceGrid| {
            group.state = group.state.map(|values| grid.pad(values));
            group
        };
        let vm = self.vm();
        [pad(density, &vm.density), pad(color, &vm.color), network]
            .map(|group| ParameterGroup::upload(&self.device, group))
    }

    fn unload(&mut self, groups: Option<VmGroups<Self>>) {
        drop(groups);
        self.vm = None;
        self.device.release_unused();
    }

    fn read(&self, groups: &VmGroups<Self>) -> Result<[HostGroup; 3]> {
        let vm = self.vm();
        let [density, color, network] = groups.each_ref().map(|group| group.download(&self.device));
        let cut = |mut group: HostGroup, grid: &gpu::DeviceGrid| {
            group.state = group.state.map(|values| grid.cut(values));
            group
        };
        Ok([cut(density?, &vm.density), cut(color?, &vm.color), network?])
    }

    fn is_non_finite(&self) -> Result<bool> {
        Ok(self.device.fetch::<u32>(&self.non_finite)?[0] != 0)
    }

    fn draw(&mut self, at: StepAt, rays: usize, detail: f32) {
        if self.rays != rays {
            (self.rays, self.ray_count) = (rays, self.device.upload(&[rays as u32]));
        }
        let (device, at) = (&self.device, (at.seed, at.step));
        self.photographs.draw(device, self.sampler, at, &self.ray_count, &mut self.batch, detail);
    }

    fn vm_render(&mut self, groups: &VmGroups<Self>) {
        self.vm().render(&self.device, arrays(groups, |group| group.value()), &self.batch);
    }

    fn losses(&mut self, mode: BackgroundMode) {
        self.losses.of_rays(&self.device, self.vm().output(), &self.batch, mode);
    }

    fn backward(&mut self, groups: &mut VmGroups<Self>) {
        let (device, vm) = (&self.device, self.vm());
        let values = arrays(groups, |group| group.value());
        let gradients = arrays(groups, |group| &group.gradient);
        vm.backward(device, values, &self.batch, self.losses.gradient(), gradients, &self.non_finite);
        self.losses.add(device, vm, &self.non_finite);
    }

    fn penalize(&mut self, groups: &mut VmGroups<Self>, weights: [f32; 2]) {
        let (device, vm) = (&self.device, self.vm());
        for ((grid, weight), group) in [&vm.density, &vm.color].into_iter().zip(weights).zip(groups) {
            grid.penalize(device, group.value(), weight, &group.gradient);
        }
    }

    fn reset_totals(&mut self) {
        self.losses.reset_totals(&self.device);
    }

    fn figures(&self) -> Result<VmFigures> {
        self.losses.fetch(&self.device)
    }
}

#[cfg(test)]
#[path = "gpu_tests.rs"]
mod tests;
