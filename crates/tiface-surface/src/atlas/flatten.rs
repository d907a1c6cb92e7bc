//! Flattening by the crate `uvunwrap`: least squares conformal maps (Lévy, Petitjean, Ray, Maillot
//! 2002), halved until none folds.

use super::chart::Flat;
use glam::DVec2;
use std::collections::HashMap;
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};
use tiface_base::error::COMPLETE_IS_KEPT;
use tiface_base::geom::Mesh;
use tiface_base::{Error, Monitor, Result};

/// Degrees between a triangle and the mean of its chart. Lower than the library's own 70: rims come
/// out straighter, so that seams are hardly longer and stretch is less, and small charts fill the
/// texture better.
const MAX_TILTED: f32 = 55.0;

/// Maximum ratio of areas within a chart: the library's default.
pub(super) const STRETCHED: f32 = 4.0;

/// The charts of a mesh, and the triangles that got none because they have no area.
#[derive(Default)]
pub(super) struct ChartSet {
    pub charts: Vec<Flat>,
    pub without: Vec<u32>,
}

impl ChartSet {
    /// Returns the charts with each triangle `t` renumbered to `number[t]`.
    pub fn renumbered(mut self, number: &[u32]) -> ChartSet {
        let triangles = self.charts.iter_mut().flat_map(|c| &mut c.triangles).chain(&mut self.without);
        triangles.for_each(|t| *t = number[*t as usize]);
        self
    }
}

/// Flattens the regions of `labels`, one number a triangle: a region becomes one chart, or several
/// where it cannot be flat without a triangle's area changing more than `most_stretched` times
/// against the others'. Without labels the library chooses the regions.
pub(super) fn flatten(
    mesh: &Mesh,
    labels: Option<&[u32]>,
    most_stretched: f32,
    monitor: &dyn Monitor,
) -> Result<ChartSet> {
    let (positions, indices, uvs) = divided(mesh, labels);
    let area: f64 = (0..mesh.triangles.len() as u32).map(|t| mesh.area(t)).sum();
    if !(area > 0.0 && area.is_finite()) {
        return Err(unusable("the mesh has no area"));
    }
    let texels_per_unit = (256.0 / area.sqrt()) as f32;
    if !(texels_per_unit > 0.0 && texels_per_unit.is_finite()) {
        return Err(unusable("the mesh is too large or too small for 32-bit texture coordinates"));
    }
    let input = uvunwrap::MeshInput {
        existing_uvs: uvs.as_deref(),
        ..uvunwrap::MeshInput::new(&positions, &indices)
    };
    // Its packing is thrown away, so the fastest of them.
    let options = uvunwrap::Options {
        density: uvunwrap::Density::Fixed { texels_per_unit, page_size: None },
        packing: uvunwrap::Packing::Fast,
        padding: 0,
        max_area_distortion: most_stretched,
        max_chart_angle: MAX_TILTED,
        ..uvunwrap::Options::default()
    };
    let call = || uvunwrap::generate_with_progress(&[input], &options, |_| !monitor.stop());
    let answer = match catch_unwind(AssertUnwindSafe(call)) {
        Ok(Ok(answer)) => answer,
        Ok(Err(uvunwrap::Error::Cancelled)) => return Err(Error::stopped(COMPLETE_IS_KEPT)),
        Ok(Err(error)) => return Err(unusable(format!("uvunwrap: {error}"))),
        Err(panic) => return Err(unusable(format!("uvunwrap panicked: {}", panic_message(&*panic)))),
    };
    let out = match &answer.meshes[..] {
        [one] if one.indices.len() == indices.len() => one,
        _ => return Err(unusable("uvunwrap answered with other triangles than it was given")),
    };
    collect(out, DVec2::new(answer.width.into(), answer.height.into()) / f64::from(answer.texels_per_unit))
}

/// Vertices repeated between regions. Regions are handed over as texture coordinates that are one
/// point a region: the library then takes each region as an island, finds the coordinates of no
/// use, and flattens it.
fn divided(mesh: &Mesh, labels: Option<&[u32]>) -> (Vec<[f32; 3]>, Vec<u32>, Option<Vec<[f32; 2]>>) {
    let Some(labels) = labels else {
        let positions = mesh.positions.iter().map(|p| p.to_array()).collect();
        return (positions, mesh.triangles.as_flattened().to_vec(), None);
    };
    let (mut positions, mut uvs) = (Vec::new(), Vec::new());
    let mut numbers: HashMap<(u32, u32), u32> = HashMap::with_capacity(mesh.positions.len());
    let corners = mesh.triangles.iter().zip(labels).flat_map(|(t, &label)| t.map(|v| (v, label)));
    let indices = corners
        .map(|(v, label)| {
            *numbers.entry((v, label)).or_insert_with(|| {
                positions.push(mesh.positions[v as usize].to_array());
                uvs.push([label as f32, 0.0]);
                positions.len() as u32 - 1
            })
        })
        .collect();
    (positions, indices, Some(uvs))
}

