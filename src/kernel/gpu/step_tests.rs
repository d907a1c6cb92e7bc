//! All of them together: a field learns a sphere from its silhouettes, and nobody waits for the device.

use super::device::tests::{device, devices, planes};
use super::*;
use crate::kernel::adam::AdamStep;
use crate::kernel::march::Bitmask;
use crate::kernel::mlp::{HIDDEN, OUTPUTS};
use crate::kernel::sdf::FieldShape;
use crate::kernel::{hash, rng};

const RAYS: usize = 128;
const CAPACITY: usize = 1 << 12;

/// A sphere of radius 0.5 of which half is red and half is blue, seen from anywhere at distance 2.
struct Pixels {
    origin: Vec<[f32; 3]>,
    direction: Vec<[f32; 3]>,
    color: Vec<[f32; 3]>,
    alpha: Vec<f32>,
}

fn pixels(step: u64) -> Pixels {
    let mut all = Pixels { origin: vec![], direction: vec![], color: vec![], alpha: vec![] };
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let unit = |v: [f32; 3]| v.map(|c| c / dot(v, v).sqrt());
    for r in 0..RAYS as u64 {
        let normal = |k: u64| rng::normal(1, step, 8 * r + k);
        let origin = unit([normal(0), normal(1), normal(2)]).map(|c| 2.0 * c);
        let aim = [normal(3), normal(4), normal(5)].map(|c| 0.4 * c);
        let direction = unit(std::array::from_fn(|a| aim[a] - origin[a]));
        let b = dot(origin, direction);
        let root = b * b - 4.0 + 0.25;
        let hit = root > 0.0;
        let z = origin[2] - (b + root.max(0.0).sqrt()) * direction[2];
        let color = if z > 0.0 { [0.8, 0.2, 0.2] } else { [0.2, 0.2, 0.8] };
        all.origin.push(origin);
        all.direction.push(direction);
        all.color.push(if hit { color } else { [0.0; 3] });
        all.alpha.push(f32::from(hit));
    }
    all
}

/// Parameters of a network that starts as a sphere of radius 1 (see `iface::model`).
fn start(shape: &FieldShape) -> Vec<f32> {
    let layout = shape.layout();
    let normal = |stream: u64, i: usize| rng::normal(2, stream, i as u64);
    let first = (2.0 / HIDDEN as f32).sqrt();
    let k = layout.inputs;
    let v1: Vec<f32> = (0..HIDDEN * k).map(|i| if i % k < 3 { first * normal(1, i) } else { 0.0 }).collect();
    let mean = (std::f32::consts::PI / HIDDEN as f32).sqrt();
    let v2: Vec<f32> = (0..OUTPUTS * HIDDEN)
        .map(|i| if i < HIDDEN { mean + 1e-4 * normal(2, i) } else { first * normal(2, i) })
        .collect();
    let lengths = |v: &[f32], n: usize| -> Vec<f32> {
        v.chunks(n).map(|row| row.iter().map(|x| x * x).sum::<f32>().sqrt()).collect()
    };
    let (g1, g2) = (lengths(&v1, k), lengths(&v2, HIDDEN));
    let mut raw = [v1, g1, vec![0.0; HIDDEN], v2, g2].concat();
    raw.push(-0.8);
    raw.extend([0.0; OUTPUTS - 1]);
    let colors: usize = layout.shapes()[4..].iter().map(|(o, i)| o * i).sum();
    raw.extend((0..colors).map(|i| 0.15 * normal(3, i)));
    raw
}

/// What some steps came to.
struct Trained {
    /// Launches of a step.
    launches: usize,
    first: Vec<f32>,
    last: Vec<f32>,
    table: Vec<u32>,
}

