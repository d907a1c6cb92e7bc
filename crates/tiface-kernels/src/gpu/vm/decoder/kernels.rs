//! Kernels of the color decoder: preparation of the weights, forward and backward pass of the
//! layers, and gradients of the weights.

use super::super::super::tile::{
    self, Block, add, add_outer, at, channel_sums, flush_outer, flush_row, output_layer, product,
    relu_backward, store_block, transposed, zero_sums,
};
use super::super::super::weight_norm::finite;
use super::super::grid::{NONE, looked_up, term};
use super::DecoderPlan;
use burn::cubecl::{self, prelude::*};

type F4 = Vector<f32, Const<4>>;

/// Returns `[M, W1_direction]` for hidden channel `h` and input `c`.
#[cube]
fn merged(flat: &[f32], real: &[u32], h: usize, c: usize, #[comptime] plan: DecoderPlan) -> f32 {
    let parts = comptime!(plan.parts());
    let (products, features) = comptime!((4 * plan.products(), plan.features));
    let row = comptime!(parts[1]) + h * comptime!(features + 3);
    let mut sum = 0.0f32;
    if h < comptime!(plan.hidden) {
        if c < products {
            let cpu_channel = real[c];
            if cpu_channel != NONE {
                for f in 0..features {
                    sum += flat[row + f] * flat[f * comptime!(plan.channels) + cpu_channel as usize];
                }
            }
        } else if c < comptime!(products + 3) {
            sum = flat[row + features + c - products];
        }
    }
    sum
}

/// Returns a value of a matrix of `rows` times `columns` that begins at `start`; zero outside of
/// the matrix.
#[cube]
fn zero_padded(
    flat: &[f32],
    #[comptime] start: usize,
    row: usize,
    column: usize,
    #[comptime] rows: usize,
    #[comptime] columns: usize,
) -> f32 {
    let mut v = 0.0f32;
    if row < rows && column < columns {
        v = flat[start + row * columns + column];
    }
    v
}

/// Copies the weights to the orders in which they are read.
#[cube(launch)]
pub(super) fn prepare(flat: &[f32], real: &[u32], out: &mut [f32], #[comptime] plan: DecoderPlan) {
    let i = ABSOLUTE_POS;
    if i < out.len() {
        let rows = comptime!(plan.rows());
        let parts = comptime!(plan.parts());
        let (width, hidden) = comptime!((plan.width(), plan.hidden));
        let (row, column) = (i / width, i % width);
        out[i] = if row < comptime!(rows[1]) {
            merged(flat, real, column, row, plan)
        } else if row < comptime!(rows[2]) {
            zero_padded(flat, comptime!(parts[2]), 0usize, column, 1usize, hidden)
        } else if row < comptime!(rows[3]) {
            zero_padded(flat, comptime!(parts[3]), column, row - comptime!(rows[2]), hidden, hidden)
        } else if row < comptime!(rows[4]) {
            zero_padded(flat, comptime!(parts[4]), 0usize, column, 1usize, hidden)
        } else if row < comptime!(rows[5]) {
            zero_padded(flat, comptime!(parts[5]), row - comptime!(rows[4]), column, 3usize, hidden)
        } else if row < comptime!(rows[6]) {
            zero_padded(flat, comptime!(parts[6]), 0usize, column, 1usize, 3usize)
        } else if row < comptime!(rows[7]) {
            let merged_row = row - comptime!(rows[6]);
            merged(flat, real, merged_row % width, merged_row / width * width + column, plan)
        } else {
            zero_padded(flat, comptime!(parts[3]), row - comptime!(rows[7]), column, hidden, hidden)
        };
    }
}

