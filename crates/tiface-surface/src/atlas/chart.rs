//! Charts: triangles laid flat, before they have a place in the texture.
//!
//! Patches of a surface: which triangles lie beside each other, parts as meshes of their own, how
//! far a chart is from the sizes of its surface.
//!
//! The face stands upright in the texture, so that it can be painted.

use glam::{DVec2, Vec3};
use std::collections::HashMap;
use tiface_base::geom::{Mesh, Sets, side_ends, sorted_sides};

/// A flat patch: y up, every triangle counter-clockwise, lengths those of the mesh.
#[derive(Clone, Debug, Default)]
pub(super) struct Flat {
    /// Triangles of the mesh.
    pub triangles: Vec<u32>,
    /// Their corners, into `points`.
    pub corners: Vec<[u32; 3]>,
    /// Texture positions of the corners.
    pub points: Vec<DVec2>,
}

/// Returns twice the area, positive when counter-clockwise.
pub(super) fn twice_area([a, b, c]: [DVec2; 3]) -> f64 {
    (b - a).perp_dot(c - a)
}

/// Returns the smallest height of a triangle; negative when clockwise.
pub(super) fn height(p: [DVec2; 3]) -> f64 {
    let longest = p[0].distance(p[1]).max(p[1].distance(p[2])).max(p[2].distance(p[0]));
    if longest > 0.0 { twice_area(p) / longest } else { 0.0 }
}

impl Flat {
    /// Returns the corners of a triangle of the chart.
    pub fn at(&self, k: usize) -> [DVec2; 3] {
        self.corners[k].map(|i| self.points[i as usize])
    }

    pub fn area(&self) -> f64 {
        0.5 * (0..self.corners.len()).map(|k| twice_area(self.at(k))).sum::<f64>()
    }

    /// Returns one triangle as half of a square, with its largest angle at the right angle.
    pub fn half_square(mesh: &Mesh, triangle: u32, leg: f64) -> Flat {
        let first = widest(mesh, triangle);
        let mut corner = [0, 1, 2];
        corner.rotate_right(first);
        Flat {
            triangles: vec![triangle],
            corners: vec![corner],
            points: vec![DVec2::ZERO, leg * DVec2::X, leg * DVec2::Y],
        }
    }

    /// Sides that border on no other triangle of the chart.
    pub fn outline(&self) -> Vec<(u32, u32)> {
        let sides = sorted_sides(&self.corners);
        let alone = sides.chunk_by(|a, b| a.0 == b.0).filter(|run| run.len() == 1);
        alone.map(|run| side_ends(&self.corners, run[0].1)).collect()
    }

    /// Returns the parts that are connected across sides, of the triangles that are `kept`. Parts
    /// that meet in a corner only no longer share it.
    pub fn parts(&self, kept: impl Fn(usize) -> bool) -> Vec<Flat> {
        let mut sets = Sets::new(self.corners.len());
        for run in sorted_sides(&self.corners).chunk_by(|a, b| a.0 == b.0) {
            let mut members = run.iter().map(|side| side.1 / 3).filter(|&k| kept(k as usize));
            if let Some(first) = members.next() {
                members.for_each(|k| sets.join(first, k));
            }
        }
        let mut parts: Vec<Flat> = Vec::new();
        let mut part_of = vec![u32::MAX; self.corners.len()];
        let mut local: HashMap<(u32, u32), u32> = HashMap::with_capacity(self.points.len());
        for k in (0..self.corners.len()).filter(|&k| kept(k)) {
            let root = sets.find(k as u32) as usize;
            if part_of[root] == u32::MAX {
                part_of[root] = parts.len() as u32;
                parts.push(Flat::default());
            }
            let number = part_of[root];
            let part = &mut parts[number as usize];
            let corners = self.corners[k].map(|i| {
                *local.entry((number, i)).or_insert_with(|| {
                    part.points.push(self.points[i as usize]);
                    part.points.len() as u32 - 1
                })
            });
            part.triangles.push(self.triangles[k]);
            part.corners.push(corners);
        }
        parts
    }
}

