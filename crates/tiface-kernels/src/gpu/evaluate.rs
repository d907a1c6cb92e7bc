//! Evaluation of a trained signed-distance field on a device, in batches that fill the device.

use super::batch::DeviceBatch;
use super::device::{Buffer, Device};
use super::march::Samples;
use super::neus::Neus;
use super::occupancy::Occupancy;
use super::sdf::Sdf;
use crate::cpu::neus::{ColorRule, RAY_WIDTH};
use crate::cpu::sdf::FieldShape;
use std::ops::Range;
use tiface_base::Result;
use tiface_base::geom::{BitGrid, Ray};

/// Number of samples evaluated together, which takes about two hundred megabytes of memory; fewer
/// in tests, which drivers in software run.
const CAPACITY: usize = if cfg!(test) { 1 << 15 } else { 1 << 17 };

/// Smaller capacities for fewer points, because planes are copied whole.
const FEWER: [usize; 2] = [1 << 10, 1 << 14];

/// Number of rays marched together.
const RAYS: usize = CAPACITY / 8;

/// Transposes rows `[n, W]` to planes `[W, capacity]`.
pub fn planes<const W: usize>(rows: &[[f32; W]], capacity: usize) -> Vec<f32> {
    let mut out = vec![0.0; W * capacity];
    for (i, row) in rows.iter().enumerate() {
        (0..W).for_each(|k| out[k * capacity + i] = row[k]);
    }
    out
}

/// A field on a device, with the buffers for its evaluation.
pub struct Evaluator {
    device: Device,
    /// Networks with buffers for [`CAPACITY`] samples, and for [`FEWER`].
    sdf: Sdf,
    fewer: [Sdf; 2],
    table: Buffer,
    flat: Buffer,
    inv_s: Buffer,
    occupancy: Occupancy,
    /// Buffers of volume renders, allocated by the first one.
    rays: Option<(Samples, Neus)>,
}

impl Evaluator {
    /// Returns whether devices can evaluate a field of this shape.
    pub fn supports(shape: &FieldShape) -> bool {
        Sdf::supports(shape)
    }

    /// Uploads a field: its table, `[entries, 2]`, network weights, sharpness, and the cells to
    /// march through with those that are solid.
    pub fn new(
        device: Device,
        shape: &FieldShape,
        table: &[f32],
        flat: &[f32],
        inv_s: f32,
        [occupied, solid]: [Option<&BitGrid>; 2],
    ) -> Evaluator {
        let of = |capacity: usize| {
            let mut sdf = Sdf::new(&device, shape, capacity);
            sdf.activate(shape.active);
            sdf
        };
        let (sdf, fewer) = (of(CAPACITY), FEWER.map(of));
        let everywhere = BitGrid::filled(2, true);
        Evaluator {
            table: device.upload(table),
            flat: device.upload(flat),
            inv_s: device.upload(&[inv_s]),
            occupancy: Occupancy::new(&device, occupied.unwrap_or(&everywhere), solid, shape.radius),
            sdf,
            fewer,
            rays: None,
            device,
        }
    }

    /// Evaluates `channels` of the eight outputs sdf, gradient (3), color (3) and logarithm of the
    /// local sharpness at points, a plane `[n]` each.
    ///
    /// # Shapes
    ///
    /// - x, direction: `[n, 3]`; without directions the colors are meaningless
    /// - normal: `[n, 3]`, normals that replace the field's as inputs of the color network
    pub fn evaluate(
        &self,
        x: &[[f32; 3]],
        direction: Option<&[[f32; 3]]>,
        normal: Option<&[[f32; 3]]>,
        channels: Range<usize>,
    ) -> Result<Vec<Vec<f32>>> {
        let device = &self.device;
        let mut out = vec![Vec::with_capacity(x.len()); channels.len()];
        for first in (0..x.len()).step_by(CAPACITY) {
            let span = first..(first + CAPACITY).min(x.len());
            let mut sizes = FEWER.into_iter().zip(&self.fewer).chain([(CAPACITY, &self.sdf)]);
            let (capacity, sdf) = sizes.find(|(c, _)| *c >= span.len()).expect("no span is longer");
            let upload = |rows: &[[f32; 3]]| device.upload(&planes(&rows[span.clone()], capacity));
            let at = upload(x);
            let view_dir = direction.map(upload);
            let normal = normal.map(upload);
            let count = device.upload(&[span.len() as u32]);
            let seen = sdf.shade(
                device,
                [&self.table, &self.flat],
                &at,
                view_dir.as_ref().unwrap_or(&at),
                normal.as_ref(),
                &count,
            );
            let all = device.fetch_part(seen, channels.start * capacity..channels.end * capacity)?;
            for (own, plane) in out.iter_mut().zip(all.chunks_exact(capacity)) {
                own.extend_from_slice(&plane[..span.len()]);
            }
        }
        Ok(out)
    }

