//! Stereo on a surface that is nearly right: how far along its normal each point should move.
//!
//! A small patch of the surface's tangent plane is looked up in every photograph that sees it. Moved along its
//! normal to where the surface is, it shows the same in all of them, but for brightness and contrast. With patches
//! `p_v` of mean 0 and length 1, the mean correlation of all pairs is
//!
//! ```text
//! score(d) = (‖Σ p_v(d)‖² − V) / (V (V − 1))          σ² = (1 − score) / −score″
//! ```
//!
//! which treats all photographs alike, as Furukawa, Ponce 2010, "Accurate, Dense, and Robust Multiview Stereopsis",
//! measure photo-consistency. Displacements are tried in steps that move no two patches by more than a part of a
//! pixel against each other; parabolas refine the peak, and the patch's tilt with it. Photographs that do not fit
//! the others (a highlight, an occluder) are left out once. A peak counts when it is inside the range and alone, when
//! `σ`, the error that noise and the peak's width allow, is small, and when neighbors agree with it: in hair they
//! rarely do.

use crate::geom::Camera;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;

/// Samples from a patch's center to its edge, a pixel apart.
const HALF: i32 = 4;

/// Samples of a patch.
const PATCH: usize = (2 * HALF as usize + 1).pow(2);

/// Photographs that a point is compared in, the most frontal ones.
const MOST_VIEWS: usize = 8;

/// Photographs that must agree.
const LEAST_VIEWS: usize = 4;

/// Flattest view, as the cosine between normal and direction to the camera.
const LEAST_COSINE: f32 = 0.4;

/// Most that neighboring hypotheses move one patch against another, pixels.
const STEP: f32 = 0.4;

/// How far a point is searched to both sides, in pixel footprints: a field that is half trained is that good.
const REACH: f32 = 5.0;

/// Standard deviation below which a patch shows nothing, of a white of 1: a rounding error of 8 bits has 0.3 / 255.
const LEAST_CONTRAST: f32 = 0.8 / 255.0;

/// Correlation of a photograph with the better half of the others below which it is left out.
const LEAST_FIT: f32 = 0.3;

/// Mean correlation of a point that counts.
const LEAST_SCORE: f32 = 0.4;

/// How much lower any other peak must be.
const MARGIN: f32 = 0.05;

/// Rounds of shift and tilt that refine a peak.
const ROUNDS: usize = 2;

/// Tilt that is tried to both sides, as a slope.
const TILT: f32 = 0.15;

/// Steepest tilt against the surface as it was.
const MOST_TILT: f32 = 0.6;

/// Largest σ of a point that counts, in pixel footprints.
const MOST_SIGMA: f32 = 1.5;

/// One photograph and what is known of the surface in it.
pub struct StereoView {
    /// Its camera.
    pub camera: Camera,
    /// `[height, width]` brightness, white is 1.
    pub gray: Vec<f32>,
    /// `[height, width]` may a patch's center lie here?
    pub usable: Vec<bool>,
    /// Edge of the cells of `depth`, pixels.
    pub cell: usize,
    /// `[⌈height / cell⌉, ⌈width / cell⌉]` distance of the surface along the viewing axis in the middle of each cell;
    /// infinite where there is none.
    pub depth: Vec<f32>,
}

/// A point of the surface as it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surfel {
    /// Where.
    pub position: Vec3,
    /// Unit normal, outward.
    pub normal: Vec3,
}

/// A point where the photographs agree.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoPoint {
    /// Where.
    pub position: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Length of a pixel there.
    pub footprint: f32,
    /// The error to expect, in footprints, up to a common factor.
    pub sigma: f32,
}

/// How a patch projects into one photograph, as a function of its displacement along the normal.
#[derive(Clone, Copy)]
struct Projected {
    view: usize,
    center: Vec2,
    /// Pixels per footprint of displacement, and the quadratic term.
    slope: Vec2,
    bend: Vec2,
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
            bend: (after + before - 2.0 * center) / (2.0 * REACH * REACH),
            axes: pixels,
        })
    }

    /// Looks the patch up: brightness with mean 0 and length 1. False, and zeros, where it leaves the picture or its
    /// usable part, or shows nothing.
    fn look_up(&self, view: &StereoView, at: Displacement, patch: &mut [f32; PATCH]) -> bool {
        let center = self.center + at.shift * (self.slope + at.shift * self.bend) - 0.5;
        let [a, b] = [0, 1].map(|k| self.axes[k] + at.tilt[k] * self.slope);
        let (w, h) = (view.camera.width as usize, view.camera.height as usize);
        let extent = HALF as f32 * (a.abs() + b.abs());
        let (low, high) = (center - extent, center + extent);
        // a little inside: sums of steps round
        let inside = low.min_element() >= 0.01 && high.x < w as f32 - 1.01 && high.y < h as f32 - 1.01;
        // moved, a patch may come to lie on what is not head or not to be looked at
        let middle = (center + 0.5).as_uvec2();
        if !inside || !view.usable[middle.y as usize * w + middle.x as usize] {
            patch.fill(0.0);
            return false;
        }
        let (mut k, mut sum) = (0, 0f32);
        for j in -HALF..=HALF {
            let row = center + j as f32 * b;
            for i in -HALF..=HALF {
                let (x, y) = (row.x + i as f32 * a.x, row.y + i as f32 * a.y);
                let (cx, cy) = (x as usize, y as usize);
                let (fx, fy) = (x - cx as f32, y - cy as f32);
                let corner = cy * w + cx;
                let (top, bottom) = (&view.gray[corner..][..2], &view.gray[corner + w..][..2]);
                let (t, u) = (top[0] + fx * (top[1] - top[0]), bottom[0] + fx * (bottom[1] - bottom[0]));
                patch[k] = t + fy * (u - t);
                sum += patch[k];
                k += 1;
            }
        }
        let mean = sum / PATCH as f32;
        let mut square = 0f32;
        for v in patch.iter_mut() {
            *v -= mean;
            square += *v * *v;
        }
        let shows = square >= LEAST_CONTRAST * LEAST_CONTRAST * PATCH as f32;
        let scale = if shows { 1.0 / square.sqrt() } else { 0.0 };
        patch.iter_mut().for_each(|v| *v *= scale);
        shows
    }
}

