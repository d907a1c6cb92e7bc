//! TensoRF's field of [`crate::cpu::vm`], whose modules hold the formulas: rays through it, and
//! their gradients.
//!
//! Samples in occupied cells are marched first; then their densities are looked up, weights are
//! composited, and those worth a color are listed and decoded. The rays that the CPU ends early are
//! marched on here, but what lies behind has neither weight nor gradient either. [`VmRenderer`]
//! renders a trained field along any number of rays.

mod decoder;
mod grid;
mod losses;
mod march;
mod rays;

pub use decoder::DeviceDecoder;
pub use grid::DeviceGrid;
pub use losses::VmLosses;

use super::batch::DeviceBatch;
use super::device::{Atomics, Buffer, Device};
use crate::cpu::vm::{Grid, RAY_WIDTH, VmField};
use march::{DeviceLattice, VmSamples};
use rays::CompositedRays;
use std::sync::Arc;
use tiface_base::Result;
use tiface_base::geom::Ray;

/// Number of samples of a tile; capacities are multiples of it.
const TILE: usize = 64;

/// Maximum number of samples of a pass of a field that is not trained; if rays have more, a pass
/// takes fewer rays.
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
    composited: CompositedRays,
}

/// The weights of a field on a device: planes and lines as [`DeviceGrid::upload`] lays them, the
/// decoder's as the CPU's.
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
    /// Allocates buffers for `rays` rays with any number of samples, and for gradients if `learns`.
    /// The decoder must be one that [`DeviceDecoder::supports`].
    pub fn new(device: &Device, field: &VmField, rays: usize, learns: bool) -> Vm {
        Vm::with_max_samples(device, field, rays, if learns { usize::MAX } else { SEEN }, learns)
    }

    /// Returns the bytes of a field that learns from batches of so many rays: with values, moments
    /// and gradients, and for each ray of a batch. Buffers hold all samples that rays can have.
    pub fn bytes(device: &Device, field: &VmField, rays: usize) -> [u64; 2] {
        let floats = |grid: Grid| DeviceGrid::padded(grid).len();
        let copies = if device.atomics() == Atomics::Fixed { 5 } else { 4 };
        let grids = copies * (floats(field.density) + floats(field.color));
        let (max_samples, quads) = (DeviceLattice::max_samples(field), DeviceGrid::quads_of(field.color));
        let gradients = DeviceDecoder::words_of_gradients(&field.decoder, quads, rays * max_samples);
        let samples = max_samples * (VmSamples::WORDS + CompositedRays::WORDS);
        [4 * (grids + gradients) as u64, 4 * (samples + CompositedRays::OF_RAY) as u64]
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
            composited: CompositedRays::new(device, field, rays, capacity, learns),
        }
    }

    /// Renders all rays whose samples fit into the buffers: planes `[5, rays]`, see
    /// [`crate::cpu::vm::RAY_WIDTH`].
    pub fn render(&self, device: &Device, values: VmValues, rays: &DeviceBatch) -> &Buffer {
        let (samples, composited) = (&self.samples, &self.composited);
        self.decoder.prepare(device, values.network);
        samples.march(device, &self.lattice, rays);
        self.density.gather(device, values.density, &samples.place, &samples.count, &composited.feature);
        composited.compute_weights(device, samples);
        self.decoder.forward(device, &self.color, values.color, rays, samples, composited);
        composited.composite(device, samples);
        &composited.out
    }

    /// Returns the composited values of the last render, planes `[5, rays]`.
    pub fn output(&self) -> &Buffer {
        &self.composited.out
    }

    /// Adds the gradients of planes and lines to those of `gradients`, and writes those of the
    /// decoder's weights: of the rays of the last render, by what was composited, planes
    /// `[5, rays]`. Where one of the latter is not finite, `non_finite`, `[1]`, becomes 1.
    pub fn backward(
        &self,
        device: &Device,
        values: VmValues,
        rays: &DeviceBatch,
        g_out: &Buffer,
        gradients: VmValues,
        non_finite: &Buffer,
    ) {
        let (samples, composited) = (&self.samples, &self.composited);
        composited.backward(device, samples, g_out);
        let (place, count) = (&samples.place, &samples.count);
        let g = &composited.g_feature;
        self.density.scatter(device, gradients.density, values.density, place, None, count, g);
        self.decoder.backward(
            device,
            &self.color,
            values.color,
            rays,
            samples,
            composited,
            values.network,
            gradients.color,
            gradients.network,
            non_finite,
        );
    }

    /// Returns the number of samples that were looked up and that would have been with larger
    /// buffers, the same of decoded ones, `[2]` each; and the lattice points of each ray, `[rays]`.
    pub fn counts(&self) -> [&Buffer; 3] {
        [&self.samples.count, &self.composited.count, &self.samples.points]
    }
}

