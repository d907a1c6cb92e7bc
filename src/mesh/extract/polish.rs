//! Vertices move onto the field's zero and apart from each other, without ever spoiling a face.
//!
//! A Newton step `p −= f g / |g|²` takes out most of the error of linear interpolation; what two steps
//! leave is the chord error of flat triangles. With the first step each vertex also slides along the
//! surface towards the middle of its neighbours, which turns the slivers of marching cubes into fair
//! triangles at no further evaluation.

use glam::Vec3;
use rayon::prelude::*;

/// Shape of a triangle, 1 for equilateral, 0 for none: `4 √3 area / Σ length²`.
fn quality(a: Vec3, b: Vec3, c: Vec3) -> f32 {
    let sum = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
    if sum > 0.0 { 2.0 * 3f32.sqrt() * (b - a).cross(c - a).length() / sum } else { 0.0 }
}

/// Below this shape a face counts as spoiled, unless it was no better before.
const POOR: f32 = 0.02;
/// A face may turn until this cosine against its direction at extraction.
const TURN: f32 = 0.2;

/// Vertices on their way, and where they started.
pub(super) struct Polish<'a> {
    triangles: &'a [[u32; 3]],
    start: Vec<Vec3>,
    /// Twice the area vectors at the start.
    facing: Vec<Vec3>,
    /// No vertex goes farther from its start.
    reach: f32,
    fixed: Vec<bool>,
}

impl<'a> Polish<'a> {
    /// `fixed` vertices stay; the others move at most `reach`.
    pub(super) fn new(
        positions: &[Vec3],
        triangles: &'a [[u32; 3]],
        reach: f32,
        fixed: Vec<bool>,
    ) -> Polish<'a> {
        let facing = triangles.par_iter().map(|t| area_vector(positions, t)).collect();
        Polish { triangles, start: positions.to_vec(), facing, reach, fixed }
    }

    /// One Newton step with values and gradients at `positions`, plus the share `relax` of the way along
    /// the surface to the middle of the neighbours. Steps that would spoil a face are shortened or
    /// undone; how many vertices that held back.
    pub(super) fn step(
        &self,
        positions: &mut Vec<Vec3>,
        values: &[f32],
        gradients: &[Vec3],
        relax: f32,
    ) -> usize {
        let middles = if relax > 0.0 { self.middles(positions) } else { Vec::new() };
        let targets: Vec<Vec3> = (0..positions.len())
            .into_par_iter()
            .map(|i| {
                let (p, f, g) = (positions[i], values[i], gradients[i]);
                let slope = g.length_squared();
                if self.fixed[i] || !f.is_finite() || !slope.is_finite() || slope < 1e-12 {
                    return p;
                }
                let mut step = -f / slope * g;
                if let Some(&middle) = middles.get(i) {
                    let normal = g / slope.sqrt();
                    step = step.clamp_length_max(self.reach)
                        + relax * (middle - p).reject_from_normalized(normal);
                }
                let moved = self.start[i] + (p + step - self.start[i]).clamp_length_max(self.reach);
                if moved.is_finite() { moved } else { p }
            })
            .collect();
        self.go(positions, &targets)
    }

    /// Mean of each vertex's neighbours.
    fn middles(&self, positions: &[Vec3]) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.0f32); positions.len()];
        for t in self.triangles {
            for k in 0..3 {
                // Around a closed fan every neighbour follows the vertex exactly once.
                let sum = &mut sums[t[k] as usize];
                sum.0 += positions[t[(k + 1) % 3] as usize];
                sum.1 += 1.0;
            }
        }
        sums.iter().zip(positions).map(|(&(s, n), &p)| if n > 0.0 { s / n } else { p }).collect()
    }

    /// Moves towards the targets: all the way, half, a quarter, or not at all where a face forbids it.
    fn go(&self, positions: &mut Vec<Vec3>, targets: &[Vec3]) -> usize {
        const SHARES: [f32; 4] = [0.0, 0.25, 0.5, 1.0];
        let from = positions.clone();
        let mut share = vec![3u8; from.len()];
        loop {
            positions.par_iter_mut().enumerate().for_each(|(i, p)| {
                *p = from[i] + SHARES[share[i] as usize] * (targets[i] - from[i]);
            });
            let bad: Vec<usize> = (0..self.triangles.len())
                .into_par_iter()
                .filter(|&t| self.is_spoiled(t, &from, positions))
                .collect();
            let mut corners: Vec<u32> =
                bad.iter().flat_map(|&t| self.triangles[t]).filter(|&v| share[v as usize] > 0).collect();
            // Faces that were spoiled from the start stay so without anyone to hold back.
            if corners.is_empty() {
                break;
            }
            corners.sort_unstable();
            corners.dedup();
            corners.iter().for_each(|&v| share[v as usize] -= 1);
        }
        share.iter().filter(|&&s| s < 3).count()
    }

    fn is_spoiled(&self, t: usize, from: &[Vec3], to: &[Vec3]) -> bool {
        let tri = &self.triangles[t];
        if tri.iter().all(|&v| from[v as usize] == to[v as usize]) {
            return false;
        }
        let now = area_vector(to, tri);
        let turned = now.dot(self.facing[t]) <= TURN * now.length() * self.facing[t].length();
        let [a, b, c] = tri.map(|v| to[v as usize]);
        let shape = quality(a, b, c);
        let [a, b, c] = tri.map(|v| from[v as usize]);
        turned || (shape < POOR && shape < quality(a, b, c))
    }
}

