//! Initialization of the signed distance from the visual hull.
//!
//! The hull is known before training and lies within millimeters of most of the head. Fitting the
//! field to its distance for a few hundred cheap steps replaces the thousands that carve a sphere,
//! and gives the occupancy grid a band from the first training step.

use super::model::shape;
use super::schedule;
use super::state::SdfState;
use crate::config::iface::IfaceConfig;
use crate::field::parameters::ParameterPart;
use crate::field::training::{StepError, TrainingSession};
use rayon::prelude::*;
use tiface_base::Error;
use tiface_base::geom::BitGrid;
use tiface_base::math::distance::LowerEnvelope;
use tiface_base::math::rng;
use tiface_kernels::cpu::adam::adam;
use tiface_kernels::cpu::hash;
use tiface_kernels::cpu::losses::{self, LossWeights};
use tiface_kernels::cpu::sdf::{self, FieldShape, WIDTH};
use tiface_kernels::cpu::weight_norm;

/// Signed distance to a hull's boundary at cell centers, in units of the box's half edge; negative
/// inside.
pub struct HullDistance {
    resolution: usize,
    values: Vec<f32>,
}

/// Returns the distance in cells from each cell's center to the nearest center of a cell in
/// `seeds`.
fn distance(resolution: usize, seeds: impl Fn(usize) -> bool + Sync) -> Vec<f32> {
    let r = resolution;
    /// Larger than any squared distance on the grid, small enough to stay exact in f32.
    const FAR: f32 = 1e6;
    let mut d: Vec<f32> = (0..r * r * r).map(|i| if seeds(i) { 0.0 } else { FAR }).collect();
    // z lines are contiguous; y and x lines within and across slabs of constant x
    d.par_chunks_mut(r * r).for_each(|slab| {
        let (mut envelope, mut line) = (LowerEnvelope::new(r), vec![0f32; r]);
        slab.chunks_mut(r).for_each(|row| envelope.transform(row));
        for c in 0..r {
            (0..r).for_each(|y| line[y] = slab[y * r + c]);
            envelope.transform(&mut line);
            (0..r).for_each(|y| slab[y * r + c] = line[y]);
        }
    });
    let along_x = |c: usize| {
        let mut line: Vec<f32> = (0..r).map(|x| d[x * r * r + c]).collect();
        LowerEnvelope::new(r).transform(&mut line);
        line
    };
    let columns: Vec<Vec<f32>> = (0..r * r).into_par_iter().map(along_x).collect();
    for (c, column) in columns.iter().enumerate() {
        (0..r).for_each(|x| d[x * r * r + c] = column[x].sqrt());
    }
    d
}

impl HullDistance {
    /// Computes the distance from a hull; everything beyond the box counts as outside.
    pub fn new(hull: &BitGrid) -> HullDistance {
        let r = hull.resolution;
        let border = |i: usize| [i / (r * r), i / r % r, i % r].iter().any(|&c| c == 0 || c == r - 1);
        let inside = |i: usize| hull.get(i) && !border(i);
        let to_inside = distance(r, inside);
        let to_outside = distance(r, |i| !inside(i));
        let cell = 2.0 / r as f32;
        // The boundary runs half a cell before the nearest center of the other kind.
        let value = |i: usize| match inside(i) {
            true => -(to_outside[i] - 0.5).max(0.0) * cell,
            false => (to_inside[i] - 0.5).max(0.0) * cell,
        };
        HullDistance { resolution: r, values: (0..r * r * r).map(value).collect() }
    }

    /// Interpolates the distance at a point of [-1, 1]³ trilinearly.
    pub fn at(&self, p: [f32; 3]) -> f32 {
        let r = self.resolution;
        let mut low = [0usize; 3];
        let mut f = [0f32; 3];
        for a in 0..3 {
            let g = ((p[a] + 1.0) * 0.5 * r as f32 - 0.5).clamp(0.0, (r - 1) as f32);
            low[a] = (g as usize).min(r - 2);
            f[a] = g - low[a] as f32;
        }
        let mut sum = 0.0;
        for k in 0..8 {
            let bit = |a: usize| k >> a & 1;
            let w: f32 = (0..3).map(|a| if bit(a) == 1 { f[a] } else { 1.0 - f[a] }).product();
            sum += w * self.values[((low[0] + bit(0)) * r + low[1] + bit(1)) * r + low[2] + bit(2)];
        }
        sum
    }
}

