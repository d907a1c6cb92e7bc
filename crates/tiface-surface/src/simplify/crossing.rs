//! Triangles that pass through others: found in a finished mesh, and refused in the making.
//!
//! Triangles are entered into the cells of a grid that their boxes meet. The test of a pair is the
//! one of `files::check`; before it, a triangle strictly on one side of the other's plane is
//! let go.

use super::rings::{NONE, Rings};
use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Aabb, Boxes, DBox, Effort, intersect};

/// Maximum numbers of cells along an axis and in total.
const MAX_CELLS_PER_AXIS: f32 = 512.0;
const MAX_CELLS: f32 = 4e6;

/// A regular grid over a box.
#[derive(Clone, Copy)]
struct Cells {
    origin: Vec3,
    per_unit: f32,
    dims: IVec3,
}

impl Cells {
    /// Cells about as large as the boxes of these triangles.
    fn fit(positions: &[Vec3], triangles: &[[u32; 3]]) -> Cells {
        let (mut bounds, mut sum, mut n) = (Aabb::EMPTY, 0.0f64, 0usize);
        for t in triangles.iter().filter(|t| t[0] != NONE) {
            let corners = t.map(|v| positions[v as usize]);
            let b = Aabb::around(corners);
            bounds = bounds.with(b.min).with(b.max);
            sum += f64::from((b.max - b.min).max_element());
            n += 1;
        }
        if n == 0 {
            return Cells { origin: Vec3::ZERO, per_unit: 0.0, dims: IVec3::ONE };
        }
        let extent = bounds.max - bounds.min;
        let mut size = (1.2 * sum / n as f64) as f32;
        size = size.max(extent.max_element() / MAX_CELLS_PER_AXIS);
        // extents relative to the size, so that their product does not overflow
        let along = |size: f32| (extent / size).floor() + 1.0;
        while size > 0.0 && along(size).element_product() > MAX_CELLS {
            size *= 1.3;
        }
        // a point, or a box too large or too small for numbers
        if !(size > 0.0 && (1.0 / size).is_finite() && extent.is_finite()) {
            return Cells { origin: bounds.min, per_unit: 0.0, dims: IVec3::ONE };
        }
        Cells { origin: bounds.min, per_unit: 1.0 / size, dims: along(size).as_ivec3() }
    }

    fn len(&self) -> usize {
        self.dims.x as usize * self.dims.y as usize * self.dims.z as usize
    }

    /// Returns the cell of a point in the box; the conversion truncates, which is rounding down for
    /// such points.
    fn cell(&self, p: Vec3) -> IVec3 {
        ((p - self.origin) * self.per_unit).as_ivec3().clamp(IVec3::ZERO, self.dims - 1)
    }

    fn number(&self, c: IVec3) -> usize {
        (c.z as usize * self.dims.y as usize + c.y as usize) * self.dims.x as usize + c.x as usize
    }

    /// Returns the cells of a box of cells, with their numbers.
    fn between(self, low: IVec3, high: IVec3) -> impl Iterator<Item = (IVec3, usize)> {
        let row = move |y, z| (low.x..=high.x).map(move |x| IVec3::new(x, y, z));
        let layer = move |z| (low.y..=high.y).flat_map(move |y| row(y, z));
        (low.z..=high.z).flat_map(layer).map(move |c| (c, self.number(c)))
    }
}

/// A triangle as the test of pairs wants it.
#[derive(Clone, Copy)]
struct Facet {
    ids: [u32; 3],
    p: [DVec3; 3],
    /// Twice the area vector.
    area: DVec3,
    bounds: Aabb,
}

impl Facet {
    fn new(ids: [u32; 3], corners: [Vec3; 3]) -> Facet {
        let p = corners.map(|c| c.as_dvec3());
        Facet { ids, p, area: (p[1] - p[0]).cross(p[2] - p[0]), bounds: Aabb::around(corners) }
    }

    /// Returns whether the two meet in more than common corners; triangles without area never do.
    fn meets(&self, other: &Facet) -> bool {
        let (a, b) = (&self.bounds, &other.bounds);
        if a.min.cmpgt(b.max).any() || b.min.cmpgt(a.max).any() {
            return false;
        }
        // All determinants below have three factors of at most this length: 1e-14 of its cube is
        // more than their rounding.
        let size = (a.max.max(b.max) - a.min.min(b.min)).length();
        let unsure = 1e-14 * f64::from(size).powi(3);
        if self.is_clear_of(other, unsure) || other.is_clear_of(self, unsure) {
            return false;
        }
        self.area != DVec3::ZERO
            && other.area != DVec3::ZERO
            && intersect(self.p, self.ids, other.p, other.ids)
    }

    /// Returns whether the other one lies strictly on one side, but for common corners.
    fn is_clear_of(&self, other: &Facet, unsure: f64) -> bool {
        let (mut above, mut below) = (false, false);
        for k in 0..3 {
            if self.ids.contains(&other.ids[k]) {
                continue;
            }
            let side = self.area.dot(other.p[k] - self.p[0]);
            above |= side >= -unsure;
            below |= side <= unsure;
        }
        // with all three corners in common neither is set: the same triangle twice
        above != below
    }
}