fn area_vector(positions: &[Vec3], t: &[u32; 3]) -> Vec3 {
    let [a, b, c] = t.map(|v| positions[v as usize]);
    (b - a).cross(c - a)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn octahedron() -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let p = vec![Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z];
        let t = vec![[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]];
        (p, t)
    }

    #[test]
    fn one_newton_step_lands_on_a_sphere_of_another_radius() {
        // f = |p| − 1.25, |g| = 1: from |p| = 1 the step is 0.25 outward.
        let (mut p, t) = octahedron();
        let polish = Polish::new(&p, &t, 0.5, vec![false; 6]);
        let f = vec![-0.25; 6];
        let g = p.clone();
        assert_eq!(polish.step(&mut p, &f, &g, 0.0), 0);
        assert!(p.iter().all(|p| (p.length() - 1.25).abs() < 1e-6));
    }

    #[test]
    fn a_step_is_cut_at_the_reach_and_fixed_vertices_stay() {
        let (mut p, t) = octahedron();
        let mut fixed = vec![false; 6];
        fixed[0] = true;
        let polish = Polish::new(&p, &t, 0.1, fixed);
        let g = p.clone();
        polish.step(&mut p, &[-9.0; 6], &g, 0.0);
        assert_eq!(p[0], Vec3::X);
        assert!((p[1].length() - 1.1).abs() < 1e-6);
    }

    #[test]
    fn a_move_through_the_opposite_side_is_held_back() {
        // Vertex 2 sent from z = 1 to z = −7; half way is −3, a quarter −1: each turns its faces.
        let (mut p, t) = octahedron();
        let polish = Polish::new(&p, &t, 10.0, vec![false; 6]);
        let mut f = vec![0.0; 6];
        f[2] = 8.0;
        let g = p.clone();
        assert_eq!(polish.step(&mut p, &f, &g, 0.0), 5);
        assert_eq!(p[2], Vec3::Z);
        assert!(t.iter().all(|t| area_vector(&p, t).dot(p[t[0] as usize]) > 0.0));
    }

    #[test]
    fn values_that_are_not_finite_move_nothing() {
        let (mut p, t) = octahedron();
        let polish = Polish::new(&p, &t, 0.5, vec![false; 6]);
        polish.step(&mut p, &[f32::NAN; 6], &[Vec3::X; 6], 0.5);
        polish.step(&mut p, &[1.0; 6], &[Vec3::ZERO; 6], 0.5);
        assert_eq!(p, octahedron().0);
    }
}
