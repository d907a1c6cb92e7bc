//! The color network that both fields on a hash grid have: two hidden layers over the outputs of
//! the geometry network, the direction's spherical harmonics and, by field, the unit normal and the
//! hash features.

use super::tile::{
    self, Block, CHANNELS, LANES, Lane, at, ends, load_planes, outer_block, outer_row, output_layer, product,
    relu, relu_backward, sigmoid, store_block, store_outer, store_planes, store_row,
};
use crate::cpu::density::MAX_EXP_GRADIENT;
use crate::cpu::mlp::{HIDDEN, SOFTNESS, TILE};
use crate::cpu::neus::MIN_GRADIENT_NORM;
use burn::cubecl::{self, prelude::*};

type F4 = Vector<f32, Const<4>>;

/// Number of spherical harmonics.
const HARMONICS: usize = 16;

/// Sizes of a color network, and the rows of 64 floats where its weights and gradients begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct ColorPlan {
    /// Number of outputs of the geometry network.
    pub outputs: usize,
    /// Whether the field is a signed distance, whose unit normal is an input and whose local
    /// sharpness is an output.
    pub signed: bool,
    /// Number of hash features among the inputs.
    pub features: usize,
    /// Number of inputs, padded.
    pub inputs: usize,
    /// First row of the weights.
    pub weights: usize,
    /// First row of the gradients, and the number of rows of all gradients of the field.
    pub gradients: [usize; 2],
    /// First plane of the colors in the field's output.
    pub colors: usize,
}

impl ColorPlan {
    /// Returns the first rows of C1ᵀ, C1, C2ᵀ, C2, C3, and the end.
    pub fn rows(&self) -> [usize; 6] {
        ends([self.inputs, HIDDEN, HIDDEN, HIDDEN, 3]).map(|row: usize| row + self.weights)
    }

    /// Returns the first rows of the gradients of C1, C2, C3, and the end.
    pub fn gradient_rows(&self) -> [usize; 4] {
        ends([HIDDEN, HIDDEN, 3]).map(|row: usize| row + self.gradients[0])
    }

    /// Returns the first channel of the normal, or the one after the harmonics for a field without
    /// normals.
    fn normal(&self) -> usize {
        self.outputs + HARMONICS
    }

    /// Returns the first channel of the hash features.
    fn skipped(&self) -> usize {
        self.normal() + if self.signed { 3 } else { 0 }
    }
}

/// v / ‖v‖ and ‖v‖, by the same formulas as the CPU.
#[derive(CubeType)]
pub(super) struct Unit {
    x: F4,
    y: F4,
    z: F4,
    length: F4,
}

#[cube]
pub(super) fn unit(x: F4, y: F4, z: F4) -> Unit {
    let length = max((x * x + y * y + z * z).sqrt(), F4::new(1e-12f32));
    Unit { x: x / length, y: y / length, z: z / length, length }
}

/// Writes the inputs of the color network to a tile. `o` is the thread's output of the geometry
/// network; `normal` is read by one thread of each row only.
#[cube]
pub(super) fn color_inputs(
    a: &mut [F4],
    o: F4,
    normal: &Unit,
    direction: &[F4],
    value: &[F4],
    lane: &Lane,
    #[comptime] plan: ColorPlan,
) {
    let outputs = comptime!(plan.outputs);
    let (row, column, plane, here) = (lane.row, lane.column, lane.plane, lane.here);
    if column < outputs {
        a[at(column, row, LANES)] = o;
    }
    if column == 13 {
        let (x, y, z) = (direction[here], direction[plane + here], direction[2 * plane + here]);
        harmonics(a, outputs, x, y, z, row);
    }
    if comptime!(plan.signed) {
        let first = comptime!(plan.normal());
        if column == 14 {
            a[at(first, row, LANES)] = normal.x;
            a[at(first + 1, row, LANES)] = normal.y;
            a[at(first + 2, row, LANES)] = normal.z;
        }
    }
    let first = comptime!(plan.skipped());
    if comptime!(plan.inputs > first) {
        for j in 0..2usize {
            let c = column + 16 * j;
            if c < comptime!(plan.inputs - first) {
                let mut v = F4::new(0.0f32);
                if c < comptime!(plan.features) {
                    v = value[c * plane + here];
                }
                a[at(first + c, row, LANES)] = v;
            }
        }
    }
}

