//! The hash encoding of [`crate::cpu::hash`]: features with their Jacobian, and the scatter of
//! their gradients.

use super::device::{Atomics, Buffer, Device, MAX_GROUPS, Words, launch};
use super::sum::{Exchange, FIXED_POINT_RANGE, Fixed, Native, Sum, group_sum};
use super::vec3::Vec3;
use crate::cpu::hash::Level;
use crate::cpu::mlp::TILE;
use burn::cubecl::{self, prelude::*};

/// Number of samples per group of threads.
const GROUP: u32 = 256;

/// Number of groups of threads that compute the bound on the sums of a level.
const BOUNDING: usize = 64;

/// Largest number of groups of threads that interpolate a level, or add to it: enough to fill a
/// large card. They step through the samples, since their capacity is several times their usual
/// number, and idle groups cost time, too.
const STEPPING: u32 = 128;

/// Returns the groups that step through `capacity` samples of so many levels.
fn stepping_groups(capacity: usize, levels: usize) -> CubeCount {
    CubeCount::Static((capacity as u32).div_ceil(GROUP).min(STEPPING), levels as u32, 1)
}

/// Number of words that describe a level: scale, resolution, entries, offset, whether it is hashed.
const LEVEL: usize = 5;

/// The cell of a position at a level: its lowest corner and the position inside it.
#[derive(CubeType)]
struct Cell {
    low_x: u32,
    low_y: u32,
    low_z: u32,
    inside: Vec3,
}

/// Returns the cell of sample `s`.
#[cube]
fn cell(levels: &[u32], level: usize, x: &[f32], s: usize, capacity: usize, world: f32) -> Cell {
    let scale = f32::reinterpret(levels[level * LEVEL]);
    let px = fma(scale, x[s] * world + 0.5f32, 0.5f32);
    let py = fma(scale, x[capacity + s] * world + 0.5f32, 0.5f32);
    let pz = fma(scale, x[2 * capacity + s] * world + 0.5f32, 0.5f32);
    let (lx, ly, lz) = (px.floor(), py.floor(), pz.floor());
    Cell {
        low_x: u32::cast_from(i32::cast_from(lx)),
        low_y: u32::cast_from(i32::cast_from(ly)),
        low_z: u32::cast_from(i32::cast_from(lz)),
        inside: Vec3::new(px - lx, py - ly, pz - lz),
    }
}

/// Returns the entry of corner `k`, which lies at +1 along x if bit 0 is set, along y for bit 1 and
/// along z for bit 2.
#[cube]
fn entry(levels: &[u32], level: usize, cell: &Cell, #[comptime] k: u32) -> usize {
    let (x, y, z) = (cell.low_x + (k & 1), cell.low_y + ((k >> 1) & 1), cell.low_z + (k >> 2));
    let entries = levels[level * LEVEL + 2];
    let r = levels[level * LEVEL + 1];
    let index = if levels[level * LEVEL + 4] == 1 {
        (x ^ (y * 2_654_435_761u32) ^ (z * 805_459_861u32)) & (entries - 1)
    } else {
        (x + r * (y + r * z)) % entries
    };
    (levels[level * LEVEL + 3] + index) as usize
}

/// Returns the weight of a corner along one axis.
#[cube]
fn along(f: f32, #[comptime] up: bool) -> f32 {
    if up { 0.5f32 + (f - 0.5f32) } else { 0.5f32 - (f - 0.5f32) }
}

/// Returns `v` times the slope of that weight.
#[cube]
fn signed(v: f32, #[comptime] up: bool) -> f32 {
    if up { v } else { -v }
}

