//! Residuals: photograph minus rendered mesh in the training views, added to new views of the mesh.
//!
//! A ray gets, at the heaviest of its hits, the weighted mean `μ` of the residuals of the training
//! views that see its point from a similar direction, as in view-dependent texture mapping (Debevec
//! et al. 1996) and unstructured lumigraph rendering (Buehler et al. 2001). The weight of a view is
//!
//! ```text
//! w = c · v · g · (1 − u)² / (u + 0.1),    u = (1 − cos θ) / (1 − cos R)
//! ```
//!
//! with the confidence `c` of the view's pixel, its visibility `v`, the slant `g` of the surface,
//! and the angle `θ` between both directions, below the reach `R`. The colors of the ray's hits
//! change by `μ · S / (S + w₀) / (1 + σ² / σ₀²)`, `S` being the sum of the weights and `σ²` the
//! variance of the residuals: little where views are far or disagree. All factors are continuous,
//! so that nothing pops along a camera path, but where another hit of a ray through soft layers
//! becomes the heaviest. Views that are judged get nothing of a photograph from their own position.

use super::{RayHits, RenderedView};
use glam::{DVec3, Mat3, Vec2, Vec3};
use rayon::prelude::*;
use std::array::from_fn;
use tiface_base::geom::{Camera, bilinear_taps};
use tiface_base::image::{Gray, OPAQUE_ALPHA, Photo, eroded};

/// Residuals are stored in bytes of 1/512 around 128: up to a quarter of the range of colors.
const STEPS: f32 = 512.0;

/// Distance over which confidence grows from nothing at soft pixels, outlines and jumps of depth,
/// in pixels.
const RAMP_PX: usize = 2;

/// Depth change over one pixel, in pixel footprints, from which on it is an outline: tan 79°.
const JUMP: f32 = 5.0;

/// Depth behind the nearest surface of the view, in pixel footprints, up to which a point is seen
/// by it.
const DEPTH_TOLERANCE: f32 = 3.0;

/// Coverage from which on a rendered pixel shows the mesh alone.
const COVERED: f32 = 0.98;

/// Cosines between surface normal and view direction at which `g` begins and ends to grow.
const SLANT: (f32, f32) = (0.1, 0.4);

/// Number of neighbors that a training view has within the reach.
const NEIGHBORS: usize = 4;

/// Range of the reach, degrees.
const REACH_DEG: (f32, f32) = (8.0, 45.0);

/// The sum of weights `w₀` at which half of a residual is added.
const HALF_WEIGHT: f32 = 0.5;

/// Root of the variance `σ₀²` at which half of a residual is added.
const HALF_DEVIATION: f32 = 0.05;

/// The residuals of all training views.
pub struct Residuals {
    views: Vec<ResidualView>,
    /// `1 − cos R`
    reach: f32,
    /// Whether a view gets no residuals of the photograph from its own position: it could not be
    /// judged by this photograph.
    leaves_out_own: bool,
}

/// A training photograph and the mesh as its camera sees it.
pub struct ResidualSource<'a> {
    /// The camera, in the mesh's coordinates.
    pub camera: &'a Camera,
    /// The photograph.
    pub photo: &'a Photo,
    /// Soft alpha of the head, same size; `None`: all is head.
    pub mask: Option<&'a Gray>,
    /// Usable pixels (non-zero), same size; `None`: all are.
    pub valid: Option<&'a Gray>,
    /// The rendered mesh, with depth in the mesh's units.
    pub view: RenderedView,
}

/// One pixel of a training view.
#[derive(Clone, Copy, Default)]
struct ResidualPixel {
    /// Residual of each channel, in 1/512 from 128.
    residual: [u8; 3],
    /// Confidence, 0..=255.
    confidence: u8,
    /// Distance along the viewing axis.
    depth: f32,
}

/// The part of a training view where the mesh can be compared with the photograph.
pub struct ResidualView {
    camera: Camera,
    position: Vec3,
    /// From the mesh's coordinates, relative to the position, to the camera's: right, up,
    /// backwards.
    rotation: Mat3,
    left: usize,
    top: usize,
    /// Pixels per row.
    width: usize,
    pixels: Vec<ResidualPixel>,
}

