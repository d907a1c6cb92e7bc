//! Kernels of the signed-distance field: preparation of the weights, the forward pass, and the
//! backward pass of the geometry network.

use super::super::color::{color_forward, color_inputs, unit};
use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::tile::{
    self, Block, CHANNELS, LANES, Lane, UNITS, at, channel_sums, load_planes, outer_block, outer_row,
    output_layer, product, sigmoid, store_block, store_outer, store_planes, store_row,
};
use super::SdfPlan;
use crate::cpu::mlp::{HIDDEN, OUTPUTS, SOFTNESS, TILE};
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

/// Number of groups whose partial gradients one thread adds, one after the other.
const SLICE: usize = 32;

/// Returns the number of groups that have partial gradients of `count` samples.
#[cube]
fn summed_groups(count: &[u32], tile: u32, summing: u32) -> usize {
    min((count[0] as usize).div_ceil(tile as usize), summing as usize)
}

/// Sums the partial gradients of each slice of groups, in the order of the groups, into those of
/// the slice's first group. Slices lie in the second dimension of the launch.
#[cube(launch)]
fn sum_slices(partial: &mut [f32], count: &[u32], size: u32, tile: u32, summing: u32) {
    let i = ABSOLUTE_POS_X as usize;
    let first = CUBE_POS_Y as usize * SLICE;
    let end = min(first + SLICE, summed_groups(count, tile, summing));
    if i < size as usize && first < end {
        let mut sum = 0.0f32;
        for group in first..end {
            sum += partial[group * size as usize + i];
        }
        partial[first * size as usize + i] = sum;
    }
}

/// Sums the slices, in their order. With `mapped`, `map` has the index in the gradients of each
/// float of `flat`.
#[cube(launch)]
fn reduce(
    partial: &[f32],
    map: &[u32],
    count: &[u32],
    flat: &mut [f32],
    size: u32,
    tile: u32,
    summing: u32,
    #[comptime] mapped: bool,
) {
    let i = ABSOLUTE_POS;
    if i < flat.len() {
        let mut from = i;
        if mapped {
            from = map[i] as usize;
        }
        let mut sum = 0.0f32;
        for slice in 0..summed_groups(count, tile, summing).div_ceil(SLICE) {
            sum += partial[slice * SLICE * size as usize + from];
        }
        flat[i] = sum;
    }
}

/// Writes the sums over groups of their partial gradients, in a fixed order: `size` floats of each
/// of `summing` groups, which take a `tile` of samples at a time. `map` has the index in the
/// gradients of each float of `flat`; without it they are the same. Overwrites the partial
/// gradients.
pub(in super::super) fn sum_groups(
    device: &Device,
    partial: &Buffer,
    map: Option<&Buffer>,
    count: &Buffer,
    flat: &Buffer,
    (size, tile, summing): (usize, usize, usize),
) {
    let over = |floats: usize| floats.div_ceil(UNITS as usize);
    let slices = CubeCount::Static(over(size) as u32, summing.div_ceil(SLICE) as u32, 1);
    // not known to the compiler, which would compile both kernels again for every capacity
    let (size, tile, summing) = (size as u32, tile as u32, summing as u32);
    launch!(device, sum_slices::launch, slices, UNITS; partial, count; size, tile, summing);
    launch!(device, reduce::launch, groups(over(flat.word_count())), UNITS;
        partial, map.unwrap_or(count), count, flat; size, tile, summing, map.is_some()
    );
}

/// Writes the inputs of the geometry network to a tile.
#[cube]
fn geometry_inputs(
    a: &mut [F4],
    value: &[F4],
    x: &[F4],
    inv_radius: f32,
    lane: &Lane,
    #[comptime] features: usize,
) {
    for j in 0..4usize {
        let c = lane.column + 16 * j;
        let mut v = F4::new(0.0f32);
        if c < features {
            v = value[c * lane.plane + lane.here];
        } else if c < features + 3 {
            v = x[(c - features) * lane.plane + lane.here] * F4::new(inv_radius);
        }
        a[at(c, lane.row, LANES)] = v;
    }
}

/// Writes sdf, ∇sdf, color and local sharpness, planes `[8, capacity]`, and the activations that
/// the backward pass needs. If `given` is set, `normals` replace ∇sdf.
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
    #[comptime] plan: SdfPlan,
    #[comptime] given: bool,
) {
    let rows = comptime!(plan.rows());
    let features = comptime!(plan.features);
    let plane = x.len() / 3;
    let color = comptime!(plan.color);
    let tile = CUBE_POS;
    let lane = tile::lane_of(tile, plane);
    let (row, column, here) = (lane.row, lane.column, lane.here);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = tile::uniform_count(count, &mut a);
    if tile * TILE < samples {
        geometry_inputs(&mut a, value, x, inv_radius, &lane, features);
        sync_cube();
        let z = product(&a, 0usize, w, comptime!(rows[0]), comptime!(plan.padded), row, column, LANES);
        let active = tile::activate(&z, w[comptime!(rows[2] * LANES) + column]);
        store_planes(h, &active.h, &lane, HIDDEN);
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
        store_planes(q, &own_q, &lane, features);
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
        let normal = unit(nx, ny, nz);
        color_inputs(&mut a, output, &normal, direction, value, &lane, color);
        if column == 0 {
            out[here] = output;
        }
        if column == SOFTNESS {
            out[7 * plane + here] = sigmoid(output - F4::new(2.0f32)) * F4::new(-soften);
        }
        sync_cube();
        color_forward(&mut a, &mut b, w, c1, c2, out, &lane, color);
    }
}

