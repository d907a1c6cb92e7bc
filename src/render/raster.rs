//! A view of a mesh, rasterized: as the ray caster sees it, in a hundredth of the time.
//!
//! 1. Corners are projected and snapped to 1/256 of a pixel, triangles cut to what the camera sees, and sorted into tiles
//!    of 32 × 32 pixels (`project`). A lens that bends straight lines gets triangles halved until that no longer shows: so
//!    edges stay shared, which a picture that is bent afterwards could not promise.
//! 2. In each tile the nearest triangle is found at the center of every pixel and at four samples around it (`tile`).
//! 3. What is seen is colored once a pixel, and again for each surface that ends within the pixel. The ray through the
//!    pixel is met with its triangle as a ray caster would do it, so depth and attributes do not depend on the snapping.
//!
//! Coverage is that of the four samples; what is not covered is transparent black. Every tile is made by one thread in the
//! order of the triangles: same mesh, same picture.

mod project;
mod tile;

use super::raycast::{RayHits, RenderedView};
use crate::geom::{Camera, Hit, Mesh, Similarity};
use crate::image::Image;
use glam::{DVec3, Mat3, Vec3};
use project::{Bins, Lens, Rays};
use rayon::prelude::*;
use std::array::from_fn;
use tile::{CENTER, GRID, NOTHING, SAMPLES, TILE, Tile, UNIT};

/// Depth change over one pixel, in pixel footprints, from which on a surface ends: tan 84°, as for rays.
const JUMP: f32 = 10.0;

/// How a mesh is rasterized.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Are triangles seen from behind left out? Of a closed mesh nobody misses them.
    pub cull: bool,
    /// Is the picture of normals made? Else it has no pixels.
    pub normals: bool,
    /// From the mesh's coordinates (in which the camera stands too) to those of depth and normals.
    pub world_from_scene: Similarity,
}

impl Default for RasterOptions {
    fn default() -> RasterOptions {
        RasterOptions { cull: false, normals: true, world_from_scene: Similarity::IDENTITY }
    }
}

/// What one camera sees, and which triangles.
#[derive(Clone, Debug, PartialEq)]
pub struct RasterView {
    /// Color, depth and normals, as of a ray caster.
    pub view: RenderedView,
    /// `[height · width]` triangles at the centers of the pixels, [`RasterView::NOTHING`] where there is none.
    pub triangles: Vec<u32>,
}

impl RasterView {
    /// Stands for no triangle.
    pub const NOTHING: u32 = NOTHING;
}

