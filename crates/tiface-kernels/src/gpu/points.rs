//! Stereo points, which the surface should pass through. Each step draws some of them and evaluates
//! them together with its samples, after which they are stored.
//!
//! With `f` the distance at a point, `p` the length of a pixel at the point, and `w` its weight,
//! the mean over the points of a step of `w (√((f / p)² + k²) − k)`.

use super::device::{Buffer, Device, Words, groups, launch};
use super::march::Samples;
use super::rng::{Wide, below, stream};
use super::vec3::Vec3;
use crate::cpu::losses::{LossWeights, STEREO_STREAM};
use crate::cpu::sdf::WIDTH;
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 256;

/// Number of floats of a point: position (3), length of a pixel, weight.
const ROW: usize = 5;

/// Draws points and writes them after the samples of a step; the total number goes to `total`.
#[cube(launch)]
fn append(
    rows: &[f32],
    count: &[u32],
    total: &mut [u32],
    drawn: &mut [u32],
    x: &mut [f32],
    view_dir: &mut [f32],
    available: u32,
    per_step: u32,
    stream: Wide,
) {
    let i = ABSOLUTE_POS;
    let plane = x.len() / 3;
    let first = count[0];
    // a step without samples gets no points either
    let points = select(first > 0, per_step, 0u32);
    if i < points as usize {
        let which = below(&stream, u32::cast_from(i), available);
        drawn[i] = which;
        let s = first as usize + i;
        Vec3::read(rows, 1usize, which as usize * ROW).write(x, plane, s);
        // any direction will do, because the color of points is not used
        Vec3::new(0.0f32, 0.0f32, 1.0f32).write(view_dir, plane, s);
    }
    if i == 0 {
        total[0] = first + points;
    }
}

/// Writes the loss terms of points, `[points]`, and the gradients with respect to the field's
/// output at the points.
#[cube(launch)]
fn of_points(
    rows: &[f32],
    drawn: &[u32],
    count: &[u32],
    total: &[u32],
    field: &[f32],
    g_field: &mut [f32],
    terms: &mut [f32],
    weight: f32,
    knee: f32,
) {
    let i = ABSOLUTE_POS;
    let plane = field.len() / comptime!(WIDTH);
    let points = (total[0] - count[0]) as usize;
    if i < terms.len() {
        let mut term = 0.0f32;
        if i < points {
            let s = count[0] as usize + i;
            let row = drawn[i] as usize * ROW;
            let share = rows[row + 4] / f32::cast_from(points);
            let pixel = 1.0f32 / rows[row + 3];
            let offset = field[s] * pixel;
            let root = (offset * offset + knee * knee).sqrt();
            term = share * (root - knee);
            g_field[s] = weight * share * offset / root * pixel;
            #[unroll]
            for k in 1..8usize {
                g_field[k * plane + s] = 0.0f32;
            }
        }
        terms[i] = term;
    }
}

/// Stereo points on a device, of which each step draws some.
pub struct SurfacePoints {
    rows: Buffer,
    count: usize,
    weights: LossWeights,
    drawn: Buffer,
    terms: Buffer,
    total: Buffer,
}

impl SurfacePoints {
    /// Creates an empty set of points, of which each step draws `max_per_step`.
    pub fn new(device: &Device, max_per_step: usize, weights: &LossWeights) -> SurfacePoints {
        SurfacePoints {
            rows: device.zeros::<f32>(ROW),
            count: 0,
            weights: *weights,
            drawn: device.zeros::<u32>(max_per_step),
            terms: device.zeros::<f32>(max_per_step),
            total: device.zeros::<u32>(1),
        }
    }

    /// Replaces the points. Each row holds the position in field coordinates, the length of a pixel
    /// at the point, and the weight.
    pub fn set(&mut self, device: &Device, rows: &[[f32; ROW]]) {
        self.count = rows.len();
        self.terms = device.zeros::<f32>(self.max_per_step());
        if self.count > 0 {
            self.rows = device.upload(rows.as_flattened());
        }
    }

    /// Returns the number of points that a step draws.
    pub fn max_per_step(&self) -> usize {
        self.terms.word_count()
    }

