//! Search for surface points that several photographs agree on, starting from the current field.
//!
//! Rays are intersected with the field's zero set. Points spread over it are moved along their
//! normals until all photographs in which they are visible match ([`tiface_kernels::cpu::stereo`]).
//! Hair is excluded, because stereo places its strands some millimeters inside its outline.

use super::occupancy::Occupancy;
use crate::config::iface::IfaceConfig;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Camera, Ray};
use tiface_base::image::eroded;
use tiface_base::math::rank::median;
use tiface_capture::LoadedView;
use tiface_kernels::cpu::mlp::Weights;
use tiface_kernels::cpu::sdf::{self, FieldShape};
use tiface_kernels::cpu::stereo::{self, StereoPoint, StereoView, Surfel};

/// Distance between neighboring rays, pixels.
const STRIDE: usize = 4;

/// Softest surface that is searched: logarithm of the sharpness relative to the sharpest, here a
/// half.
const SOFTEST: f32 = -std::f32::consts::LN_2;

/// A point that the surface should pass through, in field coordinates; in checkpoints and on GPUs a
/// row of its numbers.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct SurfacePoint {
    /// Position in field coordinates.
    pub position: [f32; 3],
    /// Length of a pixel at the point.
    pub footprint: f32,
    /// Weight in the loss, at most 1.
    pub weight: f32,
}

/// The field on the host.
pub struct HostField<'a> {
    /// Its shape.
    pub shape: &'a FieldShape,
    /// Hash table.
    pub table: &'a [[f32; 2]],
    /// Network weights.
    pub weights: &'a Weights,
}

impl HostField<'_> {
    /// Returns the distances at points in field coordinates.
    fn values(&self, x: &[[f32; 3]]) -> Vec<f32> {
        sdf::values(self.shape, self.table, self.weights, x)
    }

    /// Moves points in field coordinates onto the nearby zero set, and returns them with their unit
    /// normals.
    fn project(&self, mut x: Vec<[f32; 3]>) -> Vec<(Vec3, Option<Vec3>)> {
        /// Gradients have lengths of about one, and points start within a pixel or two.
        const ROUNDS: usize = 2;
        for _ in 0..ROUNDS {
            let gradients = sdf::gradients(self.shape, self.table, self.weights, &x);
            for (x, (f, n)) in x.iter_mut().zip(gradients) {
                let square: f32 = n.iter().map(|n| n * n).sum();
                (0..3).for_each(|a| x[a] -= f * n[a] / square.max(0.25));
            }
        }
        let gradients = sdf::gradients(self.shape, self.table, self.weights, &x);
        x.into_iter()
            .zip(gradients)
            .map(|(x, (_, n))| (Vec3::from(x), Vec3::from(n).try_normalize()))
            .collect()
    }
}

/// Returns the depths of the zero set in each view, and points spread over it, in scene units.
fn surface(
    views: &[LoadedView],
    config: &IfaceConfig,
    field: &HostField,
    occupancy: &Occupancy,
) -> (Vec<StereoView>, Vec<Surfel>) {
    let (stereo_views, found): (Vec<StereoView>, Vec<Vec<[f32; 3]>>) =
        views.iter().map(|view| first_crossings(view, config, field, occupancy)).unzip();
    let radius = config.radius;
    let mut spread = Vec::new();
    for (v, x) in found.into_iter().enumerate() {
        let soft = sdf::softness(field.shape, field.table, field.weights, &x);
        let hard: Vec<[f32; 3]> =
            x.into_iter().zip(soft).filter(|(_, soft)| *soft >= SOFTEST).map(|(x, _)| x).collect();
        let normals = sdf::gradients(field.shape, field.table, field.weights, &hard);
        let own = |(x, (_, n)): (&[f32; 3], &(f32, [f32; 3]))| {
            let normal = Vec3::from(*n).try_normalize()?;
            let surfel = Surfel { position: Vec3::from(*x) / radius, normal };
            let footprint = stereo::owned_footprint(&stereo_views, v, &surfel)?;
            // Each point becomes four, two pixels apart.
            let axis = normal.any_orthonormal_vector();
            let other = normal.cross(axis);
            let at =
                |a: f32, b: f32| ((surfel.position + footprint * (a * axis + b * other)) * radius).to_array();
            Some([at(-1.0, -1.0), at(1.0, -1.0), at(-1.0, 1.0), at(1.0, 1.0)])
        };
        let four: Vec<[[f32; 3]; 4]> = hard.par_iter().zip(&normals).filter_map(own).collect();
        spread.extend(four.into_flattened());
    }
    let surfels = field
        .project(spread)
        .into_iter()
        .filter_map(|(x, normal)| Some(Surfel { position: x / radius, normal: normal? }));
    (stereo_views, surfels.collect())
}

