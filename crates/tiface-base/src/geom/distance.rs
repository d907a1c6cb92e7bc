//! Distances between surfaces.
//!
//! Points are spread evenly by area over one mesh, always at the same positions, and their nearest
//! points on the other are found. Both directions are needed: missing parts show in one,
//! superfluous parts in the other.

use super::bvh::Bvh;
use super::mesh::Mesh;
use crate::math::rank::nearest_rank;
use glam::Vec3;
use rayon::prelude::*;
use serde::Serialize;

/// Distances from one surface to another, in the units of the meshes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Distances {
    /// Number of points that were measured.
    pub samples: usize,
    /// Mean.
    pub mean: f64,
    /// Median.
    pub median: f64,
    /// 90th percentile.
    pub p90: f64,
    /// Largest.
    pub max: f64,
}

/// Returns the distances from `samples` points on `from` to the surface `to`; `None` if a mesh has
/// no area.
pub fn one_way(from: &Mesh, to: &Bvh, samples: usize) -> Option<Distances> {
    distances(sample(from, samples), to)
}

/// Returns the distances of points from a surface; `None` without any.
pub fn distances(points: Vec<Vec3>, to: &Bvh) -> Option<Distances> {
    let mut distances: Vec<f32> =
        points.into_par_iter().filter_map(|p| to.closest_point(p).map(|c| c.distance)).collect();
    if distances.is_empty() {
        return None;
    }
    let mean = distances.iter().map(|&d| d as f64).sum::<f64>() / distances.len() as f64;
    distances.par_sort_unstable_by(f32::total_cmp);
    let rank = |share: f64| nearest_rank(&distances, share).map(f64::from);
    Some(Distances { samples: distances.len(), mean, median: rank(0.5)?, p90: rank(0.9)?, max: rank(1.0)? })
}

/// Returns `count` points spread evenly by area: equal steps through the summed areas choose the
/// triangle, the R2 sequence (Roberts 2018) the point in it. Without area, no points.
pub fn sample(mesh: &Mesh, count: usize) -> Vec<Vec3> {
    sample_triangles(mesh, count).into_iter().map(|(p, _)| p).collect()
}

/// Runs [`sample`] and returns the triangle of each point, too.
pub fn sample_triangles(mesh: &Mesh, count: usize) -> Vec<(Vec3, u32)> {
    let mut total = 0.0f64;
    let areas: Vec<f64> = (0..mesh.triangles.len() as u32)
        .map(|t| {
            let [a, b, c] = mesh.corners(t).map(|p| p.as_dvec3());
            let area = 0.5 * (b - a).cross(c - a).length();
            total += if area.is_finite() { area } else { 0.0 };
            total
        })
        .collect();
    if total <= 0.0 {
        return Vec::new();
    }
    let point = |i: usize| {
        let target = (i as f64 + 0.5) / count as f64 * total;
        let t = areas.partition_point(|&sum| sum <= target).min(areas.len() - 1);
        // 1/g and 1/g² of the plastic number g = 1.3247…
        let u = (0.5 + 0.754_877_666_246_692_8 * i as f64).fract() as f32;
        let v = (0.5 + 0.569_840_290_998_053_3 * i as f64).fract() as f32;
        let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        let [a, b, c] = mesh.corners(t as u32);
        (a + u * (b - a) + v * (c - a), t as u32)
    };
    (0..count).into_par_iter().map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::testing::sheet;

    /// From the first to the second, and back.
    fn both_ways(a: &Mesh, b: &Mesh, samples: usize) -> Option<[Distances; 2]> {
        Some([one_way(a, &Bvh::new(b), samples)?, one_way(b, &Bvh::new(a), samples)?])
    }

    #[test]
    fn parallel_sheets_are_their_gap_apart() {
        for way in both_ways(&sheet(0.0), &sheet(0.25), 1000).unwrap() {
            assert_eq!((way.samples, way.mean, way.median, way.p90, way.max), (1000, 0.25, 0.25, 0.25, 0.25));
        }
    }

    #[test]
    fn what_is_missing_shows_in_one_direction_only() {
        let whole = sheet(0.0);
        let half = Mesh {
            positions: whole.positions.iter().map(|p| Vec3::new(p.x * 0.5, p.y, p.z)).collect(),
            ..whole.clone()
        };
        let [forth, back] = both_ways(&half, &whole, 20_000).unwrap();
        assert!(forth.max < 1e-6);
        // half of the points are at 0, the rest at x − 1: mean ∫₀¹ x dx / 2 = 0.25, 90 % at 0.8
        assert!((back.mean - 0.25).abs() < 1e-3, "{back:?}");
        assert!((back.p90 - 0.8).abs() < 1e-2 && back.max <= 1.0, "{back:?}");
    }

    #[test]
    fn points_are_spread_by_area() {
        let mut mesh = sheet(0.0);
        mesh.positions.extend([Vec3::new(5.0, 0.0, 0.0), Vec3::new(6.0, 0.0, 0.0), Vec3::new(5.0, 1.0, 0.0)]);
        mesh.triangles.push([4, 5, 6]); // half of 2.5: 0.5
        let points = sample(&mesh, 10_000);
        let small = points.iter().filter(|p| p.x >= 5.0).count();
        assert!((small as i64 - 2000).abs() <= 1, "{small}");
        // within the sheet the mean is its middle
        let rest: Vec<Vec3> = points.into_iter().filter(|p| p.x < 5.0).collect();
        let mean = rest.iter().sum::<Vec3>() / rest.len() as f32;
        assert!(mean.distance(Vec3::new(1.0, 0.5, 0.0)) < 2e-3, "{mean}");
    }

    #[test]
    fn nothing_has_no_distance() {
        assert!(both_ways(&Mesh::default(), &sheet(0.0), 10).is_none());
        assert!(one_way(&sheet(0.0), &Bvh::new(&Mesh::default()), 10).is_none());
    }
}
