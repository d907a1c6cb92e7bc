//! [`Polish`] moves vertices onto the field's zero and apart from each other, without ever spoiling
//! a face.
//!
//! A Newton step takes out most of the error of linear interpolation; what two steps leave is the
//! chord error of flat triangles. With the first step each vertex also slides along the surface
//! towards the middle of its neighbors, which turns the slivers of marching cubes into fair
//! triangles at no further evaluation.

use crate::moves::{MIN_QUALITY, MIN_TURN_COSINE, move_vertices, newton};
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{area_vector, shape};

/// Moving vertices, with their start positions.
pub(super) struct Polish<'a> {
    triangles: &'a [[u32; 3]],
    start: Vec<Vec3>,
    /// Twice the area vectors at the start.
    facing: Vec<Vec3>,
    /// Maximum distance of a vertex from its start.
    reach: f32,
    fixed: Vec<bool>,
}

impl<'a> Polish<'a> {
    /// Returns a polish in which `fixed` vertices stay and the others move at most `reach`.
    pub(super) fn new(
        positions: &[Vec3],
        triangles: &'a [[u32; 3]],
        reach: f32,
        fixed: Vec<bool>,
    ) -> Polish<'a> {
        let facing = triangles.par_iter().map(|t| area_vector(t.map(|v| positions[v as usize]))).collect();
        Polish { triangles, start: positions.to_vec(), facing, reach, fixed }
    }

    /// Makes one Newton step with values and gradients at `positions`, plus the share `relax` of
    /// the way along the surface to the mean of the neighbors. Steps that would spoil a face are
    /// shortened or undone; returns the number of such vertices.
    pub(super) fn step(
        &self,
        positions: &mut [Vec3],
        values: &[f32],
        gradients: &[Vec3],
        relax: f32,
    ) -> usize {
        let middles = if relax > 0.0 { self.middles(positions) } else { Vec::new() };
        let targets: Vec<Vec3> = (0..positions.len())
            .into_par_iter()
            .map(|i| {
                let (p, g) = (positions[i], gradients[i]);
                let Some(mut step) = newton(values[i], g).filter(|_| !self.fixed[i]) else { return p };
                if let Some(&middle) = middles.get(i) {
                    let normal = g / g.length_squared().sqrt();
                    step = step.clamp_length_max(self.reach)
                        + relax * (middle - p).reject_from_normalized(normal);
                }
                let moved = self.start[i] + (p + step - self.start[i]).clamp_length_max(self.reach);
                if moved.is_finite() { moved } else { p }
            })
            .collect();
        let at = |i: usize, p: Vec3, share: f32| p + share * (targets[i] - p);
        let spoiled = |t: usize, from: &[Vec3], to: &[Vec3]| {
            let [was, is] = [from, to].map(|p| self.triangles[t].map(|v| p[v as usize]));
            let now = area_vector(is);
            let turned = now.dot(self.facing[t]) <= MIN_TURN_COSINE * now.length() * self.facing[t].length();
            turned || (shape(is) < MIN_QUALITY && shape(is) < shape(was))
        };
        move_vertices(positions, self.triangles, at, spoiled)
    }

    /// Returns the mean of each vertex's neighbors.
    fn middles(&self, positions: &[Vec3]) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.0f32); positions.len()];
        for t in self.triangles {
            for k in 0..3 {
                // Around a closed fan every neighbor follows the vertex exactly once.
                let sum = &mut sums[t[k] as usize];
                sum.0 += positions[t[(k + 1) % 3] as usize];
                sum.1 += 1.0;
            }
        }
        sums.iter().zip(positions).map(|(&(s, n), &p)| if n > 0.0 { s / n } else { p }).collect()
    }
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
        assert!(t.iter().all(|t| area_vector(t.map(|v| p[v as usize])).dot(p[t[0] as usize]) > 0.0));
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
