//! Orientation of the closed pieces of a mesh.
//!
//! A piece is what edges connect, so solids that touch at a vertex are several. Wound outward, it
//! has a positive volume. One of negative volume bounds a cavity if it lies inside the others:
//! their winding number at its corners is positive. The winding number of a point is the number of
//! triangles that a ray from it leaves minus those that it enters (+x here). A ray through an edge
//! or a corner meets one of the triangles there: in the plane, a point on a side counts as left of
//! it, and a side spans its lower end but not its upper one (as in simulation of simplicity,
//! Edelsbrunner, Mücke 1990).

use super::boxes::{Boxes, DBox, DEFAULT_EFFORT, Effort, share_out};
use super::intersect::orient;
use super::overlap::turn;
use super::topology::{Sets, sorted_sides};
use glam::{DVec3, Vec2, Vec3};

/// Volumes below this share of the sum that they are the result of are rounding.
const NO_VOLUME: f64 = 1e-12;

/// Corners of a piece at which the winding number of the others is determined.
const CORNERS: usize = 8;

/// Cost of one triangle near a ray, in comparisons of boxes.
const CROSSING_COST: usize = 8;

/// A closed piece that is wound against the others.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WrongPiece {
    /// Its triangles.
    pub triangles: usize,
    /// Middle of its box.
    pub center: DVec3,
    /// Its volume: negative if it is inside out, zero if it encloses nothing.
    pub volume: f64,
}

struct Piece {
    triangles: Vec<u32>,
    volume: f64,
}

