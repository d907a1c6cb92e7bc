//! Products of tiles: 64 samples times up to 64 channels in workgroup memory, by 256 threads.
//!
//! Four samples are a vector, and a tile is `[64 channels, 16 vectors]`. Thread `(row, column)`, 16 by 16, owns vector
//! `row` of channels `4 column .. 4 column + 4`: a [`Block`]. Weights lie in rows of 64 floats, `[inputs, 64]`.

use cubecl::prelude::*;

type F4 = Vector<f32, Const<4>>;

/// Channels of a tile.
pub const CHANNELS: usize = 64;
/// Vectors of a tile's channel.
pub const LANES: usize = 16;
/// Threads that share a tile.
pub const UNITS: u32 = 256;

/// Where a channel's vector lies: neighboring channels in different banks, read along channels or along samples.
#[cube]
pub fn at(channel: usize, row: usize) -> usize {
    channel * LANES + (row ^ (channel % LANES))
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
) -> Block {
    let mut c0 = F4::new(0.0f32);
    let mut c1 = F4::new(0.0f32);
    let mut c2 = F4::new(0.0f32);
    let mut c3 = F4::new(0.0f32);
    for p in 0..k {
        let v = a[at(first + p, row)];
        let m = w[(from + p) * LANES + column];
        c0 += v * F4::new(m.extract(0usize));
        c1 += v * F4::new(m.extract(1usize));
        c2 += v * F4::new(m.extract(2usize));
        c3 += v * F4::new(m.extract(3usize));
    }
    Block::of(c0, c1, c2, c3)
}

/// Output `column` of a layer of few outputs from 64 channels; its weights are `[outputs, 64]`. Beyond the last, zero.
#[cube]
pub fn narrow(
    a: &[F4],
    w: &[F4],
    #[comptime] from: usize,
    row: usize,
    column: usize,
    #[comptime] outputs: usize,
) -> F4 {
    let mut sum = F4::new(0.0f32);
    if column < outputs {
        for p in 0..LANES {
            let m = w[(from + column) * LANES + p];
            #[unroll]
            for j in 0..4usize {
                sum += a[at(4 * p + j, row)] * F4::new(m.extract(j));
            }
        }
    }
    sum
}

/// Writes a thread's block to a tile.
#[cube]
pub fn put(a: &mut [F4], block: &Block, row: usize, column: usize) {
    #[unroll]
    for j in 0..4usize {
        a[at(4 * column + j, row)] = block.channel(j);
    }
}

/// A thread's block of a tile.
#[cube]
pub fn take(a: &[F4], row: usize, column: usize) -> Block {
    let c = 4 * column;
    Block::of(a[at(c, row)], a[at(c + 1, row)], a[at(c + 2, row)], a[at(c + 3, row)])
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
        a[at(c, row)] = from[c * plane + here];
    }
}

/// Adds to a matrix of gradients, in rows of 64, `Σ_samples a[first + i] · b[j]`, `i < m` and `j < n`; the first time
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
) {
    for ii in 0..comptime!(m.div_ceil(16)) {
        let i = row + 16 * ii;
        if i < m {
            let mut s0 = 0.0f32;
            let mut s1 = 0.0f32;
            let mut s2 = 0.0f32;
            let mut s3 = 0.0f32;
            for r in 0..LANES {
                let v = a[at(first + i, r)];
                s0 += v.dot(b[at(column, r)]);
                s1 += v.dot(b[at(column + 16, r)]);
                s2 += v.dot(b[at(column + 32, r)]);
                s3 += v.dot(b[at(column + 48, r)]);
            }
            let here = start + i * CHANNELS + column;
            add(gradient, here, s0, fresh);
            if comptime!(n > 16) {
                add(gradient, here + 16, s1, fresh);
            }
            if comptime!(n > 32) {
                add(gradient, here + 32, s2, fresh);
            }
            if comptime!(n > 48) {
                add(gradient, here + 48, s3, fresh);
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
) {
    if row == 0 {
        for jj in 0..comptime!(n.div_ceil(16)) {
            let j = column + 16 * jj;
            if j < n {
                let mut sum = F4::new(0.0f32);
                for r in 0..LANES {
                    sum += a[at(first + j, r)];
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
pub fn gate(g: &Block, a: &[F4], row: usize, column: usize) -> Block {
    let v = take(a, row, column);
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
