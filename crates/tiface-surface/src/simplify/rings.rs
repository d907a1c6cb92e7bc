//! The mesh while it shrinks: which triangles are around each vertex.
//!
//! Flat arrays only. The rings of all vertices lie in one pool; a ring that outgrows its slot moves
//! to the pool's end. A collapse of (a, b) gives b's triangles to a and drops the one or two that
//! held the edge; nothing else in the mesh changes its number.
//!
//! On an edge with more than two triangles, or with two that run the same way, and at a vertex
//! whose triangles form more than one fan, the link condition does not apply. Such vertices stay as
//! they are, so that a mesh with a flaw keeps the flaw and gets no others.

use super::quadric::{PlaneQuadric, scaled_normal};
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{Mesh, area_vector};

/// Stands for the corners of a dropped triangle.
pub(super) const NONE: u32 = u32::MAX;

/// A border edge resists leaving its line as much as a triangle of this many times its length
/// squared.
const BORDER_WEIGHT: f32 = 3.0;

#[derive(Clone, Copy, Debug, Default)]
struct RingSlot {
    start: u32,
    len: u32,
    capacity: u32,
}

/// A mesh under collapse.
#[derive(Clone)]
pub(super) struct Rings {
    pub positions: Vec<Vec3>,
    /// Empty, or one a vertex.
    pub colors: Vec<[f32; 3]>,
    /// Empty, or a factor of the cost of changes for each vertex.
    pub importance: Vec<f32>,
    /// Dropped triangles are [`NONE`] thrice.
    pub triangles: Vec<[u32; 3]>,
    /// `√A n` of each triangle.
    pub scaled_normals: Vec<Vec3>,
    pub quadrics: Vec<PlaneQuadric>,
    pub flags: Vec<u8>,
    /// Incremented whenever a collapse changes or removes a vertex.
    pub stamps: Vec<u32>,
    /// Triangles that are left.
    pub count: usize,
    slots: Vec<RingSlot>,
    pool: Vec<u32>,
}