/// Returns a view for stereo with its depths, and the first crossings of its rays with the zero
/// set, in field coordinates.
fn first_crossings(
    view: &LoadedView,
    config: &IfaceConfig,
    field: &HostField,
    occupancy: &Occupancy,
) -> (StereoView, Vec<[f32; 3]>) {
    /// Margin of usable pixels: a patch of this half width around one lies in the head.
    const MARGIN: usize = 5;
    /// Samples of a ray that are evaluated together.
    const AHEAD: usize = 6;
    let Reduced { camera, gray, fully_head, partly_head } = Reduced::new(view);
    let (w, h) = (camera.width as usize, camera.height as usize);
    let usable = eroded(fully_head, w, h, MARGIN);
    let (columns, rows) = (w.div_ceil(STRIDE), h.div_ceil(STRIDE));
    let middle = |i: usize| {
        ((i % columns * STRIDE + STRIDE / 2).min(w - 1), (i / columns * STRIDE + STRIDE / 2).min(h - 1))
    };
    let pixels: Vec<(usize, Ray)> = (0..columns * rows)
        .into_par_iter()
        .filter_map(|i| {
            let (x, y) = middle(i);
            if !partly_head[y * w + x] {
                return None;
            }
            let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))?;
            Some((i, ray.scaled(config.radius)))
        })
        .collect();
    let rays: Vec<Ray> = pixels.iter().map(|p| p.1).collect();
    let samples = occupancy.march(config, config.min_step, &rays, &[]);
    let at = |r: usize, t: f32| std::array::from_fn(|a| rays[r].origin[a] + t * rays[r].direction[a]);
    // A crossing is the first step from outside to inside. Each round evaluates the next few
    // samples of every open ray.
    let mut crossing = vec![None; rays.len()];
    let mut open_rays: Vec<(usize, usize, f32)> =
        (0..rays.len()).map(|r| (r, samples.offsets[r] as usize, f32::NAN)).collect();
    while !open_rays.is_empty() {
        let piece = |&(r, k, _): &(usize, usize, f32)| k..(k + AHEAD).min(samples.offsets[r + 1] as usize);
        let x: Vec<[f32; 3]> = open_rays
            .iter()
            .flat_map(|g| piece(g).map(|k| at(g.0, samples.t[k])).collect::<Vec<_>>())
            .collect();
        let mut f = field.values(&x).into_iter();
        open_rays.retain_mut(|g| {
            let span = piece(g);
            let mut before = g.2;
            for (k, f) in span.clone().zip(f.by_ref().take(span.len()).collect::<Vec<_>>()) {
                if before > 0.0 && f <= 0.0 && crossing[g.0].is_none() {
                    let (near, far) = (samples.t[k - 1], samples.t[k]);
                    crossing[g.0] = Some(near + (far - near) * before / (before - f));
                }
                before = f;
            }
            (g.1, g.2) = (span.end, before);
            crossing[g.0].is_none() && span.end < samples.offsets[g.0 + 1] as usize
        });
    }
    let mut depth = vec![f32::INFINITY; columns * rows];
    let mut found = Vec::new();
    for (r, t) in crossing.into_iter().enumerate() {
        let (i, Some(t)) = (pixels[r].0, t) else { continue };
        let x = at(r, t);
        let Some((_, z)) = camera.project(Vec3::from(x) / config.radius) else { continue };
        depth[i] = z;
        let (column, row) = middle(i);
        if usable[row * w + column] {
            found.push(x);
        }
    }
    (StereoView { camera, gray, usable, cell: STRIDE, depth }, found)
}

/// A photograph reduced to the resolution of the stereo search.
struct Reduced {
    camera: Camera,
    /// Brightness, white is 1.
    gray: Vec<f32>,
    /// Per pixel: whether all source pixels are head and valid.
    fully_head: Vec<bool>,
    /// Per pixel: whether any source pixel is head with an alpha of at least one half.
    partly_head: Vec<bool>,
}