/// Rasterizes a mesh.
///
/// `color` is given batches of what is seen and returns sRGB-coded colors in 0..=1, one a hit, `[n, 3]`; what it leaves
/// out is black. It runs on several threads at once.
///
/// # Examples
///
/// ```
/// use glam::{DMat3, DVec3, Vec3};
/// use tiface::geom::{Camera, Distortion, Mesh};
/// use tiface::render::{RasterOptions, raster};
///
/// let positions = vec![Vec3::new(-3.0, -3.0, 0.0), Vec3::new(3.0, -3.0, 0.0), Vec3::new(0.0, 3.0, 0.0)];
/// let mesh = Mesh { positions, triangles: vec![[0, 1, 2]], ..Mesh::default() };
/// let camera = Camera {
///     width: 20, height: 10, fx: 10.0, fy: 10.0, cx: 10.0, cy: 5.0,
///     distortion: Distortion::default(), rotation: DMat3::IDENTITY, position: DVec3::new(0.0, 0.0, 2.0),
/// };
/// let seen = raster(&mesh, &camera, &RasterOptions::default(), |hits| {
///     hits.normals.iter().map(|n| n.to_array().map(|v| v.abs())).collect()
/// });
/// // blue where the normal is +Z, two units away
/// assert_eq!(seen.view.color.pixel(10, 5), [0.0, 0.0, 1.0, 1.0]);
/// assert!((seen.view.depth.pixel(10, 5)[0] - 2.0).abs() < 1e-6);
/// assert_eq!(seen.triangles[5 * 20 + 10], 0);
/// ```
pub fn raster(
    mesh: &Mesh,
    camera: &Camera,
    options: &RasterOptions,
    color: impl Fn(&RayHits) -> Vec<[f32; 3]> + Sync,
) -> RasterView {
    let (width, height) = (camera.width, camera.height);
    let mut view = RenderedView {
        color: Image::new(width, height, 4),
        depth: Image::new(width, height, 1),
        normal: if options.normals { Image::new(width, height, 3) } else { Image::new(0, 0, 3) },
    };
    let mut triangles = vec![NOTHING; width as usize * height as usize];
    let lens = if triangles.is_empty() { None } else { Lens::new(camera, mesh, options.cull) };
    let Some(lens) = lens else { return RasterView { view, triangles } };
    let bins = lens.bin(mesh);
    let w = width as usize;
    // no rows of a picture that is not made
    let mut normal_rows: Vec<&mut [f32]> = view.normal.data.chunks_mut(TILE * w * 3).collect();
    normal_rows.resize_with((height as usize).div_ceil(TILE), Default::default);
    let rows = view
        .color
        .data
        .par_chunks_mut(TILE * w * 4)
        .zip(view.depth.data.par_chunks_mut(TILE * w))
        .zip(normal_rows)
        .zip(triangles.par_chunks_mut(TILE * w));
    let painter = Painter {
        mesh,
        camera,
        origin: camera.position.as_vec3().as_dvec3(),
        forward: camera.forward(),
        scale: options.world_from_scene.scale as f32,
        world_from_mesh: options.world_from_scene.rotation_f32(),
        rays: Rays::new(camera),
        jump: JUMP / camera.fx.abs() as f32,
        smooth: mesh.normals.len() == mesh.positions.len(),
    };
    let start = || (Tile::new(), Queue::default());
    rows.enumerate().for_each_init(start, |(tile, queue), (row, (((rgba, depth), normal), triangles))| {
        let out = &mut Band {
            top: row * TILE,
            rgba: rgba.as_chunks_mut().0,
            depth,
            normal: normal.as_chunks_mut().0,
            triangles,
        };
        let (across, height) = (w.div_ceil(TILE), out.depth.len() / w);
        for column in 0..across {
            let left = column * TILE;
            let index = row * across + column;
            if bins.iter().all(|b| b.of(index).len() == 0) {
                continue;
            }
            let size = [TILE.min(w - left), height];
            tile.move_to(left, out.top, size[0], size[1]);
            draw(tile, &bins, index);
            painter.paint(tile, left, size, out, queue);
            queue.shade(out.rgba, &color);
        }
    });
    RasterView { view, triangles }
}

crate::dispatch! {
    /// Draws what a tile holds: first what faces the camera, which hides most of the rest.
    fn draw / draw_faces(tile: &mut Tile, bins: &[Bins], index: usize)
}

#[inline(always)]
fn draw_faces<const F: bool>(tile: &mut Tile, bins: &[Bins], index: usize) {
    for back in [false, true] {
        for face in bins.iter().flat_map(|b| b.of(index)).filter(|face| face.back == back) {
            tile.draw(face);
        }
        tile.look_up_farthest();
    }
}

/// Some rows of the pictures that are made.
struct Band<'a> {
    top: usize,
    rgba: &'a mut [[f32; 4]],
    depth: &'a mut [f32],
    normal: &'a mut [[f32; 3]],
    triangles: &'a mut [u32],
}

/// Turns what a tile knows into pixels.
struct Painter<'a> {
    mesh: &'a Mesh,
    camera: &'a Camera,
    origin: DVec3,
    forward: Vec3,
    /// From the mesh's units to those of depth.
    scale: f32,
    world_from_mesh: Mat3,
    rays: Rays<'a>,
    /// Change of depth over one pixel, as a share of it, from which on a surface ends.
    jump: f32,
    smooth: bool,
}