impl Rings {
    /// Builds the rings of `mesh`, whose indices must be in range and positions finite. Triangles
    /// with a repeated vertex are left out.
    pub(super) fn new(mesh: &Mesh) -> Rings {
        let n = mesh.positions.len();
        let triangles: Vec<[u32; 3]> =
            mesh.triangles.iter().copied().filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0]).collect();
        let colors = if mesh.colors.len() == n { mesh.colors.clone() } else { Vec::new() };
        let mut rings = Rings {
            positions: mesh.positions.clone(),
            colors,
            importance: Vec::new(),
            scaled_normals: vec![Vec3::ZERO; triangles.len()],
            quadrics: vec![PlaneQuadric::default(); n],
            flags: vec![0; n],
            stamps: vec![0; n],
            count: triangles.len(),
            slots: vec![RingSlot::default(); n],
            pool: vec![0; 3 * triangles.len()],
            triangles,
        };
        for &v in rings.triangles.as_flattened() {
            rings.slots[v as usize].capacity += 1;
        }
        let mut start = 0;
        for slot in &mut rings.slots {
            slot.start = start;
            start += slot.capacity;
        }
        for (t, triangle) in rings.triangles.iter().enumerate() {
            for &v in triangle {
                let slot = &mut rings.slots[v as usize];
                rings.pool[(slot.start + slot.len) as usize] = t as u32;
                slot.len += 1;
            }
        }
        rings.flags = (0..n as u32)
            .into_par_iter()
            .map_init(Vec::new, |sides, v| {
                sides.clear();
                sides.extend(rings.ring(v).iter().map(|&t| rings.opposite(t, v)));
                vertex_flags(sides)
            })
            .collect();
        rings.measure();
        rings
    }

    /// Returns the triangles around a vertex.
    pub(super) fn ring(&self, v: u32) -> &[u32] {
        let slot = self.slots[v as usize];
        &self.pool[slot.start as usize..(slot.start + slot.len) as usize]
    }

    /// Returns the number of triangles around a vertex; 0 if it was removed.
    pub(super) fn valence(&self, v: u32) -> usize {
        self.slots[v as usize].len as usize
    }

    /// Changes with either end: stamps only grow, so their sum stays the same only if both do.
    pub(super) fn stamp(&self, a: u32, b: u32) -> u32 {
        self.stamps[a as usize].wrapping_add(self.stamps[b as usize])
    }

    /// Returns the three corners of a triangle.
    pub(super) fn corners(&self, t: u32) -> [Vec3; 3] {
        self.triangles[t as usize].map(|v| self.positions[v as usize])
    }

    /// Returns the importance of the vertex that an edge collapses to: the geometric mean of its
    /// ends'.
    pub(super) fn mean_importance(&self, a: u32, b: u32) -> f32 {
        (self.importance[a as usize] * self.importance[b as usize]).sqrt()
    }

    /// Returns the triangles that are left.
    pub(super) fn alive(&self) -> impl Iterator<Item = u32> {
        (0..self.triangles.len() as u32).filter(|&t| self.triangles[t as usize][0] != NONE)
    }

    /// Returns which corner of a triangle a vertex is; 2 if neither of the first two.
    pub(super) fn corner_of(&self, t: u32, v: u32) -> usize {
        self.triangles[t as usize][..2].iter().position(|&w| w == v).unwrap_or(2)
    }

    /// Returns the other two corners of a triangle, in order.
    pub(super) fn opposite(&self, t: u32, v: u32) -> (u32, u32) {
        let (triangle, k) = (self.triangles[t as usize], self.corner_of(t, v));
        (triangle[(k + 1) % 3], triangle[(k + 2) % 3])
    }

    /// Leans and quadrics of everything, from the positions as they are now.
    fn measure(&mut self) {
        self.quadrics.fill(PlaneQuadric::default());
        for t in 0..self.triangles.len() {
            let triangle = self.triangles[t];
            if triangle[0] == NONE {
                continue;
            }
            let s = scaled_normal(area_vector(self.corners(t as u32)));
            self.scaled_normals[t] = s;
            for v in triangle {
                self.quadrics[v as usize].add(s);
            }
        }
        for v in 0..self.positions.len() as u32 {
            if self.flags[v as usize] & BORDER != 0 {
                self.measure_at(v);
            }
        }
    }

    /// Computes the quadric of a vertex, with the planes through its border edges, perpendicular to
    /// their triangles.
    pub(super) fn measure_at(&mut self, v: u32) {
        let mut quadric = PlaneQuadric::default();
        let at = self.positions[v as usize];
        for &t in self.ring(v) {
            let s = self.scaled_normals[t as usize];
            quadric.add(s);
            if self.flags[v as usize] & BORDER == 0 {
                continue;
            }
            let (p, q) = self.opposite(t, v);
            for w in [p, q] {
                if self.flags[w as usize] & BORDER != 0 && self.shared(v, w) == 1 {
                    let edge = self.positions[w as usize] - at;
                    quadric.add(BORDER_WEIGHT.sqrt() * s.normalize_or_zero().cross(edge));
                }
            }
        }
        self.quadrics[v as usize] = quadric;
    }

    /// Returns how many triangles share both vertices.
    fn shared(&self, v: u32, w: u32) -> usize {
        self.ring(v).iter().filter(|&&t| self.triangles[t as usize].contains(&w)).count()
    }

    /// Sets the ring of a vertex, in place if its slot has the capacity.
    pub(super) fn set_ring(&mut self, v: u32, ring: &[u32]) {
        let slot = &mut self.slots[v as usize];
        slot.len = ring.len() as u32;
        if slot.len > slot.capacity {
            slot.start = self.pool.len() as u32;
            slot.capacity = slot.len;
            self.pool.extend_from_slice(ring);
        } else {
            self.pool[slot.start as usize..][..ring.len()].copy_from_slice(ring);
        }
    }

    /// Takes one triangle out of a vertex's ring.
    pub(super) fn leave(&mut self, v: u32, t: u32) {
        let slot = &mut self.slots[v as usize];
        let ring = &mut self.pool[slot.start as usize..(slot.start + slot.len) as usize];
        if let Some(i) = ring.iter().position(|&other| other == t) {
            ring[i] = ring[ring.len() - 1];
            slot.len -= 1;
        }
    }

    /// Compacts the arrays, keeping the order of the remaining vertices and triangles. Also returns
    /// which vertices must not move: those of borders, and where the mesh is not a manifold.
    pub(super) fn into_mesh(self) -> (Mesh, Vec<bool>) {
        let mut fixed = Vec::new();
        let mut number = vec![NONE; self.positions.len()];
        let mut mesh = Mesh::default();
        for v in 0..self.positions.len() {
            if self.slots[v].len > 0 {
                number[v] = mesh.positions.len() as u32;
                mesh.positions.push(self.positions[v]);
                fixed.push(self.flags[v] & (BORDER | FIXED) != 0);
                if let Some(&color) = self.colors.get(v) {
                    mesh.colors.push(color);
                }
            }
        }
        let alive = self.triangles.iter().filter(|t| t[0] != NONE);
        mesh.triangles = alive.map(|t| t.map(|v| number[v as usize])).collect();
        (mesh, fixed)
    }
}

