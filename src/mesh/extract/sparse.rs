//! Sparse extraction of the zero level set of an expensive field: only nodes near the surface are evaluated.
//!
//! 1. Every `coarse_step`-th node of the grid, along each axis, is evaluated (every 8th: 0.2 %).
//! 2. So is every node along the coarse edges that change sign.
//! 3. **Flood.** Whenever two evaluated neighbours differ in sign, all four cells around that edge are
//!    evaluated, until none is left. The rule depends on evaluated nodes only, so the surface it leaves is
//!    closed by construction, and equal to the dense one on every piece it met.
//!
//! A piece that lies between coarse nodes is missed: take a finer coarse step for that. Nodes on the outer faces of the grid count as outside; so do nodes for
//! outside the hull, without evaluating the field. Waves of a flood that starts everywhere are few
//! and large, so that the field is evaluated at thousands of points at a time.
//!
//! # Blocks
//!
//! The evaluated nodes of a sparse grid, in blocks of 8³ nodes kept only near the surface, and the
//! surface through them.
//!
//! A plane of a block is one word, bit `x + 8 y`. An edge belongs to the block of its lower node, so a
//! vertex on a block's border has one owner and one index: the block's first plus a count of bits before
//! it. Nothing is merged by distance.

use super::marching::{LevelSet, PartCounts, cell_point, edge_point, largest_neighbour, sided};
use super::marching_cell::{CASES, CellOutput, CellSurface, EDGES, crossed, crossing, resolve};
use super::{BATCH, NodeGrid};
use crate::geom::SdfField;
use crate::mesh::{check_len, setting};
use crate::{Monitor, Result};
use glam::Vec3;
use rayon::prelude::*;

/// A surface and the cost of its extraction.
#[derive(Clone, Debug, Default)]
pub struct Sparse {
    /// The closed surface; empty when no piece was met.
    pub surface: LevelSet,
    /// Nodes at which the field was evaluated.
    pub evaluated: usize,
    /// Nodes that counted as outside without being evaluated.
    pub skipped: usize,
    /// Smallest and largest finite value met; infinite and swapped when none was.
    pub range: (f32, f32),
}

/// Returns the zero level set of `field` over `grid`, closed at its borders.
///
/// The first nodes evaluated lie `coarse_step` cells apart. The field is called from one thread: it may well use all of
/// them. Nodes that it excludes count as outside.
///
/// # Errors
///
/// A field that returns the wrong number of values, a coarse step other than 2, 4, 8, more vertices than 32-bit
/// indices can name, a request to stop, which is checked between batches.
pub fn sparse(
    field: &dyn SdfField,
    grid: &NodeGrid,
    coarse_step: usize,
    monitor: &dyn Monitor,
) -> Result<Sparse> {
    setting([2, 4, 8].contains(&coarse_step), "coarse_step", "2, 4 or 8", coarse_step)?;
    let lattice = grid.dims.map(|d| (d - 1) / coarse_step + 1);
    let mut flood = Flood {
        field,
        grid: *grid,
        coarse_step,
        monitor,
        lattice,
        coarse: vec![f32::NAN; lattice.iter().product()],
        blocks: Blocks::new(grid.dims),
        wanted: Vec::new(),
        cells: Vec::new(),
        out: Sparse { range: (f32::INFINITY, f32::NEG_INFINITY), ..Sparse::default() },
    };
    flood.evaluate_coarse()?;
    flood.cross()?;
    flood.spread()?;
    let Flood { mut blocks, mut out, .. } = flood;
    out.surface = blocks.surface(grid)?;
    Ok(out)
}

struct Flood<'a> {
    field: &'a dyn SdfField,
    grid: NodeGrid,
    coarse_step: usize,
    monitor: &'a dyn Monitor,
    lattice: [usize; 3],
    /// `[z, y, x]` over the lattice: NaN where not evaluated (border) or not a number: outside.
    coarse: Vec<f32>,
    blocks: Blocks,
    /// Nodes marked as known whose value is still to come.
    wanted: Vec<[usize; 3]>,
    /// Cells that are queued and not yet processed.
    cells: Vec<[usize; 3]>,
    out: Sparse,
}

