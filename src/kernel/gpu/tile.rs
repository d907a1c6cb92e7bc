//! Products of tiles in workgroup memory, by 256 threads.
//!
//! Four samples are a vector, and a tile is so many `lanes` of vectors times [`channels`] of them: 64 samples times 64
//! channels, or 32 times 128. Thread `(row, column)` owns vector `row` of channels `4 column .. 4 column + 4`: a
//! [`Block`]. Weights lie in rows of as many floats as a tile has channels, `[inputs, channels]`.

use burn::cubecl::{self, prelude::*};

type F4 = Vector<f32, Const<4>>;

/// Channels of a tile of [`LANES`].
pub const CHANNELS: usize = channels(LANES);
/// Vectors of a channel in a tile of 64 samples.
pub const LANES: usize = 16;
/// Threads that share a tile.
pub const UNITS: u32 = 256;

/// Threads that share a row, and vectors in a row of weights.
pub const fn columns(lanes: usize) -> usize {
    UNITS as usize / lanes
}

/// Channels of a tile.
pub const fn channels(lanes: usize) -> usize {
    4 * columns(lanes)
}

/// Where a channel's vector lies: neighboring channels in different banks, read along channels or along samples.
#[cube]
pub fn at(channel: usize, row: usize, #[comptime] lanes: usize) -> usize {
    channel * lanes + (row ^ (channel % lanes))
}

/// The first word of `count`, through a tile that nothing lies in yet. All threads read it there behind a barrier: FXC,
/// the older compiler of DX12, refuses barriers in loops and branches whose condition it reads from a buffer. Tiles
/// take all the memory that a group has on some adapters, so the word is two whole numbers in floats.
#[cube]
pub fn uniform_count(count: &[u32], tile: &mut [F4]) -> usize {
    if UNIT_POS == 0 {
        let n = count[0];
        let mut halves = F4::new(0.0f32);
        halves.insert(0usize, f32::cast_from(n >> 16u32));
        halves.insert(1usize, f32::cast_from(n & 65_535u32));
        tile[0] = halves;
    }
    sync_cube();
    let halves = tile[0];
    sync_cube();
    let n = (u32::cast_from(halves.extract(0usize)) << 16u32) | u32::cast_from(halves.extract(1usize));
    n as usize
}

/// Four channels of a thread's vector of samples.
#[derive(CubeType, Clone, Copy)]
pub struct Block {
    c0: F4,
    c1: F4,
    c2: F4,
    c3: F4,
}

#[cube]
impl Block {
    /// Of four channels' vectors.
    pub fn of(c0: F4, c1: F4, c2: F4, c3: F4) -> Block {
        Block { c0, c1, c2, c3 }
    }

    /// One channel.
    pub fn channel(&self, #[comptime] j: usize) -> F4 {
        match j {
            0 => self.c0,
            1 => self.c1,
            2 => self.c2,
            _ => self.c3,
        }
    }
}

/// `Σ_k a[first + k] · w[k]` over `k` channels.
#[cube]
pub fn product(
    a: &[F4],
    #[comptime] first: usize,
    w: &[F4],
    #[comptime] from: usize,
    #[comptime] k: usize,
    row: usize,
    column: usize,
    #[comptime] lanes: usize,
) -> Block {
    let mut c0 = F4::new(0.0f32);
    let mut c1 = F4::new(0.0f32);
    let mut c2 = F4::new(0.0f32);
    let mut c3 = F4::new(0.0f32);
    for p in 0..k {
        let v = a[at(first + p, row, lanes)];
        let m = w[(from + p) * comptime!(columns(lanes)) + column];
        c0 += v * F4::new(m.extract(0usize));
        c1 += v * F4::new(m.extract(1usize));
        c2 += v * F4::new(m.extract(2usize));
        c3 += v * F4::new(m.extract(3usize));
    }
    Block::of(c0, c1, c2, c3)
}

/// Output `column` of a layer of few outputs from all channels; its weights are `[outputs, channels]`. Beyond the last,
/// zero.
#[cube]
pub fn narrow(
    a: &[F4],
    w: &[F4],
    #[comptime] from: usize,
    row: usize,
    column: usize,
    #[comptime] outputs: usize,
    #[comptime] lanes: usize,
) -> F4 {
    let mut sum = F4::new(0.0f32);
    if column < outputs {
        for p in 0..comptime!(columns(lanes)) {
            let m = w[(from + column) * comptime!(columns(lanes)) + p];
            #[unroll]
            for j in 0..4usize {
                sum += a[at(4 * p + j, row, lanes)] * F4::new(m.extract(j));
            }
        }
    }
    sum
}