/// A surfel in the photographs that see it.
struct Matching<'a> {
    views: &'a [StereoView],
    visible: Vec<Projected>,
    patches: Vec<[f32; PATCH]>,
}

impl Matching<'_> {
    /// Mean correlation of all pairs.
    fn score(&mut self, displacement: Displacement) -> f32 {
        let mut sum = [0f32; PATCH];
        let mut shown = 0;
        for (p, patch) in self.visible.iter().zip(&mut self.patches) {
            shown += i32::from(p.look_up(&self.views[p.view], displacement, patch));
            (0..PATCH).for_each(|k| sum[k] += patch[k]);
        }
        let n = self.visible.len() as f32;
        let square: f32 = sum.iter().map(|s| s * s).sum();
        (square - shown as f32) / (n * (n - 1.0))
    }

    /// Leaves photographs out that do not fit the others at a displacement. Returns whether all fitted.
    fn keep_fitting(&mut self, displacement: Displacement) -> bool {
        self.score(displacement);
        let n = self.visible.len();
        let fits = |v: usize| {
            let with = |w: usize| (0..PATCH).map(|k| self.patches[v][k] * self.patches[w][k]).sum::<f32>();
            // the better half of the others: an outlier among them should not condemn this one
            let mut others: Vec<f32> = (0..n).filter(|&w| w != v).map(with).collect();
            others.sort_by(|a, b| b.total_cmp(a));
            let best = &others[..others.len().div_ceil(2)];
            best.iter().sum::<f32>() / best.len() as f32 >= LEAST_FIT
        };
        let kept: Vec<Projected> = (0..n).filter(|&v| fits(v)).map(|v| self.visible[v]).collect();
        self.patches.truncate(kept.len());
        self.visible = kept;
        self.visible.len() == n
    }

    /// The shift of the highest peak over the range, and the step between shifts. `None` where it is not inside or not
    /// alone, or where the views are too much alike to tell.
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

    /// The peak near a shift, with its score and second derivative.
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
                at.tilt[k] = (at.tilt[k] + TILT * steps_to_peak(around)).clamp(-MOST_TILT, MOST_TILT);
            }
        }
        // the tilt moved the peak a little
        at.shift += step * steps_to_peak(self.scores_around(at, step));
        let (offset, score, curvature) = parabola(self.scores_around(at, step), step)?;
        at.shift += offset;
        Some((at, score, curvature))
    }

    /// Scores with the shift one `step` less, as it is, and one more.
    fn scores_around(&mut self, at: Displacement, step: f32) -> [f32; 3] {
        [-step, 0.0, step].map(|d| self.score(Displacement { shift: at.shift + d, ..at }))
    }
}

/// How many steps to go from the middle of three values towards their peak, one at most.
fn steps_to_peak([before, middle, after]: [f32; 3]) -> f32 {
    let (slope, curvature) = (0.5 * (after - before), 2.0 * middle - before - after);
    if curvature > 1e-6 { (slope / curvature).clamp(-1.0, 1.0) } else { slope.signum() }
}

/// The peak of the parabola through three values one `step` apart, whose middle is the highest: its offset from the
/// middle, its value and its negative second derivative.
fn parabola([before, middle, after]: [f32; 3], step: f32) -> Option<(f32, f32, f32)> {
    let curvature = 2.0 * middle - before - after;
    if before > middle || after > middle || curvature <= 1e-6 {
        return None;
    }
    let offset = 0.5 * (after - before) / curvature;
    Some((offset * step, middle + 0.25 * (after - before) * offset, curvature / (step * step)))
}