impl Flood<'_> {
    /// Returns the values at nodes, outside ones without evaluating them. Order as given.
    fn evaluate(&mut self, nodes: &[[usize; 3]]) -> Result<Vec<f32>> {
        let mut values = Vec::with_capacity(nodes.len());
        for nodes in nodes.chunks(BATCH) {
            self.monitor.check_stop()?;
            let points: Vec<Vec3> = nodes.iter().map(|&n| self.grid.point(n)).collect();
            // One cell is a fair guess of how far outside a skipped node is.
            let mut batch = vec![self.grid.spacing; points.len()];
            let keep: Vec<usize> = (0..points.len()).filter(|&i| !self.field.excludes(points[i])).collect();
            let evaluated: Vec<Vec3> = keep.iter().map(|&i| points[i]).collect();
            let answer = if evaluated.is_empty() { Vec::new() } else { self.field.sdf(&evaluated) };
            check_len("signed distance", evaluated.len(), answer.len())?;
            for (&i, &v) in keep.iter().zip(&answer) {
                batch[i] = v;
                if v.is_finite() {
                    let (low, high) = self.out.range;
                    self.out.range = (low.min(v), high.max(v));
                }
            }
            self.out.evaluated += evaluated.len();
            self.out.skipped += points.len() - evaluated.len();
            values.extend(batch);
        }
        Ok(values)
    }

    fn lattice_index(&self, at: [usize; 3]) -> usize {
        (at[2] * self.lattice[1] + at[1]) * self.lattice[0] + at[0]
    }

    fn lattice_points(&self) -> impl Iterator<Item = [usize; 3]> + use<> {
        let [nx, ny, nz] = self.lattice;
        (0..nz).flat_map(move |z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])))
    }

    fn evaluate_coarse(&mut self) -> Result<()> {
        let step = self.coarse_step;
        let nodes: Vec<[usize; 3]> =
            self.lattice_points().map(|l| l.map(|c| c * step)).filter(|&n| !self.grid.on_border(n)).collect();
        let values = self.evaluate(&nodes)?;
        for (n, v) in nodes.iter().zip(values) {
            let i = self.lattice_index(n.map(|c| c / step));
            self.coarse[i] = v;
        }
        Ok(())
    }

    /// Returns whether a lattice node is inside. A node that was not evaluated is not.
    fn coarse_inside(&self, at: [usize; 3]) -> bool {
        self.coarse[self.lattice_index(at)] < 0.0
    }

    /// Evaluates every node along the coarse edges that change sign.
    fn cross(&mut self) -> Result<()> {
        let step = self.coarse_step;
        for l in self.lattice_points() {
            for axis in 0..3 {
                let last = l[axis] + 1 == self.lattice[axis];
                let mut next = l;
                next[axis] += 1;
                // Past the last lattice node lies the border, which is outside.
                let crossed = self.coarse_inside(l) != (!last && self.coarse_inside(next));
                let low = l[axis] * step;
                let high = if last { self.grid.dims[axis] - 1 } else { low + step };
                for c in (low..=high).filter(|_| crossed && high > low) {
                    let mut node = l.map(|c| c * step);
                    node[axis] = c;
                    self.want(node);
                }
            }
        }
        self.settle()
    }

    /// Returns the lattice's value of a node, where it has been evaluated.
    fn lattice_value(&self, node: [usize; 3]) -> Option<f32> {
        let step = self.coarse_step;
        (node.iter().all(|c| c % step == 0) && !self.grid.on_border(node))
            .then(|| self.coarse[self.lattice_index(node.map(|c| c / step))])
    }

    /// Adds a node to the next batch, unless its value is known.
    fn want(&mut self, node: [usize; 3]) {
        if self.blocks.claim(node) {
            self.wanted.push(node);
        }
    }

    /// Evaluates the wanted nodes and queues the cells around every crossed edge.
    fn settle(&mut self) -> Result<()> {
        let nodes = std::mem::take(&mut self.wanted);
        let (old, new): (Vec<_>, Vec<_>) = nodes.iter().partition(|&&n| self.lattice_value(n).is_some());
        for &n in &old {
            let value = self.lattice_value(n).unwrap_or(f32::NAN);
            self.blocks.set(n, value, true);
        }
        let values = self.evaluate(&new)?;
        for (&n, v) in new.iter().zip(values) {
            self.blocks.set(n, v, !self.grid.on_border(n));
        }
        for &n in &nodes {
            let inside = self.blocks.inside(n);
            for axis in 0..3 {
                for forward in [false, true] {
                    let mut m = n;
                    if forward {
                        m[axis] += 1;
                        if m[axis] == self.grid.dims[axis] {
                            continue;
                        }
                    } else if m[axis] == 0 {
                        continue;
                    } else {
                        m[axis] -= 1;
                    }
                    let other = self.blocks.known(m).or_else(|| Some(self.lattice_value(m)? < 0.0));
                    if other.is_some_and(|o| o != inside) {
                        self.queue_around(if forward { n } else { m }, axis);
                    }
                }
            }
        }
        Ok(())
    }

    /// Queues the up to four cells that share the edge leaving `node` along `axis`.
    fn queue_around(&mut self, node: [usize; 3], axis: usize) {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for (du, dv) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let mut cell = node;
            if cell[u] < du || cell[v] < dv {
                continue;
            }
            cell[u] -= du;
            cell[v] -= dv;
            if (0..3).all(|a| cell[a] + 1 < self.grid.dims[a]) && self.blocks.claim_cell(cell) {
                self.cells.push(cell);
            }
        }
    }

    /// Floods until no crossed edge has a cell that was not evaluated.
    fn spread(&mut self) -> Result<()> {
        while !self.cells.is_empty() {
            for cell in std::mem::take(&mut self.cells) {
                for c in 0..8 {
                    self.want([cell[0] + (c & 1), cell[1] + (c >> 1 & 1), cell[2] + (c >> 2)]);
                }
            }
            self.settle()?;
        }
        Ok(())
    }
}

