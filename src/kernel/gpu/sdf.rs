//! The signed-distance field of [`crate::kernel::sdf`], whose module holds the formulas: forward with normals, and the
//! backward with its second-order path.
//!
//! A group of 256 threads takes 64 samples through all layers. Activations stand in workgroup memory, channel by
//! channel; a thread holds four samples of four channels. Weights, 90 kB, are read where they lie: all groups read the
//! same, so they stay in the nearest cache and leave workgroup memory to two tiles of activations (32 KiB). Gradients
//! of weights are summed by group, then over the groups in their order. The backward is two kernels, one a network:
//! as one, a software driver takes ten times as long to compile it.

use super::device::{Buffer, Device, groups};
use super::hash::Grid;
use super::tile::{
    self, CHANNELS, LANES, UNITS, at, gate, load, narrow, outer, product, put, save, sigmoid, sums,
};
use crate::kernel::mlp::{COLOR_INPUTS, HIDDEN, Layout, OUTPUTS, SOFTNESS, TILE};
use crate::kernel::neus::SHORTEST;
use crate::kernel::sdf::{FieldShape, WIDTH};
use cubecl::prelude::*;

type F4 = Vector<f32, Const<4>>;

/// Groups that sum gradients of weights, each over its own tiles.
const SUMMING: usize = 256;

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
    fn new(layout: Layout) -> Plan {
        let (padded, color) = (layout.padded(), layout.color_padded());
        assert!(
            padded + OUTPUTS <= CHANNELS && color <= CHANNELS,
            "the field has more levels than a tile has room"
        );
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
fn ends<const N: usize, const M: usize>(counts: [usize; N]) -> [usize; M] {
    std::array::from_fn(|i| counts[..i].iter().sum())
}

/// Weights in the orders in which they are read.
#[cube(launch)]
fn prepare(flat: &[f32], map: &[u32], out: &mut [f32]) {
    let i = ABSOLUTE_POS;
    if i < out.len() {
        let from = map[i] as usize;
        out[i] = if from < flat.len() { flat[from] } else { 0.0f32 };
    }
}

/// Sums of the groups' gradients, in the order of the groups.
#[cube(launch)]
fn reduce(
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
        a[at(c, row)] = v;
    }
}

/// v / ‖v‖ and ‖v‖, as the CPU takes them.
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

/// Writes the inputs of the color network to a tile, after a thread's own output `o` of the geometry network and, for
/// the one that writes it, the normal.
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
        a[at(column, row)] = o;
    }
    if column == 13 {
        let (x, y, z) = (direction[here], direction[plane + here], direction[2 * plane + here]);
        harmonics(a, x, y, z, row);
    }
    if column == 14 {
        a[at(NORMAL, row)] = normal.x;
        a[at(NORMAL + 1, row)] = normal.y;
        a[at(NORMAL + 2, row)] = normal.z;
    }
    if comptime!(plan.color > COLOR_INPUTS) {
        for j in 0..2usize {
            let c = column + 16 * j;
            if c < comptime!(plan.color - COLOR_INPUTS) {
                let mut v = F4::new(0.0f32);
                if c < comptime!(plan.features) {
                    v = value[c * plane + here];
                }
                a[at(COLOR_INPUTS + c, row)] = v;
            }
        }
    }
}

/// [`crate::kernel::sphharm::sh16`].
#[cube]
fn harmonics(a: &mut [F4], x: F4, y: F4, z: F4, row: usize) {
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let (x2, y2, z2) = (x * x, y * y, z * z);
    let one = F4::new(1.0f32);
    let five = one - F4::new(5.0f32) * z2;
    a[at(13, row)] = F4::new(0.282_094_79f32);
    a[at(14, row)] = y * F4::new(-0.488_602_51f32);
    a[at(15, row)] = z * F4::new(0.488_602_51f32);
    a[at(16, row)] = x * F4::new(-0.488_602_51f32);
    a[at(17, row)] = xy * F4::new(1.092_548_4f32);
    a[at(18, row)] = yz * F4::new(-1.092_548_4f32);
    a[at(19, row)] = z2 * F4::new(0.946_174_7f32) - F4::new(0.315_391_57f32);
    a[at(20, row)] = xz * F4::new(-1.092_548_4f32);
    a[at(21, row)] = (x2 - y2) * F4::new(0.546_274_2f32);
    a[at(22, row)] = y * (y2 - x2 * F4::new(3.0f32)) * F4::new(0.590_043_6f32);
    a[at(23, row)] = xy * z * F4::new(2.890_611_4f32);
    a[at(24, row)] = y * five * F4::new(0.457_045_8f32);
    a[at(25, row)] = z * (F4::new(5.0f32) * z2 - F4::new(3.0f32)) * F4::new(0.373_176_34f32);
    a[at(26, row)] = x * five * F4::new(0.457_045_8f32);
    a[at(27, row)] = z * (x2 - y2) * F4::new(1.445_305_7f32);
    a[at(28, row)] = x * (y2 * F4::new(3.0f32) - x2) * F4::new(0.590_043_6f32);
}

