//! Colors of surface points: their exact positions, the cameras that see them, and the field's
//! colors.

use super::lobes::fit_lobes;
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{Bvh, Camera, Mesh, Ray, SdfField};
use tiface_base::image::{linear_from_srgb, srgb_from_linear};

/// Cosine of the steepest angle at which a camera still shows the color of a point: 75 degrees.
const MIN_COSINE: f32 = 0.258_819;

/// Points of the surface with their unit normals.
pub struct SurfacePoints {
    /// Their positions.
    pub positions: Vec<Vec3>,
    /// Unit normals, pointing out.
    pub normals: Vec<Vec3>,
}

/// Moves points of the flat triangles onto the field's zero along their interpolated normals, at
/// most `reach` far, and gives them the field's normals. A point from where the field's zero is not
/// met stays as it is, with its interpolated normal.
pub fn snap_to_surface(flat: &SurfacePoints, reach: f32, field: &dyn SdfField) -> SurfacePoints {
    let n = flat.positions.len();
    let mut offset = vec![0f32; n];
    let mut start = vec![f32::INFINITY; n];
    let mut points = SurfacePoints { positions: flat.positions.clone(), normals: flat.normals.clone() };
    for step in 0..3 {
        let (values, gradients) = field.sdf_gradient(&points.positions);
        for i in 0..n {
            let (Some(&f), Some(&g)) = (values.get(i), gradients.get(i)) else { continue };
            let slope = g.dot(flat.normals[i]);
            let norm = g.length();
            if step == 0 {
                start[i] = f.abs();
            }
            if step == 2 {
                // accepted where the steps have closed in on the zero
                let near = norm > 1e-6 && f.abs() <= 0.1 * reach * norm && f.abs() <= start[i];
                if near && slope > 0.0 {
                    points.normals[i] = g / norm;
                } else {
                    points.positions[i] = flat.positions[i];
                }
            } else if f.is_finite() && slope > 0.25 * norm {
                offset[i] = (offset[i] - f / slope).clamp(-reach, reach);
                points.positions[i] = flat.positions[i] + offset[i] * flat.normals[i];
            }
        }
    }
    points
}

/// Visibility of points from the training cameras, occluded by the mesh.
pub struct Visibility<'a> {
    /// The cameras, in the mesh's coordinates.
    pub cameras: &'a [Camera],
    /// The mesh that hides.
    pub bvh: &'a Bvh,
    /// Offset of a line of sight from the flat triangle, so that it does not hit its own triangle.
    pub clearance: f32,
    /// Maximum number of cameras of a point: the ones that view it most directly.
    pub max_cameras: usize,
}

/// Number of substitute cameras for a point that none sees.
const FALLBACK_CAMERAS: usize = 3;

/// Directions to the cameras that see each point, all in one list.
#[derive(Default)]
pub struct ViewDirections {
    /// Whether any camera sees point `i`; else its directions are those of the cameras that come
    /// nearest to it.
    pub known: Vec<bool>,
    /// Directions of point `i`.
    pub counts: Vec<u32>,
    /// Unit directions towards them.
    pub directions: Vec<Vec3>,
    /// cos² of the angle to the normal.
    pub weights: Vec<f32>,
}

