//! Matrix products of tiles in workgroup memory, by 256 threads.
//!
//! A vector holds four samples of a channel. A tile has `lanes` vectors for each of
//! its [`channels`]: it is 64 samples times 64 channels, or 32 times 128. Thread `(row, column)`
//! owns vector `row` of channels `4 column .. 4 column + 4`, a [`Block`]. Weights are stored in
//! rows with as many floats as a tile has channels, `[inputs, channels]`.

use burn::cubecl::{self, prelude::*};

type F4 = Vector<f32, Const<4>>;

/// Number of channels of a tile with [`LANES`] vectors per channel.
pub const CHANNELS: usize = channels(LANES);
/// Number of vectors per channel in a tile of 64 samples.
pub const LANES: usize = 16;
/// Number of threads that work on a tile.
pub const UNITS: u32 = 256;

/// Returns the number of threads per row of a tile, which is also the number of vectors in a row of
/// weights.
pub const fn columns(lanes: usize) -> usize {
    UNITS as usize / lanes
}

/// Returns the number of channels of a tile.
pub const fn channels(lanes: usize) -> usize {
    4 * columns(lanes)
}

/// Returns the index of a channel's vector in a tile. The layout puts neighboring channels in
/// different banks, whether a tile is read along channels or along samples.
#[cube]
pub fn at(channel: usize, row: usize, #[comptime] lanes: usize) -> usize {
    channel * lanes + (row ^ (channel % lanes))
}

/// Returns the first word of `count`, which all threads read from a tile that is not in use yet,
/// after a barrier. FXC, the older compiler of DX12, rejects barriers in loops and branches whose
/// condition comes from a buffer. On some adapters tiles take all of the workgroup memory, so the
/// word is passed as two integers in the floats of a tile.
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

/// A thread's place in a tile of 64 samples, and its vector of samples in planes.
#[derive(CubeType, Clone, Copy)]
pub struct Lane {
    pub row: usize,
    pub column: usize,
    /// Number of vectors of a plane.
    pub plane: usize,
    /// Index of the thread's vector in a plane.
    pub here: usize,
}

/// Returns the calling thread's place in tile number `tile`.
#[cube]
pub fn lane_of(tile: usize, plane: usize) -> Lane {
    let (row, column) = (UNIT_POS as usize / 16, UNIT_POS as usize % 16);
    Lane { row, column, plane, here: tile * LANES + row }
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
    /// Creates a block from the vectors of four channels.
    pub fn new(c0: F4, c1: F4, c2: F4, c3: F4) -> Block {
        Block { c0, c1, c2, c3 }
    }

    /// Returns the vector of channel `j`, 0..4.
    pub fn channel(&self, #[comptime] j: usize) -> F4 {
        match j {
            0 => self.c0,
            1 => self.c1,
            2 => self.c2,
            _ => self.c3,
        }
    }
}

/// Returns a thread's block of `Σ_p a[first + p] · w[from + p]` over `k` channels.
#[cube]
pub fn product(
    a: &[F4],
    #[comptime] first: usize,
    w: &[F4],
    from: usize,
    k: usize,
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
    Block::new(c0, c1, c2, c3)
}

