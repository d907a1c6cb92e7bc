//! Pixels of photographs as rows of a linear system.

use super::glare::is_glare;
use super::nodes::{Nodes, grouped};
use super::photograph::Photograph;
use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use std::ops::{Deref, Range};
use std::sync::Arc;
use tiface_base::geom::{Bvh, Hit, Mesh, ShellCaster, area_vector};

/// Rays along each side of a photograph's pixel; a rendered one is of a single ray.
const SIDE: u32 = 2;

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
    /// Its part of [`Rows::met`].
    hits: Range<u32>,
}

/// What a ray meets, and its share in the pixel.
type Met = (Hit, f32);

/// A mesh, and the translucent layers around it, as rays meet them.
pub struct RayTarget<'a> {
    pub mesh: &'a Mesh,
    pub bvh: Bvh,
    pub layers: Option<ShellCaster<'a>>,
}

/// The pixels that colors are fitted to.
pub struct Rows {
    rows: Vec<Row>,
    /// What their rays meet, of a ray layers first; the shares of a row sum to 1. It is shared with
    /// the rows that these are a part of.
    met: Arc<Vec<Met>>,
}

impl Deref for Rows {
    type Target = [Row];

    fn deref(&self) -> &[Row] {
        &self.rows
    }
}

impl Rows {
    /// Looks at every `stride`-th pixel each way of the photographs, and at every one of rendered
    /// views; `turned` leads from the mesh's coordinates to those of the harmonics.
    pub fn new(target: &RayTarget, photographs: &[Photograph], stride: u32, turned: Mat3) -> Rows {
        let stride = |v: u32| if photographs[v as usize].rendered { 1 } else { stride };
        let lines: Vec<(u32, u32)> = (0..photographs.len() as u32)
            .flat_map(|v| {
                let (height, stride) = (photographs[v as usize].photo.height, stride(v));
                (0..height).filter(move |y| y % stride == v % stride).map(move |y| (v, y))
            })
            .collect();
        let glare: Vec<Vec<bool>> = photographs.par_iter().map(is_glare).collect();
        let line = |&(view, y): &(u32, u32)| {
            let (photograph, glare) = (&photographs[view as usize], &glare[view as usize]);
            let stride = stride(view);
            let xs = (y / stride % stride..photograph.photo.width).step_by(stride as usize);
            let row = y as usize * photograph.photo.width as usize;
            let (mut rows, mut met) = (Vec::new(), Vec::new());
            for x in xs.filter(|x| !glare[row + *x as usize]) {
                let before = met.len();
                match Row::new(target, (view, photograph), [x, y], turned, &mut met) {
                    Some(row) => rows.push(row),
                    None => met.truncate(before),
                }
            }
            (rows, met)
        };
        let parts: Vec<(Vec<Row>, Vec<Met>)> = lines.par_iter().map(line).collect();
        let mut rows = Vec::with_capacity(parts.iter().map(|part| part.0.len()).sum());
        let mut met: Vec<Met> = Vec::with_capacity(parts.iter().map(|part| part.1.len()).sum());
        for (of_line, met_there) in parts {
            let base = u32::try_from(met.len()).expect("rays of some million pixels meet less");
            let moved = |Range { start, end }: Range<u32>| base + start..base + end;
            rows.extend(of_line.into_iter().map(|row| Row { hits: moved(row.hits), ..row }));
            met.extend(met_there);
        }
        Rows { rows, met: Arc::new(met) }
    }

    /// Returns every second row, for a first, cheaper fit. Of every fourth, colors seem to depend
    /// less on the view than they do.
    pub fn half(&self) -> Rows {
        Rows { rows: self.rows.iter().step_by(2).cloned().collect(), met: self.met.clone() }
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
                    for (hit, share) in &self.met[hits.start as usize..hits.end as usize] {
                        nodes.under(hit, |node, w| match row.iter_mut().find(|e| e.0 == node) {
                            Some(e) => e.1 += w * share,
                            None => row.push((node, w * share)),
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
    /// Returns a pixel of a photograph, if the head fills it, and appends what its rays meet to
    /// `met`.
    fn new(
        RayTarget { mesh, bvh, layers }: &RayTarget,
        (view, photograph): (u32, &Photograph),
        [x, y]: [u32; 2],
        turned: Mat3,
        met: &mut Vec<Met>,
    ) -> Option<Row> {
        let Photograph { camera, photo, .. } = photograph;
        let at = y as usize * photo.width as usize + x as usize;
        if !photograph.is_head(at) {
            return None;
        }
        let mut cosine = 0.0;
        let side = if photograph.rendered { 1 } else { SIDE };
        let share = 1.0 / (side * side) as f32;
        let first = met.len() as u32;
        for k in 0..side * side {
            let sub = |k: u32| (k as f32 + 0.5) / side as f32;
            let ray = camera.ray(Vec2::new(x as f32 + sub(k % side), y as f32 + sub(k / side)))?;
            let hit = bvh.closest_hit(&ray)?;
            let normal = area_vector(mesh.corners(hit.triangle)).normalize_or_zero();
            cosine -= normal.dot(ray.direction) * share;
            let mut left = share;
            if let Some(layers) = layers {
                layers.cast(&ray, hit.t, |_, hit, alpha| {
                    met.push((hit, left * alpha));
                    left *= 1.0 - alpha;
                });
            }
            met.push((hit, left));
        }
        let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))?;
        Some(Row {
            photo: photo.rgb[at].map(|b| f32::from(b) / 255.0),
            direction: turned * -ray.direction,
            weight: cosine.clamp(0.0, 1.0).sqrt(),
            view,
            hits: first..met.len() as u32,
        })
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
