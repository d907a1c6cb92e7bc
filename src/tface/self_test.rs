//! Self-test that compares a training step of the vector-matrix field on a GPU with the CPU's.

use super::cpu::CpuVm;
use super::gpu::GpuVm;
use super::ops::VmOps;
use super::state::VmState;
use super::train::VmModel;
use crate::config::{Preset, VmConfig};
use crate::field::Check;
use crate::field::ball;
use crate::field::parameters::HostGroup;
use crate::field::pixels::RaySampler;
use crate::field::self_test::{SEED, TestedModel, compare, devices, run_step, session};
use tiface_base::Result;
use tiface_kernels::gpu::Adapter;

// no plane of symmetry between the cameras lies on the border of a cell, where rounding decides
const BOUNDS: [[f32; 3]; 2] = [[-0.813, -0.797, -0.829], [0.787, 0.819, 0.803]];

impl<O: VmOps> TestedModel for VmModel<'_, O> {
    fn host_groups(&self) -> Result<Vec<HostGroup>> {
        Ok(self.ops.read(self.groups())?.into())
    }
}

/// Compares a step: some 20,000 samples get a color.
pub(super) fn vm(adapter: &Adapter) -> Result<Vec<Check>> {
    compare_vm(adapter, 2048)
}

fn compare_vm(adapter: &Adapter, rays: usize) -> Result<Vec<Check>> {
    const FIELD: &str = "vector-matrix";
    let full = VmConfig {
        steps: 1000,
        rays,
        voxels_start: 24 * 24 * 24,
        upsample_at: Vec::new(),
        mask_at: Vec::new(),
        ..VmConfig::preset(Preset::Draft)
    };
    let (views, hull, session) = (ball::views(), ball::hull(), session("tface"));
    // The first step has rays that the host drew; the smaller one draws on the device, in the
    // published order.
    let of_host = RaySampler::new(&views, 0.25, 1.0, full.foreground, full.whole_frame);
    let published = RaySampler::permuted(&views, full.foreground, BOUNDS, full.depth_directions);
    let state = VmState::new(&full, SEED, BOUNDS, Some(&hull));
    let mut checks = Vec::new();
    for (way, (device, part)) in [FIELD, "vector-matrix in fixed point"].into_iter().zip(devices(adapter)?) {
        let config = VmConfig { rays: full.rays / part, ..full.clone() };
        let sampler = if part == 1 { &of_host } else { &published };
        let mut on_cpu = VmModel::new(CpuVm::new(&config, sampler), state.clone(), &config, &session);
        on_cpu.load();
        let resident = GpuVm::fits("tface", &config, sampler, BOUNDS, &device)? && part > 1;
        let ops = GpuVm::new(&config, sampler, device, resident);
        let mut on_gpu = VmModel::new(ops, state.clone(), &config, &session);
        on_gpu.load();
        checks.extend(compare(way, &run_step(&mut on_gpu)?, &run_step(&mut on_cpu)?));
    }
    Ok(checks)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passes(rays: usize) {
        let Some(adapter) = Adapter::all().first() else { return };
        let began = std::time::Instant::now();
        let checks = compare_vm(adapter, rays).unwrap();
        println!("{:.1?}: {checks:#?}", began.elapsed());
        assert!(!checks.is_empty() && checks.iter().all(|check| check.passed));
    }

    #[test]
    fn a_device_that_computes_right_passes_with_few_rays() {
        passes(512);
    }

    #[test]
    #[ignore = "long: run by `tools/test.sh all`; as many rays as `tiface doctor` has"]
    fn a_device_that_computes_right_passes() {
        passes(2048);
    }
}
