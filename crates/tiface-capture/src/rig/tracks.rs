//! Points of a rough surface, found again in the photographs.
//!
//! A patch of the tangent plane of a point is looked up in every photograph in which the point is
//! visible. Where poses and surface are wrong, the patch lies beside its true place there,
//! differently in each photograph. Gauss–Newton moves it in the picture until its brightness,
//! normalized to mean 0 and length 1, fits that of the mean of the *other* photographs (Lucas,
//! Kanade 1981, with the inverse of neither picture preferred), first in a blurred picture, then in
//! the sharp one. Since all photographs move, none is taken for the truth, and what is common to
//! all of them is left to the adjustment, where points are free.

use super::adjust::{Sighting, Track, project};
use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Bvh, Camera, Mesh, Ray};
use tiface_base::image::{Gray, Photo, blurred, eroded};

/// Samples from a patch's center to its edge.
const HALF: i32 = 6;

/// Samples of a patch.
const PATCH: usize = (2 * HALF as usize + 1).pow(2);

/// Maximum number of photographs that a point is looked up in; the most frontal ones are used.
const MAX_VIEWS: usize = 10;

/// Minimum number of photographs that a point must be found in.
pub const MIN_VIEWS: usize = 3;

/// Minimum cosine between the normal and the direction to the camera.
const MIN_COSINE: f32 = 0.35;

/// Minimum correlation of a patch with the mean of the others.
const MIN_CORRELATION: f32 = 0.7;

/// Minimum standard deviation of a patch with texture, where white is 1. Rounding to 8 bits has 0.3
/// / 255.
const MIN_CONTRAST: f32 = 0.8 / 255.0;

/// Mask values from here on are head.
pub const HEAD: u8 = 250;

/// A photograph as it is searched.
pub struct RigView {
    /// Pixels a row.
    width: usize,
    /// Brightness, white is 1: slightly blurred, so that interpolation between pixels does not
    /// sharpen and soften the patch as it moves, and strongly blurred.
    pictures: [Vec<f32>; 2],
    /// Per pixel: whether a patch around it shows the head alone.
    usable: Vec<bool>,
}

impl RigView {
    /// Prepares a photograph; `head` is its mask, of the same size.
    pub fn new(photo: &Photo, head: &Gray) -> RigView {
        let (w, h) = (photo.width as usize, photo.height as usize);
        let luma = |[r, g, b]: &[u8; 3]| {
            (0.299 * f32::from(*r) + 0.587 * f32::from(*g) + 0.114 * f32::from(*b)) / 255.0
        };
        let gray: Vec<f32> = photo.rgb.iter().map(luma).collect();
        let pictures = LEVELS.map(|level| blurred(&gray, w, level.blur));
        let inside = head.values.iter().map(|&v| v >= HEAD).collect();
        RigView { width: w, pictures, usable: eroded(inside, w, h, HALF as usize) }
    }

    /// Returns whether a patch around a position of the picture can be used.
    pub fn is_usable(&self, pixel: Vec2) -> bool {
        is_set(&self.usable, self.width, pixel)
    }
}

/// Returns whether the pixel at a position of a picture is set; none outside it is.
pub fn is_set(set: &[bool], width: usize, pixel: Vec2) -> bool {
    let height = set.len() / width.max(1);
    let inside = pixel.min_element() >= 0.0 && pixel.x < width as f32 && pixel.y < height as f32;
    inside && set[pixel.y as usize * width + pixel.x as usize]
}

/// A point to look up.
#[derive(Clone, Debug)]
pub struct Seed {
    /// Position, scene units.
    pub position: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Views that no other part of the surface hides it from.
    pub views: Vec<usize>,
}

impl Seed {
    /// Returns the cosine between the normal and the direction to a camera.
    fn cosine(&self, camera: &Camera) -> f32 {
        (camera.position.as_vec3() - self.position).normalize().dot(self.normal)
    }

    /// Returns the axes of its patch: in the tangent plane, as long as a pixel of this camera.
    fn axes(&self, camera: &Camera) -> [Vec3; 2] {
        let footprint = camera.position.as_vec3().distance(self.position) / camera.fx as f32;
        let axis = self.normal.any_orthonormal_vector();
        [footprint * axis, footprint * self.normal.cross(axis)]
    }
}