fn collect(out: &uvunwrap::OutputMesh, page: DVec2) -> Result<ChartSet> {
    let mut charts: Vec<Flat> = Vec::new();
    let mut without = Vec::new();
    let mut number_of: HashMap<u32, u32> = HashMap::new();
    let mut local = vec![u32::MAX; out.vertices.len()];
    for (t, corners) in out.indices.chunks_exact(3).enumerate() {
        let at = |k: usize| out.vertices.get(corners[k] as usize);
        let (Some(a), Some(b), Some(c)) = (at(0), at(1), at(2)) else {
            return Err(unusable("uvunwrap left a corner without coordinates"));
        };
        let chart = match a.chart {
            Some(chart) if b.chart == a.chart && c.chart == a.chart && a.uv != b.uv && b.uv != c.uv => chart,
            _ => {
                without.push(t as u32);
                continue;
            }
        };
        let next = charts.len() as u32;
        let number = *number_of.entry(chart).or_insert(next);
        if number == next {
            charts.push(Flat::default());
        }
        let flat = &mut charts[number as usize];
        let mut corner = [0; 3];
        for (k, vertex) in [a, b, c].into_iter().enumerate() {
            let point = DVec2::new(vertex.uv[0].into(), vertex.uv[1].into()) * page;
            if !point.is_finite() {
                return Err(unusable("uvunwrap gave a coordinate that is not finite"));
            }
            let slot = &mut local[corners[k] as usize];
            if *slot == u32::MAX {
                *slot = flat.points.len() as u32;
                flat.points.push(point);
            }
            corner[k] = *slot;
        }
        flat.triangles.push(t as u32);
        flat.corners.push(corner);
    }
    Ok(ChartSet { charts, without })
}

/// Returns the error for a mesh that cannot be divided into charts.
fn unusable(reason: impl Display) -> Error {
    Error::cannot(reason, "")
}

/// Returns the message of a panic.
fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("without a message").into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use tiface_base::Quiet;

    /// Four unit squares in a row, folded up by a little each.
    fn steps() -> Mesh {
        let heights = [0.0, 0.1, 0.3, 0.6, 1.0];
        let positions = (0..5).flat_map(|i| [0.0, 1.0].map(|y| Vec3::new(i as f32, y, heights[i]))).collect();
        let triangles = (0..4).flat_map(|i| [[2 * i, 2 * i + 2, 2 * i + 3], [2 * i, 2 * i + 3, 2 * i + 1]]);
        Mesh { positions, triangles: triangles.collect(), ..Mesh::default() }
    }

    #[test]
    fn regions_become_charts_of_their_own_size() {
        let mesh = steps();
        let whole = flatten(&mesh, Some(&[0; 8]), STRETCHED, &Quiet).unwrap();
        assert_eq!((whole.charts.len(), whole.without.len()), (1, 0));
        let halves = flatten(&mesh, Some(&[0, 0, 0, 0, 7, 7, 7, 7]), STRETCHED, &Quiet).unwrap();
        let triangles: Vec<_> = halves.charts.iter().map(|c| c.triangles.clone()).collect();
        assert_eq!(triangles, [vec![0, 1, 2, 3], vec![4, 5, 6, 7]]);
        // √(1 + 0.1²) + √(1 + 0.2²)
        let area = 1.01f64.sqrt() + 1.04f64.sqrt();
        assert!((halves.charts[0].area() - area).abs() < 1e-4 * area);
        assert!((0..4).all(|k| super::super::chart::twice_area(halves.charts[0].at(k)) > 0.0));
    }

    #[test]
    fn triangles_without_area_get_no_chart() {
        let mut mesh = steps();
        mesh.triangles.push([0, 0, 1]);
        assert_eq!(flatten(&mesh, None, STRETCHED, &Quiet).unwrap().without, [8]);
        mesh.triangles = vec![[0, 0, 1]];
        assert!(flatten(&mesh, None, STRETCHED, &Quiet).is_err());
    }
}
