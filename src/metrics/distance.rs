//! Distances between surfaces.
//!
//! Points are spread evenly by area over one mesh, always at the same positions, and their nearest
//! points on the other are found. Both directions are needed: missing parts show in one,
//! superfluous parts in the other.

use glam::Vec3;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::RangeInclusive;
use tiface_base::geom::{Bvh, Camera, Mesh, Ray};
use tiface_base::math::rank::nearest_rank;

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

fn distances(points: Vec<Vec3>, to: &Bvh) -> Option<Distances> {
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

/// Minimum cosine between a surface's normal and the direction to a camera that counts as seeing it
/// (75°, the limit of texture baking too): flatter views carry little information.
const MIN_COSINE: f32 = 0.26;

/// Visibility of a point, and its label.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SurfaceVisibility {
    /// Number of cameras that see the point: inside the frame, not steeper than 75°, and
    /// unoccluded.
    pub cameras: u32,
    /// Number of these cameras whose pixel shows the first kind, and the second.
    pub kinds: [u32; 2],
}

impl SurfaceVisibility {
    /// Returns whether three or more cameras see the point, and more than half of them label it as
    /// this kind.
    pub fn is(&self, kind: usize) -> bool {
        self.cameras >= 3 && 2 * self.kinds[kind] > self.cameras
    }
}

/// Returns the visibility of points of a mesh; `kind` returns the label of a camera (its index) at
/// a pixel (column, row): 0 or 1, if it has one.
///
/// Where fewer than three cameras look (a cap below the frames' border, the inside of a nostril,
/// the underside of a bust) photographs do not determine the surface, and its distance to the truth
/// says nothing about a method.
pub fn sights(
    mesh: &Mesh,
    bvh: &Bvh,
    cameras: &[Camera],
    points: &[(Vec3, u32)],
    kind: impl Fn(usize, [u32; 2]) -> Option<usize> + Sync,
) -> Vec<SurfaceVisibility> {
    let lift = 1e-4 * mesh.bounds().size().max_element();
    let pixel = |camera: &Camera, p: Vec3, normal: Vec3| {
        let (q, _) = camera.project(p)?;
        let inside = q.x >= 0.0 && q.y >= 0.0 && q.x <= camera.width as f32 && q.y <= camera.height as f32;
        let way = camera.position.as_vec3() - p;
        let distance = way.length();
        let direction = way / distance;
        let sees = inside
            && direction.dot(normal) > MIN_COSINE
            && !bvh.any_hit(&Ray { origin: p + lift * normal, direction, t_min: 0.0, t_max: distance });
        let last = [camera.width, camera.height].map(|n| n.saturating_sub(1));
        sees.then(|| [(q.x as u32).min(last[0]), (q.y as u32).min(last[1])])
    };
    let sight = |&(p, t): &(Vec3, u32)| {
        let mut sight = SurfaceVisibility::default();
        for (i, camera) in cameras.iter().enumerate() {
            let Some(pixel) = pixel(camera, p, normal(mesh, t)) else { continue };
            sight.cameras += 1;
            if let Some(kind) = kind(i, pixel) {
                sight.kinds[kind] += 1;
            }
        }
        sight
    };
    points.par_iter().map(sight).collect()
}

fn normal(mesh: &Mesh, triangle: u32) -> Vec3 {
    let [a, b, c] = mesh.corners(triangle);
    (b - a).cross(c - a).normalize_or_zero()
}

/// Returns the distances from `from` to `to` over the parts that the cameras label as either kind
/// ([`SurfaceVisibility::is`]), with the median of the signed ones: positive where `to` is outside.
/// `None` for an empty part.
pub fn kinds_one_way(
    from: &Mesh,
    to: &Bvh,
    samples: usize,
    cameras: &[Camera],
    kind: impl Fn(usize, [u32; 2]) -> Option<usize> + Sync,
) -> [Option<(Distances, f64)>; 2] {
    let points = sample_triangles(from, samples);
    let sights = sights(from, &Bvh::new(from), cameras, &points, kind);
    [0, 1].map(|kind| {
        let part: Vec<(Vec3, u32)> =
            points.iter().zip(&sights).filter(|(_, s)| s.is(kind)).map(|(p, _)| *p).collect();
        let signed = |&(p, t): &(Vec3, u32)| {
            let closest = to.closest_point(p)?;
            Some(closest.distance.copysign((closest.point - p).dot(normal(from, t))))
        };
        let mut signed: Vec<f32> = part.par_iter().filter_map(signed).collect();
        signed.par_sort_unstable_by(f32::total_cmp);
        let median = f64::from(nearest_rank(&signed, 0.5)?);
        Some((distances(part.into_iter().map(|(p, _)| p).collect(), to)?, median))
    })
}

