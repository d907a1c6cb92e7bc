//! Exposure and white balance of photographs, from points of the head that several of them show.
//!
//! In linear light, the logarithm of what view `v` shows of point `p` is `point_p + view_v`. A
//! robust fit (Cauchy weights, points eliminated) of points on the visual hull in blurred
//! photographs gives both, except for a constant that is taken to be 0 in the mean of the training
//! views.
//!
//! Skin is not Lambertian: grazing skin and glare make what a view shows brighter by a few per
//! cent, smoothly over the viewing directions, and the fit cannot tell that from exposure. What is
//! linear in the viewing direction is therefore taken out of the exposures, which leaves 0.7 to 1.9
//! % instead of 3 to 4 % on captures of one exposure. Colors have little of it, and keep it.
//!
//! Vignetting is not measured: one number for each lens in the same equations came out between
//! −0.24 and +0.11 on captures without any, since grazing skin lies at the outline.

use super::adjust::median;
use super::tracks::{HEAD, MIN_VIEWS, Seed, is_set, seeds};
use glam::DVec3;
use rayon::prelude::*;
use std::ops::Range;
use tiface_base::geom::{Camera, Mesh};
use tiface_base::image::{Exposure, Gray, Photo, blurred, eroded, linear_from_srgb};
use tiface_base::math::cholesky::solve;

/// Points spread over the surface.
const POINTS: usize = 6000;

/// Deviation of the blur, pixels: what a hull that lies some pixels off still shows alike.
const BLUR: f32 = 3.0;

/// Pixels around each that must be usable.
const MARGIN: usize = 3;

/// Coded values that are neither saturated nor as dark as hair, whose highlights move with the
/// view.
const EXPOSED: Range<u8> = 40..248;

/// Minimum number of training views that can be measured. Four numbers describe what is linear in
/// the viewing direction; with fewer views, these would take most of the exposures along.
pub const MIN_TRAINING_VIEWS: usize = 7;

/// Points that a view must show to be measured.
const MIN_POINTS: usize = 50;

/// Minimum cosine between the normal and the direction to the camera.
const MIN_COSINE: f32 = 0.35;

/// Root mean square of logarithms from which on exposures or colors differ. Captures of one
/// exposure reach 0.019 and 0.013.
const MIN_SPREAD: f64 = 0.025;

/// Logarithm of a single view's brightness from which on exposures differ. Captures of one exposure
/// reach 0.044.
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

/// Result of the fit of exposures.
#[derive(Clone, Debug, PartialEq)]
pub struct ExposureFit {
    /// Exposure of every view, `None` where it shows too little; those of training views have a
    /// geometric mean of 1 in each channel.
    pub exposures: Vec<Option<Exposure>>,
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
        let train = self.exposures.iter().take(self.train).flatten();
        let most = train.map(|e| f64::from(e.brightness()).ln().abs()).fold(0.0, f64::max);
        self.brightness_spread >= MIN_SPREAD || most >= MIN_ALONE
    }

    /// Returns whether colors differ enough to be evened out.
    pub fn color_differs(&self) -> bool {
        self.color_spread >= MIN_SPREAD
    }
}

/// Why exposures are not compared.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Incomparable {
    /// Too few training views show enough of what others show: those where this is true.
    TooFewViews(Vec<bool>),
    /// The views do not determine exposures.
    Undetermined,
}

/// Light of one point in one view.
struct Sample {
    view: usize,
    /// Logarithm of the light of each channel.
    light: [f64; 3],
}

/// Measures exposures. The first `train` views are the training views, which alone decide what is
/// common; the others are compared with it one by one. A training view that shows too little, for
/// it is dark or saturated or sees the head from where no other does, takes no part.
pub fn measure(
    views: &[ExposureView],
    cameras: &[Camera],
    train: usize,
    surface: &Mesh,
) -> Result<ExposureFit, Incomparable> {
    let spread = seeds(surface, cameras, |v, pixel| is_set(&views[v].usable, views[v].width, pixel), POINTS);
    let points: Vec<Vec<Sample>> =
        spread.par_iter().with_min_len(64).map(|seed| samples(views, cameras, seed)).collect();
    let (points, takes_part, counts) = comparable(points, views.len(), train);
    let measured: Vec<usize> = (0..train).filter(|&v| takes_part[v]).collect();
    let count = measured.len();
    if count < MIN_TRAINING_VIEWS {
        return Err(Incomparable::TooFewViews(takes_part));
    }
    // the training views that take part, then all others
    let order: Vec<usize> = measured.into_iter().chain(train..views.len()).collect();
    let points = renumbered(points, &order, views.len());
    let cameras: Vec<Camera> = order.iter().map(|&v| cameras[v].clone()).collect();
    let fitted = (0..3).into_par_iter().map(|k| fit_channel(&points, k, order.len(), count));
    let fitted: Vec<Vec<f64>> = fitted.collect::<Option<_>>().ok_or(Incomparable::Undetermined)?;
    let logs: Vec<[f64; 3]> = (0..order.len()).map(|v| [0, 1, 2].map(|k| fitted[k][v])).collect();
    let logs = without_direction(&logs, &cameras, count);
    let square = |v: f64| v * v;
    let brightness = |log: &[f64; 3]| log.iter().sum::<f64>() / 3.0;
    let rms = |sum: f64| (sum / count as f64).sqrt();
    let color = |log: &[f64; 3]| log.iter().map(|l| square(l - brightness(log))).sum::<f64>() / 3.0;
    let mut exposures = vec![None; views.len()];
    for (&v, log) in order.iter().zip(&logs).filter(|(v, _)| counts[**v] >= MIN_POINTS) {
        exposures[v] = Some(Exposure { gain: log.map(|l| l.exp() as f32) });
    }
    Ok(ExposureFit {
        exposures,
        train,
        points: counts,
        brightness_spread: rms(logs[..count].iter().map(|log| square(brightness(log))).sum()),
        color_spread: rms(logs[..count].iter().map(color).sum()),
    })
}

