//! The kernels of one training step of the signed-distance field, in CPU time.
//!
//! ```text
//! cargo bench --bench iface_step            # all threads
//! RAYON_NUM_THREADS=1 cargo bench --bench iface_step
//! ```
//!
//! The published networks: no color skip, one sharpness (a whole draft takes a seventh more CPU
//! time with both).
//!
//! 32 768 samples (256 rays of 128), 16 levels of 2 features, tables of 2¹⁹ entries, base 16,
//! growth 1.447; color, mask and eikonal losses, backward to table and network weights, AdamW of
//! the table. CPU time (user + system of the process) is what is compared: it does not depend on
//! what else the machine does.

mod process;

use process::cpu_s;
use tiface::kernel::cpu::adam::{AdamStep, adam};
use tiface::kernel::cpu::hash;
use tiface::kernel::cpu::losses::{self, LossWeights, Targets};
use tiface::kernel::cpu::mlp::Weights;
use tiface::kernel::cpu::neus::{self, Segments};
use tiface::kernel::cpu::sdf::{self, FieldShape};
use tiface::math::rng;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const RAYS: usize = 256;
const PER_RAY: usize = 128;
const N: usize = RAYS * PER_RAY;

struct Input {
    shape: FieldShape,
    table: Vec<f32>,
    flat: Vec<f32>,
    x: Vec<[f32; 3]>,
    d: Vec<[f32; 3]>,
    t: Vec<f32>,
    dt: Vec<f32>,
    offsets: Vec<i32>,
    directions: Vec<[f32; 3]>,
    alpha: Vec<f32>,
}

fn input() -> Input {
    let levels = hash::levels(16, 16, 1.447_269_237_440_378, 19);
    let shape = FieldShape { levels, radius: 1.0, active: 16, color_skip: false, soften: 0.0 };
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
        alpha: (0..RAYS).map(|r| f32::from(r % 2 == 0)).collect(),
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

/// A step; adds the CPU seconds of each kernel.
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
    let segments = Segments { offsets: &i.offsets, direction: &i.directions, t: &i.t, dt: &i.dt };
    let out = neus::forward(segments, a.output(), 20.0, 0.5);
    lap(1);
    let targets =
        Targets { offsets: &i.offsets, color: &i.directions, alpha: &i.alpha, background: &i.directions };
    let (_, g_out) = losses::of_rays(&out, targets, &WEIGHTS);
    lap(2);
    let (mut g_field, _) = neus::backward(segments, a.output(), 20.0, 0.5, &g_out);
    lap(1);
    losses::of_samples(a.output(), &WEIGHTS, &mut g_field);
    lap(2);
    std::hint::black_box(sdf::backward(&a, &w, &g_field, bytemuck::cast_slice_mut(g)));
    lap(3);
    drop(a);
    adam(p, m, v, g, &STEP);
    lap(4);
}

const WEIGHTS: LossWeights = LossWeights {
    rgb_mse: 10.0,
    rgb_sample: 1.0,
    mask: 0.1,
    eikonal: 0.1,
    sparsity: 0.0,
    sparsity_scale: 1.0,
    stereo: 0.0,
    knee: 0.15,
};

fn main() {
    let i = input();
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
    let step: f64 = ms.iter().sum();
    println!(
        "a step {step:7.1} CPU ms, {:.0} k samples per core-second: forward {:.1}, NeuS {:.1}, losses {:.1}, backward {:.1}, \
         AdamW {:.1}",
        N as f64 / step,
        ms[0],
        ms[1],
        ms[2],
        ms[3],
        ms[4]
    );
}