/// One pass of the search.
struct Level {
    /// Deviation of the blur, pixels.
    blur: f32,
    /// Distance between samples, pixels.
    spacing: f32,
    /// Steps of Gauss–Newton.
    steps: usize,
}

/// The sharp picture, and the blurred one that the search may begin with.
const LEVELS: [Level; 2] =
    [Level { blur: 0.7, spacing: 1.0, steps: 5 }, Level { blur: 1.5, spacing: 2.0, steps: 5 }];

/// Spreads `count` points evenly over a surface, and finds out which views see each. `is_usable`
/// says whether a view can be used at a position of its picture.
pub fn seeds(
    surface: &Mesh,
    cameras: &[Camera],
    is_usable: impl Fn(usize, Vec2) -> bool + Sync,
    count: usize,
) -> Vec<Seed> {
    let bvh = Bvh::new(surface);
    let areas: Vec<f64> = (0..surface.triangles.len() as u32).map(|t| surface.area(t)).collect();
    let total: f64 = areas.iter().sum();
    let spacing = total / count as f64;
    let mut places = Vec::with_capacity(count);
    let (mut before, mut next) = (0.0, 0.5 * spacing);
    for (t, area) in areas.iter().enumerate() {
        while next < before + area && places.len() < count {
            places.push((t as u32, places.len()));
            next += spacing;
        }
        before += area;
    }
    let lift = (1e-3 * surface.bounds().size().max_element()).max(f32::MIN_POSITIVE);
    let seed = |&(t, index): &(u32, usize)| {
        // the generalized golden ratio of two dimensions fills the triangle evenly (Roberts 2018)
        let (mut a, mut b) = ((index as f32 * 0.754_877_7).fract(), (index as f32 * 0.569_840_3).fract());
        if a + b > 1.0 {
            (a, b) = (1.0 - a, 1.0 - b);
        }
        let [p, q, r] = surface.corners(t);
        let position = p + a * (q - p) + b * (r - p);
        let normals = surface.triangles[t as usize].map(|v| surface.normals[v as usize]);
        let normal =
            (normals[0] + a * (normals[1] - normals[0]) + b * (normals[2] - normals[0])).try_normalize()?;
        let sees = |v: &usize| {
            let to_camera = cameras[*v].position.as_vec3() - position;
            let Some((pixel, _)) = cameras[*v].project(position) else { return false };
            if to_camera.dot(normal) <= 0.0 || !is_usable(*v, pixel) {
                return false;
            }
            let ray = Ray {
                origin: position + lift * normal,
                direction: to_camera.normalize(),
                t_min: 0.0,
                t_max: f32::INFINITY,
            };
            !bvh.any_hit(&ray)
        };
        let views: Vec<usize> = (0..cameras.len()).filter(sees).collect();
        (views.len() >= MIN_VIEWS).then_some(Seed { position, normal, views })
    };
    places.par_iter().with_min_len(64).filter_map(seed).collect()
}

/// A patch sampled in a photograph: values of mean 0 and length 1, and their slopes along both axes
/// of the picture.
struct Patch {
    value: [f32; PATCH],
    slope: [[f32; PATCH]; 2],
}

impl Default for Patch {
    fn default() -> Patch {
        Patch { value: [0.0; PATCH], slope: [[0.0; PATCH]; 2] }
    }
}

/// The place of a patch in a photograph.
struct Placed<'a> {
    view: usize,
    picture: &'a RigView,
    /// Where its center is expected.
    center: Vec2,
    /// Pixels per sample of one pixel along both axes of the patch.
    axes: [Vec2; 2],
    /// Where it is found, relative to the expected place.
    shift: Vec2,
}