/// Views that see a surfel, most frontal first.
fn visible_in(views: &[StereoView], s: &Surfel) -> Vec<usize> {
    let sees = |view: &StereoView| {
        let way = view.camera.position.as_vec3() - s.position;
        let cosine = way.normalize().dot(s.normal);
        let (pixel, depth) = view.camera.project(s.position).filter(|_| cosine >= LEAST_COSINE)?;
        let (w, h) = (view.camera.width as usize, view.camera.height as usize);
        if !(pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w as f32 && pixel.y < h as f32) {
            return None;
        }
        let (x, y) = (pixel.x as usize, pixel.y as usize);
        let nearest = view.depth[y / view.cell * w.div_ceil(view.cell) + x / view.cell];
        // a cell's depth differs from the point's by the surface's slope, and hypotheses go as far
        let reach = (REACH + 1.5 * view.cell as f32) * depth / view.camera.fx as f32;
        (view.usable[y * w + x] && depth <= nearest + reach).then_some(cosine)
    };
    let mut visible: Vec<(f32, usize)> =
        views.iter().enumerate().filter_map(|(v, view)| Some((sees(view)?, v))).collect();
    visible.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    visible.into_iter().map(|(_, v)| v).collect()
}

/// Views that see a surfel, where enough of them do, most frontal first, and the length of a pixel of the first there.
fn frontal(views: &[StereoView], s: &Surfel) -> Option<(Vec<usize>, f32)> {
    let visible = Some(visible_in(views, s)).filter(|visible| visible.len() >= LEAST_VIEWS)?;
    let camera = &views[visible[0]].camera;
    let (_, depth) = camera.project(s.position)?;
    Some((visible, depth / camera.fx as f32))
}

/// Length of a pixel at a surfel, where `view` is the most frontal of the views that see it and enough of them do:
/// of all views that find a point one keeps it.
pub fn owned(views: &[StereoView], view: usize, s: &Surfel) -> Option<f32> {
    frontal(views, s).filter(|(visible, _)| visible[0] == view).map(|(_, footprint)| footprint)
}

fn match_one(views: &[StereoView], s: &Surfel) -> Option<StereoPoint> {
    let (visible, footprint) = frontal(views, s)?;
    let first = s.normal.any_orthonormal_vector();
    let axes = [first, s.normal.cross(first)];
    let visible: Vec<Projected> = visible
        .into_iter()
        .take(MOST_VIEWS)
        .filter_map(|v| Projected::new(v, &views[v].camera, s, axes, footprint))
        .collect();
    if visible.len() < LEAST_VIEWS {
        return None;
    }
    let mut matching = Matching { views, patches: vec![[0f32; PATCH]; visible.len()], visible };
    let (mut shift, mut step) = matching.search()?;
    if !matching.keep_fitting(Displacement { shift, tilt: Vec2::ZERO }) {
        if matching.visible.len() < LEAST_VIEWS {
            return None;
        }
        (shift, step) = matching.search()?;
    }
    let (at, score, curvature) = matching.refine(shift, step)?;
    let sigma = ((1.0 - score).max(0.0) / curvature).sqrt();
    if score < LEAST_SCORE || sigma > MOST_SIGMA || at.shift.abs() > REACH {
        return None;
    }
    Some(StereoPoint {
        position: s.position + at.shift * footprint * s.normal,
        normal: (s.normal - at.tilt.x * axes[0] - at.tilt.y * axes[1]).normalize(),
        footprint,
        sigma,
    })
}

/// Points where the photographs agree, in the order of `surfels`; many have none.
pub fn matches(views: &[StereoView], surfels: &[Surfel]) -> Vec<StereoPoint> {
    surfels.par_iter().with_min_len(64).filter_map(|s| match_one(views, s)).collect()
}

/// Those of `points` that half of their neighbors confirm; the points lie about `spacing` apart.
pub fn confirmed(points: &[StereoPoint], spacing: f32) -> Vec<StereoPoint> {
    /// Neighbors are within so many spacings.
    const NEAR: f32 = 2.5;
    /// How far a neighbor's plane may pass the point, in footprints.
    const AGREE: f32 = 0.5;
    /// Neighbors that a point must have.
    const LEAST: u32 = 4;
    let near = NEAR * spacing;
    let cell = |p: Vec3| (p / near).floor().to_array().map(|c| c as i32);
    let mut cells: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
    for (i, p) in points.iter().enumerate() {
        cells.entry(cell(p.position)).or_default().push(i as u32);
    }
    let is_confirmed = |i: usize, p: &StereoPoint| {
        let [x, y, z] = cell(p.position);
        let (mut neighbors, mut agree) = (0, 0);
        for k in 0..27 {
            for &j in cells.get(&[x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1]).into_iter().flatten() {
                let q = &points[j as usize];
                let way = p.position - q.position;
                // not the other side of a thin part
                if j as usize == i || way.length() > near || p.normal.dot(q.normal) < 0.5 {
                    continue;
                }
                neighbors += 1;
                let off = way.dot((p.normal + q.normal).normalize());
                agree += u32::from(off.abs() < AGREE * p.footprint);
            }
        }
        neighbors >= LEAST && 2 * agree >= neighbors
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