impl Visibility<'_> {
    /// Returns the cameras that see each point: in the frame, at most 75 degrees from its normal,
    /// nothing between.
    ///
    /// Angles are those to the mesh's own normals and lines of sight start from the mesh (`flat`):
    /// the field's normals are rough, and a camera must not come and go from texel to texel. A
    /// point that no camera sees is looked at from where the cameras stand that face it most: those
    /// are directions that the field has learned colors for, unlike the one straight at it. Without
    /// any camera, each point is viewed along its normal.
    pub fn directions(&self, points: &SurfacePoints, flat: &SurfacePoints) -> ViewDirections {
        let n = points.positions.len();
        if self.cameras.is_empty() {
            let directions = points.normals.clone();
            return ViewDirections {
                known: vec![false; n],
                counts: vec![1; n],
                directions,
                weights: vec![1.0; n],
            };
        }
        let each: Vec<(bool, Vec<(Vec3, f32)>)> = (0..n)
            .into_par_iter()
            .with_min_len(256)
            .map(|i| {
                let (p, from, normal) = (points.positions[i], flat.positions[i], flat.normals[i]);
                let sees = |camera| self.seen_from(camera, p, from, normal).map(|(d, cos)| (d, cos * cos));
                let mut list: Vec<_> = self.cameras.iter().filter_map(sees).collect();
                if list.len() > self.max_cameras {
                    list.sort_by(|a, b| b.1.total_cmp(&a.1));
                    list.truncate(self.max_cameras);
                }
                if !list.is_empty() {
                    return (true, list);
                }
                let facing = |camera: &Camera| facing(camera, p, normal);
                let mut nearest: Vec<(Vec3, f32)> = self.cameras.iter().map(facing).collect();
                nearest.sort_by(|a, b| b.1.total_cmp(&a.1));
                nearest.truncate(FALLBACK_CAMERAS);
                (false, nearest.into_iter().map(|(d, cos)| (d, cos.max(0.0).powi(2) + 1e-3)).collect())
            })
            .collect();
        let mut seen = ViewDirections::default();
        for (known, list) in each {
            seen.known.push(known);
            seen.counts.push(list.len() as u32);
            for (direction, weight) in list {
                seen.directions.push(direction);
                seen.weights.push(weight);
            }
        }
        seen
    }

    /// Returns the unit direction to a camera that sees a point, and its cosine to the normal. The
    /// line of sight starts `clearance` above `from`, the point's place on the mesh.
    pub fn seen_from(&self, camera: &Camera, p: Vec3, from: Vec3, normal: Vec3) -> Option<(Vec3, f32)> {
        let (direction, cosine) = facing(camera, p, normal);
        if cosine < MIN_COSINE || camera.project_inside(p).is_none() {
            return None;
        }
        let origin = from + self.clearance * normal;
        let way = camera.position.as_vec3() - origin;
        let ray = Ray { origin, direction: way.normalize_or_zero(), t_min: 0.0, t_max: way.length() };
        (!self.bvh.any_hit(&ray)).then_some((direction, cosine))
    }
}

/// Returns the unit direction from a point to a camera, and its cosine to the normal.
fn facing(camera: &Camera, p: Vec3, normal: Vec3) -> (Vec3, f32) {
    let direction = (camera.position.as_vec3() - p).normalize_or_zero();
    (direction, direction.dot(normal))
}

/// Colors of points: what the cameras that see them see on average, and how it changes between
/// them.
pub struct Shades {
    /// `[n]` linear color.
    pub linear: Vec<[f32; 3]>,
    /// `[n, functions]` lobes; empty without.
    pub lobes: Vec<[f32; 3]>,
    /// `[n]` whether any camera sees it.
    pub seen: Vec<bool>,
}

