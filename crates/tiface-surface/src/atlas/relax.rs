//! Makes a flat chart keep the sizes and angles of its surface: symmetric Dirichlet energy (Smith &
//! Schaefer 2015, "Bijective parameterization with free boundaries"), minimized by L-BFGS from a
//! chart without folds.
//!
//! Of a triangle with area `A`, and `a` in the chart, whose map has the singular values `σ₁`, `σ₂`:
//!
//! ```text
//! E = A · (σ₁² + σ₂²) · (1 + A² / a²)
//!   = A · (σ₁² + σ₂² + σ₁⁻² + σ₂⁻²),   4 A for an isometry
//! ```
//!
//! It grows without bound as a triangle becomes thin, and no step is longer than 0.9 of the way to
//! the first triangle without area: what starts without folds ends without. A border that starts
//! without crossing itself ends without, too (ibid., §4): then no two triangles share any area. Its
//! sides do not touch either, so that this holds for rounded points.

mod border;

use super::chart::Flat;
use border::Border;
use glam::DVec2;
use std::collections::VecDeque;
use tiface_base::geom::Mesh;

/// Number of past steps that L-BFGS stores.
const LBFGS_HISTORY: usize = 5;

/// Energy over area at which a chart is good enough: 4 is an isometry, and 0.01 more a mean area
/// stretch below half a percent.
const TARGET_ENERGY: f64 = 4.01;

/// Area over the squared length of the thinnest triangle in a chart.
const THINNEST: f64 = 5e-3;

/// The surface's side of a triangle, as the energy needs it.
struct RestTriangle {
    /// Its corners, as indices of the chart's points.
    corners: [u32; 3],
    area: f64,
    /// Squared lengths of the sides at corner 0 and their scalar product, over 2 · area.
    g11: f64,
    g22: f64,
    g12: f64,
}

/// Relaxes a chart for at most `rounds` steps; one that holds a fold is left as it is.
pub(super) fn relax(mesh: &Mesh, flat: &mut Flat, rounds: usize) {
    let mut whole = 0.0;
    let mut rest = Vec::with_capacity(flat.triangles.len());
    for (&t, &corners) in flat.triangles.iter().zip(&flat.corners) {
        let [a, b, c] = mesh.corners(t).map(|p| p.as_dvec3());
        let (u, v) = (b - a, c - a);
        // a triangle that is a line would have endless energy, and none of its own in the texture:
        // it becomes as high as a hundredth of its length
        let area = (0.5 * u.cross(v).length()).max(THINNEST * u.length_squared().max(v.length_squared()));
        whole += area;
        let half = 0.5 / area;
        rest.push(RestTriangle {
            corners,
            area,
            g11: half * u.length_squared(),
            g22: half * v.length_squared(),
            g12: half * u.dot(v),
        });
    }
    let scale = (whole / flat.area()).sqrt();
    if !(scale.is_finite() && scale > 0.0) {
        return;
    }
    flat.points.iter_mut().for_each(|p| *p *= scale);
    if (0..flat.corners.len()).any(|k| super::chart::twice_area(flat.at(k)) <= 0.0) {
        return;
    }
    let border = Border::new(flat.outline(), &flat.points);
    descend(&rest, &mut flat.points, rounds, whole, &border);
}

fn energy(rest: &[RestTriangle], points: &[DVec2], slope: Option<&mut [DVec2]>) -> f64 {
    let mut sum = 0.0;
    let mut slope = slope;
    if let Some(s) = slope.as_deref_mut() {
        s.fill(DVec2::ZERO);
    }
    for r in rest {
        let [i, j, k] = r.corners.map(|c| c as usize);
        let (u, v) = (points[j] - points[i], points[k] - points[i]);
        let a = 0.5 * u.perp_dot(v);
        if a <= 0.0 {
            return f64::INFINITY;
        }
        // σ₁² + σ₂² times the area is the Dirichlet energy
        let d = 0.5 * (u.length_squared() * r.g22 + v.length_squared() * r.g11 - 2.0 * u.dot(v) * r.g12);
        let ratio = r.area * r.area / (a * a);
        sum += d * (1.0 + ratio);
        if let Some(s) = slope.as_deref_mut() {
            let (du, dv) = (u * r.g22 - v * r.g12, v * r.g11 - u * r.g12);
            // of the area: ∂a/∂u = ½ (v.y, −v.x), ∂a/∂v = ½ (−u.y, u.x)
            let c = -d * ratio / a;
            let gu = (1.0 + ratio) * du + c * DVec2::new(v.y, -v.x);
            let gv = (1.0 + ratio) * dv + c * DVec2::new(-u.y, u.x);
            s[j] += gu;
            s[k] += gv;
            s[i] -= gu + gv;
        }
    }
    sum
}

