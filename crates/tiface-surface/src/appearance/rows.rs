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

/// What a ray meets, in little memory: with soft layers there are tens of them a pixel.
#[derive(Clone, Copy)]
struct PackedHit {
    triangle: u32,
    /// Weights of the triangle's second and third vertex, in 1 / [`STEPS`]; rounded down, so that
    /// they sum to 1 at most.
    weights: [u16; 2],
    /// Its share in the pixel.
    share: f32,
}

/// Steps of a weight or share from 0 to 1.
const STEPS: f32 = 65535.0;

impl PackedHit {
    fn new(hit: &Hit, share: f32) -> PackedHit {
        PackedHit { triangle: hit.triangle, weights: [hit.u, hit.v].map(|w| (w * STEPS) as u16), share }
    }

    fn hit(&self) -> Hit {
        let [u, v] = self.weights.map(|w| f32::from(w) / STEPS);
        Hit { t: 0.0, triangle: self.triangle, u, v }
    }
}

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
    met: Arc<Vec<PackedHit>>,
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
        let parts: Vec<(Vec<Row>, Vec<PackedHit>)> = lines.par_iter().map(line).collect();
        let mut rows = Vec::with_capacity(parts.iter().map(|part| part.0.len()).sum());
        let mut met: Vec<PackedHit> = Vec::with_capacity(parts.iter().map(|part| part.1.len()).sum());
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
        let parts: Vec<SparseRows> = self
            .par_chunks(1 << 14)
            .map(|rows| {
                let mut part = SparseRows { start: vec![0], ..SparseRows::default() };
                let mut row: Vec<(u32, f32)> = Vec::new();
                for Row { hits, .. } in rows {
                    row.clear();
                    for met in &self.met[hits.start as usize..hits.end as usize] {
                        nodes.under(&met.hit(), |node, w| match row.iter_mut().find(|e| e.0 == node) {
                            Some(e) => e.1 += w * met.share,
                            None => row.push((node, w * met.share)),
                        });
                    }
                    part.push_row(&row);
                }
                part
            })
            .collect();
        let len = parts.iter().map(|part| part.index.len()).sum();
        let mut rows =
            SparseRows { start: vec![0], index: Vec::with_capacity(len), share: Vec::with_capacity(len) };
        for part in parts {
            let base = rows.index.len() as u32;
            rows.start.extend(part.start[1..].iter().map(|start| base + start));
            rows.index.extend(part.index);
            rows.share.extend(part.share);
        }
        let mut columns = SparseRows { start: Vec::new(), index: vec![0; len], share: vec![0; len] };
        let by_node =
            (0..self.len()).flat_map(|p| rows.packed(p).map(move |(node, share)| (node, (p as u32, share))));
        columns.start = grouped(nodes.len(), by_node, |at, (row, share)| {
            (columns.index[at], columns.share[at]) = (row, share);
        });
        Matrix { rows, columns }
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
        met: &mut Vec<PackedHit>,
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
                    met.push(PackedHit::new(&hit, left * alpha));
                    left *= 1.0 - alpha;
                });
            }
            met.push(PackedHit::new(&hit, left));
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
    rows: SparseRows,
    columns: SparseRows,
}

/// For each row its nodes, or for each node its rows, with the node's share of the row. They take
/// most of a fit's memory, and reading them most of its time.
#[derive(Default)]
struct SparseRows {
    /// Where the entries of each begin; one more than there are.
    start: Vec<u32>,
    /// Node or row of each entry.
    index: Vec<u32>,
    /// Share of each entry, in 1 / [`STEPS`].
    share: Vec<u16>,
}

impl SparseRows {
    /// Appends the entries of a row whose shares do not round to 0.
    fn push_row(&mut self, row: &[(u32, f32)]) {
        for &(index, share) in row {
            let share = (share * STEPS + 0.5) as u16;
            if share > 0 {
                self.index.push(index);
                self.share.push(share);
            }
        }
        self.start.push(self.index.len() as u32);
    }

    fn range(&self, i: usize) -> Range<usize> {
        self.start[i] as usize..self.start[i + 1] as usize
    }

    #[inline(always)]
    fn packed(&self, i: usize) -> impl Iterator<Item = (u32, u16)> + Clone {
        let range = self.range(i);
        self.index[range.clone()].iter().copied().zip(self.share[range].iter().copied())
    }

    #[inline(always)]
    fn entries(&self, i: usize) -> impl Iterator<Item = (u32, f32)> {
        self.packed(i).map(|(index, share)| (index, f32::from(share) * (1.0 / STEPS)))
    }
}

impl Matrix {
    /// Returns the nodes of a row; their shares sum to 1, but for rounding to [`STEPS`].
    #[inline(always)]
    pub fn row(&self, row: usize) -> impl Iterator<Item = (u32, f32)> {
        self.rows.entries(row)
    }

    /// Returns the rows of a node.
    #[inline(always)]
    pub fn column(&self, node: usize) -> impl Iterator<Item = (u32, f32)> {
        self.columns.entries(node)
    }

    /// Returns the share of the nodes that some row shows.
    pub fn seen(&self) -> f64 {
        let nodes = self.columns.start.len() - 1;
        (0..nodes).filter(|&n| !self.columns.range(n).is_empty()).count() as f64 / nodes.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_hits_stay_on_their_triangle() {
        let third = 1.0 / 3.0;
        let places = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [third, third], [0.1, 0.9]];
        for [u, v] in places.into_iter().chain([[-1e-7, 1.0 + 1e-7], [f32::EPSILON, 1.0]]) {
            let packed = PackedHit::new(&Hit { t: 3.0, triangle: 7, u, v }, 0.25);
            let hit = packed.hit();
            assert_eq!((hit.triangle, packed.share), (7, 0.25));
            assert!(hit.weights().iter().all(|w| (0.0..=1.0).contains(w)), "{u} {v}: {:?}", hit.weights());
            assert!((hit.u - u).abs() <= 1.0 / STEPS && (hit.v - v).abs() <= 1.0 / STEPS, "{u} {v}");
        }
    }

    #[test]
    fn shares_are_stored_to_half_a_step_and_those_of_nothing_are_not() {
        let shares = [0.5, 0.3, 0.2 - 4e-6, 4e-6, 0.0];
        let mut rows = SparseRows { start: vec![0], ..SparseRows::default() };
        rows.push_row(&[]);
        rows.push_row(&(0..).zip(shares).collect::<Vec<_>>());
        assert_eq!(rows.entries(0).count(), 0);
        let stored: Vec<(u32, f32)> = rows.entries(1).collect();
        assert_eq!(stored.iter().map(|entry| entry.0).collect::<Vec<_>>(), [0, 1, 2]);
        assert!(stored.iter().zip(shares).all(|((_, own), share)| (own - share).abs() <= 0.51 / STEPS));
    }
}
