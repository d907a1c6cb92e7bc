//! Sparse extraction of the zero level set of an expensive field: only nodes near the surface are
//! evaluated.
//!
//! 1. Every `coarse_step`-th node of the grid, along each axis, is evaluated (every 8th: 0.2 %).
//! 2. So is every node along the coarse edges that change sign.
//! 3. **Flood.** Whenever two evaluated neighbors differ in sign, all four cells around that edge
//!    are evaluated, until none is left. The rule depends on evaluated nodes only, so the surface
//!    it leaves is closed by construction, and equal to the dense one on every piece it met.
//!
//! A piece that lies between coarse nodes is missed: a finer coarse step finds it. Nodes on the
//! outer faces of the grid count as outside. Nodes outside the hull count as outside too, and are
//! not evaluated. The flood starts everywhere at once, so its waves are few and large, and the
//! field is evaluated at thousands of points at a time.
//!
//! Evaluated nodes are kept in blocks near the surface (`blocks`).

use super::blocks::Blocks;
use super::marching::LevelSet;
use super::{BATCH, NodeGrid};
use crate::{check_len, setting};
use glam::Vec3;
use tiface_base::geom::SdfField;
use tiface_base::{Monitor, Result};

/// A surface and the cost of its extraction.
#[derive(Clone, Debug, Default)]
pub struct Sparse {
    /// The closed surface; empty when no piece was met.
    pub surface: LevelSet,
    /// Nodes at which the field was evaluated.
    pub evaluated: usize,
    /// Nodes that counted as outside without being evaluated.
    pub skipped: usize,
    /// Smallest and largest finite value met; infinite and swapped when none was.
    pub range: (f32, f32),
}

/// Returns the zero level set of `field` over `grid`, closed at its borders.
///
/// The first nodes evaluated lie `coarse_step` cells apart. The field is called from one thread: it
/// may well use all of them. Nodes that it excludes count as outside.
///
/// # Errors
///
/// A field that returns the wrong number of values, a coarse step other than 2, 4, 8, more vertices
/// than 32-bit indices can name, a request to stop, which is checked between batches.
pub fn sparse(
    field: &dyn SdfField,
    grid: &NodeGrid,
    coarse_step: usize,
    monitor: &dyn Monitor,
) -> Result<Sparse> {
    setting([2, 4, 8].contains(&coarse_step), "coarse_step", "2, 4 or 8", coarse_step)?;
    let lattice = grid.dims.map(|d| (d - 1) / coarse_step + 1);
    let mut flood = Flood {
        field,
        grid: *grid,
        coarse_step,
        monitor,
        lattice,
        coarse: vec![f32::NAN; lattice.iter().product()],
        blocks: Blocks::new(grid.dims),
        wanted: Vec::new(),
        cells: Vec::new(),
        out: Sparse { range: (f32::INFINITY, f32::NEG_INFINITY), ..Sparse::default() },
    };
    flood.evaluate_coarse()?;
    flood.evaluate_crossed_edges()?;
    flood.fill()?;
    let Flood { mut blocks, mut out, .. } = flood;
    out.surface = blocks.surface(grid)?;
    Ok(out)
}

struct Flood<'a> {
    field: &'a dyn SdfField,
    grid: NodeGrid,
    coarse_step: usize,
    monitor: &'a dyn Monitor,
    lattice: [usize; 3],
    /// `[z, y, x]` over the lattice: NaN where not evaluated (border) or not a number: outside.
    coarse: Vec<f32>,
    blocks: Blocks,
    /// Nodes marked as known whose value is still to come.
    wanted: Vec<[usize; 3]>,
    /// Cells that are queued and not yet processed.
    cells: Vec<[usize; 3]>,
    out: Sparse,
}