/// Writes features of all levels, planes `[2 · levels, capacity]`, and their slopes, planes
/// `[2 · levels · 3, capacity]`. Levels from `active` on are zero, and so are samples from
/// `count[0]` to the end of the last tile.
#[cube(launch)]
fn gather(
    table: &[Vector<f32, Const<2>>],
    levels: &[u32],
    x: &[f32],
    count: &[u32],
    value: &mut [f32],
    jacobian: &mut [f32],
    capacity: u32,
    active: u32,
    world: f32,
    #[comptime] slopes: bool,
) {
    let capacity = capacity as usize;
    let level = CUBE_POS_Y as usize;
    let end = (count[0] as usize).div_ceil(TILE) * TILE;
    let step = CUBE_COUNT_X as usize * GROUP as usize;
    for s in range_stepped(ABSOLUTE_POS_X as usize, min(end, capacity), step) {
        let mut v = Vector::<f32, Const<2>>::new(0.0f32);
        let mut jx = Vector::<f32, Const<2>>::new(0.0f32);
        let mut jy = Vector::<f32, Const<2>>::new(0.0f32);
        let mut jz = Vector::<f32, Const<2>>::new(0.0f32);
        if s < count[0] as usize && level < active as usize {
            let cell = cell(levels, level, x, s, capacity, world);
            let slope = f32::reinterpret(levels[level * LEVEL]) * world;
            #[unroll]
            for k in 0..8u32 {
                let (ux, uy, uz) = comptime!((k & 1 == 1, k & 2 == 2, k & 4 == 4));
                let e = table[entry(levels, level, &cell, k)];
                let f = cell.inside;
                let (wx, wy, wz) = (along(f.x, ux), along(f.y, uy), along(f.z, uz));
                v += e * Vector::new(wx * wy * wz);
                if slopes {
                    jx += e * Vector::new(signed(wy * wz * slope, ux));
                    jy += e * Vector::new(signed(wx * wz * slope, uy));
                    jz += e * Vector::new(signed(wx * wy * slope, uz));
                }
            }
        }
        #[unroll]
        for f in 0..2usize {
            let plane = 2 * level + f;
            value[plane * capacity + s] = v.extract(f);
            if slopes {
                jacobian[3 * plane * capacity + s] = jx.extract(f);
                jacobian[(3 * plane + 1) * capacity + s] = jy.extract(f);
                jacobian[(3 * plane + 2) * capacity + s] = jz.extract(f);
            }
        }
    }
}

/// Adds the gradient with respect to the table: see [`crate::cpu::hash::scatter`].
#[cube(launch)]
fn scatter<S: Sum>(
    gradient: &[Atomic<S::Word>],
    levels: &[u32],
    x: &[f32],
    count: &[u32],
    g_value: &[f32],
    q: &[f32],
    g_normal: &[f32],
    units: &[f32],
    capacity: u32,
    world: f32,
    #[comptime] slopes: bool,
) {
    let capacity = capacity as usize;
    let level = CUBE_POS_Y as usize;
    let unit = units[level];
    let step = CUBE_COUNT_X as usize * GROUP as usize;
    for s in range_stepped(ABSOLUTE_POS_X as usize, min(count[0] as usize, capacity), step) {
        let cell = cell(levels, level, x, s, capacity, world);
        let plane = 2 * level * capacity + s;
        let (g0, g1) = (g_value[plane], g_value[plane + capacity]);
        let mut q0 = 0.0f32;
        let mut q1 = 0.0f32;
        let mut n = Vec3::zero();
        if slopes {
            let slope = f32::reinterpret(levels[level * LEVEL]) * world;
            n = Vec3::read(g_normal, capacity, s) * slope;
            q0 = q[plane];
            q1 = q[plane + capacity];
        }
        #[unroll]
        for k in 0..8u32 {
            let (ux, uy, uz) = comptime!((k & 1 == 1, k & 2 == 2, k & 4 == 4));
            let f = cell.inside;
            let (wx, wy, wz) = (along(f.x, ux), along(f.y, uy), along(f.z, uz));
            let w = wx * wy * wz;
            let d = signed(n.x * (wy * wz), ux) + signed(n.y * (wx * wz), uy) + signed(n.z * (wx * wy), uz);
            let e = 2 * entry(levels, level, &cell, k);
            S::add(&gradient[e], g0 * w + q0 * d, unit);
            S::add(&gradient[e + 1], g1 * w + q1 * d, unit);
        }
    }
}

/// Writes partial sums of a bound on the sums of each level, `[levels, BOUNDING]`. The bound is the
/// sum of all contributions, as if they went to one entry. Each level has [`BOUNDING`] groups of
/// threads, each of which sums its own samples in a fixed order.
#[cube(launch)]
fn bound(
    levels: &[u32],
    count: &[u32],
    g_value: &[f32],
    q: &[f32],
    g_normal: &[f32],
    partial: &mut [f32],
    capacity: u32,
    world: f32,
    #[comptime] slopes: bool,
) {
    let capacity = capacity as usize;
    let level = CUBE_POS_Y as usize;
    let slope = f32::reinterpret(levels[level * LEVEL]) * world;
    let mut sum = 0.0f32;
    for s in range_stepped(ABSOLUTE_POS_X as usize, count[0] as usize, BOUNDING * GROUP as usize) {
        let plane = 2 * level * capacity + s;
        sum += max(g_value[plane].abs(), g_value[plane + capacity].abs());
        if slopes {
            let n = g_normal[s].abs() + g_normal[capacity + s].abs() + g_normal[2 * capacity + s].abs();
            sum += max(q[plane].abs(), q[plane + capacity].abs()) * n * slope;
        }
    }
    let total = group_sum::<f32>(sum, GROUP as usize);
    if UNIT_POS == 0 {
        partial[level * BOUNDING + CUBE_POS_X as usize] = total;
    }
}