/// Backward pass of the geometry network, with first and second order. Writes the gradients with
/// respect to the features of each sample, and partial sums by group of those with respect to the
/// weights.
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
    #[comptime] plan: SdfPlan,
) {
    let rows = comptime!(plan.rows());
    let gradient_rows = comptime!(plan.gradients());
    let features = comptime!(plan.features);
    let padded = comptime!(plan.padded);
    let plane = x.len() / 3;
    let group = CUBE_POS;
    let sum = group * comptime!(plan.color.gradients[1] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = tile::uniform_count(count, &mut a);
    // the thread's sums of the gradients of W1, W2, b1 and b2
    let mut w1_0 = F4::new(0.0f32);
    let mut w1_1 = F4::new(0.0f32);
    let mut w1_2 = F4::new(0.0f32);
    let mut w1_3 = F4::new(0.0f32);
    let mut w2 = F4::new(0.0f32);
    let mut b1 = F4::new(0.0f32);
    let mut b2 = 0.0f32;
    for tile in range_stepped(group, samples.div_ceil(TILE), CUBE_COUNT) {
        let lane = tile::lane_of(tile, plane);
        let (row, column, here) = (lane.row, lane.column, lane.here);
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
        load_planes(&mut a, h, &lane);
        sync_cube();
        let g_a = product(&b, 0usize, w, comptime!(rows[0]), padded, row, column, LANES);
        let from_o = product(&b, padded, w, comptime!(rows[3]), OUTPUTS, row, column, LANES);
        let w0 = w[comptime!(rows[3] * LANES) + column];
        let s = tile::slope(&tile::load_block(&a, row, column, LANES));
        if row < OUTPUTS {
            w2 += outer_row(&b, padded + row, &a, column, LANES);
        }
        if row == 0 && column < OUTPUTS {
            let mut of_output = F4::new(0.0f32);
            for r in 0..LANES {
                of_output += b[at(padded + column, r, LANES)];
            }
            b2 += tile::total(of_output);
        }
        sync_cube();
        store_block(&mut a, &tile::times(&g_a, &s), row, column, LANES);
        sync_cube();
        // the first output is the distance, whose row of W2 has a second-order part; threads of the
        // first row have it
        w2 += channel_sums(&a, row, column, LANES);
        sync_cube();
        store_block(&mut a, &tile::weighted(&s, w0), row, column, LANES);
        sync_cube();
        let second_order = outer_block(&a, &b, row, column);
        w1_0 += second_order.channel(0usize);
        w1_1 += second_order.channel(1usize);
        w1_2 += second_order.channel(2usize);
        w1_3 += second_order.channel(3usize);
        sync_cube();
        store_block(&mut a, &tile::softplus_backward(&s, &from_o, &g_a, w0), row, column, LANES);
        geometry_inputs(&mut b, value, x, inv_radius, &lane, features);
        sync_cube();
        let first_order = outer_block(&a, &b, row, column);
        w1_0 += first_order.channel(0usize);
        w1_1 += first_order.channel(1usize);
        w1_2 += first_order.channel(2usize);
        w1_3 += first_order.channel(3usize);
        b1 += channel_sums(&a, row, column, LANES);
        let g_u = product(&a, 0usize, w, comptime!(rows[1]), HIDDEN, row, column, LANES);
        #[unroll]
        for j in 0..4usize {
            let c = 4 * column + j;
            if c < features {
                let i = c * plane + here;
                if comptime!(plan.color.features > 0) {
                    g_value[i] += g_u.channel(j);
                } else {
                    g_value[i] = g_u.channel(j);
                }
            }
        }
        sync_cube();
    }
    if group < samples.div_ceil(TILE) {
        let lane = tile::lane_of(group, plane);
        let (row, column) = (lane.row, lane.column);
        let sums = Block::new(w1_0, w1_1, w1_2, w1_3);
        store_outer(partial, sum, &sums, padded, row, column);
        if row < OUTPUTS {
            store_row(partial, sum + (comptime!(gradient_rows[2]) + row) * CHANNELS, w2, HIDDEN, column);
        }
        if row == 0 {
            store_row(partial, sum + comptime!(gradient_rows[1] * CHANNELS), b1, HIDDEN, column);
            if column < OUTPUTS {
                partial[sum + comptime!(gradient_rows[3] * CHANNELS) + column] = b2;
            }
        }
    }
}
