//! The mesh while it shrinks: which triangles are around each vertex.
//!
//! Flat arrays only. The rings of all vertices lie in one pool; a ring that outgrows its place moves
//! to the pool's end. A collapse of (a, b) gives b's triangles to a and drops the one or two that held
//! the edge; nothing else in the mesh changes its number.

use super::hold::{BORDER, HELD, kind};
use super::quadric::{PlaneQuadric, lean};
use crate::geom::{Mesh, area_vector};
use glam::Vec3;
use rayon::prelude::*;

/// Another sheet of the surface is near: collapses look for intersections.
pub(super) const CROWDED: u8 = 4;

/// What a dropped triangle's corners are.
pub(super) const NONE: u32 = u32::MAX;

/// A border edge resists leaving its line as much as a triangle of this many times its length squared.
const BORDER_WEIGHT: f32 = 3.0;

#[derive(Clone, Copy, Debug, Default)]
struct RingSlot {
    start: u32,
    len: u32,
    room: u32,
}

/// A mesh under collapse.
#[derive(Clone)]
pub(super) struct Rings {
    pub positions: Vec<Vec3>,
    /// Empty, or one a vertex.
    pub colors: Vec<[f32; 3]>,
    /// Dropped triangles are [`NONE`] thrice.
    pub triangles: Vec<[u32; 3]>,
    /// `√A n` of each triangle.
    pub leans: Vec<Vec3>,
    pub spreads: Vec<PlaneQuadric>,
    pub flags: Vec<u8>,
    /// Grows whenever a vertex is what a collapse left or took away.
    pub stamps: Vec<u32>,
    /// Triangles that are left.
    pub count: usize,
    places: Vec<RingSlot>,
    pool: Vec<u32>,
}

