//! Sparse extraction of the zero level set of an expensive field: only nodes near the surface are evaluated.
//!
//! 1. Every `coarse_step`-th node of the grid, along each axis, is evaluated (every 8th: 0.2 %).
//! 2. Coarse edges that change sign are bisected down to one crossed grid edge each. Coarse cells
//!    without a change but close to the surface by their values, `|f| ≤ k · half diagonal` with k the
//!    99th percentile of the gradient norm, are probed at their middle and the middles of their eighths,
//!    once the flood has run and unless it has been there.
//! 3. **Flood.** Whenever two evaluated neighbours differ in sign, all four cells around that edge are
//!    evaluated, until none is left. The rule looks at evaluated nodes only, so the surface it leaves is
//!    closed by construction, whatever k was, and equal to the dense one on every piece it met.
//!
//! A piece that lies between coarse nodes and whose neighbours' values do not betray it is missed: take
//! a finer coarse step for that. Nodes on the outer faces of the grid count as outside; so do nodes for
//! outside the hull, without evaluating the field. Waves of a flood that starts everywhere are few
//! and large, so that the field is evaluated at thousands of points at a time.

use super::NodeGrid;
use super::marching::LevelSet;
use super::sparse_blocks::Blocks;
use crate::mesh::input::{check_len, setting};
use crate::{Monitor, Result};
use glam::Vec3;

/// A surface and the cost of its extraction.
#[derive(Clone, Debug, Default)]
pub struct Sparse {
    /// The closed surface; empty when no piece was met.
    pub surface: LevelSet,
    /// Nodes at which the field was evaluated.
    pub evaluated: usize,
    /// Nodes that counted as outside without being evaluated.
    pub skipped: usize,
    /// 99th percentile of the field's gradient norm over coarse nodes.
    pub gradient_norm: f32,
    /// Smallest and largest finite value met; infinite and swapped when none was.
    pub range: (f32, f32),
}

/// Returns the zero level set of `field` over `grid`, closed at its borders.
///
/// The first nodes evaluated lie `coarse_step` cells apart. `field` gets at most `batch` points a call and is called
/// from one thread: it may well use all of them. Nodes for which `inside_hull` is false count as outside.
///
/// # Errors
///
/// A field that returns the wrong number of values, a coarse step other than 2, 4, 8, more vertices than 32-bit
/// indices can name, a request to stop, which is looked for between batches.
pub fn sparse(
    field: &dyn Fn(&[Vec3]) -> Vec<f32>,
    inside_hull: Option<&dyn Fn(Vec3) -> bool>,
    grid: &NodeGrid,
    coarse_step: usize,
    batch: usize,
    monitor: &dyn Monitor,
) -> Result<Sparse> {
    setting([2, 4, 8].contains(&coarse_step), "coarse_step", "2, 4 or 8", coarse_step)?;
    let lattice = grid.dims.map(|d| (d - 1) / coarse_step + 1);
    let mut flood = Flood {
        field,
        inside_hull,
        grid: *grid,
        coarse_step,
        batch,
        monitor,
        lattice,
        coarse: vec![f32::NAN; lattice.iter().product()],
        blocks: Blocks::new(grid.dims),
        wanted: Vec::new(),
        cells: Vec::new(),
        out: Sparse { range: (f32::INFINITY, f32::NEG_INFINITY), ..Sparse::default() },
    };
    flood.evaluate_coarse()?;
    let edges = flood.coarse_crossings();
    flood.bisect(edges)?;
    flood.spread()?;
    flood.probe()?;
    flood.spread()?;
    let Flood { mut blocks, mut out, .. } = flood;
    out.surface = blocks.surface(grid)?;
    Ok(out)
}

/// A run of nodes along `axis` from one that is on one side of the surface to one on the other.
#[derive(Clone, Copy)]
struct NodeRun {
    start: [usize; 3],
    axis: usize,
    /// Ends as coordinates along the axis, `low < high`.
    low: usize,
    high: usize,
    /// Is the low end inside?
    low_inside: bool,
}

