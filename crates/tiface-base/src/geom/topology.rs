//! Topology of a triangle mesh: closed, manifold, number of pieces, genus.
//!
//! `V − E + F = Σ over closed pieces (2 − 2 · genus)`. Works on indices alone, except for areas.

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// The findings of [`topology`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Topology {
    /// Vertices that a triangle uses.
    pub vertices: usize,
    /// Undirected edges.
    pub edges: usize,
    /// Triangles.
    pub triangles: usize,
    /// Every edge has exactly two triangles, oppositely wound; false for no triangles.
    pub closed: bool,
    /// Every edge has at most two triangles and every vertex one fan.
    pub manifold: bool,
    /// Edges with one triangle.
    pub boundary_edges: usize,
    /// Edges with more than two triangles.
    pub non_manifold_edges: usize,
    /// Edges whose two triangles run the same way.
    pub misoriented_edges: usize,
    /// Vertices whose triangles form more than one fan.
    pub non_manifold_vertices: usize,
    /// Triangles with a repeated index or no area.
    pub degenerate_triangles: usize,
    /// Triangles over the same three vertices as another.
    pub duplicate_triangles: usize,
    /// Vertices no triangle uses.
    pub unused_vertices: usize,
    /// Vertices with a coordinate that is not finite.
    pub non_finite_vertices: usize,
    /// Pieces connected through common vertices.
    pub pieces: usize,
    /// `V − E + F` over used vertices.
    pub euler: i64,
    /// Handles of all pieces together; known only when closed and manifold.
    pub genus: Option<i64>,
}

impl Topology {
    /// Returns whether the mesh is closed, manifold, finite, and without degenerate or doubled
    /// triangles: fit to be printed or simulated.
    pub fn is_solid(&self) -> bool {
        self.closed
            && self.manifold
            && self.degenerate_triangles == 0
            && self.duplicate_triangles == 0
            && self.non_finite_vertices == 0
    }
}

/// Disjoint sets over 0..n.
pub struct Sets(Vec<u32>);

impl Sets {
    /// Returns `n` sets of one element each.
    pub fn new(n: usize) -> Sets {
        Sets((0..n as u32).collect())
    }

    /// Vertices in sets of those that triangles connect.
    pub fn of_pieces(vertices: usize, triangles: &[[u32; 3]]) -> Sets {
        let mut sets = Sets::new(vertices);
        for t in triangles {
            sets.join(t[0], t[1]);
            sets.join(t[0], t[2]);
        }
        sets
    }

    /// Returns the smallest member of `i`'s set.
    #[inline]
    pub fn find(&mut self, mut i: u32) -> u32 {
        while self.0[i as usize] != i {
            let up = self.0[self.0[i as usize] as usize];
            self.0[i as usize] = up;
            i = up;
        }
        i
    }

    #[inline]
    /// Joins the sets of two elements.
    pub fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

/// Returns the directed sides of all triangles, sorted by undirected edge:
/// `(low << 32 | high, corner)`, where corner `3 t + k` starts the side from vertex k to k + 1 of
/// triangle t.
pub fn sorted_sides(triangles: &[[u32; 3]]) -> Vec<(u64, u32)> {
    let mut sides: Vec<(u64, u32)> = triangles
        .par_iter()
        .enumerate()
        .flat_map_iter(|(t, tri)| {
            (0..3).map(move |k| {
                let (a, b) = (tri[k], tri[(k + 1) % 3]);
                (u64::from(a.min(b)) << 32 | u64::from(a.max(b)), (3 * t + k) as u32)
            })
        })
        .collect();
    sides.par_sort_unstable();
    sides
}

/// Returns the vertices at which the side of a corner starts and ends.
#[inline]
pub fn side_ends(triangles: &[[u32; 3]], corner: u32) -> (u32, u32) {
    let (t, k) = (triangles[corner as usize / 3], corner as usize % 3);
    (t[k], t[(k + 1) % 3])
}

/// For every corner, the set of corners reached from it around its vertex across edges with exactly
/// two triangles. A vertex with one set has one fan.
pub fn fans(triangles: &[[u32; 3]], sides: &[(u64, u32)]) -> Sets {
    let mut fans = Sets::new(3 * triangles.len());
    let vertex = |c: u32| side_ends(triangles, c).0;
    let after = |c: u32| c / 3 * 3 + (c % 3 + 1) % 3;
    for run in sides.chunk_by(|a, b| a.0 == b.0) {
        if let [(_, a), (_, b)] = *run {
            for p in [a, after(a)] {
                for q in [b, after(b)] {
                    if vertex(p) == vertex(q) {
                        fans.join(p, q);
                    }
                }
            }
        }
    }
    fans
}

/// Analyzes a mesh. Indices must lie below `positions.len()`.
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::topology;
///
/// let corners = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
/// let tetrahedron = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
/// let found = topology(&corners, &tetrahedron);
/// assert_eq!((found.closed, found.euler, found.genus), (true, 2, Some(0)));
/// assert_eq!(topology(&corners, &tetrahedron[1..]).boundary_edges, 3);
/// ```
pub fn topology(positions: &[Vec3], triangles: &[[u32; 3]]) -> Topology {
    let mut out = Topology {
        triangles: triangles.len(),
        non_finite_vertices: positions.iter().filter(|p| !p.is_finite()).count(),
        ..Topology::default()
    };
    let mut used = vec![false; positions.len()];
    triangles.iter().flatten().for_each(|&v| used[v as usize] = true);
    out.vertices = used.iter().filter(|&&u| u).count();
    out.unused_vertices = positions.len() - out.vertices;

    out.degenerate_triangles = triangles.par_iter().filter(|t| has_no_area(positions, t)).count();
    let mut keys: Vec<[u32; 3]> = triangles
        .par_iter()
        .map(|&(mut t)| {
            t.sort_unstable();
            t
        })
        .collect();
    keys.par_sort_unstable();
    out.duplicate_triangles = keys.windows(2).filter(|w| w[0] == w[1]).count();
    drop(keys);

    let sides = sorted_sides(triangles);
    for run in sides.chunk_by(|a, b| a.0 == b.0) {
        out.edges += 1;
        let forward = |c: u32| side_ends(triangles, c).0 == (run[0].0 >> 32) as u32;
        match run {
            [_] => out.boundary_edges += 1,
            [a, b] => out.misoriented_edges += usize::from(forward(a.1) == forward(b.1)),
            _ => out.non_manifold_edges += 1,
        }
    }

    let mut fans = fans(triangles, &sides);
    let mut fans_of = vec![0u32; positions.len()];
    for (t, tri) in triangles.iter().enumerate() {
        for k in 0..3 {
            let corner = (3 * t + k) as u32;
            fans_of[tri[k] as usize] += u32::from(fans.find(corner) == corner);
        }
    }
    out.non_manifold_vertices = fans_of.iter().filter(|&&n| n > 1).count();

    let mut pieces = Sets::of_pieces(positions.len(), triangles);
    out.pieces = (0..positions.len()).filter(|&v| used[v] && pieces.find(v as u32) == v as u32).count();

    out.euler = out.vertices as i64 - out.edges as i64 + out.triangles as i64;
    out.closed =
        !triangles.is_empty() && out.boundary_edges + out.non_manifold_edges + out.misoriented_edges == 0;
    out.manifold = out.non_manifold_edges + out.non_manifold_vertices == 0;
    out.genus = (out.closed && out.manifold).then_some(out.pieces as i64 - out.euler / 2);
    out
}

/// Returns whether an index repeats or the corners are collinear (in f64 from the f32 positions).
fn has_no_area(positions: &[Vec3], t: &[u32; 3]) -> bool {
    if t[0] == t[1] || t[1] == t[2] || t[2] == t[0] {
        return true;
    }
    let [a, b, c] = t.map(|i| positions[i as usize].as_dvec3());
    let twice = (b - a).cross(c - a).length();
    twice.is_nan() || twice == 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const TETRAHEDRON: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

    fn corners() -> Vec<Vec3> {
        vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z]
    }