impl Rings {
    /// Around the triangles of `mesh`, whose indices must be in range and positions finite. Triangles
    /// with a repeated vertex are left out.
    pub(super) fn new(mesh: &Mesh) -> Rings {
        let n = mesh.positions.len();
        let triangles: Vec<[u32; 3]> =
            mesh.triangles.iter().copied().filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0]).collect();
        let colors = if mesh.colors.len() == n { mesh.colors.clone() } else { Vec::new() };
        let mut rings = Rings {
            positions: mesh.positions.clone(),
            colors,
            leans: vec![Vec3::ZERO; triangles.len()],
            spreads: vec![PlaneQuadric::default(); n],
            flags: vec![0; n],
            stamps: vec![0; n],
            count: triangles.len(),
            places: vec![RingSlot::default(); n],
            pool: vec![0; 3 * triangles.len()],
            triangles,
        };
        for &v in rings.triangles.as_flattened() {
            rings.places[v as usize].room += 1;
        }
        let mut start = 0;
        for place in &mut rings.places {
            place.start = start;
            start += place.room;
        }
        for (t, triangle) in rings.triangles.iter().enumerate() {
            for &v in triangle {
                let place = &mut rings.places[v as usize];
                rings.pool[(place.start + place.len) as usize] = t as u32;
                place.len += 1;
            }
        }
        rings.flags = (0..n as u32)
            .into_par_iter()
            .map_init(Vec::new, |sides, v| {
                sides.clear();
                sides.extend(rings.ring(v).iter().map(|&t| rings.opposite(t, v)));
                kind(sides)
            })
            .collect();
        rings.measure();
        rings
    }

    /// The triangles around a vertex.
    pub(super) fn ring(&self, v: u32) -> &[u32] {
        let place = self.places[v as usize];
        &self.pool[place.start as usize..(place.start + place.len) as usize]
    }

    /// How many triangles are around a vertex; none when it is gone.
    pub(super) fn valence(&self, v: u32) -> usize {
        self.places[v as usize].len as usize
    }

    /// Changes with either end: stamps only grow, so their sum stays the same only if both do.
    pub(super) fn stamp(&self, a: u32, b: u32) -> u32 {
        self.stamps[a as usize].wrapping_add(self.stamps[b as usize])
    }

    /// The three corners of a triangle.
    pub(super) fn corners(&self, t: u32) -> [Vec3; 3] {
        self.triangles[t as usize].map(|v| self.positions[v as usize])
    }

    /// The triangles that are left.
    pub(super) fn alive(&self) -> impl Iterator<Item = u32> {
        (0..self.triangles.len() as u32).filter(|&t| self.triangles[t as usize][0] != NONE)
    }

    /// Returns which corner of a triangle a vertex is; 2 if neither of the first two.
    pub(super) fn corner_of(&self, t: u32, v: u32) -> usize {
        self.triangles[t as usize][..2].iter().position(|&w| w == v).unwrap_or(2)
    }

    /// The other two corners of a triangle, in order.
    pub(super) fn opposite(&self, t: u32, v: u32) -> (u32, u32) {
        let (triangle, k) = (self.triangles[t as usize], self.corner_of(t, v));
        (triangle[(k + 1) % 3], triangle[(k + 2) % 3])
    }

    /// Leans and spreads of everything, from the positions as they are now.
    fn measure(&mut self) {
        self.spreads.fill(PlaneQuadric::default());
        for t in 0..self.triangles.len() {
            let triangle = self.triangles[t];
            if triangle[0] == NONE {
                continue;
            }
            let s = lean(area_vector(self.corners(t as u32)));
            self.leans[t] = s;
            for v in triangle {
                self.spreads[v as usize].add(s);
            }
        }
        for v in 0..self.positions.len() as u32 {
            if self.flags[v as usize] & BORDER != 0 {
                self.measure_at(v);
            }
        }
    }

    /// The spread of one vertex, with the planes through its border edges, upright on their triangles.
    pub(super) fn measure_at(&mut self, v: u32) {
        let mut spread = PlaneQuadric::default();
        let at = self.positions[v as usize];
        for &t in self.ring(v) {
            let s = self.leans[t as usize];
            spread.add(s);
            if self.flags[v as usize] & BORDER == 0 {
                continue;
            }
            let (p, q) = self.opposite(t, v);
            for w in [p, q] {
                if self.flags[w as usize] & BORDER != 0 && self.shared(v, w) == 1 {
                    let edge = self.positions[w as usize] - at;
                    spread.add(BORDER_WEIGHT.sqrt() * s.normalize_or_zero().cross(edge));
                }
            }
        }
        self.spreads[v as usize] = spread;
    }

    /// How many triangles hold both vertices.
    fn shared(&self, v: u32, w: u32) -> usize {
        self.ring(v).iter().filter(|&&t| self.triangles[t as usize].contains(&w)).count()
    }

    /// Gives the vertex this ring, in place when there is room.
    pub(super) fn set_ring(&mut self, v: u32, ring: &[u32]) {
        let place = &mut self.places[v as usize];
        place.len = ring.len() as u32;
        if place.len > place.room {
            place.start = self.pool.len() as u32;
            place.room = place.len;
            self.pool.extend_from_slice(ring);
        } else {
            self.pool[place.start as usize..][..ring.len()].copy_from_slice(ring);
        }
    }

    /// Takes one triangle out of a vertex's ring.
    pub(super) fn leave(&mut self, v: u32, t: u32) {
        let place = &mut self.places[v as usize];
        let ring = &mut self.pool[place.start as usize..(place.start + place.len) as usize];
        if let Some(i) = ring.iter().position(|&other| other == t) {
            ring[i] = ring[ring.len() - 1];
            place.len -= 1;
        }
    }

    /// Drops gone vertices and triangles from the arrays; the order of the rest stays. And which vertices
    /// must not move: those of borders, and where the mesh is no surface.
    pub(super) fn into_mesh(self) -> (Mesh, Vec<bool>) {
        let mut fixed = Vec::new();
        let mut number = vec![NONE; self.positions.len()];
        let mut mesh = Mesh::default();
        for v in 0..self.positions.len() {
            if self.places[v].len > 0 {
                number[v] = mesh.positions.len() as u32;
                mesh.positions.push(self.positions[v]);
                fixed.push(self.flags[v] & (BORDER | HELD) != 0);
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
