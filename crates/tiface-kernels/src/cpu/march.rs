//! Ray marching through an occupancy bitmask, on a fixed lattice of steps.
//!
//! All samples of a ray lie on one lattice of pitch `step` (as in nerfacc 0.3.3): empty cells are
//! skipped by whole steps, so that positions do not depend on which cells happen to be empty.

use super::bricks::{BrickWalk, Bricks, POINTS};
use rayon::prelude::*;
use tiface_base::dispatch;
use tiface_base::geom::{BitGrid, Ray};

/// Returns the part of a step, 0..1, by which the sample lattice of a ray is shifted: `jitter` has
/// one a ray, or none at all, which stands for 0.
#[inline(always)]
pub(crate) fn shift(jitter: &[f32], ray: usize) -> f32 {
    jitter.get(ray).copied().unwrap_or(0.0)
}

/// Index of the color of a sample that weighs so little on its ray that it has none.
pub const COLORLESS: u32 = u32::MAX;

/// The samples of a batch of rays, sorted by ray and then by `t`.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Vec<i32>,
    /// `[samples]` midpoints.
    pub t: Vec<f32>,
}

impl Samples {
    /// Returns positions and directions of the samples of the batch's rays.
    pub fn points(&self, rays: &[Ray]) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
        let (mut points, mut directions) = (Vec::new(), Vec::new());
        self.points_into(rays, &mut points, &mut directions);
        (points, directions)
    }

    /// Replaces what the lists hold by positions and directions of the samples of the batch's rays.
    pub fn points_into(&self, rays: &[Ray], points: &mut Vec<[f32; 3]>, directions: &mut Vec<[f32; 3]>) {
        for list in [&mut *points, directions] {
            list.clear();
            list.reserve(self.t.len());
        }
        for (ray, span) in rays.iter().zip(self.offsets.windows(2)) {
            let (o, d) = (ray.origin.to_array(), ray.direction.to_array());
            for t in &self.t[span[0] as usize..span[1] as usize] {
                points.push([o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]]);
                directions.push(d);
            }
        }
    }
}

/// The cells through which rays march.
#[derive(Clone, Debug, PartialEq)]
pub struct MarchCells(Bricks);

impl MarchCells {
    /// Stores the cells in which samples are taken, and the cells at which rays end, which lie so
    /// deep inside that nothing beyond them is visible. Both grids have the same resolution.
    pub fn new(occupied: &BitGrid, solid: Option<&BitGrid>) -> MarchCells {
        assert!(solid.is_none_or(|solid| solid.resolution == occupied.resolution));
        let solid = solid.map_or(&[][..], |solid| &solid.bits);
        MarchCells(Bricks::new([occupied.resolution; 3], &occupied.bits, solid))
    }

    /// Marches a batch of whole rays, of unit directions and in field units, and keeps the nearest
    /// `limit` samples of each: the midpoints of the steps whose cell is occupied. `radius` and
    /// `step` are in field units.
    ///
    /// # Shapes
    ///
    /// - jitter: `[rays]`, the part of a step by which each ray's samples are shifted; `[0]` for
    ///   none
    pub fn march(&self, radius: f32, step: f32, rays: &[Ray], jitter: &[f32], limit: usize) -> Samples {
        /// Rays per task.
        const RAYS: usize = 256;
        assert!(jitter.is_empty() || jitter.len() == rays.len());
        let of_task = |(task, rays): (usize, &[Ray])| {
            let jitter = jitter.get(task * RAYS..task * RAYS + rays.len()).unwrap_or(&[]);
            let mut samples = Samples { offsets: vec![0], t: Vec::with_capacity(rays.len() * 32) };
            march_rays(&mut samples, &self.0, [radius, step], rays, jitter, limit);
            samples
        };
        let tasks: Vec<Samples> = rays.par_chunks(RAYS).enumerate().map(of_task).collect();
        let mut samples = Samples { offsets: vec![0], t: Vec::new() };
        for task in tasks {
            let before = samples.t.len() as i32;
            samples.offsets.extend(task.offsets[1..].iter().map(|offset| before + offset));
            samples.t.extend_from_slice(&task.t);
        }
        samples
    }
}