struct Flood<'a> {
    field: &'a dyn Fn(&[Vec3]) -> Vec<f32>,
    inside_hull: Option<&'a dyn Fn(Vec3) -> bool>,
    grid: NodeGrid,
    coarse_step: usize,
    batch: usize,
    monitor: &'a dyn Monitor,
    lattice: [usize; 3],
    /// `[z, y, x]` over the lattice: NaN where not evaluated (border) or not a number: outside.
    coarse: Vec<f32>,
    blocks: Blocks,
    /// Nodes marked as known whose value is still to come.
    wanted: Vec<[usize; 3]>,
    /// Cells queued and not yet looked at.
    cells: Vec<[usize; 3]>,
    out: Sparse,
}

impl Flood<'_> {
    /// Values at nodes, outside ones without evaluating them. Order as given.
    fn evaluate(&mut self, nodes: &[[usize; 3]]) -> Result<Vec<f32>> {
        let mut values = Vec::with_capacity(nodes.len());
        for nodes in nodes.chunks(self.batch.max(1)) {
            self.monitor.check_stop()?;
            let points: Vec<Vec3> = nodes.iter().map(|&n| self.grid.point(n)).collect();
            // One cell is a fair guess of how far outside a skipped node is.
            let mut batch = vec![self.grid.spacing; points.len()];
            let inside = |p: Vec3| self.inside_hull.is_none_or(|inside| inside(p));
            let keep: Vec<usize> = (0..points.len()).filter(|&i| inside(points[i])).collect();
            let evaluated: Vec<Vec3> = keep.iter().map(|&i| points[i]).collect();
            let answer = if evaluated.is_empty() { Vec::new() } else { (self.field)(&evaluated) };
            check_len("signed distance", evaluated.len(), answer.len())?;
            for (&i, &v) in keep.iter().zip(&answer) {
                batch[i] = v;
                if v.is_finite() {
                    let (low, high) = self.out.range;
                    self.out.range = (low.min(v), high.max(v));
                }
            }
            self.out.evaluated += evaluated.len();
            self.out.skipped += points.len() - evaluated.len();
            values.extend(batch);
        }
        Ok(values)
    }

    fn lattice_index(&self, at: [usize; 3]) -> usize {
        (at[2] * self.lattice[1] + at[1]) * self.lattice[0] + at[0]
    }

    fn lattice_points(&self) -> impl Iterator<Item = [usize; 3]> + use<> {
        let [nx, ny, nz] = self.lattice;
        (0..nz).flat_map(move |z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])))
    }

    fn evaluate_coarse(&mut self) -> Result<()> {
        let step = self.coarse_step;
        let nodes: Vec<[usize; 3]> =
            self.lattice_points().map(|l| l.map(|c| c * step)).filter(|&n| !self.grid.on_border(n)).collect();
        let values = self.evaluate(&nodes)?;
        for (n, v) in nodes.iter().zip(values) {
            let i = self.lattice_index(n.map(|c| c / step));
            self.coarse[i] = v;
        }
        // Norm of the forward differences wherever all four values are numbers.
        let length = step as f32 * self.grid.spacing;
        let mut norms = Vec::new();
        for l in self.lattice_points() {
            if (0..3).any(|a| l[a] + 1 == self.lattice[a]) {
                continue;
            }
            let here = self.coarse[self.lattice_index(l)];
            let slope = Vec3::from(std::array::from_fn(|a| {
                let mut next = l;
                next[a] += 1;
                (self.coarse[self.lattice_index(next)] - here) / length
            }));
            if slope.is_finite() {
                norms.push(slope.length());
            }
        }
        norms.sort_by(f32::total_cmp);
        self.out.gradient_norm = norms.get(norms.len() * 99 / 100).copied().unwrap_or(1.0);
        Ok(())
    }

    /// Whether a lattice node is inside. A node that was not evaluated is not.
    fn coarse_inside(&self, at: [usize; 3]) -> bool {
        self.coarse[self.lattice_index(at)] < 0.0
    }

    fn coarse_crossings(&self) -> Vec<NodeRun> {
        let step = self.coarse_step;
        let mut spans = Vec::new();
        for l in self.lattice_points() {
            let low_inside = self.coarse_inside(l);
            for axis in 0..3 {
                let last = l[axis] + 1 == self.lattice[axis];
                let mut next = l;
                next[axis] += 1;
                // Past the last lattice node lies the border, which is outside.
                let high_inside = !last && self.coarse_inside(next);
                let low = l[axis] * step;
                let high = if last { self.grid.dims[axis] - 1 } else { low + step };
                if low_inside != high_inside && high > low {
                    spans.push(NodeRun { start: l.map(|c| c * step), axis, low, high, low_inside });
                }
            }
        }
        spans
    }

    /// Halves all spans until their ends are neighbours, the ends' values known.
    fn bisect(&mut self, mut spans: Vec<NodeRun>) -> Result<()> {
        let at = |s: &NodeRun, c: usize| {
            let mut n = s.start;
            n[s.axis] = c;
            n
        };
        for s in &spans {
            // A border end may not have been evaluated: it matters as a neighbour of the last node.
            for c in [s.low, s.high] {
                self.want(at(s, c));
            }
        }
        self.settle()?;
        while !spans.is_empty() {
            let middle = |s: &NodeRun| s.low.midpoint(s.high);
            spans.retain(|s| s.high - s.low > 1);
            for s in &spans {
                self.want(at(s, middle(s)));
            }
            self.settle()?;
            for s in &mut spans {
                let m = middle(s);
                if self.blocks.inside(at(s, m)) == s.low_inside {
                    s.low = m;
                } else {
                    s.high = m;
                }
            }
        }
        Ok(())
    }

    /// Returns the lattice's value of a node, where it has been evaluated.
    fn lattice_value(&self, node: [usize; 3]) -> Option<f32> {
        let step = self.coarse_step;
        (node.iter().all(|c| c % step == 0) && !self.grid.on_border(node))
            .then(|| self.coarse[self.lattice_index(node.map(|c| c / step))])
    }

    /// Has a node evaluated with the next batch, unless it is known.
    fn want(&mut self, node: [usize; 3]) {
        if self.blocks.claim(node) {
            self.wanted.push(node);
        }
    }

    /// Evaluates the wanted nodes and queues the cells around every crossed edge.
    fn settle(&mut self) -> Result<()> {
        let nodes = std::mem::take(&mut self.wanted);
        let (old, new): (Vec<_>, Vec<_>) = nodes.iter().partition(|&&n| self.lattice_value(n).is_some());
        for &n in &old {
            let value = self.lattice_value(n).unwrap_or(f32::NAN);
            self.blocks.set(n, value, true);
        }
        let values = self.evaluate(&new)?;
        for (&n, v) in new.iter().zip(values) {
            self.blocks.set(n, v, !self.grid.on_border(n));
        }
        for &n in &nodes {
            let inside = self.blocks.inside(n);
            for axis in 0..3 {
                for forward in [false, true] {
                    let mut m = n;
                    if forward {
                        m[axis] += 1;
                        if m[axis] == self.grid.dims[axis] {
                            continue;
                        }
                    } else if m[axis] == 0 {
                        continue;
                    } else {
                        m[axis] -= 1;
                    }
                    let other = self.blocks.known(m).or_else(|| Some(self.lattice_value(m)? < 0.0));
                    if other.is_some_and(|o| o != inside) {
                        self.queue_around(if forward { n } else { m }, axis);
                    }
                }
            }
        }
        Ok(())
    }

    /// Queues the up to four cells that share the edge leaving `node` along `axis`.
    fn queue_around(&mut self, node: [usize; 3], axis: usize) {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for (du, dv) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let mut cell = node;
            if cell[u] < du || cell[v] < dv {
                continue;
            }
            cell[u] -= du;
            cell[v] -= dv;
            if (0..3).all(|a| cell[a] + 1 < self.grid.dims[a]) && self.blocks.claim_cell(cell) {
                self.cells.push(cell);
            }
        }
    }

    /// Floods until no crossed edge has a cell that was not evaluated.
    fn spread(&mut self) -> Result<()> {
        while !self.cells.is_empty() {
            for cell in std::mem::take(&mut self.cells) {
                for c in 0..8 {
                    self.want([cell[0] + (c & 1), cell[1] + (c >> 1 & 1), cell[2] + (c >> 2)]);
                }
            }
            self.settle()?;
        }
        Ok(())
    }

    /// Looks for pieces between coarse nodes of one sign.
    fn probe(&mut self) -> Result<()> {
        let step = self.coarse_step;
        let reach =
            |cells: usize| 0.5 * 3f32.sqrt() * cells as f32 * self.grid.spacing * self.out.gradient_norm;
        let (whole, half) = (reach(step), step / 2);
        let mut near = Vec::new();
        for l in self.lattice_points() {
            if (0..3).any(|a| l[a] + 1 == self.lattice[a]) {
                continue;
            }
            let corners: [f32; 8] = std::array::from_fn(|c| {
                self.coarse[self.lattice_index([l[0] + (c & 1), l[1] + (c >> 1 & 1), l[2] + (c >> 2)])]
            });
            let inside = corners[0] < 0.0;
            let alike = corners.iter().all(|&v| (v < 0.0) == inside);
            let close = corners.iter().any(|v| v.abs() <= whole);
            let corner = l.map(|c| c * step);
            if alike && close && !self.blocks.any_cell(corner, step) {
                near.push((corner, inside));
            }
        }
        let middles: Vec<[usize; 3]> = near.iter().map(|(c, _)| c.map(|x| x + half)).collect();
        let values = self.evaluate(&middles)?;
        let mut found = Vec::new();
        let mut eighths = Vec::new();
        for ((&(corner, inside), &middle), &v) in near.iter().zip(&middles).zip(&values) {
            if (v < 0.0) != inside {
                found.push((middle, corner, inside));
            } else if v.abs() <= whole && half > 1 {
                for c in 0..8 {
                    let quarter = |i: usize| corner[i] + half / 2 + half * (c >> i & 1);
                    eighths.push(([quarter(0), quarter(1), quarter(2)], corner, inside));
                }
            }
        }
        let nodes: Vec<[usize; 3]> = eighths.iter().map(|e| e.0).collect();
        let values = self.evaluate(&nodes)?;
        found.extend(eighths.iter().zip(values).filter(|(e, v)| (*v < 0.0) != e.2).map(|(e, _)| *e));

        // From each find walk to the coarse corner along the axes; one of the three legs changes sign.
        let turns =
            |from: [usize; 3], to: [usize; 3]| [from, [to[0], from[1], from[2]], [to[0], to[1], from[2]], to];
        for &(from, to, _) in &found {
            turns(from, to).into_iter().for_each(|n| self.want(n));
        }
        self.settle()?;
        let mut spans = Vec::new();
        for &(from, to, _) in &found {
            let path = turns(from, to);
            for axis in 0..3 {
                let (a, b) = (path[axis], path[axis + 1]);
                if self.blocks.inside(a) != self.blocks.inside(b) {
                    // The walk goes towards the lower corner: b is the low end.
                    let low_inside = self.blocks.inside(b);
                    spans.push(NodeRun { start: a, axis, low: b[axis], high: a[axis], low_inside });
                }
            }
        }
        self.bisect(spans)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::Aabb;
    use crate::mesh::{Volume, marching};
    use crate::monitor::{Quiet, Stopping};

    fn ball(center: Vec3, radius: f32) -> impl Fn(Vec3) -> f32 {
        move |p| p.distance(center) - radius
    }

    fn both(field: impl Fn(Vec3) -> f32, bounds: Aabb, resolution: usize) -> (Sparse, LevelSet) {
        let grid = NodeGrid::fit(bounds, resolution).unwrap();
        let evaluate = |p: &[Vec3]| p.iter().map(|&p| field(p)).collect::<Vec<_>>();
        let few = sparse(&evaluate, None, &grid, 8, 1 << 16, &Quiet).unwrap();
        let mut values = Vec::new();
        for k in 0..grid.dims[2] {
            for j in 0..grid.dims[1] {
                values.extend((0..grid.dims[0]).map(|i| field(grid.point([i, j, k]))));
            }
        }
        let volume = Volume {
            dims: grid.dims,
            values: &values,
            origin: grid.origin,
            spacing: Vec3::splat(grid.spacing),
        };
        (few, marching(&volume, true).unwrap())
    }

    /// The triangles as sorted positions: equal for equal surfaces, however numbered.
    fn key(s: &LevelSet) -> Vec<[[u32; 3]; 3]> {
        let mut all: Vec<_> = s
            .triangles
            .iter()
            .map(|t| {
                let mut c = t.map(|i| s.positions[i as usize].to_array().map(f32::to_bits));
                let first = (0..3).min_by_key(|&k| c[k]).unwrap();
                c.rotate_left(first);
                c
            })
            .collect();
        all.sort_unstable();
        all
    }

    #[test]
    fn the_grid_covers_a_long_box_with_cubes() {
        // 2 × 1 × 0.5 at 8 cells along x: h = 0.25, 8 × 4 × 2 cells.
        let b = Aabb { min: Vec3::ZERO, max: Vec3::new(2.0, 1.0, 0.5) };
        let g = NodeGrid::fit(b, 8).unwrap();
        assert_eq!((g.dims, g.spacing, g.origin), ([9, 5, 3], 0.25, Vec3::ZERO));
        assert!(NodeGrid::fit(Aabb::EMPTY, 8).is_err() && NodeGrid::fit(b, 1).is_err());
    }

    #[test]
    fn asking_few_gives_the_dense_surface() {
        let (few, dense) = both(ball(Vec3::new(0.1, -0.05, 0.02), 0.6), Aabb::SCENE, 64);
        assert_eq!(key(&few.surface), key(&dense));
        assert_eq!(few.surface.positions.len(), dense.positions.len());
        assert!(few.evaluated * 8 < 65 * 65 * 65, "{}", few.evaluated);
    }

    #[test]
    fn what_leaves_the_box_is_capped_as_in_the_dense_surface() {
        for axis in 0..3 {
            for side in [-1.0, 1.0] {
                let mut c = Vec3::splat(0.05);
                c[axis] = side;
                let (few, dense) = both(ball(c, 0.6), Aabb::SCENE, 40);
                assert_eq!(key(&few.surface), key(&dense));
                assert!(few.surface.capped > 0);
            }
        }
        let (few, dense) = both(ball(Vec3::ONE, 0.9), Aabb::SCENE, 40);
        assert_eq!(key(&few.surface), key(&dense));
    }

    #[test]
    fn a_face_in_a_block_border_and_a_tube_along_a_block_edge_survive() {
        // 64 cells of 1/32: block borders lie at multiples of 1/4; the plane x = 0.25 is zero there.
        let slab = |p: Vec3| (p.x - 0.25).max(-0.5 - p.x).max(p.y.abs() - 0.5).max(p.z.abs() - 0.5);
        let (few, dense) = both(slab, Aabb::SCENE, 64);
        assert_eq!(key(&few.surface), key(&dense));
        let tube = |p: Vec3| (p.x - 0.25).hypot(p.y - 0.25).max(p.z.abs() - 0.6) - 0.04;
        let (few, dense) = both(tube, Aabb::SCENE, 64);
        assert!(!dense.triangles.is_empty());
        assert_eq!(key(&few.surface), key(&dense));
    }

    #[test]
    fn a_floater_between_coarse_nodes_is_found_by_its_distance() {
        // Radius 2.5 cells about the middle of a coarse cell, far from the ball: no coarse node inside.
        let h = 2.0 / 64.0;
        let floater = ball(Vec3::splat(-1.0 + 12.0 * h), 2.5 * h);
        let big = ball(Vec3::splat(0.3), 0.4);
        let (few, dense) = both(|p| floater(p).min(big(p)), Aabb::SCENE, 64);
        assert_eq!(key(&few.surface), key(&dense));
    }

    #[test]
    fn a_skipped_half_is_never_evaluated_and_the_rest_is_closed_there() {
        let grid = NodeGrid::fit(Aabb::SCENE, 48).unwrap();
        let field = ball(Vec3::ZERO, 0.6);
        let evaluate = |p: &[Vec3]| {
            assert!(p.iter().all(|p| p.x <= 0.1));
            p.iter().map(|&p| field(p)).collect::<Vec<_>>()
        };
        let inside = |p: Vec3| p.x <= 0.1;
        let s = sparse(&evaluate, Some(&inside), &grid, 8, 1 << 16, &Quiet).unwrap();
        let mesh = crate::geom::Mesh {
            positions: s.surface.positions,
            triangles: s.surface.triangles,
            ..Default::default()
        };
        assert!(s.skipped > 0 && mesh.is_closed());
        assert!(mesh.bounds().max.x < 0.1 + grid.spacing);
    }

    #[test]
    fn a_stop_and_a_short_answer_are_errors() {
        let grid = NodeGrid::fit(Aabb::SCENE, 16).unwrap();
        let evaluate = |p: &[Vec3]| vec![1.0; p.len()];
        assert!(sparse(&evaluate, None, &grid, 8, 64, &Stopping).unwrap_err().kind().is_stop());
        let short = |p: &[Vec3]| vec![1.0; p.len() - 1];
        let error = sparse(&short, None, &grid, 8, 1 << 16, &Quiet).unwrap_err().to_string();
        assert!(error.contains("evaluated at 1 points and returned 0"), "{error}");
    }
}