impl Residuals {
    /// Returns the residuals of these views of a mesh around `center`; `None` without views. With
    /// `leaves_out_own`, a training view adds nothing to a view from its own position.
    pub fn new(views: Vec<ResidualView>, center: Vec3, leaves_out_own: bool) -> Option<Residuals> {
        let directions: Vec<Vec3> = views.iter().map(|v| (v.position - center).normalize_or_zero()).collect();
        let mut reaches: Vec<f32> = directions
            .iter()
            .map(|a| {
                let mut angles: Vec<f32> = directions.iter().map(|b| 1.0 - a.dot(*b)).collect();
                angles.sort_unstable_by(f32::total_cmp);
                angles[NEIGHBORS.min(angles.len() - 1)] // the first is the view itself
            })
            .collect();
        reaches.sort_unstable_by(f32::total_cmp);
        let limits = [REACH_DEG.0, REACH_DEG.1].map(|degrees| 1.0 - degrees.to_radians().cos());
        let reach = reaches.get(reaches.len() / 2)?.clamp(limits[0], limits[1]);
        Some(Residuals { views, reach, leaves_out_own })
    }

    /// Adds residuals to the sRGB-coded `colors` of hits, `[n]`. The hits of a ray get what the
    /// heaviest of them has: most lie close together, and looking up each took three times as long.
    ///
    /// # Panics
    ///
    /// Panics if there are fewer colors than hits.
    pub fn add(&self, hits: &RayHits, camera: &Camera, colors: &mut [[f32; 3]]) {
        let counts = |view: &&ResidualView| {
            !self.leaves_out_own || !is_same_position(view.camera.position, camera.position)
        };
        let views: Vec<&ResidualView> = self.views.iter().filter(counts).collect();
        let views: Vec<ViewBlock> = views.chunks(LANES).map(ViewBlock::new).collect();
        for ray in hits.rays() {
            let heavier = |a: &usize, b: &usize| hits.pixels[*a].1.total_cmp(&hits.pixels[*b].1);
            let Some(i) = ray.clone().max_by(heavier) else { continue };
            let change = self.at(&views, hits.points[i], hits.normals[i], hits.directions[i]);
            for color in &mut colors[ray] {
                *color = (Vec3::from(*color) + change).clamp(Vec3::ZERO, Vec3::ONE).to_array();
            }
        }
    }

    /// Returns the change of color at a point of the surface that is seen along a direction.
    fn at(&self, views: &[ViewBlock], point: Vec3, normal: Vec3, direction: Vec3) -> Vec3 {
        let least = 1.0 - self.reach; // below a right angle
        let (mut sum, mut mean, mut square) = (0.0, Vec3::ZERO, 0.0);
        // most views are out of reach
        let near = views.iter().flat_map(|block| {
            let within = block.within(least, point, direction);
            block.views.iter().zip(within).filter(|(_, within)| *within).map(|(view, _)| view)
        });
        for view in near {
            let to_view = view.position - point;
            let distance = to_view.length();
            let u = (1.0 + to_view.dot(direction) / distance) / self.reach;
            let slant = ((normal.dot(to_view) / distance - SLANT.0) / (SLANT.1 - SLANT.0)).clamp(0.0, 1.0);
            if u >= 1.0 || slant == 0.0 {
                continue;
            }
            let (residual, seen) = view.look_up(point);
            let w = seen * slant * (1.0 - u) * (1.0 - u) / (u.max(0.0) + 0.1);
            sum += w;
            mean += w * residual;
            square += w * residual.length_squared();
        }
        if sum == 0.0 {
            return Vec3::ZERO;
        }
        mean /= sum;
        let variance = (square / sum - mean.length_squared()).max(0.0) / 3.0;
        mean * sum / (sum + HALF_WEIGHT) / (1.0 + variance / (HALF_DEVIATION * HALF_DEVIATION))
    }
}

/// Number of views whose reach is tested together.
const LANES: usize = 8;

