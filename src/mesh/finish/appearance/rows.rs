//! Pixels of photographs as rows of a linear system.

use super::nodes::Nodes;
use crate::geom::{Bvh, Camera, Hit, Mesh};
use crate::image::{Gray, Photo, eroded};
use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;

/// Rays along each side of a pixel.
const SIDE: u32 = 2;

/// Mask from which on a pixel shows the head alone: matting and lossy masks rarely say 255 everywhere.
const OPAQUE: u8 = 250;

/// Rays of a pixel.
const RAYS: usize = (SIDE * SIDE) as usize;

/// A photograph that colors are fitted to.
#[derive(Clone, Copy)]
pub struct Photograph<'a> {
    /// Its camera, in the mesh's coordinates.
    pub camera: &'a Camera,
    /// Its pixels, sRGB-coded.
    pub photo: &'a Photo,
    /// Soft alpha of the head, same size; `None`: all is head.
    pub mask: Option<&'a Gray>,
    /// Usable pixels (non-zero), same size; `None`: all are.
    pub valid: Option<&'a Gray>,
}

impl Photograph<'_> {
    /// Returns whether a pixel shows the head alone. Soft pixels show what is behind the head, too, and would paint
    /// the outline with it.
    fn is_head(&self, at: usize) -> bool {
        self.mask.is_none_or(|m| m.values[at] >= OPAQUE) && self.valid.is_none_or(|v| v.values[at] > 0)
    }

    /// Returns the usable pixels within `margin` pixels of the mask's outline.
    pub(crate) fn outline(&self, margin: usize) -> Vec<usize> {
        let Some(mask) = self.mask else { return Vec::new() };
        let (w, h) = (mask.width as usize, mask.height as usize);
        // a mask continues beyond its border with the value at the border
        let (wide, high) = (w + 2 * margin, h + 2 * margin);
        let inner = |at: usize, n: usize| at.clamp(margin, margin + n - 1) - margin;
        let side = |head: bool| {
            let of = |i: usize| (mask.values[inner(i / wide, h) * w + inner(i % wide, w)] >= 128) == head;
            let set = eroded((0..wide * high).map(of).collect(), wide, high, margin);
            (0..w * h).map(|i| set[(i / w + margin) * wide + i % w + margin]).collect::<Vec<bool>>()
        };
        let (inside, outside) = (side(true), side(false));
        let usable = |at: &usize| self.valid.is_none_or(|v| v.values[*at] > 0);
        (0..w * h).filter(|&at| !inside[at] && !outside[at]).filter(usable).collect()
    }

    /// Returns how many pixels show the head alone.
    pub fn head_pixels(&self) -> usize {
        (0..self.photo.rgb.len()).into_par_iter().filter(|&at| self.is_head(at)).count()
    }
}

/// Pixels that the head fills, by the mask and by all of their rays; `[rows]` each.
#[derive(Default)]
pub struct Rows {
    /// Colors of the photograph, sRGB-coded.
    pub photo: Vec<[f32; 3]>,
    /// Unit directions to the viewer, turned to the coordinates of the harmonics.
    pub directions: Vec<Vec3>,
    /// Weights of the rows, 0..=1: the root of the cosine between view and surface.
    pub weight: Vec<f32>,
    /// Photograph of each row.
    pub view: Vec<u32>,
    /// The hits of a row's rays, all rows in one list.
    hits: Vec<Hit>,
}

impl Rows {
    /// Looks at every `stride`-th pixel each way of the photographs; `turned` leads from the mesh's coordinates to
    /// those of the harmonics.
    pub fn new(mesh: &Mesh, bvh: &Bvh, photographs: &[Photograph], stride: u32, turned: Mat3) -> Rows {
        let lines: Vec<(u32, u32)> = (0..photographs.len() as u32)
            .flat_map(|v| {
                let height = photographs[v as usize].photo.height;
                (0..height).filter(move |y| y % stride == v % stride).map(move |y| (v, y))
            })
            .collect();
        let parts: Vec<Rows> = lines
            .par_chunks(8)
            .map(|lines| {
                let mut rows = Rows::default();
                for &(v, y) in lines {
                    rows.add_line(mesh, bvh, (v, &photographs[v as usize]), y, stride, turned);
                }
                rows
            })
            .collect();
        let mut rows = Rows::default();
        for part in parts {
            rows.photo.extend(part.photo);
            rows.directions.extend(part.directions);
            rows.weight.extend(part.weight);
            rows.view.extend(part.view);
            rows.hits.extend(part.hits);
        }
        rows
    }