/// Appends the samples of rays; `radius` and `step` as in [`MarchCells::march`].
#[inline(always)]
fn march_body<const F: bool>(
    samples: &mut Samples,
    bricks: &Bricks,
    [radius, step]: [f32; 2],
    rays: &[Ray],
    jitter: &[f32],
    limit: usize,
) {
    for (r, ray) in rays.iter().enumerate() {
        march_one(&mut samples.t, bricks, [radius, step], ray, shift(jitter, r), limit);
        samples.offsets.push(samples.t.len() as i32);
    }
}

dispatch! {
    fn march_rays / march_body(
        samples: &mut Samples, bricks: &Bricks, radius_and_step: [f32; 2], rays: &[Ray], jitter: &[f32],
        limit: usize,
    )
}

/// Appends the samples of a ray.
#[inline(always)]
fn march_one(
    samples: &mut Vec<f32>,
    bricks: &Bricks,
    [radius, step]: [f32; 2],
    ray: &Ray,
    jitter: f32,
    limit: usize,
) {
    let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
    let (mut enter, mut leave) = (0f32, f32::INFINITY);
    for a in 0..3 {
        let (o, d) = (origin[a], direction[a]);
        if d == 0.0 {
            if o.abs() > radius {
                return;
            }
            continue;
        }
        let (p, q) = ((-radius - o) / d, (radius - o) / d);
        enter = enter.max(p.min(q));
        leave = leave.min(p.max(q));
    }
    let finite = ray.origin.is_finite() && ray.direction.is_finite() && step.is_finite();
    if !finite || enter >= leave || step <= 0.0 {
        return;
    }
    let walk = BrickWalk::new(bricks, [[-radius; 3], [radius; 3]], ray, step);
    let start = enter + jitter * step;
    let end = samples.len().saturating_add(limit);
    // t = start + (k + ½) · step for integer k: computed, never accumulated
    let mut k = 0i32;
    let mut t = [0f32; POINTS];
    loop {
        for i in 0..POINTS {
            t[i] = start + ((k + i as i32) as f32 + 0.5) * step;
        }
        let found = walk.find(bricks, &t);
        // samples before the first point at which the ray ends
        let mut left = found.occupied & !found.ends & found.ends.wrapping_sub(1);
        while left != 0 {
            let t = t[left.trailing_zeros() as usize];
            if t >= leave || samples.len() >= end {
                return;
            }
            samples.push(t);
            left &= left - 1;
        }
        k = k.saturating_add(if found.occupied == 0 { found.steps } else { POINTS as i32 });
        if found.ends != 0 || t[POINTS - 1] >= leave || k > i32::MAX - POINTS as i32 {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Marches through a box of edge 2.
    fn march(
        occupied: &BitGrid,
        solid: Option<&BitGrid>,
        step: f32,
        rays: &[Ray],
        jitter: &[f32],
        limit: usize,
    ) -> Samples {
        MarchCells::new(occupied, solid).march(1.0, step, rays, jitter, limit)
    }

    /// Returns a ray down along z, near the axis.
    fn ray() -> Ray {
        Ray::new([0.03, 0.01, 2.0], [0.0, 0.0, -1.0])
    }

    #[test]
    fn a_full_box_of_edge_two_holds_twenty_steps_of_a_tenth() {
        let mask = BitGrid::filled(8, true);
        let s = march(&mask, None, 0.1, &[ray()], &[], 1000);
        assert_eq!(s.offsets, [0, 20]);
        assert!((s.t[0] - 1.05).abs() < 1e-5 && (s.t[19] - 2.95).abs() < 1e-5);
    }

    #[test]
    fn emptying_cells_removes_samples_and_moves_none() {
        let full = BitGrid::filled(8, true);
        let mut holes = full.clone();
        for i in 0..512 {
            if i % 3 == 0 || i % 8 == 5 {
                holes.set(i, false);
            }
        }
        let ray = Ray::new([2.0, 1.7, 1.9], [-0.6, -0.48, -0.64]);
        let all = march(&full, None, 0.02, &[ray], &[0.3], 1000).t;
        let some = march(&holes, None, 0.02, &[ray], &[0.3], 1000).t;
        assert!(some.len() < all.len() && !some.is_empty());
        for t in &some {
            assert!(all.iter().any(|u| u == t));
        }
        // and no sample of the full march in an occupied cell is missing
        let kept = all.iter().filter(|&&t| {
            let c = |a: usize| {
                (((ray.origin[a] + t * ray.direction[a] + 1.0) * 4.0).floor() as i32).clamp(0, 7) as usize
            };
            holes.get((c(0) * 8 + c(1)) * 8 + c(2))
        });
        assert_eq!(kept.count(), some.len());
    }

    #[test]
    fn skipping_empty_bricks_loses_no_sample() {
        // 3 % of two thirds of 37³ cells, so that most bricks of 4³ have one, some are far from
        // any; rays through all of the box
        let mut mask = BitGrid::filled(37, false);
        let draw = |i: usize| (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
        (0..37usize.pow(3)).filter(|&i| draw(i) % 1000 < 30 && i % 37 > 12).for_each(|i| mask.set(i, true));
        // a few where rays end, most of them in bricks without any other
        let mut solid = BitGrid::filled(37, false);
        let ends = |&i: &usize| draw(i) % 1000 > 994 && !mask.get(i);
        (0..37usize.pow(3)).filter(ends).for_each(|i| solid.set(i, true));
        let mut ended = 0;
        let mut kept = 0;
        for i in 0..200 {
            let unit = |k: usize| draw(i * 8 + k) as f32 / (1 << 24) as f32;
            let to = [unit(0) - 0.5, unit(1) - 0.5, unit(2) - 0.5];
            let from = [3.0 * unit(3) - 1.5, 3.0 * unit(4) - 1.5, 2.5 * (unit(5) - 0.5).signum()];
            let way: [f32; 3] = std::array::from_fn(|a| to[a] - from[a]);
            let length = way.iter().map(|d| d * d).sum::<f32>().sqrt();
            let (ray, jitter) = (Ray::new(from, way.map(|d| d / length)), [unit(6)]);
            let all = march(&BitGrid::filled(37, true), None, 0.01, &[ray], &jitter, 1000).t;
            let cell = |t: f32| {
                let c = |a: usize| ((ray.origin[a] + t * ray.direction[a] + 1.0) * 18.5) as i32;
                [0, 1, 2].iter().fold(0, |i, &a| i * 37 + c(a).clamp(0, 36) as usize)
            };
            let want: Vec<f32> = all.iter().copied().filter(|&t| mask.get(cell(t))).collect();
            assert_eq!(march(&mask, None, 0.01, &[ray], &jitter, 1000).t, want);
            kept += want.len();
            let to_end: Vec<f32> = all.iter().copied().take_while(|&t| !solid.get(cell(t))).collect();
            let want: Vec<f32> = to_end.iter().copied().filter(|&t| mask.get(cell(t))).collect();
            assert_eq!(march(&mask, Some(&solid), 0.01, &[ray], &jitter, 1000).t, want);
            ended += usize::from(to_end.len() < all.len());
        }
        assert!(kept > 100 && (20..180).contains(&ended), "{kept} {ended}");
    }

    #[test]
    fn a_ray_ends_at_the_first_solid_cell() {
        // the ray comes down along z through cell column (4, 4): z cells 7, 6, 5 kept, 4 solid
        let mut mask = BitGrid::filled(8, true);
        let mut solid = BitGrid::filled(8, false);
        mask.set((4 * 8 + 4) * 8 + 4, false);
        solid.set((4 * 8 + 4) * 8 + 4, true);
        let s = march(&mask, Some(&solid), 0.1, &[ray()], &[], 1000);
        // z from 1 down to 0.25 in steps of 0.1, midpoints 0.95 … 0.25: eight of them
        assert_eq!(s.offsets, [0, 8]);
    }

    #[test]
    fn rays_that_miss_own_nothing() {
        let mask = BitGrid::filled(8, true);
        let miss = Ray::new([0.0, 0.0, 2.0], [0.0, 0.0, 1.0]);
        let outside = Ray::new([1.5, 0.0, 2.0], [0.0, 0.0, -1.0]);
        assert_eq!(march(&mask, None, 0.1, &[miss, ray(), outside], &[], 5).offsets, [0, 0, 5, 5]);
    }
}
