//! Multi-view stereo that refines an approximate surface: it finds how far each point should move
//! along its normal.
//!
//! A small patch of the surface's tangent plane is sampled in every photograph in which it is
//! visible. Once it is moved along its normal to the true surface, its image is the same in all of
//! them, up to brightness and contrast. With patches `p_v` of mean 0 and length 1, the mean
//! correlation of all pairs is
//!
//! ```text
//! score(d) = (‖Σ p_v(d)‖² − V) / (V (V − 1))          σ² = (1 − score) / −score″
//! ```
//!
//! which treats all photographs equally, as Furukawa, Ponce 2010, "Accurate, Dense, and Robust
//! Multiview Stereopsis", measure photo-consistency. Displacements are tried in steps that shift no
//! two patches by more than a fraction of a pixel against each other; parabolas refine the peak and
//! the tilt of the patch. Photographs that do not fit the others (because of a highlight or an
//! occluder) are removed once. A point is accepted if its peak is unique and inside the range, if
//! `σ`, the error to expect from noise and the width of the peak, is small, and if its neighbors
//! agree, which in hair they rarely do.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;
use tiface_base::dispatch;
use tiface_base::geom::Camera;

/// Number of samples from a patch's center to its edge; samples are a pixel apart.
const HALF: i32 = 4;

/// Number of samples of a patch.
const PATCH: usize = (2 * HALF as usize + 1).pow(2);

/// Number of samples that are evaluated together.
const LANES: usize = 8;

/// Length of a patch in memory, whole lanes; the samples beyond [`PATCH`] are zero.
const PADDED: usize = PATCH.next_multiple_of(LANES);

/// Column and row of the samples of a patch, counted from its center.
const OFFSETS: [[f32; PADDED]; 2] = {
    let mut offsets = [[0f32; PADDED]; 2];
    let mut k = 0;
    while k < PATCH {
        let side = 2 * HALF + 1;
        offsets[0][k] = (k as i32 % side - HALF) as f32;
        offsets[1][k] = (k as i32 / side - HALF) as f32;
        k += 1;
    }
    offsets
};

/// Maximum number of photographs in which a point is compared; the most frontal ones are used.
const MAX_VIEWS: usize = 8;

/// Minimum number of photographs that must agree.
const MIN_VIEWS: usize = 4;

/// Minimum cosine between the normal and the direction to the camera.
const MIN_COSINE: f32 = 0.4;

/// Maximum shift of one patch against another between neighboring hypotheses, in pixels.
const STEP: f32 = 0.4;

/// Search range to either side of a point, in pixel footprints. A half-trained field is that
/// accurate.
const REACH: f32 = 5.0;

/// Minimum standard deviation of a patch with texture, where white is 1. Rounding to 8 bits has 0.3
/// / 255.
const MIN_CONTRAST: f32 = 0.8 / 255.0;

/// Minimum mean correlation of a photograph with the better half of the others; below it the
/// photograph is removed.
const MIN_FIT: f32 = 0.3;

/// Minimum mean correlation of an accepted point.
const MIN_SCORE: f32 = 0.4;

/// Minimum difference in score between the best peak and any other.
const MARGIN: f32 = 0.05;

/// Number of iterations in which shift and tilt of a peak are refined.
const ROUNDS: usize = 2;

/// Step of the tilt to either side, as a slope.
const TILT: f32 = 0.15;

/// Maximum tilt against the initial surface, as a slope.
const MAX_TILT: f32 = 0.6;

/// Maximum σ of an accepted point, in pixel footprints.
const MAX_SIGMA: f32 = 1.5;

/// A photograph with its camera, and the visibility of the surface in it.
pub struct StereoView {
    /// Camera of the photograph.
    pub camera: Camera,
    /// `[height, width]` brightness, 0..=1.
    pub gray: Vec<f32>,
    /// `[height, width]`: whether the center of a patch may lie at a pixel.
    pub usable: Vec<bool>,
    /// Edge length of the cells of `depth`, in pixels.
    pub cell: usize,
    /// `[⌈height / cell⌉, ⌈width / cell⌉]` distance of the surface along the viewing axis at the
    /// center of each cell; infinite where the cell shows no surface.
    pub depth: Vec<f32>,
}

/// A point of the initial surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surfel {
    /// Position in scene units.
    pub position: Vec3,
    /// Unit normal, outward.
    pub normal: Vec3,
}

/// A point at which the photographs agree.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoPoint {
    /// Position in scene units.
    pub position: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Length of a pixel at the point, in scene units.
    pub footprint: f32,
    /// Expected error in footprints, up to a factor that all points share.
    pub sigma: f32,
}