/// Writes sdf, ∇sdf, color and local sharpness, planes `[8, capacity]`, and what the backward needs.
#[cube(launch_unchecked)]
fn forward(
    w: &[F4],
    value: &[F4],
    jacobian: &[F4],
    x: &[F4],
    direction: &[F4],
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
) {
    let rows = comptime!(plan.rows());
    let features = comptime!(plan.features);
    let plane = x.len() / 3;
    let (row, column) = (UNIT_POS as usize / 16, UNIT_POS as usize % 16);
    let tile = CUBE_POS;
    let here = tile * LANES + row;
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    if tile * TILE < count[0] as usize {
        geometry_inputs(&mut a, value, x, inv_radius, plane, here, row, column, features);
        sync_cube();
        let z = product(&a, 0usize, w, comptime!(rows[0]), comptime!(plan.padded), row, column);
        let active = tile::activate(&z, w[comptime!(rows[2] * LANES) + column]);
        save(h, &active.h, plane, here, column, HIDDEN);
        put(&mut b, &active.h, row, column);
        sync_cube();
        let own =
            narrow(&b, w, comptime!(rows[3]), row, column, OUTPUTS) + w[comptime!(rows[4] * LANES) + column];
        if column < OUTPUTS {
            o[column * plane + here] = own;
        }
        let weighted = tile::weighted(&active.s, w[comptime!(rows[3] * LANES) + column]);
        put(&mut a, &weighted, row, column);
        sync_cube();
        // q = a W1, and this thread's share of n = q_x + Jᵀ q_F
        let own_q = product(&a, 0usize, w, comptime!(rows[1]), HIDDEN, row, column);
        save(q, &own_q, plane, here, column, features);
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
            b[at(16 * axis + column, row)] = sum;
        }
        sync_cube();
        let mut nx = F4::new(0.0f32);
        let mut ny = F4::new(0.0f32);
        let mut nz = F4::new(0.0f32);
        if column == 14 {
            for c in 0..16usize {
                nx += b[at(c, row)];
                ny += b[at(16 + c, row)];
                nz += b[at(32 + c, row)];
            }
            out[plane + here] = nx;
            out[2 * plane + here] = ny;
            out[3 * plane + here] = nz;
        }
        color_inputs(&mut a, own, &unit(nx, ny, nz), direction, value, plane, here, row, column, plan);
        if column == 0 {
            out[here] = own;
        }
        if column == SOFTNESS {
            out[7 * plane + here] = sigmoid(own - F4::new(2.0f32)) * F4::new(-soften);
        }
        sync_cube();
        let first =
            tile::relu(&product(&a, 0usize, w, comptime!(rows[5]), comptime!(plan.color), row, column));
        save(c1, &first, plane, here, column, HIDDEN);
        put(&mut b, &first, row, column);
        sync_cube();
        let second = tile::relu(&product(&b, 0usize, w, comptime!(rows[7]), HIDDEN, row, column));
        save(c2, &second, plane, here, column, HIDDEN);
        put(&mut a, &second, row, column);
        sync_cube();
        let rgb = narrow(&a, w, comptime!(rows[9]), row, column, 3usize);
        if column < 3 {
            out[(4 + column) * plane + here] = sigmoid(rgb);
        }
    }
}

/// Samples from `samples` on count nothing.
#[cube]
fn masked(v: F4, first: usize, samples: usize) -> F4 {
    let mut own = v;
    #[unroll]
    for i in 0..4usize {
        if first + i >= samples {
            own.insert(i, 0.0f32);
        }
    }
    own
}