/// Returns four inputs of a sample: products of a term's channels, or the direction. `k` is the
/// sample's position in the list `index` of samples with a color.
#[cube]
fn input(
    values: &[F4],
    words: &[u32],
    place: &[f32],
    ray: &[u32],
    direction: &[f32],
    index: &[u32],
    k: usize,
    samples: usize,
    quad: usize,
    #[comptime] plan: DecoderPlan,
) -> F4 {
    let mut v = F4::new(0.0f32);
    if k < samples {
        let s = index[k] as usize;
        #[unroll]
        for i in 0..3usize {
            let first = comptime!(plan.quads[..i].iter().sum::<usize>());
            let quads = comptime!(plan.quads[i]);
            if comptime!(quads > 0) && quad >= first && quad < comptime!(first + quads) {
                let t = term(words, place, s, i, quads);
                v = looked_up(values, &t, quad - first, quads);
            }
        }
        if quad == comptime!(plan.products()) {
            let r = ray[s] as usize;
            let rays = direction.len() / 3;
            v.insert(0usize, direction[r]);
            v.insert(1usize, direction[rays + r]);
            v.insert(2usize, direction[2 * rays + r]);
        }
    }
    v
}

/// Returns the number of inputs in piece `p`, which fills a tile or is the last one.
#[cube]
fn piece_inputs(p: usize, #[comptime] plan: DecoderPlan) -> usize {
    min(comptime!(plan.inputs()) - p * comptime!(plan.width()), comptime!(plan.width()))
}

/// Fills a tile with one piece of the inputs of the samples of tile number `tile`.
#[cube]
fn inputs(
    a: &mut [F4],
    values: &[F4],
    words: &[u32],
    place: &[f32],
    ray: &[u32],
    direction: &[f32],
    index: &[u32],
    tile: usize,
    samples: usize,
    row: usize,
    column: usize,
    piece: usize,
    #[comptime] plan: DecoderPlan,
) {
    let lanes = comptime!(plan.lanes);
    let quad = piece * comptime!(tile::columns(lanes)) + column;
    if quad < comptime!(plan.inputs() / 4) {
        let k = 4 * (tile * lanes + row);
        let block = Block::new(
            input(values, words, place, ray, direction, index, k, samples, quad, plan),
            input(values, words, place, ray, direction, index, k + 1, samples, quad, plan),
            input(values, words, place, ray, direction, index, k + 2, samples, quad, plan),
            input(values, words, place, ray, direction, index, k + 3, samples, quad, plan),
        );
        store_block(a, &transposed(&block), row, column, lanes);
    }
}

/// Returns channel `j` of a bias in all components of a vector.
#[cube]
fn broadcast(bias: F4, #[comptime] j: usize) -> F4 {
    F4::new(bias.extract(j))
}

/// Returns a thread's block of the first hidden layer. Tile `a` is scratch memory, free afterwards.
#[cube]
fn first_layer(
    a: &mut [F4],
    w: &[F4],
    values: &[F4],
    words: &[u32],
    place: &[f32],
    ray: &[u32],
    direction: &[f32],
    index: &[u32],
    tile: usize,
    samples: usize,
    row: usize,
    column: usize,
    #[comptime] plan: DecoderPlan,
) -> Block {
    let lanes = comptime!(plan.lanes);
    let rows = comptime!(plan.rows());
    let bias = w[comptime!(rows[1] * tile::columns(lanes)) + column];
    // a loop of the kernel, like the other one over pieces: unrolled, the interpolation is compiled
    // once for each piece, which takes software drivers a minute
    let mut c0 = broadcast(bias, 0usize);
    let mut c1 = broadcast(bias, 1usize);
    let mut c2 = broadcast(bias, 2usize);
    let mut c3 = broadcast(bias, 3usize);
    for p in 0..comptime!(plan.pieces()) {
        inputs(a, values, words, place, ray, direction, index, tile, samples, row, column, p, plan);
        sync_cube();
        let z =
            product(&*a, 0usize, w, p * comptime!(plan.width()), piece_inputs(p, plan), row, column, lanes);
        c0 += z.channel(0usize);
        c1 += z.channel(1usize);
        c2 += z.channel(2usize);
        c3 += z.channel(3usize);
        sync_cube();
    }
    tile::relu(&Block::new(c0, c1, c2, c3))
}

/// Returns a thread's block of the second hidden layer, computed from the first one in tile `b`.
#[cube]
fn second_layer(b: &[F4], w: &[F4], row: usize, column: usize, #[comptime] plan: DecoderPlan) -> Block {
    let lanes = comptime!(plan.lanes);
    let rows = comptime!(plan.rows());
    let bias = w[comptime!(rows[3] * tile::columns(lanes)) + column];
    let z = product(b, 0usize, w, comptime!(rows[2]), comptime!(plan.hidden), row, column, lanes);
    tile::relu(&Block::new(
        z.channel(0usize) + broadcast(bias, 0usize),
        z.channel(1usize) + broadcast(bias, 1usize),
        z.channel(2usize) + broadcast(bias, 2usize),
        z.channel(3usize) + broadcast(bias, 3usize),
    ))
}