/// Returns the corner of a triangle with its largest angle: opposite the longest side.
pub(super) fn widest(mesh: &Mesh, triangle: u32) -> usize {
    let p = mesh.corners(triangle);
    let opposite = |k: usize| p[(k + 1) % 3].distance_squared(p[(k + 2) % 3]);
    (1..3).fold(0, |best, k| if opposite(k) > opposite(best) { k } else { best })
}

/// Marks a missing triangle, vertex or number.
pub(super) const NONE: u32 = u32::MAX;

/// Returns the `wanted` triangles and their indices.
pub(super) fn part(mesh: &Mesh, wanted: impl Fn(u32) -> bool) -> (Mesh, Vec<u32>) {
    let number: Vec<u32> = (0..mesh.triangles.len() as u32).filter(|&t| wanted(t)).collect();
    let mut vertex = vec![NONE; mesh.positions.len()];
    let mut part = Mesh::default();
    for &t in &number {
        part.triangles.push(mesh.triangles[t as usize].map(|v| {
            let n = &mut vertex[v as usize];
            if *n == NONE {
                *n = part.positions.len() as u32;
                part.positions.push(mesh.positions[v as usize]);
            }
            *n
        }));
    }
    (part, number)
}

/// Returns the mean of (r + 1/r) / 2 over a chart that has the area of its surface.
pub(super) fn stretch(mesh: &Mesh, flat: &Flat) -> f64 {
    let (mut sum, mut whole) = (0.0, 0.0);
    for (k, &t) in flat.triangles.iter().enumerate() {
        let area = mesh.area(t);
        let ratio = 0.5 * twice_area(flat.at(k)) / area;
        if ratio > 0.0 && ratio.is_finite() {
            sum += area * 0.5 * (ratio + 1.0 / ratio);
            whole += area;
        }
    }
    sum / whole
}

/// Returns the triangle across the side from corner k to k + 1 of each triangle; [`NONE`] if not
/// exactly one other shares it.
pub(super) fn neighbors(mesh: &Mesh) -> Vec<[u32; 3]> {
    let mut beside = vec![[NONE; 3]; mesh.triangles.len()];
    for run in sorted_sides(&mesh.triangles).chunk_by(|a, b| a.0 == b.0) {
        if let [(_, a), (_, b)] = *run {
            beside[a as usize / 3][a as usize % 3] = b / 3;
            beside[b as usize / 3][b as usize % 3] = a / 3;
        }
    }
    beside
}

/// Smooths the borders of regions: a triangle with two neighbors in one other region joins it.
pub(super) fn straighten<L: Copy + PartialEq>(beside: &[[u32; 3]], region: &mut [L]) {
    for _ in 0..4 {
        for t in 0..beside.len() {
            let of = beside[t].map(|n| (n != NONE).then(|| region[n as usize]));
            for (a, b) in [(0, 1), (1, 2), (2, 0)] {
                if let (Some(one), Some(other)) = (of[a], of[b])
                    && one == other
                {
                    region[t] = one;
                }
            }
        }
    }
}

/// Minimum mean rise, as a share of the steepest, from which an up direction is derived.
const MIN_RISE: f64 = 0.1;

/// Returns the unit up direction within the chart that has to stand upright: the one that triangle
/// `of_face` is part of.
pub(super) fn upright(mesh: &Mesh, charts: &[Flat], of_face: u32, up: Vec3) -> Vec<Option<DVec2>> {
    let stands = |chart: &Flat| chart.triangles.contains(&of_face).then(|| rising(mesh, chart, up)).flatten();
    charts.iter().map(stands).collect()
}