/// Returns output `column` of a layer with few outputs, whose inputs are all channels; its weights
/// are `[outputs, channels]`. Columns after the last output get zero.
#[cube]
pub fn output_layer(
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

/// Returns the transpose of a block: four samples' vectors of channels become four channels'
/// vectors of samples, and vice versa.
#[cube]
pub fn transposed(b: &Block) -> Block {
    Block::new(component(b, 0usize), component(b, 1usize), component(b, 2usize), component(b, 3usize))
}

/// Returns component `k` of all four vectors.
#[cube]
fn component(b: &Block, #[comptime] k: usize) -> F4 {
    let mut v = F4::new(b.c0.extract(k));
    v.insert(1usize, b.c1.extract(k));
    v.insert(2usize, b.c2.extract(k));
    v.insert(3usize, b.c3.extract(k));
    v
}

/// Writes a thread's block to a tile.
#[cube]
pub fn store_block(a: &mut [F4], block: &Block, row: usize, column: usize, #[comptime] lanes: usize) {
    #[unroll]
    for j in 0..4usize {
        a[at(4 * column + j, row, lanes)] = block.channel(j);
    }
}

/// Reads a thread's block of a tile.
#[cube]
pub fn load_block(a: &[F4], row: usize, column: usize, #[comptime] lanes: usize) -> Block {
    let c = 4 * column;
    Block::new(
        a[at(c, row, lanes)],
        a[at(c + 1, row, lanes)],
        a[at(c + 2, row, lanes)],
        a[at(c + 3, row, lanes)],
    )
}

/// Writes the channels below `end` of a thread's block to planes.
#[cube]
pub fn store_planes(to: &mut [F4], block: &Block, lane: &Lane, #[comptime] end: usize) {
    #[unroll]
    for j in 0..4usize {
        let c = 4 * lane.column + j;
        if c < end {
            to[c * lane.plane + lane.here] = block.channel(j);
        }
    }
}

/// Fills a tile from 64 planes.
#[cube]
pub fn load_planes(a: &mut [F4], from: &[F4], lane: &Lane) {
    for j in 0..4usize {
        let c = lane.column + 16 * j;
        a[at(c, lane.row, LANES)] = from[c * lane.plane + lane.here];
    }
}

/// Returns the products of a vector with four others.
#[cube]
fn dots(v: F4, b0: F4, b1: F4, b2: F4, b3: F4) -> F4 {
    let mut s = F4::new(v.dot(b0));
    s.insert(1usize, v.dot(b1));
    s.insert(2usize, v.dot(b2));
    s.insert(3usize, v.dot(b3));
    s
}

/// Returns `Σ_samples a[i] · b[j]` for the four channels `j` of tile `b` that a thread owns in a
/// row of a gradient: `column` and every [`columns`]-th after it.
#[cube]
pub fn outer_row(a: &[F4], i: usize, b: &[F4], column: usize, #[comptime] lanes: usize) -> F4 {
    let columns = comptime!(columns(lanes));
    let mut sum = F4::new(0.0f32);
    for r in 0..lanes {
        sum += dots(
            a[at(i, r, lanes)],
            b[at(column, r, lanes)],
            b[at(column + columns, r, lanes)],
            b[at(column + 2 * columns, r, lanes)],
            b[at(column + 3 * columns, r, lanes)],
        );
    }
    sum
}

/// Returns [`outer_row`] for the four rows that a thread owns in a gradient of 64 rows: `row` and
/// every 16th after it. A kernel sums them over its tiles in registers, and writes them once.
#[cube]
pub fn outer_block(a: &[F4], b: &[F4], row: usize, column: usize) -> Block {
    let mut c0 = F4::new(0.0f32);
    let mut c1 = F4::new(0.0f32);
    let mut c2 = F4::new(0.0f32);
    let mut c3 = F4::new(0.0f32);
    for r in 0..LANES {
        let b0 = b[at(column, r, LANES)];
        let b1 = b[at(column + 16, r, LANES)];
        let b2 = b[at(column + 32, r, LANES)];
        let b3 = b[at(column + 48, r, LANES)];
        c0 += dots(a[at(row, r, LANES)], b0, b1, b2, b3);
        c1 += dots(a[at(row + 16, r, LANES)], b0, b1, b2, b3);
        c2 += dots(a[at(row + 32, r, LANES)], b0, b1, b2, b3);
        c3 += dots(a[at(row + 48, r, LANES)], b0, b1, b2, b3);
    }
    Block::new(c0, c1, c2, c3)
}

/// Writes what [`outer_row`] returns for a row, of a gradient with `n` columns, to the row that
/// begins at `start`.
#[cube]
pub fn store_row(gradient: &mut [f32], start: usize, sums: F4, #[comptime] n: usize, column: usize) {
    gradient[start + column] = sums.extract(0usize);
    if comptime!(n > 16) {
        gradient[start + column + 16] = sums.extract(1usize);
    }
    if comptime!(n > 32) {
        gradient[start + column + 32] = sums.extract(2usize);
    }
    if comptime!(n > 48) {
        gradient[start + column + 48] = sums.extract(3usize);
    }
}

/// Writes what [`outer_block`] returns to a gradient of 64 rows and `n` columns.
#[cube]
pub fn store_outer(
    gradient: &mut [f32],
    start: usize,
    sums: &Block,
    #[comptime] n: usize,
    row: usize,
    column: usize,
) {
    #[unroll]
    for k in 0..4usize {
        store_row(gradient, start + (row + 16 * k) * CHANNELS, sums.channel(k), n, column);
    }
}

/// Returns `Σ_samples a[j]` for the four channels `j` that a thread of the first row owns, as in
/// [`outer_row`]; 0 to the others.
#[cube]
pub fn channel_sums(a: &[F4], row: usize, column: usize, #[comptime] lanes: usize) -> F4 {
    let columns = comptime!(columns(lanes));
    let mut sums = F4::new(0.0f32);
    if row == 0 {
        #[unroll]
        for j in 0..4usize {
            let mut sum = F4::new(0.0f32);
            for r in 0..lanes {
                sum += a[at(column + columns * j, r, lanes)];
            }
            sums.insert(j, total(sum));
        }
    }
    sums
}

/// Returns the sum of four samples.
#[cube]
pub fn total(v: F4) -> f32 {
    v.extract(0usize) + v.extract(1usize) + (v.extract(2usize) + v.extract(3usize))
}

/// Returns so many zeros, the sums of a thread.
#[cube]
pub fn zero_sums(#[comptime] count: usize) -> Array<F4> {
    let mut sums = Array::<F4>::new(count);
    #[unroll]
    for i in 0..count {
        sums[i] = F4::new(0.0f32);
    }
    sums
}

/// Adds [`outer_row`] of each row that a thread owns in a gradient, `row` and every `lanes`-th
/// after it, to `sums[first..first + rows]`. Indices are constants, so the sums stay in registers.
#[cube]
pub fn add_outer(
    sums: &mut Array<F4>,
    #[comptime] first: usize,
    #[comptime] rows: usize,
    a: &[F4],
    b: &[F4],
    row: usize,
    column: usize,
    #[comptime] lanes: usize,
) {
    let columns = comptime!(columns(lanes));
    for r in 0..lanes {
        let b0 = b[at(column, r, lanes)];
        let b1 = b[at(column + columns, r, lanes)];
        let b2 = b[at(column + 2 * columns, r, lanes)];
        let b3 = b[at(column + 3 * columns, r, lanes)];
        #[unroll]
        for k in 0..rows {
            sums[first + k] += dots(a[at(row + lanes * k, r, lanes)], b0, b1, b2, b3);
        }
    }
}

/// Adds the sums of [`add_outer`] to a gradient whose rows have all channels of a tile, or
/// overwrites it if `fresh` is set.
#[cube]
pub fn flush_outer(
    gradient: &mut [f32],
    start: usize,
    sums: &Array<F4>,
    #[comptime] first: usize,
    #[comptime] rows: usize,
    fresh: bool,
    row: usize,
    column: usize,
    #[comptime] lanes: usize,
) {
    #[unroll]
    for k in 0..rows {
        let at_row = start + (row + lanes * k) * comptime!(channels(lanes));
        flush_row(gradient, at_row, sums[first + k], fresh, column, lanes);
    }
}

/// Adds what [`outer_row`] or [`channel_sums`] return to the row of a gradient that begins at
/// `start`, or overwrites it if `fresh` is set.
#[cube]
pub fn flush_row(
    gradient: &mut [f32],
    start: usize,
    sums: F4,
    fresh: bool,
    column: usize,
    #[comptime] lanes: usize,
) {
    #[unroll]
    for j in 0..4usize {
        add(gradient, start + column + comptime!(columns(lanes)) * j, sums.extract(j), fresh);
    }
}

/// Adds `v` to a gradient, or overwrites it if `fresh` is set.
#[cube]
pub fn add(gradient: &mut [f32], i: usize, v: f32, fresh: bool) {
    gradient[i] = if fresh { v } else { gradient[i] + v };
}

/// Returns 1 / (1 + e⁻ᵛ).
#[cube]
pub fn sigmoid(v: F4) -> F4 {
    let one = F4::new(1.0f32);
    one / (one + (-v).exp())
}

/// Returns `max(v, 0)`.
#[cube]
fn positive(v: F4) -> F4 {
    max(v, F4::new(0.0f32))
}

/// Returns `max(v, 0)` of all values of a block.
#[cube]
pub fn relu(b: &Block) -> Block {
    Block::new(positive(b.c0), positive(b.c1), positive(b.c2), positive(b.c3))
}

/// Returns `g` where the activations of tile `a` are positive, else zero: the gradient of the relu.
#[cube]
pub fn relu_backward(g: &Block, a: &[F4], row: usize, column: usize, #[comptime] lanes: usize) -> Block {
    let v = load_block(a, row, column, lanes);
    Block::new(
        relu_backward_channel(g.c0, v.c0),
        relu_backward_channel(g.c1, v.c1),
        relu_backward_channel(g.c2, v.c2),
        relu_backward_channel(g.c3, v.c3),
    )
}

#[cube]
fn relu_backward_channel(g: F4, v: F4) -> F4 {
    let zero = F4::new(0.0f32);
    select_many(v.greater_than(&zero), g, zero)
}

/// Returns the elementwise product of two blocks.
#[cube]
pub fn times(a: &Block, b: &Block) -> Block {
    Block::new(a.c0 * b.c0, a.c1 * b.c1, a.c2 * b.c2, a.c3 * b.c3)
}

/// Returns a block times one weight per channel.
#[cube]
pub fn weighted(a: &Block, w: F4) -> Block {
    let w = Block::new(
        F4::new(w.extract(0usize)),
        F4::new(w.extract(1usize)),
        F4::new(w.extract(2usize)),
        F4::new(w.extract(3usize)),
    );
    times(a, &w)
}

/// Values of `softplus₁₀₀` and of its slope.
#[derive(CubeType)]
pub struct Active {
    pub h: Block,
    pub s: Block,
}

/// Returns h = softplus₁₀₀(z + b) and s = sigmoid(100 (z + b)), by the same formulas as the CPU.
#[cube]
pub fn activate(z: &Block, bias: F4) -> Active {
    let a0 = activated(z.c0, bias.extract(0usize));
    let a1 = activated(z.c1, bias.extract(1usize));
    let a2 = activated(z.c2, bias.extract(2usize));
    let a3 = activated(z.c3, bias.extract(3usize));
    Active { h: Block::new(a0.h, a1.h, a2.h, a3.h), s: Block::new(a0.s, a1.s, a2.s, a3.s) }
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

/// Returns s for given h: `1 − e^{−100 h}`.
#[cube]
pub fn slope(h: &Block) -> Block {
    Block::new(slope_channel(h.c0), slope_channel(h.c1), slope_channel(h.c2), slope_channel(h.c3))
}

#[cube]
fn slope_channel(h: F4) -> F4 {
    F4::new(1.0f32) - (h * F4::new(-100.0f32)).exp()
}

/// Returns the gradient `g_z = s (g_h + 100 g_a w (1 − s))`.
#[cube]
pub fn softplus_backward(s: &Block, g_h: &Block, g_a: &Block, w: F4) -> Block {
    Block::new(
        softplus_backward_channel(s.c0, g_h.c0, g_a.c0, w.extract(0usize)),
        softplus_backward_channel(s.c1, g_h.c1, g_a.c1, w.extract(1usize)),
        softplus_backward_channel(s.c2, g_h.c2, g_a.c2, w.extract(2usize)),
        softplus_backward_channel(s.c3, g_h.c3, g_a.c3, w.extract(3usize)),
    )
}

#[cube]
fn softplus_backward_channel(s: F4, g_h: F4, g_a: F4, w: f32) -> F4 {
    s * (g_h + g_a * F4::new(100.0f32 * w) * (F4::new(1.0f32) - s))
}

/// Returns running sums of `counts`, from 0.
pub(super) fn ends<const N: usize, const M: usize>(counts: [usize; N]) -> [usize; M] {
    std::array::from_fn(|i| counts[..i].iter().sum())
}
