//! The signed-distance field of [`crate::cpu::sdf`], whose module holds the formulas: the forward
//! pass with normals, and the backward pass with its second-order path.
//!
//! A group of 256 threads evaluates all layers for 64 samples. Activations are kept in workgroup
//! memory, channel by channel; a thread holds four samples of four channels. Weights, 90 kB, are
//! read from global memory: all groups read the same ones, so they stay in the nearest cache, and
//! workgroup memory is free for two tiles of activations (32 KiB). Gradients of weights are summed
//! by group, in registers, then over the groups in a fixed order. The backward pass is two kernels,
//! one per network, because a software driver takes ten times as long to compile a single one.

pub(super) mod kernels;

use super::color::{ColorPlan, color_backward};
use super::device::{Buffer, Device, Words, groups, launch};
use super::hash::Grid;
use super::tile::{CHANNELS, UNITS, ends};
use crate::cpu::mlp::{HIDDEN, Layout, OUTPUTS, TILE};
use crate::cpu::sdf::{FieldShape, WIDTH};
use kernels::{forward, geometry_backward, prepare, sum_groups};

/// Maximum number of groups that sum gradients of weights, each over its own tiles. wgpu states no
/// number of multiprocessors; the largest cards run about a thousand groups of 256 threads with 32
/// KiB of workgroup memory at once. More groups than tiles are never launched.
const SUMMING: usize = 1024;

/// Returns the number of groups that sum gradients of up to `capacity` samples.
pub(super) fn summing(capacity: usize) -> usize {
    SUMMING.min(capacity / TILE)
}

/// Offsets of the matrices of a field, in rows of 64 floats. Weights are stored in the orders in
/// which they are read, gradients row-major like on the CPU. Geometry columns are `[hash, x]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct SdfPlan {
    /// Number of hash features: two per level.
    features: usize,
    /// Number of inputs of the geometry network, padded.
    padded: usize,
    /// The color network, which may read the hash features as well.
    color: ColorPlan,
}

impl SdfPlan {
    /// Returns whether a tile can hold the inputs of each network.
    fn fits(layout: Layout) -> bool {
        layout.padded() + OUTPUTS <= CHANNELS && layout.color_padded() <= CHANNELS
    }

    fn new(layout: Layout) -> SdfPlan {
        assert!(SdfPlan::fits(layout), "the field has more levels than a tile can hold");
        let (features, padded) = (layout.inputs - 3, layout.padded());
        let color = ColorPlan {
            outputs: OUTPUTS,
            signed: true,
            features: if layout.color_skip { features } else { 0 },
            inputs: layout.color_padded(),
            weights: 0,
            gradients: [0; 2],
            colors: 4,
        };
        let mut plan = SdfPlan { features, padded, color };
        plan.color.weights = plan.rows()[5];
        plan.color.gradients[0] = plan.gradients()[4];
        plan.color.gradients[1] = plan.color.gradient_rows()[3];
        plan
    }

    /// Returns the first rows of W1ᵀ, W1, b1, W2, b2 (each value four times), and the end.
    fn rows(&self) -> [usize; 6] {
        ends([self.padded, HIDDEN, 1, OUTPUTS, 1])
    }

    /// Returns the first rows of the gradients of W1, b1, W2, b2, and the end.
    fn gradients(&self) -> [usize; 5] {
        ends([HIDDEN, 1, OUTPUTS, 1])
    }

    /// Returns the maps of the weights and of their gradients; see [`maps`].
    fn maps(&self, layout: Layout) -> (Vec<u32>, Vec<u32>) {
        let ([w1t, w1, b1, w2, b2, _], [g_w1, g_b1, g_w2, g_b2, _]) = (self.rows(), self.gradients());
        let (c, g_c) = (self.color.rows(), self.color.gradient_rows());
        let places = [
            (Some(w1), Some(w1t), g_w1),
            (None, Some(b1), g_b1),
            (Some(w2), None, g_w2),
            (None, None, g_b2),
            (Some(c[1]), Some(c[0]), g_c[0]),
            (Some(c[3]), Some(c[2]), g_c[1]),
            (Some(c[4]), None, g_c[2]),
        ];
        // the kernels read [hash, x], but the flat weights are ordered [x, hash]
        let column = |part: usize, i: usize| match part {
            0 => (i + layout.inputs - 3) % layout.inputs,
            _ => i,
        };
        let shapes = layout.shapes();
        let (mut prepared, summed) = maps(&shapes, &places, c[5], column);
        let first: usize = shapes[..3].iter().map(|(outputs, inputs)| outputs * inputs).sum();
        (0..4 * OUTPUTS).for_each(|i| prepared[b2 * CHANNELS + i] = (first + i / 4) as u32);
        (prepared, summed)
    }
}

