//! A tile of the picture: which triangle is nearest at each of its samples.
//!
//! A sample lies in a triangle where three edge functions are not negative, and where one of them is 0 if that edge is a
//! left or a top one (Pineda, *A Parallel Algorithm for Polygon Rasterization*, 1988). All of it is in whole numbers, so
//! triangles that share an edge leave no sample between them out and hit none twice.

use super::project::{Corner, Face, area, reach};
use std::array::from_fn;
use std::ops::{Add, BitOr};

/// Pixels along each side of a tile.
pub(super) const TILE: usize = 32;

/// Pixels along each side of a block, of which the farthest depth is known.
const BLOCK: usize = 8;
const BLOCKS: usize = TILE / BLOCK;

/// After so many faces the farthest depths are looked up again.
const REFRESH: usize = 64;

/// Parts of a pixel.
pub(super) const UNIT: i32 = 256;

/// Samples of a pixel's coverage.
pub(super) const SAMPLES: usize = 4;

/// Where they lie in a pixel: a rotated grid, in which no two share a row or a column.
pub(super) const GRID: [(i32, i32); SAMPLES] = [(96, 32), (224, 96), (32, 160), (160, 224)];

/// The first and the last place of a sample in a row.
pub(super) const FIRST: i32 = 32;
pub(super) const LAST: i32 = 224;

/// No triangle.
pub(super) const NOTHING: u32 = u32::MAX;

/// Widest extent of a face up to which its edge functions fit into 32 bits.
const SMALL: i32 = 64 * UNIT;

/// The nearest triangles of a tile.
pub(super) struct Tile {
    left: i32,
    top: i32,
    width: i32,
    height: i32,
    /// One over depth at the samples of each pixel, 0 where there is nothing.
    pub inverse_depth: [[f32; SAMPLES]; TILE * TILE],
    pub triangle: [[u32; SAMPLES]; TILE * TILE],
    /// The same at the pixels' centers.
    pub center_inverse_depth: [f32; TILE * TILE],
    pub center_triangle: [u32; TILE * TILE],
    /// The smallest inverse depth in each block.
    farthest: [f32; BLOCKS * BLOCKS],
    drawn: usize,
}

impl Tile {
    /// With nothing in it, its first pixel at (0, 0).
    pub fn new() -> Box<Tile> {
        Box::new(Tile {
            left: 0,
            top: 0,
            width: 0,
            height: 0,
            inverse_depth: [[0.0; SAMPLES]; TILE * TILE],
            triangle: [[NOTHING; SAMPLES]; TILE * TILE],
            center_inverse_depth: [0.0; TILE * TILE],
            center_triangle: [NOTHING; TILE * TILE],
            farthest: [0.0; BLOCKS * BLOCKS],
            drawn: 0,
        })
    }

    /// Empties it for another part of the picture.
    pub fn move_to(&mut self, left: usize, top: usize, width: usize, height: usize) {
        (self.left, self.top, self.width, self.height) =
            (left as i32, top as i32, width as i32, height as i32);
        self.inverse_depth.fill([0.0; SAMPLES]);
        self.triangle.fill([NOTHING; SAMPLES]);
        self.center_inverse_depth.fill(0.0);
        self.center_triangle.fill(NOTHING);
        self.farthest.fill(0.0);
        self.drawn = 0;
    }

    /// Draws a face over what is there; at equal depth the earlier one stays.
    #[inline(always)]
    pub fn draw(&mut self, face: &Face) {
        let ((left, right), (top, bottom)) = reach(face);
        let (left, right) = (left.max(self.left), right.min(self.left + self.width - 1));
        let (top, bottom) = (top.max(self.top), bottom.min(self.top + self.height - 1));
        if left > right || top > bottom {
            return;
        }
        let [a, b, c] = face.corners;
        let nearest = a.inverse_depth.max(b.inverse_depth).max(c.inverse_depth);
        let block = |p: i32, start: i32| (p - start) as usize / BLOCK;
        let hidden = (block(top, self.top)..=block(bottom, self.top)).all(|y| {
            (block(left, self.left)..=block(right, self.left))
                .all(|x| nearest <= self.farthest[y * BLOCKS + x])
        });
        if hidden {
            return;
        }
        let wide = |a: i32, b: i32, c: i32| a.max(b).max(c) - a.min(b).min(c);
        if wide(a.x, b.x, c.x).max(wide(a.y, b.y, c.y)) <= SMALL {
            self.fill::<i32>(face, nearest, left, right, top, bottom);
        } else {
            self.fill::<i64>(face, nearest, left, right, top, bottom);
        }
        self.drawn += 1;
        if self.drawn.is_multiple_of(REFRESH) {
            self.look_up_farthest();
        }
    }

    /// Looks up how far away the farthest sample of each block is.
    pub fn look_up_farthest(&mut self) {
        for (k, farthest) in self.farthest.iter_mut().enumerate() {
            let first = k / BLOCKS * BLOCK * TILE + k % BLOCKS * BLOCK;
            let mut low = [f32::INFINITY; SAMPLES];
            for row in (0..BLOCK).map(|row| first + row * TILE) {
                for samples in &self.inverse_depth[row..row + BLOCK] {
                    (0..SAMPLES).for_each(|s| low[s] = low[s].min(samples[s]));
                }
                for &center in &self.center_inverse_depth[row..row + BLOCK] {
                    low[0] = low[0].min(center);
                }
            }
            *farthest = low.into_iter().fold(f32::INFINITY, f32::min);
        }
    }

