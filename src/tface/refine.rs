//! Refinement between steps: rebuilding the alpha mask, shrinking the box, upsampling the grids.

use super::record::{NAMES, grids};
use super::state::VmState;
use crate::config::VmConfig;
use crate::field::parameters::HostGroup;
use rayon::prelude::*;
use tiface_base::geom::dilated_cells;
use tiface_kernels::cpu::vm::mask::BoxMask;
use tiface_kernels::cpu::vm::{cropped, density_at, resized, size_for, voxel_schedule};

/// Most vertices of an alpha mask; a finer grid keeps the mask's size (published).
const MASK_VERTICES: usize = 256 * 256 * 256;

/// Rebuilds the alpha mask after `step` steps and, the first time, shrinks the box to it. False if
/// nothing is left.
///
/// The published mask leaves the distance scale out of its alpha (`1 − exp(−σ · step)`), which
/// makes it that much stricter than rendering; kept, and `mask_threshold` is in these terms.
pub fn update_mask(state: &mut VmState, config: &VmConfig, step: u64) -> bool {
    let size = match &state.mask {
        Some(mask) if state.masked && state.size.iter().product::<usize>() >= MASK_VERTICES => {
            mask.size().map(|n| n - 1)
        }
        _ => state.size,
    };
    let [low, high] = state.bounds;
    let kept = occupied_vertices(state, config, size);
    let Some((first, last)) = extent(&kept, size) else { return false };
    state.mask = Some(BoxMask::from_vertices(low, high, size, &kept));
    if !state.masked {
        state.masked = true;
        shrink(state, config, size, [first, last], step);
    }
    true
}

/// Returns the vertices with enough alpha, and their neighbors, indexed by `(x · ny + y) · nz + z`.
fn occupied_vertices(state: &VmState, config: &VmConfig, size: [usize; 3]) -> Vec<bool> {
    let field = state.field(config, false);
    let density = state.groups[0].values();
    let [low, high] = state.bounds;
    let min_density =
        -(1.0 - config.mask_threshold as f32).ln() / (field.lattice.step / config.alpha_unit as f32);
    let slab = size[1] * size[2];
    let mut alive = vec![false; size[0] * slab];
    alive.par_chunks_mut(slab).enumerate().for_each(|(x, out)| {
        let at = |a: usize, i: usize| low[a] + (high[a] - low[a]) * i as f32 / (size[a] - 1) as f32;
        let mut points = Vec::with_capacity(slab);
        let mut index = Vec::with_capacity(slab);
        for i in 0..slab {
            let p = [at(0, x), at(1, i / size[2]), at(2, i % size[2])];
            // Cells that the previous mask excludes stay empty, so only the others are evaluated.
            if state.mask.as_ref().is_none_or(|m| m.contains(p)) {
                points.push(p);
                index.push(i);
            }
        }
        for (sigma, i) in density_at(&field, density, &points).into_iter().zip(index) {
            out[i] = sigma >= min_density;
        }
    });
    dilated_cells(&alive, size)
}

fn extent(kept: &[bool], size: [usize; 3]) -> Option<([usize; 3], [usize; 3])> {
    let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
    for (i, _) in kept.iter().enumerate().filter(|(_, k)| **k) {
        let c = [i / (size[1] * size[2]), i / size[2] % size[1], i % size[2]];
        for a in 0..3 {
            low[a] = low[a].min(c[a]);
            high[a] = high[a].max(c[a]);
        }
    }
    (low[0] != usize::MAX).then_some((low, high))
}

/// Crops the grids to the vertices `first..=last` of a mask of `size` vertices. The optimizer
/// starts again: its moments belong to planes of another size.
fn shrink(
    state: &mut VmState,
    config: &VmConfig,
    size: [usize; 3],
    [first, last]: [[usize; 3]; 2],
    step: u64,
) {
    let [low, high] = state.bounds;
    let (mut from, mut to) = ([0; 3], [0; 3]);
    for a in 0..3 {
        // a vertex of the mask in vertices of the grid, half to even as published
        let scaled = |i: usize| {
            (i as f64 * (state.size[a] - 1) as f64 / (size[a] - 1) as f64).round_ties_even() as usize
        };
        from[a] = scaled(first[a]).min(state.size[a] - 2);
        to[a] = (scaled(last[a]) + 1).clamp(from[a] + 2, state.size[a]);
    }
    if from == [0; 3] && to == state.size {
        return;
    }
    let unit: [f32; 3] = std::array::from_fn(|a| (high[a] - low[a]) / (state.size[a] - 1) as f32);
    let (density, color) = grids(config, state.size);
    let (kept, density) = cropped(&density, state.groups[0].values(), from, to);
    let (_, color) = cropped(&color, state.groups[1].values(), from, to);
    state.bounds = [
        std::array::from_fn(|a| low[a] + unit[a] * from[a] as f32),
        std::array::from_fn(|a| low[a] + unit[a] * (to[a] - 1) as f32),
    ];
    state.size = kept.size;
    replace(state, density, color, step);
}

/// Makes the grids finer: upsampling `which` (from 0), after `step` steps.
pub fn upsample(state: &mut VmState, config: &VmConfig, which: usize, step: u64) {
    let VmConfig { voxels_start, voxels_final, upsample_at, .. } = config;
    let voxels = voxel_schedule(*voxels_start, *voxels_final, upsample_at.len().max(1))[which];
    let extent = std::array::from_fn(|a| state.bounds[1][a] - state.bounds[0][a]);
    let size = size_for(extent, voxels);
    let (old_density, old_color) = grids(config, state.size);
    let (new_density, new_color) = grids(config, size);
    let density = resized(&old_density, state.groups[0].values(), &new_density);
    let color = resized(&old_color, state.groups[1].values(), &new_color);
    state.size = size;
    replace(state, density, color, step);
    state.reset = step;
}

fn replace(state: &mut VmState, density: Vec<f32>, color: Vec<f32>, step: u64) {
    let [of_density, of_color, network] = &mut state.groups;
    *of_density = HostGroup::flat(NAMES[0], density);
    *of_color = HostGroup::flat(NAMES[1], color);
    network.reset_moments();
    state.moments_from = step;
}
