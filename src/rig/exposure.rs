//! Exposure, white balance and vignetting of photographs, from points of the head that several of them show.
//!
//! In linear light, the logarithm of what view `v` shows of point `p` is `point_p + view_v − lens_l · r²`. A robust fit (Cauchy
//! weights, points eliminated) of points on the visual hull in blurred photographs gives all three, except for a constant
//! that is taken to be 0 in the mean of the training views.
//!
//! Skin is not Lambertian: grazing skin and glare make what a view shows brighter by a few per cent, smoothly over the viewing
//! directions, and the fit cannot tell that from exposure. What is linear in the viewing direction is therefore taken out of
//! the exposures, which leaves errors of some 0.8 % instead of 2.5 %. Colors have little of it, and keep it.

use super::adjust::{median, solve};
use super::tracks::{HEAD, MIN_VIEWS, Seed, blurred, is_set, seeds};
use crate::geom::{Camera, Mesh};
use crate::image::{Exposure, Gray, Photo, corner_share, eroded, linear_from_srgb};
use glam::DVec3;
use rayon::prelude::*;
use std::ops::Range;

/// Points spread over the surface.
const POINTS: usize = 6000;

/// Deviation of the blur, pixels: what a hull that lies some pixels off still shows alike.
const BLUR: f32 = 3.0;

/// Pixels around each that must be usable.
const MARGIN: usize = 3;

/// Coded values that are neither saturated nor mostly noise.
const EXPOSED: Range<u8> = 12..248;

/// Minimum number of training views; with fewer, exposure and direction cannot be told apart.
const LEAST_VIEWS: usize = 8;

/// Points that a view must show.
const LEAST_POINTS: usize = 50;

/// Training views that must share a lens for its vignetting to be measured.
const LEAST_SHARING: usize = 8;

/// Root mean square of logarithms from which on exposures or colors differ: that of clean captures is below 0.01.
const LEAST_SPREAD: f64 = 0.015;

/// Logarithm of what corners lose from which on vignetting is divided out.
const LEAST_VIGNETTING: f64 = 0.05;

/// Rounds of the robust fits.
const ROUNDS: usize = 12;

/// Least residual of half weight, of logarithms.
const LEAST_SCALE: f64 = 0.005;

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

    fn size(&self) -> (u32, u32) {
        (self.width as u32, (self.usable.len() / self.width.max(1)) as u32)
    }
}

/// What was measured.
#[derive(Clone, Debug, PartialEq)]
pub struct ExposureFit {
    /// Exposure of every view; those of training views have a geometric mean of 1 in each channel.
    pub exposures: Vec<Exposure>,
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
        self.brightness_spread >= LEAST_SPREAD
    }

    /// Returns whether colors differ enough to be evened out.
    pub fn color_differs(&self) -> bool {
        self.color_spread >= LEAST_SPREAD
    }
}

/// What one view shows of one point.
struct Sample {
    view: usize,
    /// Logarithm of the light of each channel.
    light: [f64; 3],
    /// [`corner_share`] of where it lies.
    corner: f64,
}

/// Measures exposures. The first `train` views are the training views, which alone decide what is common; the others are
/// compared with it one by one. `lenses` has a number for each view, the same for views that share a lens. `None` where too
/// little can be compared.
pub fn measure(
    views: &[ExposureView],
    cameras: &[Camera],
    lenses: &[usize],
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
    if train < LEAST_VIEWS || counts[..train].iter().any(|&n| n < LEAST_POINTS) {
        return None;
    }
    let shared = |l: &usize| lenses[..train].iter().filter(|other| *other == l).count() >= LEAST_SHARING;
    let lens: Vec<Option<usize>> = lenses.iter().map(|l| Some(*l).filter(shared)).collect();
    let count = lens.iter().flatten().max().map_or(0, |l| l + 1);
    let fitted: Vec<Channel> = (0..3)
        .into_par_iter()
        .map(|k| Channel::fit(&points, k, &lens, count, train))
        .collect::<Option<_>>()?;
    let vignetting: Vec<f64> = (0..count)
        .map(|l| fitted.iter().map(|c| c.lenses[l]).sum::<f64>() / 3.0)
        .map(|v| if v >= LEAST_VIGNETTING { v } else { 0.0 })
        .collect();
    let fitted: Vec<Channel> = match vignetting.iter().all(|v| *v == 0.0) {
        false => fitted,
        // the equations show none: views alone
        true => {
            let none = vec![None; views.len()];
            (0..3)
                .into_par_iter()
                .map(|k| Channel::fit(&points, k, &none, 0, train))
                .collect::<Option<_>>()?
        }
    };
    let logs: Vec<[f64; 3]> = (0..views.len()).map(|v| [0, 1, 2].map(|k| fitted[k].views[v])).collect();
    let logs = without_direction(&logs, cameras, train);
    let square = |v: f64| v * v;
    let brightness = |log: &[f64; 3]| log.iter().sum::<f64>() / 3.0;
    let rms = |sum: f64| (sum / train as f64).sqrt();
    let color = |log: &[f64; 3]| log.iter().map(|l| square(l - brightness(log))).sum::<f64>() / 3.0;
    let exposure = |(log, lens): (&[f64; 3], &Option<usize>)| Exposure {
        gain: log.map(|l| l.exp() as f32),
        vignetting: lens.map_or(0.0, |l| vignetting[l] as f32),
    };
    Some(ExposureFit {
        exposures: logs.iter().zip(&lens).map(exposure).collect(),
        points: counts,
        brightness_spread: rms(logs[..train].iter().map(|log| square(brightness(log))).sum()),
        color_spread: rms(logs[..train].iter().map(color).sum()),
    })
}