const NONE: u32 = u32::MAX;
/// The bits of a plane with x = 0, and with x = 7.
const FIRST_COLUMN: u64 = 0x0101_0101_0101_0101;
const LAST_COLUMN: u64 = FIRST_COLUMN << 7;

struct Block {
    /// Lowest node.
    start: [usize; 3],
    known: [u64; 8],
    inside: [u64; 8],
    /// Cells, by their lowest node, that the surface may cross and whose nodes are all known.
    cells: [u64; 8],
    values: [f32; 512],
}

/// Numbers of the vertices on a block's edges.
struct Owner {
    crossed: [[u64; 8]; 3],
    /// Vertices before each plane of each axis.
    before: [[u32; 8]; 3],
}

/// Blocks by a directory over the whole grid, four bytes for 512 nodes.
struct Blocks {
    dims: [usize; 3],
    per_axis: [usize; 3],
    directory: Vec<u32>,
    /// Boxed: two kilobytes each, and a growing list would copy them all.
    #[allow(clippy::vec_box)]
    blocks: Vec<Box<Block>>,
    non_finite: Vec<[usize; 3]>,
}

fn bit_of(node: [usize; 3]) -> (usize, u64) {
    (node[2] & 7, 1 << ((node[0] & 7) + 8 * (node[1] & 7)))
}

impl Blocks {
    fn new(dims: [usize; 3]) -> Blocks {
        let per_axis = dims.map(|d| d.div_ceil(8));
        let directory = vec![NONE; per_axis.iter().product()];
        Blocks { dims, per_axis, directory, blocks: Vec::new(), non_finite: Vec::new() }
    }

    fn slot(&self, node: [usize; 3]) -> usize {
        ((node[2] >> 3) * self.per_axis[1] + (node[1] >> 3)) * self.per_axis[0] + (node[0] >> 3)
    }

    fn find(&self, node: [usize; 3]) -> Option<&Block> {
        self.blocks.get(self.directory[self.slot(node)] as usize).map(|b| &**b)
    }

    fn make(&mut self, node: [usize; 3]) -> &mut Block {
        let slot = self.slot(node);
        if self.directory[slot] == NONE {
            self.directory[slot] = self.blocks.len() as u32;
            let start = node.map(|c| c & !7);
            let empty = [0; 8];
            self.blocks.push(Box::new(Block {
                start,
                known: empty,
                inside: empty,
                cells: empty,
                values: [0.0; 512],
            }));
        }
        &mut self.blocks[self.directory[slot] as usize]
    }