impl<'a> Placed<'a> {
    fn new(
        (view, picture): (usize, &'a RigView),
        camera: &Camera,
        seed: &Seed,
        axes: [Vec3; 2],
    ) -> Option<Placed<'a>> {
        let at = |p: Vec3| Some(project(camera, p.as_dvec3())?.as_vec2());
        let span = HALF as f32;
        let mut pixels = [Vec2::ZERO; 2];
        for (pixels, axis) in pixels.iter_mut().zip(axes) {
            *pixels = (at(seed.position + span * axis)? - at(seed.position - span * axis)?) / (2.0 * span);
        }
        let center = at(seed.position)?;
        Some(Placed { view, picture, center, axes: pixels, shift: Vec2::ZERO })
    }

    /// Samples the patch where it is now. Returns false, and leaves `out` unusable, if it leaves
    /// the head or has no contrast.
    fn sample(&self, level: usize, out: &mut Patch) -> bool {
        let RigView { width, pictures, usable } = self.picture;
        let (w, picture) = (*width, &pictures[level]);
        let h = picture.len() / w;
        let center = self.center + self.shift;
        let [a, b] = self.axes.map(|axis| LEVELS[level].spacing * axis);
        let extent = HALF as f32 * (a.abs() + b.abs());
        let (low, high) = (center - 0.5 - extent, center - 0.5 + extent);
        // the margin allows for rounding of the sample positions
        let inside = low.min_element() >= 0.01 && high.x < w as f32 - 1.01 && high.y < h as f32 - 1.01;
        if !inside || !usable[center.y as usize * w + center.x as usize] {
            return false;
        }
        let mut k = 0;
        for j in -HALF..=HALF {
            for i in -HALF..=HALF {
                let at = center - 0.5 + i as f32 * a + j as f32 * b;
                let (x, y) = (at.x as i32, at.y as i32); // conversions to 64 bits take longer
                let (fx, fy) = (at.x - x as f32, at.y - y as f32);
                let first = y as usize * w + x as usize;
                let (top, bottom) = (&picture[first..][..2], &picture[first + w..][..2]);
                let (across, across_below) = (top[1] - top[0], bottom[1] - bottom[0]);
                let (t, u) = (top[0] + fx * across, bottom[0] + fx * across_below);
                out.value[k] = t + fy * (u - t);
                out.slope[0][k] = across + fy * (across_below - across);
                out.slope[1][k] = u - t;
                k += 1;
            }
        }
        let mean = out.value.iter().sum::<f32>() / PATCH as f32;
        out.value.iter_mut().for_each(|v| *v -= mean);
        let square = dot(&out.value, &out.value);
        if square < MIN_CONTRAST * MIN_CONTRAST * PATCH as f32 {
            return false;
        }
        let scale = 1.0 / square.sqrt();
        out.value.iter_mut().for_each(|v| *v *= scale);
        out.slope.as_flattened_mut().iter_mut().for_each(|v| *v *= scale);
        true
    }
}