/// Computes both hidden layers of a tile of samples: the first one in tile `b`, the second one in
/// `a`.
#[cube]
fn hidden_layers(
    a: &mut [F4],
    b: &mut [F4],
    w: &[F4],
    values: &[F4],
    words: &[u32],
    place: &[f32],
    ray: &[u32],
    direction: &[f32],
    index: &[u32],
    tile: usize,
    samples: usize,
    row: usize,
    column: usize,
    #[comptime] plan: DecoderPlan,
) {
    let lanes = comptime!(plan.lanes);
    let h1 = first_layer(a, w, values, words, place, ray, direction, index, tile, samples, row, column, plan);
    store_block(b, &h1, row, column, lanes);
    sync_cube();
    let h2 = second_layer(&*b, w, row, column, plan);
    store_block(a, &h2, row, column, lanes);
    sync_cube();
}

/// Writes colors, planes `[3, capacity]`.
#[cube(launch_unchecked)]
pub(super) fn forward(
    w: &[F4],
    values: &[F4],
    words: &[u32],
    place: &[f32],
    ray: &[u32],
    direction: &[f32],
    index: &[u32],
    count: &[u32],
    rgb: &mut [F4],
    #[comptime] plan: DecoderPlan,
) {
    let (lanes, width) = comptime!((plan.lanes, plan.width()));
    let rows = comptime!(plan.rows());
    let columns = comptime!(tile::columns(lanes));
    let (row, column) = (UNIT_POS as usize / columns, UNIT_POS as usize % columns);
    let mut a = Shared::<[F4]>::new_slice(comptime!(width * lanes));
    let mut b = Shared::<[F4]>::new_slice(comptime!(width * lanes));
    let samples = tile::uniform_count(count, &mut a);
    for tile in range_stepped(CUBE_POS, samples.div_ceil(comptime!(4 * lanes)), CUBE_COUNT) {
        hidden_layers(
            &mut a, &mut b, w, values, words, place, ray, direction, index, tile, samples, row, column, plan,
        );
        let v = output_layer(&a, w, comptime!(rows[4]), row, column, 3usize, lanes);
        if column < 3 {
            let bias = w[comptime!(rows[5] * columns)];
            let channel_bias = select(column == 0, bias.extract(0usize), bias.extract(1usize));
            let channel_bias = select(column == 2, bias.extract(2usize), channel_bias);
            rgb[column * (rgb.len() / 3) + tile * lanes + row] = tile::sigmoid(v + F4::new(channel_bias));
        }
        sync_cube();
    }
}

/// Returns the gradient with respect to the input of the sigmoid of color channel `o`, for four
/// samples; zero after the last sample.
#[cube]
fn g_color(g_pre: &[F4], o: usize, here: usize, samples: usize) -> F4 {
    let mut v = g_pre[o * (g_pre.len() / 3) + here];
    #[unroll]
    for i in 0..4usize {
        if 4 * here + i >= samples {
            v.insert(i, 0.0f32);
        }
    }
    v
}

/// Returns channel `j` of the gradient with respect to the second hidden layer.
#[cube]
fn from_colors(g0: F4, g1: F4, g2: F4, w0: F4, w1: F4, w2: F4, #[comptime] j: usize) -> F4 {
    g0 * broadcast(w0, j) + g1 * broadcast(w1, j) + g2 * broadcast(w2, j)
}