/// Some views, and their positions as the test of reach reads them.
struct ViewBlock<'a> {
    /// At most [`LANES`].
    views: &'a [&'a ResidualView],
    /// `[axis][view]`, NaN beyond the last.
    position: [[f32; LANES]; 3],
}

impl<'a> ViewBlock<'a> {
    fn new(views: &'a [&'a ResidualView]) -> ViewBlock<'a> {
        let at = |axis: usize, view: usize| views.get(view).map_or(f32::NAN, |view| view.position[axis]);
        ViewBlock { views, position: from_fn(|axis| from_fn(|view| at(axis, view))) }
    }

    /// Returns for which views the cosine between the direction to a point and `direction` is above
    /// `least`, which is not negative.
    #[inline]
    fn within(&self, least: f32, point: Vec3, direction: Vec3) -> [bool; LANES] {
        let [x, y, z] = &self.position;
        let mut within = [false; LANES];
        for i in 0..LANES {
            let d = [x[i] - point.x, y[i] - point.y, z[i] - point.z];
            let along = -(d[0] * direction.x + d[1] * direction.y + d[2] * direction.z);
            let square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            within[i] = (along > 0.0) & (along * along > least * least * square);
        }
        within
    }
}

/// Returns whether two cameras stand at the same place, but for rounding.
fn is_same_position(a: DVec3, b: DVec3) -> bool {
    a.distance(b) < 1e-6 * (1.0 + a.length())
}

impl ResidualView {
    /// Returns the residuals of a view; `None` if no pixel shows the mesh alone.
    pub fn new(source: ResidualSource) -> Option<ResidualView> {
        let ResidualSource { camera, photo, mask, valid, view } = source;
        let (w, h) = (photo.width as usize, photo.height as usize);
        let depth = &view.depth.data;
        // a pixel's footprint is depth / focal length
        let jump = JUMP / camera.fx.abs() as f32;
        let joins =
            |i: usize, next: usize| (depth[i] - depth[next]).abs() <= jump * depth[i].min(depth[next]);
        let compares = |i: usize| {
            let (x, y) = (i % w, i / w);
            mask.is_none_or(|m| m.values[i] >= OPAQUE_ALPHA)
                && valid.is_none_or(|v| v.values[i] > 0)
                && view.color.data[4 * i + 3] >= COVERED
                && depth[i] > 0.0
                && (x + 1 == w || joins(i, i + 1))
                && (y + 1 == h || joins(i, i + w))
                && (x == 0 || joins(i, i - 1))
                && (y == 0 || joins(i, i - w))
        };
        let inner = eroded((0..w * h).into_par_iter().map(compares).collect(), w, h, RAMP_PX);
        let confidence = means(&inner, w, h, RAMP_PX);
        let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
        for i in (0..w * h).filter(|&i| confidence[i] > 0) {
            // with a pixel around, where confidence falls to nothing
            for (k, (at, n)) in [(i % w, w), (i / w, h)].into_iter().enumerate() {
                (low[k], high[k]) = (low[k].min(at.saturating_sub(1)), high[k].max((at + 1).min(n - 1)));
            }
        }
        if high[0] < low[0] {
            return None;
        }
        let pixel = |i: usize| {
            let rendered = &view.color.data[4 * i..4 * i + 3];
            let residual = |k: usize| f32::from(photo.rgb[i][k]) / 255.0 - rendered[k];
            let byte = |k: usize| (residual(k) * STEPS + 128.5).clamp(0.0, 255.0) as u8;
            ResidualPixel { residual: [0, 1, 2].map(byte), confidence: confidence[i], depth: depth[i] }
        };
        let rows = (low[1]..=high[1]).flat_map(|y| (low[0]..=high[0]).map(move |x| y * w + x));
        Some(ResidualView {
            camera: camera.clone(),
            position: camera.position.as_vec3(),
            rotation: camera.rotation.transpose().as_mat3(),
            left: low[0],
            top: low[1],
            width: high[0] + 1 - low[0],
            pixels: rows.map(pixel).collect(),
        })
    }

