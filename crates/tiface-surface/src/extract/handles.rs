//! Small handles go: loops of hair are cut, holes between locks are filled.
//!
//! A surface is cut along a short loop that does not separate it (`loops`), both rims are drawn
//! apart by half an edge and each is closed by the triangulation of least area (Barequet & Sharir
//! 1995). That takes away exactly one handle and changes nothing else: where the loop goes around
//! matter it is cut, where it goes around air that is filled, and the two differ only in which side
//! of the new triangles is out.
//!
//! The field chooses among the loops of a handle: the one whose disc has the smallest `∫ |f|`. A
//! thin strand has little matter to cut and a narrow slit little air to fill, however long the slit
//! is. The field is not closed or opened itself and meshed again, as morphology would: how far that
//! goes before a handle disappears is known only afterwards, it rounds off nearby surface, and
//! costs a second extraction. Here every vertex stays on the zero set, and later steps hold the
//! mesh against itself, new triangles included ([`crate::MeshDistance`]).
//!
//! A loop whose discs would meet the surface is no place to cut (another strand may run through the
//! hole): the next best is taken, and without any the handle stays and is counted.

use super::BATCH;
use super::loops::{Loop, LoopFinder};
use crate::{Warning, check_len};
use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use tiface_base::geom::{Aabb, Boxes, DBox, Effort, Mesh, SdfField, area_vector, intersect, topology};
use tiface_base::{Monitor, Result};

/// Maximum number of sides of a loop that is cut: the triangulation's cost grows with its cube.
const MAX_SIDES: usize = 256;

/// Candidate distances by which the rims are drawn back, as shares of the way to the vertices
/// behind them; the first that fits is used.
const RIM_RETRACTIONS: [f32; 3] = [0.5, 0.25, 0.1];

/// Boxes compared for one triangle of a cap, at most: a sound surface takes hundreds.
const CAP_EFFORT: usize = 1 << 20;

/// A triangle with less area than this share of a side's square is flat.
const MIN_AREA: f64 = 1e-4;

/// A triangle may turn until this cosine when its rim is drawn back.
const MIN_TURN_COSINE: f64 = 0.3;

/// The result for a surface's handles. Lengths are of loops, in units of the positions.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct HandleReport {
    /// Loops around matter that was cut.
    pub cut: Vec<f32>,
    /// Loops around holes that were filled.
    pub filled: Vec<f32>,
    /// Number of handles that were kept.
    pub left: usize,
    /// A loop of a handle that was kept although it was short enough: it is too long to
    /// triangulate, or blocked.
    pub left_length: Option<f32>,
    /// Triangles that close cut rims: the last ones of the mesh.
    pub triangles: usize,
}

impl HandleReport {
    /// Returns the triangles that close the cuts of a mesh as extracted: part of the surface,
    /// although the field is not zero at them.
    pub(super) fn patches<'a>(&self, mesh: &'a Mesh) -> &'a [[u32; 3]] {
        &mesh.triangles[mesh.triangles.len() - self.triangles..]
    }

    /// Returns a warning if handles were cut or filled; `mm` is the unit of the positions in
    /// millimeters.
    pub fn warning(&self, mm: f64) -> Option<Warning> {
        let [cut_mm, filled_mm] =
            [&self.cut, &self.filled].map(|each| each.iter().map(|&l| f64::from(l) * mm).collect::<Vec<_>>());
        let any = !cut_mm.is_empty() || !filled_mm.is_empty();
        any.then_some(Warning::Handles { cut_mm, filled_mm, left: self.left })
    }
}

/// Removes the handles of a closed manifold that have a loop no longer than `longest`, in place.
/// Where the field is not finite it counts as 0. The mesh must not have vertex attributes yet. A
/// surface without handles, or an open one, is unchanged.
///
/// # Errors
///
/// A field that returns the wrong number of values, a request to stop.
pub(super) fn cut_handles(
    mesh: &mut Mesh,
    longest: f32,
    field: &dyn SdfField,
    monitor: &dyn Monitor,
) -> Result<HandleReport> {
    let mut report = HandleReport::default();
    while topology(&mesh.positions, &mesh.triangles).genus.is_some_and(|handles| handles > 0) {
        let Some(loops) = LoopFinder::new(&mesh.positions, &mesh.triangles) else { break };
        let found = loops.short(longest, monitor)?;
        let discs = by_field(discs(&loops, found), |v| loops.position(v), field)?;
        let mut work = HandleCutter::new(mesh, &loops);
        for disc in &discs {
            if let Some(cut) = work.along(disc) {
                let lengths = if cut { &mut report.cut } else { &mut report.filled };
                lengths.push(disc.rim.length);
            }
        }
        let HandleCutter { next, basis, .. } = work;
        if basis.is_empty() {
            let shortest = discs.iter().map(|d| d.rim.length).min_by(f32::total_cmp);
            report.left_length = shortest.or_else(|| loops.some_length());
            break;
        }
        report.triangles += next.triangles.len() - mesh.triangles.len();
        *mesh = next;
    }
    Ok(report)
}

