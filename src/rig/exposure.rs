//! Exposure and white balance of photographs, from points of the head that several of them show.
//!
//! In linear light, the logarithm of what view `v` shows of point `p` is `point_p + view_v`. A robust fit (Cauchy weights, points
//! eliminated) of points on the visual hull in blurred photographs gives both, except for a constant that is taken to be 0 in
//! the mean of the training views.
//!
//! Skin is not Lambertian: grazing skin and glare make what a view shows brighter by a few per cent, smoothly over the viewing
//! directions, and the fit cannot tell that from exposure. What is linear in the viewing direction is therefore taken out of
//! the exposures, which leaves 0.7 to 1.9 % instead of 3 to 4 % on captures of one exposure. Colors have little of it, and keep it.
//!
//! Vignetting is not measured: one number for each lens in the same equations came out between −0.24 and +0.11 on captures
//! without any, since grazing skin lies at the outline.

use super::adjust::{median, solve};
use super::tracks::{HEAD, MIN_VIEWS, Seed, blurred, is_set, seeds};
use crate::geom::{Camera, Mesh};
use crate::image::{Exposure, Gray, Photo, eroded, linear_from_srgb};
use glam::DVec3;
use rayon::prelude::*;
use std::ops::Range;

/// Points spread over the surface.
const POINTS: usize = 6000;

/// Deviation of the blur, pixels: what a hull that lies some pixels off still shows alike.
const BLUR: f32 = 3.0;

/// Pixels around each that must be usable.
const MARGIN: usize = 3;

/// Coded values that are neither saturated nor as dark as hair, whose highlights move with the view.
const EXPOSED: Range<u8> = 40..248;

/// Minimum number of training views; with fewer, exposure and direction cannot be told apart.
const MIN_TRAINING_VIEWS: usize = 8;

/// Points that a view must show.
pub const MIN_POINTS: usize = 50;

/// Minimum cosine between the normal and the direction to the camera.
const MIN_COSINE: f32 = 0.35;

/// Root mean square of logarithms from which on exposures or colors differ. Captures of one exposure reach 0.019 and 0.013.
const MIN_SPREAD: f64 = 0.025;

/// Logarithm of a single view's brightness from which on exposures differ. Captures of one exposure reach 0.044.
const MIN_ALONE: f64 = 0.08;

/// Rounds of the robust fits.
const ROUNDS: usize = 12;

/// Least residual of half weight, of logarithms.
const MIN_SCALE: f64 = 0.005;

/// A photograph prepared for the measurement.
pub struct ExposureView {
    width: usize,
    /// Blurred light of each channel.
    light: [Vec<f32>; 3],
    usable: Vec<bool>,
}

impl ExposureView {
    /// Prepares a photograph; `head` is its mask, of the same size.
    pub fn new(photo: &Photo, head: &Gray) -> ExposureView {
        let (w, h) = (photo.width as usize, photo.height as usize);
        let linear: Vec<f32> = (0..=255u8).map(|b| linear_from_srgb(f32::from(b) / 255.0)).collect();
        let channel = |k: usize| -> Vec<f32> {
            blurred(&photo.rgb.iter().map(|c| linear[usize::from(c[k])]).collect::<Vec<_>>(), w, BLUR)
        };
        let exposed =
            |(color, &mask): (&[u8; 3], &u8)| mask >= HEAD && color.iter().all(|c| EXPOSED.contains(c));
        let inside = photo.rgb.iter().zip(&head.values).map(exposed).collect();
        ExposureView { width: w, light: [0, 1, 2].map(channel), usable: eroded(inside, w, h, MARGIN) }
    }
}

/// What was measured.
#[derive(Clone, Debug, PartialEq)]
pub struct ExposureFit {
    /// Exposure of every view; those of training views have a geometric mean of 1 in each channel.
    pub exposures: Vec<Exposure>,
    /// How many of the first are training views.
    pub train: usize,
    /// How many points each view shows.
    pub points: Vec<usize>,
    /// Root mean square of the logarithms of the training views' brightness.
    pub brightness_spread: f64,
    /// The same of their colors.
    pub color_spread: f64,
}