impl Painter<'_> {
    /// Writes what is known of a tile's pixels, and queues what is to be colored.
    fn paint(
        &self,
        tile: &Tile,
        left: usize,
        [width, height]: [usize; 2],
        out: &mut Band,
        queue: &mut Queue,
    ) {
        let w = self.camera.width as usize;
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            let (i, pixel) = (y * TILE + x, y * w + left + x);
            let seen: [u32; SAMPLES + 1] = from_fn(|s| tile.triangle[s][i]);
            if seen == [NOTHING; SAMPLES + 1] {
                continue;
            }
            // samples of the same surface are colored together, first those of the one at the center
            let mut left_over: [bool; SAMPLES] = from_fn(|s| seen[s] != NOTHING);
            for s in [CENTER, 0, 1, 2, 3] {
                if seen[s] == NOTHING || (s != CENTER && !left_over[s]) {
                    continue;
                }
                let own = tile.inverse_depth[s][i];
                let mut count = 0;
                for (k, left) in left_over.iter_mut().enumerate().filter(|(_, left)| **left) {
                    let other = tile.inverse_depth[k][i];
                    if (other - own).abs() <= self.jump * own.min(other) {
                        (*left, count) = (false, count + 1);
                    }
                }
                let [px, py] = [GRID[s].0, GRID[s].1].map(|v| v as f32 / UNIT as f32);
                let Some(direction) = self.rays.through((left + x) as f32 + px, (out.top + y) as f32 + py)
                else {
                    continue;
                };
                let met = self.meet(seen[s], direction);
                if s == CENTER {
                    out.depth[pixel] = met.hit.t * direction.dot(self.forward) * self.scale;
                    if let Some(normal) = out.normal.get_mut(pixel) {
                        *normal = (self.world_from_mesh * met.normal).to_array();
                    }
                    out.triangles[pixel] = seen[s];
                }
                if count > 0 {
                    queue.push(met, pixel, count as f32 / SAMPLES as f32);
                }
            }
        }
    }

    /// Where the ray through a place of the picture meets a triangle, or passes it most closely: samples lie in snapped
    /// triangles.
    #[inline(always)]
    fn meet(&self, triangle: u32, direction: Vec3) -> Met {
        let corners = self.mesh.triangles[triangle as usize].map(|v| v as usize);
        let [a, b, c] = corners.map(|v| self.mesh.positions[v].as_dvec3());
        // Möller and Trumbore, without its bounds; in f64 for what is seen edge-on
        let (ab, ac, from, along) = (b - a, c - a, self.origin - a, direction.as_dvec3());
        let p = along.cross(ac);
        let over = 1.0 / ab.dot(p);
        let (mut u, mut v) = (from.dot(p) * over, along.dot(from.cross(ab)) * over);
        if !(u >= 0.0 && v >= 0.0 && u + v <= 1.0) {
            // an edge-on triangle has no place of its own
            (u, v) = if (u + v).is_finite() { (u.max(0.0), v.max(0.0)) } else { (1.0 / 3.0, 1.0 / 3.0) };
            let shrink = 1.0 / (u + v).max(1.0);
            (u, v) = (u * shrink, v * shrink);
        }
        let point = a + u * ab + v * ac;
        let t = (point - self.origin).dot(along) as f32;
        let (u, v) = (u as f32, v as f32);
        let flat = || ab.cross(ac).normalize_or_zero().as_vec3();
        let normal = if self.smooth {
            let [a, b, c] = corners.map(|v| self.mesh.normals[v]);
            (a + u * (b - a) + v * (c - a)).try_normalize().unwrap_or_else(flat)
        } else {
            flat()
        };
        Met { point: point.as_vec3(), normal, direction, hit: Hit { t, triangle, u, v } }
    }
}

/// What a ray met.
struct Met {
    point: Vec3,
    normal: Vec3,
    direction: Vec3,
    hit: Hit,
}

/// What waits for its color, with its pixel and its share of it.
#[derive(Default)]
struct Queue {
    hits: RayHits,
    shares: Vec<(usize, f32)>,
}

impl Queue {
    #[inline(always)]
    fn push(&mut self, met: Met, pixel: usize, share: f32) {
        self.hits.points.push(met.point);
        self.hits.normals.push(met.normal);
        self.hits.directions.push(met.direction);
        self.hits.hits.push(met.hit);
        self.shares.push((pixel, share));
    }

    /// Colors everything queued.
    fn shade(&mut self, rgba: &mut [[f32; 4]], color: &(impl Fn(&RayHits) -> Vec<[f32; 3]> + Sync)) {
        let colors = color(&self.hits);
        for (k, (pixel, share)) in self.shares.drain(..).enumerate() {
            let c = colors.get(k).unwrap_or(&[0.0; 3]);
            let p = &mut rgba[pixel];
            *p = [p[0] + share * c[0], p[1] + share * c[1], p[2] + share * c[2], p[3] + share];
        }
        self.hits.points.clear();
        self.hits.normals.clear();
        self.hits.directions.clear();
        self.hits.hits.clear();
    }
}

#[cfg(test)]
mod tests;
