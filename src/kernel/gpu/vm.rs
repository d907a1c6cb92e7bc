//! TensoRF's field of [`crate::kernel::cpu::vm`], whose modules hold the formulas: rays through it, and their gradients.
//!
//! Samples are marched first, all that the mask leaves; then their densities are looked up, weights are composited, and
//! those worth a color are listed and decoded. The rays that the CPU ends early are marched on here, but what lies
//! behind has neither weight nor gradient either.

#[cfg(test)]
mod case_tests;
mod decoder;
mod grid;
mod losses;
mod march;
mod rays;
mod renderer;

pub use decoder::DeviceDecoder;
pub use grid::DeviceGrid;
pub use losses::VmLosses;
pub use renderer::VmRenderer;

use super::device::Atomics;
use super::device::{Buffer, Device};
use super::draw::Batch;
use crate::kernel::cpu::vm::{Grid, VmField};
use march::{DeviceLattice, VmSamples};
use rays::Along;

/// Samples of a tile, of which all rooms are a multiple.
const TILE: usize = 64;

/// The most samples of a pass through a field that does not learn: of rays that have more, fewer are taken.
const SEEN: usize = 1 << 22;

/// A field on a device, with buffers for a batch of rays.
pub struct Vm {
    /// Planes and lines of the density.
    pub density: DeviceGrid,
    /// Planes and lines of the appearance.
    pub color: DeviceGrid,
    lattice: DeviceLattice,
    decoder: DeviceDecoder,
    samples: VmSamples,
    along: Along,
}

/// The weights of a field on a device: planes and lines as [`DeviceGrid::upload`] lays them, the decoder's as the CPU's.
#[derive(Clone, Copy)]
pub struct VmValues<'a> {
    /// Planes and lines of the density.
    pub density: &'a Buffer,
    /// Planes and lines of the appearance.
    pub color: &'a Buffer,
    /// Weights of the decoder.
    pub network: &'a Buffer,
}

impl Vm {
    /// Allocates buffers for `rays` rays with any number of samples, and for gradients if `learns`. The decoder must be one that
    /// [`DeviceDecoder::supports`].
    pub fn new(device: &Device, field: &VmField, rays: usize, learns: bool) -> Vm {
        Vm::with_max_samples(device, field, rays, if learns { usize::MAX } else { SEEN }, learns)
    }

    /// Returns the bytes of a field that learns from batches of so many rays: with values, moments and gradients, and for
    /// each ray of a batch. Buffers hold all samples that rays can have.
    pub fn bytes(device: &Device, field: &VmField, rays: usize) -> [u64; 2] {
        let floats = |grid: Grid| DeviceGrid::padded(grid).len();
        let copies = if device.atomics() == Atomics::Fixed { 5 } else { 4 };
        let grids = copies * (floats(field.density) + floats(field.color));
        let (max_samples, quads) = (DeviceLattice::max_samples(field), DeviceGrid::quads_of(field.color));
        let gradients = DeviceDecoder::words_of_gradients(&field.decoder, quads, rays * max_samples);
        let samples = max_samples * (VmSamples::WORDS + Along::WORDS);
        [4 * (grids + gradients) as u64, 4 * (samples + Along::OF_RAY) as u64]
    }

    /// Bytes of the largest buffer for each ray of a batch.
    pub fn widest(field: &VmField) -> u64 {
        12 * DeviceLattice::max_samples(field) as u64
    }

    /// Allocates buffers for at most `max_samples` samples.
    fn with_max_samples(
        device: &Device,
        field: &VmField,
        rays: usize,
        max_samples: usize,
        learns: bool,
    ) -> Vm {
        assert_eq!(field.density.size, field.color.size);
        let lattice = DeviceLattice::new(device, field);
        let capacity = rays.saturating_mul(lattice.max_samples).min(max_samples).next_multiple_of(TILE);
        let color = DeviceGrid::new(device, field.color);
        Vm {
            density: DeviceGrid::new(device, field.density),
            decoder: DeviceDecoder::new(device, &field.decoder, &color, capacity, learns),
            color,
            lattice,
            samples: VmSamples::new(device, rays, capacity),
            along: Along::new(device, field, rays, capacity, learns),
        }
    }

    /// Renders all rays whose samples fit into the buffers: planes `[5, rays]`, see [`crate::kernel::cpu::vm::RAY_WIDTH`].
    pub fn render(&self, device: &Device, values: VmValues, rays: &Batch) -> &Buffer {
        let (samples, along) = (&self.samples, &self.along);
        self.decoder.prepare(device, values.network);
        samples.march(device, &self.lattice, rays);
        self.density.gather(device, values.density, &samples.place, &samples.count, &along.feature);
        along.compute_weights(device, samples);
        self.decoder.forward(device, &self.color, values.color, rays, samples, along);
        along.composite(device, samples);
        &along.out
    }

    /// Returns the composited values of the last render, planes `[5, rays]`.
    pub fn output(&self) -> &Buffer {
        &self.along.out
    }

    /// Adds the gradients of planes and lines to those of `gradients`, and writes those of the decoder's weights: of the
    /// rays of the last render, by what was composited, planes `[5, rays]`. Where one of the latter is not finite,
    /// `broken`, `[1]`, becomes 1.
    pub fn backward(
        &self,
        device: &Device,
        values: VmValues,
        rays: &Batch,
        g_out: &Buffer,
        gradients: VmValues,
        broken: &Buffer,
    ) {
        let (samples, along) = (&self.samples, &self.along);
        along.backward(device, samples, g_out);
        let (place, count) = (&samples.place, &samples.count);
        let g = &along.g_feature;
        self.density.scatter(device, gradients.density, values.density, place, None, count, g);
        self.decoder.backward(
            device,
            &self.color,
            values.color,
            rays,
            samples,
            along,
            values.network,
            gradients.color,
            gradients.network,
            broken,
        );
    }

    /// Returns the number of samples that were looked up and that would have been with larger buffers, the same of decoded ones, `[2]` each; and the lattice points of each ray, `[rays]`.
    pub fn counts(&self) -> [&Buffer; 3] {
        [&self.samples.count, &self.along.count, &self.samples.points]
    }
}

#[cfg(test)]
mod tests;
