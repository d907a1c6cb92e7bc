//! Does a device compute what the CPU computes? Kernels of a training step on a tiny batch, before anything is trusted
//! to an adapter and its driver.

use super::adam::{Gate, adam};
use super::check::{Check, planes, worst};
use super::device::{Buffer, Device};
use super::draw::Batch;
use super::march::Samples;
use super::neus::{Neus, RAY_WIDTH, Rays};
use super::occupancy::Occupancy;
use super::sdf::Sdf;
use crate::Result;
use crate::kernel::cpu::adam::AdamStep;
use crate::kernel::cpu::march::{Bitmask, MarchRay};
use crate::kernel::cpu::mlp::Weights;
use crate::kernel::cpu::sdf::{FieldShape, WIDTH};
use crate::kernel::cpu::{self, hash, rng};

/// A field with lively weights, samples in its box seen from anywhere, and gradients of its output. Positions and
/// scales have few digits, so that the cells of all samples are found alike.
pub(super) struct Case {
    pub shape: FieldShape,
    pub table: Vec<[f32; 2]>,
    pub flat: Vec<f32>,
    pub x: Vec<[f32; 3]>,
    pub direction: Vec<[f32; 3]>,
    pub g_out: Vec<[f32; WIDTH]>,
}

impl Case {
    pub fn new(samples: usize, levels: usize, color_skip: bool, active: usize) -> Case {
        let mut levels = hash::levels(levels, 4, 1.4, 10);
        levels.iter_mut().for_each(|l| l.scale = l.scale.round());
        let soften = if color_skip { 1.5 } else { 0.0 };
        let shape = FieldShape { levels, radius: 2.0, active, color_skip, soften };
        let normal = |stream: u64, i: usize| rng::normal(7, stream, i as u64);
        let table = (0..hash::entries(&shape.levels)).map(|i| [normal(1, 2 * i), normal(1, 2 * i + 1)]);
        let at = |i: usize| rng::below(7, 2, i as u64, 1025) as f32 / 256.0 - 2.0;
        let unit = |v: [f32; 3]| {
            let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
            v.map(|c| c / length)
        };
        Case {
            table: table.map(|e| e.map(|v| 0.3 * v)).collect(),
            flat: (0..shape.layout().len()).map(|i| 0.12 * normal(3, i)).collect(),
            x: (0..samples).map(|i| [at(3 * i), at(3 * i + 1), at(3 * i + 2)]).collect(),
            direction: (0..samples).map(|i| unit([0, 1, 2].map(|k| normal(4, 3 * i + k)))).collect(),
            g_out: (0..samples).map(|i| std::array::from_fn(|k| normal(5, WIDTH * i + k))).collect(),
            shape,
        }
    }
}

