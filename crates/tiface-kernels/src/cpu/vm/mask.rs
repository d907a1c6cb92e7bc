//! The occupied cells of a box, and marching through them on a fixed lattice of steps.
//!
//! TensoRF's alpha mask (Chen et al. 2022, §4.3; `alphaMask` of the published code) marks vertices
//! and is looked up trilinearly: a point is kept if any vertex around it is marked. A cell is
//! therefore either kept as a whole or empty, so cells are stored here, and a ray skips empty ones
//! *before* the field is evaluated. Sample positions `t = entry + step · (k + jitter)` do not
//! depend on the mask.

use crate::cpu::bricks::{BrickWalk, Bricks, POINTS};
#[cfg(feature = "wgpu")]
use crate::cpu::bricks::{coordinates, set_bits};
use tiface_base::geom::Ray;

/// The occupied cells of a box, one bit each; cell `(x, y, z)` has index `(x · ny + y) · nz + z`.
#[derive(Clone, Debug, PartialEq)]
pub struct BoxMask {
    min: [f32; 3],
    max: [f32; 3],
    size: [usize; 3],
    bits: Vec<u64>,
    /// The same bits, for rays.
    bricks: Bricks,
}

fn bit(bits: &[u64], i: usize) -> bool {
    bits[i >> 6] >> (i & 63) & 1 == 1
}

/// Iterates over the cells of a box in the order of their bits.
fn cells([nx, ny, nz]: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..nx).flat_map(move |x| (0..ny).flat_map(move |y| (0..nz).map(move |z| [x, y, z])))
}

impl BoxMask {
    /// Creates a mask by evaluating `occupied` for every cell.
    pub fn new(
        min: [f32; 3],
        max: [f32; 3],
        size: [usize; 3],
        occupied: impl Fn([usize; 3]) -> bool,
    ) -> BoxMask {
        let mut bits = vec![0u64; size.iter().product::<usize>().div_ceil(64)];
        for i in cells(size).enumerate().filter(|(_, c)| occupied(*c)).map(|(i, _)| i) {
            bits[i >> 6] |= 1 << (i & 63);
        }
        BoxMask::from_bits(min, max, size, bits).expect("a bit for each cell")
    }

    /// Creates a mask from its bits, as [`BoxMask::bits`] returns them; `None` if their number does
    /// not fit the cells. Bits after the last cell are cleared.
    pub fn from_bits(min: [f32; 3], max: [f32; 3], size: [usize; 3], mut bits: Vec<u64>) -> Option<BoxMask> {
        let count = size.iter().try_fold(1usize, |n, &s| n.checked_mul(s))?;
        if bits.len() != count.div_ceil(64) {
            return None;
        }
        if let Some(last) = bits.last_mut().filter(|_| !count.is_multiple_of(64)) {
            *last &= (1 << (count % 64)) - 1;
        }
        let bricks = Bricks::new(size, &bits, &[]);
        Some(BoxMask { min, max, size, bits, bricks })
    }

    /// Creates a mask from marked vertices: a cell is occupied if one of its eight corners is
    /// marked. Vertex `(x, y, z)` has index `(x · ny + y) · nz + z`; each axis has at least 2, and
    /// the outer ones lie on the border of `min..max`.
    ///
    /// The cells extend beyond the vertices by one on every side. The published lookup pads with
    /// zeros, so a vertex on the border still contributes to points that lie less than a cell
    /// outside.
    pub fn from_vertices(min: [f32; 3], max: [f32; 3], size: [usize; 3], vertices: &[bool]) -> BoxMask {
        assert_eq!(vertices.len(), size.iter().product::<usize>());
        let unit: [f32; 3] = std::array::from_fn(|a| (max[a] - min[a]) / (size[a] - 1) as f32);
        let grown = |corner: [f32; 3], sign: f32| std::array::from_fn(|a| corner[a] + sign * unit[a]);
        BoxMask::new(grown(min, -1.0), grown(max, 1.0), size.map(|n| n + 1), |[x, y, z]| {
            (0..8).any(|k| {
                // cell 0 lies before vertex 0, which is its upper corner
                let v = [x + (k & 1), y + (k >> 1 & 1), z + (k >> 2)];
                (0..3).all(|a| v[a] > 0 && v[a] <= size[a])
                    && vertices[((v[0] - 1) * size[1] + v[1] - 1) * size[2] + v[2] - 1]
            })
        })
    }