/// Shades points. `functions` lobes are fitted in the coordinates that `turned` rotates to, where
/// cameras see a point; 0 for none.
pub fn shade(
    points: &SurfacePoints,
    seen: ViewDirections,
    field: &dyn SdfField,
    functions: usize,
    turned: glam::Mat3,
) -> Shades {
    let n = points.positions.len();
    let away: Vec<Vec3> = seen.directions.iter().map(|d| -*d).collect();
    let colors = field.colors(&points.positions, &points.normals, &seen.counts, &away);
    let mut first = Vec::with_capacity(n + 1);
    first.push(0usize);
    seen.counts.iter().for_each(|&c| first.push(first[first.len() - 1] + c as usize));
    let mut linear = vec![[0f32; 3]; n];
    let mut fitted = vec![[0f32; 3]; n * functions];
    let one = |i: usize, linear: &mut [f32; 3], lobes: &mut [[f32; 3]]| {
        let own = first[i]..first[i + 1];
        let Some(colors) = colors.get(own.clone()) else { return };
        let weights = &seen.weights[own.clone()];
        let total: f32 = weights.iter().sum::<f32>().max(1e-12);
        for (c, w) in colors.iter().zip(weights) {
            (0..3).for_each(|k| linear[k] += w / total * linear_from_srgb(c[k]));
        }
        if !lobes.is_empty() && seen.known[i] {
            let base = linear.map(srgb_from_linear);
            let directions: Vec<Vec3> = seen.directions[own].iter().map(|d| turned * *d).collect();
            fit_lobes(base, &directions, weights, colors, lobes);
        }
    };
    if functions > 0 {
        linear
            .par_iter_mut()
            .zip(fitted.par_chunks_mut(functions))
            .enumerate()
            .with_min_len(256)
            .for_each(|(i, (c, l))| one(i, c, l));
    } else {
        linear.par_iter_mut().enumerate().with_min_len(256).for_each(|(i, c)| one(i, c, &mut []));
    }
    Shades { linear, lobes: fitted, seen: seen.known }
}

