//! A view of a mesh, rasterised: as the ray caster sees it, in a hundredth of the time.
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
use glam::Vec3;
use project::{Bins, Lens, Rays};
use rayon::prelude::*;
use tile::{GRID, NOTHING, SAMPLES, TILE, Tile, UNIT};

/// Depth change over one pixel, in pixel footprints, from which on a surface ends: tan 84°, as for rays.
const JUMP: f32 = 10.0;

/// How a mesh is rasterised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Are triangles seen from behind left out? Of a closed mesh nobody misses them.
    pub cull: bool,
    /// From the mesh's coordinates (in which the camera stands too) to those of depth and normals.
    pub world_from_scene: Similarity,
}

impl Default for RasterOptions {
    fn default() -> RasterOptions {
        RasterOptions { cull: false, world_from_scene: Similarity::IDENTITY }
    }
}

/// What one camera sees, and which triangles.
#[derive(Clone, Debug, PartialEq)]
pub struct RasterView {
    /// Color, depth and normals, as of a ray caster.
    pub view: RenderedView,
    /// `[height · width]` triangles at the centers of the pixels; `None` where there is none.
    pub triangles: Vec<Option<u32>>,
}

/// Rasterises a mesh.
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
/// assert_eq!(seen.view.depth.pixel(10, 5), [2.0]);
/// assert_eq!(seen.triangles[5 * 20 + 10], Some(0));
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
        normal: Image::new(width, height, 3),
    };
    let mut triangles = vec![None; width as usize * height as usize];
    let lens = if triangles.is_empty() { None } else { Lens::new(camera, mesh, options.cull) };
    let Some(lens) = lens else { return RasterView { view, triangles } };
    let bins = lens.bin(mesh);
    let w = width as usize;
    let rows = view
        .color
        .data
        .par_chunks_mut(TILE * w * 4)
        .zip(view.depth.data.par_chunks_mut(TILE * w))
        .zip(view.normal.data.par_chunks_mut(TILE * w * 3))
        .zip(triangles.par_chunks_mut(TILE * w));
    let painter = Painter {
        mesh,
        camera,
        options,
        origin: camera.position.as_vec3(),
        rays: Rays::new(camera),
        jump: JUMP / camera.fx.abs() as f32,
        smooth: mesh.normals.len() == mesh.positions.len(),
    };
    rows.enumerate().for_each_init(Tile::new, |tile, (row, (((rgba, depth), normal), triangles))| {
        let out = &mut Band {
            top: row * TILE,
            rgba: rgba.as_chunks_mut().0,
            depth,
            normal: normal.as_chunks_mut().0,
            triangles,
        };
        let across = w.div_ceil(TILE);
        for column in 0..across {
            let left = column * TILE;
            tile.move_to(left, out.top, TILE.min(w - left), out.depth.len() / w);
            if draw(tile, &bins, row * across + column) {
                painter.paint(tile, left, out, &color);
            }
        }
    });
    RasterView { view, triangles }
}

/// Draws what a tile holds: first what faces the camera, which hides most of the rest. Returns whether there was anything.
fn draw(tile: &mut Tile, bins: &[Bins], index: usize) -> bool {
    let mut any = false;
    for back in [false, true] {
        for face in bins.iter().flat_map(|b| b.of(index)).filter(|face| face.back == back) {
            tile.draw(face);
            any = true;
        }
        if any && !back {
            tile.look_up_farthest();
        }
    }
    any
}

/// Some rows of the pictures that are made.
struct Band<'a> {
    top: usize,
    rgba: &'a mut [[f32; 4]],
    depth: &'a mut [f32],
    normal: &'a mut [[f32; 3]],
    triangles: &'a mut [Option<u32>],
}

/// Turns what a tile knows into pixels.
struct Painter<'a> {
    mesh: &'a Mesh,
    camera: &'a Camera,
    options: &'a RasterOptions,
    origin: Vec3,
    rays: Rays<'a>,
    /// Change of depth over one pixel, as a share of it, from which on a surface ends.
    jump: f32,
    smooth: bool,
}

