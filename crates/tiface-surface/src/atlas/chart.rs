//! Charts: triangles laid flat, before they have a place in the texture.

use glam::DVec2;
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
}