/// Returns two index maps: for each float of the prepared weights, `rows` of 64, its index in the
/// flat vector, or `u32::MAX` for padding; and for each float of the flat vector its index in the
/// gradients.
///
/// The flat vector has matrices of these `shapes`, `(outputs, inputs)`; one with a single input is
/// a bias, which is one row elsewhere. `places` are the first rows of a matrix as it is, of its
/// transpose, and of its gradient. `column` returns the column of an input of a matrix.
pub(super) fn maps(
    shapes: &[(usize, usize)],
    places: &[(Option<usize>, Option<usize>, usize)],
    rows: usize,
    column: impl Fn(usize, usize) -> usize,
) -> (Vec<u32>, Vec<u32>) {
    let (mut prepared, mut summed) = (vec![u32::MAX; rows * CHANNELS], Vec::new());
    let float = |first: usize, row: usize, column: usize| (first + row) * CHANNELS + column;
    for (part, (&(outputs, inputs), &(original, transposed, gradient))) in
        shapes.iter().zip(places).enumerate()
    {
        for (o, i) in (0..outputs).flat_map(|o| (0..inputs).map(move |i| (o, i))) {
            let c = column(part, i);
            let original = original.map(|first| float(first, o, c));
            let transposed = transposed.map(|first| float(first, c, o));
            original.into_iter().chain(transposed).for_each(|at| prepared[at] = summed.len() as u32);
            let (row, column) = if inputs == 1 { (0, o) } else { (o, c) };
            summed.push(float(gradient, row, column) as u32);
        }
    }
    (prepared, summed)
}

/// A signed-distance field on a device, with the activations and gradients of up to `capacity`
/// samples.
pub struct Sdf {
    plan: SdfPlan,
    grid: Grid,
    inv_radius: f32,
    soften: f32,
    capacity: usize,
    /// Number of groups that sum gradients of weights.
    summing: usize,
    prepared_map: Buffer,
    summed_map: Buffer,
    weights: Buffer,
    value: Buffer,
    jacobian: Buffer,
    q: Buffer,
    h: Buffer,
    o: Buffer,
    c1: Buffer,
    c2: Buffer,
    out: Buffer,
    g_o: Buffer,
    g_value: Buffer,
    g_normal: Buffer,
    partial: Buffer,
}

impl Sdf {
    /// Returns whether a device can compute a field of this shape; about twenty levels are too
    /// many.
    pub fn supports(shape: &FieldShape) -> bool {
        SdfPlan::fits(shape.layout())
    }

    /// Allocates buffers for up to `capacity` samples, a multiple of [`TILE`], of a shape that it
    /// [`supports`](Sdf::supports).
    pub fn new(device: &Device, shape: &FieldShape, capacity: usize) -> Sdf {
        assert!(capacity.is_multiple_of(TILE) && capacity > 0);
        let layout = shape.layout();
        let plan = SdfPlan::new(layout);
        let (prepared, summed) = plan.maps(layout);
        let planes = |count: usize| device.scratch::<f32>(count * capacity);
        Sdf {
            plan,
            grid: Grid::new(device, &shape.levels, shape.active, shape.radius),
            inv_radius: 1.0 / shape.radius,
            soften: shape.soften,
            capacity,
            summing: summing(capacity),
            weights: device.scratch::<f32>(prepared.len()),
            prepared_map: device.upload(&prepared),
            summed_map: device.upload(&summed),
            value: planes(plan.features),
            jacobian: planes(3 * plan.features),
            q: planes(plan.features),
            h: planes(HIDDEN),
            o: planes(OUTPUTS),
            c1: planes(HIDDEN),
            c2: planes(HIDDEN),
            out: planes(WIDTH),
            g_o: planes(OUTPUTS),
            g_value: planes(plan.features),
            g_normal: planes(3),
            partial: device.scratch::<f32>(summing(capacity) * plan.color.gradients[1] * CHANNELS),
        }
    }

    /// Returns the memory per sample in words: the total, and that of the largest buffer.
    pub fn words_per_sample(shape: &FieldShape) -> [usize; 2] {
        let features = 2 * shape.levels.len();
        [6 * features + 3 * HIDDEN + 2 * OUTPUTS + WIDTH + 3, HIDDEN.max(3 * features)]
    }