impl Painter<'_> {
    fn paint(
        &self,
        tile: &Tile,
        left: usize,
        out: &mut Band,
        color: &(impl Fn(&RayHits) -> Vec<[f32; 3]> + Sync),
    ) {
        let w = self.camera.width as usize;
        let world = &self.options.world_from_scene;
        let (scale, forward) = (world.scale as f32, self.camera.forward());
        let mut queue = RayHits::default();
        // pixel and share of it of each
        let mut shares = Vec::new();
        for i in 0..TILE * TILE {
            let (x, y) = (left + i % TILE, i / TILE);
            let center = tile.center_triangle[i];
            let covered = tile.triangle[i].map(|t| t != NOTHING);
            if center == NOTHING && covered == [false; SAMPLES] {
                continue;
            }
            let pixel = y * w + x;
            let at = ((x as f32), (out.top + y) as f32);
            let mut left_over = covered;
            let enqueue = |triangle: u32, at: (f32, f32), inverse_depth: f32, left: &mut [bool; SAMPLES]| {
                // samples of the same surface are colored together
                let near = |s: usize| {
                    let other = tile.inverse_depth[i][s];
                    (other - inverse_depth).abs() <= self.jump * inverse_depth.min(other)
                };
                let own: [bool; SAMPLES] = std::array::from_fn(|s| left[s] && near(s));
                let count = own.iter().filter(|&&own| own).count();
                (0..SAMPLES).for_each(|s| left[s] &= !own[s]);
                (count, self.meet(triangle, at))
            };
            if center != NOTHING {
                let (count, met) =
                    enqueue(center, (at.0 + 0.5, at.1 + 0.5), tile.center_inverse_depth[i], &mut left_over);
                if let Some(met) = met {
                    out.depth[pixel] = met.hit.t * met.direction.dot(forward) * scale;
                    out.normal[pixel] = world.direction(met.normal).normalize_or_zero().to_array();
                    out.triangles[pixel] = Some(center);
                    met.push(count, pixel, &mut queue, &mut shares);
                }
            }
            for s in 0..SAMPLES {
                if left_over[s] {
                    let place = [GRID[s].0, GRID[s].1].map(|v| v as f32 / UNIT as f32);
                    let (count, met) = enqueue(
                        tile.triangle[i][s],
                        (at.0 + place[0], at.1 + place[1]),
                        tile.inverse_depth[i][s],
                        &mut left_over,
                    );
                    if let Some(met) = met {
                        met.push(count, pixel, &mut queue, &mut shares);
                    }
                }
            }
        }
        let colors = color(&queue);
        for (k, (pixel, weight)) in shares.into_iter().enumerate() {
            let c = colors.get(k).unwrap_or(&[0.0; 3]);
            let p = &mut out.rgba[pixel];
            *p = [p[0] + weight * c[0], p[1] + weight * c[1], p[2] + weight * c[2], p[3] + weight];
        }
    }

    /// Where the ray through a place of the picture meets a triangle, or passes it most closely: samples lie in snapped
    /// triangles.
    #[inline(always)]
    fn meet(&self, triangle: u32, (x, y): (f32, f32)) -> Option<Met> {
        let direction = self.rays.through(x, y)?;
        let [a, b, c] = self.mesh.corners(triangle);
        // Möller and Trumbore, without its bounds
        let (ab, ac, from) = (b - a, c - a, self.origin - a);
        let p = direction.cross(ac);
        let q = from.cross(ab);
        let over = 1.0 / ab.dot(p);
        let (u, v) = (from.dot(p) * over, direction.dot(q) * over);
        let (u, v) =
            if u.is_finite() && v.is_finite() { (u.max(0.0), v.max(0.0)) } else { (1.0 / 3.0, 1.0 / 3.0) };
        let shrink = 1.0 / (u + v).max(1.0);
        let (u, v) = (u * shrink, v * shrink);
        let along = u * ab + v * ac;
        let t = (along - from).dot(direction);
        let flat = || ab.cross(ac).normalize_or_zero();
        let normal = if self.smooth {
            let [a, b, c] = self.mesh.triangles[triangle as usize].map(|i| self.mesh.normals[i as usize]);
            ((1.0 - u - v) * a + u * b + v * c).try_normalize().unwrap_or_else(flat)
        } else {
            flat()
        };
        Some(Met { point: a + along, normal, direction, hit: Hit { t, triangle, u, v } })
    }
}

/// What a ray met.
struct Met {
    point: Vec3,
    normal: Vec3,
    direction: Vec3,
    hit: Hit,
}

impl Met {
    /// Queues it for its color, as what `count` samples of a pixel show.
    #[inline(always)]
    fn push(self, count: usize, pixel: usize, queue: &mut RayHits, shares: &mut Vec<(usize, f32)>) {
        if count == 0 {
            return;
        }
        queue.points.push(self.point);
        queue.normals.push(self.normal);
        queue.directions.push(self.direction);
        queue.hits.push(self.hit);
        shares.push((pixel, count as f32 / SAMPLES as f32));
    }
}