/// Projection of a patch into one photograph, as a function of its displacement along the normal.
#[derive(Clone, Copy)]
struct Projected {
    view: usize,
    center: Vec2,
    /// Pixels per footprint of displacement.
    slope: Vec2,
    /// Quadratic term: pixels per squared footprint.
    curvature: Vec2,
    /// Pixels per sample along both axes of the patch.
    axes: [Vec2; 2],
}

/// Displacement of a patch in footprints, and its slope along both axes.
#[derive(Clone, Copy)]
struct Displacement {
    shift: f32,
    tilt: Vec2,
}

impl Projected {
    fn new(view: usize, camera: &Camera, s: &Surfel, axes: [Vec3; 2], footprint: f32) -> Option<Projected> {
        let at = |p: Vec3| camera.project(p).map(|(q, _)| q);
        let center = at(s.position)?;
        let reach = REACH * footprint * s.normal;
        let (before, after) = (at(s.position - reach)?, at(s.position + reach)?);
        let span = HALF as f32;
        let mut pixels = [Vec2::ZERO; 2];
        for (pixels, axis) in pixels.iter_mut().zip(axes) {
            let to_edge = span * footprint * axis;
            *pixels = (at(s.position + to_edge)? - at(s.position - to_edge)?) / (2.0 * span);
        }
        Some(Projected {
            view,
            center,
            slope: (after - before) / (2.0 * REACH),
            curvature: (after + before - 2.0 * center) / (2.0 * REACH * REACH),
            axes: pixels,
        })
    }

    /// Samples the brightness of the patch and normalizes it to mean 0 and length 1. If the patch
    /// leaves the usable part of the photograph or has no contrast, writes zeros and returns false.
    #[inline(always)]
    fn sample_patch(&self, view: &StereoView, at: Displacement, patch: &mut [f32; PADDED]) -> bool {
        let center = self.center + at.shift * (self.slope + at.shift * self.curvature) - 0.5;
        let a = self.axes[0] + at.tilt.x * self.slope;
        let b = self.axes[1] + at.tilt.y * self.slope;
        let (w, h) = (view.camera.width as usize, view.camera.height as usize);
        let extent = HALF as f32 * (a.abs() + b.abs());
        let (low, high) = (center - extent, center + extent);
        // the margin allows for rounding of the sample positions
        let inside = low.min_element() >= 0.01 && high.x < w as f32 - 1.01 && high.y < h as f32 - 1.01;
        // a displaced patch may lie on pixels that are not head or not usable
        let center_pixel = (center + 0.5).as_uvec2();
        if !inside || !view.usable[center_pixel.y as usize * w + center_pixel.x as usize] {
            patch.fill(0.0);
            return false;
        }
        interpolate(&view.gray, (w, h), center, [a, b], patch);
        normalize(patch)
    }
}

/// Interpolates brightness at the samples of a patch, which lie inside of the photograph of at most
/// 2²⁴ pixels, a pixel or more from its right and lower edge.
#[inline(always)]
fn interpolate(
    gray: &[f32],
    (w, h): (usize, usize),
    center: Vec2,
    [a, b]: [Vec2; 2],
    patch: &mut [f32; PADDED],
) {
    assert!(w >= 2 && h >= 2 && gray.len() == w * h && gray.len() <= 1 << 24);
    let mut corner = [0i32; PADDED];
    let (mut fx, mut fy) = ([0f32; PADDED], [0f32; PADDED]);
    for k in 0..PADDED {
        let x = center.x + OFFSETS[1][k] * b.x + OFFSETS[0][k] * a.x;
        let y = center.y + OFFSETS[1][k] * b.y + OFFSETS[0][k] * a.y;
        // SAFETY: `max` and `min` bound it, NaN too, by 0 and a whole number below 2²⁴.
        let cx = unsafe { x.max(0.0).min((w - 2) as f32).to_int_unchecked::<i32>() };
        // SAFETY: as above.
        let cy = unsafe { y.max(0.0).min((h - 2) as f32).to_int_unchecked::<i32>() };
        fx[k] = x - cx as f32;
        fy[k] = y - cy as f32;
        corner[k] = cy * w as i32 + cx;
    }
    let mut pixels = [[0f32; PADDED]; 4];
    for k in 0..PADDED {
        let corner = corner[k] as usize;
        for (i, at) in [corner, corner + 1, corner + w, corner + w + 1].into_iter().enumerate() {
            // SAFETY: column and row of the corner are at most w − 2 and h − 2, by the bounds
            // above.
            pixels[i][k] = unsafe { *gray.get_unchecked(at) };
        }
    }
    for k in 0..PADDED {
        let top = pixels[0][k] + fx[k] * (pixels[1][k] - pixels[0][k]);
        let bottom = pixels[2][k] + fx[k] * (pixels[3][k] - pixels[2][k]);
        patch[k] = top + fy[k] * (bottom - top);
    }
}