/// Backward of the color network: gradients of the geometry network's outputs and of the normal by sample, of the
/// features that the color network reads itself, and of the weights by group.
#[cube(launch_unchecked)]
fn color_backward(
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
    let own = comptime!(plan.gradients());
    let plane = direction.len() / 3;
    let (row, column) = (UNIT_POS as usize / 16, UNIT_POS as usize % 16);
    let samples = count[0] as usize;
    let group = CUBE_POS;
    let sum = group * comptime!(own[7] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    for tile in range_stepped(group, samples.div_ceil(TILE), CUBE_COUNT) {
        let here = tile * LANES + row;
        let first = 4 * here;
        let fresh = tile == group;
        if column < 3 {
            let y = out[(4 + column) * plane + here];
            let g = masked(g_out[(4 + column) * plane + here], first, samples);
            a[at(column, row)] = g * y * (F4::new(1.0f32) - y);
        }
        load(&mut b, c2, plane, here, row, column);
        sync_cube();
        let start = sum + comptime!(own[6] * CHANNELS);
        outer(&a, 0usize, &b, 3usize, HIDDEN, partial, start, fresh, row, column);
        let g_c2 = gate(&product(&a, 0usize, w, comptime!(rows[9]), 3usize, row, column), &b, row, column);
        sync_cube();
        put(&mut a, &g_c2, row, column);
        load(&mut b, c1, plane, here, row, column);
        sync_cube();
        let start = sum + comptime!(own[5] * CHANNELS);
        outer(&a, 0usize, &b, HIDDEN, HIDDEN, partial, start, fresh, row, column);
        let g_c1 = gate(&product(&a, 0usize, w, comptime!(rows[8]), HIDDEN, row, column), &b, row, column);
        sync_cube();
        put(&mut a, &g_c1, row, column);
        let n = unit(out[plane + here], out[2 * plane + here], out[3 * plane + here]);
        let mut output = F4::new(0.0f32);
        if column < OUTPUTS {
            output = o[column * plane + here];
        }
        color_inputs(&mut b, output, &n, direction, value, plane, here, row, column, plan);
        sync_cube();
        let start = sum + comptime!(own[4] * CHANNELS);
        outer(&a, 0usize, &b, HIDDEN, comptime!(plan.color), partial, start, fresh, row, column);
        let g_c0 = product(&a, 0usize, w, comptime!(rows[6]), HIDDEN, row, column);
        sync_cube();
        put(&mut a, &g_c0, row, column);
        sync_cube();
        if column < OUTPUTS {
            let mut g = a[at(column, row)];
            if column == 0 {
                g += masked(g_out[here], first, samples);
            }
            if column == SOFTNESS && soften > 0.0f32 {
                // through −L σ: its slope is y (1 + y / L)
                let y = out[7 * plane + here];
                let own = masked(g_out[7 * plane + here], first, samples);
                g += own * y * (F4::new(1.0f32) + y / F4::new(soften));
            }
            g_o[column * plane + here] = g;
        }
        if column == 14 {
            // through n̂ = n / ‖n‖ too: (g − n̂ (n̂ · g)) / ‖n‖
            let (gx, gy, gz) = (a[at(NORMAL, row)], a[at(NORMAL + 1, row)], a[at(NORMAL + 2, row)]);
            let along = n.x * gx + n.y * gy + n.z * gz;
            let zero = F4::new(0.0f32);
            let one = F4::new(1.0f32);
            let share = select_many(n.length.greater_than(&F4::new(SHORTEST)), one / n.length, zero);
            g_normal[here] = masked(g_out[plane + here], first, samples) + (gx - n.x * along) * share;
            g_normal[plane + here] =
                masked(g_out[2 * plane + here], first, samples) + (gy - n.y * along) * share;
            g_normal[2 * plane + here] =
                masked(g_out[3 * plane + here], first, samples) + (gz - n.z * along) * share;
        }
        if comptime!(plan.skip) {
            for j in 0..2usize {
                let c = column + 16 * j;
                if c < comptime!(plan.features) {
                    g_value[c * plane + here] = a[at(COLOR_INPUTS + c, row)];
                }
            }
        }
        sync_cube();
    }
}

/// Backward of the geometry network, both orders: gradients of the features by sample, and of the weights by group.
#[cube(launch_unchecked)]
fn geometry_backward(
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
    let own = comptime!(plan.gradients());
    let features = comptime!(plan.features);
    let padded = comptime!(plan.padded);
    let plane = x.len() / 3;
    let (row, column) = (UNIT_POS as usize / 16, UNIT_POS as usize % 16);
    let group = CUBE_POS;
    let sum = group * comptime!(own[7] * CHANNELS);
    let mut a = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    let mut b = Shared::<[F4]>::new_slice(CHANNELS * LANES);
    for tile in range_stepped(group, (count[0] as usize).div_ceil(TILE), CUBE_COUNT) {
        let here = tile * LANES + row;
        let fresh = tile == group;
        // g_q in the first channels, g_o behind them
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
            b[at(c, row)] = v;
        }
        load(&mut a, h, plane, here, row, column);
        sync_cube();
        let g_a = product(&b, 0usize, w, comptime!(rows[0]), padded, row, column);
        let from_o = product(&b, padded, w, comptime!(rows[3]), OUTPUTS, row, column);
        let w0 = w[comptime!(rows[3] * LANES) + column];
        let s = tile::slope(&tile::take(&a, row, column));
        let start = sum + comptime!(own[2] * CHANNELS);
        outer(&b, padded, &a, OUTPUTS, HIDDEN, partial, start, fresh, row, column);
        sums(&b, padded, OUTPUTS, partial, sum + comptime!(own[3] * CHANNELS), fresh, row, column);
        sync_cube();
        put(&mut a, &tile::times(&g_a, &s), row, column);
        sync_cube();
        sums(&a, 0usize, HIDDEN, partial, start, false, row, column);
        sync_cube();
        put(&mut a, &tile::weighted(&s, w0), row, column);
        sync_cube();
        outer(&a, 0usize, &b, HIDDEN, padded, partial, sum, fresh, row, column);
        sync_cube();
        put(&mut a, &tile::curved(&s, &from_o, &g_a, w0), row, column);
        geometry_inputs(&mut b, value, x, inv_radius, plane, here, row, column, features);
        sync_cube();
        outer(&a, 0usize, &b, HIDDEN, padded, partial, sum, false, row, column);
        sums(&a, 0usize, HIDDEN, partial, sum + comptime!(own[1] * CHANNELS), fresh, row, column);
        let g_u = product(&a, 0usize, w, comptime!(rows[1]), HIDDEN, row, column);
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
    /// For up to `capacity` samples, a multiple of [`TILE`].
    pub fn new(device: &Device, shape: &FieldShape, capacity: usize) -> Sdf {
        assert!(capacity.is_multiple_of(TILE) && capacity > 0);
        let layout = shape.layout();
        let plan = Plan::new(layout);
        let (prepared, summed) = plan.maps(layout);
        let planes = |count: usize| device.scratch(count * capacity);
        Sdf {
            plan,
            grid: Grid::new(device, shape),
            inv_radius: 1.0 / shape.radius,
            soften: shape.soften,
            capacity,
            weights: device.scratch(prepared.len()),
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
            partial: device.scratch(SUMMING * plan.gradients()[7] * CHANNELS),
        }
    }

    /// How many of the levels take part from now on.
    pub fn activate(&mut self, levels: usize) {
        self.grid.activate(levels);
    }

    /// Sdf, gradient and color of samples, and what the backward needs: see [`crate::kernel::sdf::forward`].
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
        let dim = CubeDim::new_1d(UNITS);
        prepare::launch(
            device.launch(),
            groups(self.weights.words().div_ceil(UNITS as usize)),
            dim,
            flat.arg(),
            self.prepared_map.arg(),
            self.weights.arg(),
        );
        self.grid.gather(device, table, x, count, &self.value, Some(&self.jacobian));
        assert!(x.words() == 3 * self.capacity && direction.words() == x.words());
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            forward::launch_unchecked(
                device.launch(),
                groups(self.capacity / TILE),
                dim,
                self.weights.arg(),
                self.value.arg(),
                self.jacobian.arg(),
                x.arg(),
                direction.arg(),
                count.arg(),
                self.q.arg(),
                self.h.arg(),
                self.o.arg(),
                self.c1.arg(),
                self.c2.arg(),
                self.out.arg(),
                self.inv_radius,
                self.soften,
                self.plan,
            );
        }
        &self.out
    }

    /// Adds the gradient of the table, zero before, and writes that of the weights: see
    /// [`crate::kernel::sdf::backward`]. Of the samples of the last forward.
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
        let dim = CubeDim::new_1d(UNITS);
        assert!(x.words() == 3 * self.capacity && direction.words() == x.words());
        assert!(g_out.words() == WIDTH * self.capacity);
        let groups_of = groups(SUMMING.min(self.capacity / TILE));
        // SAFETY: all planes have `capacity` samples, and no tile reaches beyond it.
        unsafe {
            color_backward::launch_unchecked(
                device.launch(),
                groups_of.clone(),
                dim,
                self.weights.arg(),
                self.value.arg(),
                direction.arg(),
                count.arg(),
                self.o.arg(),
                self.c1.arg(),
                self.c2.arg(),
                self.out.arg(),
                g_out.arg(),
                self.g_o.arg(),
                self.g_normal.arg(),
                self.g_value.arg(),
                self.partial.arg(),
                self.soften,
                self.plan,
            );
            geometry_backward::launch_unchecked(
                device.launch(),
                groups_of,
                dim,
                self.weights.arg(),
                self.value.arg(),
                self.jacobian.arg(),
                x.arg(),
                count.arg(),
                self.h.arg(),
                self.g_o.arg(),
                self.g_normal.arg(),
                self.g_value.arg(),
                self.partial.arg(),
                self.inv_radius,
                self.plan,
            );
        }
        reduce::launch(
            device.launch(),
            groups(g_flat.words().div_ceil(UNITS as usize)),
            dim,
            self.partial.arg(),
            self.summed_map.arg(),
            count.arg(),
            g_flat.arg(),
            (self.plan.gradients()[7] * CHANNELS) as u32,
            SUMMING.min(self.capacity / TILE),
        );
        self.grid.scatter(device, g_table, x, count, &self.g_value, &self.q, &self.g_normal);
    }
}

