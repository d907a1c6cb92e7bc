//! A smoothed copy of a surface: every vertex moves to the mean of its neighbors (uniform
//! Laplacian; Taubin 1995 without the step back, since here the shrinking is wanted).
//!
//! A chart is a way to number the corners of triangles: coordinates that fold nowhere on the smooth
//! copy fold nowhere on the surface. The copy has no creases and pores, divides along short lines,
//! and lies flat in large pieces.

use glam::Vec3;
use tiface_base::geom::{Mesh, side_ends, sorted_sides};

/// Returns the same triangles after `rounds` of smoothing; a border is smoothed along itself.
pub(super) fn smoothed(mesh: &Mesh, rounds: usize) -> Mesh {
    let (mut inner, mut rim) = (Vec::new(), Vec::new());
    let mut on_rim = vec![false; mesh.positions.len()];
    for run in sorted_sides(&mesh.triangles).chunk_by(|a, b| a.0 == b.0) {
        let ends = side_ends(&mesh.triangles, run[0].1);
        if run.len() == 2 {
            inner.push(ends);
        } else {
            on_rim[ends.0 as usize] = true;
            on_rim[ends.1 as usize] = true;
            rim.push(ends);
        }
    }
    let mut out = mesh.clone();
    let mut sum = vec![Vec3::ZERO; out.positions.len()];
    let mut weight = vec![0f32; out.positions.len()];
    for _ in 0..rounds {
        sum.fill(Vec3::ZERO);
        weight.fill(0.0);
        let mut add = |to: u32, from: u32| {
            sum[to as usize] += out.positions[from as usize];
            weight[to as usize] += 1.0;
        };
        // border vertices depend on border neighbors only
        for &(a, b) in &inner {
            if !on_rim[a as usize] {
                add(a, b);
            }
            if !on_rim[b as usize] {
                add(b, a);
            }
        }
        for &(a, b) in &rim {
            add(a, b);
            add(b, a);
        }
        for v in 0..out.positions.len() {
            if weight[v] > 0.0 {
                // halfway, else the two sides of a border swap for ever
                let mean = sum[v] / weight[v];
                out.positions[v] = if on_rim[v] { 0.5 * (out.positions[v] + mean) } else { mean };
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Five by five vertices in a plane, the middle one and one of the border pulled out.
    fn sheet() -> Mesh {
        let mut positions: Vec<Vec3> =
            (0..25).map(|i| Vec3::new((i % 5) as f32, (i / 5) as f32, 0.0)).collect();
        positions[12].z = 8.0;
        positions[2].y = -1.0;
        let quads = (0..16).map(|q| (q % 4) + 5 * (q / 4));
        let triangles = quads.flat_map(|a: u32| [[a, a + 1, a + 6], [a, a + 6, a + 5]]).collect();
        Mesh { positions, triangles, ..Mesh::default() }
    }

    #[test]
    fn a_spike_becomes_the_mean_of_its_neighbors() {
        let smooth = smoothed(&sheet(), 1);
        // its six neighbors lie in the plane, and each has six of which it is one
        assert_eq!(smooth.positions[12].z, 0.0);
        assert!((smooth.positions[7].z - 8.0 / 6.0).abs() < 1e-6);
    }

    #[test]
    fn a_border_is_smoothed_along_itself() {
        let smooth = smoothed(&sheet(), 1);
        // halfway from y = -1 to the mean of its two neighbors on the border, 0; the inside has no
        // say
        assert_eq!(smooth.positions[2], Vec3::new(2.0, -0.5, 0.0));
        let long = smoothed(&sheet(), 50);
        assert!(long.positions.iter().all(|p| p.is_finite() && p.z.abs() < 0.01));
    }

    #[test]
    fn no_rounds_change_nothing() {
        assert_eq!(smoothed(&sheet(), 0), sheet());
    }
}
