//! Distances between surfaces, by what photographs show of them.

use glam::Vec3;
use rayon::prelude::*;
use std::ops::RangeInclusive;
use tiface_base::geom::distance::distances;
pub use tiface_base::geom::distance::{Distances, one_way, sample, sample_triangles};
use tiface_base::geom::{Bvh, Camera, Mesh, Ray};
use tiface_base::math::rank::nearest_rank;

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
    use tiface_base::geom::testing::sheet;

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