/// Returns the points that enough training views show, which training views show enough of these,
/// and how many of them each view shows. Views that show too few drop out one by one, the one with
/// the fewest first: points that only they and two others show go with them.
fn comparable(
    points: Vec<Vec<Sample>>,
    views: usize,
    train: usize,
) -> (Vec<Vec<Sample>>, Vec<bool>, Vec<usize>) {
    fn is_shown(samples: &[Sample], takes_part: &[bool]) -> bool {
        let shown = |s: &&Sample| takes_part.get(s.view).is_some_and(|part| *part);
        samples.iter().filter(shown).count() >= MIN_VIEWS
    }
    let mut takes_part = vec![true; train];
    loop {
        let mut counts = vec![0; views];
        let shown = points.iter().filter(|samples| is_shown(samples, &takes_part));
        shown.flatten().for_each(|s| counts[s.view] += 1);
        let too_few = (0..train).filter(|&v| takes_part[v] && counts[v] < MIN_POINTS);
        let Some(least) = too_few.min_by_key(|&v| counts[v]) else {
            let points = points.into_iter().filter(|samples| is_shown(samples, &takes_part));
            return (points.collect(), takes_part, counts);
        };
        takes_part[least] = false;
    }
}

/// Returns the samples of the views in `order` alone, with their places there as views.
fn renumbered(points: Vec<Vec<Sample>>, order: &[usize], views: usize) -> Vec<Vec<Sample>> {
    let mut places = vec![None; views];
    order.iter().enumerate().for_each(|(place, &v)| places[v] = Some(place));
    let placed = |s: Sample| Some(Sample { view: places[s.view]?, light: s.light });
    points.into_iter().map(|samples| samples.into_iter().filter_map(placed).collect()).collect()
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
                vector[s.view] += a * (s.light[k] - mean);
            }
        }
        // the mean of all views is open
        matrix.iter_mut().for_each(|m| *m += 1.0);
        x = solve(matrix, vector)?;
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

/// Takes out of the brightness what is linear in the viewing direction, as a robust fit to the
/// training views finds it, and leaves a mean of 0 over these.
fn without_direction(logs: &[[f64; 3]], cameras: &[Camera], train: usize) -> Vec<[f64; 3]> {
    /// Keeps directions that the cameras do not tell apart, such as the height of a turntable's,
    /// out of the fit.
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
                vector[i] += w * row[i] * brightness(log);
            }
        }
        (1..4).for_each(|i| matrix[5 * i] += RIDGE);
        let Some(found) = solve(matrix, vector) else { break };
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

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(views: &[usize]) -> Vec<Sample> {
        views.iter().map(|&view| Sample { view, light: [view as f64; 3] }).collect()
    }

    #[test]
    fn a_view_that_shows_too_little_drops_out_and_the_others_stay() {
        // views 0 to 3 are training views, 4 is held out; view 2 shows 20 points, of which 10 with
        // 0 and 3 alone
        let both = (0..60).map(|_| samples(&[0, 1, 3, 4]));
        let few = (0..10).map(|_| samples(&[0, 1, 2, 3]));
        let alone = (0..10).map(|_| samples(&[0, 2, 3]));
        let unseen = (0..10).map(|_| samples(&[1, 4]));
        let points: Vec<_> = both.chain(few).chain(alone).chain(unseen).collect();
        let (points, takes_part, counts) = comparable(points, 5, 4);
        assert_eq!(takes_part, [true, true, false, true]);
        assert_eq!((points.len(), &counts[..]), (70, &[70, 70, 10, 70, 60][..]));
        let points = renumbered(points, &[0, 1, 3, 4], 5);
        let [first, last] = [&points[0], &points[69]].map(|p| p.iter().map(|s| s.view).collect::<Vec<_>>());
        assert_eq!((first, last), (vec![0, 1, 2, 3], vec![0, 1, 2]));
        assert_eq!(points[69][2].light, [3.0; 3]);
    }

    #[test]
    fn views_without_a_point_leave_nothing_to_compare() {
        let (points, takes_part, counts) = comparable(Vec::new(), 3, 2);
        assert!(points.is_empty() && takes_part == [false; 2] && counts == [0; 3]);
    }
}
