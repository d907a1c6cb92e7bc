//! A tile of the picture: which triangle is nearest at each of its samples.
//!
//! A sample lies in a triangle where three edge functions are not negative, and where one of them
//! is 0 if that edge is a left or a top one (Pineda, *A Parallel Algorithm for Polygon
//! Rasterization*, 1988). All of it is in whole numbers, so triangles that share an edge leave no
//! sample between them out and hit none twice.

use super::project::{Corner, Face, TILE, UNIT, area, reach};
use std::array::from_fn;
use std::hint::black_box;
use std::ops::{Add, BitOr, Mul, Sub};

/// Samples of a pixel that are processed at once.
const LANES: usize = 8;

/// Pixels of a row that are tested at once against a large face, and side of a block whose farthest
/// depth is cached.
const BLOCK: usize = 8;
const BLOCKS: usize = TILE / BLOCK;

/// Number of faces after which the farthest depths are computed again.
const REFRESH: usize = 256;

/// Samples of a pixel's coverage.
pub(super) const SAMPLES: usize = 4;

/// Positions of the samples in a pixel: a rotated grid, in which no two share a row or a column.
/// The remaining lanes hold the center, which is sampled but does not count for coverage.
pub(super) const GRID: [(i32, i32); LANES] =
    [(96, 32), (224, 96), (32, 160), (160, 224), (128, 128), (128, 128), (128, 128), (128, 128)];

/// The center in [`GRID`].
pub(super) const CENTER: usize = SAMPLES;

/// No triangle.
pub(super) const NOTHING: u32 = u32::MAX;

/// Widest extent of a face up to which its edge functions fit into 32 bits.
const SMALL: i32 = 64 * UNIT;

/// The nearest triangles of a tile.
#[repr(C, align(64))]
pub(super) struct Tile {
    /// Inverse depth at each position of [`GRID`] in each pixel, 0 for empty ones.
    pub inverse_depth: [[f32; LANES]; TILE * TILE],
    pub triangle: [[u32; LANES]; TILE * TILE],
    /// The smallest inverse depth in each block.
    farthest: [f32; BLOCKS * BLOCKS],
    left: i32,
    top: i32,
    width: i32,
    height: i32,
    drawn: usize,
}

impl Tile {
    /// Returns an empty tile of no size.
    pub fn new() -> Box<Tile> {
        Box::new(Tile {
            inverse_depth: [[0.0; LANES]; TILE * TILE],
            triangle: [[NOTHING; LANES]; TILE * TILE],
            farthest: [0.0; BLOCKS * BLOCKS],
            left: 0,
            top: 0,
            width: 0,
            height: 0,
            drawn: 0,
        })
    }

    /// Clears the tile for another part of the picture.
    pub fn move_to(&mut self, left: usize, top: usize, width: usize, height: usize) {
        (self.left, self.top, self.width, self.height) =
            (left as i32, top as i32, width as i32, height as i32);
        self.inverse_depth.as_flattened_mut().fill(0.0);
        self.triangle.as_flattened_mut().fill(NOTHING);
        self.farthest.fill(0.0);
        self.drawn = 0;
    }

    /// Clears the tile, but keeps the depth of another tile at the same part of the picture.
    pub fn behind(&mut self, other: &Tile) {
        self.inverse_depth = other.inverse_depth;
        self.triangle.as_flattened_mut().fill(NOTHING);
        self.farthest.fill(0.0);
        (self.left, self.top, self.width, self.height) = (other.left, other.top, other.width, other.height);
        self.drawn = 0;
    }

    /// Draws a face over the earlier ones; at equal depth the earlier one stays.
    #[inline(always)]
    pub fn draw(&mut self, face: &Face) {
        let ((left, right), (top, bottom)) = reach(face);
        let (left, right) = (left.max(self.left), right.min(self.left + self.width - 1));
        let (top, bottom) = (top.max(self.top), bottom.min(self.top + self.height - 1));
        if left > right || top > bottom {
            return;
        }
        let (columns, rows) = ((left - self.left, right - self.left), (top - self.top, bottom - self.top));
        let [a, b, c] = face.corners;
        let nearest = a.inverse_depth.max(b.inverse_depth).max(c.inverse_depth);
        let blocks = |(from, to): (i32, i32)| from as usize / BLOCK..=to as usize / BLOCK;
        let is_hidden = |y: usize| blocks(columns).all(|x| nearest <= self.farthest[y * BLOCKS + x]);
        if blocks(rows).all(is_hidden) {
            return;
        }
        let wide = |a: i32, b: i32, c: i32| a.max(b).max(c) - a.min(b).min(c);
        if wide(a.x, b.x, c.x).max(wide(a.y, b.y, c.y)) <= SMALL {
            self.fill::<i32>(face, nearest, columns, rows);
        } else {
            self.fill::<i64>(face, nearest, columns, rows);
        }
        self.drawn += 1;
        if self.drawn.is_multiple_of(REFRESH) {
            self.look_up_farthest();
        }
    }

    /// Updates the depth of the farthest sample of each block.
    #[inline(always)]
    pub fn look_up_farthest(&mut self) {
        for (k, farthest) in self.farthest.iter_mut().enumerate() {
            let first = (k / BLOCKS * TILE + k % BLOCKS) * BLOCK;
            let mut low = [f32::INFINITY; LANES];
            for row in self.inverse_depth[first..].chunks(TILE).take(BLOCK) {
                for depths in &row[..BLOCK] {
                    for l in 0..LANES {
                        low[l] = if depths[l] < low[l] { depths[l] } else { low[l] };
                    }
                }
            }
            *farthest = low.into_iter().fold(f32::INFINITY, f32::min);
        }
    }