    /// Marks a node as known; true when it was not. Its value must follow with [`Blocks::set`].
    fn claim(&mut self, node: [usize; 3]) -> bool {
        let (plane, bit) = bit_of(node);
        let word = &mut self.make(node).known[plane];
        let fresh = *word & bit == 0;
        *word |= bit;
        fresh
    }

    /// Marks a cell as evaluated; true when it was not.
    fn claim_cell(&mut self, cell: [usize; 3]) -> bool {
        let (plane, bit) = bit_of(cell);
        let word = &mut self.make(cell).cells[plane];
        let fresh = *word & bit == 0;
        *word |= bit;
        fresh
    }

    /// A node's value; it is inside when below zero and `may_be_inside`.
    fn set(&mut self, node: [usize; 3], value: f32, may_be_inside: bool) {
        if !value.is_finite() {
            self.non_finite.push(node);
        }
        let (plane, bit) = bit_of(node);
        let block = self.make(node);
        block.values[64 * plane + bit.trailing_zeros() as usize] = value;
        if value < 0.0 && may_be_inside {
            block.inside[plane] |= bit;
        }
    }

    /// Returns whether a known node is inside.
    fn inside(&self, node: [usize; 3]) -> bool {
        self.known(node) == Some(true)
    }

    /// Returns the side of a node, when known.
    fn known(&self, node: [usize; 3]) -> Option<bool> {
        let block = self.find(node)?;
        let (plane, bit) = bit_of(node);
        (block.known[plane] & bit != 0).then_some(block.inside[plane] & bit != 0)
    }

    fn value(&self, node: [usize; 3]) -> f32 {
        let (plane, bit) = bit_of(node);
        self.find(node).map_or(f32::NAN, |b| b.values[64 * plane + bit.trailing_zeros() as usize])
    }

    /// As in the dense volume: the size of the largest finite known neighbour, 1 without any.
    fn repair(&mut self, out: &mut LevelSet) {
        let nodes = std::mem::take(&mut self.non_finite);
        out.non_finite = nodes.len();
        let sizes: Vec<f32> = nodes
            .iter()
            .map(|&n| {
                largest_neighbour(n, self.dims, |m| match self.known(m) {
                    Some(_) => self.value(m),
                    None => f32::NAN,
                })
            })
            .collect();
        for (&n, size) in nodes.iter().zip(sizes) {
            let (plane, bit) = bit_of(n);
            let value = &mut self.make(n).values[64 * plane + bit.trailing_zeros() as usize];
            *value = if *value == f32::NEG_INFINITY { -size } else { size };
        }
    }

    /// Returns the closed surface through all evaluated cells, blocks in order of z, y, x.
    fn surface(&mut self, grid: &NodeGrid) -> Result<LevelSet> {
        let mut out = LevelSet::default();
        self.repair(&mut out);
        // Blocks in grid order, independent of the order in which the flood met them.
        let order: Vec<usize> = self.directory.iter().filter(|&&b| b != NONE).map(|&b| b as usize).collect();
        let mut owners: Vec<Owner> = Vec::with_capacity(self.blocks.len());
        self.blocks.par_iter().map(|b| self.owner(b)).collect_into_vec(&mut owners);

        let counts: Vec<PartCounts> =
            order.par_iter().map(|&b| self.count(&self.blocks[b], &owners[b])).collect();
        let parts = out.share_out(&counts)?;
        let mut firsts = vec![0u32; self.blocks.len()];
        order.iter().zip(&parts).for_each(|(&b, part)| firsts[b] = part.first);
        order.par_iter().zip(parts).for_each(|(&b, part)| {
            self.place(b, &owners[b], grid, part.vertices);
            self.connect(b, &owners, &firsts, grid, part.cells);
        });
        out.capped = self
            .blocks
            .iter()
            .map(|b| {
                let nodes = (0..512).filter(|&n| b.values[n] < 0.0);
                nodes.filter(|n| b.known[n / 64] & !b.inside[n / 64] & 1 << (n % 64) != 0).count()
            })
            .sum();
        Ok(out)
    }

