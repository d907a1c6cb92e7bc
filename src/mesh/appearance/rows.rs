//! Pixels of photographs as rows of a linear system.
//!
//! # Nodes
//!
//! The nodes of fitted colors: the vertices of a mesh, or the texels of its atlas.

use crate::geom::{Atlas, Bvh, Camera, Hit, Mesh, area_vector, bilinear_taps};
use crate::image::{Gray, Image, OPAQUE_ALPHA, Photo, eroded};
use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use std::ops::Deref;

/// Rays along each side of a pixel.
const SIDE: u32 = 2;

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
    /// Returns whether a pixel shows the head alone. Soft pixels also show the background, and would paint
    /// the outline with it.
    fn is_head(&self, at: usize) -> bool {
        self.mask.is_none_or(|m| m.values[at] >= OPAQUE_ALPHA) && self.valid.is_none_or(|v| v.values[at] > 0)
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

/// A pixel that the head fills, by the mask and by all of its rays.
#[derive(Clone)]
pub struct Row {
    /// Color of the photograph, sRGB-coded.
    pub photo: [f32; 3],
    /// Unit direction to the viewer, turned to the coordinates of the harmonics.
    pub direction: Vec3,
    /// Weight of the row, 0..=1: the root of the cosine between view and surface.
    pub weight: f32,
    /// Its photograph.
    pub view: u32,
    hits: [Hit; RAYS],
}

/// The pixels that colors are fitted to.
pub struct Rows(Vec<Row>);

impl Deref for Rows {
    type Target = [Row];

    fn deref(&self) -> &[Row] {
        &self.0
    }
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
        let line = |&(view, y): &(u32, u32)| {
            let photograph = &photographs[view as usize];
            let xs = (y / stride % stride..photograph.photo.width).step_by(stride as usize);
            xs.filter_map(move |x| Row::new(mesh, bvh, (view, photograph), [x, y], turned))
        };
        Rows(lines.par_iter().flat_map_iter(line).collect())
    }

    /// Returns every fourth row, for a first, cheap fit.
    pub fn quarter(&self) -> Rows {
        Rows(self.0.iter().step_by(4).cloned().collect())
    }

    /// Returns the nodes under all rows, and their weights.
    pub fn matrix(&self, nodes: &Nodes) -> Matrix {
        let parts: Vec<(Vec<u32>, Vec<(u32, f32)>)> = self
            .par_chunks(1 << 14)
            .map(|rows| {
                let (mut counts, mut entries) = (Vec::with_capacity(rows.len()), Vec::new());
                let mut row: Vec<(u32, f32)> = Vec::new();
                for Row { hits, .. } in rows {
                    row.clear();
                    for hit in hits {
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
        let row = |p: usize| start[p] as usize..start[p + 1] as usize;
        let by_node =
            (0..self.len()).flat_map(|p| entries[row(p)].iter().map(move |e| (e.0, (p as u32, e.1))));
        let (column_start, column_entries) = grouped(nodes.len(), by_node, (0, 0.0));
        Matrix { start, entries, column_start, column_entries }
    }
}

impl Row {
    /// Returns a pixel of a photograph, if the head fills it.
    fn new(
        mesh: &Mesh,
        bvh: &Bvh,
        (view, photograph): (u32, &Photograph),
        [x, y]: [u32; 2],
        turned: Mat3,
    ) -> Option<Row> {
        let Photograph { camera, photo, .. } = photograph;
        let at = y as usize * photo.width as usize + x as usize;
        if !photograph.is_head(at) {
            return None;
        }
        let mut cosine = 0.0;
        let mut hits = [Hit { t: 0.0, triangle: 0, u: 0.0, v: 0.0 }; RAYS];
        for (slot, k) in hits.iter_mut().zip(0..) {
            let sub = |k: u32| (k as f32 + 0.5) / SIDE as f32;
            let ray = camera.ray(Vec2::new(x as f32 + sub(k % SIDE), y as f32 + sub(k / SIDE)))?;
            *slot = bvh.closest_hit(&ray)?;
            let normal = area_vector(mesh.corners(slot.triangle)).normalize_or_zero();
            cosine -= normal.dot(ray.direction) / RAYS as f32;
        }
        let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))?;
        Some(Row {
            photo: photo.rgb[at].map(|b| f32::from(b) / 255.0),
            direction: turned * -ray.direction,
            weight: cosine.clamp(0.0, 1.0).sqrt(),
            view,
            hits,
        })
    }
}

/// Returns items by the group that each is in, in their order: the start of each group, and all groups in one list.
fn grouped<T: Copy>(
    groups: usize,
    items: impl Iterator<Item = (u32, T)> + Clone,
    none: T,
) -> (Vec<u32>, Vec<T>) {
    let mut start = vec![0u32; groups + 1];
    items.clone().for_each(|(group, _)| start[group as usize + 1] += 1);
    (0..groups).for_each(|i| start[i + 1] += start[i]);
    let mut next = start.clone();
    let mut all = vec![none; start[groups] as usize];
    for (group, item) in items {
        all[next[group as usize] as usize] = item;
        next[group as usize] += 1;
    }
    (start, all)
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

/// Points of a surface that carry unknowns, between which a surface interpolates.
pub struct Nodes {
    place: NodeLayout,
    count: usize,
    /// Start of each node's neighbors in `near`; one more entry than nodes.
    near_start: Vec<u32>,
    near: Vec<u32>,
}

enum NodeLayout {
    /// The vertices of these triangles.
    Vertices(Vec<[u32; 3]>),
    /// Texels: the corners of each triangle in texels, centers of texels at whole numbers; and the node of each
    /// texel, row by row, `u32::MAX` where no triangle is near.
    Texels { corners: Vec<[Vec2; 3]>, width: usize, height: usize, node: Vec<u32> },
}

impl Nodes {
    /// Returns one node a vertex; neighbors along the edges.
    pub fn vertices(mesh: &Mesh) -> Nodes {
        let mut edges: Vec<[u32; 2]> = mesh
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        edges.par_sort_unstable();
        edges.dedup();
        Nodes::linked(NodeLayout::Vertices(mesh.triangles.clone()), mesh.positions.len(), &edges)
    }

    /// Returns one node a texel that a bilinear look-up on a triangle can meet; neighbors beside and below.
    pub fn texels(atlas: &Atlas) -> Nodes {
        let (width, height) = (atlas.width as usize, atlas.height as usize);
        let corners: Vec<[Vec2; 3]> =
            (0..atlas.triangles.len() as u32).map(|t| atlas.corners(t).map(|c| c - 0.5)).collect();
        let mut touched = vec![false; width * height];
        for &[a, b, c] in &corners {
            let (low, high) = (a.min(b).min(c), a.max(b).max(c));
            if !(low.is_finite() && high.is_finite()) {
                continue;
            }
            let range = |low: f32, high: f32, n: usize| {
                let clamp = |v: f32| v.clamp(0.0, (n - 1) as f32) as usize;
                clamp(low.floor())..clamp(high.floor() + 1.0) + 1
            };
            for y in range(low.y, high.y, height) {
                for x in range(low.x, high.x, width) {
                    touched[y * width + x] |= within_a_tent(Vec2::new(x as f32, y as f32), [a, b, c]);
                }
            }
        }
        let mut node = vec![u32::MAX; width * height];
        let mut count = 0;
        for (n, _) in node.iter_mut().zip(&touched).filter(|(_, t)| **t) {
            *n = count;
            count += 1;
        }
        let mut edges = Vec::new();
        for (i, &own) in node.iter().enumerate().filter(|(_, n)| **n != u32::MAX) {
            let beside = (i % width + 1 < width).then(|| node[i + 1]);
            let below = node.get(i + width).copied();
            edges.extend([beside, below].into_iter().flatten().filter(|n| *n != u32::MAX).map(|n| [own, n]));
        }
        Nodes::linked(NodeLayout::Texels { corners, width, height, node }, count as usize, &edges)
    }

    fn linked(place: NodeLayout, count: usize, edges: &[[u32; 2]]) -> Nodes {
        let both = edges.iter().flat_map(|&[a, b]| [(a, b), (b, a)]);
        let (near_start, near) = grouped(count, both, 0);
        Nodes { place, count, near_start, near }
    }

    /// Returns the number of nodes.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Returns the neighbors of a node.
    pub fn near(&self, node: usize) -> &[u32] {
        &self.near[self.near_start[node] as usize..self.near_start[node + 1] as usize]
    }

    /// Calls `f` with the nodes under a point of a triangle and their weights, which sum to 1.
    pub fn under(&self, hit: &Hit, mut f: impl FnMut(u32, f32)) {
        match &self.place {
            NodeLayout::Vertices(triangles) => {
                triangles[hit.triangle as usize].iter().zip(hit.weights()).for_each(|(&i, w)| f(i, w));
            }
            NodeLayout::Texels { corners, width, height, node } => {
                let at = hit.mix(corners[hit.triangle as usize]);
                let taps = bilinear_taps(at, [*width as u32, *height as u32])
                    .map(|(texel, w)| (node[texel as usize], w));
                let known = |t: &&(u32, f32)| t.0 != u32::MAX && t.1 > 0.0;
                let total: f32 = taps.iter().filter(known).map(|t| t.1).sum();
                taps.iter().filter(known).for_each(|t| f(t.0, t.1 / total));
            }
        }
    }

    /// Returns the values of the texels of a picture of 3 channels, `[nodes]`; none of vertices.
    pub fn texels_of(&self, image: &Image) -> Vec<[f32; 3]> {
        let NodeLayout::Texels { node, .. } = &self.place else { return Vec::new() };
        let texels = image.data.as_chunks::<3>().0.iter().zip(node);
        texels.filter(|(_, n)| **n != u32::MAX).map(|(c, _)| *c).collect()
    }

    /// Interpolates `values` `[nodes]` at the vertices of the mesh, in one of the triangles of each vertex.
    pub fn at_corners(&self, mesh: &Mesh, values: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let mut out = vec![[0f32; 3]; mesh.positions.len()];
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            for (&vertex, (u, v)) in triangle.iter().zip([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]) {
                let mut sum = [0f32; 3];
                self.under(&Hit { t: 0.0, triangle: t as u32, u, v }, |node, w| {
                    (0..3).for_each(|k| sum[k] += w * values[node as usize][k]);
                });
                out[vertex as usize] = sum;
            }
        }
        out
    }

    /// Returns the texels of `image` with the `values` `[nodes]` in their places, and which texels have one.
    pub fn onto(&self, values: &[[f32; 3]], image: &Image) -> (Vec<[f32; 3]>, Vec<bool>) {
        let NodeLayout::Texels { node, .. } = &self.place else { return (values.to_vec(), Vec::new()) };
        let texels = image.data.as_chunks::<3>().0.iter().zip(node);
        let texel = |(c, n): (&[f32; 3], &u32)| (*values.get(*n as usize).unwrap_or(c), *n != u32::MAX);
        texels.map(texel).unzip()
    }
}

/// Returns whether a texel's bilinear tent may meet the triangle, by the lines of its edges.
fn within_a_tent(p: Vec2, [a, b, c]: [Vec2; 3]) -> bool {
    let turn = (b - a).perp_dot(c - a).signum();
    [(a, b), (b, c), (c, a)].iter().all(|&(from, to)| {
        let edge = to - from;
        turn * edge.perp_dot(p - from) >= -(edge.x.abs() + edge.y.abs())
    })
}