/// Returns how far along `step` the first triangle loses its area.
fn reach(rest: &[RestTriangle], points: &[DVec2], step: &[DVec2]) -> f64 {
    let mut nearest = f64::INFINITY;
    for r in rest {
        let [i, j, k] = r.corners.map(|c| c as usize);
        let (u, v) = (points[j] - points[i], points[k] - points[i]);
        let (du, dv) = (step[j] - step[i], step[k] - step[i]);
        // the area along the way: c + b t + a t²
        let (a, b, c) = (du.perp_dot(dv), u.perp_dot(dv) + du.perp_dot(v), u.perp_dot(v));
        let root = if a.abs() < 1e-14 * b.abs() {
            -c / b
        } else {
            let under = b * b - 4.0 * a * c;
            if under < 0.0 {
                continue;
            }
            // the stable pair of roots, of which the smaller positive one
            let q = -0.5 * (b + under.sqrt().copysign(b));
            let (x, y) = (q / a, c / q);
            match (x > 0.0, y > 0.0) {
                (true, true) => x.min(y),
                (true, false) => x,
                (false, true) => y,
                _ => continue,
            }
        };
        if root > 0.0 {
            nearest = nearest.min(root);
        }
    }
    nearest
}

fn dot(a: &[DVec2], b: &[DVec2]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum()
}

/// Returns the points along `step` where the energy, which is `now` with this `slope`, falls
/// enough, their slope and energy; `None` if none is found.
fn searched(
    rest: &[RestTriangle],
    points: &[DVec2],
    step: &mut [DVec2],
    (now, slope): (f64, &[DVec2]),
    border: &Border,
) -> Option<(Vec<DVec2>, Vec<DVec2>, f64)> {
    let mut downhill = dot(step, slope);
    let mut length = (0.9 * reach(rest, points, step)).min(1.0);
    while downhill < 0.0 && length > 1e-12 {
        let next: Vec<DVec2> = points.iter().zip(&*step).map(|(p, s)| *p + length * *s).collect();
        let crossing = border.crossing(&next);
        if !crossing.is_empty() {
            crossing.iter().for_each(|&i| step[i as usize] = DVec2::ZERO);
            downhill = dot(step, slope);
            length = (0.9 * reach(rest, points, step)).min(length);
            continue;
        }
        let mut new_slope = vec![DVec2::ZERO; points.len()];
        let value = energy(rest, &next, Some(&mut new_slope));
        if value <= now + 1e-4 * length * downhill {
            return Some((next, new_slope, value));
        }
        length *= 0.5;
    }
    None
}

