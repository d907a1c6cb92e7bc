//! A trained field on a device, seen along any number of rays.

use super::super::device::{Buffer, Device};
use super::super::draw::Batch;
use super::{Vm, VmValues};
use crate::Result;
use crate::kernel::cpu::march::MarchRay;
use crate::kernel::cpu::vm::{RAY_WIDTH, VmField};
use std::sync::Arc;

/// Rays of a pass.
const PASS: usize = 1 << 15;

/// A trained field on a device.
pub struct VmRenderer {
    device: Arc<Device>,
    vm: Vm,
    values: [Buffer; 3],
    /// Number of rays of a pass; halved whenever their samples do not fit into the buffers.
    pass: usize,
}

impl VmRenderer {
    /// Uploads flat planes and lines of density and appearance, and flat decoder weights. The decoder must be one that
    /// [`DeviceDecoder::supports`](super::DeviceDecoder::supports).
    pub fn new(device: Arc<Device>, field: &VmField, [density, color, network]: [&[f32]; 3]) -> VmRenderer {
        let vm = Vm::new(&device, field, PASS, false);
        let values =
            [vm.density.upload(&device, density), vm.color.upload(&device, color), device.upload(network)];
        VmRenderer { device, vm, values, pass: PASS }
    }

    /// Renders rays, `[rays]`: see [`RAY_WIDTH`].
    pub fn render(&mut self, rays: &[MarchRay]) -> Result<Vec<[f32; RAY_WIDTH]>> {
        let (device, [density, color, network]) = (&self.device, &self.values);
        let values = VmValues { density, color, network };
        let mut seen = Vec::with_capacity(rays.len());
        while seen.len() < rays.len() {
            let own = &rays[seen.len()..rays.len().min(seen.len() + self.pass)];
            let out = self.vm.render(device, values, &Batch::of_rays(device, own, PASS));
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
mod tests {
    use super::super::super::device::tests::{agree, device};
    use super::super::case_tests::{NARROW, case};
    use super::*;
    use crate::kernel::cpu::vm::{DecoderWeights, render};

    #[test]
    fn rays_are_those_of_the_cpu_in_as_many_passes_as_there_is_room() {
        let Some(device) = device() else { return };
        let case = case(NARROW, 500);
        let weights = DecoderWeights::new(case.field.decoder, &case.network);
        let want = render(&case.field, &case.density, &case.color, &weights, &case.rays).out;
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