/// sRGB-coded colors of points of a mesh with their normals, as its texture would have them: the
/// mean over the cameras that see them. `reach` as in [`super::BakeConfig`].
pub fn seen_colors(
    mesh: &Mesh,
    positions: &[Vec3],
    normals: &[Vec3],
    field: &dyn SdfField,
    cameras: &[Camera],
    reach: f32,
) -> Vec<[f32; 3]> {
    let points = SurfacePoints { positions: positions.to_vec(), normals: normals.to_vec() };
    let bvh = Bvh::new(mesh);
    let seen = Visibility { cameras, bvh: &bvh, clearance: 0.5 * reach, max_cameras: usize::MAX }
        .directions(&points, &points);
    let shades = shade(&points, seen, field, 0, glam::Mat3::IDENTITY);
    shades.linear.into_iter().map(|c| c.map(srgb_from_linear)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::Painted;

    fn sphere(p: Vec3) -> f32 {
        p.length() - 0.5
    }

    fn flat(points: &[Vec3]) -> SurfacePoints {
        let normals = points.iter().map(|p| p.normalize()).collect();
        SurfacePoints { positions: points.to_vec(), normals }
    }

    #[test]
    fn points_move_onto_the_sphere_unless_it_is_out_of_reach() {
        let start = flat(&[Vec3::new(0.0, 0.0, 0.51), Vec3::new(0.0, 0.485, 0.0), Vec3::new(0.3, 0.0, 0.0)]);
        let moved = snap_to_surface(&start, 0.02, &sphere);
        assert!(moved.positions[0].distance(Vec3::Z * 0.5) < 1e-6);
        assert!(moved.positions[1].distance(Vec3::Y * 0.5) < 1e-6);
        // 0.2 deep, as a cap is: stays
        assert_eq!(moved.positions[2], start.positions[2]);
        assert_eq!(moved.normals[2], start.normals[2]);
    }

    #[test]
    fn a_camera_sees_what_faces_it_with_nothing_between() {
        // a square at z = 0.8 hides the points below x < 0
        let corner = |x: f32, y: f32| Vec3::new(x, y, 0.8);
        let hiding = Mesh {
            positions: vec![corner(-1.0, -1.0), corner(0.0, -1.0), corner(0.0, 1.0), corner(-1.0, 1.0)],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        };
        let bvh = Bvh::new(&hiding);
        let cameras = [Camera::above(100, 100, 100.0, 4.0)];
        let visibility = Visibility { cameras: &cameras, bvh: &bvh, clearance: 1e-3, max_cameras: 8 };
        let at = |x: f32, n: Vec3| (Vec3::new(x, 0.0, 0.0), n);
        let tilted = |degrees: f32| Vec3::new(degrees.to_radians().sin(), 0.0, degrees.to_radians().cos());
        // free, hidden, turned away, 80 degrees off, outside the frame (50 / 100 · 4 = 2)
        let all =
            [at(0.5, Vec3::Z), at(-0.5, Vec3::Z), at(0.5, -Vec3::Z), at(0.5, tilted(80.0)), at(2.1, Vec3::Z)];
        let (positions, normals) = all.into_iter().unzip();
        let points = SurfacePoints { positions, normals };
        // blue where x > 0: all that the one camera sees of the first point
        let colors = |p: &[Vec3], _: &[Vec3], _: &[u32], d: &[Vec3]| -> Vec<[f32; 3]> {
            assert_eq!(d.len(), p.len());
            p.iter().zip(d).map(|(p, d)| [0.0, -d.z, f32::from(p.x > 0.0)]).collect()
        };
        let learned = Painted { shape: sphere, paint: colors };
        let [first] = seen_colors(&hiding, &[at(0.5, Vec3::Z).0], &[Vec3::Z], &learned, &cameras, 2e-3)[..]
        else {
            panic!("one color a point")
        };
        assert!((first[1] - 4.0 / 16.25f32.sqrt()).abs() < 1e-3 && first[2] > 0.999, "{first:?}");
        let seen = visibility.directions(&points, &points);
        assert_eq!(seen.known, [true, false, false, false, false]);
        // the others are looked at from where the one camera stands
        assert_eq!(seen.counts, [1; 5]);
        // direction (−0.5, 0, 4) / √16.25: cos² = 16 / 16.25
        assert!((seen.weights[0] - 16.0 / 16.25).abs() < 1e-5);
    }

    #[test]
    fn colors_are_averaged_in_linear_light_by_weight() {
        // coded 0 and 1 with equal weights: linear 0.5, coded 0.735
        let colors = |_: &[Vec3], _: &[Vec3], _: &[u32], d: &[Vec3]| {
            d.iter().map(|d| [f32::from(d.x < 0.0), 0.5, 0.0]).collect::<Vec<_>>()
        };
        let learned = Painted { shape: sphere, paint: colors };
        let points = SurfacePoints { positions: vec![Vec3::Z; 2], normals: vec![Vec3::Z; 2] };
        let side = |x: f32| Vec3::new(x, 0.0, 1.0).normalize();
        let directions = vec![side(1.0), side(-1.0), side(1.0)];
        let seen = ViewDirections {
            known: vec![true, false],
            counts: vec![2, 1],
            directions,
            weights: vec![0.5; 3],
        };
        let shades = shade(&points, seen, &learned, 4, glam::Mat3::IDENTITY);
        assert!((shades.linear[0][0] - 0.5).abs() < 1e-6);
        assert!((shades.linear[0][1] - linear_from_srgb(0.5)).abs() < 1e-6);
        assert_eq!(shades.seen, [true, false]);
        // the second is looked at by a stand-in at +x: away from it x is negative
        assert_eq!(shades.linear[1][0], 1.0);
        // towards +x it is brighter than towards −x
        let towards = |x: f32| tiface_base::geom::sphharm::combine(&shades.lobes[..4], side(x).to_array())[0];
        assert!(towards(1.0) > 0.1 && towards(-1.0) < -0.3, "{} {}", towards(1.0), towards(-1.0));
        assert_eq!(shades.lobes[4..], [[0.0; 3]; 4]);
        let bvh = Bvh::new(&Mesh::default());
        let no_cameras = Visibility { cameras: &[], bvh: &bvh, clearance: 0.0, max_cameras: 8 };
        let straight = no_cameras.directions(&points, &points);
        let straight = shade(&points, straight, &learned, 0, glam::Mat3::IDENTITY);
        assert_eq!(straight.linear[0][0], 0.0);
    }
}
