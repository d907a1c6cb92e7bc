//! Self-tests that compare a training step of a signed distance, and of a density, on a GPU with
//! the CPU's.

use super::cpu::CpuSdf;
use super::density;
use super::gpu::GpuSdf;
use super::model::{initial, shape};
use super::occupancy::Occupancy;
use super::ops::SdfOps;
use super::schedule;
use super::state::SdfState;
use super::stereo::SurfacePoint;
use super::train::{SdfModel, sampler};
use crate::config::Preset;
use crate::config::iface::{IfaceConfig, OccupancyRule};
use crate::field::Check;
use crate::field::ball::{self, BALL};
use crate::field::parameters::HostGroup;
use crate::field::self_test::{
    CELLS_AT, SEED, TestedModel, compare, compare_cells, compare_values, devices, run_step, session,
};
use crate::field::training::StepAt;
use tiface_base::Result;
use tiface_base::math::rng;
use tiface_kernels::cpu::sdf as on_host;
use tiface_kernels::gpu::{Adapter, planes};

impl<O: SdfOps> TestedModel for SdfModel<'_, O> {
    fn host_groups(&self) -> Result<Vec<HostGroup>> {
        Ok(self.state()?.groups.into())
    }
}

/// Returns settings for about 20,000 samples, so that each workgroup has several tiles.
pub(super) fn config(preset: Preset) -> IfaceConfig {
    IfaceConfig {
        steps: 1000,
        rays: 1024,
        max_rays: 1024,
        samples: 8192,
        levels: 12,
        log2_table: 12,
        growth: 1.3,
        occupancy_resolution: 24,
        samples_per_ray: 40,
        ..IfaceConfig::preset(preset)
    }
}

/// Returns so many random directions.
fn directions(stream: u64, count: u64) -> Vec<[f32; 3]> {
    let direction = |i| {
        let d: [f32; 3] = std::array::from_fn(|a| rng::normal(SEED, stream, 3 * i + a as u64));
        d.map(|c| c / d.iter().map(|c| c * c).sum::<f32>().sqrt())
    };
    (0..count).map(direction).collect()
}

/// Returns a field that varies in space, and points that its surface should pass through.
fn start(config: &IfaceConfig) -> SdfState {
    let mut state = SdfState::start(initial(config, SEED), config, None);
    state.groups[0].state[0].iter_mut().for_each(|v| *v *= 100.0);
    let point = |d: [f32; 3]| SurfacePoint { position: d.map(|c| c * BALL), footprint: 0.02, weight: 0.5 };
    state.stereo = directions(9, 100).into_iter().map(point).collect();
    state
}

/// Returns the cells that an update keeps for the initial field.
fn cells<O: SdfOps>(model: &mut SdfModel<O>) -> Result<Occupancy> {
    model.load(start(model.config));
    let at = StepAt { seed: SEED, step: CELLS_AT };
    model.ops.weights(&mut model.groups);
    model.ops.update_occupancy(&model.groups, schedule::active_levels(model.config, at.step), at);
    Ok(model.state()?.occupancy)
}

/// Compares the colors of points that are given their normals, as where a mesh is textured.
fn compare_colors(field: &str, on_gpu: &SdfModel<GpuSdf>) -> Result<Check> {
    let [points, seen, normals] = [10, 11, 12].map(|stream| directions(stream, 500));
    let got = on_gpu.ops.colors(&on_gpu.groups, &points, &seen, &normals)?;
    let state = start(on_gpu.config);
    let mut shape = shape(on_gpu.config);
    shape.active = schedule::active_levels(on_gpu.config, CELLS_AT);
    let (_, weights) = state.weights(&shape);
    let want = on_host::colors(&shape, state.table(), &weights, &points, &normals, None, &seen);
    Ok(compare_values(format!("{field}: colors"), &got, &planes(&want, points.len())))
}

/// Compares a step of the signed distance.
pub(super) fn sdf(adapter: &Adapter) -> Result<Vec<Check>> {
    compare_sdf(adapter, config(Preset::Draft))
}

fn compare_sdf(adapter: &Adapter, config: IfaceConfig) -> Result<Vec<Check>> {
    const FIELD: &str = "signed distance";
    let full = IfaceConfig { sparsity: 0.1, stereo: 0.1, ..config };
    let (views, session) = (ball::views(), session("iface"));
    let sampler = sampler(&views, None, &full)?;
    let mut checks = Vec::new();
    for (way, (device, part)) in [FIELD, "signed distance in fixed point"].into_iter().zip(devices(adapter)?)
    {
        let rays = full.rays / part;
        // the published rule for cells is that of the smaller step
        let occupancy = if part == 1 { full.occupancy } else { OccupancyRule::Nerfacc };
        let samples = full.samples / part;
        let config = IfaceConfig { occupancy, rays, max_rays: rays, samples, ..full.clone() };
        let mut on_cpu = SdfModel::new(CpuSdf::new(&config, &sampler), &sampler, None, &config, &session);
        let mut on_gpu =
            SdfModel::new(GpuSdf::new(&config, &sampler, device)?, &sampler, None, &config, &session);
        // Both keep the same cells up to rounding. The compared steps use the CPU's.
        let [want, got] = [cells(&mut on_cpu)?, cells(&mut on_gpu)?];
        checks.push(compare_cells(way, &got.occupied.bits, &want.occupied.bits));
        if part == 1 {
            checks.push(compare_colors(way, &on_gpu)?);
        }
        let start = || SdfState { occupancy: want.clone(), ..start(&config) };
        on_cpu.load(start());
        on_gpu.load(start());
        checks.extend(compare(way, &run_step(&mut on_gpu)?, &run_step(&mut on_cpu)?));
    }
    Ok(checks)
}

/// Compares a step of the density.
pub(super) fn density(adapter: &Adapter) -> Result<Vec<Check>> {
    density::self_test(adapter, &config(Preset::Paper))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A device passes the tests with this many times fewer samples, of fields with this many
    /// levels.
    fn passes(fewer: usize, [of_sdf, of_density]: [usize; 2]) {
        let Some(adapter) = Adapter::all().first() else { return };
        let of = |preset: Preset, levels: usize| {
            let full = config(preset);
            let rays = full.rays / fewer;
            IfaceConfig { rays, max_rays: rays, samples: full.samples / fewer, levels, ..full }
        };
        let began = std::time::Instant::now();
        for checks in [
            compare_sdf(adapter, of(Preset::Draft, of_sdf)).unwrap(),
            density::self_test(adapter, &of(Preset::Paper, of_density)).unwrap(),
        ] {
            println!("{:.1?}: {checks:#?}", began.elapsed());
            assert!(!checks.is_empty() && checks.iter().all(|check| check.passed));
        }
    }

    #[test]
    fn a_device_that_computes_right_passes_with_few_samples() {
        // as many levels as other tests have, for which the kernels are compiled anyway
        passes(4, [5, 4]);
    }

    #[test]
    #[ignore = "long: run by `tools/test.sh all`; as many samples and levels as `tiface doctor` has"]
    fn a_device_that_computes_right_passes() {
        passes(1, [config(Preset::Draft).levels; 2]);
    }
}