/// Returns the triangles that meet others in more than common corners, in order.
pub(super) fn crossings(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<u32> {
    let facets: Vec<Facet> =
        triangles.par_iter().map(|&t| Facet::new(t, t.map(|v| positions[v as usize]))).collect();
    let boxes = Boxes::new(facets.iter().map(|f| DBox::around(f.p)));
    let mut found: Vec<u32> = facets
        .par_iter()
        .enumerate()
        .flat_map_iter(|(t, facet)| {
            let mut met = Vec::new();
            boxes.meeting(&DBox::around(facet.p), &mut Effort::new(usize::MAX), |other, _| {
                if other as usize > t && facet.meets(&facets[other as usize]) {
                    met.extend([t as u32, other]);
                }
                true
            });
            met
        })
        .collect();
    found.sort_unstable();
    found.dedup();
    found
}

/// Takes back the moves of triangles that meet others now and did not at `start`. Returns the
/// number of vertices.
pub(crate) fn without_crossings(positions: &mut [Vec3], triangles: &[[u32; 3]], start: &[Vec3]) -> usize {
    const TRIES: usize = 8;
    let mut old = None;
    let mut back = 0;
    for _ in 0..TRIES {
        let found = crossings(positions, triangles);
        if found.is_empty() {
            return back;
        }
        let old = old.get_or_insert_with(|| crossings(start, triangles));
        let mut any = false;
        for t in found.iter().filter(|t| old.binary_search(t).is_err()) {
            for v in triangles[*t as usize].map(|v| v as usize) {
                any |= positions[v] != start[v];
                back += usize::from(positions[v] != start[v]);
                positions[v] = start[v];
            }
        }
        if !any {
            return back;
        }
    }
    back += positions.iter().zip(start).filter(|(p, from)| p != from).count();
    positions.copy_from_slice(start);
    back
}

/// An index of the triangles of a shrinking mesh, used to refuse collapses that cause crossings.
pub(super) struct CrossingIndex {
    cells: Cells,
    /// Per cell the last link of its chain.
    heads: Vec<u32>,
    /// Triangle and the link before. Triangles stay entered where they once were.
    links: Vec<(u32, u32)>,
    /// The last query that visited each triangle.
    seen: Vec<u32>,
    query: u32,
}

impl CrossingIndex {
    pub(super) fn new(rings: &Rings) -> CrossingIndex {
        let cells = Cells::fit(&rings.positions, &rings.triangles);
        let mut index = CrossingIndex {
            cells,
            heads: vec![NONE; cells.len()],
            links: Vec::new(),
            seen: vec![0; rings.triangles.len()],
            query: 0,
        };
        rings.alive().for_each(|t| index.enter(t, Aabb::around(rings.corners(t)), None));
        index
    }

    /// Enters a triangle with this box, which had that one.
    pub(super) fn enter(&mut self, t: u32, bounds: Aabb, before: Option<Aabb>) {
        let cells = self.cells;
        let old = before.map(|b| (cells.cell(b.min), cells.cell(b.max)));
        for (c, i) in cells.between(cells.cell(bounds.min), cells.cell(bounds.max)) {
            if old.is_none_or(|(low, high)| c.cmplt(low).any() || c.cmpgt(high).any()) {
                self.links.push((t, self.heads[i]));
                self.heads[i] = self.links.len() as u32 - 1;
            }
        }
    }

    /// Returns whether these triangles, in the place of `instead`, would meet others or one
    /// another.
    pub(super) fn would_cross(
        &mut self,
        rings: &Rings,
        instead: impl Iterator<Item = u32>,
        triangles: impl Iterator<Item = ([u32; 3], [Vec3; 3])>,
    ) -> bool {
        if self.query == u32::MAX {
            self.seen.fill(0);
            self.query = 0;
        }
        self.query += 1;
        instead.for_each(|t| self.seen[t as usize] = self.query);
        let facets: Vec<Facet> = triangles.map(|(ids, corners)| Facet::new(ids, corners)).collect();
        let one_another = facets.iter().enumerate().any(|(i, f)| facets[..i].iter().any(|g| f.meets(g)));
        if one_another {
            return true;
        }
        let Some(bounds) = facets.iter().map(|f| f.bounds).reduce(|a, b| a.with(b.min).with(b.max)) else {
            return false;
        };
        let (low, high) = (self.cells.cell(bounds.min), self.cells.cell(bounds.max));
        for (_, i) in self.cells.between(low, high) {
            let mut link = self.heads[i];
            while link != NONE {
                let (t, before) = self.links[link as usize];
                link = before;
                let ids = rings.triangles[t as usize];
                if self.seen[t as usize] == self.query || ids[0] == NONE {
                    continue;
                }
                self.seen[t as usize] = self.query;
                let other = Facet::new(ids, rings.corners(t));
                if facets.iter().any(|f| f.meets(&other)) {
                    return true;
                }
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::check;
    use tiface_base::geom::Mesh;

    #[test]
    fn a_soup_has_the_same_crossings_as_the_check_of_meshes() {
        // 300 triangles about 0.2 large in the unit cube, from a counter; some share corners.
        let mut state = 7u64;
        let mut next = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        let mut mesh = Mesh::default();
        for i in 0..300u32 {
            let middle = Vec3::new(next(), next(), next());
            for _ in 0..3 {
                mesh.positions.push(middle + 0.2 * Vec3::new(next(), next(), next()));
            }
            let first = if i % 3 == 1 { 3 * i - 1 } else { 3 * i };
            mesh.triangles.push([first, 3 * i + 1, 3 * i + 2]);
        }
        let found = crossings(&mesh.positions, &mesh.triangles);
        assert!(found.len() > 20, "{}", found.len());
        assert_eq!(found.len(), check(&mesh, 1.0).self_intersections);
    }

    #[test]
    fn doubled_triangles_cross_and_points_and_nothing_do_not() {
        let p = [Vec3::ZERO, Vec3::X, Vec3::Y];
        assert_eq!(crossings(&p, &[[0, 1, 2], [1, 2, 0]]), [0, 1]);
        assert!(crossings(&[Vec3::ONE; 3], &[[0, 1, 2]]).is_empty());
        assert!(crossings(&[], &[]).is_empty());
    }
}
