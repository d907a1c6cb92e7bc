//! The signed-distance field of [`crate::kernel::cpu::sdf`], whose module holds the formulas: forward with normals, and the
//! backward with its second-order path.
//!
//! A group of 256 threads takes 64 samples through all layers. Activations stand in workgroup memory, channel by
//! channel; a thread holds four samples of four channels. Weights, 90 kB, are read where they lie: all groups read the
//! same, so they stay in the nearest cache and leave workgroup memory to two tiles of activations (32 KiB). Gradients
//! of weights are summed by group, then over the groups in their order. The backward is two kernels, one a network:
//! as one, a software driver takes ten times as long to compile it.

pub(super) mod kernels;

use super::device::{Buffer, Device, Words, groups, launch};
use super::hash::Grid;
use super::tile::{CHANNELS, UNITS};
use crate::kernel::cpu::mlp::{HIDDEN, Layout, OUTPUTS, TILE};
use crate::kernel::cpu::sdf::{FieldShape, WIDTH};
use kernels::{color_backward, forward, geometry_backward, prepare, reduce};

/// Groups that sum gradients of weights, each over its own tiles.
pub(super) const SUMMING: usize = 256;

/// The first channel of the normal among the inputs of the color network.
const NORMAL: usize = OUTPUTS + 16;

/// Where the matrices of a field stand, in rows of 64 floats: weights in the orders in which they are read, and
/// gradients row-major as the CPU's. Geometry columns are `[hash, x]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Plan {
    /// Hash features: two a level.
    features: usize,
    /// Inputs of the geometry network, padded.
    padded: usize,
    /// Inputs of the color network, padded.
    color: usize,
    skip: bool,
}

impl Plan {
    /// Is there room for the inputs of both networks in a tile?
    fn fits(layout: Layout) -> bool {
        layout.padded() + OUTPUTS <= CHANNELS && layout.color_padded() <= CHANNELS
    }

    fn new(layout: Layout) -> Plan {
        let (padded, color) = (layout.padded(), layout.color_padded());
        assert!(Plan::fits(layout), "the field has more levels than a tile has room");
        Plan { features: layout.inputs - 3, padded, color, skip: layout.color_skip }
    }

    /// First rows of W1ᵀ, W1, b1, W2, b2 (each four times), C1ᵀ, C1, C2ᵀ, C2, C3, and the end.
    fn rows(&self) -> [usize; 11] {
        let counts = [self.padded, HIDDEN, 1, OUTPUTS, 1, self.color, HIDDEN, HIDDEN, HIDDEN, 3];
        ends(counts)
    }

    /// First rows of the gradients of W1, b1, W2, b2, C1, C2, C3, and the end.
    fn gradients(&self) -> [usize; 8] {
        ends([HIDDEN, 1, OUTPUTS, 1, HIDDEN, HIDDEN, 3])
    }

    /// For each float of the prepared weights the one of the flat vector, and for each of the flat vector the one of
    /// the gradients: `u32::MAX` where there is none.
    fn maps(&self, layout: Layout) -> (Vec<u32>, Vec<u32>) {
        let (rows, gradients) = (self.rows(), self.gradients());
        let mut prepared = vec![u32::MAX; rows[10] * CHANNELS];
        let mut summed = vec![u32::MAX; layout.len()];
        let mut flat = 0;
        for (part, (outputs, inputs)) in layout.shapes().into_iter().enumerate() {
            for (o, i) in (0..outputs).flat_map(|o| (0..inputs).map(move |i| (o, i))) {
                // the geometry network reads [hash, x], its weights say [x, hash]
                let c = if part == 0 { (i + inputs - 3) % inputs } else { i };
                let float = |row: usize, column: usize| row * CHANNELS + column;
                let [own, turned] = match part {
                    0 => [Some(float(rows[1] + o, c)), Some(float(rows[0] + c, o))],
                    1 => [Some(float(rows[2], o)), None],
                    2 => [Some(float(rows[3] + o, c)), None],
                    3 => [None, None],
                    4 => [Some(float(rows[6] + o, c)), Some(float(rows[5] + c, o))],
                    5 => [Some(float(rows[8] + o, c)), Some(float(rows[7] + c, o))],
                    _ => [Some(float(rows[9] + o, c)), None],
                };
                own.into_iter().chain(turned).for_each(|at| prepared[at] = flat);
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

/// Running sums, from 0.
pub(super) fn ends<const N: usize, const M: usize>(counts: [usize; N]) -> [usize; M] {
    std::array::from_fn(|i| counts[..i].iter().sum())
}

/// A signed-distance field on a device, and what its forward keeps for its backward, for up to `capacity` samples.
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
    /// Can a device compute a field of this shape? Not one of some twenty levels.
    pub fn supports(shape: &FieldShape) -> bool {
        Plan::fits(shape.layout())
    }

    /// For up to `capacity` samples, a multiple of [`TILE`], of a field that it [`supports`](Sdf::supports).
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

    /// Words of memory that a sample takes: all of them, and of the largest buffer.
    pub fn words_per_sample(shape: &FieldShape) -> [usize; 2] {
        let features = 2 * shape.levels.len();
        [6 * features + 3 * HIDDEN + 2 * OUTPUTS + WIDTH + 3, HIDDEN.max(3 * features)]
    }

    /// Words of memory that sums of groups take, however many samples there are.
    pub fn words_of_sums(shape: &FieldShape) -> usize {
        SUMMING * Plan::new(shape.layout()).gradients()[7] * CHANNELS
    }

    /// What the last forward computed, planes `[8, capacity]`.
    pub fn output(&self) -> &Buffer {
        &self.out
    }

    /// How many of the levels take part from now on.
    pub fn activate(&mut self, levels: usize) {
        self.grid.activate(levels);
    }

    /// Sdf, gradient and color of samples, and what the backward needs: see [`crate::kernel::cpu::sdf::forward`].
    ///
    /// # Shapes
    ///
    /// - table: `[entries, 2]`; flat: the weights as [`Layout`] describes
    /// - x, direction: planes `[3, capacity]`, finite behind the last sample; count: `[1]`, the samples there are
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

    /// As [`Sdf::forward`]; where normals are given, planes `[3, capacity]`, color sees those, and the output has them in
    /// place of the gradient.
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

    /// Adds the gradient of the table, zero before, and writes that of the weights: see
    /// [`crate::kernel::cpu::sdf::backward`]. Of the samples of the last forward.
    ///
    /// # Shapes
    ///
    /// - g_out: planes `[8, capacity]`
    /// - g_table: `[entries, 2]`; g_flat: as the weights
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
        let groups_of = groups(SUMMING.min(self.capacity / TILE));
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            launch!(device, color_backward::launch_unchecked, groups_of.clone(), UNITS;
                self.weights, self.value, direction, count, self.o, self.c1, self.c2, self.out, g_out,
                self.g_o, self.g_normal, self.g_value, self.partial;
                self.soften, self.plan
            );
            launch!(device, geometry_backward::launch_unchecked, groups_of, UNITS;
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