    /// Draws the pixels of a face in these columns and rows.
    #[inline(always)]
    fn fill<T: Whole>(&mut self, face: &Face, nearest: f32, left: i32, right: i32, top: i32, bottom: i32) {
        let [a, b, c] = face.corners;
        let center = (left * UNIT + UNIT / 2, top * UNIT + UNIT / 2);
        let edges = [(a, b), (b, c), (c, a)].map(|(p, q)| Edge::<T>::new(p, q, center));
        let farthest = a.inverse_depth.min(b.inverse_depth).min(c.inverse_depth);
        // one over depth is linear on the picture
        let over = 1.0 / area(face.corners) as f32;
        let to = |p: Corner| ((p.x - a.x) as f32, (p.y - a.y) as f32, p.inverse_depth - a.inverse_depth);
        let ((bx, by, bw), (cx, cy, cw)) = (to(b), to(c));
        let (dx, dy) = ((bw * cy - cw * by) * over, (cw * bx - bw * cx) * over);
        let first = a.inverse_depth + dx * (center.0 - a.x) as f32 + dy * (center.1 - a.y) as f32;
        let offset: [f32; SAMPLES] =
            from_fn(|s| dx * (GRID[s].0 - UNIT / 2) as f32 + dy * (GRID[s].1 - UNIT / 2) as f32);
        let mut rows = edges.each_ref().map(|e| e.first);
        for y in top..=bottom {
            let mut at = rows;
            let row = (y - self.top) as usize * TILE;
            let row_depth = first + dy * ((y - top) * UNIT) as f32;
            for x in left..=right {
                let outside = (at[0] + edges[0].most) | (at[1] + edges[1].most) | (at[2] + edges[2].most);
                if outside >= T::ZERO {
                    let i = row + (x - self.left) as usize;
                    let w = row_depth + dx * ((x - left) * UNIT) as f32;
                    let (depths, triangles) = (&mut self.inverse_depth[i], &mut self.triangle[i]);
                    for s in 0..SAMPLES {
                        let inside = (at[0] + edges[0].offset[s])
                            | (at[1] + edges[1].offset[s])
                            | (at[2] + edges[2].offset[s]);
                        // a sliver's slope is unreliable: it is no nearer and no farther than its corners
                        let w = (w + offset[s]).max(farthest).min(nearest);
                        let visible = (inside >= T::ZERO) & (w > depths[s]);
                        depths[s] = if visible { w } else { depths[s] };
                        triangles[s] = if visible { face.triangle } else { triangles[s] };
                    }
                    let w = w.max(farthest).min(nearest);
                    if (at[0] | at[1] | at[2]) >= T::ZERO && w > self.center_inverse_depth[i] {
                        self.center_inverse_depth[i] = w;
                        self.center_triangle[i] = face.triangle;
                    }
                }
                (0..3).for_each(|k| at[k] = at[k] + edges[k].right);
            }
            (0..3).for_each(|k| rows[k] = rows[k] + edges[k].down);
        }
    }
}

/// A whole number in which edge functions are computed.
trait Whole: Copy + PartialOrd + Add<Output = Self> + BitOr<Output = Self> {
    const ZERO: Self;
    /// One that is known to fit.
    fn from_i64(value: i64) -> Self;
}

impl Whole for i32 {
    const ZERO: i32 = 0;

    fn from_i64(value: i64) -> i32 {
        value as i32
    }
}

impl Whole for i64 {
    const ZERO: i64 = 0;

    fn from_i64(value: i64) -> i64 {
        value
    }
}

/// The function of an edge: not negative on the side of the face.
struct Edge<T> {
    /// At the first pixel's center.
    first: T,
    /// A pixel on.
    right: T,
    down: T,
    /// From a pixel's center to its samples, and the largest of these, the center's own among them.
    offset: [T; SAMPLES],
    most: T,
}

impl<T: Whole> Edge<T> {
    #[inline(always)]
    fn new(a: Corner, b: Corner, (x, y): (i32, i32)) -> Edge<T> {
        let (dx, dy) = (i64::from(b.x - a.x), i64::from(b.y - a.y));
        // a sample on the edge belongs to the face below a top one or right of a left one
        let own = dy < 0 || (dy == 0 && dx > 0);
        let first = dx * i64::from(y - a.y) - dy * i64::from(x - a.x) - i64::from(!own);
        let offset: [i64; SAMPLES] =
            GRID.map(|(x, y)| dx * i64::from(y - UNIT / 2) - dy * i64::from(x - UNIT / 2));
        Edge {
            first: T::from_i64(first),
            right: T::from_i64(-dy * i64::from(UNIT)),
            down: T::from_i64(dx * i64::from(UNIT)),
            offset: offset.map(T::from_i64),
            most: T::from_i64(offset.into_iter().fold(0, i64::max)),
        }
    }
}