    fn cell(&self, c: [usize; 3]) -> usize {
        (c[0] * self.size[1] + c[1]) * self.size[2] + c[2]
    }

    /// Returns the lower and upper corner of the mask's box.
    pub fn bounds(&self) -> ([f32; 3], [f32; 3]) {
        (self.min, self.max)
    }

    /// Returns the number of cells along each axis.
    pub fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Returns the cells' bits.
    pub fn bits(&self) -> &[u64] {
        &self.bits
    }

    /// Returns one bit per block of `edge`³ cells, set if the block contains an occupied cell, in
    /// the order of cells.
    #[cfg(feature = "wgpu")]
    pub fn blocks(&self, edge: usize) -> Vec<u64> {
        let size = self.size.map(|n| n.div_ceil(edge));
        let mut blocks = vec![0; size.iter().product::<usize>().div_ceil(64)];
        for cell in set_bits(&self.bits) {
            let [x, y, z] = coordinates(cell, self.size).map(|c| c / edge);
            let i = (x * size[1] + y) * size[2] + z;
            blocks[i >> 6] |= 1 << (i & 63);
        }
        blocks
    }

    /// Returns the fraction of cells that are occupied, 0..=1.
    pub fn share(&self) -> f64 {
        let cells: usize = self.size.iter().product();
        let set: u64 = self.bits.iter().map(|b| b.count_ones() as u64).sum();
        set as f64 / cells.max(1) as f64
    }

    /// Returns whether a point lies in an occupied cell; false outside the box.
    pub fn contains(&self, p: [f32; 3]) -> bool {
        let mut c = [0; 3];
        for a in 0..3 {
            // this form of the comparison also rejects NaN
            if !(p[a] >= self.min[a] && p[a] <= self.max[a]) {
                return false;
            }
            let g = (p[a] - self.min[a]) / (self.max[a] - self.min[a]) * self.size[a] as f32;
            c[a] = (g as usize).min(self.size[a] - 1);
        }
        bit(&self.bits, self.cell(c))
    }
}

/// The lattice of samples on a ray through a box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Lower corner of the field's box.
    pub min: [f32; 3],
    /// Upper corner.
    pub max: [f32; 3],
    /// Distance between samples, in units of `t`.
    pub step: f32,
    /// Number of samples of a ray; the last one has length 0 and therefore no weight.
    pub samples: usize,
    /// Minimum of `t` at the first sample.
    pub near: f32,
    /// Maximum of `t` at the first sample.
    pub far: f32,
}

impl Lattice {
    /// Returns the number of lattice points of a ray inside the box, which a renderer without a
    /// mask evaluates.
    pub fn points(&self, ray: &Ray) -> u64 {
        match self.crossing(ray) {
            Some((enter, leave)) => {
                let inside = (leave - enter.clamp(self.near, self.far)) / self.step;
                (inside.max(0.0) as u64 + 1).min(self.samples as u64)
            }
            None => 0,
        }
    }

    /// Returns `t` where a ray enters and leaves the box; `None` if it misses.
    #[inline(always)]
    fn crossing(&self, ray: &Ray) -> Option<(f32, f32)> {
        let (enter, leave) = crossing([self.min, self.max], ray.origin.to_array(), ray.direction.to_array());
        // also refuses NaN
        (enter <= leave).then_some((enter, leave))
    }
}

/// Returns `t` where a line enters and leaves a box; the first is greater than the second if the
/// line misses. Zero components of the direction are replaced by 1e-6, as in the published code.
#[inline(always)]
pub fn crossing([low, high]: [[f32; 3]; 2], origin: [f32; 3], direction: [f32; 3]) -> (f32, f32) {
    let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
    for a in 0..3 {
        let d = if direction[a] == 0.0 { 1e-6 } else { direction[a] };
        let (p, q) = ((low[a] - origin[a]) / d, (high[a] - origin[a]) / d);
        enter = enter.max(p.min(q));
        leave = leave.min(p.max(q));
    }
    (enter, leave)
}