    /// Returns the block after `block` along `axis`.
    fn after(&self, block: &Block, axis: usize) -> Option<&Block> {
        let mut node = block.start;
        node[axis] += 8;
        (node[axis] < self.dims[axis]).then(|| self.find(node))?
    }

    /// Edges whose two nodes are known and differ.
    fn owner(&self, block: &Block) -> Owner {
        let next = [0, 1, 2].map(|axis| self.after(block, axis));
        let shifted = |axis: usize, pick: fn(&Block) -> &[u64; 8], z: usize| {
            let own = pick(block);
            let other = |z: usize| next[axis].map_or(0, |n| pick(n)[z]);
            match axis {
                0 => (own[z] & !FIRST_COLUMN) >> 1 | (other(z) << 7 & LAST_COLUMN),
                1 => own[z] >> 8 | other(z) << 56,
                _ if z < 7 => own[z + 1],
                _ => other(0),
            }
        };
        let mut owner = Owner { crossed: [[0; 8]; 3], before: [[0; 8]; 3] };
        let mut count = 0;
        for axis in 0..3 {
            for z in 0..8 {
                let word = (block.inside[z] ^ shifted(axis, |b| &b.inside, z))
                    & block.known[z]
                    & shifted(axis, |b| &b.known, z);
                owner.crossed[axis][z] = word;
                owner.before[axis][z] = count;
                count += word.count_ones();
            }
        }
        owner
    }

    /// Returns the eight blocks that hold the corners of this block's cells, by corner of the 2³ blocks.
    fn around(&self, block: &Block) -> [u32; 8] {
        std::array::from_fn(|c| {
            let node: [usize; 3] = std::array::from_fn(|a| block.start[a] + 8 * (c >> a & 1));
            if (0..3).all(|a| node[a] < self.dims[a]) { self.directory[self.slot(node)] } else { NONE }
        })
    }

    /// Calls `visit(cell, case, values)` for the evaluated cells of a block; values only when the case
    /// needs them.
    fn for_each_cell(&self, block: &Block, mut visit: impl FnMut([usize; 3], u8, Option<CellSurface>)) {
        let around = self.around(block);
        for z in 0..8 {
            let mut word = block.cells[z];
            while word != 0 {
                let b = word.trailing_zeros() as usize;
                word &= word - 1;
                let local = [b & 7, b >> 3, z];
                let mut case = 0u8;
                let mut values = [0.0; 8];
                for (c, value) in values.iter_mut().enumerate() {
                    let (holder, plane, bit) = locate(local, c as u8);
                    let holder = &self.blocks[around[holder] as usize];
                    let inside = holder.inside[plane] >> bit & 1 == 1;
                    case |= u8::from(inside) << c;
                    *value = sided(holder.values[64 * plane + bit], inside);
                }
                let cell = std::array::from_fn(|a| block.start[a] + local[a]);
                let resolved = CASES[case as usize].ambiguous.then(|| resolve(case, &values));
                visit(cell, case, resolved);
            }
        }
    }

    fn count(&self, block: &Block, owner: &Owner) -> PartCounts {
        let vertices = owner.crossed.iter().flatten().map(|w| u64::from(w.count_ones())).sum();
        let mut counts = PartCounts { vertices, ..PartCounts::default() };
        self.for_each_cell(block, |_, case, resolved| match resolved {
            Some(cell) => {
                counts.inner += cell.inner.len() as u64;
                counts.triangles += cell.triangles.len() as u64;
            }
            None => counts.triangles += u64::from(CASES[case as usize].count),
        });
        counts
    }