    /// Returns the memory of the groups' partial gradient sums in words, for up to `capacity`
    /// samples.
    pub fn words_of_sums(shape: &FieldShape, capacity: usize) -> usize {
        summing(capacity) * SdfPlan::new(shape.layout()).color.gradients[1] * CHANNELS
    }

    /// Returns the output of the last forward pass, planes `[8, capacity]`.
    pub fn output(&self) -> &Buffer {
        &self.out
    }

    /// Sets the number of active levels.
    pub fn activate(&mut self, levels: usize) {
        self.grid.activate(levels);
    }

    /// Evaluates sdf, gradient and color of samples, and keeps the activations that the backward
    /// pass needs: see [`crate::cpu::sdf::forward`].
    ///
    /// # Shapes
    ///
    /// - table: `[entries, 2]`; flat: the weights as [`Layout`] describes
    /// - x, direction: planes `[3, capacity]`, finite after the last sample; count: `[1]`, the
    ///   number of samples
    /// - output: planes `[8, capacity]`
    pub fn forward(
        &self,
        device: &Device,
        table: &Buffer,
        flat: &Buffer,
        x: &Buffer,
        direction: &Buffer,
        count: &Buffer,
    ) -> &Buffer {
        self.shade(device, [table, flat], x, direction, None, count)
    }

    /// Evaluates samples like [`Sdf::forward`]. If normals are given, planes `[3, capacity]`, they
    /// replace the gradient both as inputs of the color network and in the output.
    pub fn shade(
        &self,
        device: &Device,
        [table, flat]: [&Buffer; 2],
        x: &Buffer,
        direction: &Buffer,
        normals: Option<&Buffer>,
        count: &Buffer,
    ) -> &Buffer {
        launch!(device, prepare::launch, groups(self.weights.word_count().div_ceil(UNITS as usize)), UNITS;
            flat, self.prepared_map, self.weights
        );
        self.grid.gather(device, table, x, count, &self.value, Some(&self.jacobian));
        assert!(x.word_count() == 3 * self.capacity && direction.word_count() == x.word_count());
        assert!(normals.is_none_or(|n| n.word_count() == x.word_count()));
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            launch!(device, forward::launch_unchecked, groups(self.capacity / TILE), UNITS;
                self.weights, self.value, self.jacobian, x, direction, normals.unwrap_or(x), count, self.q,
                self.h, self.o, self.c1, self.c2, self.out;
                self.inv_radius, self.soften, self.plan, normals.is_some()
            );
        }
        &self.out
    }

    /// Adds the gradient with respect to the table, which must be zero before, and writes that with
    /// respect to the weights, for the samples of the last forward pass: see
    /// [`crate::cpu::sdf::backward`].
    ///
    /// # Shapes
    ///
    /// - g_out: planes `[8, capacity]`
    /// - g_table: `[entries, 2]`; g_flat: shaped like the weights
    pub fn backward(
        &self,
        device: &Device,
        x: &Buffer,
        direction: &Buffer,
        count: &Buffer,
        g_out: &Buffer,
        g_table: &Buffer,
        g_flat: &Buffer,
    ) {
        assert!(x.word_count() == 3 * self.capacity && direction.word_count() == x.word_count());
        assert!(g_out.word_count() == WIDTH * self.capacity);
        let summing_groups = groups(self.summing);
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            launch!(device, color_backward::launch_unchecked, summing_groups.clone(), UNITS;
                self.weights, self.value, direction, count, self.o, self.c1, self.c2, self.out, g_out,
                self.g_o, self.g_normal, self.g_value, self.partial;
                self.soften, self.plan.color
            );
            launch!(device, geometry_backward::launch_unchecked, summing_groups, UNITS;
                self.weights, self.value, self.jacobian, x, count, self.h, self.g_o, self.g_normal,
                self.g_value, self.partial;
                self.inv_radius, self.plan
            );
        }
        let sizes = (self.plan.color.gradients[1] * CHANNELS, TILE, self.summing);
        sum_groups(device, &self.partial, Some(&self.summed_map), count, g_flat, sizes);
        let slopes = Some([&self.q, &self.g_normal]);
        self.grid.scatter(device, g_table, x, count, &self.g_value, slopes);
    }
}

#[cfg(test)]
mod tests;
