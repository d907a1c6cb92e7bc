//! One training step of the signed-distance field, three ways, in CPU time.
//!
//! ```text
//! cargo bench --bench iface_step            # all threads
//! RAYON_NUM_THREADS=1 cargo bench --bench iface_step
//! ```
//!
//! The published networks: no color skip, one sharpness (a whole draft takes a seventh more CPU time with both).
//!
//! 32 768 samples (256 rays of 128), 16 levels of 2 features, tables of 2¹⁹ entries, base 16, growth
//! 1.447; color, mask and eikonal losses, backward to every parameter, AdamW. CPU time (user + system of
//! the process) is what is compared: it does not depend on what else the machine does.

mod process;

use burn::tensor::{Device, Int, Tensor, TensorData};
use process::cpu_s;
use std::sync::Arc;
use tiface::field::parameters::Parameter;
use tiface::field::{self, ops};
use tiface::kernel::adam::{AdamStep, adam};
use tiface::kernel::hash;
use tiface::kernel::mlp::{Layout, Weights};
use tiface::kernel::neus::{self, Rays};
use tiface::kernel::rng;
use tiface::kernel::sdf::{self, FieldShape};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const RAYS: usize = 256;
const PER_RAY: usize = 128;
const N: usize = RAYS * PER_RAY;

struct Input {
    shape: Arc<FieldShape>,
    table: Vec<f32>,
    flat: Vec<f32>,
    x: Vec<[f32; 3]>,
    d: Vec<[f32; 3]>,
    t: Vec<f32>,
    dt: Vec<f32>,
    offsets: Vec<i32>,
    directions: Vec<[f32; 3]>,
}

fn input() -> Input {
    let levels = hash::levels(16, 16, 1.447_269_237_440_378, 19);
    let shape = Arc::new(FieldShape { levels, radius: 1.0, active: 16, color_skip: false, soften: 0.0 });
    let u = |s: u64, i: usize| 2.0 * rng::uniform(9, s, i as u64) - 1.0;
    let table = (0..2 * hash::entries(&shape.levels)).map(|i| 1e-4 * u(1, i)).collect();
    let flat = (0..shape.layout().len()).map(|i| 0.2 * u(2, i)).collect();
    let mut i = Input {
        shape,
        table,
        flat,
        x: vec![],
        d: vec![],
        t: vec![],
        dt: vec![1.0 / PER_RAY as f32; N],
        offsets: (0..=RAYS).map(|r| (r * PER_RAY) as i32).collect(),
        directions: vec![],
    };
    for r in 0..RAYS {
        let o = [0.9 * u(3, 3 * r), 0.9 * u(3, 3 * r + 1), -0.5];
        let d = [0.1 * u(4, 2 * r), 0.1 * u(4, 2 * r + 1), 1.0f32];
        let len = (d[0] * d[0] + d[1] * d[1] + 1.0).sqrt();
        let d = d.map(|c| c / len);
        i.directions.push(d);
        for k in 0..PER_RAY {
            let t = (k as f32 + 0.5) / PER_RAY as f32;
            i.x.push([o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]].map(|c| c.clamp(-0.99, 0.99)));
            i.d.push(d);
            i.t.push(t);
        }
    }
    i
}

const STEP: AdamStep = AdamStep {
    lr: 1e-4,
    beta1: 0.9,
    beta2: 0.99,
    epsilon: 1e-15,
    weight_decay: 0.0,
    step: 5,
    skip_zero: true,
};

/// Kernels alone, no burn: the bound.
fn kernels(i: &Input, state: &mut [Vec<f32>; 4], parts: &mut [f64; 5]) {
    let mut clock = cpu_s();
    let mut lap = |k: usize| {
        let now = cpu_s();
        parts[k] += now - clock;
        clock = now;
    };
    let w = Weights::new(i.shape.layout(), &i.flat);
    let [p, m, v, g] = state;
    let a = sdf::forward(&i.shape, bytemuck::cast_slice(p), &w, &i.x, &i.d);
    lap(0);
    let rays = Rays { offsets: &i.offsets, direction: &i.directions, t: &i.t, dt: &i.dt };
    let out = neus::forward(rays, a.output(), 20.0, 0.5);
    let g_out: Vec<f32> = out
        .chunks(8)
        .flat_map(|o| [o[0], o[1], o[2], o[3] - 1.0, 0.0, 0.0, 0.0, 0.0].map(|e| e / 768.0))
        .collect();
    let (mut g_field, _) = neus::backward(rays, a.output(), 20.0, 0.5, &g_out);
    for (g, o) in g_field.chunks_exact_mut(8).zip(a.output().chunks_exact(8)) {
        let len = (o[1] * o[1] + o[2] * o[2] + o[3] * o[3]).sqrt().max(1e-6);
        (1..4).for_each(|k| g[k] += 0.2 / N as f32 * (len - 1.0) / len * o[k]);
    }
    lap(1);
    std::hint::black_box(sdf::backward(&a, &w, &g_field, bytemuck::cast_slice_mut(g)));
    lap(2);
    drop(a);
    adam(p, m, v, g, &STEP);
    lap(3);
}