    #[test]
    fn a_tetrahedron_is_a_sphere() {
        // V − E + F = 4 − 6 + 4 = 2
        let t = topology(&corners(), &TETRAHEDRON);
        assert!(t.is_solid());
        assert_eq!((t.vertices, t.edges, t.euler, t.pieces, t.genus), (4, 6, 2, 1, Some(0)));
    }

    #[test]
    fn a_torus_has_one_handle() {
        // A 4 × 4 grid of quads glued both ways: V = 16, F = 32, E = 48.
        let at = |i: u32, j: u32| (i % 4) * 4 + j % 4;
        let turn = |i: u32| std::f32::consts::FRAC_PI_2 * i as f32;
        let mut positions = Vec::new();
        let mut triangles = Vec::new();
        for i in 0..4 {
            for j in 0..4 {
                let r = 2.0 + turn(j).cos();
                positions.push(Vec3::new(r * turn(i).cos(), r * turn(i).sin(), turn(j).sin()));
                triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        let t = topology(&positions, &triangles);
        assert!(t.is_solid(), "{t:?}");
        assert_eq!((t.euler, t.genus), (0, Some(1)));
    }

    #[test]
    fn two_tetrahedra_at_one_vertex_are_closed_but_not_manifold() {
        let mut p = corners();
        p.extend([-Vec3::X, -Vec3::Y, -Vec3::Z]);
        let mut t = TETRAHEDRON.to_vec();
        t.extend(TETRAHEDRON.map(|t| [t[0], t[2], t[1]].map(|v| if v == 0 { 0 } else { v + 3 })));
        let t = topology(&p, &t);
        assert!(t.closed && !t.manifold);
        assert_eq!((t.non_manifold_vertices, t.non_manifold_edges, t.pieces), (1, 0, 1));
    }

    #[test]
    fn two_tetrahedra_at_one_edge_have_an_edge_of_four() {
        let mut p = corners();
        p.extend([-Vec3::X, -Vec3::Y]);
        let mut t = TETRAHEDRON.to_vec();
        // the second one over 0, 3 (shared) and 4, 5: turned about z by half a turn
        t.extend(TETRAHEDRON.map(|t| t.map(|v| [0, 4, 5, 3][v as usize])));
        let t = topology(&p, &t);
        assert!(!t.closed && !t.manifold);
        assert_eq!(t.non_manifold_edges, 1);
    }

    #[test]
    fn holes_turned_faces_slivers_and_strays_are_counted() {
        let mut p = corners();
        p.push(Vec3::NAN);
        let t = topology(&p, &TETRAHEDRON[..3]);
        assert!(!t.closed && t.manifold && t.genus.is_none());
        assert_eq!((t.boundary_edges, t.unused_vertices, t.non_finite_vertices), (3, 1, 1));

        let mut turned = TETRAHEDRON;
        turned[0].swap(0, 1);
        assert_eq!(topology(&corners(), &turned).misoriented_edges, 3);

        let flat = topology(&[Vec3::ZERO, Vec3::X, 2.0 * Vec3::X], &[[0, 1, 2], [0, 0, 1], [2, 1, 0]]);
        assert_eq!((flat.degenerate_triangles, flat.duplicate_triangles), (3, 1));
        assert!(!topology(&[], &[]).closed);
    }
}