/// Brings a patch to mean 0 and length 1, or to zero where it has no contrast, for which it returns
/// false.
#[inline(always)]
fn normalize(patch: &mut [f32; PADDED]) -> bool {
    patch[PATCH..].fill(0.0);
    let mut sum = [0f32; LANES];
    for block in patch.as_chunks::<LANES>().0 {
        for i in 0..LANES {
            sum[i] += block[i];
        }
    }
    let mean = sum.iter().sum::<f32>() / PATCH as f32;
    for v in patch.iter_mut() {
        *v -= mean;
    }
    patch[PATCH..].fill(0.0);
    let square = squares(patch);
    let has_contrast = square >= MIN_CONTRAST * MIN_CONTRAST * PATCH as f32;
    let scale = if has_contrast { 1.0 / square.sqrt() } else { 0.0 };
    for v in patch.iter_mut() {
        *v *= scale;
    }
    has_contrast
}

/// Returns Σ v².
#[inline(always)]
fn squares(patch: &[f32; PADDED]) -> f32 {
    let mut sum = [0f32; LANES];
    for block in patch.as_chunks::<LANES>().0 {
        for i in 0..LANES {
            sum[i] += block[i] * block[i];
        }
    }
    sum.iter().sum()
}

/// Writes the normalized patches of a surfel at a displacement, and the squared length of their sum
/// less the number of those with contrast.
#[inline(always)]
fn sum_patches_body<const F: bool>(
    views: &[StereoView],
    visible: &[Projected],
    at: Displacement,
    patches: &mut [[f32; PADDED]],
    out: &mut f32,
) {
    let mut sum = [0f32; PADDED];
    let mut with_contrast = 0;
    for (p, patch) in visible.iter().zip(patches) {
        with_contrast += i32::from(p.sample_patch(&views[p.view], at, patch));
        for k in 0..PADDED {
            sum[k] += patch[k];
        }
    }
    *out = squares(&sum) - with_contrast as f32;
}

dispatch! {
    fn sum_patches / sum_patches_body(
        views: &[StereoView], visible: &[Projected], at: Displacement, patches: &mut [[f32; PADDED]],
        out: &mut f32,
    )
}

/// A surfel with its projections into the photographs in which it is visible.
struct Matching<'a> {
    views: &'a [StereoView],
    visible: Vec<Projected>,
    patches: Vec<[f32; PADDED]>,
}