    fn add_line(
        &mut self,
        mesh: &Mesh,
        bvh: &Bvh,
        (v, photograph): (u32, &Photograph),
        y: u32,
        stride: u32,
        turned: Mat3,
    ) {
        let Photograph { camera, photo, .. } = photograph;
        for x in (y / stride % stride..photo.width).step_by(stride as usize) {
            let at = y as usize * photo.width as usize + x as usize;
            if !photograph.is_head(at) {
                continue;
            }
            let (first, mut cosine) = (self.hits.len(), 0.0);
            for k in 0..SIDE * SIDE {
                let sub = |k: u32| (k as f32 + 0.5) / SIDE as f32;
                let ray = camera.ray(Vec2::new(x as f32 + sub(k % SIDE), y as f32 + sub(k / SIDE)));
                let Some((ray, hit)) = ray.and_then(|ray| Some((ray, bvh.closest_hit(&ray)?))) else { break };
                let [a, b, c] = mesh.corners(hit.triangle);
                let normal = (b - a).cross(c - a).normalize_or_zero();
                cosine -= normal.dot(ray.direction) / RAYS as f32;
                self.hits.push(hit);
            }
            let center = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let Some(ray) = center.filter(|_| self.hits.len() == first + RAYS) else {
                self.hits.truncate(first);
                continue;
            };
            self.photo.push(photo.rgb[at].map(|b| f32::from(b) / 255.0));
            self.directions.push(turned * -ray.direction);
            self.weight.push(cosine.clamp(0.0, 1.0).sqrt());
            self.view.push(v);
        }
    }

    /// Returns the number of rows.
    pub fn len(&self) -> usize {
        self.photo.len()
    }

    /// Returns every fourth row, for a first, cheap fit.
    pub fn quarter(&self) -> Rows {
        let some = || (0..self.len()).step_by(4);
        Rows {
            photo: some().map(|p| self.photo[p]).collect(),
            directions: some().map(|p| self.directions[p]).collect(),
            weight: some().map(|p| self.weight[p]).collect(),
            view: some().map(|p| self.view[p]).collect(),
            hits: some().flat_map(|p| &self.hits[p * RAYS..(p + 1) * RAYS]).copied().collect(),
        }
    }

    /// Returns the nodes under all rows, and their weights.
    pub fn matrix(&self, nodes: &Nodes) -> Matrix {
        let all: Vec<usize> = (0..self.len()).collect();
        let parts: Vec<(Vec<u32>, Vec<(u32, f32)>)> = all
            .par_chunks(1 << 14)
            .map(|rows| {
                let (mut counts, mut entries) = (Vec::with_capacity(rows.len()), Vec::new());
                let mut row: Vec<(u32, f32)> = Vec::new();
                for &p in rows {
                    row.clear();
                    for hit in &self.hits[p * RAYS..(p + 1) * RAYS] {
                        nodes.under(hit, |node, w| match row.iter_mut().find(|e| e.0 == node) {
                            Some(e) => e.1 += w / RAYS as f32,
                            None => row.push((node, w / RAYS as f32)),
                        });
                    }
                    counts.push(row.len() as u32);
                    entries.extend_from_slice(&row);
                }
                (counts, entries)
            })
            .collect();
        let mut start = vec![0u32];
        let mut entries: Vec<(u32, f32)> = Vec::with_capacity(parts.iter().map(|p| p.1.len()).sum());
        for (counts, part) in parts {
            for n in counts {
                start.push(start[start.len() - 1] + n);
            }
            entries.extend(part);
        }
        let mut column_start = vec![0u32; nodes.len() + 1];
        entries.iter().for_each(|e| column_start[e.0 as usize + 1] += 1);
        (0..nodes.len()).for_each(|i| column_start[i + 1] += column_start[i]);
        let mut next = column_start.clone();
        let mut column_entries = vec![(0u32, 0f32); entries.len()];
        for p in 0..self.len() {
            for &(node, w) in &entries[start[p] as usize..start[p + 1] as usize] {
                column_entries[next[node as usize] as usize] = (p as u32, w);
                next[node as usize] += 1;
            }
        }
        Matrix { start, entries, column_start, column_entries }
    }
}

/// Which nodes a row shows and which rows show a node, with the node's share of the row.
pub struct Matrix {
    start: Vec<u32>,
    entries: Vec<(u32, f32)>,
    column_start: Vec<u32>,
    column_entries: Vec<(u32, f32)>,
}

impl Matrix {
    /// Returns the nodes of a row; their shares sum to 1.
    pub fn row(&self, row: usize) -> &[(u32, f32)] {
        &self.entries[self.start[row] as usize..self.start[row + 1] as usize]
    }

    /// Returns the rows of a node.
    pub fn column(&self, node: usize) -> &[(u32, f32)] {
        &self.column_entries[self.column_start[node] as usize..self.column_start[node + 1] as usize]
    }

    /// Returns the share of the nodes that some row shows.
    pub fn seen(&self) -> f64 {
        let nodes = self.column_start.len() - 1;
        (0..nodes).filter(|&n| !self.column(n).is_empty()).count() as f64 / nodes.max(1) as f64
    }
}
