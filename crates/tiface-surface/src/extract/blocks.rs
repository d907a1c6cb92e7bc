//! The evaluated nodes of a sparse grid, in blocks of 8³ nodes kept only near the surface, and the
//! surface through them.
//!
//! A plane of a block is one word, bit `x + 8 y`. An edge belongs to the block of its lower node,
//! so a vertex on a block's border has one owner and one index: the block's first plus a count of
//! bits before it. Nothing is merged by distance.

use super::NodeGrid;
use super::marching::{LevelSet, PartCounts, cell_point, edge_point, largest_neighbor, sided};
use super::marching_cell::{CASES, CellOutput, CellSurface, EDGES, crossed, crossing, resolve};
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::Result;

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
pub(super) struct Blocks {
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
    pub fn new(dims: [usize; 3]) -> Blocks {
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
    pub fn claim(&mut self, node: [usize; 3]) -> bool {
        let (plane, bit) = bit_of(node);
        let word = &mut self.make(node).known[plane];
        let fresh = *word & bit == 0;
        *word |= bit;
        fresh
    }

    /// Marks a cell as evaluated; true when it was not.
    pub fn claim_cell(&mut self, cell: [usize; 3]) -> bool {
        let (plane, bit) = bit_of(cell);
        let word = &mut self.make(cell).cells[plane];
        let fresh = *word & bit == 0;
        *word |= bit;
        fresh
    }

    /// Stores the value of a node, which is inside if the value is below zero and `may_be_inside`.
    pub fn set(&mut self, node: [usize; 3], value: f32, may_be_inside: bool) {
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
    pub fn inside(&self, node: [usize; 3]) -> bool {
        self.known(node) == Some(true)
    }

    /// Returns the side of a node, when known.
    pub fn known(&self, node: [usize; 3]) -> Option<bool> {
        let block = self.find(node)?;
        let (plane, bit) = bit_of(node);
        (block.known[plane] & bit != 0).then_some(block.inside[plane] & bit != 0)
    }

    fn value(&self, node: [usize; 3]) -> f32 {
        let (plane, bit) = bit_of(node);
        self.find(node).map_or(f32::NAN, |b| b.values[64 * plane + bit.trailing_zeros() as usize])
    }

    /// Gives nodes whose value is not finite the size of their largest finite known neighbor, as in
    /// the dense volume, or 1 without any; −∞ stays negative.
    fn repair(&mut self, out: &mut LevelSet) {
        let nodes = std::mem::take(&mut self.non_finite);
        out.non_finite = nodes.len();
        let sizes: Vec<f32> = nodes
            .iter()
            .map(|&n| {
                largest_neighbor(n, self.dims, |m| match self.known(m) {
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
    pub fn surface(&mut self, grid: &NodeGrid) -> Result<LevelSet> {
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
            self.write_vertices(b, &owners[b], grid, part.vertices);
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

    /// Returns the eight blocks that hold the corners of this block's cells, by corner of the 2³
    /// blocks.
    fn around(&self, block: &Block) -> [u32; 8] {
        std::array::from_fn(|c| {
            let node: [usize; 3] = std::array::from_fn(|a| block.start[a] + 8 * (c >> a & 1));
            if (0..3).all(|a| node[a] < self.dims[a]) { self.directory[self.slot(node)] } else { NONE }
        })
    }

    /// Calls `visit(cell, case, values)` for the evaluated cells of a block; values only when the
    /// case needs them.
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

    fn write_vertices(&self, b: usize, owner: &Owner, grid: &NodeGrid, vertices: &mut [Vec3]) {
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
