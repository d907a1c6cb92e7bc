//! The third step, from the visible triangles of a tile to pixels: intersects the rays through the
//! samples with their triangles, and weights the hits of each pixel.

use super::super::hits::RayHits;
use super::project::{TILE, UNIT};
use super::tile::{CENTER, GRID, NOTHING, SAMPLES, Tile};
use bytemuck::Zeroable;
use glam::{DVec3, Mat3, Vec2, Vec3};
use tiface_base::geom::{Camera, Hit, Mesh, ShellLayer};

/// Number of samples that are intersected with their triangles at once.
const BATCH: usize = 64;

/// Number of hits queued before they are colored, so that they fit into the caches.
const QUEUE: usize = 4 * BATCH;

/// All samples of a pixel.
const FULL: u8 = (1 << SAMPLES) - 1;

/// Triangles that share their vertices, the mesh's own or those of a layer around it.
pub(super) struct RasterSurface<'a> {
    pub positions: &'a [Vec3],
    /// The shell; `None` for the mesh itself.
    pub shell: Option<&'a ShellLayer>,
}

/// Some rows of the rendered pictures.
pub(super) struct PictureRows<'a> {
    pub top: usize,
    pub rgba: &'a mut [[f32; 4]],
    pub depth: &'a mut [f32],
    pub normal: &'a mut [[f32; 3]],
    pub triangles: &'a mut [u32],
}

/// The part of the picture under a tile.
#[derive(Clone, Copy)]
pub(super) struct TileArea {
    pub left: usize,
    pub width: usize,
    pub height: usize,
}

/// Writes the pixels of tiles.
pub(super) struct Painter<'a, C> {
    pub mesh: &'a Mesh,
    pub camera: &'a Camera,
    pub origin: Vec3,
    pub forward: Vec3,
    /// Scale from the mesh's units to those of depth.
    pub scale: f32,
    pub world_from_mesh: Mat3,
    /// For a lens without distortion: the ray through the picture's corner, and the steps to the
    /// next pixel in x and y.
    pub straight: Option<[DVec3; 3]>,
    /// Relative change of depth over one pixel from which on a surface ends.
    pub jump: f32,
    /// Whether hits get no points and normals.
    pub bare: bool,
    pub color: C,
}

/// Returns the rays of a camera without distortion, before they are normalized.
pub(super) fn straight_rays(c: &Camera) -> Option<[DVec3; 3]> {
    let through = |x: f64, y: f64, z: f64| c.rotation * DVec3::new(x, y, z);
    c.distortion.is_none().then(|| {
        [
            through(-c.cx / c.fx, c.cy / c.fy, -1.0),
            through(1.0 / c.fx, 0.0, 0.0),
            through(0.0, -1.0 / c.fy, 0.0),
        ]
    })
}

impl<C: Fn(&RayHits) -> Vec<[f32; 3]>> Painter<'_, C> {
    /// Writes depth and normals of a tile's pixels, and queues its hits for coloring. `light` is
    /// the transmittance of each sample after the layers drawn before; empty if it is 1 everywhere.
    pub fn paint(
        &self,
        tile: &Tile,
        surface: &RasterSurface,
        light: &mut [[f32; SAMPLES]],
        area: TileArea,
        out: &mut PictureRows,
        batch: &mut SampleBatch,
        queue: &mut RayHits,
    ) {
        for y in 0..area.height {
            for x in 0..area.width {
                let i = y * TILE + x;
                let (depths, seen) = (&tile.inverse_depth[i], &tile.triangle[i]);
                let present = (0..SAMPLES).fold(0, |bits, s| bits | u8::from(seen[s] != NOTHING) << s);
                if present == 0 && seen[CENTER] == NOTHING {
                    continue;
                }
                // samples of the same surface are colored together, first those of the one at the
                // center
                let same = |own: f32| {
                    let near = |s: usize| (depths[s] - own).abs() <= self.jump * own.min(depths[s]);
                    (0..SAMPLES).fold(0, |bits, s| bits | u8::from(near(s)) << s)
                };
                let mut rest = present;
                if seen[CENTER] != NOTHING {
                    let samples = rest & same(depths[CENTER]);
                    rest &= !samples;
                    self.add(batch, [x, y], CENTER, seen[CENTER], samples, area, out.top);
                }
                while rest != 0 {
                    let s = rest.trailing_zeros() as usize;
                    let samples = rest & (same(depths[s]) | 1 << s);
                    rest &= !samples;
                    self.add(batch, [x, y], s, seen[s], samples, area, out.top);
                }
                // a pixel has no further samples
                if batch.count > BATCH - SAMPLES - 1 {
                    self.finish(surface, light, area, out, batch, queue);
                }
            }
        }
        self.finish(surface, light, area, out, batch, queue);
        queue.shade(out.rgba, &self.color);
    }

    #[inline(always)]
    fn add(
        &self,
        batch: &mut SampleBatch,
        [x, y]: [usize; 2],
        place: usize,
        triangle: u32,
        samples: u8,
        area: TileArea,
        top: usize,
    ) {
        let k = batch.count;
        let [px, py] = [GRID[place].0, GRID[place].1].map(|v| v as f32 / UNIT as f32);
        (batch.x[k], batch.y[k]) = ((area.left + x) as f32 + px, (top + y) as f32 + py);
        if self.straight.is_none() {
            // no ray exists where the lens model folds over
            let Some(ray) = self.camera.ray(Vec2::new(batch.x[k], batch.y[k])) else { return };
            (0..3).for_each(|c| batch.direction[c][k] = ray.direction[c]);
        }
        (batch.pixel[k], batch.triangle[k]) = ((y * TILE + x) as u32, triangle);
        (batch.samples[k], batch.is_center[k]) = (samples, place == CENTER);
        batch.count += 1;
    }

    /// Intersects the rays of a batch.
    fn finish(
        &self,
        surface: &RasterSurface,
        light: &mut [[f32; SAMPLES]],
        area: TileArea,
        out: &mut PictureRows,
        batch: &mut SampleBatch,
        queue: &mut RayHits,
    ) {
        let count = std::mem::take(&mut batch.count);
        for k in 0..count {
            let corners = self.mesh.triangles[batch.triangle[k] as usize];
            for (corner, v) in batch.corners.iter_mut().zip(corners) {
                let p = surface.positions[v as usize];
                (corner[0][k], corner[1][k], corner[2][k]) = (p.x, p.y, p.z);
            }
        }
        meet(batch, self.straight, self.origin);
        let w = self.camera.width as usize;
        for k in 0..count {
            let triangle = batch.triangle[k];
            let hit = Hit { t: batch.t[k], triangle, u: batch.u[k], v: batch.v[k] };
            let direction = Vec3::from(batch.direction.each_ref().map(|d| d[k]));
            let i = batch.pixel[k] as usize;
            let pixel = i / TILE * w + area.left + i % TILE;
            if batch.is_center[k] && surface.shell.is_none() {
                out.depth[pixel] = hit.t * direction.dot(self.forward) * self.scale;
                out.triangles[pixel] = triangle;
                if let Some(own) = out.normal.get_mut(pixel) {
                    *own = (self.world_from_mesh * self.mesh.shading_normal(&hit)).to_array();
                }
            }
            let share = match (light.get_mut(i), batch.samples[k]) {
                (None, FULL) => 1.0,
                (None, samples) => samples.count_ones() as f32 / SAMPLES as f32,
                (Some(light), samples) => {
                    let alpha =
                        surface.shell.map_or(1.0, |l| l.alpha(&hit, self.mesh.triangles[triangle as usize]));
                    let mut share = 0.0;
                    for s in (0..SAMPLES).filter(|s| samples >> s & 1 == 1) {
                        share += light[s] * alpha / SAMPLES as f32;
                        light[s] *= 1.0 - alpha;
                    }
                    share
                }
            };
            if share == 0.0 {
                continue;
            }
            if !self.bare {
                queue.points.push(self.mesh.point_at(&hit));
                queue.normals.push(self.mesh.shading_normal(&hit));
            }
            queue.directions.push(direction);
            queue.hits.push(hit);
            queue.pixels.push((pixel, share));
        }
        if queue.pixels.len() >= QUEUE {
            queue.shade(out.rgba, &self.color);
        }
    }
}