    /// Draws points by seed and step, writes them after the step's samples, and returns the number
    /// of samples and points, `[1]`.
    pub fn append(&self, device: &Device, (seed, step): (u64, u64), samples: &Samples) -> &Buffer {
        let stream = stream(seed, step << 4 | STEREO_STREAM);
        launch!(device, append::launch, groups(self.max_per_step().div_ceil(UNITS as usize)), UNITS;
            self.rows, samples.count, self.total, self.drawn, samples.x, samples.direction;
            self.count as u32, if self.count > 0 { self.max_per_step() as u32 } else { 0 }, stream
        );
        &self.total
    }

    /// Writes the gradients with respect to the field's output at a step's points, after those of
    /// its samples, planes `[8, capacity]`. `count` is the number of samples without points.
    pub fn losses(&self, device: &Device, field: &Buffer, count: &Buffer, g_field: &Buffer) {
        if self.count == 0 {
            return;
        }
        launch!(device, of_points::launch, groups(self.max_per_step().div_ceil(UNITS as usize)), UNITS;
            self.rows, self.drawn, count, self.total, field, g_field, self.terms;
            self.weights.stereo, self.weights.knee
        );
    }

    /// Returns the unweighted contribution of each point of the last step to the loss,
    /// `[max_per_step]`.
    pub fn terms(&self) -> &Buffer {
        &self.terms
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{agree, device};
    use super::*;
    use tiface_base::math::rng;

    #[test]
    fn points_follow_the_samples_and_have_the_gradients_of_their_loss() {
        let Some(device) = device() else { return };
        const PLANE: usize = 64;
        let rows: Vec<[f32; 5]> =
            (0..7).map(|i| [i as f32, 10.0 + i as f32, -1.0, 0.02 + 0.001 * i as f32, 0.5]).collect();
        let mut points = SurfacePoints::new(
            &device,
            20,
            &LossWeights { stereo: 3.0, knee: 0.15, ..LossWeights::default() },
        );
        let mut samples = Samples::new(&device, 4, PLANE);
        samples.count = device.upload(&[40u32, 40]);
        // the set is empty at first
        assert_eq!(device.read::<u32>(points.append(&device, (3, 9), &samples)), [40]);
        points.set(&device, &rows);
        assert_eq!(device.read::<u32>(points.append(&device, (3, 9), &samples)), [60]);
        let which: Vec<usize> =
            (0..20).map(|i| rng::below(3, 9 << 4 | STEREO_STREAM, i, 7) as usize).collect();
        let x = device.read::<f32>(&samples.x);
        let d = device.read::<f32>(&samples.direction);
        for (i, &w) in which.iter().enumerate() {
            let at = |v: &[f32]| [0, 1, 2].map(|a| v[a * PLANE + 40 + i]);
            assert_eq!((at(&x), at(&d)), ([rows[w][0], rows[w][1], rows[w][2]], [0.0, 0.0, 1.0]));
        }
        let f: Vec<f32> = (0..20).map(|i| 0.03 * rng::normal(1, 1, i)).collect();
        let mut field = vec![9f32; 8 * PLANE];
        field[40..60].copy_from_slice(&f);
        let (field, g) = (device.upload(&field), device.upload(&vec![7f32; 8 * PLANE]));
        points.losses(&device, &field, &samples.count, &g);
        let loss = |f: f64, row: &[f32; 5]| {
            let off = f / row[3] as f64;
            row[4] as f64 * ((off * off + 0.15 * 0.15).sqrt() - 0.15) / 20.0
        };
        let each = |i: usize, h: f64| loss(f[i] as f64 + h, &rows[which[i]]);
        let want: Vec<f32> = (0..20).map(|i| each(i, 0.0) as f32).collect();
        agree("points", &device.read::<f32>(points.terms()), &want, 1e-5);
        let slope = |i: usize| (3.0 * (each(i, 1e-7) - each(i, -1e-7)) / 2e-7) as f32;
        let g = device.read::<f32>(&g);
        agree("points' gradients", &g[40..60], &(0..20).map(slope).collect::<Vec<_>>(), 1e-5);
        // gradients of samples do not change, and those by a point's other outputs are zero
        assert!(g[..40].iter().all(|&g| g == 7.0) && g[PLANE + 40..PLANE + 60].iter().all(|&g| g == 0.0));
        // a step without samples has no points
        samples.count = device.upload(&[0u32, 0]);
        assert_eq!(device.read::<u32>(points.append(&device, (3, 9), &samples)), [0]);
    }
}