impl Matching<'_> {
    /// Returns the mean correlation of all pairs of photographs at a displacement.
    fn score(&mut self, displacement: Displacement) -> f32 {
        let mut square = 0.0;
        sum_patches(self.views, &self.visible, displacement, &mut self.patches, &mut square);
        let n = self.visible.len() as f32;
        square / (n * (n - 1.0))
    }

    /// Removes photographs that do not fit the others at a displacement. Returns whether all of
    /// them fitted.
    fn keep_fitting(&mut self, displacement: Displacement) -> bool {
        self.score(displacement);
        let n = self.visible.len();
        let fits = |v: usize| {
            let correlation =
                |w: usize| (0..PATCH).map(|k| self.patches[v][k] * self.patches[w][k]).sum::<f32>();
            // only the better half of the others counts, so that an outlier among them does not
            // remove this one
            let mut others: Vec<f32> = (0..n).filter(|&w| w != v).map(correlation).collect();
            others.sort_by(|a, b| b.total_cmp(a));
            let best = &others[..others.len().div_ceil(2)];
            best.iter().sum::<f32>() / best.len() as f32 >= MIN_FIT
        };
        let kept: Vec<Projected> = (0..n).filter(|&v| fits(v)).map(|v| self.visible[v]).collect();
        self.patches.truncate(kept.len());
        self.visible = kept;
        self.visible.len() == n
    }

    /// Returns the shift of the highest peak in the search range, and the step between shifts.
    /// Returns `None` if the peak lies on the border of the range or is not unique, or if the
    /// baseline of the views is too small or too large.
    fn search(&mut self) -> Option<(f32, f32)> {
        let mut widest = 0f32;
        for (i, a) in self.visible.iter().enumerate() {
            for b in &self.visible[..i] {
                widest = widest.max(a.slope.distance(b.slope));
            }
        }
        let steps = (REACH * widest / STEP).ceil();
        if !(2.0..=64.0).contains(&steps) {
            return None;
        }
        let (n, step) = (steps as i32, REACH / steps);
        let scores: Vec<f32> =
            (-n..=n).map(|k| self.score(Displacement { shift: k as f32 * step, tilt: Vec2::ZERO })).collect();
        let best = (0..scores.len()).max_by(|&a, &b| scores[a].total_cmp(&scores[b]))?;
        if best == 0 || best + 1 == scores.len() {
            return None;
        }
        let rival = (1..scores.len() - 1)
            .filter(|&k| k.abs_diff(best) > 2 && scores[k] >= scores[k - 1] && scores[k] >= scores[k + 1])
            .map(|k| scores[k])
            .fold(f32::NEG_INFINITY, f32::max);
        (rival < scores[best] - MARGIN).then_some(((best as i32 - n) as f32 * step, step))
    }

    /// Returns the refined peak near a shift, with its score and negative second derivative.
    fn refine(&mut self, shift: f32, mut step: f32) -> Option<(Displacement, f32, f32)> {
        let mut at = Displacement { shift, tilt: Vec2::ZERO };
        for _ in 0..ROUNDS {
            at.shift += step * steps_to_peak(self.scores_around(at, step));
            step = (0.6 * step).max(0.1);
            for k in 0..2 {
                let around = [-TILT, 0.0, TILT].map(|d| {
                    let mut tilt = at.tilt;
                    tilt[k] += d;
                    self.score(Displacement { tilt, ..at })
                });
                at.tilt[k] = (at.tilt[k] + TILT * steps_to_peak(around)).clamp(-MAX_TILT, MAX_TILT);
            }
        }
        // refining the tilt has moved the peak slightly
        at.shift += step * steps_to_peak(self.scores_around(at, step));
        let (offset, score, curvature) = parabola(self.scores_around(at, step), step)?;
        at.shift += offset;
        Some((at, score, curvature))
    }

    /// Returns the scores at the shift minus `step`, at the shift, and at the shift plus `step`.
    fn scores_around(&mut self, at: Displacement, step: f32) -> [f32; 3] {
        [-step, 0.0, step].map(|d| self.score(Displacement { shift: at.shift + d, ..at }))
    }
}

/// Returns the number of steps from the middle of three values towards their peak, clamped to
/// -1..=1.
fn steps_to_peak([before, middle, after]: [f32; 3]) -> f32 {
    let (slope, curvature) = (0.5 * (after - before), 2.0 * middle - before - after);
    if curvature > 1e-6 { (slope / curvature).clamp(-1.0, 1.0) } else { slope.signum() }
}

/// Returns the peak of the parabola through three values that are one `step` apart: its offset from
/// the middle, its value and its negative second derivative. Returns `None` if the middle value is
/// not the highest.
fn parabola([before, middle, after]: [f32; 3], step: f32) -> Option<(f32, f32, f32)> {
    let curvature = 2.0 * middle - before - after;
    if before > middle || after > middle || curvature <= 1e-6 {
        return None;
    }
    let offset = 0.5 * (after - before) / curvature;
    Some((offset * step, middle + 0.25 * (after - before) * offset, curvature / (step * step)))
}

/// Returns the views in which a surfel is visible, the most frontal one first.
fn visible_in(views: &[StereoView], s: &Surfel) -> Vec<usize> {
    let visible_cosine = |view: &StereoView| {
        let to_camera = view.camera.position.as_vec3() - s.position;
        let cosine = to_camera.normalize().dot(s.normal);
        let (pixel, depth) = view.camera.project(s.position).filter(|_| cosine >= MIN_COSINE)?;
        let (w, h) = (view.camera.width as usize, view.camera.height as usize);
        if !(pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w as f32 && pixel.y < h as f32) {
            return None;
        }
        let (x, y) = (pixel.x as usize, pixel.y as usize);
        let nearest = view.depth[y / view.cell * w.div_ceil(view.cell) + x / view.cell];
        // tolerance: the surface's slope changes the depth within a cell, and hypotheses may lie up
        // to REACH away
        let reach = (REACH + 1.5 * view.cell as f32) * depth / view.camera.fx as f32;
        (view.usable[y * w + x] && depth <= nearest + reach).then_some(cosine)
    };
    let mut visible: Vec<(f32, usize)> =
        views.iter().enumerate().filter_map(|(v, view)| Some((visible_cosine(view)?, v))).collect();
    visible.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    visible.into_iter().map(|(_, v)| v).collect()
}