#[cfg(test)]
mod tests {
    use super::super::device::tests::{agree, device, devices, planes};
    use super::*;
    use crate::kernel::mlp::Weights;
    use crate::kernel::{hash, rng, sdf};

    const SAMPLES: usize = 1000;
    const CAPACITY: usize = 1088; // one tile more than there are samples for

    /// A field with lively weights, samples in its box seen from anywhere, and gradients of its output. Positions and
    /// scales have few digits, so that the cells of all samples are found alike.
    struct Case {
        shape: FieldShape,
        table: Vec<[f32; 2]>,
        flat: Vec<f32>,
        x: Vec<[f32; 3]>,
        direction: Vec<[f32; 3]>,
        g_out: Vec<[f32; WIDTH]>,
    }

    fn case(levels: usize, color_skip: bool, active: usize) -> Case {
        let mut levels = hash::levels(levels, 4, 1.4, 10);
        levels.iter_mut().for_each(|l| l.scale = l.scale.round());
        let soften = if color_skip { 1.5 } else { 0.0 };
        let shape = FieldShape { levels, radius: 2.0, active, color_skip, soften };
        let normal = |stream: u64, i: usize| rng::normal(7, stream, i as u64);
        let table = (0..hash::entries(&shape.levels)).map(|i| [normal(1, 2 * i), normal(1, 2 * i + 1)]);
        let at = |i: usize| rng::below(7, 2, i as u64, 1025) as f32 / 256.0 - 2.0;
        let unit = |v: [f32; 3]| {
            let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
            v.map(|c| c / length)
        };
        Case {
            table: table.map(|e| e.map(|v| 0.3 * v)).collect(),
            flat: (0..shape.layout().len()).map(|i| 0.12 * normal(3, i)).collect(),
            x: (0..SAMPLES).map(|i| [at(3 * i), at(3 * i + 1), at(3 * i + 2)]).collect(),
            direction: (0..SAMPLES).map(|i| unit([0, 1, 2].map(|k| normal(4, 3 * i + k)))).collect(),
            g_out: (0..SAMPLES).map(|i| std::array::from_fn(|k| normal(5, WIDTH * i + k))).collect(),
            shape,
        }
    }

