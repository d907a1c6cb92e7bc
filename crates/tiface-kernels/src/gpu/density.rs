//! The density field of [`crate::cpu::density`], whose module holds the formulas: its networks
//! forward and backward, truncation of rays by transmittance, and compositing with the losses.

use super::batch::DeviceBatch;
use super::color::{ColorPlan, color_backward, color_forward, color_inputs, unit};
use super::device::{Buffer, Device, Words, groups, launch};
use super::hash::Grid;
use super::losses::{HIT, LAST, TALLY, sum, tally};
use super::march::{Samples, prefix_sum};
use super::sdf::kernels::{prepare, sum_groups};
use super::sdf::{maps, summing};
use super::tile::{
    Block, CHANNELS, LANES, Lane, UNITS, at, ends, lane_of, load_planes, outer_block, outer_row,
    output_layer, product, relu, relu_backward, store_block, store_outer, store_planes, store_row,
    uniform_count,
};
use super::weight_norm::finite;
use crate::cpu::density::{COLOR_INPUTS, DISTORTION, DensityShape, FEATURES, HIDDEN, MIN_TRANSMITTANCE};
use crate::cpu::losses::{RAY_TERMS, SAMPLE_TERMS, TERMS};
use crate::cpu::mlp::TILE;
use burn::cubecl::{self, prelude::*};

type F4 = Vector<f32, Const<4>>;

/// Number of planes of the field's output: density and color.
const WIDTH: usize = 4;

/// Offsets of the matrices in rows of 64 floats. Weights are stored in the orders in which they are
/// read, gradients row-major like on the CPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct DensityPlan {
    /// Number of hash features: two per level.
    features: usize,
    color: ColorPlan,
}

impl DensityPlan {
    fn new(shape: &DensityShape) -> DensityPlan {
        let features = 2 * shape.levels.len();
        let color = ColorPlan {
            outputs: FEATURES,
            signed: false,
            features: 0,
            inputs: COLOR_INPUTS,
            weights: features + HIDDEN + FEATURES,
            gradients: [HIDDEN + FEATURES, 3 * HIDDEN + FEATURES + 3],
            colors: 1,
        };
        DensityPlan { features, color }
    }

    /// Returns the first rows of W1ᵀ, W1, W2.
    fn rows(&self) -> [usize; 3] {
        ends([self.features, HIDDEN, FEATURES])
    }

    /// Returns the maps of the weights and of their gradients; see [`maps`].
    fn maps(&self, shape: &DensityShape) -> (Vec<u32>, Vec<u32>) {
        let ([w1t, w1, w2], c, g_c) = (self.rows(), self.color.rows(), self.color.gradient_rows());
        let places = [
            (Some(w1), Some(w1t), 0),
            (Some(w2), None, HIDDEN),
            (Some(c[1]), Some(c[0]), g_c[0]),
            (Some(c[3]), Some(c[2]), g_c[1]),
            (Some(c[4]), None, g_c[2]),
        ];
        maps(&shape.shapes(), &places, c[5], |_, i| i)
    }
}

/// Writes densities and, if `colors` is set, colors to planes `[4, capacity]`, and the activations
/// that the backward pass needs.
#[cube(launch_unchecked)]
fn forward(
    w: &[F4],
    value: &[F4],
    direction: &[F4],
    count: &[u32],
    h: &mut [F4],
    o: &mut [F4],
    c1: &mut [F4],
    c2: &mut [F4],
    out: &mut [F4],
    #[comptime] plan: DensityPlan,
    #[comptime] colors: bool,
) {
    let rows = comptime!(plan.rows());
    let plane = direction.len() / 3;
    let color = comptime!(plan.color);
    let tile = CUBE_POS;
    let lane = lane_of(tile, plane);
    let (row, column, here) = (lane.row, lane.column, lane.here);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    if tile * TILE < uniform_count(count, &mut a) {
        features(&mut a, value, &lane, comptime!(plan.features));
        sync_cube();
        let first =
            relu(&product(&a, 0usize, w, comptime!(rows[0]), comptime!(plan.features), row, column, LANES));
        store_block(&mut b, &first, row, column, LANES);
        sync_cube();
        let output = output_layer(&b, w, comptime!(rows[2]), row, column, FEATURES, LANES);
        if column == 0 {
            out[here] = (output - F4::new(1.0f32)).exp();
        }
        if colors {
            store_planes(h, &first, &lane, HIDDEN);
            o[column * plane + here] = output;
            // densities have no normal
            let none = F4::new(0.0f32);
            let normal = unit(none, none, none);
            color_inputs(&mut a, output, &normal, direction, value, &lane, color);
            sync_cube();
            color_forward(&mut a, &mut b, w, c1, c2, out, &lane, color);
        }
    }
}