    /// Draws the pixels of a face in these columns and rows of the tile.
    #[inline(always)]
    fn fill<T: Whole>(&mut self, face: &Face, nearest: f32, columns: (i32, i32), rows: (i32, i32)) {
        let [a, b, c] = face.corners;
        // the first pixel
        let (x, y) = ((self.left + columns.0) * UNIT, (self.top + rows.0) * UNIT);
        let [e, f, g] = [(a, b), (b, c), (c, a)].map(|(p, q)| Edge::<T>::new(p, q, (x, y)));
        let farthest = a.inverse_depth.min(b.inverse_depth).min(c.inverse_depth);
        // one over depth is linear on the picture
        let over = 1.0 / area(face.corners) as f32;
        let (bx, by, bw) = ((b.x - a.x) as f32, (b.y - a.y) as f32, b.inverse_depth - a.inverse_depth);
        let (cx, cy, cw) = ((c.x - a.x) as f32, (c.y - a.y) as f32, c.inverse_depth - a.inverse_depth);
        let (dx, dy) = ((bw * cy - cw * by) * over, (cw * bx - bw * cx) * over);
        let first: [f32; LANES] = from_fn(|s| {
            let (px, py) = (x + GRID[s].0 - a.x, y + GRID[s].1 - a.y);
            a.inverse_depth + dx * px as f32 + dy * py as f32
        });
        let count = (columns.1 - columns.0 + 1) as usize;
        for down in 0..=rows.1 - rows.0 {
            let row = (rows.0 + down) as usize * TILE + columns.0 as usize;
            let [er, fr, gr] = [&e, &f, &g].map(|edge| edge.down * T::from(down));
            let wr = dy * (down * UNIT) as f32;
            for from in (0..count).step_by(BLOCK) {
                let right = T::from(from as i32);
                let most = |edge: &Edge<T>, at: T| at + edge.right * right + edge.most;
                if count > BLOCK && (most(&e, er) | most(&f, fr) | most(&g, gr)).sign() != 0 {
                    continue;
                }
                for column in from..count.min(from + BLOCK) {
                    let right = T::from(column as i32);
                    let (et, ft, gt) = (er + e.right * right, fr + f.right * right, gr + g.right * right);
                    let w = wr + dx * (column as i32 * UNIT) as f32;
                    let (depths, triangles) =
                        (&mut self.inverse_depth[row + column], &mut self.triangle[row + column]);
                    // all in whole numbers, which compilers turn into vectors: those of positive
                    // floats are in their order
                    let (old_depths, old_triangles) = (*depths, *triangles);
                    let mut visible = [0u32; LANES];
                    for l in 0..LANES {
                        let outside = (et + e.at[l]) | (ft + f.at[l]) | (gt + g.at[l]);
                        // a sliver's slope is unreliable: it is no nearer and no farther than its
                        // corners
                        let new = (w + first[l]).max(farthest).min(nearest).to_bits() as i32;
                        let old = old_depths[l].to_bits() as i32;
                        let best = old.max(new & !outside.sign());
                        depths[l] = f32::from_bits(best as u32);
                        visible[l] = ((old - best) >> 31) as u32;
                    }
                    // the place hidden, lest compilers store the lanes that changed alone: some
                    // machines are slow at that
                    let triangles = black_box(triangles);
                    for l in 0..LANES {
                        triangles[l] = old_triangles[l] ^ ((old_triangles[l] ^ face.triangle) & visible[l]);
                    }
                }
            }
        }
    }
}

/// A whole number in which edge functions are computed.
trait Whole:
    Copy + From<i32> + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + BitOr<Output = Self>
{
    /// Returns −1 for negative numbers, else 0.
    fn sign(self) -> i32;
}

impl Whole for i32 {
    #[inline(always)]
    fn sign(self) -> i32 {
        self >> 31
    }
}

impl Whole for i64 {
    #[inline(always)]
    fn sign(self) -> i32 {
        (self >> 63) as i32
    }
}

/// The function of an edge: not negative on the side of the face.
struct Edge<T> {
    /// At the places of [`GRID`] in the first pixel.
    at: [T; LANES],
    /// The step to the next pixel.
    right: T,
    down: T,
    /// Upper bound over that pixel and those of its block to the right.
    most: T,
}

impl<T: Whole> Edge<T> {
    #[inline(always)]
    fn new(a: Corner, b: Corner, (x, y): (i32, i32)) -> Edge<T> {
        let (dx, dy) = (T::from(b.x - a.x), T::from(b.y - a.y));
        // a sample on the edge belongs to the face below a top one or right of a left one
        let own = b.y < a.y || (b.y == a.y && b.x > a.x);
        let first = dx * T::from(y - a.y) - dy * T::from(x - a.x) - T::from(i32::from(!own));
        let at = from_fn(|s| first + dx * T::from(GRID[s].1) - dy * T::from(GRID[s].0));
        // at the corner of the pixels that is farthest inside
        let farthest =
            |slope: T, most: i32| if slope.sign() != 0 { T::from(0) } else { slope * T::from(most) };
        let most = first + farthest(T::from(0) - dy, BLOCK as i32 * UNIT) + farthest(dx, UNIT);
        Edge { at, right: T::from(0) - dy * T::from(UNIT), down: dx * T::from(UNIT), most }
    }
}
