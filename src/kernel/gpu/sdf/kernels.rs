//! Kernels of the signed-distance field: preparation of the weights, the forward pass, and the backward pass in one kernel
//! per network.

use super::super::tile::{
    self, CHANNELS, LANES, at, load_planes, outer, output_layer, product, relu, relu_backward, sample_sums,
    sigmoid, store_block, store_planes,
};
use super::{NORMAL, Plan};
use crate::kernel::cpu::mlp::{COLOR_INPUTS, HIDDEN, OUTPUTS, SOFTNESS, TILE};
use crate::kernel::cpu::neus::MIN_GRADIENT_NORM;
use burn::cubecl::{self, prelude::*};

type F4 = Vector<f32, Const<4>>;

/// Copies the weights to the orders in which they are read.
#[cube(launch)]
pub(in super::super) fn prepare(flat: &[f32], map: &[u32], out: &mut [f32]) {
    let i = ABSOLUTE_POS;
    if i < out.len() {
        let from = map[i] as usize;
        out[i] = if from < flat.len() { flat[from] } else { 0.0f32 };
    }
}

/// Sums the partial gradients of the groups, in the order of the groups.
#[cube(launch)]
pub(in super::super) fn reduce(
    partial: &[f32],
    map: &[u32],
    count: &[u32],
    flat: &mut [f32],
    size: u32,
    #[comptime] summing: usize,
) {
    let i = ABSOLUTE_POS;
    if i < flat.len() {
        let tiles = (count[0] as usize).div_ceil(TILE);
        let mut sum = 0.0f32;
        for group in 0..min(tiles, summing) {
            sum += partial[group * size as usize + map[i] as usize];
        }
        flat[i] = sum;
    }
}

/// Writes the inputs of the geometry network to a tile.
#[cube]
fn geometry_inputs(
    a: &mut [F4],
    value: &[F4],
    x: &[F4],
    inv_radius: f32,
    plane: usize,
    here: usize,
    row: usize,
    column: usize,
    #[comptime] features: usize,
) {
    for j in 0..4usize {
        let c = column + 16 * j;
        let mut v = F4::new(0.0f32);
        if c < features {
            v = value[c * plane + here];
        } else if c < features + 3 {
            v = x[(c - features) * plane + here] * F4::new(inv_radius);
        }
        a[at(c, row, LANES)] = v;
    }
}

/// v / ‖v‖ and ‖v‖, by the same formulas as the CPU.
#[derive(CubeType)]
struct Unit {
    x: F4,
    y: F4,
    z: F4,
    length: F4,
}

#[cube]
fn unit(x: F4, y: F4, z: F4) -> Unit {
    let length = max((x * x + y * y + z * z).sqrt(), F4::new(1e-12f32));
    Unit { x: x / length, y: y / length, z: z / length, length }
}

/// Writes the inputs of the color network to a tile. `o` is the thread's output of the geometry network; `normal` is read
/// by one thread of each row only.
#[cube]
fn color_inputs(
    a: &mut [F4],
    o: F4,
    normal: &Unit,
    direction: &[F4],
    value: &[F4],
    plane: usize,
    here: usize,
    row: usize,
    column: usize,
    #[comptime] plan: Plan,
) {
    if column < OUTPUTS {
        a[at(column, row, LANES)] = o;
    }
    if column == 13 {
        let (x, y, z) = (direction[here], direction[plane + here], direction[2 * plane + here]);
        harmonics(a, OUTPUTS, x, y, z, row);
    }
    if column == 14 {
        a[at(NORMAL, row, LANES)] = normal.x;
        a[at(NORMAL + 1, row, LANES)] = normal.y;
        a[at(NORMAL + 2, row, LANES)] = normal.z;
    }
    if comptime!(plan.color > COLOR_INPUTS) {
        for j in 0..2usize {
            let c = column + 16 * j;
            if c < comptime!(plan.color - COLOR_INPUTS) {
                let mut v = F4::new(0.0f32);
                if c < comptime!(plan.features) {
                    v = value[c * plane + here];
                }
                a[at(COLOR_INPUTS + c, row, LANES)] = v;
            }
        }
    }
}