    /// Projects a point to the photograph, like [`Camera::project`], in f32 where there is no
    /// distortion.
    fn project(&self, point: Vec3) -> Option<(Vec2, f32)> {
        let Camera { fx, fy, cx, cy, distortion, .. } = &self.camera;
        if !distortion.is_none() {
            return self.camera.project(point);
        }
        let p = self.rotation * (point - self.position);
        let slopes = Vec2::new(p.x, -p.y) / -p.z;
        let pixel = Vec2::new(*fx as f32, *fy as f32) * slopes + Vec2::new(*cx as f32, *cy as f32);
        (p.z < -1e-9).then_some((pixel, -p.z))
    }

    /// Returns the residual at a point, between pixels, and how well the view sees the point,
    /// 0..=1.
    fn look_up(&self, point: Vec3) -> (Vec3, f32) {
        const NOTHING: (Vec3, f32) = (Vec3::ZERO, 0.0);
        let Some((pixel, depth)) = self.project(point) else { return NOTHING };
        let size = [self.width, self.pixels.len() / self.width].map(|n| n as u32);
        let at = pixel - Vec2::new(self.left as f32 + 0.5, self.top as f32 + 0.5);
        // not finite where a lens has no picture of the point
        if !(at.min_element() >= 0.0 && at.x <= (size[0] - 1) as f32 && at.y <= (size[1] - 1) as f32) {
            return NOTHING;
        }
        let (mut residual, mut confidence, mut surface) = (Vec3::ZERO, 0.0, 0f32);
        for (i, share) in bilinear_taps(at, size) {
            let pixel = self.pixels[i as usize];
            let weight = share * f32::from(pixel.confidence) / 255.0;
            residual += weight * (Vec3::from(pixel.residual.map(f32::from)) - 128.0);
            confidence += weight;
            surface = surface.max(pixel.depth);
        }
        if confidence == 0.0 {
            return NOTHING;
        }
        let tolerance = DEPTH_TOLERANCE * depth / self.camera.fx.abs() as f32;
        let visibility = (2.0 - (depth - surface) / tolerance).clamp(0.0, 1.0);
        (residual / (STEPS * confidence), confidence * visibility)
    }
}