/// Returns the pieces of a closed mesh that enclose nothing, or are inside out and lie in no other
/// one. A piece that could not be compared with all others for a bounded effort is one of them.
pub fn wrong_pieces(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<WrongPiece> {
    let corners = |t: u32| triangles[t as usize].map(|v| positions[v as usize].as_dvec3());
    let (pieces, piece_of) = pieces(positions, triangles);
    let suspects: Vec<usize> = (0..pieces.len()).filter(|&i| pieces[i].volume <= 0.0).collect();
    if suspects.is_empty() {
        return Vec::new();
    }
    let boxes = Boxes::new((0..triangles.len() as u32).map(|t| DBox::around(corners(t))));
    let winding = |piece: usize, point: Vec3, effort: &mut Effort| {
        let (from, flat) = (point.as_dvec3(), Vec2::new(point.y, point.z));
        let mut sum = 0;
        boxes.meeting(&DBox::around([from, from.with_x(f64::INFINITY)]), effort, |t, effort| {
            if piece_of[t as usize] as usize != piece {
                let corners = triangles[t as usize].map(|v| positions[v as usize]);
                let around = winding_in_plane(flat, corners.map(|p| Vec2::new(p.y, p.z)));
                // a triangle around the ray's line that lies before its origin is seen from the
                // other side
                let [a, b, c] = corners.map(|p| p.as_dvec3());
                sum += if around == orient(a, b, c, from) { around } else { 0 };
            }
            effort.spend(CROSSING_COST)
        });
        sum
    };
    let is_cavity = |i: usize, effort: &mut Effort| {
        let own = &pieces[suspects[i]];
        let all = own.triangles.len();
        let sample = |k: usize| triangles[own.triangles[k * all / CORNERS.min(all)] as usize][0];
        let is_inside = |k: usize, effort: &mut Effort| {
            winding(suspects[i], positions[sample(k) as usize], effort) > 0 && !effort.ran_short()
        };
        own.volume < 0.0 && (0..CORNERS.min(all)).all(|k| is_inside(k, effort))
    };
    let found = share_out(suspects.len(), DEFAULT_EFFORT, is_cavity).found;
    let wrong = suspects.into_iter().zip(found).filter(|(_, is_cavity)| !is_cavity);
    let wrong = wrong.map(|(i, _)| {
        let Piece { triangles, volume } = &pieces[i];
        let all = || triangles.iter().flat_map(|&t| corners(t));
        let (low, high) = (all().reduce(DVec3::min), all().reduce(DVec3::max));
        let center = 0.5 * (low.unwrap_or_default() + high.unwrap_or_default());
        WrongPiece { triangles: triangles.len(), center, volume: *volume }
    });
    wrong.collect()
}

/// Returns the pieces, in the order of their first triangles, and the piece of each triangle.
fn pieces(positions: &[Vec3], triangles: &[[u32; 3]]) -> (Vec<Piece>, Vec<u32>) {
    let mut sets = Sets::new(triangles.len());
    for run in sorted_sides(triangles).chunk_by(|a, b| a.0 == b.0) {
        run.windows(2).for_each(|pair| sets.join(pair[0].1 / 3, pair[1].1 / 3));
    }
    let (mut pieces, mut piece_of): (Vec<Piece>, Vec<u32>) = (Vec::new(), Vec::new());
    for t in 0..triangles.len() as u32 {
        // the smallest triangle stands for its set, so its piece is known
        let first = sets.find(t);
        let piece = if first == t { pieces.len() as u32 } else { piece_of[first as usize] };
        if first == t {
            pieces.push(Piece { triangles: Vec::new(), volume: 0.0 });
        }
        pieces[piece as usize].triangles.push(t);
        piece_of.push(piece);
    }
    for piece in &mut pieces {
        let at = |t: u32| triangles[t as usize].map(|v| positions[v as usize].as_dvec3());
        // around one of its own corners: far from the origin, nothing else would be left of small
        // volumes
        let origin = at(piece.triangles[0])[0];
        let (mut sum, mut size) = (0.0, 0.0);
        for &t in &piece.triangles {
            let [a, b, c] = at(t).map(|p| p - origin);
            let normal = b.cross(c);
            sum += a.dot(normal);
            size += a.length() * normal.length();
        }
        piece.volume = if sum.abs() <= NO_VOLUME * size { 0.0 } else { sum / 6.0 };
    }
    (pieces, piece_of)
}

/// Returns how often the sides of a triangle run around a point: 1 counter-clockwise, −1 clockwise,
/// 0 outside.
fn winding_in_plane(point: Vec2, corners: [Vec2; 3]) -> i32 {
    let crossing = |k: usize| {
        let (from, to) = (corners[k], corners[(k + 1) % 3]);
        let up = i32::from(to.y > point.y) - i32::from(from.y > point.y);
        let (low, high) = if up > 0 { (from, to) } else { (to, from) };
        if up != 0 && turn(low, high, point) >= 0 { up } else { 0 }
    };
    (0..3).map(crossing).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    type Solid = (Vec<Vec3>, Vec<[u32; 3]>);

    /// Boxes between corners, each wound outward or not.
    fn boxes(all: &[(Vec3, Vec3, bool)]) -> Solid {
        let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let (mut positions, mut triangles) = (Vec::new(), Vec::new());
        for &(low, high, outward) in all {
            let first = positions.len() as u32;
            let corner =
                |i: u32| Vec3::from([0, 1, 2].map(|k| if i >> k & 1 == 1 { high[k] } else { low[k] }));
            positions.extend((0..8).map(corner));
            for [a, b, c, d] in quads.map(|q: [u32; 4]| q.map(|i| i + first)) {
                let halves = [[a, b, c], [a, c, d]];
                triangles.extend(halves.map(|[a, b, c]| if outward { [a, b, c] } else { [a, c, b] }));
            }
        }
        (positions, triangles)
    }

    fn wrong(all: &[(Vec3, Vec3, bool)]) -> Vec<(DVec3, f64)> {
        let (positions, triangles) = boxes(all);
        wrong_pieces(&positions, &triangles).iter().map(|w| (w.center, w.volume)).collect()
    }

    #[test]
    fn a_cavity_is_a_piece_turned_inward_inside_another() {
        let (zero, one, three) = (Vec3::ZERO, Vec3::ONE, Vec3::splat(3.0));
        let whole = (-one, three, true);
        assert!(wrong(&[whole]).is_empty());
        assert!(wrong(&[whole, (zero, one, false)]).is_empty());
        // beside it, and as the only one
        let beside = (Vec3::new(4.0, 0.0, 0.0), Vec3::new(5.0, 1.0, 1.0), false);
        let found = [(DVec3::new(4.5, 0.5, 0.5), -1.0)];
        assert_eq!(wrong(&[whole, beside]), found);
        assert_eq!(wrong(&[beside]), found);
        // a solid in the cavity is sound, a cavity in the cavity is not: around it is nothing, 1 −
        // 1 = 0
        let cavity = (zero, Vec3::splat(2.0), false);
        let inner = (Vec3::splat(0.5), Vec3::splat(1.5), true);
        assert!(wrong(&[whole, cavity, inner]).is_empty());
        assert_eq!(wrong(&[whole, cavity, (inner.0, inner.1, false)]), [(DVec3::ONE, -1.0)]);
        // a box that reaches out of the other through its wall
        let through = (Vec3::splat(2.0), Vec3::splat(4.0), false);
        assert_eq!(wrong(&[whole, through]), [(DVec3::splat(3.0), -8.0)]);
    }

    #[test]
    fn a_small_piece_far_away_keeps_its_sign() {
        let far = Vec3::splat(4096.0);
        assert!(wrong(&[(far, far + Vec3::splat(0.125), true)]).is_empty());
        assert_eq!(wrong(&[(far, far + Vec3::splat(0.125), false)]).len(), 1);
    }

    #[test]
    fn solids_that_touch_at_a_vertex_are_judged_apart() {
        let (mut positions, mut triangles) =
            boxes(&[(Vec3::ZERO, Vec3::ONE, true), (Vec3::ONE, Vec3::splat(2.0), false)]);
        // one vertex for both: number 7 of the first and 0 of the second
        triangles.iter_mut().flatten().filter(|v| **v == 8).for_each(|v| *v = 7);
        positions[8] = Vec3::NAN;
        let found = wrong_pieces(&positions, &triangles);
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].triangles, found[0].center), (12, DVec3::splat(1.5)));
    }

    #[test]
    fn two_sides_of_one_triangle_enclose_nothing() {
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y];
        let found = wrong_pieces(&positions, &[[0, 1, 2], [0, 2, 1]]);
        assert_eq!(found, [WrongPiece { triangles: 2, center: DVec3::new(0.5, 0.5, 0.0), volume: 0.0 }]);
    }

    #[test]
    fn a_point_on_a_common_side_is_in_one_of_its_triangles() {
        let [a, b, c, d] = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(Vec2::from);
        // the diagonal, then both sides of it, then right, left, bottom and top
        let inside = [(0.5, 0.5), (0.25, 0.5), (0.75, 0.5), (1.0, 0.5), (1.0, 0.0), (0.5, 0.0)];
        let outside = [(0.0, 0.5), (0.0, 0.0), (0.5, 1.0), (2.0, 0.5), (0.5, -1.0)];
        let all = inside.map(|at| (at, 1)).into_iter().chain(outside.map(|at| (at, 0)));
        for ((x, y), expected) in all {
            let point = Vec2::new(x, y);
            let around = winding_in_plane(point, [a, b, c]) + winding_in_plane(point, [a, c, d]);
            assert_eq!(around, expected, "{point}");
            assert_eq!(winding_in_plane(point, [a, c, b]) + winding_in_plane(point, [a, d, c]), -expected);
        }
    }
}