/// The step as training runs it: losses in tensors, fused operations.
fn fused(i: &Input, device: &Device, table: &mut Parameter, flat: &Tensor<1>) {
    let t = |v: &[[f32; 3]]| -> Tensor<2> {
        field::tensor(bytemuck::cast_slice(v).to_vec(), [v.len(), 3], device).autodiff()
    };
    let one = |v: &[f32]| -> Tensor<1> { field::tensor(v.to_vec(), [v.len()], device).autodiff() };
    let inv_s = one(&[20.0]).require_grad();
    let out = ops::sdf_field(table.flat(), flat.clone(), t(&i.x), t(&i.d), i.shape.clone());
    let bundle = ops::RaySamples {
        direction: t(&i.directions),
        t: one(&i.t),
        dt: one(&i.dt),
        offsets: Tensor::<1, Int>::from_data(TensorData::new(i.offsets.clone(), [RAYS + 1]), device)
            .autodiff(),
    };
    let composed = ops::neus(out.clone(), inv_s, bundle, 0.5);
    let loss = losses(composed, out.narrow(1, 1, 3));
    let mut grads = loss.backward();
    table.update(&mut grads, STEP);
}

fn losses(composed: Tensor<2>, gradient: Tensor<2>) -> Tensor<1> {
    let opacity = composed.clone().narrow(1, 3, 1).clamp(1e-3, 1.0 - 1e-3);
    let color = composed.narrow(1, 0, 3).square().mean() * 10.0;
    let mask = opacity.log().mean().neg() * 0.1;
    let length = (gradient.square().sum_dim(1) + 1e-12).sqrt();
    color + mask + (length - 1.0).square().mean() * 0.1
}

/// The same step in burn tensors alone; hash indices and weights are precomputed and not counted.
struct Plain {
    index: Tensor<1, Int>,
    weight: Tensor<3>,
    slope: Tensor<4>,
}

fn plain_input(i: &Input, device: &Device) -> Plain {
    let l = i.shape.levels.len();
    let mut index = Vec::with_capacity(N * l * 8);
    let mut weight = Vec::with_capacity(N * l * 8);
    let mut slope = Vec::with_capacity(N * l * 24);
    for x in &i.x {
        for level in &i.shape.levels {
            let x01 = x.map(|c| 0.5 * c + 0.5);
            let (cell, f) = hash::cell::<false>(level, x01);
            for k in 0..8 {
                index.push((level.offset + cell[k] as usize) as i32);
                let bit = |a: usize| k >> a & 1 == 1;
                let w: [f32; 3] = std::array::from_fn(|a| if bit(a) { f[a] } else { 1.0 - f[a] });
                weight.push(w[0] * w[1] * w[2]);
                for a in 0..3 {
                    let sign = if bit(a) { 0.5 } else { -0.5 };
                    slope.push(sign * level.scale * w[(a + 1) % 3] * w[(a + 2) % 3]);
                }
            }
        }
    }
    Plain {
        index: Tensor::<1, Int>::from_data(TensorData::new(index, [N * l * 8]), device).autodiff(),
        weight: field::tensor(weight, [N * l, 8, 1], device).autodiff(),
        slope: field::tensor(slope, [N * l, 8, 3, 1], device).autodiff(),
    }
}