/// Returns the share of set pixels in the square of half edge `margin` around each pixel, in
/// 255ths.
fn means(set: &[bool], w: usize, h: usize, margin: usize) -> Vec<u8> {
    let window = |at: usize, n: usize| at.saturating_sub(margin)..(at + margin + 1).min(n);
    let row = |i: usize| window(i % w, w).filter(|x| set[i / w * w + x]).count();
    let rows: Vec<usize> = (0..w * h).map(row).collect();
    let side = 2 * margin + 1;
    let column =
        |i: usize| window(i / w, h).map(|y| rows[y * w + i % w]).sum::<usize>() * 255 / (side * side);
    (0..w * h).map(|i| column(i) as u8).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::{RaycastOptions, raycast};
    use tiface_base::geom::{Bvh, Mesh};
    use tiface_base::image::Image;

    const GRAY: [f32; 3] = [100.0 / 255.0; 3];

    /// A square at `z` that faces up.
    fn square(z: f32, half: f32) -> Mesh {
        let corners = [(-half, -half), (half, -half), (half, half), (-half, half)];
        Mesh {
            positions: corners.map(|(x, y)| Vec3::new(x, y, z)).to_vec(),
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        }
    }

    /// A camera that looks down from four units above, moved along x: a pixel is 0.04 wide.
    fn camera(x: f64) -> Camera {
        let above = Camera::above(60, 60, 100.0, 4.0);
        Camera { position: DVec3::new(x, 0.0, 4.0), ..above }
    }

    fn gray(hits: &RayHits) -> Vec<[f32; 3]> {
        vec![GRAY; hits.points.len()]
    }

    /// Returns a photograph of the plane z = 0 that shows a color at each of its points.
    fn photo(camera: &Camera, color: impl Fn(Vec3) -> u8) -> Photo {
        let pixel = |i: u32| {
            let ray = camera.ray(Vec2::new((i % 60) as f32 + 0.5, (i / 60) as f32 + 0.5)).unwrap();
            let point = ray.origin - ray.direction * (ray.origin.z / ray.direction.z);
            [color(point); 3]
        };
        Photo { width: 60, height: 60, rgb: (0..3600).map(pixel).collect(), alpha: None }
    }

    /// A square of half edge 0.3 that is brighter than the mesh by 40.
    fn patch(point: Vec3) -> u8 {
        if point.x.abs().max(point.y.abs()) < 0.3 { 140 } else { 100 }
    }

    /// Returns the residuals of photographs of a mesh.
    fn residuals(
        mesh: &Mesh,
        cameras: &[Camera],
        photos: &[Photo],
        mask: Option<&Gray>,
    ) -> Option<Residuals> {
        let (bvh, options) = (Bvh::new(mesh), RaycastOptions { samples: 1, ..RaycastOptions::default() });
        let views = cameras.iter().zip(photos).filter_map(|(camera, photo)| {
            let view = raycast(&bvh, mesh, None, camera, &options, gray);
            ResidualView::new(ResidualSource { camera, photo, mask, valid: None, view })
        });
        Residuals::new(views.collect(), Vec3::ZERO, true)
    }

    fn view(residuals: &Residuals, mesh: &Mesh, camera: &Camera) -> Image {
        let options = RaycastOptions::default();
        let color = |hits: &RayHits| {
            let mut colors = gray(hits);
            residuals.add(hits, camera, &mut colors);
            colors
        };
        raycast(&Bvh::new(mesh), mesh, None, camera, &options, color).color
    }

    #[test]
    fn what_two_photographs_show_is_seen_from_between() {
        let (mesh, cameras) = (square(0.0, 3.0), [camera(-0.4), camera(0.4)]);
        let photos = cameras.each_ref().map(|c| photo(c, patch));
        let residuals = residuals(&mesh, &cameras, &photos, None).unwrap();
        let seen = view(&residuals, &mesh, &camera(0.0));
        // u = 1 / 4 at the middle of both, with a reach of twice the angle between them: each
        // weighs (3/4)² / 0.35
        let sum = 2.0 * 0.5625 / 0.35;
        let expected = GRAY[0] + 40.0 / 255.0 * sum / (sum + HALF_WEIGHT);
        let middle = seen.pixel(30, 30)[0];
        assert!((middle - expected).abs() < 0.01, "{middle} for {expected}");
        // nothing changes where photographs show what the mesh shows: within half of a stored step
        assert!((seen.pixel(8, 30)[0] - GRAY[0]).abs() < 0.5 / STEPS);
    }

    #[test]
    fn a_photograph_adds_nothing_to_the_view_from_its_own_position() {
        let (mesh, cameras) = (square(0.0, 3.0), [camera(0.0)]);
        let photos = cameras.each_ref().map(|c| photo(c, patch));
        let residuals = residuals(&mesh, &cameras, &photos, None).unwrap();
        assert_eq!(view(&residuals, &mesh, &camera(0.0)).pixel(30, 30)[0], GRAY[0]);
        assert!(view(&residuals, &mesh, &camera(0.01)).pixel(30, 30)[0] > GRAY[0] + 0.1);
        // along a camera path it does, so that no frame differs from its neighbors
        let residuals = Residuals { leaves_out_own: false, ..residuals };
        assert!(view(&residuals, &mesh, &camera(0.0)).pixel(30, 30)[0] > GRAY[0] + 0.1);
    }

    #[test]
    fn the_hits_of_a_ray_get_what_the_heaviest_has() {
        let (mesh, cameras) = (square(0.0, 3.0), [camera(-0.4), camera(0.4)]);
        let photos = cameras.each_ref().map(|c| photo(c, patch));
        let residuals = residuals(&mesh, &cameras, &photos, None).unwrap();
        let changes = |hits: &[(Vec3, usize, f32)], directions: &[Vec3]| {
            let hits = RayHits {
                points: hits.iter().map(|hit| hit.0).collect(),
                normals: vec![Vec3::Z; hits.len()],
                directions: directions.to_vec(),
                hits: Vec::new(),
                pixels: hits.iter().map(|hit| (hit.1, hit.2)).collect(),
            };
            let mut colors = gray(&hits);
            residuals.add(&hits, &camera(0.0), &mut colors);
            colors
        };
        let (within, beyond) = (Vec3::ZERO, Vec3::new(1.5, 0.0, 0.0));
        let (down, aside) = (-Vec3::Z, Vec3::new(0.01, 0.0, -1.0).normalize());
        let [bright, plain] = [within, beyond].map(|point| changes(&[(point, 7, 1.0)], &[down])[0]);
        assert!(bright[0] > plain[0] + 0.1);
        let (heavy, light) = ((within, 7, 0.6), (beyond, 7, 0.4));
        assert_eq!(changes(&[light, heavy], &[down, down]), [bright, bright]);
        // rays differ in pixel or direction
        assert_eq!(changes(&[light, (within, 8, 0.6)], &[down, down]), [plain, bright]);
        let both = changes(&[light, heavy, light], &[down, aside, aside]);
        assert!(both[0] == plain && both[1] == both[2] && both[1][0] > plain[0] + 0.1);
    }

    #[test]
    fn what_photographs_do_not_agree_on_is_hardly_added() {
        let (mesh, cameras) = (square(0.0, 3.0), [camera(-0.4), camera(0.4)]);
        let photos = [photo(&cameras[0], patch), photo(&cameras[1], |_| 100)];
        let residuals = residuals(&mesh, &cameras, &photos, None).unwrap();
        // the mean is 20 / 255 and as large as the deviation: less than a third of it is left
        let change = view(&residuals, &mesh, &camera(0.0)).pixel(30, 30)[0] - GRAY[0];
        assert!((0.01..0.3 * 20.0 / 255.0).contains(&change), "{change}");
    }

    #[test]
    fn hidden_and_soft_points_get_nothing() {
        // a small square a unit above the plane hides its middle from both cameras
        let mut mesh = square(0.0, 3.0);
        let cover = square(1.0, 0.4);
        mesh.positions.extend(cover.positions);
        mesh.triangles.extend([[4, 5, 6], [4, 6, 7]]);
        let cameras = [camera(-0.1), camera(0.1)];
        let photos = cameras.each_ref().map(|c| photo(c, patch));
        let open = square(0.0, 3.0);
        let hidden = residuals(&mesh, &cameras, &photos, None).unwrap();
        assert_eq!(view(&hidden, &open, &camera(0.0)).pixel(30, 30)[0], GRAY[0]);
        // masks that are soft everywhere leave nothing to compare
        let soft = Gray { width: 60, height: 60, values: vec![OPAQUE_ALPHA - 1; 3600] };
        assert!(residuals(&open, &cameras, &photos, Some(&soft)).is_none());
    }

    #[test]
    fn nothing_pops_along_a_camera_path() {
        let (mesh, cameras) = (square(0.0, 3.0), [-0.8, -0.3, 0.0, 0.5, 0.9].map(camera));
        let waves = |k: f32| move |p: Vec3| (120.0 + 20.0 * (7.0 * p.x + k).sin()) as u8;
        let photos: Vec<Photo> =
            cameras.iter().zip(0u8..).map(|(c, k)| photo(c, waves(f32::from(k)))).collect();
        let residuals = residuals(&mesh, &cameras, &photos, None).unwrap();
        // blocks of one view and of four count like one of five
        let all: Vec<&ResidualView> = residuals.views.iter().collect();
        let parts = [&all[..1], &all[1..]].map(ViewBlock::new);
        let all = [ViewBlock::new(&all)];
        let change = |x: f64| {
            let direction = (Vec3::ZERO - camera(x).position.as_vec3()).normalize();
            let change = residuals.at(&all, Vec3::ZERO, Vec3::Z, direction);
            assert_eq!(residuals.at(&parts, Vec3::ZERO, Vec3::Z, direction), change);
            change.x
        };
        let path: Vec<f32> = (0..=4000).map(|i| change(-2.0 + i as f64 * 0.001)).collect();
        let steps = path.windows(2).map(|w| (w[1] - w[0]).abs());
        let (low, high) = path.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        // no step of a thousandth of a unit is more than a fiftieth of the whole change
        assert!(high - low > 0.05 && steps.fold(0.0, f32::max) < 0.02 * (high - low));
    }
}