/// Samples on the picture and the triangles to intersect at them.
#[derive(Zeroable)]
pub(super) struct SampleBatch {
    count: usize,
    x: [f32; BATCH],
    y: [f32; BATCH],
    /// Pixel in the tile.
    pixel: [u32; BATCH],
    triangle: [u32; BATCH],
    /// A bit for each sample that gets this color.
    samples: [u8; BATCH],
    is_center: [bool; BATCH],
    direction: [[f32; BATCH]; 3],
    /// Coordinates of the three corners.
    corners: [[[f32; BATCH]; 3]; 3],
    u: [f32; BATCH],
    v: [f32; BATCH],
    t: [f32; BATCH],
}

tiface_base::dispatch! {
    /// Computes the intersections of the rays with their triangles, or the nearest points: samples
    /// lie in snapped triangles.
    fn meet / meet_all(batch: &mut SampleBatch, straight: Option<[DVec3; 3]>, origin: Vec3)
}

#[inline(always)]
fn meet_all<const F: bool>(batch: &mut SampleBatch, straight: Option<[DVec3; 3]>, origin: Vec3) {
    let origin = origin.as_dvec3().to_array();
    for k in 0..BATCH {
        if let Some([corner, right, down]) = straight {
            let (x, y) = (f64::from(batch.x[k]), f64::from(batch.y[k]));
            let mut d = [0.0; 3];
            for c in 0..3 {
                d[c] = corner[c] + x * right[c] + y * down[c];
            }
            // rounded once, as in the ray caster
            let over = 1.0 / dot(d, d).sqrt();
            for c in 0..3 {
                batch.direction[c][k] = (d[c] * over) as f32;
            }
        }
    }
    // Möller and Trumbore, without the bounds test; in f64 for triangles seen edge-on
    for k in 0..BATCH {
        let (mut d, mut corners) = ([0.0; 3], [[0.0; 3]; 3]);
        for c in 0..3 {
            d[c] = f64::from(batch.direction[c][k]);
            for i in 0..3 {
                corners[i][c] = f64::from(batch.corners[i][c][k]) - origin[c];
            }
        }
        let [a, b, c] = corners;
        let (ab, ac) = (minus(b, a), minus(c, a));
        let p = cross(d, ac);
        let over = 1.0 / dot(ab, p);
        let (u, v) = (-dot(a, p) * over, -dot(d, cross(a, ab)) * over);
        // a triangle seen edge-on has no unique intersection
        let is_known = (u + v).abs() < f64::INFINITY;
        let (u, v) =
            (if is_known { u.max(0.0) } else { 1.0 / 3.0 }, if is_known { v.max(0.0) } else { 1.0 / 3.0 });
        let shrink = 1.0 / (u + v).max(1.0);
        let (u, v) = (u * shrink, v * shrink);
        (batch.u[k], batch.v[k]) = (u as f32, v as f32);
        batch.t[k] = (dot(a, d) + u * dot(ab, d) + v * dot(ac, d)) as f32;
    }
}

#[inline(always)]
fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