/// Four vectors, one of each of four samples' four channels, as channels' vectors of samples; and back.
#[cube]
pub fn turned(b: &Block) -> Block {
    Block::of(across(b, 0usize), across(b, 1usize), across(b, 2usize), across(b, 3usize))
}

#[cube]
fn across(b: &Block, #[comptime] k: usize) -> F4 {
    let mut v = F4::new(b.c0.extract(k));
    v.insert(1usize, b.c1.extract(k));
    v.insert(2usize, b.c2.extract(k));
    v.insert(3usize, b.c3.extract(k));
    v
}

/// Writes a thread's block to a tile.
#[cube]
pub fn put(a: &mut [F4], block: &Block, row: usize, column: usize, #[comptime] lanes: usize) {
    #[unroll]
    for j in 0..4usize {
        a[at(4 * column + j, row, lanes)] = block.channel(j);
    }
}

/// A thread's block of a tile.
#[cube]
pub fn take(a: &[F4], row: usize, column: usize, #[comptime] lanes: usize) -> Block {
    let c = 4 * column;
    Block::of(
        a[at(c, row, lanes)],
        a[at(c + 1, row, lanes)],
        a[at(c + 2, row, lanes)],
        a[at(c + 3, row, lanes)],
    )
}

/// Writes a thread's block to planes, its channels below `end`.
#[cube]
pub fn save(to: &mut [F4], block: &Block, plane: usize, here: usize, column: usize, #[comptime] end: usize) {
    #[unroll]
    for j in 0..4usize {
        let c = 4 * column + j;
        if c < end {
            to[c * plane + here] = block.channel(j);
        }
    }
}

/// Fills a tile from 64 planes.
#[cube]
pub fn load(a: &mut [F4], from: &[F4], plane: usize, here: usize, row: usize, column: usize) {
    for j in 0..4usize {
        let c = column + 16 * j;
        a[at(c, row, LANES)] = from[c * plane + here];
    }
}

/// Adds to a matrix of gradients, in rows of all channels, `Σ_samples a[first + i] · b[j]`, `i < m` and `j < n`; the first time
/// writes it.
#[cube]
pub fn outer(
    a: &[F4],
    #[comptime] first: usize,
    b: &[F4],
    #[comptime] m: usize,
    #[comptime] n: usize,
    gradient: &mut [f32],
    start: usize,
    fresh: bool,
    row: usize,
    column: usize,
    #[comptime] lanes: usize,
) {
    let columns = comptime!(columns(lanes));
    for ii in 0..comptime!(m.div_ceil(lanes)) {
        let i = row + lanes * ii;
        if i < m {
            let mut s0 = 0.0f32;
            let mut s1 = 0.0f32;
            let mut s2 = 0.0f32;
            let mut s3 = 0.0f32;
            for r in 0..lanes {
                let v = a[at(first + i, r, lanes)];
                s0 += v.dot(b[at(column, r, lanes)]);
                s1 += v.dot(b[at(column + columns, r, lanes)]);
                s2 += v.dot(b[at(column + 2 * columns, r, lanes)]);
                s3 += v.dot(b[at(column + 3 * columns, r, lanes)]);
            }
            let here = start + i * comptime!(channels(lanes)) + column;
            add(gradient, here, s0, fresh);
            if comptime!(n > columns) {
                add(gradient, here + columns, s1, fresh);
            }
            if comptime!(n > 2 * columns) {
                add(gradient, here + 2 * columns, s2, fresh);
            }
            if comptime!(n > 3 * columns) {
                add(gradient, here + 3 * columns, s3, fresh);
            }
        }
    }
}

/// Adds `Σ_samples a[first + j]`, `j < n`, to a row of gradients; by the threads that own the first row of [`outer`].
#[cube]
pub fn sums(
    a: &[F4],
    #[comptime] first: usize,
    #[comptime] n: usize,
    gradient: &mut [f32],
    start: usize,
    fresh: bool,
    row: usize,
    column: usize,
    #[comptime] lanes: usize,
) {
    if row == 0 {
        let columns = comptime!(columns(lanes));
        for jj in 0..comptime!(n.div_ceil(columns)) {
            let j = column + columns * jj;
            if j < n {
                let mut sum = F4::new(0.0f32);
                for r in 0..lanes {
                    sum += a[at(first + j, r, lanes)];
                }
                let all =
                    sum.extract(0usize) + sum.extract(1usize) + (sum.extract(2usize) + sum.extract(3usize));
                add(gradient, start + j, all, fresh);
            }
        }
    }
}

#[cube]
fn add(gradient: &mut [f32], i: usize, v: f32, fresh: bool) {
    gradient[i] = if fresh { v } else { gradient[i] + v };
}