fn plain(i: &Input, q: &Plain, device: &Device, table: &mut [Option<Tensor<2>>; 3], flat: &Tensor<1>) {
    let layout = Layout::new(16, false);
    let p = table[0].take().expect("kept").autodiff().require_grad();
    let mut start = 0;
    let mats: Vec<Tensor<2>> = layout
        .shapes()
        .iter()
        .map(|&(o, k)| {
            start += o * k;
            flat.clone().narrow(0, start - o * k, o * k).reshape([o, k])
        })
        .collect();
    let x: Tensor<2> = field::tensor(bytemuck::cast_slice(&i.x).to_vec(), [N, 3], device).autodiff();
    let d: Vec<f32> = i.d.iter().flat_map(|&d| tiface::kernel::sphharm::sh16(d)).collect();
    let sh: Tensor<2> = field::tensor(d, [N, 16], device).autodiff();
    let rows = p.clone().select(0, q.index.clone()).reshape([N * 16, 8, 2]);
    let features = (rows.clone() * q.weight.clone()).sum_dim(1).reshape([N, 32]);
    let jacobian = (rows.reshape([N * 16, 8, 1, 2]) * q.slope.clone()).sum_dim(1).reshape([N, 16, 3, 2]);
    let u = Tensor::cat(vec![x, features], 1); // [n, 35]
    let z = u.matmul(mats[0].clone().transpose()) + mats[1].clone().transpose();
    let y = z * 100.0;
    let h = (y.clone().abs().neg().exp() + 1.0).log() * 0.01 + y.clone().clamp_min(0.0) * 0.01;
    let s = (y.neg().exp() + 1.0).recip();
    let o = h.matmul(mats[2].clone().transpose()) + mats[3].clone().transpose();
    let grad_u = (s * mats[2].clone().narrow(0, 0, 1)).matmul(mats[0].clone()); // [n, 35]
    let through = grad_u.clone().narrow(1, 3, 32).reshape([N, 16, 1, 2]) * jacobian;
    let n = grad_u.narrow(1, 0, 3) + through.sum_dim(3).sum_dim(1).reshape([N, 3]);
    let length = (n.clone().square().sum_dim(1) + 1e-12).sqrt();
    let unit = n.clone() / length;
    let c0 = Tensor::cat(vec![o.clone(), sh, unit.clone()], 1);
    let c1 = c0.matmul(mats[4].clone().transpose()).clamp_min(0.0);
    let c2 = c1.matmul(mats[5].clone().transpose()).clamp_min(0.0);
    let rgb = (c2.matmul(mats[6].clone().transpose()).neg().exp() + 1.0).recip();
    // NeuS with rays of equal length
    let direction: Tensor<2> = field::tensor(bytemuck::cast_slice(&i.d).to_vec(), [N, 3], device).autodiff();
    let cos = (unit * direction).sum_dim(1);
    let ic = (cos.clone() * -0.5 + 0.5).clamp_min(0.0) * -0.5 - cos.neg().clamp_min(0.0) * 0.5;
    let half = ic * (0.5 / PER_RAY as f32);
    let sigmoid = |v: Tensor<2>| (v.neg().exp() + 1.0).recip();
    let sdf = o.narrow(1, 0, 1);
    let (a, b) = (sigmoid((sdf.clone() - half.clone()) * 20.0), sigmoid((sdf + half) * 20.0));
    let alpha = ((a.clone() - b + 1e-5) / (a + 1e-5)).clamp(0.0, 1.0).reshape([RAYS, PER_RAY]);
    let log = (alpha.clone().neg() + 1.0 + 1e-7).log();
    let transmittance = (log.clone().cumsum(1) - log).exp();
    let w = (alpha * transmittance).reshape([RAYS, PER_RAY, 1]);
    let color = (rgb.reshape([RAYS, PER_RAY, 3]) * w.clone()).sum_dim(1).reshape([RAYS, 3]);
    let opacity = w.sum_dim(1).reshape([RAYS, 1]);
    let loss = losses(Tensor::cat(vec![color, opacity], 1), n);
    let mut grads = loss.backward();
    let g = p.grad_remove(&mut grads).expect("the table took part");
    let [_, m, v] = [0, 1, 2].map(|k| table[k].take());
    let (m, v) = (m.expect("kept"), v.expect("kept"));
    let m = m * 0.9 + g.clone() * 0.1;
    let v = v * 0.99 + g.square() * 0.01;
    let p = p.inner() - m.clone() / (v.clone().sqrt() + 1e-15) * 1e-4;
    *table = [Some(p), Some(m), Some(v)];
}

fn main() {
    let i = input();
    let device = Device::flex();
    let entries = hash::entries(&i.shape.levels);
    println!("{N} samples, {entries} entries, {} threads", rayon::current_num_threads());
    let repeat = 10;
    let mut state = [i.table.clone(), vec![0.0; 2 * entries], vec![0.0; 2 * entries], vec![0.0; 2 * entries]];
    let mut parts = [0.0; 5];
    kernels(&i, &mut state, &mut [0.0; 5]);
    for _ in 0..repeat {
        kernels(&i, &mut state, &mut parts);
    }
    let ms = parts.map(|p| 1e3 * p / repeat as f64);
    let bound: f64 = ms.iter().sum();
    println!(
        "kernels alone     {bound:7.1} CPU ms: forward {:.1}, NeuS {:.1}, backward {:.1}, AdamW {:.1}",
        ms[0], ms[1], ms[2], ms[3]
    );
    let tables = || {
        let t = |v: Vec<f32>| -> Option<Tensor<2>> { Some(field::tensor(v, [entries, 2], &device)) };
        [t(i.table.clone()), t(vec![0.0; 2 * entries]), t(vec![0.0; 2 * entries])]
    };
    let flat: Tensor<1> = field::tensor(i.flat.clone(), [i.flat.len()], &device).autodiff().require_grad();
    let time = |name: &str, repeat: usize, run: &mut dyn FnMut()| -> f64 {
        run();
        let start = cpu_s();
        (0..repeat).for_each(|_| run());
        let ms = 1e3 * (cpu_s() - start) / repeat as f64;
        println!("{name} {ms:7.1} CPU ms: {:.0} k samples per core-second", N as f64 / ms);
        ms
    };
    let mut table = Parameter::new("table", &[2 * entries], i.table.clone(), &device);
    let step = time("training step    ", repeat, &mut || fused(&i, &device, &mut table, &flat));
    let mut table = tables();
    let q = plain_input(&i, &device);
    let tensors = time("plain burn tensors", 3, &mut || plain(&i, &q, &device, &mut table, &flat));
    println!("training step / bound {:.2}, plain / training step {:.1}", step / bound, tensors / step);
}