impl Reduced {
    fn new(view: &LoadedView) -> Reduced {
        /// Longest side in pixels, up to twice: a surface that is half trained is right to a few of
        /// these, and a tenth of one suffices.
        const SIDE: u32 = 512;
        let (w, h) = (view.camera.width, view.camera.height);
        let factor = (w.max(h) / SIDE).clamp(1, w.min(h).max(1));
        let (width, height) = (w / factor, h / factor);
        let camera = view.camera.part(0, 0, width * factor, height * factor).resized(width, height);
        let head = |p: usize| view.mask.as_ref().map_or(255, |m| m.values[p]);
        let valid = |p: usize| view.valid.as_ref().is_none_or(|m| m.values[p] != 0);
        let luma = |[r, g, b]: [u8; 3]| (0.299 * r as f32 + 0.587 * g as f32 + 0.114 * b as f32) / 255.0;
        let (k, across) = (factor as usize, width as usize);
        let one = |i: usize| {
            let (x, y) = (i % across * k, i / across * k);
            let (mut gray, mut fully_head, mut partly_head) = (0.0, true, false);
            for p in (0..k * k).map(|j| (y + j / k) * w as usize + x + j % k) {
                gray += luma(view.photo.rgb[p]);
                fully_head &= head(p) == 255 && valid(p);
                partly_head |= head(p) >= 128;
            }
            (gray / (k * k) as f32, (fully_head, partly_head))
        };
        let pixels = across * height as usize;
        let (gray, (fully_head, partly_head)) =
            (0..pixels).into_par_iter().with_min_len(4096).map(one).unzip();
        Reduced { camera, gray, fully_head, partly_head }
    }
}

/// Returns points that photographs agree on. The result does not depend on the number of threads.
pub fn points(
    views: &[LoadedView],
    config: &IfaceConfig,
    field: &HostField,
    occupancy: &Occupancy,
) -> Vec<SurfacePoint> {
    let (stereo_views, surfels) = surface(views, config, field, occupancy);
    let found = stereo::matches(&stereo_views, &surfels);
    // The median is robust against a few photographs taken from close up.
    let mut footprints: Vec<f32> = found.iter().map(|p| p.footprint).collect();
    let Some(footprint) = median(&mut footprints, f32::total_cmp) else { return Vec::new() };
    let point = |p: StereoPoint| SurfacePoint {
        position: (p.position * config.radius).to_array(),
        footprint: p.footprint * config.radius,
        weight: 1.0 / (1.0 + p.sigma * p.sigma),
    };
    stereo::confirmed(&found, 2.0 * footprint).into_iter().map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::image::{Gray, Photo};

    #[test]
    fn a_large_photograph_is_averaged_and_a_pixel_is_head_where_all_of_it_is() {
        // 1031 / 512: two by two; the last column is left out
        let (w, h) = (1031, 6);
        let mut view = LoadedView {
            camera: Camera::above(w, h, 500.0, 3.0),
            photo: Photo { width: w, height: h, rgb: vec![[51; 3]; 1031 * 6], alpha: None },
            mask: Some(Gray { width: w, height: h, values: vec![255; 1031 * 6] }),
            valid: Some(Gray { width: w, height: h, values: vec![255; 1031 * 6] }),
            region: None,
        };
        view.photo.rgb[1031 + 3] = [255; 3]; // one of four of pixel (1, 0)
        view.mask.as_mut().unwrap().values[1031 * 2] = 254; // of pixel (0, 1)
        view.mask.as_mut().unwrap().values[..2].fill(0); // half of pixel (0, 0)
        view.valid.as_mut().unwrap().values[1031 * 5 + 1029] = 0; // of pixel (514, 2)
        let small = Reduced::new(&view);
        assert_eq!((small.camera.width, small.camera.height, small.gray.len()), (515, 3, 515 * 3));
        // (3 · 0.2 + 1) / 4
        assert!((small.gray[1] - 0.4).abs() < 1e-6 && (small.gray[2] - 0.2).abs() < 1e-6);
        let not_whole: Vec<usize> = (0..515 * 3).filter(|&i| !small.fully_head[i]).collect();
        assert_eq!(not_whole, [0, 515, 515 * 2 + 514]);
        assert!(small.partly_head.iter().all(|&partly_head| partly_head));
        // the middle of a pixel is the corner that its four share
        let (ray, same) = (small.camera.ray(Vec2::splat(0.5)).unwrap(), view.camera.ray(Vec2::ONE).unwrap());
        assert!((ray.direction - same.direction).length() < 1e-6);
    }
}