    /// Renders rays with march steps of `step`, and returns `[rays, 9]`: see
    /// [`crate::cpu::neus::forward`]. All calls have the same `colors`.
    pub fn render(&mut self, rays: &[Ray], step: f32, colors: ColorRule) -> Result<Vec<[f32; RAY_WIDTH]>> {
        let device = &self.device;
        let step = device.upload(&[step]);
        let made = || (Samples::new(device, RAYS, CAPACITY), Neus::new(device, RAYS, CAPACITY, colors));
        let (samples, neus) = self.rays.get_or_insert_with(made);
        let mut out = Vec::with_capacity(rays.len());
        while out.len() < rays.len() {
            let own = &rays[out.len()..(out.len() + RAYS).min(rays.len())];
            let batch = DeviceBatch::upload(device, own, &[], RAYS);
            samples.march(device, &self.occupancy, &batch, &step, usize::MAX, 0);
            let (x, view_dir, count) = (&samples.x, &samples.direction, &samples.count);
            let field = self.sdf.forward(device, &self.table, &self.flat, x, view_dir, count);
            let composited = neus.forward(device, &batch, samples, field, &self.inv_s, 1.0);
            let seen: Vec<f32> = device.fetch(composited)?;
            let alive: Vec<u32> = device.fetch(&batch.alive)?;
            // Rays that exceeded the sample capacity are marched again with the next batch.
            let done = alive[..own.len()].iter().position(|&a| a == 0).unwrap_or(own.len());
            assert!(done > 0, "one ray has more samples than the buffers hold");
            out.extend((0..done).map(|r| std::array::from_fn(|k| seen[k * RAYS + r])));
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::super::case_tests::Case;
    use super::super::testing::{agree, device};
    use super::*;
    use crate::cpu::march::MarchCells;
    use crate::cpu::mlp::Weights;
    use crate::cpu::sdf;
    use tiface_base::math::rng;

    #[test]
    fn what_is_asked_is_what_the_cpu_answers() {
        let Some(device) = device() else { return };
        let Case { shape, table, flat, x, direction, .. } = Case::new(700, 5, true, 5);
        let weights = Weights::new(shape.layout(), &flat);
        let flatten = |rows: Vec<[f32; 3]>| rows.into_flattened();
        let mut mask = BitGrid::filled(8, true);
        (0..512).step_by(3).for_each(|i| mask.set(i, false));
        let mut evaluator =
            Evaluator::new(device, &shape, table.as_flattened(), &flat, 20.0, [Some(&mask), None]);

        // one point, some, and more than a small batch holds
        for n in [1, 700, 1100] {
            let some: Vec<[f32; 3]> = x.iter().copied().cycle().take(n).collect();
            let got = evaluator.evaluate(&some, None, None, 0..1).unwrap();
            let want: Vec<f32> =
                sdf::gradients(&shape, &table, &weights, &some).iter().map(|w| w.0).collect();
            agree("distances of a few", &got[0], &want, 1e-4);
        }
        let got = evaluator.evaluate(&x, None, None, 0..4).unwrap();
        let want = sdf::gradients(&shape, &table, &weights, &x);
        agree("distances", &got[0], &want.iter().map(|w| w.0).collect::<Vec<_>>(), 1e-4);
        for axis in 0..3 {
            agree("slopes", &got[1 + axis], &want.iter().map(|w| w.1[axis]).collect::<Vec<_>>(), 1e-4);
        }
        let soft = evaluator.evaluate(&x, None, None, 7..8).unwrap();
        agree("softness", &soft[0], &sdf::softness(&shape, &table, &weights, &x), 1e-4);
        // any unit vectors as normals
        let normal: Vec<[f32; 3]> = direction.iter().rev().copied().collect();
        let got = evaluator.evaluate(&x, Some(&direction), Some(&normal), 4..7).unwrap();
        let want = sdf::colors(&shape, &table, &weights, &x, &normal, None, &direction);
        agree("colors", &got.concat(), &planes(&want, x.len()), 1e-4);

        // More rays and more samples than the buffers hold: 4,300 of about 15.
        let step = 0.16;
        let rays: Vec<Ray> = (0..4_300)
            .map(|i| {
                let d = direction[i % 700];
                let origin: [f32; 3] =
                    std::array::from_fn(|a| -3.0 * d[a] + rng::normal(1, 2, (3 * i + a) as u64));
                Ray::new(origin, d)
            })
            .collect();
        let cells = MarchCells::new(&mask, None);
        let colors = ColorRule { min_weight: 1e-4, group_weight: 0.05 };
        let marched = |rays: &[Ray]| cells.march(shape.radius, step, rays, &[], usize::MAX);
        assert!(rays.len() > RAYS && marched(&rays[..RAYS]).t.len() > CAPACITY);
        let got = evaluator.render(&rays, step, colors).unwrap();
        assert_eq!(got.len(), rays.len());
        let some: Vec<usize> = (0..rays.len()).step_by(7).collect();
        let few: Vec<Ray> = some.iter().map(|&r| rays[r]).collect();
        let samples = marched(&few);
        let (x, d) = samples.points(&few);
        let field = sdf::forward(&shape, &table, &weights, &x, &d);
        let along: Vec<[f32; 3]> = few.iter().map(|r| r.direction.to_array()).collect();
        let dt = vec![step; x.len()];
        let segments = crate::cpu::neus::Segments {
            offsets: &samples.offsets,
            direction: &along,
            t: &samples.t,
            dt: &dt,
            colors,
        };
        let want = crate::cpu::neus::forward(segments, field.output(), 20.0, 1.0);
        let got: Vec<[f32; RAY_WIDTH]> = some.iter().map(|&r| got[r]).collect();
        agree("renders", got.as_flattened(), &want, 1e-4);
        assert!(flatten(x).len() > 20_000);
    }
}
