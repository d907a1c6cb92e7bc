//! Did the sparse extraction lose anything? The dense grid knows.

use super::grid::NodeGrid;
use super::marching::{Volume, marching};
use crate::{Monitor, Result};
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// The sparse extraction beside the dense one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Verified {
    /// Triangles of the dense grid's surface.
    pub dense_triangles: usize,
    /// Triangles of the sparse extraction, before cleaning.
    pub sparse_triangles: usize,
}

/// Evaluates every node of `grid` and counts the triangles of its surface. Needs four bytes a node.
pub(super) fn dense_triangles(
    sdf: &dyn Fn(&[Vec3]) -> Vec<f32>,
    inside_hull: Option<&dyn Fn(Vec3) -> bool>,
    grid: &NodeGrid,
    batch: usize,
    monitor: &dyn Monitor,
) -> Result<usize> {
    let [nx, ny, _] = grid.dims;
    let mut values = vec![grid.spacing; grid.nodes()];
    let mut nodes = (0..values.len())
        .map(|i| (i, grid.point([i % nx, i / nx % ny, i / (nx * ny)])))
        .filter(|&(_, p)| inside_hull.is_none_or(|inside| inside(p)));
    loop {
        monitor.check_stop()?;
        let (places, points): (Vec<usize>, Vec<Vec3>) = nodes.by_ref().take(batch).unzip();
        if points.is_empty() {
            break;
        }
        places.into_iter().zip(sdf(&points)).for_each(|(i, f)| values[i] = f);
    }
    let spacing = Vec3::splat(grid.spacing);
    let volume = Volume { dims: grid.dims, values: &values, origin: grid.point([0; 3]), spacing };
    Ok(marching(&volume, true)?.triangles.len())
}

#[cfg(test)]
mod tests {
    use crate::Quiet;
    use crate::geom::Aabb;
    use crate::mesh::{ExtractOptions, extract};
    use glam::Vec3;

    #[test]
    fn a_ball_has_the_same_triangles_either_way_and_a_lost_piece_shows() {
        let ball = |c: Vec3, r: f32| move |p: &Vec3| (*p - c).length() - r;
        let (big, small) = (ball(Vec3::ZERO, 0.6), ball(Vec3::splat(0.9), 0.009));
        let config = ExtractOptions { resolution: 128, verify: true, ..ExtractOptions::default() };
        let run = |sdf: &(dyn Fn(&Vec3) -> f32 + Sync)| {
            let values = |p: &[Vec3]| p.iter().map(sdf).collect::<Vec<f32>>();
            let gradient = |p: &[Vec3]| (values(p), p.iter().map(|p| p.normalize_or_zero()).collect());
            let color = |p: &[Vec3], _: &[Vec3]| vec![[0.5; 3]; p.len()];
            extract(values, gradient, color, Aabb::SCENE, None, &config, &Quiet).unwrap().1.verified.unwrap()
        };
        let same = run(&big);
        assert!(same.dense_triangles > 1000 && same.dense_triangles == same.sparse_triangles);
        // a speck of one cell between the coarse nodes is the known price of few evaluations
        let both = run(&|p| big(p).min(small(p)));
        assert!(
            both.dense_triangles >= both.sparse_triangles && both.sparse_triangles >= same.sparse_triangles
        );
    }
}