/// A loop with the discs that could close it.
struct Disc {
    rim: Loop,
    /// Places in the rim.
    triangles: Vec<[usize; 3]>,
}

/// Returns a disc for each loop that has one, each loop once.
fn discs(loops: &LoopFinder, found: Vec<Loop>) -> Vec<Disc> {
    let mut seen = BTreeSet::new();
    let disc = |rim: Loop| {
        let mut key = rim.vertices.clone();
        key.sort_unstable();
        let n = rim.vertices.len();
        if !(3..=MAX_SIDES).contains(&n) || !seen.insert(key) {
            return None;
        }
        let places: HashMap<u32, usize> = rim.vertices.iter().enumerate().map(|(i, &v)| (v, i)).collect();
        let mut taken = vec![false; n * n];
        for (i, &v) in rim.vertices.iter().enumerate() {
            for j in loops.at(v).filter_map(|side| places.get(&loops.end(side)).copied()) {
                taken[i * n + j] = (i + 1) % n != j && (j + 1) % n != i;
            }
        }
        let points: Vec<DVec3> = rim.vertices.iter().map(|&v| loops.position(v).as_dvec3()).collect();
        let triangles = least_area(&points, |i, j| taken[i * n + j])?;
        Some(Disc { rim, triangles })
    };
    found.into_iter().filter_map(disc).collect()
}

/// Returns the triangulation of a closed polygon with the least area, its corners in the polygon's
/// order. A diagonal that is `taken` would give an edge a third triangle; `None` if those cannot be
/// avoided.
fn least_area(points: &[DVec3], taken: impl Fn(usize, usize) -> bool) -> Option<Vec<[usize; 3]>> {
    let n = points.len();
    let at = |i: usize, j: usize| i * n + j;
    let mut cost = vec![f64::INFINITY; n * n];
    let mut apex = vec![usize::MAX; n * n];
    for i in 0..n - 1 {
        cost[at(i, i + 1)] = 0.0;
    }
    for span in 2..n {
        for i in 0..n - span {
            let j = i + span;
            if taken(i, j) {
                continue;
            }
            for k in i + 1..j {
                let area = 0.5 * (points[k] - points[i]).cross(points[j] - points[i]).length();
                // a triangle without area along a straight side would cost nothing: it is used only
                // if no other is left
                let across = points[j].distance_squared(points[i]);
                let flat = if area <= MIN_AREA * across { across / MIN_AREA } else { 0.0 };
                let sum = cost[at(i, k)] + cost[at(k, j)] + area + flat;
                if sum < cost[at(i, j)] {
                    cost[at(i, j)] = sum;
                    apex[at(i, j)] = k;
                }
            }
        }
    }
    if !cost[at(0, n - 1)].is_finite() {
        return None;
    }
    let (mut open, mut out) = (vec![(0, n - 1)], Vec::with_capacity(n - 2));
    while let Some((i, j)) = open.pop() {
        if j > i + 1 {
            let k = apex[at(i, j)];
            out.push([i, k, j]);
            open.extend([(i, k), (k, j)]);
        }
    }
    Some(out)
}

/// Sorts loops by the integral `∫ |f|` over their discs, sampled at the middles of the triangles.
fn by_field(discs: Vec<Disc>, place: impl Fn(u32) -> Vec3, field: &dyn SdfField) -> Result<Vec<Disc>> {
    let (mut middles, mut areas) = (Vec::new(), Vec::new());
    for disc in &discs {
        for t in &disc.triangles {
            let [a, b, c] = t.map(|i| place(disc.rim.vertices[i]));
            middles.push((a + b + c) / 3.0);
            areas.push(0.5 * (b - a).cross(c - a).length());
        }
    }
    let values: Vec<f32> = middles.chunks(BATCH).flat_map(|points| field.sdf(points)).collect();
    check_len("signed distance", middles.len(), values.len())?;
    let mut each = values.iter().zip(&areas).map(|(f, a)| if f.is_finite() { f.abs() * a } else { 0.0 });
    let mut costs: Vec<(f32, Disc)> =
        discs.into_iter().map(|disc| (each.by_ref().take(disc.triangles.len()).sum(), disc)).collect();
    costs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.rim.length.total_cmp(&b.1.rim.length)));
    Ok(costs.into_iter().map(|(_, disc)| disc).collect())
}