    fn place(&self, b: usize, owner: &Owner, grid: &NodeGrid, vertices: &mut [Vec3]) {
        let block = &self.blocks[b];
        let next = [0, 1, 2].map(|axis| self.after(block, axis));
        let mut at = 0;
        for axis in 0..3 {
            for z in 0..8 {
                let mut word = owner.crossed[axis][z];
                while word != 0 {
                    let bit = word.trailing_zeros() as usize;
                    word &= word - 1;
                    let mut local = [bit & 7, bit >> 3, z];
                    let node: [usize; 3] = std::array::from_fn(|a| block.start[a] + local[a]);
                    let low = block.values[64 * z + bit];
                    local[axis] += 1;
                    let holder = if local[axis] < 8 { Some(&**block) } else { next[axis] };
                    local[axis] &= 7;
                    let high = holder.map_or(0.0, |h| h.values[64 * local[2] + local[0] + 8 * local[1]]);
                    let inside = block.inside[z] >> bit & 1 == 1;
                    let t = crossing(sided(low, inside), sided(high, !inside));
                    vertices[at] = edge_point(grid.origin, Vec3::splat(grid.spacing), node, axis, t);
                    at += 1;
                }
            }
        }
    }

    fn connect(&self, b: usize, owners: &[Owner], firsts: &[u32], grid: &NodeGrid, mut out: CellOutput) {
        let block = &self.blocks[b];
        let around = self.around(block);
        self.for_each_cell(block, |cell, case, resolved| {
            let local = [cell[0] & 7, cell[1] & 7, cell[2] & 7];
            let mut ids = [0u32; 12];
            for (e, id) in ids.iter_mut().enumerate().filter(|&(e, _)| crossed(case, e)) {
                let axis = e / 4;
                let (holder, plane, bit) = locate(local, EDGES[e][0]);
                let holder = around[holder] as usize;
                let owner = &owners[holder];
                let earlier = owner.crossed[axis][plane] & ((1 << bit) - 1);
                *id = firsts[holder] + owner.before[axis][plane] + earlier.count_ones();
            }
            let point = |at| cell_point(grid.origin, Vec3::splat(grid.spacing), cell, at);
            out.write(&CASES[case as usize], resolved, &ids, point);
        });
    }
}