    #[test]
    fn the_field_and_its_gradients_are_those_of_the_cpu() {
        for (levels, skip, active) in [(16, false, 16), (5, true, 4)] {
            let Case { shape, table, flat, x, direction, g_out } = case(levels, skip, active);
            let weights = Weights::new(shape.layout(), &flat);
            let a = sdf::forward(&shape, &table, &weights, &x, &direction);
            let mut g_table = vec![[0f32; 2]; table.len()];
            let g_flat = sdf::backward(&a, &weights, g_out.as_flattened(), &mut g_table);
            for device in devices() {
                let name =
                    |what: &str| format!("{what}, {levels} levels, skip {skip}, {:?}", device.atomics());
                let mut on = Sdf::new(&device, &shape, CAPACITY);
                on.activate(active);
                let [x, direction] = [&x, &direction].map(|v| device.upload(&planes(v, CAPACITY)));
                let (table, flat) = (device.upload(&table), device.upload(&flat));
                let count = device.upload(&[SAMPLES as u32]);
                let out = device.read::<f32>(on.forward(&device, &table, &flat, &x, &direction, &count));
                let rows: &[[f32; WIDTH]] = a.output().as_chunks().0;
                for k in 0..WIDTH {
                    let want: Vec<f32> = rows.iter().map(|r| r[k]).collect();
                    agree(&name(&format!("output {k}")), &out[k * CAPACITY..][..SAMPLES], &want, 1e-4);
                }
                let mut g_planes = planes(&g_out, CAPACITY);
                // behind the last sample nothing counts
                (0..WIDTH).for_each(|k| g_planes[k * CAPACITY + SAMPLES] = f32::NAN);
                let got_table = device.zeros(2 * g_table.len());
                let got_flat = device.zeros(g_flat.len());
                on.backward(
                    &device,
                    &x,
                    &direction,
                    &count,
                    &device.upload(&g_planes),
                    &got_table,
                    &got_flat,
                );
                let mut start = 0;
                for (o, i) in shape.layout().shapes() {
                    let span = start..start + o * i;
                    start += o * i;
                    agree(
                        &name("weights"),
                        &device.read::<f32>(&got_flat)[span.clone()],
                        &g_flat[span],
                        1e-4,
                    );
                }
                agree(&name("table"), &device.read::<f32>(&got_table), g_table.as_flattened(), 1e-4);
            }
        }
    }

