//! Kernels of the signed-distance field: preparation of the weights, the forward pass, and the backward pass of the geometry
//! network.

use super::super::color::{color_forward, color_inputs, unit};
use super::super::tile::{
    self, CHANNELS, LANES, Lane, at, load_planes, outer, output_layer, product, sample_sums, sigmoid,
    store_block, store_planes,
};
use super::Plan;
use crate::kernel::cpu::mlp::{HIDDEN, OUTPUTS, SOFTNESS, TILE};
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

/// Sums the partial gradients of the groups, in the order of the groups. With `mapped`, `map` has the index in the gradients
/// of each float of `flat`.
#[cube(launch)]
pub(in super::super) fn reduce(
    partial: &[f32],
    map: &[u32],
    count: &[u32],
    flat: &mut [f32],
    size: u32,
    #[comptime] tile: usize,
    #[comptime] summing: usize,
    #[comptime] mapped: bool,
) {
    let i = ABSOLUTE_POS;
    if i < flat.len() {
        let mut from = i;
        if mapped {
            from = map[i] as usize;
        }
        let tiles = (count[0] as usize).div_ceil(tile);
        let mut sum = 0.0f32;
        for group in 0..min(tiles, summing) {
            sum += partial[group * size as usize + from];
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
    let group = CUBE_POS;
    let sum = group * comptime!(plan.color.gradients[1] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let samples = tile::uniform_count(count, &mut a);
    for tile in range_stepped(group, samples.div_ceil(TILE), CUBE_COUNT) {
        let lane = tile::lane_of(tile, plane);
        let (row, column, here) = (lane.row, lane.column, lane.here);
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
        load_planes(&mut a, h, &lane);
        sync_cube();
        let g_a = product(&b, 0usize, w, comptime!(rows[0]), padded, row, column, LANES);
        let from_o = product(&b, padded, w, comptime!(rows[3]), OUTPUTS, row, column, LANES);
        let w0 = w[comptime!(rows[3] * LANES) + column];
        let s = tile::slope(&tile::load_block(&a, row, column, LANES));
        let start = sum + comptime!(gradient_rows[2] * CHANNELS);
        outer(&b, padded, &a, OUTPUTS, HIDDEN, partial, start, fresh, row, column, LANES);
        let at_b2 = sum + comptime!(gradient_rows[3] * CHANNELS);
        sample_sums(&b, padded, OUTPUTS, partial, at_b2, fresh, row, column, LANES);
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
        geometry_inputs(&mut b, value, x, inv_radius, &lane, features);
        sync_cube();
        outer(&a, 0usize, &b, HIDDEN, padded, partial, sum, false, row, column, LANES);
        let at_b1 = sum + comptime!(gradient_rows[1] * CHANNELS);
        sample_sums(&a, 0usize, HIDDEN, partial, at_b1, fresh, row, column, LANES);
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
}