fn train(device: &Device, steps: u64) -> Trained {
    let levels = hash::levels(5, 4, 1.6, 12);
    let shape = FieldShape { levels, radius: 1.0, active: 5, color_skip: true, soften: 1.5 };
    let entries = hash::entries(&shape.levels);
    let network = Norm::new(device, shape.layout());
    let on = Sdf::new(device, &shape, CAPACITY);
    let samples = Samples::new(device, RAYS, CAPACITY);
    let neus = Neus::new(device, RAYS, CAPACITY);
    let weights = LossWeights {
        rgb_mse: 10.0,
        rgb_l1: 0.0,
        rgb_sample: 1.0,
        mask: 0.5,
        eikonal: 0.1,
        sparsity: 0.0,
        sparsity_scale: 1.0,
    };
    let losses = Losses::new(device, weights, RAYS, CAPACITY);
    let occupancy = Occupancy::new(device, &Bitmask::filled(16, true), None, 1.0);
    let small: Vec<f32> = (0..2 * entries as u64).map(|i| 2e-4 * rng::uniform(3, 1, i) - 1e-4).collect();
    let moments = |n: usize| [device.zeros(n), device.zeros(n), device.zeros(n)];
    let (table, [m_table, v_table, g_table]) = (device.upload(&small), moments(2 * entries));
    let (raw, [m_raw, v_raw, g_raw]) = (device.upload(&start(&shape)), moments(network.parameters()));
    let (variance, [m_s, v_s, g_s]) = (device.upload(&[0.3f32]), moments(1));
    let (flat, g_flat) = (device.zeros(shape.layout().len()), device.zeros(shape.layout().len()));
    let (inv_s, g_inv_s) = (device.zeros(1), device.zeros(1));
    let pitch = device.upload(&[0.08f32]);
    let (broken, no_points) = (device.zeros(1), device.zeros(1));
    let mut trained = Trained { launches: 0, first: vec![], last: vec![], table: vec![] };
    for step in 0..steps {
        let seen = pixels(step);
        let batch = Batch {
            origin: device.upload(&planes(&seen.origin, RAYS)),
            direction: device.upload(&planes(&seen.direction, RAYS)),
            color: device.upload(&planes(&seen.color, RAYS)),
            alpha: device.upload(&seen.alpha),
            alive: device.upload(&[1u32; RAYS]),
            ..Batch::new(device, RAYS)
        };
        let (launches, readbacks) = device.counts();

        network.forward(device, &raw, &variance, [-1.38, 1.38], &flat, &inv_s);
        samples.march(device, &occupancy, &batch, &pitch, 64, 0);
        let Samples { offsets, count, t, dt, x, direction: along, .. } = &samples;
        let field = on.forward(device, &table, &flat, x, along, count);
        let rays = Rays { offsets, direction: &batch.direction, t, dt };
        let composed = neus.forward(device, rays, field, &inv_s, 1.0);
        let g_out = losses.of_rays(device, composed, &batch, offsets);
        let g_field = neus.backward(device, rays, field, &inv_s, 1.0, g_out, &g_inv_s);
        losses.of_samples(device, field, count, g_field);
        on.backward(device, x, along, count, g_field, &g_table, &g_flat);
        network.backward(device, &raw, &inv_s, [&g_flat, &g_inv_s], [&g_raw, &g_s], &broken);
        let of_network = AdamStep {
            lr: 2e-3,
            beta1: 0.9,
            beta2: 0.99,
            epsilon: 1e-15,
            weight_decay: 0.0,
            step: step + 1,
            skip_zero: false,
        };
        let gate = Gate { count, broken: &broken };
        adam(device, [&raw, &m_raw, &v_raw], &g_raw, &of_network, gate);
        adam(device, [&variance, &m_s, &v_s], &g_s, &of_network, gate);
        let of_table = AdamStep { skip_zero: true, ..of_network };
        adam(device, [&table, &m_table, &v_table], &g_table, &of_table, gate);

        let after = device.counts();
        assert_eq!(after.1, readbacks, "a step reads nothing back");
        trained.launches = after.0 - launches;
        trained.last = device.read(losses.sums(device, count, &no_points));
        if step == 0 {
            trained.first = trained.last.clone();
        }
    }
    trained.table = device.read(&table);
    println!(
        "{:?}: {} launches a step, losses {:.4?} to {:.4?}",
        device.atomics(),
        trained.launches,
        trained.first,
        trained.last
    );
    trained
}

#[test]
fn a_field_learns_a_sphere_and_nothing_is_read_back() {
    let Some(device) = device() else { return };
    let Trained { launches, first, last, .. } = train(&device, 30);
    assert!(launches <= 40, "{launches} launches");
    // color and mask are learned, the field stays a distance
    assert!(last[0] < 0.5 * first[0] && last[3] < 0.5 * first[3] && last[4] < 0.1, "{first:?} {last:?}");
}

#[test]
fn all_ways_to_add_learn_alike_and_whole_numbers_the_same_bytes() {
    let found: Vec<(Atomics, Trained)> = devices().iter().map(|d| (d.atomics(), train(d, 3))).collect();
    for (way, trained) in &found {
        let (last, first) = (&trained.last, &found[0].1.last);
        assert!(last.iter().zip(first).all(|(a, b)| (a - b).abs() < 0.01 * b.abs() + 1e-6), "{way:?}");
    }
    let Some((device, (_, before))) = devices().pop().zip(found.last()) else { return };
    assert_eq!(device.atomics(), Atomics::Fixed);
    assert!(train(&device, 3).table == before.table, "the same steps give the same bytes");
}