/// A surface on which several loops are cut, none of which touches another.
struct HandleCutter<'a> {
    mesh: &'a Mesh,
    loops: &'a LoopFinder<'a>,
    boxes: Boxes,
    next: Mesh,
    /// Triangles of `mesh` that have changed.
    changed: Vec<bool>,
    /// The triangles that replace them in `next`, and the new ones.
    fresh: Vec<u32>,
    /// The classes of the loops cut, reduced: while they are independent, the surface stays in one
    /// piece.
    basis: Vec<u64>,
}

/// The changes that a cut makes to the mesh.
struct CutPlan {
    /// New positions of the vertices, including copies.
    moved: HashMap<u32, Vec3>,
    /// Triangles at the rims, with the copies on the right.
    at_rims: BTreeMap<u32, [u32; 3]>,
    caps: Vec<[u32; 3]>,
}

impl<'a> HandleCutter<'a> {
    fn new(mesh: &'a Mesh, loops: &'a LoopFinder<'a>) -> HandleCutter<'a> {
        HandleCutter {
            mesh,
            loops,
            boxes: Boxes::new((0..mesh.triangles.len() as u32).map(|t| span(mesh.corners(t)))),
            next: mesh.clone(),
            changed: vec![false; mesh.triangles.len()],
            fresh: Vec::new(),
            basis: Vec::new(),
        }
    }

    /// Cuts along a rim and closes both sides. Returns whether matter was cut or a hole filled;
    /// `None` if the cut is impossible, also in combination with earlier ones.
    fn along(&mut self, disc: &Disc) -> Option<bool> {
        let class = self.basis.iter().fold(disc.rim.class, |word, b| word.min(word ^ b));
        if class == 0 {
            return None;
        }
        let cut =
            RIM_RETRACTIONS.iter().find_map(|&share| self.cut(disc, share).filter(|cut| self.fits(cut)))?;
        let n = disc.rim.vertices.len();
        let copies = self.next.positions.len() as u32;
        self.next.positions.resize(copies as usize + n, Vec3::ZERO);
        for (&v, &p) in &cut.moved {
            self.next.positions[v as usize] = p;
        }
        for (&t, &corners) in &cut.at_rims {
            self.next.triangles[t as usize] = corners;
            self.changed[t as usize] = true;
            self.fresh.push(t);
        }
        let first = self.next.triangles.len() as u32;
        self.next.triangles.extend(&cut.caps);
        self.fresh.extend(first..self.next.triangles.len() as u32);
        self.basis.push(class);

        // the right cap faces the left one through air, or else faces away from it
        let right = &cut.caps[cut.caps.len() / 2..];
        let out: Vec3 = right.iter().map(|t| area_vector(t.map(|v| cut.moved[&v]))).sum();
        let apart: Vec3 =
            (0..n).map(|i| cut.moved[&disc.rim.vertices[i]] - cut.moved[&(copies + i as u32)]).sum();
        Some(out.dot(apart) > 0.0)
    }

    fn cut(&self, disc: &Disc, share: f32) -> Option<CutPlan> {
        let (loops, rim) = (self.loops, &disc.rim.vertices);
        let (n, copies) = (rim.len(), self.next.positions.len() as u32);
        let mut moved = HashMap::new();
        let mut at_rims: BTreeMap<u32, [u32; 3]> = BTreeMap::new();
        for (i, &v) in rim.iter().enumerate() {
            let towards = |w: u32| loops.at(v).find(|&side| loops.end(side) == w);
            let on = towards(rim[(i + 1) % n])?;
            let back = towards(rim[(i + n - 1) % n])?;
            let copy = copies + i as u32;
            for (from, to, name) in [(on, back, v), (back, on, copy)] {
                let (mut sum, mut count) = (Vec3::ZERO, 0.0);
                for side in loops.around(from).take_while(|&side| side != to) {
                    if side != from {
                        sum += loops.position(loops.end(side));
                        count += 1.0;
                    }
                    let corners = at_rims.entry(side / 3).or_insert(self.mesh.triangles[side as usize / 3]);
                    corners[side as usize % 3] = name;
                }
                let p = loops.position(v);
                moved.insert(name, if count > 0.0 { p.lerp(sum / count, share) } else { p });
            }
        }
        let left = disc.triangles.iter().map(|&[a, b, c]| [rim[a], rim[c], rim[b]]);
        let right = disc.triangles.iter().map(|t| t.map(|i| copies + i as u32));
        Some(CutPlan { moved, at_rims, caps: left.chain(right).collect() })
    }

    /// Returns whether no triangle is turned over, flat, or in the way of another.
    fn fits(&self, cut: &CutPlan) -> bool {
        let corners = |t: [u32; 3]| {
            t.map(|v| cut.moved.get(&v).copied().unwrap_or_else(|| self.next.positions[v as usize]))
        };
        let turned = cut.at_rims.iter().any(|(&t, &to)| {
            let was = area_vector(self.mesh.corners(t)).as_dvec3();
            let is = area_vector(corners(to)).as_dvec3();
            was.dot(is) <= MIN_TURN_COSINE * was.length() * is.length()
        });
        let taken = cut.at_rims.keys().any(|&t| self.changed[t as usize]);
        if turned || taken || cut.caps.iter().any(|&t| area_vector(corners(t)) == Vec3::ZERO) {
            return false;
        }
        let all: Vec<[u32; 3]> = cut.at_rims.values().chain(&cut.caps).copied().collect();
        all.iter().enumerate().all(|(i, &t)| {
            let p = corners(t);
            let bounds = Aabb::around(p);
            let meets = |other: [u32; 3]| {
                let q = corners(other);
                let around = Aabb::around(q);
                let apart = around.min.cmpgt(bounds.max).any() || around.max.cmplt(bounds.min).any();
                !apart && area_vector(q) != Vec3::ZERO && {
                    intersect(p.map(|p| p.as_dvec3()), t, q.map(|q| q.as_dvec3()), other)
                }
            };
            let mut free = true;
            let mut effort = Effort::new(CAP_EFFORT);
            self.boxes.meeting(&span(p), &mut effort, |o, _| {
                let replaced = self.changed[o as usize] || cut.at_rims.contains_key(&o);
                free = replaced || !meets(self.mesh.triangles[o as usize]);
                free
            });
            free && !effort.ran_short()
                && !all[..i].iter().any(|&o| meets(o))
                && !self.fresh.iter().any(|&o| meets(self.next.triangles[o as usize]))
        })
    }
}

fn span(corners: [Vec3; 3]) -> DBox {
    DBox::around(corners.map(Vec3::as_dvec3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straight_side_of_many_vertices_gets_no_triangle_without_area() {
        // a square of 4 × 1 with the long sides in quarters
        let at = |i: usize| match i {
            0..=4 => DVec3::new(i as f64, 0.0, 0.0),
            _ => DVec3::new(9.0 - i as f64, 1.0, 0.0),
        };
        let points: Vec<DVec3> = (0..10).map(at).collect();
        let found = least_area(&points, |_, _| false).unwrap();
        let area = |t: &[usize; 3]| {
            let [a, b, c] = t.map(|i| points[i]);
            0.5 * (b - a).cross(c - a).z
        };
        assert!(found.iter().all(|t| area(t) > 0.1), "{found:?}");
        assert!((found.iter().map(area).sum::<f64>() - 4.0).abs() < 1e-12);
    }

    #[test]
    fn a_diagonal_that_is_an_edge_already_is_not_made_again() {
        // a square whose one diagonal is taken: the other, although it is the longer one in space
        let points = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.5), DVec3::Y];
        let free = least_area(&points, |_, _| false).unwrap();
        let by = |i: usize, j: usize| (i, j) == (0, 2);
        let forced = least_area(&points, by).unwrap();
        assert!(forced.iter().all(|t| !(t.contains(&0) && t.contains(&2))), "{forced:?} {free:?}");
        assert!(least_area(&points, |_, j| j != 3).is_some());
        assert!(least_area(&points, |i, j| (i, j) == (0, 2) || (i, j) == (1, 3)).is_none());
    }
}