/// Writes the gradients with respect to products of samples `from..from + limit`,
/// `[limit, channels]`, and adds a group's sums of those with respect to the weights to its part of
/// `partial`, or overwrites it with those of the first samples.
#[cube(launch_unchecked)]
pub(super) fn backward(
    w: &[F4],
    values: &[F4],
    words: &[u32],
    place: &[f32],
    ray: &[u32],
    direction: &[f32],
    index: &[u32],
    count: &[u32],
    g_pre: &[F4],
    g_products: &mut [F4],
    partial: &mut [f32],
    from: u32,
    limit: u32,
    #[comptime] plan: DecoderPlan,
) {
    let (lanes, width, hidden) = comptime!((plan.lanes, plan.width(), plan.hidden));
    let (rows, gradient_rows) = comptime!((plan.rows(), plan.gradients()));
    let columns = comptime!(tile::columns(lanes));
    let (row, column) = (UNIT_POS as usize / columns, UNIT_POS as usize % columns);
    let sum = CUBE_POS * comptime!(gradient_rows[6] * width);
    // what a thread owns of W2 and of each piece of [M, W1_direction]
    let (own, pieces) = comptime!((hidden.div_ceil(lanes), plan.pieces()));
    let mut a = Shared::<[F4]>::new_slice(comptime!(width * lanes));
    let mut b = Shared::<[F4]>::new_slice(comptime!(width * lanes));
    let samples = tile::uniform_count(count, &mut a);
    let start = from as usize / comptime!(4 * lanes);
    let end = min(samples, from as usize + limit as usize).div_ceil(comptime!(4 * lanes));
    let c = UNIT_POS as usize;
    // the thread's sums of the gradients of W2 and then of the pieces; of b1, b2, W3 and b3
    let mut sums = zero_sums(comptime!((1 + pieces) * own));
    let mut b1 = F4::new(0.0f32);
    let mut b2 = F4::new(0.0f32);
    let mut w3 = F4::new(0.0f32);
    let mut b3 = 0.0f32;
    for tile in range_stepped(start + CUBE_POS, end, CUBE_COUNT) {
        let here = tile * lanes + row;
        hidden_layers(
            &mut a, &mut b, w, values, words, place, ray, direction, index, tile, samples, row, column, plan,
        );
        if c < hidden {
            let mut of_w3 = F4::new(0.0f32);
            #[unroll]
            for o in 0..3usize {
                let mut s = 0.0f32;
                for r in 0..lanes {
                    s += a[at(c, r, lanes)].dot(g_color(g_pre, o, tile * lanes + r, samples));
                }
                of_w3.insert(o, s);
            }
            w3 += of_w3;
        }
        if c < 3 {
            let mut s = F4::new(0.0f32);
            for r in 0..lanes {
                s += g_color(g_pre, c, tile * lanes + r, samples);
            }
            b3 += tile::total(s);
        }
        let g0 = g_color(g_pre, 0usize, here, samples);
        let g1 = g_color(g_pre, 1usize, here, samples);
        let g2 = g_color(g_pre, 2usize, here, samples);
        let w0 = w[comptime!(rows[4] * columns) + column];
        let w1 = w[comptime!((rows[4] + 1) * columns) + column];
        let w2 = w[comptime!((rows[4] + 2) * columns) + column];
        let g_h2 = Block::new(
            from_colors(g0, g1, g2, w0, w1, w2, 0usize),
            from_colors(g0, g1, g2, w0, w1, w2, 1usize),
            from_colors(g0, g1, g2, w0, w1, w2, 2usize),
            from_colors(g0, g1, g2, w0, w1, w2, 3usize),
        );
        let g_z2 = relu_backward(&g_h2, &a, row, column, lanes);
        sync_cube();
        store_block(&mut a, &g_z2, row, column, lanes);
        sync_cube();
        add_outer(&mut sums, 0usize, own, &a, &b, row, column, lanes);
        b2 += channel_sums(&a, row, column, lanes);
        let g_h1 = product(&a, 0usize, w, comptime!(rows[7]), hidden, row, column, lanes);
        let g_z1 = relu_backward(&g_h1, &b, row, column, lanes);
        sync_cube();
        store_block(&mut b, &g_z1, row, column, lanes);
        sync_cube();
        b1 += channel_sums(&b, row, column, lanes);
        for p in 0..pieces {
            inputs(&mut a, values, words, place, ray, direction, index, tile, samples, row, column, p, plan);
            sync_cube();
            #[unroll]
            for j in 0..pieces {
                if p == j {
                    add_outer(&mut sums, comptime!((1 + j) * own), own, &b, &a, row, column, lanes);
                }
            }
            let (quad, products) = (p * columns + column, comptime!(plan.products()));
            if p * columns < products {
                let from_m = comptime!(rows[6]) + p * width;
                let g = transposed(&product(&b, 0usize, w, from_m, hidden, row, column, lanes));
                if quad < products {
                    let k = (4 * here - from as usize) * products + quad;
                    #[unroll]
                    for j in 0..4usize {
                        g_products[k + j * products] = g.channel(j);
                    }
                }
            }
            sync_cube();
        }
    }
    if start + CUBE_POS < end {
        let fresh = from == 0;
        #[unroll]
        for j in 0..pieces {
            let at_m = sum + comptime!(j * width * width);
            flush_outer(partial, at_m, &sums, comptime!((1 + j) * own), own, fresh, row, column, lanes);
        }
        let at_w2 = sum + comptime!(gradient_rows[2] * width);
        flush_outer(partial, at_w2, &sums, 0usize, own, fresh, row, column, lanes);
        if row == 0 {
            flush_row(partial, sum + comptime!(gradient_rows[1] * width), b1, fresh, column, lanes);
            flush_row(partial, sum + comptime!(gradient_rows[3] * width), b2, fresh, column, lanes);
        }
        if c < hidden {
            #[unroll]
            for o in 0..3usize {
                add(partial, sum + comptime!((gradient_rows[4] + o) * width) + c, w3.extract(o), fresh);
            }
        }
        if c < 3 {
            add(partial, sum + comptime!(gradient_rows[5] * width) + c, b3, fresh);
        }
    }
}