/// Flag of a vertex at an edge with one triangle.
pub(super) const BORDER: u8 = 1;
/// Takes part in no collapse and does not move.
pub(super) const FIXED: u8 = 2;

/// Returns the flags of a vertex, [`BORDER`] or [`FIXED`] or neither, by the sides opposite to it,
/// each from one neighbor to the next: one closed walk through all of them is the inside of a
/// surface, one open walk its border.
pub(super) fn vertex_flags(sides: &mut [(u32, u32)]) -> u8 {
    sides.sort_unstable();
    let after = |w: u32| sides.binary_search_by_key(&w, |side| side.0).ok();
    if sides.is_empty() {
        return 0;
    }
    if sides.windows(2).any(|pair| pair[0].0 == pair[1].0) {
        return FIXED;
    }
    // A walk from anywhere either comes back, or ends at a border.
    let walk = |start: usize| {
        let (mut at, mut steps) = (start, 1);
        loop {
            match after(sides[at].1) {
                None => return (steps, true),
                Some(next) if next == start => return (steps, false),
                Some(_) if steps == sides.len() => return (usize::MAX, false),
                Some(next) => (at, steps) = (next, steps + 1),
            }
        }
    };
    match walk(0) {
        (steps, false) if steps == sides.len() => return 0,
        (_, false) => return FIXED,
        (_, true) => {}
    }
    // The border begins at the one side whose first neighbor ends none.
    let mut ends: Vec<u32> = sides.iter().map(|side| side.1).collect();
    ends.sort_unstable();
    let begin = (0..sides.len()).find(|&i| ends.binary_search(&sides[i].0).is_err());
    match begin.map(walk) {
        Some((steps, true)) if steps == sides.len() => BORDER,
        _ => FIXED,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_walk_is_inside_an_open_one_a_border_and_two_are_held() {
        assert_eq!(vertex_flags(&mut [(1, 2), (3, 1), (2, 3)]), 0);
        assert_eq!(vertex_flags(&mut [(3, 4), (1, 2), (2, 3)]), BORDER);
        assert_eq!(vertex_flags(&mut [(1, 2)]), BORDER);
        assert_eq!(vertex_flags(&mut [(1, 2), (2, 3), (3, 1), (4, 5), (5, 6), (6, 4)]), FIXED);
        assert_eq!(vertex_flags(&mut [(1, 2), (3, 4)]), FIXED);
        assert_eq!(vertex_flags(&mut []), 0);
    }

    #[test]
    fn a_third_triangle_on_an_edge_holds_it_whichever_way_it_runs() {
        assert_eq!(vertex_flags(&mut [(1, 2), (2, 3), (3, 1), (1, 4)]), FIXED);
        assert_eq!(vertex_flags(&mut [(1, 2), (2, 3), (3, 1), (4, 1)]), FIXED);
        // into a loop that does not hold the start
        assert_eq!(vertex_flags(&mut [(0, 1), (1, 2), (2, 1)]), FIXED);
    }

    #[test]
    fn many_sides_are_told_apart_the_same_way() {
        let mut sides: Vec<(u32, u32)> = (0..40).map(|i| ((i * 7) % 40, (i * 7 + 1) % 40)).collect();
        assert_eq!(vertex_flags(&mut sides), 0);
        sides.pop();
        assert_eq!(vertex_flags(&mut sides), BORDER);
        sides.push((7, 99));
        assert_eq!(vertex_flags(&mut sides), FIXED);
    }
}
