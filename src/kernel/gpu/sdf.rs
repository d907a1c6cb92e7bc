//! The signed-distance field of [`crate::kernel::cpu::sdf`], whose module holds the formulas: the forward pass with
//! normals, and the backward pass with its second-order path.
//!
//! A group of 256 threads evaluates all layers for 64 samples. Activations are kept in workgroup memory, channel by
//! channel; a thread holds four samples of four channels. Weights, 90 kB, are read from global memory: all groups read
//! the same ones, so they stay in the nearest cache, and workgroup memory is free for two tiles of activations (32 KiB).
//! Gradients of weights are summed by group, then over the groups in a fixed order. The backward pass is two kernels, one
//! per network, because a software driver takes ten times as long to compile a single one.

pub(super) mod kernels;

use super::device::{Buffer, Device, Words, groups, launch};
use super::hash::Grid;
use super::tile::{CHANNELS, UNITS};
use crate::kernel::cpu::mlp::{HIDDEN, Layout, OUTPUTS, TILE};
use crate::kernel::cpu::sdf::{FieldShape, WIDTH};
use kernels::{color_backward, forward, geometry_backward, prepare, reduce};

/// Maximum number of groups that sum gradients of weights, each over its own tiles.
pub(super) const SUMMING: usize = 256;

/// First channel of the normal among the inputs of the color network.
const NORMAL: usize = OUTPUTS + 16;

/// Offsets of the matrices of a field, in rows of 64 floats. Weights are stored in the orders in which they are read,
/// gradients row-major like on the CPU. Geometry columns are `[hash, x]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Plan {
    /// Number of hash features: two per level.
    features: usize,
    /// Number of inputs of the geometry network, padded.
    padded: usize,
    /// Number of inputs of the color network, padded.
    color: usize,
    /// Whether the color network also reads the hash features.
    skip: bool,
}

impl Plan {
    /// Returns whether a tile can hold the inputs of each network.
    fn fits(layout: Layout) -> bool {
        layout.padded() + OUTPUTS <= CHANNELS && layout.color_padded() <= CHANNELS
    }

    fn new(layout: Layout) -> Plan {
        let (padded, color) = (layout.padded(), layout.color_padded());
        assert!(Plan::fits(layout), "the field has more levels than a tile can hold");
        Plan { features: layout.inputs - 3, padded, color, skip: layout.color_skip }
    }

    /// Returns the first rows of W1ᵀ, W1, b1, W2, b2 (each value four times), C1ᵀ, C1, C2ᵀ, C2, C3, and the end.
    fn rows(&self) -> [usize; 11] {
        let counts = [self.padded, HIDDEN, 1, OUTPUTS, 1, self.color, HIDDEN, HIDDEN, HIDDEN, 3];
        ends(counts)
    }

    /// Returns the first rows of the gradients of W1, b1, W2, b2, C1, C2, C3, and the end.
    fn gradients(&self) -> [usize; 8] {
        ends([HIDDEN, 1, OUTPUTS, 1, HIDDEN, HIDDEN, 3])
    }

    /// Returns two index maps: for each float of the prepared weights its index in the flat vector, or `u32::MAX` for
    /// padding; and for each float of the flat vector its index in the gradients.
    fn maps(&self, layout: Layout) -> (Vec<u32>, Vec<u32>) {
        let (rows, gradients) = (self.rows(), self.gradients());
        let mut prepared = vec![u32::MAX; rows[10] * CHANNELS];
        let mut summed = vec![u32::MAX; layout.len()];
        let mut flat = 0;
        for (part, (outputs, inputs)) in layout.shapes().into_iter().enumerate() {
            for (o, i) in (0..outputs).flat_map(|o| (0..inputs).map(move |i| (o, i))) {
                // the kernels read [hash, x], but the flat weights are ordered [x, hash]
                let c = if part == 0 { (i + inputs - 3) % inputs } else { i };
                let float = |row: usize, column: usize| row * CHANNELS + column;
                let [original, transposed] = match part {
                    0 => [Some(float(rows[1] + o, c)), Some(float(rows[0] + c, o))],
                    1 => [Some(float(rows[2], o)), None],
                    2 => [Some(float(rows[3] + o, c)), None],
                    3 => [None, None],
                    4 => [Some(float(rows[6] + o, c)), Some(float(rows[5] + c, o))],
                    5 => [Some(float(rows[8] + o, c)), Some(float(rows[7] + c, o))],
                    _ => [Some(float(rows[9] + o, c)), None],
                };
                original.into_iter().chain(transposed).for_each(|at| prepared[at] = flat);
                if part == 3 {
                    (0..4).for_each(|k| prepared[float(rows[4], 4 * o + k)] = flat);
                }
                let biases = [1, 3].contains(&part);
                let row = gradients[part] + if biases { 0 } else { o };
                summed[flat as usize] = float(row, if biases { o } else { c }) as u32;
                flat += 1;
            }
        }
        (prepared, summed)
    }
}