/// Returns the gradient with respect to `[M, W1_direction]` for hidden channel `h` and input `c`.
#[cube]
fn g_merged(summed: &[f32], h: usize, c: usize, #[comptime] width: usize) -> f32 {
    summed[(c / width * width + h) * width + c % width]
}

/// Writes the gradients with respect to the flat weights, by the chain rule through `M`.
#[cube(launch)]
pub(super) fn chain(
    flat: &[f32],
    real: &[u32],
    padded: &[u32],
    summed: &[f32],
    g_flat: &mut [f32],
    non_finite: &mut [u32],
    #[comptime] plan: DecoderPlan,
) {
    let i = ABSOLUTE_POS;
    if i < g_flat.len() {
        let (parts, gradient_rows) = comptime!((plan.parts(), plan.gradients()));
        let (width, hidden, features) = comptime!((plan.width(), plan.hidden, plan.features));
        let (channels, products) = comptime!((plan.channels, 4 * plan.products()));
        let inputs = comptime!(features + 3);
        let mut g = 0.0f32;
        if i < comptime!(parts[1]) {
            let (f, c) = (i / channels, padded[i % channels] as usize);
            for h in 0..hidden {
                g += flat[comptime!(parts[1]) + h * inputs + f] * g_merged(summed, h, c, width);
            }
        } else if i < comptime!(parts[2]) {
            let (h, f) = ((i - comptime!(parts[1])) / inputs, (i - comptime!(parts[1])) % inputs);
            if f < features {
                for c in 0..products {
                    if real[c] != NONE {
                        g += flat[f * channels + real[c] as usize] * g_merged(summed, h, c, width);
                    }
                }
            } else {
                g = g_merged(summed, h, products + f - features, width);
            }
        } else if i < comptime!(parts[3]) {
            g = summed[comptime!(gradient_rows[1] * width) + i - comptime!(parts[2])];
        } else if i < comptime!(parts[4]) {
            let k = i - comptime!(parts[3]);
            g = summed[(comptime!(gradient_rows[2]) + k / hidden) * width + k % hidden];
        } else if i < comptime!(parts[5]) {
            g = summed[comptime!(gradient_rows[3] * width) + i - comptime!(parts[4])];
        } else if i < comptime!(parts[6]) {
            let k = i - comptime!(parts[5]);
            g = summed[(comptime!(gradient_rows[4]) + k / hidden) * width + k % hidden];
        } else {
            g = summed[comptime!(gradient_rows[5] * width) + i - comptime!(parts[6])];
        }
        g_flat[i] = g;
        // all threads that write, write the same value
        if !finite(g) {
            non_finite[0] = 1;
        }
    }
}