/// Returns what the views show of a point.
fn samples(views: &[ExposureView], cameras: &[Camera], seed: &Seed) -> Vec<Sample> {
    let sample = |&v: &usize| {
        let (pixel, _) = cameras[v].project(seed.position)?;
        let view = &views[v];
        let i = pixel.y as usize * view.width + pixel.x as usize;
        let corner = f64::from(corner_share((pixel.x, pixel.y), view.size()));
        Some(Sample { view: v, light: [0, 1, 2].map(|k| f64::from(view.light[k][i]).ln()), corner })
    };
    seed.views.iter().filter_map(sample).collect()
}

/// The fit of one channel.
struct Channel {
    /// Logarithms of the views' gains.
    views: Vec<f64>,
    /// Vignetting of the lenses.
    lenses: Vec<f64>,
}

impl Channel {
    /// Fits views and lenses to what the views show of points.
    fn fit(
        points: &[Vec<Sample>],
        k: usize,
        lens: &[Option<usize>],
        lenses: usize,
        train: usize,
    ) -> Option<Channel> {
        let n = train + lenses;
        let mut x = vec![0.0; n];
        let mut scale = 1.0;
        let mut offset = vec![0.0; points.len()];
        let value = |x: &[f64], s: &Sample| {
            let vignetting = lens[s.view].map_or(0.0, |l| x[train + l] * s.corner);
            s.light[k] + vignetting - if s.view < train { x[s.view] } else { 0.0 }
        };
        for round in 0..ROUNDS {
            let (mut matrix, mut vector) = (vec![0.0; n * n], vec![0.0; n]);
            for (samples, offset) in points.iter().zip(&offset) {
                let known = || samples.iter().filter(|s| s.view < train);
                // every point's own constant is eliminated: columns less their weighted mean
                let (mut total, mut mean, mut light) = (0.0, vec![(0, 0.0); 0], 0.0);
                for s in known() {
                    let w = match round {
                        0 => 1.0,
                        _ => 1.0 / (1.0 + ((value(&x, s) - offset) / scale).powi(2)),
                    };
                    let columns = [Some((s.view, 1.0)), lens[s.view].map(|l| (train + l, -s.corner))];
                    for (i, a) in columns.into_iter().flatten() {
                        for (j, b) in columns.into_iter().flatten() {
                            matrix[n * i + j] += w * a * b;
                        }
                        vector[i] -= w * a * s.light[k];
                        mean.push((i, w * a));
                    }
                    total += w;
                    light += w * s.light[k];
                }
                for &(i, a) in &mean {
                    mean.iter().for_each(|&(j, b)| matrix[n * i + j] -= a * b / total);
                    vector[i] += a * light / total;
                }
            }
            // the mean of all views is open
            (0..train * train).for_each(|i| matrix[n * (i / train) + i % train] += 1.0);
            (train..n).for_each(|i| matrix[n * i + i] += 1e-6);
            x = solve(matrix, &vector)?;
            let mut residuals = Vec::new();
            for (samples, offset) in points.iter().zip(&mut offset) {
                let known = || samples.iter().filter(|s| s.view < train).map(|s| value(&x, s));
                *offset = median(&mut known().collect::<Vec<f64>>());
                residuals.extend(known().map(|v| (v - *offset).abs()));
            }
            scale = (2.0 * median(&mut residuals)).max(LEAST_SCALE);
        }
        let mean = x[..train].iter().sum::<f64>() / train as f64;
        let mut views: Vec<f64> = x[..train].iter().map(|g| g - mean).collect();
        let mut others = vec![Vec::new(); lens.len() - train];
        for (samples, offset) in points.iter().zip(&offset) {
            for s in samples.iter().filter(|s| s.view >= train) {
                others[s.view - train].push(value(&x, s) - offset - mean);
            }
        }
        views.extend(others.iter_mut().map(|values| median(values)));
        Some(Channel { views, lenses: x.split_off(train) })
    }
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
        scale = (2.0 * median(&mut off.collect::<Vec<f64>>())).max(LEAST_SCALE);
    }
    let mut left: Vec<[f64; 3]> =
        logs.iter().zip(&rows).map(|(log, row)| log.map(|l| l - fitted(&slopes, row))).collect();
    for k in 0..3 {
        let mean = left[..train].iter().map(|log| log[k]).sum::<f64>() / train as f64;
        left.iter_mut().for_each(|log| log[k] -= mean);
    }
    left
}