    #[test]
    fn the_gradients_agree_with_f64_finite_differences_second_order_included() {
        for skip in [false, true] {
            let Some(device) = device() else { return };
            sdf::tests::backward_agrees(skip, |case| {
                let capacity = case.x.len().next_multiple_of(TILE);
                let on = Sdf::new(&device, case.shape, capacity);
                let [x, direction] = [case.x, case.direction].map(|v| device.upload(&planes(v, capacity)));
                let (table, flat) = (device.upload(case.table), device.upload(case.flat));
                let count = device.upload(&[case.x.len() as u32]);
                on.forward(&device, &table, &flat, &x, &direction, &count);
                let g_out = device.upload(&planes(case.g_out.as_chunks::<WIDTH>().0, capacity));
                let g_table = device.zeros(2 * case.table.len());
                let g_flat = device.zeros(case.flat.len());
                on.backward(&device, &x, &direction, &count, &g_out, &g_table, &g_flat);
                (device.read(&g_flat), device.read::<f32>(&g_table).as_chunks().0.to_vec())
            });
        }
    }

    #[test]
    fn no_samples_give_no_gradient() {
        let Some(device) = device() else { return };
        let Case { shape, table, flat, x, direction, g_out } = case(5, false, 5);
        let on = Sdf::new(&device, &shape, CAPACITY);
        let [x, direction] = [&x, &direction].map(|v| device.upload(&planes(v, CAPACITY)));
        let (entries, floats) = (table.len(), flat.len());
        let (table, flat, count) = (device.upload(&table), device.upload(&flat), device.upload(&[0u32]));
        on.forward(&device, &table, &flat, &x, &direction, &count);
        let (g_table, g_flat) = (device.zeros(2 * entries), device.upload(&vec![1f32; floats]));
        let g_out = device.upload(&planes(&g_out, CAPACITY));
        on.backward(&device, &x, &direction, &count, &g_out, &g_table, &g_flat);
        let zero = |b: &Buffer| device.read::<f32>(b).iter().all(|&v| v == 0.0);
        assert!(zero(&g_table) && zero(&g_flat));
        let (launches, readbacks) = device.counts();
        println!("{launches} launches and {readbacks} readbacks of a field, forward and backward");
    }
}
