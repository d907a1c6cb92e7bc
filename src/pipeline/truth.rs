//! A mesh of the demo head, compared with its exact surface.

use crate::metrics::distance;
use rayon::prelude::*;
use serde::Serialize;
use tiface_base::geom::{Bvh, Mesh};
use tiface_capture::synthetic::SyntheticHead;

/// Distances in per cent of head height, over the head without neck and shoulders.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Truth {
    /// Points measured in each direction.
    pub points: usize,
    /// Mean distance from the mesh to the true surface (accuracy).
    pub accuracy_mean: f64,
    /// 90 % of the mesh is nearer than this.
    pub accuracy_p90: f64,
    /// Mean distance from the true surface to the mesh (completeness).
    pub completeness_mean: f64,
    /// 90 % of the true surface is nearer than this.
    pub completeness_p90: f64,
}

/// Compares a mesh in world coordinates with the synthetic head. `None` if no part of it is head.
pub fn against_truth(mesh: &Mesh, points: usize) -> Option<Truth> {
    let percent = |d: f32| 100.0 * d as f64 / SyntheticHead::HEAD_HEIGHT as f64;
    let summary = |mut d: Vec<f32>| {
        d.sort_by(f32::total_cmp);
        let mean = d.iter().map(|&v| percent(v)).sum::<f64>() / d.len() as f64;
        Some((mean, percent(*d.get((d.len() * 9).div_ceil(10).checked_sub(1)?)?)))
    };
    let here: Vec<f32> = distance::sample(mesh, points)
        .into_par_iter()
        .filter(|&p| SyntheticHead.is_head(p))
        .map(|p| SyntheticHead.distance(p))
        .collect();
    let bvh = Bvh::new(mesh);
    let to_mesh: Vec<f32> = SyntheticHead
        .surface_points(points, 1)
        .into_par_iter()
        .filter(|&p| SyntheticHead.is_head(p))
        .filter_map(|p| bvh.closest_point(p).map(|c| c.distance))
        .collect();
    let count = here.len().min(to_mesh.len());
    let (accuracy_mean, accuracy_p90) = summary(here)?;
    let (completeness_mean, completeness_p90) = summary(to_mesh)?;
    Some(Truth { points: count, accuracy_mean, accuracy_p90, completeness_mean, completeness_p90 })
}