impl ExposureFit {
    /// Returns whether brightness differs enough to be evened out.
    pub fn brightness_differs(&self) -> bool {
        let train = self.exposures.iter().take(self.train);
        let most = train.map(|e| f64::from(e.brightness()).ln().abs()).fold(0.0, f64::max);
        self.brightness_spread >= MIN_SPREAD || most >= MIN_ALONE
    }

    /// Returns whether colors differ enough to be evened out.
    pub fn color_differs(&self) -> bool {
        self.color_spread >= MIN_SPREAD
    }
}

/// What one view shows of one point.
struct Sample {
    view: usize,
    /// Logarithm of the light of each channel.
    light: [f64; 3],
}

/// Measures exposures. The first `train` views are the training views, which alone decide what is common; the others are
/// compared with it one by one. `None` where too little can be compared.
pub fn measure(
    views: &[ExposureView],
    cameras: &[Camera],
    train: usize,
    surface: &Mesh,
) -> Option<ExposureFit> {
    let spread = seeds(surface, cameras, |v, pixel| is_set(&views[v].usable, views[v].width, pixel), POINTS);
    let points: Vec<Vec<Sample>> =
        spread.par_iter().with_min_len(64).map(|seed| samples(views, cameras, seed)).collect();
    let points: Vec<Vec<Sample>> = points
        .into_iter()
        .filter(|samples| samples.iter().filter(|s| s.view < train).count() >= MIN_VIEWS)
        .collect();
    let mut counts = vec![0; views.len()];
    points.iter().flatten().for_each(|s| counts[s.view] += 1);
    if train < MIN_TRAINING_VIEWS || counts[..train].iter().any(|&n| n < MIN_POINTS) {
        return None;
    }
    let fitted: Vec<Vec<f64>> =
        (0..3).into_par_iter().map(|k| fit_channel(&points, k, views.len(), train)).collect::<Option<_>>()?;
    let logs: Vec<[f64; 3]> = (0..views.len()).map(|v| [0, 1, 2].map(|k| fitted[k][v])).collect();
    let logs = without_direction(&logs, cameras, train);
    let square = |v: f64| v * v;
    let brightness = |log: &[f64; 3]| log.iter().sum::<f64>() / 3.0;
    let rms = |sum: f64| (sum / train as f64).sqrt();
    let color = |log: &[f64; 3]| log.iter().map(|l| square(l - brightness(log))).sum::<f64>() / 3.0;
    let exposure = |log: &[f64; 3]| Exposure { gain: log.map(|l| l.exp() as f32) };
    Some(ExposureFit {
        exposures: logs.iter().map(exposure).collect(),
        train,
        points: counts,
        brightness_spread: rms(logs[..train].iter().map(|log| square(brightness(log))).sum()),
        color_spread: rms(logs[..train].iter().map(color).sum()),
    })
}

/// Returns what the views show of a point.
fn samples(views: &[ExposureView], cameras: &[Camera], seed: &Seed) -> Vec<Sample> {
    let sample = |&v: &usize| {
        let (pixel, _) = cameras[v].project(seed.position)?;
        let to_camera = (cameras[v].position.as_vec3() - seed.position).normalize();
        if to_camera.dot(seed.normal) < MIN_COSINE {
            return None;
        }
        let view = &views[v];
        let i = pixel.y as usize * view.width + pixel.x as usize;
        Some(Sample { view: v, light: [0, 1, 2].map(|k| f64::from(view.light[k][i]).ln()) })
    };
    seed.views.iter().filter_map(sample).collect()
}

