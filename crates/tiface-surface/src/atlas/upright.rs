//! Which way a chart stands in the texture: the face is upright, so that it can be painted.

use super::chart::{Flat, twice_area};
use glam::{DVec2, Vec3};
use tiface_base::geom::Mesh;

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