/// Returns the distances from `from` to `to` over the parts seen by each number of cameras, and
/// each part's share of the area, in the order of `views`. `None` for an empty part.
pub fn seen_one_way(
    from: &Mesh,
    to: &Bvh,
    samples: usize,
    cameras: &[Camera],
    views: &[RangeInclusive<u32>],
) -> Vec<Option<(Distances, f64)>> {
    let points = sample_triangles(from, samples);
    let seen = sights(from, &Bvh::new(from), cameras, &points, |_, _| None);
    let part = |range: &RangeInclusive<u32>| {
        let kept = points.iter().zip(&seen).filter(|(_, seen)| range.contains(&seen.cameras));
        let kept: Vec<Vec3> = kept.map(|((p, _), _)| *p).collect();
        let share = kept.len() as f64 / points.len().max(1) as f64;
        Some((distances(kept, to)?, share))
    };
    views.iter().map(part).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// Returns a 2 × 1 rectangle at height z, of two triangles.
    fn sheet(z: f32) -> Mesh {
        Mesh {
            positions: vec![
                Vec3::new(0.0, 0.0, z),
                Vec3::new(2.0, 0.0, z),
                Vec3::new(2.0, 1.0, z),
                Vec3::new(0.0, 1.0, z),
            ],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        }
    }

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

    #[test]
    fn a_sheet_under_another_is_not_seen_from_above() {
        // two sheets, the lower one twice as long: only its free half and the upper sheet are seen
        let mut mesh = sheet(0.0);
        mesh.positions.iter_mut().for_each(|p| p.x *= 2.0);
        let upper = sheet(1.0);
        mesh.positions.extend(&upper.positions);
        mesh.triangles.extend(upper.triangles.iter().map(|t| t.map(|i| i + 4)));
        let camera = Camera { position: DVec3::new(2.0, 0.5, 100.0), ..Camera::above(100, 100, 1000.0, 0.0) };
        let parts =
            seen_one_way(&mesh, &Bvh::new(&sheet(0.0)), 6000, &[camera], &[1..=u32::MAX, 0..=0, 2..=2]);
        let (d, share) = parts[0].unwrap();
        // area 2 · 2 + 2 = 6 … the lower sheet is 4 × 1, the upper 2 × 1: seen 2 + 2 of 6
        assert!((share - 4.0 / 6.0).abs() < 0.01, "{share}");
        // the upper sheet lies 1 above, the free half up to 2 beyond the end at x = 2: mean (1 + 1)
        // / 2
        assert!((d.mean - 1.0).abs() < 0.02 && (d.max - 2.0).abs() < 0.05, "{d:?}");
        // the invisible rest lies on the other surface; no point is counted twice
        let (hidden, rest) = parts[1].unwrap();
        assert!((rest - 2.0 / 6.0).abs() < 0.01 && hidden.mean < 0.01, "{hidden:?}");
        assert!(parts[2].is_none());
    }

    #[test]
    fn a_part_is_what_most_of_three_cameras_take_it_for() {
        // four cameras above the middle: all call the left half the first kind; of the right half
        // two say the second, which is no majority, but beyond x = 1.5 three do
        let camera =
            |x: f64| Camera { position: DVec3::new(x, 0.5, 100.0), ..Camera::above(100, 100, 4000.0, 0.0) };
        let cameras = [0.8, 0.9, 1.1, 1.2].map(camera);
        let x = |i: usize, [column, _]: [u32; 2]| {
            // 4000 / 100 = 40 pixels a unit around column 50
            cameras[i].position.x + (column as f64 + 0.5 - 50.0) / 40.0
        };
        let kind = |i: usize, pixel: [u32; 2]| match x(i, pixel) {
            x if x < 1.0 => Some(0),
            x if i < 2 || (i < 3 && x > 1.5) => Some(1),
            _ => None,
        };
        let [left, right] = kinds_one_way(&sheet(0.0), &Bvh::new(&sheet(-0.25)), 20_000, &cameras, kind);
        let ((left, below), (right, _)) = (left.unwrap(), right.unwrap());
        assert!((left.samples as f64 / 20_000.0 - 0.5).abs() < 0.02, "{left:?}");
        assert!((right.samples as f64 / 20_000.0 - 0.25).abs() < 0.02, "{right:?}");
        // the other sheet is inside, a quarter below
        assert_eq!((left.median, below), (0.25, -0.25));
        let two = kinds_one_way(&sheet(0.0), &Bvh::new(&sheet(-0.25)), 100, &cameras[..2], kind);
        assert_eq!(two, [None, None]);
    }
}