/// Writes hash features to a tile, padded with zeros.
#[cube]
fn features(a: &mut [F4], value: &[F4], lane: &Lane, #[comptime] count: usize) {
    for j in 0..4usize {
        let c = lane.column + 16 * j;
        let mut v = F4::new(0.0f32);
        if c < count {
            v = value[c * lane.plane + lane.here];
        }
        a[at(c, lane.row, LANES)] = v;
    }
}

/// Backward pass of the geometry network. Writes the gradients with respect to the features of each
/// sample, and partial sums by group of those with respect to the weights.
#[cube(launch_unchecked)]
fn geometry_backward(
    w: &[F4],
    value: &[F4],
    count: &[u32],
    h: &[F4],
    g_o: &[F4],
    g_value: &mut [F4],
    partial: &mut [f32],
    #[comptime] plan: DensityPlan,
) {
    let rows = comptime!(plan.rows());
    let inputs = comptime!(plan.features);
    let plane = g_o.len() / FEATURES;
    let group = CUBE_POS;
    let sum = group * comptime!(plan.color.gradients[1] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = uniform_count(count, &mut a);
    // the thread's sums of the gradients of both matrices
    let mut w1_0 = F4::new(0.0f32);
    let mut w1_1 = F4::new(0.0f32);
    let mut w1_2 = F4::new(0.0f32);
    let mut w1_3 = F4::new(0.0f32);
    let mut w2 = F4::new(0.0f32);
    for tile in range_stepped(group, samples.div_ceil(TILE), CUBE_COUNT) {
        let lane = lane_of(tile, plane);
        let (row, column, here) = (lane.row, lane.column, lane.here);
        a[at(column, row, LANES)] = g_o[column * plane + here];
        load_planes(&mut b, h, &lane);
        sync_cube();
        w2 += outer_row(&a, row, &b, column, LANES);
        let g_h = product(&a, 0usize, w, comptime!(rows[2]), FEATURES, row, column, LANES);
        let g_h = relu_backward(&g_h, &b, row, column, LANES);
        sync_cube();
        store_block(&mut a, &g_h, row, column, LANES);
        features(&mut b, value, &lane, inputs);
        sync_cube();
        let of_w1 = outer_block(&a, &b, row, column);
        w1_0 += of_w1.channel(0usize);
        w1_1 += of_w1.channel(1usize);
        w1_2 += of_w1.channel(2usize);
        w1_3 += of_w1.channel(3usize);
        let g_u = product(&a, 0usize, w, comptime!(rows[1]), HIDDEN, row, column, LANES);
        store_planes(g_value, &g_u, &lane, inputs);
        sync_cube();
    }
    if group < samples.div_ceil(TILE) {
        let lane = lane_of(group, plane);
        let (row, column) = (lane.row, lane.column);
        let sums = Block::new(w1_0, w1_1, w1_2, w1_3);
        store_outer(partial, sum, &sums, inputs, row, column);
        store_row(partial, sum + (row + HIDDEN) * CHANNELS, w2, HIDDEN, column);
    }
}

/// Sets `non_finite` if a value of the gradient is not finite.
#[cube(launch)]
fn check(gradient: &[f32], non_finite: &mut [u32]) {
    let i = ABSOLUTE_POS;
    if i < gradient.len() && !finite(gradient[i]) {
        non_finite[0] = 1;
    }
}

/// Truncates rays by transmittance. A first pass counts the remaining samples of each ray; a second
/// pass, after a prefix sum of the counts, copies them.
#[cube(launch)]
fn cut(
    density: &[f32],
    offsets: &[u32],
    kept: &[u32],
    counts: &mut [u32],
    t: &[f32],
    x: &[f32],
    direction: &[f32],
    kept_t: &mut [f32],
    kept_x: &mut [f32],
    kept_direction: &mut [f32],
    dt: f32,
    #[comptime] writes: bool,
) {
    let r = ABSOLUTE_POS;
    let plane = t.len();
    if r < counts.len() {
        let first = offsets[r] as usize;
        if writes {
            let to = kept[r] as usize;
            for k in 0..counts[r] as usize {
                kept_t[to + k] = t[first + k];
                for axis in 0..3usize {
                    kept_x[axis * plane + to + k] = x[axis * plane + first + k];
                    kept_direction[axis * plane + to + k] = direction[axis * plane + first + k];
                }
            }
        } else {
            let end = offsets[r + 1] as usize;
            let mut thickness = 0.0f32;
            let mut s = first;
            while s < end && (-thickness).exp() >= MIN_TRANSMITTANCE {
                thickness += density[s] * dt;
                s += 1;
            }
            counts[r] = u32::cast_from(s - first);
        }
    }
}

/// Returns `1 − e⁻ˣ` for x ≥ 0.
#[cube]
fn opacity(x: f32) -> f32 {
    // the difference cancels for small x, so a series is used
    let series =
        x * (1.0f32 - x / 2.0f32 * (1.0f32 - x / 3.0f32 * (1.0f32 - x / 4.0f32 * (1.0f32 - x / 5.0f32))));
    select(x < 0.1f32, series, 1.0f32 - (-x).exp())
}

/// Composites rays. Writes their loss terms, planes `[3, rays]`, and the gradients with respect to
/// the field's output, planes `[4, capacity]`. `light` is scratch memory, planes `[2, capacity]`.
#[cube(launch)]
fn of_rays(
    field: &[f32],
    offsets: &[u32],
    t: &[f32],
    color: &[f32],
    tally: &[u32],
    light: &mut [f32],
    g_out: &mut [f32],
    terms: &mut [f32],
    dt: f32,
) {
    let rays = color.len() / 3;
    let plane = t.len();
    let r = ABSOLUTE_POS;
    if r < rays {
        let (first, end) = (offsets[r] as usize, offsets[r + 1] as usize);
        let hit_rays = f32::cast_from(max(tally[HIT], 1u32));
        let last = f32::cast_from(max(tally[LAST], 1u32));
        let mut thickness = 0.0f32;
        let mut red = 0.0f32;
        let mut green = 0.0f32;
        let mut blue = 0.0f32;
        let mut sum = 0.0f32;
        let mut moment = 0.0f32;
        let mut spread = 0.0f32;
        for s in first..end {
            let thickness_here = field[s] * dt;
            let w = (-thickness).exp() * opacity(thickness_here);
            thickness += thickness_here;
            red += w * field[plane + s];
            green += w * field[2 * plane + s];
            blue += w * field[3 * plane + s];
            let before = t[s] * sum - moment;
            spread += dt * w * w / 3.0f32 + 2.0f32 * w * before;
            sum += w;
            moment += w * t[s];
            light[s] = w;
            light[plane + s] = before;
        }
        let is_hit = select(end > first, 1.0f32, 0.0f32);
        let (e0, e1, e2) = (red - color[r], green - color[rays + r], blue - color[2 * rays + r]);
        let share = is_hit / (3.0f32 * hit_rays);
        terms[r] = (e0 * e0 + e1 * e1 + e2 * e2) * share;
        terms[rays + r] = (smooth(e0) + smooth(e1) + smooth(e2)) * share;
        terms[2 * rays + r] = spread / last;
        let g0 = clamp(e0, -1.0f32, 1.0f32) * share;
        let g1 = clamp(e1, -1.0f32, 1.0f32) * share;
        let g2 = clamp(e2, -1.0f32, 1.0f32) * share;
        let mut farther = 0.0f32;
        let mut farther_moment = 0.0f32;
        let mut farther_sum = 0.0f32;
        for k in 0..end - first {
            let s = end - 1 - k;
            let w = light[s];
            let g_spread = 2.0f32 / 3.0f32 * dt * w
                + 2.0f32 * light[plane + s]
                + 2.0f32 * (farther_moment - t[s] * farther);
            farther += w;
            farther_moment += w * t[s];
            let g_color = g0 * field[plane + s] + g1 * field[2 * plane + s] + g2 * field[3 * plane + s];
            let g = DISTORTION / last * g_spread + g_color;
            g_out[s] = dt * ((-thickness).exp() * g - farther_sum);
            thickness -= field[s] * dt;
            farther_sum += w * g;
            g_out[plane + s] = g0 * w;
            g_out[2 * plane + s] = g1 * w;
            g_out[3 * plane + s] = g2 * w;
        }
    }
}

/// Returns the smooth-L1 loss of an error.
#[cube]
fn smooth(e: f32) -> f32 {
    select(e.abs() < 1.0f32, 0.5f32 * e * e, e.abs() - 0.5f32)
}

/// A density field on a device, with the buffers of a training step for up to `rays` rays and
/// `capacity` samples.
pub struct Density {
    plan: DensityPlan,
    grid: Grid,
    dt: f32,
    capacity: usize,
    /// Number of groups that sum gradients of weights.
    summing: usize,
    prepared_map: Buffer,
    summed_map: Buffer,
    weights: Buffer,
    value: Buffer,
    h: Buffer,
    o: Buffer,
    c1: Buffer,
    c2: Buffer,
    out: Buffer,
    light: Buffer,
    g_out: Buffer,
    g_o: Buffer,
    g_value: Buffer,
    partial: Buffer,
    tally: Buffer,
    ray_terms: Buffer,
    no_terms: Buffer,
    sums: Buffer,
}

impl Density {
    /// Creates a field that is marched in steps of `dt`; `capacity` must be a multiple of [`TILE`].
    pub fn new(device: &Device, shape: &DensityShape, dt: f32, rays: usize, capacity: usize) -> Density {
        assert!(capacity.is_multiple_of(TILE) && capacity > 0 && Density::supports(shape));
        let plan = DensityPlan::new(shape);
        let (prepared, summed) = plan.maps(shape);
        let planes = |count: usize| device.scratch::<f32>(count * capacity);
        Density {
            plan,
            grid: Grid::new(device, &shape.levels, shape.levels.len(), shape.radius),
            dt,
            capacity,
            summing: summing(capacity),
            weights: device.scratch::<f32>(prepared.len()),
            prepared_map: device.upload(&prepared),
            summed_map: device.upload(&summed),
            value: planes(plan.features),
            h: planes(HIDDEN),
            o: planes(FEATURES),
            c1: planes(HIDDEN),
            c2: planes(HIDDEN),
            out: planes(WIDTH),
            light: planes(2),
            g_out: planes(WIDTH),
            g_o: planes(FEATURES),
            g_value: planes(plan.features),
            partial: device.scratch::<f32>(summing(capacity) * plan.color.gradients[1] * CHANNELS),
            tally: device.scratch::<u32>(TALLY),
            ray_terms: device.scratch::<f32>(RAY_TERMS * rays),
            no_terms: device.zeros::<f32>(SAMPLE_TERMS),
            sums: device.zeros::<f32>(TERMS + 2),
        }
    }

    /// Returns whether a tile can hold the features of all levels.
    pub fn supports(shape: &DensityShape) -> bool {
        2 * shape.levels.len() <= CHANNELS
    }

    /// Returns the memory per sample in words, including its marched samples before and after
    /// truncation: the total, and that of the largest buffer.
    pub fn words_per_sample(shape: &DensityShape) -> [usize; 2] {
        let features = 2 * shape.levels.len();
        [2 * features + 3 * HIDDEN + 2 * FEATURES + 2 * WIDTH + 2 + 2 * (3 + 3 + 2), HIDDEN.max(features)]
    }

    /// Returns the memory of the groups' partial gradient sums in words, for up to `capacity`
    /// samples.
    pub fn words_of_sums(shape: &DensityShape, capacity: usize) -> usize {
        summing(capacity) * DensityPlan::new(shape).color.gradients[1] * CHANNELS
    }

    /// Converts new network weights to the layout of the kernels.
    pub fn prepare(&self, device: &Device, flat: &Buffer) {
        launch!(device, prepare::launch, groups(self.weights.word_count().div_ceil(UNITS as usize)), UNITS;
            flat, self.prepared_map, self.weights
        );
    }

    /// Evaluates densities of samples and, if directions are given, colors: see
    /// [`crate::cpu::density::evaluate`].
    ///
    /// # Shapes
    ///
    /// - table: `[entries, 2]`; x, direction: planes `[3, capacity]`, finite after the last sample;
    ///   count: `[1]`, the number of samples
    /// - output: planes `[4, capacity]`
    pub fn evaluate(
        &self,
        device: &Device,
        table: &Buffer,
        x: &Buffer,
        direction: Option<&Buffer>,
        count: &Buffer,
    ) -> &Buffer {
        assert!(
            x.word_count() == 3 * self.capacity && direction.is_none_or(|d| d.word_count() == x.word_count())
        );
        self.grid.gather(device, table, x, count, &self.value, None);
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            launch!(device, forward::launch_unchecked, groups(self.capacity / TILE), UNITS;
                self.weights, self.value, direction.unwrap_or(x), count, self.h, self.o, self.c1, self.c2,
                self.out;
                self.plan, direction.is_some()
            );
        }
        &self.out
    }

    /// Truncates each ray where its transmittance falls below [`MIN_TRANSMITTANCE`], by the
    /// densities of the last evaluation, and copies the remaining samples to `kept`.
    pub fn cut(&self, device: &Device, samples: &Samples, kept: &Samples) {
        let pass = |writes: bool| {
            launch!(device, cut::launch, groups(kept.counts.word_count().div_ceil(UNITS as usize)), UNITS;
                self.out, samples.offsets, kept.offsets, kept.counts, samples.t, samples.x, samples.direction,
                kept.t, kept.x, kept.direction;
                self.dt, writes
            );
        };
        pass(false);
        prefix_sum(device, &kept.counts, &kept.offsets, &kept.count, self.capacity);
        pass(true);
    }

    /// Composites the samples of the last evaluation, and keeps the gradients of their losses for
    /// [`backward`](Density::backward).
    pub fn losses(&self, device: &Device, samples: &Samples, batch: &DeviceBatch) {
        let offsets = &samples.offsets;
        let one = CubeCount::new_single();
        launch!(device, tally::launch, one, UNITS; offsets, batch.alpha, batch.alive, self.tally; true);
        launch!(device, of_rays::launch, groups(batch.rays().div_ceil(UNITS as usize)), UNITS;
            self.out, offsets, samples.t, batch.color, self.tally, self.light, self.g_out, self.ray_terms;
            self.dt
        );
        let none = &self.no_terms;
        launch!(device, sum::launch, CubeCount::new_1d(TERMS as u32), UNITS;
            self.ray_terms, none, none, none, samples.count, self.sums
        );
    }

    /// Adds the gradient with respect to the table, which must be zero before, writes that with
    /// respect to the weights, and sets `non_finite` if the latter is not finite.
    pub fn backward(
        &self,
        device: &Device,
        samples: &Samples,
        [g_table, g_flat]: [&Buffer; 2],
        non_finite: &Buffer,
    ) {
        let count = &samples.count;
        let (weights, partial, direction) = (&self.weights, &self.partial, &samples.direction);
        let summing = self.summing;
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            launch!(device, color_backward::launch_unchecked, groups(summing), UNITS;
                weights, self.value, direction, count, self.o, self.c1, self.c2, self.out, self.g_out, self.g_o,
                self.g_o, self.g_value, partial;
                0.0, self.plan.color
            );
            launch!(device, geometry_backward::launch_unchecked, groups(summing), UNITS;
                weights, self.value, count, self.h, self.g_o, self.g_value, partial; self.plan
            );
        }
        let size = self.plan.color.gradients[1] * CHANNELS;
        sum_groups(device, partial, Some(&self.summed_map), count, g_flat, (size, TILE, summing));
        launch!(device, check::launch, groups(g_flat.word_count().div_ceil(UNITS as usize)), UNITS;
            g_flat, non_finite
        );
        self.grid.scatter(device, g_table, &samples.x, count, &self.g_value, None);
    }

    /// Returns squared error, smooth-L1 loss and distortion of the last step, followed by the sums
    /// over steps as in [`Losses::sums`](super::Losses::sums).
    pub fn sums(&self) -> &Buffer {
        &self.sums
    }

    /// Resets the squared errors that are summed over steps.
    pub fn reset_sums(&mut self, device: &Device) {
        self.sums = device.zeros::<f32>(TERMS + 2);
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{agree, device, planes};
    use super::*;
    use crate::cpu::hash;
    use tiface_base::math::rng;

    #[test]
    fn gradients_of_a_density_are_the_same_where_groups_sum_over_several_tiles() {
        const SAMPLES: usize = 1000;
        const CAPACITY: usize = 1024;
        let Some(device) = device() else { return };
        let shape = DensityShape { levels: hash::levels(4, 4, 1.4, 10), radius: 1.0 };
        let normals = |stream: u64, count: usize, scale: f32| -> Vec<f32> {
            (0..count).map(|i| scale * rng::normal(7, stream, i as u64)).collect()
        };
        let floats = shape.shapes().iter().map(|(outputs, inputs)| outputs * inputs).sum();
        let entries = hash::entries(&shape.levels);
        let table = device.upload(&normals(1, 2 * entries, 0.3));
        let rows: Vec<[f32; 3]> = normals(2, 3 * SAMPLES, 0.2).as_chunks().0.to_vec();
        let mut samples = Samples::new(&device, 1, CAPACITY);
        samples.x = device.upload(&planes(&rows, CAPACITY));
        samples.direction = device.upload(&planes(&rows, CAPACITY));
        samples.count = device.upload(&[SAMPLES as u32]);
        let mut on = Density::new(&device, &shape, 0.1, 1, CAPACITY);
        on.prepare(&device, &device.upload(&normals(3, floats, 0.12)));
        on.evaluate(&device, &table, &samples.x, Some(&samples.direction), &samples.count);
        on.g_out = device.upload(&normals(4, WIDTH * CAPACITY, 1.0));
        let [each, several] = [CAPACITY / TILE, 3].map(|summing| {
            on.summing = summing;
            let (g_table, g_flat) = (device.zeros::<f32>(2 * entries), device.zeros::<f32>(floats));
            on.backward(&device, &samples, [&g_table, &g_flat], &device.zeros::<u32>(1));
            device.read::<f32>(&g_flat)
        });
        assert!(each.iter().any(|&v| v != 0.0));
        agree("weights of a density", &several, &each, 1e-4);
    }
}
