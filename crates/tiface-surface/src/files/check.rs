//! Validation of a mesh. Counts are on vertices welded by equal position, so texture seams do not
//! matter.
//!
//! - closed: every edge in exactly two triangles, oppositely wound;
//! - watertight: closed, and every piece wound outward, except cavities: pieces wound inward that
//!   lie inside another;
//! - manifold: no edge in more than two triangles, no vertex with more than one fan;
//! - Euler number `V − E + F`; genus = pieces − Euler/2 for a closed manifold;
//! - self-intersection: an edge that runs from one side of another triangle to the other, through
//!   it or its border, or two triangles of one plane that share area. Sharing a corner or an edge
//!   is not one, nor is resting on another triangle. Signs come from the determinant in f64 with
//!   Shewchuk's error bound (1997); what the bound cannot tell from zero counts as touching.
//! - sliver: quality `4 √3 · area / Σ edge²` below 0.05 (1 for an equilateral triangle).

use super::check_report::{CheckReport, PieceReport};
use super::weld::weld_map;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{
    Aabb, Boxes, DBox, DEFAULT_EFFORT, Mesh, WrongPiece, intersect, share_out, topology, wrong_pieces,
};

/// Triangles worse than this are slivers; an equilateral one has 1.
const SLIVER: f64 = 0.05;

/// Maximum deviation of a normal's length from 1; the Khronos validator's own bound.
const NORMAL_TOLERANCE: f32 = 5e-4;

/// Examines a mesh whose coordinates are `unit_m` meters each. Never panics, for any mesh.
///
/// # Examples
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::Mesh;
/// use tiface_surface::files::check;
///
/// let mut tetrahedron = Mesh {
///     positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
///     triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
///     ..Mesh::default()
/// };
/// let report = check(&tetrahedron, 1.0);
/// assert!(report.closed && report.genus == Some(0));
/// assert!(report.require(&["watertight", "one-piece", "no-self-intersections"]).is_ok());
///
/// tetrahedron.triangles.pop();
/// let report = check(&tetrahedron, 1.0);
/// assert_eq!((report.closed, report.boundary_edges, report.genus), (false, 3, None));
/// ```
pub fn check(mesh: &Mesh, unit_m: f64) -> CheckReport {
    check_around(mesh, DVec3::ZERO, unit_m)
}

/// [`check`] of a mesh whose positions are relative to `origin`.
pub fn check_around(mesh: &Mesh, origin: DVec3, unit_m: f64) -> CheckReport {
    let (weld, welded) = weld_map(mesh);
    let valid =
        |t: &[u32; 3]| t.iter().all(|&i| mesh.positions.get(i as usize).is_some_and(|p| p.is_finite()));
    // triangles that remain triangles after welding: their welded corners and their indices
    let (mut faces, mut sources) = (Vec::new(), Vec::new());
    let (mut invalid, mut degenerate, mut slivers, mut volume) = (0, 0, 0, 0.0);
    let mut bounds = Aabb::EMPTY;
    for (i, t) in mesh.triangles.iter().enumerate() {
        if !valid(t) {
            invalid += 1;
            continue;
        }
        let corners = mesh.corners(i as u32);
        bounds = corners.into_iter().fold(bounds, Aabb::with);
        let [a, b, c] = corners.map(|p| p.as_dvec3());
        volume += a.dot(b.cross(c)) / 6.0;
        let area = 0.5 * (b - a).cross(c - a).length();
        let edges = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
        let quality = 4.0 * 3f64.sqrt() * area / edges;
        if quality <= 1e-9 || quality.is_nan() {
            degenerate += 1;
        } else if quality < SLIVER {
            slivers += 1;
        }
        let w = t.map(|i| weld[i as usize]);
        if w[0] != w[1] && w[1] != w[2] && w[2] != w[0] {
            faces.push(w);
            sources.push(i as u32);
        }
    }
    let topology = topology(&welded, &faces);
    let closed = topology.closed && invalid == 0;
    let bad_normal = |n: &&glam::Vec3| (n.length() - 1.0).abs() > NORMAL_TOLERANCE || n.is_nan();
    let [low, high] = [bounds.min, bounds.max].map(|p| if bounds.is_empty() { Vec3::ZERO } else { p });
    let [low, high] = [low, high].map(|p| p.as_dvec3() + origin);
    let count = mesh.positions.len();
    let liters = unit_m.powi(3) * 1000.0;
    let wrong_pieces = if closed { wrong_pieces(&welded, &faces) } else { Vec::new() };
    let reported = |piece: WrongPiece| PieceReport {
        triangles: piece.triangles,
        center: (piece.center + origin).to_array(),
        volume_l: piece.volume * liters,
    };
    let (self_intersections, self_intersections_left) = self_intersections(mesh, &faces, &sources);
    CheckReport {
        vertices: count,
        triangles: mesh.triangles.len(),
        welded_vertices: welded.len(),
        invalid,
        closed,
        boundary_edges: topology.boundary_edges,
        flipped_edges: topology.misoriented_edges,
        nonmanifold_edges: topology.non_manifold_edges,
        nonmanifold_vertices: topology.non_manifold_vertices,
        manifold: topology.manifold,
        pieces: topology.pieces,
        euler: topology.euler,
        genus: topology.genus.filter(|_| closed),
        self_intersections,
        self_intersections_left,
        slivers,
        degenerate,
        min: low.to_array(),
        max: high.to_array(),
        size_m: ((high - low) * unit_m).to_array(),
        volume_l: closed.then_some(volume * liters),
        wrong_pieces: wrong_pieces.into_iter().map(reported).collect(),
        has_colors: count > 0 && mesh.colors.len() == count,
        has_texture: None,
        has_normals: count > 0 && mesh.normals.len() == count,
        bad_normals: mesh.normals.iter().filter(bad_normal).count(),
        uv: None,
    }
}

