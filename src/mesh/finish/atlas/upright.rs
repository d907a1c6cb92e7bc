//! The face stands upright in the texture: who paints there sees what it is.

use super::flat::{Flat, twice_area};
use crate::geom::Mesh;
use glam::{DVec2, Vec3};

/// Of the surface, a chart that is no more than a sliver of the face need not stand.
const LEAST: f64 = 0.01;

/// Less than this share of the steepest rise says nothing of where up is.
const LEAST_RISE: f64 = 0.1;

/// For each chart where up is in it, of length 1, if it has to stand upright: the one that the foremost triangle, seen
/// along `front`, is part of.
pub(super) fn upright(mesh: &Mesh, charts: &[Flat], front: Vec3, up: Vec3) -> Vec<Option<DVec2>> {
    let depth = |t: u32| mesh.corners(t).map(|p| p.dot(front)).iter().sum::<f32>();
    let foremost = (0..mesh.triangles.len() as u32).max_by(|&a, &b| depth(a).total_cmp(&depth(b)));
    let whole: f64 = charts.iter().map(Flat::area).sum();
    let stands = |chart: &Flat| {
        let is_face = foremost.is_some_and(|t| chart.triangles.contains(&t)) && chart.area() > LEAST * whole;
        is_face.then(|| rising(mesh, chart, up)).flatten()
    };
    charts.iter().map(stands).collect()
}

/// Where in a chart the surface rises, on the mean over its area; `None` where it does not.
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
    // seen from below or above, up is nowhere in it; the gradient of what stands straight is 1 everywhere
    (sum.length() > LEAST_RISE * 2.0 * chart.area()).then(|| sum.normalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn up_in_a_chart_is_where_the_surface_rises() {
        // a square in the plane y = 0, seen from -y, laid flat and turned by a quarter: its z runs along -x of the chart
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
        let found = upright(&mesh, std::slice::from_ref(&chart), -Vec3::Y, Vec3::Z)[0].unwrap();
        assert!((found - DVec2::NEG_X).length() < 1e-12, "{found}");
        // level ground rises nowhere
        let nearly_level = (Vec3::Y + 0.05 * Vec3::Z).normalize();
        for up in [Vec3::Y, nearly_level] {
            assert_eq!(upright(&mesh, std::slice::from_ref(&chart), -Vec3::Y, up), [None]);
        }
    }
}
