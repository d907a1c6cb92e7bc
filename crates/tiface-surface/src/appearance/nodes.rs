//! The nodes of fitted colors: the vertices of a mesh, or the texels of its atlas.

use glam::Vec2;
use rayon::prelude::*;
use tiface_base::geom::{Atlas, Hit, Mesh, bilinear_taps};
use tiface_base::image::Image;

/// Sorts items into groups, in their order: `put` gets each item and its place among those of all
/// groups. Returns the start of each group, and the end of the last.
pub(super) fn grouped<T>(
    groups: usize,
    items: impl Iterator<Item = (u32, T)> + Clone,
    mut put: impl FnMut(usize, T),
) -> Vec<u32> {
    let mut start = vec![0u32; groups + 1];
    items.clone().for_each(|(group, _)| start[group as usize + 1] += 1);
    (0..groups).for_each(|i| start[i + 1] += start[i]);
    let mut next = start.clone();
    for (group, item) in items {
        put(next[group as usize] as usize, item);
        next[group as usize] += 1;
    }
    start
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
    /// Texels: the corners of each triangle in texels, centers of texels at whole numbers; and the
    /// node of each texel, row by row, `u32::MAX` where no triangle is near.
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

    /// Returns one node a texel that a bilinear look-up on a triangle can meet; neighbors beside
    /// and below.
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
        let mut near = vec![0; 2 * edges.len()];
        let near_start = grouped(count, both, |at, node| near[at] = node);
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

    /// Returns values at nodes, each averaged with those of its neighbors in some rounds.
    pub fn smoothed(&self, mut values: Vec<f32>, rounds: usize) -> Vec<f32> {
        for _ in 0..rounds {
            let mean = |v: usize| {
                let near = self.near(v);
                (values[v] + near.iter().map(|&n| values[n as usize]).sum::<f32>()) / (near.len() + 1) as f32
            };
            values = (0..values.len()).into_par_iter().map(mean).collect();
        }
        values
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

    /// Interpolates `values` `[nodes]` at the vertices of the mesh, in one of the triangles of each
    /// vertex.
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

    /// Returns the texels of `image` with the `values` `[nodes]` in their places, and which texels
    /// have one.
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