/// Returns `count` points for a step of the fit and the distances there, both times the field's
/// `radius`. Every second point lies anywhere in the box, the others near the hull's boundary.
fn fit_points(
    distance: &HullDistance,
    seed: u64,
    step: u64,
    count: usize,
    radius: f32,
) -> (Vec<[f32; 3]>, Vec<f32>) {
    let candidate = |k: usize| {
        let u = |a: u64| 2.0 * rng::uniform(seed, 201 + (step << 10), 4 * k as u64 + a) - 1.0;
        let p = [u(0), u(1), u(2)];
        let f = distance.at(p);
        (k.is_multiple_of(2) || f.abs() <= 0.1).then(|| (p.map(|c| c * radius), f * radius))
    };
    let (mut x, mut target) = (Vec::with_capacity(count), Vec::with_capacity(count));
    let mut drawn = 0;
    while target.len() < count {
        let found: Vec<_> = (drawn..drawn + count).into_par_iter().with_min_len(512).map(candidate).collect();
        drawn += count;
        for (p, f) in found.into_iter().flatten().take(count - target.len()) {
            x.push(p);
            target.push(f);
        }
    }
    (x, target)
}

/// Fits the geometry of the field to the hull's distance, on the CPU. Half of the points lie in a
/// band around the hull's boundary.
pub fn fit_hull(
    state: &mut SdfState,
    hull: &BitGrid,
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(), StepError> {
    /// Enough for errors well below a cell of the hull with the coarse levels.
    const STEPS: u64 = 250;
    const POINTS: usize = 8192;
    /// Weights of distance and eikonal.
    const DISTANCE: f32 = 10.0;
    let eikonal = LossWeights { eikonal: 0.1, ..LossWeights::default() };
    let distance = HullDistance::new(hull);
    let shape = FieldShape { active: schedule::active_levels(config, 0), ..shape(config) };
    let layout = shape.layout();
    // The color network's parameters follow the geometry's in the group, and are not fitted.
    let colors = |part: &&ParameterPart| part.name.starts_with('c');
    let [table, network, _] = &state.groups;
    let colored: usize = network.parts.iter().filter(colors).map(|part| part.count()).sum();
    let geometry = network.values().len() - colored;
    let mut g_table = vec![0f32; table.values().len()];
    let mut g_network = vec![0f32; network.values().len()];
    for step in 0..STEPS {
        let (x, target) = fit_points(&distance, session.seed, step, POINTS, config.radius);
        let (_, weights) = state.weights(&shape);
        let field = sdf::geometry(&shape, state.table(), &weights, &x);
        let mut g_field = vec![0f32; field.output().len()];
        losses::of_samples(field.output(), &eikonal, &mut g_field);
        let rows = field.output().chunks_exact(WIDTH).zip(g_field.chunks_exact_mut(WIDTH));
        for ((out, g), target) in rows.zip(target) {
            let error = out[0] - target;
            g[0] += DISTANCE / POINTS as f32 * if error == 0.0 { 0.0 } else { error.signum() };
        }
        let g_flat = sdf::backward(&field, &weights, &g_field, bytemuck::cast_slice_mut(&mut g_table));
        weight_norm::backward(layout, state.groups[1].values(), &g_flat, &mut g_network);
        let factor = 0.1f64.powf(step as f64 / STEPS as f64) * ((step + 1) as f64 / 20.0).min(1.0);
        if !g_network.iter().all(|g| g.is_finite()) {
            let lr = config.lr_network * factor;
            let problem = format!(
                "a gradient of the fit to the visual hull is NaN or infinite at step {step} (learning rate {lr:.2e})"
            );
            let hint = "lower iface.lr_network and iface.lr_table, or start again with another --seed";
            return Err(StepError::Failed(Error::cannot(problem, hint)));
        }
        let steps = schedule::adam_steps(config, factor, step + 1);
        let counts = [2 * hash::entries(&shape.levels[..shape.active]), geometry];
        for (((group, g), count), step) in
            state.groups.iter_mut().zip([&mut g_table, &mut g_network]).zip(counts).zip(&steps)
        {
            let [p, m, v] = group.state.each_mut().map(|values| &mut values[..count]);
            adam(p, m, v, &mut g[..count], step);
        }
        if session.monitor.stop() {
            let kept = "before the first step: the fit to the hull starts again";
            return Err(StepError::Failed(Error::stopped(kept)));
        }
    }
    // training starts with its own moments
    state.groups.iter_mut().for_each(|group| group.reset_moments());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_to_a_ball_of_cells_is_that_of_the_ball() {
        let r = 48;
        let mut hull = BitGrid::filled(r, false);
        let center =
            |i: usize| [i / (r * r), i / r % r, i % r].map(|c| (c as f32 + 0.5) / (0.5 * r as f32) - 1.0);
        let norm = |p: [f32; 3]| (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
        (0..r * r * r).for_each(|i| hull.set(i, norm(center(i)) < 0.6));
        let d = HullDistance::new(&hull);
        let cell = 2.0 / r as f32;
        // (not at the very center, where the eight neighbors all lie nearer to the boundary)
        for p in [[0.2, 0.1, 0.0], [0.3, -0.2, 0.4], [0.0, 0.61, 0.0], [0.7, 0.7, 0.0], [-0.9, 0.1, 0.1]] {
            assert!((d.at(p) - (norm(p) - 0.6)).abs() < cell, "{p:?}: {} {}", d.at(p), norm(p) - 0.6);
        }
    }
}