/// L-BFGS (Nocedal & Wright, algorithm 7.4) with steps that halve until the energy falls enough
/// (Armijo). Where a step would make the border cross itself, the ends of the sides that cross stay
/// where they are, in this step.
fn descend(rest: &[RestTriangle], points: &mut Vec<DVec2>, rounds: usize, area: f64, border: &Border) {
    let n = points.len();
    let mut slope = vec![DVec2::ZERO; n];
    let mut now = energy(rest, points, Some(&mut slope));
    let mut past: VecDeque<(Vec<DVec2>, Vec<DVec2>, f64)> = VecDeque::with_capacity(LBFGS_HISTORY);
    let mut fallen = 0.0;
    for round in 0..rounds {
        if now <= TARGET_ENERGY * area {
            return;
        }
        let mut step: Vec<DVec2> = slope.iter().map(|g| -*g).collect();
        let mut along = [0.0; LBFGS_HISTORY];
        for (m, (s, y, rho)) in past.iter().enumerate().rev() {
            along[m] = rho * dot(s, &step);
            step.iter_mut().zip(y).for_each(|(p, y)| *p -= along[m] * *y);
        }
        if let Some((s, y, _)) = past.back() {
            let scale = dot(s, y) / dot(y, y);
            step.iter_mut().for_each(|p| *p *= scale);
        }
        for (m, (s, y, rho)) in past.iter().enumerate() {
            let back = rho * dot(y, &step);
            step.iter_mut().zip(s).for_each(|(p, s)| *p += (along[m] - back) * *s);
        }
        let Some((next, new_slope, value)) = searched(rest, points, &mut step, (now, &slope), border) else {
            if past.is_empty() {
                return;
            }
            past.clear();
            continue;
        };
        let s: Vec<DVec2> = next.iter().zip(&*points).map(|(a, b)| *a - *b).collect();
        let y: Vec<DVec2> = new_slope.iter().zip(&slope).map(|(a, b)| *a - *b).collect();
        let sy = dot(&s, &y);
        if sy > 1e-12 * dot(&y, &y).sqrt() * dot(&s, &s).sqrt() {
            if past.len() == LBFGS_HISTORY {
                past.pop_front();
            }
            past.push_back((s, y, 1.0 / sy));
        }
        fallen += now - value;
        *points = next;
        slope = new_slope;
        now = value;
        // ten steps that gain a thousandth of a percent of the area each are at the end
        if round % 10 == 9 {
            if fallen < 1e-4 * area {
                return;
            }
            fallen = 0.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::chart::twice_area;
    use super::*;
    use glam::Vec3;

    /// Returns a cylinder's quarter, 12 × 8 squares, and its coordinates seen from the front.
    fn quarter() -> (Mesh, Flat) {
        let mut mesh = Mesh::default();
        let mut flat = Flat::default();
        for y in 0..=8 {
            for x in 0..=12 {
                let turn = (x as f32 / 12.0 - 0.5) * std::f32::consts::FRAC_PI_2;
                mesh.positions.push(Vec3::new(turn.sin(), y as f32 / 6.0, turn.cos()));
                flat.points.push(DVec2::new(turn.sin() as f64, y as f64 / 6.0));
            }
        }
        for q in 0..96u32 {
            let a = q % 12 + 13 * (q / 12);
            mesh.triangles.extend([[a, a + 1, a + 14], [a, a + 14, a + 13]]);
        }
        flat.triangles = (0..192).collect();
        flat.corners.clone_from(&mesh.triangles);
        (mesh, flat)
    }

    fn rest_of(mesh: &Mesh, flat: &Flat) -> Vec<RestTriangle> {
        let mut alone = flat.clone();
        relax(mesh, &mut alone, 0);
        flat.triangles
            .iter()
            .zip(&flat.corners)
            .map(|(&t, &corners)| {
                let [a, b, c] = mesh.corners(t).map(|p| p.as_dvec3());
                let (u, v) = (b - a, c - a);
                let area = 0.5 * u.cross(v).length();
                let g = |x: f64| 0.5 * x / area;
                RestTriangle {
                    corners,
                    area,
                    g11: g(u.length_squared()),
                    g22: g(v.length_squared()),
                    g12: g(u.dot(v)),
                }
            })
            .collect()
    }

    #[test]
    fn what_can_be_unrolled_becomes_its_own_size() {
        let (mesh, mut flat) = quarter();
        relax(&mesh, &mut flat, 400);
        for (k, &t) in flat.triangles.iter().enumerate() {
            let corners = mesh.corners(t);
            for i in 0..3 {
                let length = f64::from(corners[i].distance(corners[(i + 1) % 3]));
                let found = flat.at(k)[i].distance(flat.at(k)[(i + 1) % 3]);
                assert!((found / length - 1.0).abs() < 0.08, "{found} for {length}");
            }
        }
    }

    #[test]
    fn the_energy_is_four_times_the_area_of_an_isometry_and_its_slope_is_that_of_differences() {
        let (mesh, flat) = quarter();
        let rest = rest_of(&mesh, &flat);
        // one triangle mapped by singular values 2 and ½: ½ · (4 + ¼) · 2 = 4.25 with area ½
        let one = RestTriangle { corners: [0, 1, 2], area: 0.5, g11: 1.0, g22: 1.0, g12: 0.0 };
        let points = [DVec2::ZERO, DVec2::new(2.0, 0.0), DVec2::new(0.0, 0.5)];
        assert!((energy(&[one], &points, None) - 4.25).abs() < 1e-12);
        let mut slope = vec![DVec2::ZERO; flat.points.len()];
        energy(&rest, &flat.points, Some(&mut slope));
        for v in [0, 6, 20, 58, 116] {
            for axis in [DVec2::X, DVec2::Y] {
                let shifted = |by: f64| {
                    let mut p = flat.points.clone();
                    p[v] += by * axis;
                    energy(&rest, &p, None)
                };
                let difference = (shifted(1e-6) - shifted(-1e-6)) / 2e-6;
                assert!((difference - slope[v].dot(axis)).abs() < 1e-6 * (1.0 + difference.abs()));
            }
        }
    }

    #[test]
    fn no_step_folds_and_folds_are_left_alone() {
        let (mesh, mut flat) = quarter();
        // nearly folded: one inner vertex almost on the far side of its ring
        flat.points[45] = flat.points[46] + DVec2::new(-1e-4, 1e-5);
        let folded = (0..192).any(|k| twice_area(flat.at(k)) <= 0.0);
        relax(&mesh, &mut flat, 200);
        if !folded {
            assert!((0..192).all(|k| twice_area(flat.at(k)) > 0.0));
        }
        flat.points[45] = flat.points[46] + DVec2::new(0.5, 0.0);
        let before = flat.clone();
        relax(&mesh, &mut flat, 200);
        // its size is right all the same
        let scale = flat.points[1].x / before.points[1].x;
        assert!(flat.points.iter().zip(&before.points).all(|(a, b)| a.abs_diff_eq(scale * *b, 1e-12)));
    }

    #[test]
    fn the_reach_ends_where_the_first_triangle_has_no_area() {
        let one = RestTriangle { corners: [0, 1, 2], area: 0.5, g11: 1.0, g22: 1.0, g12: 0.0 };
        let points = [DVec2::ZERO, DVec2::X, DVec2::Y];
        let step = [DVec2::ZERO, DVec2::ZERO, DVec2::new(0.0, -0.25)];
        // the height falls by a quarter a unit
        assert!((reach(&[one], &points, &step) - 4.0).abs() < 1e-12);
    }
}