/// Writes [`tiface_base::geom::sphharm::sh16`] to 16 channels of a tile, from `first` on.
#[cube]
fn harmonics(a: &mut [F4], #[comptime] first: usize, x: F4, y: F4, z: F4, row: usize) {
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let (x2, y2, z2) = (x * x, y * y, z * z);
    let one = F4::new(1.0f32);
    let five = one - F4::new(5.0f32) * z2;
    a[at(first, row, LANES)] = F4::new(0.282_094_79f32);
    a[at(first + 1, row, LANES)] = y * F4::new(-0.488_602_51f32);
    a[at(first + 2, row, LANES)] = z * F4::new(0.488_602_51f32);
    a[at(first + 3, row, LANES)] = x * F4::new(-0.488_602_51f32);
    a[at(first + 4, row, LANES)] = xy * F4::new(1.092_548_4f32);
    a[at(first + 5, row, LANES)] = yz * F4::new(-1.092_548_4f32);
    a[at(first + 6, row, LANES)] = z2 * F4::new(0.946_174_7f32) - F4::new(0.315_391_57f32);
    a[at(first + 7, row, LANES)] = xz * F4::new(-1.092_548_4f32);
    a[at(first + 8, row, LANES)] = (x2 - y2) * F4::new(0.546_274_2f32);
    a[at(first + 9, row, LANES)] = y * (y2 - x2 * F4::new(3.0f32)) * F4::new(0.590_043_6f32);
    a[at(first + 10, row, LANES)] = xy * z * F4::new(2.890_611_4f32);
    a[at(first + 11, row, LANES)] = y * five * F4::new(0.457_045_8f32);
    a[at(first + 12, row, LANES)] = z * (F4::new(5.0f32) * z2 - F4::new(3.0f32)) * F4::new(0.373_176_34f32);
    a[at(first + 13, row, LANES)] = x * five * F4::new(0.457_045_8f32);
    a[at(first + 14, row, LANES)] = z * (x2 - y2) * F4::new(1.445_305_7f32);
    a[at(first + 15, row, LANES)] = x * (y2 * F4::new(3.0f32) - x2) * F4::new(0.590_043_6f32);
}

/// Writes colors to the field's output from the inputs in tile `a`, and the activations that the
/// backward pass needs.
#[cube]
pub(super) fn color_forward(
    a: &mut [F4],
    b: &mut [F4],
    w: &[F4],
    c1: &mut [F4],
    c2: &mut [F4],
    out: &mut [F4],
    lane: &Lane,
    #[comptime] plan: ColorPlan,
) {
    let rows = comptime!(plan.rows());
    let (row, column, plane, here) = (lane.row, lane.column, lane.plane, lane.here);
    let first =
        relu(&product(&*a, 0usize, w, comptime!(rows[0]), comptime!(plan.inputs), row, column, LANES));
    store_planes(c1, &first, lane, HIDDEN);
    store_block(b, &first, row, column, LANES);
    sync_cube();
    let second = relu(&product(&*b, 0usize, w, comptime!(rows[2]), HIDDEN, row, column, LANES));
    store_planes(c2, &second, lane, HIDDEN);
    store_block(a, &second, row, column, LANES);
    sync_cube();
    let rgb = output_layer(&*a, w, comptime!(rows[4]), row, column, 3usize, LANES);
    if column < 3 {
        out[(comptime!(plan.colors) + column) * plane + here] = sigmoid(rgb);
    }
}

/// Returns four samples' values, set to zero from sample number `samples` on; `first` is the number
/// of the first one.
#[cube]
fn masked(v: F4, first: usize, samples: usize) -> F4 {
    let mut masked_v = v;
    #[unroll]
    for i in 0..4usize {
        if first + i >= samples {
            masked_v.insert(i, 0.0f32);
        }
    }
    masked_v
}