/// Returns the block (of the 2³ around), plane and bit of a corner of a block's cell.
fn locate(cell: [usize; 3], corner: u8) -> (usize, usize, usize) {
    let [x, y, z] = std::array::from_fn(|a| cell[a] + (corner >> a & 1) as usize);
    ((x >> 3) | (y >> 3) << 1 | (z >> 3) << 2, z & 7, (x & 7) + 8 * (y & 7))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Quiet;
    use crate::geom::Aabb;
    use crate::mesh::fixtures::Stopping;
    use crate::mesh::{Volume, marching};

    fn ball(center: Vec3, radius: f32) -> impl Fn(Vec3) -> f32 + Sync {
        move |p| p.distance(center) - radius
    }

    fn both(field: impl Fn(Vec3) -> f32 + Sync, bounds: Aabb, resolution: usize) -> (Sparse, LevelSet) {
        let grid = NodeGrid::fit(bounds, resolution).unwrap();
        let few = sparse(&field, &grid, 8, &Quiet).unwrap();
        let mut values = Vec::new();
        for k in 0..grid.dims[2] {
            for j in 0..grid.dims[1] {
                values.extend((0..grid.dims[0]).map(|i| field(grid.point([i, j, k]))));
            }
        }
        let volume = Volume {
            dims: grid.dims,
            values: &values,
            origin: grid.origin,
            spacing: Vec3::splat(grid.spacing),
        };
        (few, marching(&volume, true).unwrap())
    }

    /// Returns the triangles as sorted positions: equal for equal surfaces, however numbered.
    fn key(s: &LevelSet) -> Vec<[[u32; 3]; 3]> {
        let mut all: Vec<_> = s
            .mesh
            .triangles
            .iter()
            .map(|t| {
                let mut c = t.map(|i| s.mesh.positions[i as usize].to_array().map(f32::to_bits));
                let first = (0..3).min_by_key(|&k| c[k]).unwrap();
                c.rotate_left(first);
                c
            })
            .collect();
        all.sort_unstable();
        all
    }

    #[test]
    fn the_grid_covers_a_long_box_with_cubes() {
        // 2 × 1 × 0.5 at 8 cells along x: h = 0.25, 8 × 4 × 2 cells.
        let b = Aabb { min: Vec3::ZERO, max: Vec3::new(2.0, 1.0, 0.5) };
        let g = NodeGrid::fit(b, 8).unwrap();
        assert_eq!((g.dims, g.spacing, g.origin), ([9, 5, 3], 0.25, Vec3::ZERO));
        assert!(NodeGrid::fit(Aabb::EMPTY, 8).is_err() && NodeGrid::fit(b, 1).is_err());
    }

    #[test]
    fn asking_few_gives_the_dense_surface() {
        let (few, dense) = both(ball(Vec3::new(0.1, -0.05, 0.02), 0.6), Aabb::SCENE, 64);
        assert_eq!(key(&few.surface), key(&dense));
        assert_eq!(few.surface.mesh.positions.len(), dense.mesh.positions.len());
        assert!(few.evaluated * 8 < 65 * 65 * 65, "{}", few.evaluated);
    }

    #[test]
    fn what_leaves_the_box_is_capped_as_in_the_dense_surface() {
        for axis in 0..3 {
            for side in [-1.0, 1.0] {
                let mut c = Vec3::splat(0.05);
                c[axis] = side;
                let (few, dense) = both(ball(c, 0.6), Aabb::SCENE, 40);
                assert_eq!(key(&few.surface), key(&dense));
                assert!(few.surface.capped > 0);
            }
        }
        let (few, dense) = both(ball(Vec3::ONE, 0.9), Aabb::SCENE, 40);
        assert_eq!(key(&few.surface), key(&dense));
    }

    #[test]
    fn a_face_in_a_block_border_and_a_tube_along_a_block_edge_survive() {
        // 64 cells of 1/32: block borders lie at multiples of 1/4; the field is zero on the plane x = 0.25.
        let slab = |p: Vec3| (p.x - 0.25).max(-0.5 - p.x).max(p.y.abs() - 0.5).max(p.z.abs() - 0.5);
        let (few, dense) = both(slab, Aabb::SCENE, 64);
        assert_eq!(key(&few.surface), key(&dense));
        let tube = |p: Vec3| (p.x - 0.25).hypot(p.y - 0.25).max(p.z.abs() - 0.6) - 0.04;
        let (few, dense) = both(tube, Aabb::SCENE, 64);
        assert!(!dense.mesh.triangles.is_empty());
        assert_eq!(key(&few.surface), key(&dense));
    }

    /// A field that excludes x > 0.1.
    struct Half<F>(F);

    impl<F: Fn(Vec3) -> f32 + Sync> SdfField for Half<F> {
        fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
            assert!(points.iter().all(|p| p.x <= 0.1));
            self.0.sdf(points)
        }

        fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
            self.0.sdf_gradient(points)
        }

        fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], _: &[Vec3]) -> Vec<[f32; 3]> {
            panic!("no color is asked for")
        }

        fn excludes(&self, point: Vec3) -> bool {
            point.x > 0.1
        }
    }

    /// A field that forgets its last point.
    struct Short;

    impl SdfField for Short {
        fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
            vec![1.0; points.len() - 1]
        }

        fn sdf_gradient(&self, _: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
            panic!("no gradient is asked for")
        }

        fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], _: &[Vec3]) -> Vec<[f32; 3]> {
            panic!("no color is asked for")
        }
    }

    #[test]
    fn a_skipped_half_is_never_evaluated_and_the_rest_is_closed_there() {
        let grid = NodeGrid::fit(Aabb::SCENE, 48).unwrap();
        let s = sparse(&Half(ball(Vec3::ZERO, 0.6)), &grid, 8, &Quiet).unwrap();
        let mesh = s.surface.mesh;
        assert!(s.skipped > 0 && mesh.is_closed());
        assert!(mesh.bounds().max.x < 0.1 + grid.spacing);
    }

    #[test]
    fn a_stop_and_a_short_answer_are_errors() {
        let grid = NodeGrid::fit(Aabb::SCENE, 16).unwrap();
        assert!(sparse(&|_: Vec3| 1.0, &grid, 8, &Stopping).unwrap_err().kind().is_stop());
        let error = sparse(&Short, &grid, 8, &Quiet).unwrap_err().to_string();
        assert!(error.contains("evaluated at 1 points and returned 0"), "{error}");
    }
}