/// Compares a device with the CPU.
///
/// # Errors
///
/// Where the device does not answer.
pub fn self_test(device: &Device) -> Result<Vec<Check>> {
    const SAMPLES: usize = 192;
    let mut checks = Vec::new();
    let mut check = |name, got: &[f32], want: &[f32], allowed| {
        checks.push(Check { name, error: worst(got, want), allowed });
    };
    let Case { shape, table, flat, x, direction, g_out } = Case::new(SAMPLES, 6, true, 5);

    let weights = Weights::new(shape.layout(), &flat);
    let a = cpu::sdf::forward(&shape, &table, &weights, &x, &direction);
    let mut g_table = vec![[0f32; 2]; table.len()];
    let g_flat = cpu::sdf::backward(&a, &weights, g_out.as_flattened(), &mut g_table);
    let mut field = Sdf::new(device, &shape, SAMPLES);
    field.activate(shape.active);
    let [at, toward] = [&x, &direction].map(|v| device.upload(&planes(v, SAMPLES)));
    let there = [device.upload(table.as_flattened()), device.upload(&flat)];
    let count = device.upload(&[SAMPLES as u32]);
    let out = field.forward(device, &there[0], &there[1], &at, &toward, &count);
    let rows: &[[f32; WIDTH]] = a.output().as_chunks().0;
    check("field", &device.fetch(out)?, &planes(rows, SAMPLES), 1e-4);
    let (got_table, got_flat) = (device.zeros::<f32>(2 * table.len()), device.zeros::<f32>(flat.len()));
    let g = device.upload(&planes(&g_out, SAMPLES));
    field.backward(device, &at, &toward, &count, &g, &got_table, &got_flat);
    check("gradient of the networks", &device.fetch(&got_flat)?, &g_flat, 1e-4);
    check("gradient of the table", &device.fetch(&got_table)?, g_table.as_flattened(), 1e-4);

    let rays: Vec<MarchRay> = (0..32)
        .map(|i| {
            let origin: [f32; 3] = std::array::from_fn(|a| -2.5 * direction[i][a] + 0.1 * x[i][a]);
            MarchRay { origin, direction: direction[i], jitter: i as f32 / 32.0 }
        })
        .collect();
    let mut mask = Bitmask::filled(8, true);
    (0..512).step_by(3).for_each(|i| mask.set(i, false));
    let marched = cpu::march::march(&mask, None, 2.0, 0.25, &rays, 100);
    let batch = Batch::of_rays(device, &rays, rays.len());
    let samples = Samples::new(device, rays.len(), 1024);
    let occupancy = Occupancy::new(device, &mask, None, 2.0);
    samples.march(device, &occupancy, &batch, &device.upload(&[0.25f32]), 100, 0);
    let n = marched.t.len();
    let (offsets, t) = (device.fetch::<i32>(&samples.offsets)?, device.fetch::<f32>(&samples.t)?);
    let alike = offsets == marched.offsets;
    check("marching", if alike { &t[..n] } else { &[f32::NAN] }, &marched.t, 1e-5);

    let along: Vec<[f32; 3]> = rays.iter().map(|r| r.direction).collect();
    let dt = vec![0.25f32; n];
    let bundle = cpu::neus::Rays { offsets: &marched.offsets, direction: &along, t: &marched.t, dt: &dt };
    let values: Vec<[f32; WIDTH]> = (0..n).map(|i| rows[i % SAMPLES]).collect();
    let seen = cpu::neus::forward(bundle, values.as_flattened(), 20.0, 0.5);
    let neus = Neus::new(device, rays.len(), n);
    let [t, dt] = [&marched.t, &dt].map(|v| device.upload(v));
    let offsets = device.upload(&marched.offsets);
    let there = Rays { offsets: &offsets, direction: &batch.direction, t: &t, dt: &dt };
    let out = neus.forward(device, there, &device.upload(&planes(&values, n)), &device.upload(&[20f32]), 0.5);
    // the device composites squared colors, too
    let got = device.fetch::<f32>(out)?[..cpu::neus::RAY_WIDTH * rays.len()].to_vec();
    let seen: &[[f32; cpu::neus::RAY_WIDTH]] = seen.as_chunks().0;
    check("compositing", &got, &planes(seen, rays.len()), 1e-4);
    const { assert!(RAY_WIDTH == cpu::neus::RAY_WIDTH) };

    let step = AdamStep {
        lr: 0.01,
        beta1: 0.9,
        beta2: 0.99,
        epsilon: 1e-15,
        weight_decay: 0.02,
        step: 3,
        skip_zero: false,
    };
    let mut want = [flat.clone(), vec![0.1; flat.len()], vec![0.2; flat.len()]];
    let there: [Buffer; 3] = want.each_ref().map(|v| device.upload(v));
    let gate = Gate { count: &count, broken: &device.zeros::<u32>(1) };
    let gradient = device.upload(&g_flat);
    adam(device, there.each_ref(), &gradient, &step, gate);
    let [p, m, v] = &mut want;
    cpu::adam::adam(p, m, v, &mut g_flat.clone(), &step);
    check("optimizer", &device.fetch(&there[0])?, &want[0], 1e-5);
    checks.extend(super::vm::checks(device)?);
    Ok(checks)
}

#[cfg(test)]
mod tests {
    use super::super::device::tests::devices;
    use super::*;

    #[test]
    fn a_device_that_computes_right_passes_and_wrong_numbers_do_not() {
        for device in devices() {
            let began = std::time::Instant::now();
            let checks = self_test(&device).unwrap();
            println!("{:?} in {:.1?}: {checks:?}", device.atomics(), began.elapsed());
            assert!(checks.len() == 10 && checks.iter().all(|c| c.passed()), "{checks:?}");
        }
        let wrong = |got: f32| Check { name: "", error: worst(&[1.0, got], &[1.0, 2.0]), allowed: 1e-4 };
        assert!(wrong(2.0).passed() && !wrong(2.001).passed() && !wrong(f32::NAN).passed());
    }
}