/// Writes the scale of the fixed-point sums of each level: the number of integer steps per 1.
#[cube(launch)]
fn fixed_point_scales(partial: &[f32], units: &mut [f32]) {
    let level = ABSOLUTE_POS;
    if level < units.len() {
        let mut total = 0.0f32;
        for i in 0..BOUNDING {
            total += partial[level * BOUNDING + i];
        }
        // the lower bound keeps the scale finite if nothing is added
        units[level] = FIXED_POINT_RANGE / max(total, 1e-28f32);
    }
}

/// Converts the fixed-point sums to floats, in place.
#[cube(launch)]
fn fixed_point_to_float(gradient: &mut [u32], levels: &[u32], units: &[f32]) {
    let level = CUBE_POS_Y as usize;
    let first = 2 * levels[level * LEVEL + 3] as usize;
    let end = first + 2 * levels[level * LEVEL + 2] as usize;
    for i in range_stepped(first + ABSOLUTE_POS_X as usize, end, CUBE_COUNT_X as usize * GROUP as usize) {
        gradient[i] = u32::reinterpret(f32::cast_from(i32::reinterpret(gradient[i])) / units[level]);
    }
}

/// A hash grid on a device.
pub struct Grid {
    levels: Buffer,
    partial: Buffer,
    units: Buffer,
    count: usize,
    active: usize,
    /// Entries of the largest level.
    largest: usize,
    /// d x01 / d position.
    world: f32,
}

impl Grid {
    /// Creates a grid over `[-radius, radius]³`, of whose levels the first `active` are used.
    pub fn new(device: &Device, levels: &[Level], active: usize, radius: f32) -> Grid {
        let words = |l: &Level| {
            [l.scale.to_bits(), l.resolution, l.entries, l.offset as u32, u32::from(l.is_hashed())]
        };
        Grid {
            levels: device.upload(&levels.iter().flat_map(words).collect::<Vec<u32>>()),
            partial: device.zeros::<f32>(BOUNDING * levels.len()),
            units: device.zeros::<f32>(levels.len()),
            count: levels.len(),
            active,
            largest: levels.iter().map(|l| l.entries as usize).max().unwrap_or(0),
            world: 0.5 / radius,
        }
    }

    /// Sets the number of active levels.
    pub fn activate(&mut self, levels: usize) {
        assert!(levels <= self.count);
        self.active = levels;
    }

    /// Writes features and, if `jacobian` is given, their Jacobian with respect to position.
    ///
    /// # Shapes
    ///
    /// - table: `[entries, 2]`; x: planes `[3, capacity]`; count: `[1]`, the number of samples
    /// - value: planes `[2 · levels, capacity]`; jacobian: planes `[2 · levels · 3, capacity]`,
    ///   zeros after the last sample
    pub fn gather(
        &self,
        device: &Device,
        table: &Buffer,
        x: &Buffer,
        count: &Buffer,
        value: &Buffer,
        jacobian: Option<&Buffer>,
    ) {
        let capacity = x.word_count() / 3;
        let groups = stepping_groups(capacity, self.count);
        launch!(device, gather::launch, groups, GROUP;
            table, self.levels, x, count, value, jacobian.unwrap_or(value);
            capacity as u32, self.active as u32, self.world, jacobian.is_some()
        );
    }