/// Maximum number of rays of a pass; fewer in tests, which drivers in software run.
const PASS: usize = if cfg!(test) { 1 << 11 } else { 1 << 15 };

/// A trained field on a device.
pub struct VmRenderer {
    device: Arc<Device>,
    vm: Vm,
    values: [Buffer; 3],
    /// Number of rays of a pass; halved whenever their samples do not fit into the buffers.
    pass: usize,
}

impl VmRenderer {
    /// Uploads flat planes and lines of density and appearance, and flat decoder weights. The
    /// decoder must be one that [`DeviceDecoder::supports`].
    pub fn new(device: Arc<Device>, field: &VmField, [density, color, network]: [&[f32]; 3]) -> VmRenderer {
        let vm = Vm::new(&device, field, PASS, false);
        let values =
            [vm.density.upload(&device, density), vm.color.upload(&device, color), device.upload(network)];
        VmRenderer { device, vm, values, pass: PASS }
    }

    /// Renders rays, `[rays]`: see [`RAY_WIDTH`].
    pub fn render(&mut self, rays: &[Ray]) -> Result<Vec<[f32; RAY_WIDTH]>> {
        let (device, [density, color, network]) = (&self.device, &self.values);
        let values = VmValues { density, color, network };
        let mut seen = Vec::with_capacity(rays.len());
        while seen.len() < rays.len() {
            let own = &rays[seen.len()..rays.len().min(seen.len() + self.pass)];
            let out = self.vm.render(device, values, &DeviceBatch::upload(device, own, &[], PASS));
            let out = device.fetch::<f32>(out)?;
            let [count, ..] = self.vm.counts();
            let found = device.fetch::<u32>(count)?;
            // samples did not fit: render again, in smaller passes
            if found[0] < found[1] && own.len() > 1 {
                self.pass = own.len() / 2;
                continue;
            }
            seen.extend(
                (0..own.len()).map(|r| -> [f32; RAY_WIDTH] { std::array::from_fn(|k| out[k * PASS + r]) }),
            );
        }
        Ok(seen)
    }
}

#[cfg(test)]
mod case_tests;
#[cfg(test)]
mod tests;

#[cfg(test)]
mod renderer_tests {
    use super::super::testing::{agree, device};
    use super::case_tests::{NARROW, case};
    use super::*;
    use crate::cpu::vm::{DecoderWeights, composited};

    #[test]
    fn rays_are_those_of_the_cpu_in_as_many_passes_as_there_is_room() {
        let Some(device) = device() else { return };
        let case = case(NARROW, 500);
        let weights = DecoderWeights::new(case.field.decoder, &case.network);
        let want = composited(&case.field, &case.density, &case.color, &weights, &case.rays);
        let values = [case.density.as_slice(), &case.color, &case.network];
        let mut renderer = VmRenderer::new(Arc::new(device), &case.field, values);
        agree("rendered", renderer.render(&case.rays).unwrap().as_flattened(), &want, 1e-4);
        assert_eq!(renderer.pass, PASS);
        // room for a third of the samples
        renderer.vm = Vm::with_max_samples(&renderer.device, &case.field, PASS, 1600, false);
        agree("rendered in passes", renderer.render(&case.rays).unwrap().as_flattened(), &want, 1e-4);
        assert_eq!(renderer.pass, 125);
    }
}