/// Returns the mean direction in a chart along which the surface rises; `None` if it has none.
fn rising(mesh: &Mesh, chart: &Flat, up: Vec3) -> Option<DVec2> {
    let mut sum = DVec2::ZERO;
    for (k, &t) in chart.triangles.iter().enumerate() {
        let [a, b, c] = chart.at(k);
        let height = mesh.corners(t).map(|p| f64::from(p.dot(up)));
        let (along, across) = (height[1] - height[0], height[2] - height[0]);
        // the gradient of a linear function on a triangle, times twice its area
        let (u, v) = (b - a, c - a);
        sum += DVec2::new(along * v.y - across * u.y, across * u.x - along * v.x)
            * twice_area([a, b, c]).signum();
    }
    // seen from below or above, up is nowhere in it; what stands straight rises by its scale
    // everywhere
    let surface: f64 = chart.triangles.iter().map(|&t| mesh.area(t)).sum();
    (sum.length() > MIN_RISE * 2.0 * (surface * chart.area()).sqrt()).then(|| sum.normalize())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// Returns a strip of four triangles over the corners 0 1 2 above 3 4 5.
    fn strip() -> Flat {
        let p = |x: f64, y: f64| DVec2::new(x, y);
        Flat {
            triangles: vec![10, 11, 12, 13],
            corners: vec![[3, 4, 0], [4, 1, 0], [4, 5, 1], [5, 2, 1]],
            points: vec![p(0., 1.), p(1., 1.), p(2., 1.), p(0., 0.), p(1., 0.), p(2., 0.)],
        }
    }

    #[test]
    fn a_chart_falls_apart_where_a_triangle_is_taken_out() {
        assert_eq!(strip().parts(|_| true).len(), 1);
        let parts = strip().parts(|k| k != 2);
        assert_eq!(parts.iter().map(|p| p.triangles.clone()).collect::<Vec<_>>(), [vec![10, 11], vec![13]]);
        // the corner they meet in, twice
        assert_eq!(parts[0].points.len() + parts[1].points.len(), 7);
        assert!((parts[0].area() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn the_outline_runs_around_the_chart() {
        // 2 sides above, 2 below, 1 at each end
        let outline = strip().outline();
        assert_eq!(outline.len(), 6);
        assert!(outline.contains(&(3, 4)) && outline.contains(&(1, 0)));
    }

    #[test]
    fn a_half_square_has_its_right_angle_at_the_largest() {
        let mesh = Mesh {
            positions: vec![Vec3::new(9.0, 0.0, 0.0), Vec3::new(4.0, 0.1, 0.0), Vec3::ZERO],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        let f = Flat::half_square(&mesh, 0, 2.0);
        assert_eq!(f.at(0)[1], DVec2::ZERO); // the corner at (4, 0.1)
        assert!((f.area() - 2.0).abs() < 1e-12);
        assert!((height(f.at(0)) - 2f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn up_in_a_chart_is_where_the_surface_rises() {
        // a square in the plane y = 0, seen from -y, laid flat and turned by a quarter: its z runs
        // along -x of the chart
        let p = |x: f32, z: f32| Vec3::new(x, 0.0, z);
        let mesh = Mesh {
            positions: vec![p(0., 0.), p(1., 0.), p(1., 1.), p(0., 1.)],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        };
        let q = |x: f64, y: f64| DVec2::new(x, y);
        let chart = Flat {
            triangles: vec![0, 1],
            corners: vec![[0, 1, 2], [0, 2, 3]],
            points: vec![q(0., 0.), q(0., 1.), q(-1., 1.), q(-1., 0.)],
        };
        for scale in [1.0, 300.0] {
            let points = chart.points.iter().map(|p| *p * scale).collect();
            let found = upright(&mesh, &[Flat { points, ..chart.clone() }], 0, Vec3::Z)[0].unwrap();
            assert!((found - DVec2::NEG_X).length() < 1e-12, "{found}");
        }
        // level ground rises nowhere
        let nearly_level = (Vec3::Y + 0.05 * Vec3::Z).normalize();
        for up in [Vec3::Y, nearly_level] {
            assert_eq!(upright(&mesh, std::slice::from_ref(&chart), 0, up), [None]);
        }
    }
}