/// Returns running sums of `counts`, from 0.
pub(super) fn ends<const N: usize, const M: usize>(counts: [usize; N]) -> [usize; M] {
    std::array::from_fn(|i| counts[..i].iter().sum())
}

/// A signed-distance field on a device, with the activations and gradients of up to `capacity` samples.
pub struct Sdf {
    plan: Plan,
    grid: Grid,
    inv_radius: f32,
    soften: f32,
    capacity: usize,
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
    /// Returns whether a device can compute a field of this shape; about twenty levels are too many.
    pub fn supports(shape: &FieldShape) -> bool {
        Plan::fits(shape.layout())
    }

    /// Allocates buffers for up to `capacity` samples, a multiple of [`TILE`], of a shape that it
    /// [`supports`](Sdf::supports).
    pub fn new(device: &Device, shape: &FieldShape, capacity: usize) -> Sdf {
        assert!(capacity.is_multiple_of(TILE) && capacity > 0);
        let layout = shape.layout();
        let plan = Plan::new(layout);
        let (prepared, summed) = plan.maps(layout);
        let planes = |count: usize| device.scratch::<f32>(count * capacity);
        Sdf {
            plan,
            grid: Grid::new(device, &shape.levels, shape.active, shape.radius),
            inv_radius: 1.0 / shape.radius,
            soften: shape.soften,
            capacity,
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
            partial: device.scratch::<f32>(SUMMING * plan.gradients()[7] * CHANNELS),
        }
    }

    /// Returns the memory per sample in words: the total, and that of the largest buffer.
    pub fn words_per_sample(shape: &FieldShape) -> [usize; 2] {
        let features = 2 * shape.levels.len();
        [6 * features + 3 * HIDDEN + 2 * OUTPUTS + WIDTH + 3, HIDDEN.max(3 * features)]
    }

    /// Returns the memory of the groups' partial gradient sums in words, which does not depend on the number of samples.
    pub fn words_of_sums(shape: &FieldShape) -> usize {
        SUMMING * Plan::new(shape.layout()).gradients()[7] * CHANNELS
    }

    /// Returns the output of the last forward pass, planes `[8, capacity]`.
    pub fn output(&self) -> &Buffer {
        &self.out
    }

    /// Sets the number of active levels.
    pub fn activate(&mut self, levels: usize) {
        self.grid.activate(levels);
    }

    /// Evaluates sdf, gradient and color of samples, and keeps the activations that the backward pass needs: see
    /// [`crate::kernel::cpu::sdf::forward`].
    ///
    /// # Shapes
    ///
    /// - table: `[entries, 2]`; flat: the weights as [`Layout`] describes
    /// - x, direction: planes `[3, capacity]`, finite after the last sample; count: `[1]`, the number of samples
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

    /// Evaluates samples like [`Sdf::forward`]. If normals are given, planes `[3, capacity]`, they replace the gradient both
    /// as inputs of the color network and in the output.
    pub fn shade(
        &self,
        device: &Device,
        [table, flat]: [&Buffer; 2],
        x: &Buffer,
        direction: &Buffer,
        normals: Option<&Buffer>,
        count: &Buffer,
    ) -> &Buffer {
        launch!(device, prepare::launch, groups(self.weights.words().div_ceil(UNITS as usize)), UNITS;
            flat, self.prepared_map, self.weights
        );
        self.grid.gather(device, table, x, count, &self.value, Some(&self.jacobian));
        assert!(x.words() == 3 * self.capacity && direction.words() == x.words());
        assert!(normals.is_none_or(|n| n.words() == x.words()));
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

    /// Adds the gradient with respect to the table, which must be zero before, and writes that with respect to the weights,
    /// for the samples of the last forward pass: see [`crate::kernel::cpu::sdf::backward`].
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
        assert!(x.words() == 3 * self.capacity && direction.words() == x.words());
        assert!(g_out.words() == WIDTH * self.capacity);
        let summing_groups = groups(SUMMING.min(self.capacity / TILE));
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            launch!(device, color_backward::launch_unchecked, summing_groups.clone(), UNITS;
                self.weights, self.value, direction, count, self.o, self.c1, self.c2, self.out, g_out,
                self.g_o, self.g_normal, self.g_value, self.partial;
                self.soften, self.plan
            );
            launch!(device, geometry_backward::launch_unchecked, summing_groups, UNITS;
                self.weights, self.value, self.jacobian, x, count, self.h, self.g_o, self.g_normal,
                self.g_value, self.partial;
                self.inv_radius, self.plan
            );
        }
        launch!(device, reduce::launch, groups(g_flat.words().div_ceil(UNITS as usize)), UNITS;
            self.partial, self.summed_map, count, g_flat;
            (self.plan.gradients()[7] * CHANNELS) as u32, SUMMING.min(self.capacity / TILE)
        );
        let slopes = Some([&self.q, &self.g_normal]);
        self.grid.scatter(device, g_table, x, count, &self.g_value, slopes);
    }
}

#[cfg(test)]
mod tests;