/// Backward pass of the color network. Writes, for each sample, the gradients with respect to the
/// geometry network's outputs (of the density: before the exponential), the normal, and the
/// features that the color network reads; and partial sums by group of the gradients with respect
/// to the weights. `g_normal` and `g_value` are written only where these are inputs.
#[cube(launch_unchecked)]
pub(super) fn color_backward(
    w: &[F4],
    value: &[F4],
    direction: &[F4],
    count: &[u32],
    o: &[F4],
    c1: &[F4],
    c2: &[F4],
    out: &[F4],
    g_out: &[F4],
    g_o: &mut [F4],
    g_normal: &mut [F4],
    g_value: &mut [F4],
    partial: &mut [f32],
    soften: f32,
    #[comptime] plan: ColorPlan,
) {
    let (rows, gradient_rows) = comptime!((plan.rows(), plan.gradient_rows()));
    let outputs = comptime!(plan.outputs);
    let plane = direction.len() / 3;
    let group = CUBE_POS;
    let sum = group * comptime!(plan.gradients[1] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = tile::uniform_count(count, &mut a);
    // the thread's sums of the gradients of C1, C2 and C3
    let mut c1_0 = F4::new(0.0f32);
    let mut c1_1 = F4::new(0.0f32);
    let mut c1_2 = F4::new(0.0f32);
    let mut c1_3 = F4::new(0.0f32);
    let mut c2_0 = F4::new(0.0f32);
    let mut c2_1 = F4::new(0.0f32);
    let mut c2_2 = F4::new(0.0f32);
    let mut c2_3 = F4::new(0.0f32);
    let mut c3_0 = F4::new(0.0f32);
    for tile in range_stepped(group, samples.div_ceil(TILE), CUBE_COUNT) {
        let lane = tile::lane_of(tile, plane);
        let (row, column, here) = (lane.row, lane.column, lane.here);
        let first = 4 * here;
        if column < 3 {
            let y = out[(comptime!(plan.colors) + column) * plane + here];
            let g = masked(g_out[(comptime!(plan.colors) + column) * plane + here], first, samples);
            a[at(column, row, LANES)] = g * y * (F4::new(1.0f32) - y);
        }
        load_planes(&mut b, c2, &lane);
        sync_cube();
        if row < 3 {
            c3_0 += outer_row(&a, row, &b, column, LANES);
        }
        let g_c2 = product(&a, 0usize, w, comptime!(rows[4]), 3usize, row, column, LANES);
        let g_c2 = relu_backward(&g_c2, &b, row, column, LANES);
        sync_cube();
        store_block(&mut a, &g_c2, row, column, LANES);
        load_planes(&mut b, c1, &lane);
        sync_cube();
        let of_c2 = outer_block(&a, &b, row, column);
        c2_0 += of_c2.channel(0usize);
        c2_1 += of_c2.channel(1usize);
        c2_2 += of_c2.channel(2usize);
        c2_3 += of_c2.channel(3usize);
        let g_c1 = product(&a, 0usize, w, comptime!(rows[3]), HIDDEN, row, column, LANES);
        let g_c1 = relu_backward(&g_c1, &b, row, column, LANES);
        sync_cube();
        store_block(&mut a, &g_c1, row, column, LANES);
        let n = unit(out[plane + here], out[2 * plane + here], out[3 * plane + here]);
        let mut output = F4::new(0.0f32);
        if column < outputs {
            output = o[column * plane + here];
        }
        color_inputs(&mut b, output, &n, direction, value, &lane, plan);
        sync_cube();
        let of_c1 = outer_block(&a, &b, row, column);
        c1_0 += of_c1.channel(0usize);
        c1_1 += of_c1.channel(1usize);
        c1_2 += of_c1.channel(2usize);
        c1_3 += of_c1.channel(3usize);
        let g_c0 = product(&a, 0usize, w, comptime!(rows[1]), HIDDEN, row, column, LANES);
        sync_cube();
        store_block(&mut a, &g_c0, row, column, LANES);
        sync_cube();
        if column < outputs {
            let mut g = a[at(column, row, LANES)];
            if column == 0 {
                let mut g_first = masked(g_out[here], first, samples);
                if comptime!(!plan.signed) {
                    g_first *= min(out[here], F4::new(MAX_EXP_GRADIENT));
                }
                g += g_first;
            }
            if comptime!(plan.signed) {
                let at_soft = 7 * plane + here;
                if column == SOFTNESS && soften > 0.0f32 {
                    // through y = −L σ, whose slope is y (1 + y / L)
                    let y = out[at_soft];
                    let g_soft = masked(g_out[at_soft], first, samples);
                    g += g_soft * y * (F4::new(1.0f32) + y / F4::new(soften));
                }
            }
            g_o[column * plane + here] = g;
        }
        if comptime!(plan.signed) {
            let at_normal = comptime!(plan.normal());
            if column == 14 {
                // also through n̂ = n / ‖n‖: (g − n̂ (n̂ · g)) / ‖n‖
                let gx = a[at(at_normal, row, LANES)];
                let gy = a[at(at_normal + 1, row, LANES)];
                let gz = a[at(at_normal + 2, row, LANES)];
                let radial = n.x * gx + n.y * gy + n.z * gz;
                let zero = F4::new(0.0f32);
                let one = F4::new(1.0f32);
                let share =
                    select_many(n.length.greater_than(&F4::new(MIN_GRADIENT_NORM)), one / n.length, zero);
                g_normal[here] = masked(g_out[plane + here], first, samples) + (gx - n.x * radial) * share;
                g_normal[plane + here] =
                    masked(g_out[2 * plane + here], first, samples) + (gy - n.y * radial) * share;
                g_normal[2 * plane + here] =
                    masked(g_out[3 * plane + here], first, samples) + (gz - n.z * radial) * share;
            }
        }
        if comptime!(plan.features > 0) {
            for j in 0..2usize {
                let c = column + 16 * j;
                if c < comptime!(plan.features) {
                    g_value[c * plane + here] = a[at(comptime!(plan.skipped()) + c, row, LANES)];
                }
            }
        }
        sync_cube();
    }
    if group < samples.div_ceil(TILE) {
        let lane = tile::lane_of(group, plane);
        let (row, column) = (lane.row, lane.column);
        let sums = Block::new(c1_0, c1_1, c1_2, c1_3);
        store_outer(
            partial,
            sum + comptime!(gradient_rows[0] * CHANNELS),
            &sums,
            comptime!(plan.inputs),
            row,
            column,
        );
        let sums = Block::new(c2_0, c2_1, c2_2, c2_3);
        store_outer(partial, sum + comptime!(gradient_rows[1] * CHANNELS), &sums, HIDDEN, row, column);
        if row < 3 {
            let start = sum + (comptime!(gradient_rows[2]) + row) * CHANNELS;
            store_row(partial, start, c3_0, HIDDEN, column);
        }
    }
}
