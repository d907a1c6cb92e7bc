//! Whether two triangles in space pass through each other: by signs of determinants in f64, which
//! count as zero where rounding could decide them.

use super::overlap::separates;
use glam::{DVec2, DVec3};

/// Returns whether two triangles meet in more than the corners they share.
pub fn intersect(p: [DVec3; 3], p_ids: [u32; 3], q: [DVec3; 3], q_ids: [u32; 3]) -> bool {
    let shared = |ids: [u32; 3], others: [u32; 3]| ids.map(|i| others.contains(&i));
    let (in_p, in_q) = (shared(p_ids, q_ids), shared(q_ids, p_ids));
    let count = in_p.iter().filter(|&&s| s).count();
    if count == 3 {
        return true;
    }
    let sides = q.map(|v| orient(p[0], p[1], p[2], v));
    match sides {
        [0, 0, 0] => return overlap_in_plane(p, q),
        [1, 1, 1] | [-1, -1, -1] => return false, // apart
        _ => {}
    }
    // The edge opposite a shared corner, or every edge without one; with a shared edge, none.
    let crosses = |a: [DVec3; 3], touching: [bool; 3], b: [DVec3; 3]| {
        (0..3).any(|k| {
            let next = (k + 1) % 3;
            !touching[k] && !touching[next] && pierces(a[k], a[next], b)
        })
    };
    count < 2 && (crosses(p, in_p, q) || crosses(q, in_q, p))
}

/// Returns whether the segment goes from one side of the triangle to the other, through it or its
/// border.
fn pierces(from: DVec3, to: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    if orient(a, b, c, from) * orient(a, b, c, to) >= 0 {
        return false;
    }
    let turns = [orient(from, to, a, b), orient(from, to, b, c), orient(from, to, c, a)];
    turns.iter().all(|&s| s >= 0) || turns.iter().all(|&s| s <= 0)
}

/// Sign of the determinant of `(a − d, b − d, c − d)`; 0 where rounding could decide it.
pub(super) fn orient(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> i32 {
    let (a, b, c) = (a - d, b - d, c - d);
    let det = a.dot(b.cross(c));
    let (x, y, z) = (a.abs(), b.abs(), c.abs());
    let permanent =
        x.x * (y.y * z.z + y.z * z.y) + x.y * (y.z * z.x + y.x * z.z) + x.z * (y.x * z.y + y.y * z.x);
    // (7 + 56 u) u with u = 2⁻⁵³ (Shewchuk 1997), and a little for the differences
    if det.abs() <= 1e-15 * permanent { 0 } else { det.signum() as i32 }
}

/// Returns whether two triangles of one plane share area: not if a side of either separates them.
fn overlap_in_plane(p: [DVec3; 3], q: [DVec3; 3]) -> bool {
    let normal = (p[1] - p[0]).cross(p[2] - p[0]).abs();
    let flat = |v: DVec3| {
        if normal.x >= normal.y && normal.x >= normal.z {
            DVec2::new(v.y, v.z)
        } else if normal.y >= normal.z {
            DVec2::new(v.z, v.x)
        } else {
            DVec2::new(v.x, v.y)
        }
    };
    let turn = |a: DVec2, b: DVec2, c: DVec2| {
        let (x, y) = ((b.x - a.x) * (c.y - a.y), (b.y - a.y) * (c.x - a.x));
        if (x - y).abs() <= 1e-15 * (x.abs() + y.abs()) { 0 } else { (x - y).signum() as i32 }
    };
    let (p, q) = (p.map(flat), q.map(flat));
    !separates(p, q, turn) && !separates(q, p, turn)
}