fn dot(a: &[f32; PATCH], b: &[f32; PATCH]) -> f32 {
    let mut sums = [0f32; 13];
    for (a, b) in a.as_chunks::<13>().0.iter().zip(b.as_chunks::<13>().0) {
        (0..13).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum()
}

/// Returns the step in pixels that fits a patch to a target of mean 0 and length 1: Gauss–Newton on
/// the difference of the normalized patches. `None` where the patch does not say where it belongs
/// along some direction.
fn step_to(patch: &Patch, target: &[f32; PATCH]) -> Option<Vec2> {
    /// Smallest share of the larger curvature that the smaller one may have.
    const EDGE: f32 = 0.02;
    let v = &patch.value;
    let off = 1.0 - dot(v, target); // of the difference along the patch itself
    let [x, y] = &patch.slope;
    let mean = |s: &[f32; PATCH]| s.iter().sum::<f32>() / PATCH as f32;
    let (mx, my, vx, vy) = (mean(x), mean(y), dot(x, v), dot(y, v));
    let n = PATCH as f32;
    let xx = dot(x, x) - n * mx * mx - vx * vx;
    let xy = dot(x, y) - n * mx * my - vx * vy;
    let yy = dot(y, y) - n * my * my - vy * vy;
    let gx = vx - dot(x, target) - vx * off;
    let gy = vy - dot(y, target) - vy * off;
    let (determinant, trace) = (xx * yy - xy * xy, xx + yy);
    (determinant > EDGE * trace * trace)
        .then(|| -Vec2::new(yy * gx - xy * gy, xx * gy - xy * gx) / determinant)
}

/// Moves the patches of one point until each fits the mean of the others. Returns how well each
/// fits; those that left the head are removed.
fn align(placed: &mut Vec<Placed>, level: usize, patch: &mut Patch) -> Vec<f32> {
    let Level { spacing, steps, .. } = LEVELS[level];
    let mut values: Vec<[f32; PATCH]> = Vec::with_capacity(placed.len());
    placed.retain(|p| {
        let is_sampled = p.sample(level, patch);
        values.extend(is_sampled.then_some(patch.value));
        is_sampled
    });
    let mut sum = [0f32; PATCH];
    values.iter().for_each(|v| (0..PATCH).for_each(|k| sum[k] += v[k]));
    let mut fits = Vec::new();
    for step in 0..=steps {
        fits.clear();
        let mut i = 0;
        while i < placed.len() && placed.len() >= MIN_VIEWS {
            (0..PATCH).for_each(|k| sum[k] -= values[i][k]);
            let length = dot(&sum, &sum).sqrt().max(f32::MIN_POSITIVE);
            let mut target = sum;
            target.iter_mut().for_each(|t| *t /= length);
            let moved = if placed[i].sample(level, patch) { step_to(patch, &target) } else { None };
            let Some(moved) = moved else {
                placed.remove(i);
                values.remove(i);
                continue;
            };
            values[i] = patch.value;
            (0..PATCH).for_each(|k| sum[k] += patch.value[k]);
            fits.push(dot(&patch.value, &target));
            if step < steps {
                placed[i].shift += moved.clamp_length_max(spacing);
            }
            i += 1;
        }
    }
    fits
}

/// Returns the views that a point is looked up in, the most frontal one first.
fn frontal(cameras: &[Camera], seed: &Seed) -> Vec<usize> {
    let mut views: Vec<(f32, usize)> =
        seed.views.iter().map(|&v| (seed.cosine(&cameras[v]), v)).filter(|(c, _)| *c >= MIN_COSINE).collect();
    views.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    views.truncate(MAX_VIEWS);
    views.into_iter().map(|(_, v)| v).collect()
}

/// Returns how many points are looked up in each view.
pub fn looked_up(cameras: &[Camera], seeds: &[Seed]) -> Vec<usize> {
    let mut counts = vec![0; cameras.len()];
    seeds.iter().flat_map(|seed| frontal(cameras, seed)).for_each(|v| counts[v] += 1);
    counts
}

/// Looks up points in the photographs. `levels` counts passes: two begin in the blurred pictures.
/// Returns for each seed the point with its sightings, if enough views agree.
pub fn find(views: &[RigView], cameras: &[Camera], seeds: &[Seed], levels: usize) -> Vec<Option<Track>> {
    let look_up = |seed: &Seed| {
        let frontal = frontal(cameras, seed);
        let axes = seed.axes(&cameras[*frontal.first()?]);
        let place = |&v: &usize| Placed::new((v, &views[v]), &cameras[v], seed, axes);
        let mut placed: Vec<Placed> = frontal.iter().filter_map(place).collect();
        let mut patch = Patch::default();
        let mut fits = Vec::new();
        for level in (0..levels).rev() {
            fits = align(&mut placed, level, &mut patch);
        }
        let found = placed.iter().zip(&fits).filter(|(_, fit)| **fit >= MIN_CORRELATION);
        let sighting = |(p, _): (&Placed, &f32)| Sighting {
            view: p.view,
            pixel: DVec2::new(f64::from(p.center.x + p.shift.x), f64::from(p.center.y + p.shift.y)),
        };
        let sightings: Vec<Sighting> = found.map(sighting).collect();
        (sightings.len() >= MIN_VIEWS).then_some(Track {
            position: seed.position.as_dvec3(),
            normal: seed.normal,
            sightings,
        })
    };
    seeds.par_iter().with_min_len(16).map(look_up).collect()
}

/// Looks up points in one more photograph, whose patches are moved until they fit the mean of those
/// that the points were found in; these stay. Returns the points found, each with its sighting in
/// view 0 alone.
pub fn find_in(
    (photo, camera): (&RigView, &Camera),
    views: &[RigView],
    cameras: &[Camera],
    tracks: &[Track],
) -> Vec<Track> {
    let look_up = |track: &Track| {
        let seed = Seed { position: track.position.as_vec3(), normal: track.normal, views: Vec::new() };
        let axes = seed.axes(&cameras[track.sightings.first()?.view]);
        let mut placed =
            Placed::new((0, photo), camera, &seed, axes).filter(|_| seed.cosine(camera) >= MIN_COSINE)?;
        let (mut patch, mut fit) = (Patch::default(), 0.0);
        for (level, Level { spacing, steps, .. }) in LEVELS.iter().enumerate().rev() {
            let mut target = [0f32; PATCH];
            for s in &track.sightings {
                let mut seen = Placed::new((s.view, &views[s.view]), &cameras[s.view], &seed, axes)?;
                seen.shift = s.pixel.as_vec2() - seen.center;
                if seen.sample(level, &mut patch) {
                    (0..PATCH).for_each(|k| target[k] += patch.value[k]);
                }
            }
            let length = dot(&target, &target).sqrt().max(f32::MIN_POSITIVE);
            target.iter_mut().for_each(|t| *t /= length);
            for step in 0..=*steps {
                let moved = placed.sample(level, &mut patch).then(|| step_to(&patch, &target))??;
                fit = dot(&patch.value, &target);
                if step < *steps {
                    placed.shift += moved.clamp_length_max(*spacing);
                }
            }
        }
        let pixel = (placed.center + placed.shift).as_dvec2();
        let sightings = vec![Sighting { view: 0, pixel }];
        (fit >= MIN_CORRELATION).then(|| Track { sightings, ..track.clone() })
    };
    tracks.par_iter().with_min_len(16).filter_map(look_up).collect()
}

/// Returns the seeds moved to the points of their tracks, with normals of the surface through their
/// neighbors.
pub fn moved_to(seeds: &[Seed], tracks: &[Track]) -> Vec<Seed> {
    let positions: Vec<DVec3> = tracks.iter().map(|t| t.position).collect();
    let moved = |(seed, track): (&Seed, &Track)| Seed {
        position: track.position.as_vec3(),
        normal: normal_among(track.position, &positions, track.normal),
        views: seed.views.clone(),
    };
    seeds.par_iter().zip(tracks).with_min_len(16).map(moved).collect()
}

/// Returns the normal of the plane that is closest to the neighbors of a point, or `before` if that
/// is quite another one.
fn normal_among(point: DVec3, positions: &[DVec3], before: Vec3) -> Vec3 {
    const NEIGHBORS: usize = 16;
    /// Least cosine between both.
    const SIMILAR: f32 = 0.5;
    const ROUNDS: usize = 30;
    let mut near: Vec<(f64, usize)> =
        positions.iter().enumerate().map(|(i, p)| (p.distance_squared(point), i)).collect();
    if near.len() <= NEIGHBORS {
        return before;
    }
    let order = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    near.select_nth_unstable_by(NEIGHBORS, order);
    near.truncate(NEIGHBORS + 1);
    near.sort_by(order); // sums keep their order
    let mean = near.iter().map(|n| positions[n.1]).sum::<DVec3>() / near.len() as f64;
    let mut spread = DMat3::ZERO;
    for (_, i) in near {
        let v = positions[i] - mean;
        spread += DMat3::from_cols(v * v.x, v * v.y, v * v.z);
    }
    // the direction of least spread, by inverse iteration
    let trace = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
    let inverse = (spread + DMat3::from_diagonal(DVec3::splat(1e-3 * trace + 1e-12))).inverse();
    let mut normal = before.as_dvec3();
    for _ in 0..ROUNDS {
        normal = DVec3::normalize(inverse * normal);
    }
    let normal = normal.as_vec3();
    let cosine = normal.dot(before);
    if cosine.abs() > SIMILAR { cosine.signum() * normal } else { before }
}