/// Returns the logarithms of the views' gains in one channel.
fn fit_channel(points: &[Vec<Sample>], k: usize, views: usize, train: usize) -> Option<Vec<f64>> {
    fn known(samples: &[Sample], train: usize) -> impl Iterator<Item = &Sample> {
        samples.iter().filter(move |s| s.view < train)
    }
    let mut x = vec![0.0; train];
    let mut offset = vec![0.0; points.len()];
    let mut scale = 1.0;
    for round in 0..ROUNDS {
        let (mut matrix, mut vector) = (vec![0.0; train * train], vec![0.0; train]);
        for (samples, offset) in points.iter().zip(&offset) {
            let weight = |s: &&Sample| match round {
                0 => 1.0,
                _ => 1.0 / (1.0 + ((s.light[k] - x[s.view] - offset) / scale).powi(2)),
            };
            let weighted: Vec<(f64, &Sample)> = known(samples, train).map(|s| (weight(&s), s)).collect();
            let total: f64 = weighted.iter().map(|(w, _)| w).sum();
            let mean = weighted.iter().map(|(w, s)| w * s.light[k]).sum::<f64>() / total;
            // every point's own constant is eliminated
            for (a, s) in &weighted {
                matrix[train * s.view + s.view] += a;
                weighted.iter().for_each(|(b, t)| matrix[train * s.view + t.view] -= a * b / total);
                vector[s.view] -= a * (s.light[k] - mean);
            }
        }
        // the mean of all views is open
        matrix.iter_mut().for_each(|m| *m += 1.0);
        x = solve(matrix, &vector)?;
        let mut residuals = Vec::new();
        for (samples, offset) in points.iter().zip(&mut offset) {
            let values: Vec<f64> = known(samples, train).map(|s| s.light[k] - x[s.view]).collect();
            *offset = median(&mut values.clone());
            residuals.extend(values.iter().map(|v| (v - *offset).abs()));
        }
        scale = (2.0 * median(&mut residuals)).max(MIN_SCALE);
    }
    let mut others = vec![Vec::new(); views - train];
    for (samples, offset) in points.iter().zip(&offset) {
        for s in samples.iter().filter(|s| s.view >= train) {
            others[s.view - train].push(s.light[k] - offset);
        }
    }
    x.extend(others.iter_mut().map(|values| median(values)));
    Some(x)
}

/// Takes out of the brightness what is linear in the viewing direction, as a robust fit to the training views finds it, and
/// leaves a mean of 0 over these.
fn without_direction(logs: &[[f64; 3]], cameras: &[Camera], train: usize) -> Vec<[f64; 3]> {
    /// Keeps directions that the cameras do not tell apart, such as the height of a turntable's, out of the fit.
    const RIDGE: f64 = 1e-3;
    let row = |c: &Camera| {
        let DVec3 { x, y, z } = c.position.normalize_or_zero();
        [1.0, x, y, z]
    };
    let rows: Vec<[f64; 4]> = cameras.iter().map(row).collect();
    let brightness = |log: &[f64; 3]| log.iter().sum::<f64>() / 3.0;
    let mut slopes = vec![0.0; 4];
    let fitted = |slopes: &[f64], row: &[f64; 4]| row.iter().zip(slopes).map(|(a, b)| a * b).sum::<f64>();
    let mut scale = f64::INFINITY;
    for _ in 0..ROUNDS {
        let (mut matrix, mut vector) = (vec![0.0; 16], vec![0.0; 4]);
        for (row, log) in rows.iter().zip(logs).take(train) {
            let w = 1.0 / (1.0 + ((brightness(log) - fitted(&slopes, row)) / scale).powi(2));
            for i in 0..4 {
                (0..4).for_each(|j| matrix[4 * i + j] += w * row[i] * row[j]);
                vector[i] -= w * row[i] * brightness(log);
            }
        }
        (1..4).for_each(|i| matrix[5 * i] += RIDGE);
        let Some(found) = solve(matrix, &vector) else { break };
        slopes = found;
        let off = rows
            .iter()
            .zip(logs)
            .take(train)
            .map(|(row, log)| (brightness(log) - fitted(&slopes, row)).abs());
        scale = (2.0 * median(&mut off.collect::<Vec<f64>>())).max(MIN_SCALE);
    }
    let mut left: Vec<[f64; 3]> =
        logs.iter().zip(&rows).map(|(log, row)| log.map(|l| l - fitted(&slopes, row))).collect();
    for k in 0..3 {
        let mean = left[..train].iter().map(|log| log[k]).sum::<f64>() / train as f64;
        left.iter_mut().for_each(|log| log[k] -= mean);
    }
    left
}