/// Walks over the lattice points of a ray inside the box and inside a mask.
///
/// This is a state rather than a closure, because a closure would be compiled without the vector
/// instructions of the kernel that calls it.
pub struct Walk<'a> {
    mask: Option<(&'a Bricks, BrickWalk)>,
    origin: [f32; 3],
    direction: [f32; 3],
    /// The field's box, with slack for rounding.
    low: [f32; 3],
    high: [f32; 3],
    start: f32,
    step: f32,
    leave: f32,
    /// Index of the first of the lattice points that were looked at last.
    k: i32,
    /// Those of them that are still to be returned, a bit each.
    left: u32,
    /// Index of the first of the points that are looked at next.
    next: i32,
    end: i32,
}

impl<'a> Walk<'a> {
    /// Creates a walk that starts before the first lattice point, which `jitter` shifts by that
    /// part of a step; it has no points if the ray misses the box.
    #[inline(always)]
    pub fn new(lattice: &'a Lattice, mask: Option<&'a BoxMask>, ray: &Ray, jitter: f32) -> Walk<'a> {
        let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
        let crossing = lattice.crossing(ray).filter(|_| lattice.step > 0.0);
        let (enter, leave) = crossing.unwrap_or((0.0, 0.0));
        let start = enter.clamp(lattice.near, lattice.far) + jitter * lattice.step;
        let (mut low, mut high) = (lattice.min, lattice.max);
        for a in 0..3 {
            let slack = 1e-6 * (high[a] - low[a]);
            low[a] -= slack;
            high[a] += slack;
        }
        let of_ray =
            |m: &'a BoxMask| (&m.bricks, BrickWalk::new(&m.bricks, [m.min, m.max], ray, lattice.step));
        let finite = ray.origin.is_finite() && ray.direction.is_finite();
        let any = crossing.is_some() && start.is_finite() && finite;
        let last = lattice.samples.saturating_sub(1).try_into().unwrap_or(i32::MAX);
        Walk {
            mask: mask.map(of_ray),
            origin,
            direction,
            low,
            high,
            start,
            step: lattice.step,
            // the border itself belongs to the box, and rounding may put a sample just outside
            leave: leave + lattice.step,
            k: 0,
            left: 0,
            next: 0,
            end: if any { last } else { 0 },
        }
    }

    /// Returns `t` of a lattice point.
    #[inline(always)]
    fn t(&self, k: i32) -> f32 {
        self.start + self.step * k as f32
    }

    /// Returns `t` of the next lattice point.
    #[inline(always)]
    pub fn advance(&mut self) -> Option<f32> {
        while self.left == 0 {
            self.k = self.next;
            if self.k >= self.end || self.t(self.k) > self.leave {
                return None;
            }
            self.look();
        }
        let i = self.left.trailing_zeros() as i32;
        self.left &= self.left - 1;
        Some(self.t(self.k.wrapping_add(i)))
    }

    /// Looks at the next lattice points.
    #[inline(always)]
    fn look(&mut self) {
        let mut t = [0f32; POINTS];
        for i in 0..POINTS {
            t[i] = self.start + self.step * self.k.wrapping_add(i as i32) as f32;
        }
        // how far outside of the box
        let mut outside = [f32::NEG_INFINITY; POINTS];
        for a in 0..3 {
            for i in 0..POINTS {
                let p = self.origin[a] + t[i] * self.direction[a];
                outside[i] = outside[i].max(self.low[a] - p).max(p - self.high[a]);
            }
        }
        for i in 0..POINTS {
            self.left |= u32::from(outside[i] <= 0.0 && t[i] <= self.leave) << i;
        }
        // the last points of the lattice
        let exist = (self.end - self.k).min(POINTS as i32);
        self.left &= (1 << exist) - 1;
        self.next = self.k.saturating_add(POINTS as i32);
        if let Some((bricks, walk)) = &self.mask {
            let found = walk.find(bricks, &t);
            self.left &= found.occupied;
            if found.occupied == 0 {
                self.next = self.k.saturating_add(found.steps);
            }
        }
    }
}