/// Returns the views in which a surfel is visible, the most frontal one first, and the length of a
/// pixel of the first view at the surfel. Returns `None` for fewer than [`MIN_VIEWS`].
fn frontal(views: &[StereoView], s: &Surfel) -> Option<(Vec<usize>, f32)> {
    let visible = Some(visible_in(views, s)).filter(|visible| visible.len() >= MIN_VIEWS)?;
    let camera = &views[visible[0]].camera;
    let (_, depth) = camera.project(s.position)?;
    Some((visible, depth / camera.fx as f32))
}

/// Returns the length of a pixel at a surfel if `view` is its most frontal view and enough views
/// see the surfel, else `None`. With this rule exactly one of all views that find a point keeps it.
pub fn owned_footprint(views: &[StereoView], view: usize, s: &Surfel) -> Option<f32> {
    frontal(views, s).filter(|(visible, _)| visible[0] == view).map(|(_, footprint)| footprint)
}

fn match_one(views: &[StereoView], s: &Surfel) -> Option<StereoPoint> {
    let (visible, footprint) = frontal(views, s)?;
    let first = s.normal.any_orthonormal_vector();
    let axes = [first, s.normal.cross(first)];
    let visible: Vec<Projected> = visible
        .into_iter()
        .take(MAX_VIEWS)
        .filter_map(|v| Projected::new(v, &views[v].camera, s, axes, footprint))
        .collect();
    if visible.len() < MIN_VIEWS {
        return None;
    }
    let mut matching = Matching { views, patches: vec![[0f32; PADDED]; visible.len()], visible };
    let (mut shift, mut step) = matching.search()?;
    if !matching.keep_fitting(Displacement { shift, tilt: Vec2::ZERO }) {
        if matching.visible.len() < MIN_VIEWS {
            return None;
        }
        (shift, step) = matching.search()?;
    }
    let (at, score, curvature) = matching.refine(shift, step)?;
    let sigma = ((1.0 - score).max(0.0) / curvature).sqrt();
    if score < MIN_SCORE || sigma > MAX_SIGMA || at.shift.abs() > REACH {
        return None;
    }
    Some(StereoPoint {
        position: s.position + at.shift * footprint * s.normal,
        normal: (s.normal - at.tilt.x * axes[0] - at.tilt.y * axes[1]).normalize(),
        footprint,
        sigma,
    })
}

/// Matches surfels and returns the points at which the photographs agree, in the order of
/// `surfels`. Many surfels have none.
pub fn matches(views: &[StereoView], surfels: &[Surfel]) -> Vec<StereoPoint> {
    surfels.par_iter().with_min_len(64).filter_map(|s| match_one(views, s)).collect()
}

/// Returns the points that at least half of their neighbors confirm. `points` lie about `spacing`
/// apart, in scene units.
pub fn confirmed(points: &[StereoPoint], spacing: f32) -> Vec<StereoPoint> {
    /// Maximum distance of a neighbor, in spacings.
    const NEIGHBOR_RADIUS: f32 = 2.5;
    /// Maximum distance of the point from a neighbor's plane, in footprints.
    const MAX_OFFSET: f32 = 0.5;
    /// Minimum number of neighbors of a point.
    const MIN_NEIGHBORS: u32 = 4;
    let radius = NEIGHBOR_RADIUS * spacing;
    let cell = |p: Vec3| (p / radius).floor().to_array().map(|c| c as i32);
    let mut cells: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
    for (i, p) in points.iter().enumerate() {
        cells.entry(cell(p.position)).or_default().push(i as u32);
    }
    let is_confirmed = |i: usize, p: &StereoPoint| {
        let [x, y, z] = cell(p.position);
        let (mut neighbors, mut agreeing) = (0, 0);
        for k in 0..27 {
            for &j in cells.get(&[x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1]).into_iter().flatten() {
                let q = &points[j as usize];
                let between = p.position - q.position;
                // points on the other side of a thin part are not neighbors
                if j as usize == i || between.length() > radius || p.normal.dot(q.normal) < 0.5 {
                    continue;
                }
                neighbors += 1;
                let offset = between.dot((p.normal + q.normal).normalize());
                agreeing += u32::from(offset.abs() < MAX_OFFSET * p.footprint);
            }
        }
        neighbors >= MIN_NEIGHBORS && 2 * agreeing >= neighbors
    };
    points
        .par_iter()
        .enumerate()
        .with_min_len(256)
        .filter(|(i, p)| is_confirmed(*i, p))
        .map(|(_, p)| *p)
        .collect()
}

#[cfg(test)]
mod tests;