    /// Adds the gradient with respect to the table, which must be zero before: see
    /// [`crate::cpu::hash::scatter`]. With [`Atomics::Fixed`] it may be called only once per step.
    ///
    /// # Shapes
    ///
    /// - gradient: `[entries, 2]`; x: planes `[3, capacity]`; g_value: planes
    ///   `[2 · levels, capacity]`
    /// - slopes, if the Jacobian has a gradient: `q`, shaped like `g_value`, and `g_normal`, shaped
    ///   like `x`
    pub fn scatter(
        &self,
        device: &Device,
        gradient: &Buffer,
        x: &Buffer,
        count: &Buffer,
        g_value: &Buffer,
        slopes: Option<[&Buffer; 2]>,
    ) {
        let [q, g_normal] = slopes.unwrap_or([g_value, x]);
        let capacity = x.word_count() / 3;
        let fixed = device.atomics() == Atomics::Fixed;
        if fixed {
            let groups = CubeCount::Static(BOUNDING as u32, self.active as u32, 1);
            launch!(device, bound::launch, groups, GROUP;
                self.levels, count, g_value, q, g_normal, self.partial;
                capacity as u32, self.world, slopes.is_some()
            );
            let groups = CubeCount::new_1d((self.count as u32).div_ceil(GROUP));
            launch!(device, fixed_point_scales::launch, groups, GROUP; self.partial, self.units);
        }
        let scatter = match device.atomics() {
            Atomics::Native => scatter::launch::<Native>,
            Atomics::Exchange => scatter::launch::<Exchange>,
            Atomics::Fixed => scatter::launch::<Fixed>,
        };
        let groups = stepping_groups(capacity, self.active);
        launch!(device, scatter, groups, GROUP;
            gradient, self.levels, x, count, g_value, q, g_normal, self.units;
            capacity as u32, self.world, slopes.is_some()
        );
        if fixed {
            let groups = (2 * self.largest as u32).div_ceil(GROUP).min(MAX_GROUPS);
            let count = CubeCount::Static(groups, self.active as u32, 1);
            launch!(device, fixed_point_to_float::launch, count, GROUP; gradient, self.levels, self.units);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{agree, device, devices, planes};
    use super::*;
    use crate::cpu::hash;
    use tiface_base::math::rng;

    const SAMPLES: usize = 1000;
    const CAPACITY: usize = 1024;
    const RADIUS: f32 = 2.0;

    /// Returns the published grid with smaller tables, and samples anywhere in the box. Positions
    /// and scales have few digits, so that multiply-add gives the same result whether it is fused
    /// or not.
    fn grid() -> (Vec<hash::Level>, Vec<[f32; 2]>, Vec<[f32; 3]>) {
        let mut levels = hash::levels(16, 16, 1.447, 12);
        levels.iter_mut().for_each(|l| l.scale = l.scale.round());
        let table =
            (0..hash::entries(&levels)).map(|i| [(i as f32 * 0.73).sin(), (i as f32 * 0.31).cos()]).collect();
        let at = |i: usize| rng::below(1, 2, i as u64, 1025) as f32 / 256.0 - RADIUS;
        (levels, table, (0..SAMPLES).map(|i| [at(3 * i), at(3 * i + 1), at(3 * i + 2)]).collect())
    }

    fn inside(x: &[[f32; 3]]) -> Vec<[f32; 3]> {
        x.iter().map(|p| p.map(|c| c * (0.5 / RADIUS) + 0.5)).collect()
    }

    fn filled<const W: usize>(stream: u64) -> Vec<[f32; W]> {
        let at = |i: usize| rng::normal(1, stream, i as u64);
        (0..SAMPLES).map(|s| std::array::from_fn(|k| at(W * s + k))).collect()
    }

    #[test]
    fn features_and_slopes_are_those_of_the_cpu() {
        let Some(device) = device() else { return };
        let (levels, table, x) = grid();
        let n = levels.len();
        let mut value = vec![[0f32; 2]; n * SAMPLES];
        let blocks = SAMPLES.div_ceil(hash::LANES);
        let mut jacobian = vec![[[0f32; hash::LANES]; 6]; n * blocks];
        hash::gather(&levels, &table, &inside(&x), 0.5 / RADIUS, &mut value, Some(&mut jacobian));
        let want = |l: usize| &value[l * SAMPLES..][..SAMPLES];
        let want: Vec<f32> = (0..n).flat_map(|l| planes(want(l), CAPACITY)).collect();
        let slope = |i: usize| jacobian[i / hash::LANES].map(|lanes| lanes[i % hash::LANES]);
        let rows = |l: usize| -> Vec<[f32; 6]> {
            (0..SAMPLES).map(|s| slope(l * blocks * hash::LANES + s)).collect()
        };
        let slopes: Vec<f32> = (0..n).flat_map(|l| planes(&rows(l), CAPACITY)).collect();

        let device_grid = Grid::new(&device, &levels, levels.len(), RADIUS);
        let (table, x) = (device.upload(table.as_flattened()), device.upload(&planes(&x, CAPACITY)));
        let (v, j) = (device.scratch::<f32>(want.len()), device.scratch::<f32>(slopes.len()));
        let count = device.upload(&[SAMPLES as u32]);
        device_grid.gather(&device, &table, &x, &count, &v, Some(&j));
        let (value, jacobian) = (device.read::<f32>(&v), device.read::<f32>(&j));
        for l in 0..n {
            let span = |planes: usize| l * planes * CAPACITY..(l + 1) * planes * CAPACITY;
            agree("hash features", &value[span(2)], &want[span(2)], 1e-5);
            agree("hash slopes", &jacobian[span(6)], &slopes[span(6)], 1e-5);
        }
        device_grid.gather(&device, &table, &x, &count, &v, None);
        assert_eq!(device.read::<f32>(&v), value);
    }

    #[test]
    fn the_scatter_is_that_of_the_cpu_with_all_atomics() {
        let (levels, table, x) = grid();
        let n = levels.len();
        let pair = |stream: u64| -> Vec<[f32; 2]> {
            (0..n as u64).flat_map(|l| filled::<2>(100 * stream + l)).collect()
        };
        let (g, q, normal) = (pair(1), pair(2), filled::<3>(5));
        let wanted = |q: &[[f32; 2]], normal: &[[f32; 3]]| {
            let mut want = vec![[0f32; 2]; table.len()];
            hash::scatter(&levels, &mut want, &inside(&x), 0.5 / RADIUS, &g, q, normal);
            want
        };
        let none = (vec![[0.0; 2]; q.len()], vec![[0.0; 3]; normal.len()]);
        let [want, want_values] = [wanted(&q, &normal), wanted(&none.0, &none.1)];
        for device in devices() {
            let device_grid = Grid::new(&device, &levels, levels.len(), RADIUS);
            let x = device.upload(&planes(&x, CAPACITY));
            let count = device.upload(&[SAMPLES as u32]);
            let level_planes = |v: &[[f32; 2]]| -> Vec<f32> {
                (0..n).flat_map(|l| planes(&v[l * SAMPLES..][..SAMPLES], CAPACITY)).collect()
            };
            let (g, q) = (device.upload(&level_planes(&g)), device.upload(&level_planes(&q)));
            let normal = device.upload(&planes(&normal, CAPACITY));
            for (slopes, want) in [(Some([&q, &normal]), &want), (None, &want_values)] {
                let once = || {
                    let gradient = device.zeros::<f32>(2 * table.len());
                    device_grid.scatter(&device, &gradient, &x, &count, &g, slopes);
                    device.read::<f32>(&gradient)
                };
                let got = once();
                for l in &levels {
                    let span = 2 * l.offset..2 * (l.offset + l.entries as usize);
                    let want = want[l.offset..][..l.entries as usize].as_flattened();
                    agree(&format!("{:?} scatter", device.atomics()), &got[span], want, 1e-5);
                }
                if device.atomics() == Atomics::Fixed {
                    assert_eq!(got, once(), "fixed-point sums do not depend device_grid the order");
                }
            }
        }
    }

    #[test]
    fn sums_of_a_level_need_not_fit_in_one_launch_of_a_group_for_each() {
        let Some(device) = device().map(|d| d.with_atomics(Atomics::Fixed)) else { return };
        // a dense level with a little more floats than groups of 256 in one launch
        let levels = hash::levels(1, 204, 1.5, 24);
        let entries = hash::entries(&levels);
        assert!(2 * entries > 256 * MAX_GROUPS as usize && entries < 1 << 24);
        // the first of them at the end of the level
        let x = [[1.984_375f32; 3], [-1.5, 1.25, 0.5]];
        let g = [[1.0f32, -2.0], [0.5, 4.0]];
        let mut want = vec![[0f32; 2]; entries];
        hash::scatter(&levels, &mut want, &inside(&x), 0.5 / RADIUS, &g, &[[0.0; 2]; 2], &[[0.0; 3]; 2]);
        let [planes_of_x, planes_of_g] = [planes(&x, 64), planes(&g, 64)].map(|v| device.upload(&v));
        let gradient = device.zeros::<f32>(2 * entries);
        let count = device.upload(&[2u32]);
        let grid = Grid::new(&device, &levels, 1, RADIUS);
        grid.scatter(&device, &gradient, &planes_of_x, &count, &planes_of_g, None);
        let got = device.read::<f32>(&gradient);
        let worst = got.iter().zip(want.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0f32, f32::max);
        let touched = got.iter().filter(|v| **v != 0.0).count();
        println!("{entries} entries, {touched} floats changed, error {worst:.1e}");
        assert!(touched >= 8 && worst < 1e-6, "{touched} {worst}");
        assert!(got[256 * MAX_GROUPS as usize..].iter().any(|v| *v != 0.0));
    }
}