impl Flood<'_> {
    /// Returns the values at nodes, outside ones without evaluating them. Order as given.
    fn evaluate(&mut self, nodes: &[[usize; 3]]) -> Result<Vec<f32>> {
        let mut values = Vec::with_capacity(nodes.len());
        for nodes in nodes.chunks(BATCH) {
            self.monitor.check_stop()?;
            let points: Vec<Vec3> = nodes.iter().map(|&n| self.grid.point(n)).collect();
            // One cell is a fair guess of how far outside a skipped node is.
            let mut batch = vec![self.grid.spacing; points.len()];
            let keep: Vec<usize> = (0..points.len()).filter(|&i| !self.field.excludes(points[i])).collect();
            let evaluated: Vec<Vec3> = keep.iter().map(|&i| points[i]).collect();
            let answer = if evaluated.is_empty() { Vec::new() } else { self.field.sdf(&evaluated) };
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
        Ok(())
    }

    /// Returns whether a lattice node is inside. A node that was not evaluated is not.
    fn coarse_inside(&self, at: [usize; 3]) -> bool {
        self.coarse[self.lattice_index(at)] < 0.0
    }

    /// Evaluates every node along the coarse edges that change sign.
    fn evaluate_crossed_edges(&mut self) -> Result<()> {
        let step = self.coarse_step;
        for l in self.lattice_points() {
            for axis in 0..3 {
                let last = l[axis] + 1 == self.lattice[axis];
                let mut next = l;
                next[axis] += 1;
                // Past the last lattice node lies the border, which is outside.
                let crossed = self.coarse_inside(l) != (!last && self.coarse_inside(next));
                let low = l[axis] * step;
                let high = if last { self.grid.dims[axis] - 1 } else { low + step };
                for c in (low..=high).filter(|_| crossed && high > low) {
                    let mut node = l.map(|c| c * step);
                    node[axis] = c;
                    self.want(node);
                }
            }
        }
        self.evaluate_wanted()
    }

    /// Returns the lattice's value of a node, where it has been evaluated.
    fn lattice_value(&self, node: [usize; 3]) -> Option<f32> {
        let step = self.coarse_step;
        (node.iter().all(|c| c % step == 0) && !self.grid.on_border(node))
            .then(|| self.coarse[self.lattice_index(node.map(|c| c / step))])
    }

    /// Adds a node to the next batch, unless its value is known.
    fn want(&mut self, node: [usize; 3]) {
        if self.blocks.claim(node) {
            self.wanted.push(node);
        }
    }

    /// Evaluates the wanted nodes and queues the cells around every crossed edge.
    fn evaluate_wanted(&mut self) -> Result<()> {
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
    fn fill(&mut self) -> Result<()> {
        while !self.cells.is_empty() {
            for cell in std::mem::take(&mut self.cells) {
                for c in 0..8 {
                    self.want([cell[0] + (c & 1), cell[1] + (c >> 1 & 1), cell[2] + (c >> 2)]);
                }
            }
            self.evaluate_wanted()?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::Stopping;
    use crate::{Volume, marching};
    use tiface_base::Quiet;
    use tiface_base::geom::Aabb;

    fn ball(center: Vec3, radius: f32) -> impl Fn(Vec3) -> f32 + Sync {
        move |p| p.distance(center) - radius
    }

    fn both(field: impl Fn(Vec3) -> f32 + Sync, bounds: Aabb, resolution: usize) -> (Sparse, LevelSet) {
        let grid = NodeGrid::fit(bounds, resolution).unwrap();
        let few = sparse(&field, &grid, 8, &Quiet).unwrap();
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

    /// Returns the triangles as sorted positions: equal for equal surfaces, however numbered.
    fn key(s: &LevelSet) -> Vec<[[u32; 3]; 3]> {
        let mut all: Vec<_> = s
            .mesh
            .triangles
            .iter()
            .map(|t| {
                let mut c = t.map(|i| s.mesh.positions[i as usize].to_array().map(f32::to_bits));
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
        assert_eq!(few.surface.mesh.positions.len(), dense.mesh.positions.len());
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
        // 64 cells of 1/32: block borders lie at multiples of 1/4; the field is zero on the plane
        // x = 0.25.
        let slab = |p: Vec3| (p.x - 0.25).max(-0.5 - p.x).max(p.y.abs() - 0.5).max(p.z.abs() - 0.5);
        let (few, dense) = both(slab, Aabb::SCENE, 64);
        assert_eq!(key(&few.surface), key(&dense));
        let tube = |p: Vec3| (p.x - 0.25).hypot(p.y - 0.25).max(p.z.abs() - 0.6) - 0.04;
        let (few, dense) = both(tube, Aabb::SCENE, 64);
        assert!(!dense.mesh.triangles.is_empty());
        assert_eq!(key(&few.surface), key(&dense));
    }

    /// A field that excludes x > 0.1.
    struct Half<F>(F);

    impl<F: Fn(Vec3) -> f32 + Sync> SdfField for Half<F> {
        fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
            assert!(points.iter().all(|p| p.x <= 0.1));
            self.0.sdf(points)
        }

        fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
            self.0.sdf_gradient(points)
        }

        fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], _: &[Vec3]) -> Vec<[f32; 3]> {
            panic!("no color is asked for")
        }

        fn excludes(&self, point: Vec3) -> bool {
            point.x > 0.1
        }
    }

    /// A field that forgets its last point.
    struct Short;

    impl SdfField for Short {
        fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
            vec![1.0; points.len() - 1]
        }

        fn sdf_gradient(&self, _: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
            panic!("no gradient is asked for")
        }

        fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], _: &[Vec3]) -> Vec<[f32; 3]> {
            panic!("no color is asked for")
        }
    }

    #[test]
    fn a_skipped_half_is_never_evaluated_and_the_rest_is_closed_there() {
        let grid = NodeGrid::fit(Aabb::SCENE, 48).unwrap();
        let s = sparse(&Half(ball(Vec3::ZERO, 0.6)), &grid, 8, &Quiet).unwrap();
        let mesh = s.surface.mesh;
        assert!(s.skipped > 0 && mesh.is_closed());
        assert!(mesh.bounds().max.x < 0.1 + grid.spacing);
    }

    #[test]
    fn a_stop_and_a_short_answer_are_errors() {
        let grid = NodeGrid::fit(Aabb::SCENE, 16).unwrap();
        assert!(sparse(&|_: Vec3| 1.0, &grid, 8, &Stopping).unwrap_err().kind().is_stop());
        let error = sparse(&Short, &grid, 8, &Quiet).unwrap_err().to_string();
        assert!(error.contains("evaluated at 1 points and returned 0"), "{error}");
    }
}