/// Cost of comparing two triangles, in comparisons of boxes.
const TRIANGLE_TEST_COST: usize = 16;

/// Returns how many triangles pass through or lie on another one, and how many others were not
/// compared with all candidates.
fn self_intersections(mesh: &Mesh, faces: &[[u32; 3]], sources: &[u32]) -> (usize, usize) {
    // Triangles over the same corners lie on each other, so one of them stands for all: a shape
    // that is repeated in one place costs no more than a single one.
    let mut sorted: Vec<([u32; 3], u32)> = (0..faces.len() as u32)
        .into_par_iter()
        .filter_map(|f| {
            let mut ids = faces[f as usize];
            let [a, b, c] = mesh.corners(sources[f as usize]).map(|p| p.as_dvec3());
            ids.sort_unstable();
            ((b - a).cross(c - a) != DVec3::ZERO).then_some((ids, f))
        })
        .collect();
    sorted.par_sort_unstable();
    let mut found = 0;
    let (mut facets, mut alone) = (Vec::new(), Vec::new());
    for copies in sorted.chunk_by(|a, b| a.0 == b.0) {
        let face = copies[0].1 as usize;
        if copies.len() > 1 {
            found += copies.len();
        } else {
            alone.push(facets.len());
        }
        facets.push((mesh.corners(sources[face]).map(|p| p.as_dvec3()), faces[face]));
    }
    let boxes = Boxes::new(facets.iter().map(|f| DBox::around(f.0)));
    let shared = share_out(alone.len(), DEFAULT_EFFORT, |i, effort| {
        let (own, mut meets) = (alone[i], false);
        let (p, ids) = facets[own];
        boxes.meeting(&DBox::around(p), effort, |other, effort| {
            let (q, other_ids) = facets[other as usize];
            if other as usize != own {
                if !effort.spend(TRIANGLE_TEST_COST) {
                    return false;
                }
                meets = intersect(p, ids, q, other_ids);
            }
            !meets
        });
        meets
    });
    found += shared.found.iter().filter(|&&meets| meets).count();
    (found, shared.unfinished.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::REQUIREMENTS;
    use tiface_base::ErrorKind;

    /// Returns a box from `low` to `high`, wound outward.
    fn cuboid(low: Vec3, high: Vec3) -> Mesh {
        let at = |i: u32| Vec3::from([0, 1, 2].map(|k| if i >> k & 1 == 1 { high[k] } else { low[k] }));
        let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        Mesh {
            positions: (0..8).map(at).collect(),
            triangles: quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect(),
            ..Mesh::default()
        }
    }

    fn both(mut a: Mesh, b: Mesh) -> Mesh {
        let first = a.positions.len() as u32;
        a.positions.extend(b.positions);
        a.triangles.extend(b.triangles.iter().map(|t| t.map(|i| i + first)));
        a
    }

    #[test]
    fn a_box_is_sound() {
        // 2 × 3 × 4 dm: 24 liters; V − E + F = 8 − 18 + 12 = 2
        let r = check(&cuboid(Vec3::ZERO, Vec3::new(2.0, 3.0, 4.0)), 0.1);
        assert!(r.closed && r.manifold);
        assert_eq!((r.pieces, r.euler, r.genus), (1, 2, Some(0)));
        assert!((r.volume_l.unwrap() - 24.0).abs() < 1e-9);
        assert!((r.size_m[2] - 0.4).abs() < 1e-12);
        assert_eq!((r.self_intersections, r.slivers, r.degenerate), (0, 0, 0));
        assert_eq!(r.require(&REQUIREMENTS[..4]), Ok(()));
        // its texture coordinates have not been measured
        assert!(r.require(&["sound-uv"]).is_err());
        assert!(r.to_string().contains("watertight           yes"));
    }

    #[test]
    fn a_texture_seam_does_not_open_a_mesh() {
        let whole = cuboid(Vec3::ZERO, Vec3::ONE);
        let split = Mesh {
            positions: whole.triangles.iter().flat_map(|t| t.map(|i| whole.positions[i as usize])).collect(),
            triangles: (0..12).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..Mesh::default()
        };
        let r = check(&split, 1.0);
        assert_eq!((r.vertices, r.welded_vertices, r.closed, r.euler), (36, 8, true, 2));
    }

    #[test]
    fn holes_turned_faces_and_third_faces_are_told_apart() {
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.triangles.pop();
        let r = check(&m, 1.0);
        assert_eq!((r.boundary_edges, r.closed, r.manifold, r.genus), (3, false, true, None));
        let missed = r.require(&["manifold", "watertight"]).unwrap_err();
        assert!(
            missed.kind() == ErrorKind::BelowBar && missed.to_string().starts_with("not watertight: 3 open")
        );
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.triangles[0].swap(0, 1);
        let r = check(&m, 1.0);
        assert_eq!((r.flipped_edges, r.closed), (3, false));
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.positions.push(Vec3::new(3.0, -1.0, 0.5));
        m.triangles.push([0, 1, 8]);
        let r = check(&m, 1.0);
        assert_eq!((r.nonmanifold_edges, r.boundary_edges, r.manifold), (1, 2, false));
    }

    #[test]
    fn an_inside_out_mesh_is_not_watertight() {
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        let r = check(&m, 1.0);
        assert!(r.closed && r.volume_l.unwrap() < 0.0);
        let missed = r.require(&["watertight"]).unwrap_err();
        assert!(
            missed.kind() == ErrorKind::BelowBar && missed.to_string().ends_with("inside out"),
            "{missed}"
        );
        assert!(r.to_string().contains("watertight           NO (0 open edges, 0 wound alike, inside out)"));
        // a hollow in a box is wound towards the box's outside, and as it should be
        let hollow = both(cuboid(Vec3::splat(-1.0), Vec3::splat(2.0)), m);
        assert_eq!(check(&hollow, 1.0).require(&["watertight"]), Ok(()));
    }

    #[test]
    fn a_piece_turned_inside_out_beside_another_is_not_watertight() {
        let whole = cuboid(Vec3::splat(-1.0), Vec3::ONE);
        let mut turned = cuboid(Vec3::new(2.0, -0.5, -0.5), Vec3::new(3.0, 0.5, 0.5));
        turned.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        let r = check(&both(whole.clone(), turned), 1.0);
        // 8 m³ − 1 m³: the volume of all does not show it
        assert!(r.closed && r.volume_l.is_some_and(|v| v > 0.0));
        let expected = PieceReport { triangles: 12, center: [2.5, 0.0, 0.0], volume_l: -1000.0 };
        assert_eq!(r.wrong_pieces, [expected]);
        let missed = r.require(&["watertight"]).unwrap_err();
        let named = "a piece of 12 triangles around (2.500000, 0.000000, 0.000000) inside out";
        assert!(missed.kind() == ErrorKind::BelowBar && missed.to_string().contains(named), "{missed}");
        assert!(r.to_string().contains("watertight           NO"), "{r}");
        // one that touches the other at a vertex, where they are welded
        let mut touching = cuboid(Vec3::ONE, Vec3::splat(2.0));
        let sound = check(&both(whole.clone(), touching.clone()), 1.0);
        assert_eq!((sound.pieces, sound.require(&["watertight"])), (1, Ok(())));
        touching.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        assert!(check(&both(whole, touching), 1.0).require(&["watertight"]).is_err());
    }

    #[test]
    fn both_sides_of_a_flat_sheet_are_not_watertight() {
        let m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2], [0, 2, 1]],
            ..Mesh::default()
        };
        let r = check(&m, 1.0);
        let missed = r.require(&["watertight"]).unwrap_err();
        assert!(r.closed && missed.to_string().ends_with(", without a volume"), "{missed}");
    }

    #[test]
    fn an_open_mesh_has_no_volume_wherever_it_lies() {
        for away in [0.0, 10.0] {
            let mut m = cuboid(Vec3::splat(away), Vec3::splat(away + 1.0));
            m.triangles.pop();
            let r = check(&m, 1.0);
            assert_eq!(r.volume_l, None);
            assert!(r.to_string().contains("volume               undefined: the mesh is open"), "{r}");
        }
    }

    #[test]
    fn the_ends_of_an_edge_of_three_triangles_are_not_manifold() {
        let m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::Z, Vec3::X, Vec3::Y, -Vec3::X],
            triangles: vec![[0, 1, 2], [0, 1, 3], [0, 1, 4]],
            ..Mesh::default()
        };
        // nothing says which two of the three go on into each other: each is a fan of its own at
        // both ends
        let r = check(&m, 1.0);
        assert_eq!((r.nonmanifold_edges, r.nonmanifold_vertices, r.boundary_edges), (1, 2, 6));
    }

    #[test]
    fn two_boxes_touching_at_a_corner_are_closed_but_not_manifold() {
        let m = both(cuboid(Vec3::ZERO, Vec3::ONE), cuboid(Vec3::ONE, Vec3::splat(2.0)));
        let r = check(&m, 1.0);
        assert_eq!((r.closed, r.nonmanifold_vertices, r.pieces, r.self_intersections), (true, 1, 1, 0));
    }

    #[test]
    fn boxes_side_by_side_do_not_intersect_and_overlapping_ones_do() {
        let first = cuboid(Vec3::ZERO, Vec3::ONE);
        let apart = both(first.clone(), cuboid(Vec3::new(2.0, 0.0, 0.0), Vec3::new(3.0, 1.0, 1.0)));
        let r = check(&apart, 1.0);
        assert_eq!((r.pieces, r.self_intersections, r.genus), (2, 0, Some(0)));
        assert!(r.require(&["one-piece"]).is_err());
        // a corner at (0.7, 0.6, 0.4) inside the first box
        let through = both(first.clone(), cuboid(Vec3::new(0.7, 0.6, 0.4), Vec3::new(1.9, 1.8, 1.7)));
        assert!(check(&through, 1.0).self_intersections >= 6);
        // a common wall with other diagonals and corners: the walls overlap in one plane
        let flush = both(first, cuboid(Vec3::new(1.0, 0.2, 0.2), Vec3::new(2.0, 0.8, 0.8)));
        assert!(check(&flush, 1.0).self_intersections >= 4);
    }

    #[test]
    fn folded_and_repeated_triangles_lie_on_each_other() {
        let mut m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.5, 1.0, 0.0), Vec3::new(0.5, 0.5, 0.0)],
            triangles: vec![[0, 1, 2], [1, 0, 3]], // both on the same side of their edge
            ..Mesh::default()
        };
        assert_eq!(check(&m, 1.0).self_intersections, 2);
        m.positions[3].z = 0.1; // a sharp fold, but a fold
        assert_eq!(check(&m, 1.0).self_intersections, 0);
        m.triangles[1] = [2, 0, 1];
        assert_eq!(check(&m, 1.0).self_intersections, 2);
    }

    #[test]
    fn triangles_sharing_one_corner_may_pierce_each_other() {
        let m = Mesh {
            positions: vec![
                Vec3::ZERO,
                Vec3::new(2.0, -1.0, 0.0),
                Vec3::new(2.0, 1.0, 0.0),
                Vec3::new(1.0, 0.0, -1.0),
                Vec3::new(1.0, 0.0, 1.0),
            ],
            triangles: vec![[0, 1, 2], [0, 3, 4]],
            ..Mesh::default()
        };
        assert_eq!(check(&m, 1.0).self_intersections, 2);
    }

    #[test]
    fn slivers_and_flat_triangles_are_counted() {
        let m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.5, 0.01, 0.0), Vec3::new(2.0, 0.0, 0.0)],
            // quality 4√3·0.005/1.5 = 0.023; then three points on a line; then one point twice
            triangles: vec![[0, 1, 2], [0, 1, 3], [0, 0, 1]],
            ..Mesh::default()
        };
        let r = check(&m, 1.0);
        assert_eq!((r.slivers, r.degenerate), (1, 2));
    }

    #[test]
    fn rubbish_is_reported_not_followed() {
        let m = Mesh {
            positions: vec![Vec3::NAN, Vec3::splat(3e38), Vec3::splat(-3e38), Vec3::X],
            normals: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::NAN],
            triangles: vec![[0, 1, 2], [7, 8, 9], [1, 2, 3]],
            ..Mesh::default()
        };
        let r = check(&m, 1.0);
        assert_eq!((r.invalid, r.closed, r.bad_normals), (2, false, 2));
        assert_eq!(check(&Mesh::default(), 1.0).pieces, 0);
        let unknown = r.require(&["shiny"]).unwrap_err();
        assert!(unknown.kind() == ErrorKind::Usage && unknown.hint().contains("one-piece"), "{unknown}");
    }
}