/// Writes [`crate::geom::sphharm::sh16`] to 16 channels of a tile, from `first` on.
#[cube]
pub(in super::super) fn harmonics(a: &mut [F4], #[comptime] first: usize, x: F4, y: F4, z: F4, row: usize) {
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

/// Writes sdf, ∇sdf, color and local sharpness, planes `[8, capacity]`, and the activations that the backward pass needs.
/// If `given` is set, `normals` replace ∇sdf.
#[cube(launch_unchecked)]
pub(super) fn forward(
    w: &[F4],
    value: &[F4],
    jacobian: &[F4],
    x: &[F4],
    direction: &[F4],
    normals: &[F4],
    count: &[u32],
    q: &mut [F4],
    h: &mut [F4],
    o: &mut [F4],
    c1: &mut [F4],
    c2: &mut [F4],
    out: &mut [F4],
    inv_radius: f32,
    soften: f32,
    #[comptime] plan: Plan,
    #[comptime] given: bool,
) {
    let rows = comptime!(plan.rows());
    let features = comptime!(plan.features);
    let plane = x.len() / 3;
    let (row, column) = (UNIT_POS as usize / 16, UNIT_POS as usize % 16);
    let tile = CUBE_POS;
    let here = tile * LANES + row;
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = tile::uniform_count(count, &mut a);
    if tile * TILE < samples {
        geometry_inputs(&mut a, value, x, inv_radius, plane, here, row, column, features);
        sync_cube();
        let z = product(&a, 0usize, w, comptime!(rows[0]), comptime!(plan.padded), row, column, LANES);
        let active = tile::activate(&z, w[comptime!(rows[2] * LANES) + column]);
        store_planes(h, &active.h, plane, here, column, HIDDEN);
        store_block(&mut b, &active.h, row, column, LANES);
        sync_cube();
        let output = output_layer(&b, w, comptime!(rows[3]), row, column, OUTPUTS, LANES)
            + w[comptime!(rows[4] * LANES) + column];
        if column < OUTPUTS {
            o[column * plane + here] = output;
        }
        let weighted = tile::weighted(&active.s, w[comptime!(rows[3] * LANES) + column]);
        store_block(&mut a, &weighted, row, column, LANES);
        sync_cube();
        // q = a W1, and this thread's part of n = q_x + Jᵀ q_F
        let own_q = product(&a, 0usize, w, comptime!(rows[1]), HIDDEN, row, column, LANES);
        store_planes(q, &own_q, plane, here, column, features);
        #[unroll]
        for axis in 0..3usize {
            let mut sum = F4::new(0.0f32);
            #[unroll]
            for j in 0..4usize {
                let c = 4 * column + j;
                let v = own_q.channel(j);
                if c < features {
                    sum += jacobian[(3 * c + axis) * plane + here] * v;
                } else if c == features + axis {
                    sum += v * F4::new(inv_radius);
                }
            }
            b[at(16 * axis + column, row, LANES)] = sum;
        }
        sync_cube();
        let mut nx = F4::new(0.0f32);
        let mut ny = F4::new(0.0f32);
        let mut nz = F4::new(0.0f32);
        if column == 14 {
            if given {
                nx = normals[here];
                ny = normals[plane + here];
                nz = normals[2 * plane + here];
            } else {
                for c in 0..16usize {
                    nx += b[at(c, row, LANES)];
                    ny += b[at(16 + c, row, LANES)];
                    nz += b[at(32 + c, row, LANES)];
                }
            }
            out[plane + here] = nx;
            out[2 * plane + here] = ny;
            out[3 * plane + here] = nz;
        }
        color_inputs(&mut a, output, &unit(nx, ny, nz), direction, value, plane, here, row, column, plan);
        if column == 0 {
            out[here] = output;
        }
        if column == SOFTNESS {
            out[7 * plane + here] = sigmoid(output - F4::new(2.0f32)) * F4::new(-soften);
        }
        sync_cube();
        let first = product(&a, 0usize, w, comptime!(rows[5]), comptime!(plan.color), row, column, LANES);
        let first = relu(&first);
        store_planes(c1, &first, plane, here, column, HIDDEN);
        store_block(&mut b, &first, row, column, LANES);
        sync_cube();
        let second = relu(&product(&b, 0usize, w, comptime!(rows[7]), HIDDEN, row, column, LANES));
        store_planes(c2, &second, plane, here, column, HIDDEN);
        store_block(&mut a, &second, row, column, LANES);
        sync_cube();
        let rgb = output_layer(&a, w, comptime!(rows[9]), row, column, 3usize, LANES);
        if column < 3 {
            out[(4 + column) * plane + here] = sigmoid(rgb);
        }
    }
}

/// Returns four samples' values, set to zero from sample number `samples` on; `first` is the number of the first one.
#[cube]
pub(in super::super) fn masked(v: F4, first: usize, samples: usize) -> F4 {
    let mut masked_v = v;
    #[unroll]
    for i in 0..4usize {
        if first + i >= samples {
            masked_v.insert(i, 0.0f32);
        }
    }
    masked_v
}

/// Backward pass of the color network. Writes, for each sample, the gradients with respect to the geometry network's
/// outputs, the normal, and the features that the color network reads; and partial sums by group of the gradients with
/// respect to the weights.
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
    #[comptime] plan: Plan,
) {
    let rows = comptime!(plan.rows());
    let gradient_rows = comptime!(plan.gradients());
    let plane = direction.len() / 3;
    let (row, column) = (UNIT_POS as usize / 16, UNIT_POS as usize % 16);
    let group = CUBE_POS;
    let sum = group * comptime!(gradient_rows[7] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = tile::uniform_count(count, &mut a);
    for tile in range_stepped(group, samples.div_ceil(TILE), CUBE_COUNT) {
        let here = tile * LANES + row;
        let first = 4 * here;
        let fresh = tile == group;
        if column < 3 {
            let y = out[(4 + column) * plane + here];
            let g = masked(g_out[(4 + column) * plane + here], first, samples);
            a[at(column, row, LANES)] = g * y * (F4::new(1.0f32) - y);
        }
        load_planes(&mut b, c2, plane, here, row, column);
        sync_cube();
        let start = sum + comptime!(gradient_rows[6] * CHANNELS);
        outer(&a, 0usize, &b, 3usize, HIDDEN, partial, start, fresh, row, column, LANES);
        let g_c2 = product(&a, 0usize, w, comptime!(rows[9]), 3usize, row, column, LANES);
        let g_c2 = relu_backward(&g_c2, &b, row, column, LANES);
        sync_cube();
        store_block(&mut a, &g_c2, row, column, LANES);
        load_planes(&mut b, c1, plane, here, row, column);
        sync_cube();
        let start = sum + comptime!(gradient_rows[5] * CHANNELS);
        outer(&a, 0usize, &b, HIDDEN, HIDDEN, partial, start, fresh, row, column, LANES);
        let g_c1 = product(&a, 0usize, w, comptime!(rows[8]), HIDDEN, row, column, LANES);
        let g_c1 = relu_backward(&g_c1, &b, row, column, LANES);
        sync_cube();
        store_block(&mut a, &g_c1, row, column, LANES);
        let n = unit(out[plane + here], out[2 * plane + here], out[3 * plane + here]);
        let mut output = F4::new(0.0f32);
        if column < OUTPUTS {
            output = o[column * plane + here];
        }
        color_inputs(&mut b, output, &n, direction, value, plane, here, row, column, plan);
        sync_cube();
        let start = sum + comptime!(gradient_rows[4] * CHANNELS);
        outer(&a, 0usize, &b, HIDDEN, comptime!(plan.color), partial, start, fresh, row, column, LANES);
        let g_c0 = product(&a, 0usize, w, comptime!(rows[6]), HIDDEN, row, column, LANES);
        sync_cube();
        store_block(&mut a, &g_c0, row, column, LANES);
        sync_cube();
        if column < OUTPUTS {
            let mut g = a[at(column, row, LANES)];
            if column == 0 {
                g += masked(g_out[here], first, samples);
            }
            if column == SOFTNESS && soften > 0.0f32 {
                // through y = −L σ, whose slope is y (1 + y / L)
                let y = out[7 * plane + here];
                let g_soft = masked(g_out[7 * plane + here], first, samples);
                g += g_soft * y * (F4::new(1.0f32) + y / F4::new(soften));
            }
            g_o[column * plane + here] = g;
        }
        if column == 14 {
            // also through n̂ = n / ‖n‖: (g − n̂ (n̂ · g)) / ‖n‖
            let (gx, gy, gz) =
                (a[at(NORMAL, row, LANES)], a[at(NORMAL + 1, row, LANES)], a[at(NORMAL + 2, row, LANES)]);
            let radial = n.x * gx + n.y * gy + n.z * gz;
            let zero = F4::new(0.0f32);
            let one = F4::new(1.0f32);
            let share = select_many(n.length.greater_than(&F4::new(MIN_GRADIENT_NORM)), one / n.length, zero);
            g_normal[here] = masked(g_out[plane + here], first, samples) + (gx - n.x * radial) * share;
            g_normal[plane + here] =
                masked(g_out[2 * plane + here], first, samples) + (gy - n.y * radial) * share;
            g_normal[2 * plane + here] =
                masked(g_out[3 * plane + here], first, samples) + (gz - n.z * radial) * share;
        }
        if comptime!(plan.skip) {
            for j in 0..2usize {
                let c = column + 16 * j;
                if c < comptime!(plan.features) {
                    g_value[c * plane + here] = a[at(COLOR_INPUTS + c, row, LANES)];
                }
            }
        }
        sync_cube();
    }
}

/// Backward pass of the geometry network, with first and second order. Writes the gradients with respect to the features
/// of each sample, and partial sums by group of those with respect to the weights.
#[cube(launch_unchecked)]
pub(super) fn geometry_backward(
    w: &[F4],
    value: &[F4],
    jacobian: &[F4],
    x: &[F4],
    count: &[u32],
    h: &[F4],
    g_o: &[F4],
    g_normal: &[F4],
    g_value: &mut [F4],
    partial: &mut [f32],
    inv_radius: f32,
    #[comptime] plan: Plan,
) {
    let rows = comptime!(plan.rows());
    let gradient_rows = comptime!(plan.gradients());
    let features = comptime!(plan.features);
    let padded = comptime!(plan.padded);
    let plane = x.len() / 3;
    let (row, column) = (UNIT_POS as usize / 16, UNIT_POS as usize % 16);
    let group = CUBE_POS;
    let sum = group * comptime!(gradient_rows[7] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = tile::uniform_count(count, &mut a);
    for tile in range_stepped(group, samples.div_ceil(TILE), CUBE_COUNT) {
        let here = tile * LANES + row;
        let fresh = tile == group;
        // g_q goes to the first channels, g_o to the channels after them
        for j in 0..4usize {
            let c = column + 16 * j;
            let mut v = F4::new(0.0f32);
            if c < features {
                for axis in 0..3usize {
                    v += jacobian[(3 * c + axis) * plane + here] * g_normal[axis * plane + here];
                }
            } else if c < features + 3 {
                v = g_normal[(c - features) * plane + here] * F4::new(inv_radius);
            } else if c >= padded && c < padded + OUTPUTS {
                v = g_o[(c - padded) * plane + here];
            }
            b[at(c, row, LANES)] = v;
        }
        load_planes(&mut a, h, plane, here, row, column);
        sync_cube();
        let g_a = product(&b, 0usize, w, comptime!(rows[0]), padded, row, column, LANES);
        let from_o = product(&b, padded, w, comptime!(rows[3]), OUTPUTS, row, column, LANES);
        let w0 = w[comptime!(rows[3] * LANES) + column];
        let s = tile::slope(&tile::load_block(&a, row, column, LANES));
        let start = sum + comptime!(gradient_rows[2] * CHANNELS);
        outer(&b, padded, &a, OUTPUTS, HIDDEN, partial, start, fresh, row, column, LANES);
        sample_sums(
            &b,
            padded,
            OUTPUTS,
            partial,
            sum + comptime!(gradient_rows[3] * CHANNELS),
            fresh,
            row,
            column,
            LANES,
        );
        sync_cube();
        store_block(&mut a, &tile::times(&g_a, &s), row, column, LANES);
        sync_cube();
        sample_sums(&a, 0usize, HIDDEN, partial, start, false, row, column, LANES);
        sync_cube();
        store_block(&mut a, &tile::weighted(&s, w0), row, column, LANES);
        sync_cube();
        outer(&a, 0usize, &b, HIDDEN, padded, partial, sum, fresh, row, column, LANES);
        sync_cube();
        store_block(&mut a, &tile::softplus_backward(&s, &from_o, &g_a, w0), row, column, LANES);
        geometry_inputs(&mut b, value, x, inv_radius, plane, here, row, column, features);
        sync_cube();
        outer(&a, 0usize, &b, HIDDEN, padded, partial, sum, false, row, column, LANES);
        sample_sums(
            &a,
            0usize,
            HIDDEN,
            partial,
            sum + comptime!(gradient_rows[1] * CHANNELS),
            fresh,
            row,
            column,
            LANES,
        );
        let g_u = product(&a, 0usize, w, comptime!(rows[1]), HIDDEN, row, column, LANES);
        #[unroll]
        for j in 0..4usize {
            let c = 4 * column + j;
            if c < features {
                let i = c * plane + here;
                if comptime!(plan.skip) {
                    g_value[i] += g_u.channel(j);
                } else {
                    g_value[i] = g_u.channel(j);
                }
            }
        }
        sync_cube();
    }
}