/// 1 / (1 + e⁻ˣ).
#[cube]
pub fn sigmoid(v: F4) -> F4 {
    let one = F4::new(1.0f32);
    one / (one + (-v).exp())
}

/// `max(v, 0)`.
#[cube]
fn positive(v: F4) -> F4 {
    max(v, F4::new(0.0f32))
}

/// `max(v, 0)` of each.
#[cube]
pub fn relu(b: &Block) -> Block {
    Block::of(positive(b.c0), positive(b.c1), positive(b.c2), positive(b.c3))
}

/// `g` where the tile's own channels are above zero.
#[cube]
pub fn gate(g: &Block, a: &[F4], row: usize, column: usize, #[comptime] lanes: usize) -> Block {
    let v = take(a, row, column, lanes);
    Block::of(gated(g.c0, v.c0), gated(g.c1, v.c1), gated(g.c2, v.c2), gated(g.c3, v.c3))
}

#[cube]
fn gated(g: F4, v: F4) -> F4 {
    let zero = F4::new(0.0f32);
    select_many(v.greater_than(&zero), g, zero)
}

/// Product of two blocks, channel by channel.
#[cube]
pub fn times(a: &Block, b: &Block) -> Block {
    Block::of(a.c0 * b.c0, a.c1 * b.c1, a.c2 * b.c2, a.c3 * b.c3)
}

/// A block times one weight per channel.
#[cube]
pub fn weighted(a: &Block, w: F4) -> Block {
    let w = Block::of(
        F4::new(w.extract(0usize)),
        F4::new(w.extract(1usize)),
        F4::new(w.extract(2usize)),
        F4::new(w.extract(3usize)),
    );
    times(a, &w)
}

/// `softplus₁₀₀` and its slope.
#[derive(CubeType)]
pub struct Active {
    pub h: Block,
    pub s: Block,
}

/// h = softplus(z + b), s = sigmoid(100 (z + b)), as the CPU takes them.
#[cube]
pub fn activate(z: &Block, bias: F4) -> Active {
    let a0 = activated(z.c0, bias.extract(0usize));
    let a1 = activated(z.c1, bias.extract(1usize));
    let a2 = activated(z.c2, bias.extract(2usize));
    let a3 = activated(z.c3, bias.extract(3usize));
    Active { h: Block::of(a0.h, a1.h, a2.h, a3.h), s: Block::of(a0.s, a1.s, a2.s, a3.s) }
}

#[derive(CubeType)]
struct ActiveChannel {
    h: F4,
    s: F4,
}

#[cube]
fn activated(z: F4, bias: f32) -> ActiveChannel {
    let (zero, one) = (F4::new(0.0f32), F4::new(1.0f32));
    let v = z + F4::new(bias);
    let e = (-(v * F4::new(100.0f32)).abs()).exp();
    let inverse = one / (one + e);
    let s = select_many(v.greater_equal(&zero), inverse, e * inverse);
    // ln(1 + e) = 2 artanh(e / (2 + e))
    let t = e / (F4::new(2.0f32) + e);
    let t2 = t * t;
    let p = t2 * F4::new(1.0f32 / 13.0f32) + F4::new(1.0f32 / 11.0f32);
    let p = t2 * p + F4::new(1.0f32 / 9.0f32);
    let p = t2 * p + F4::new(1.0f32 / 7.0f32);
    let p = t2 * p + F4::new(1.0f32 / 5.0f32);
    let p = t2 * p + F4::new(1.0f32 / 3.0f32);
    let p = t2 * p + one;
    ActiveChannel { h: max(v, zero) + t * p * F4::new(0.02f32), s }
}

/// s of h: `1 − e^{−100 h}`.
#[cube]
pub fn slope(h: &Block) -> Block {
    Block::of(sloped(h.c0), sloped(h.c1), sloped(h.c2), sloped(h.c3))
}

#[cube]
fn sloped(h: F4) -> F4 {
    F4::new(1.0f32) - (h * F4::new(-100.0f32)).exp()
}

/// `g_z = s (g_h + 100 g_a w (1 − s))`.
#[cube]
pub fn curved(s: &Block, g_h: &Block, g_a: &Block, w: F4) -> Block {
    Block::of(
        curve(s.c0, g_h.c0, g_a.c0, w.extract(0usize)),
        curve(s.c1, g_h.c1, g_a.c1, w.extract(1usize)),
        curve(s.c2, g_h.c2, g_a.c2, w.extract(2usize)),
        curve(s.c3, g_h.c3, g_a.c3, w.extract(3usize)),
    )
}

#[cube]
fn curve(s: F4, g_h: F4, g_a: F4, w: f32) -> F4 {
    s * (g_h + g_a * F4::new(100.0f32 * w) * (F4::new(1.0f32) - s))
}
