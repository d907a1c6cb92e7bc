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
//! the table. Colors are evaluated where a sample shows, as in training. CPU time (user + system of
//! the process) is what is compared: it does not depend on what else the machine does. Times of
//! networks stand beside their share of the processor's peak in f32, that of the optimizer beside
//! its share of the memory's.

mod process;

use process::cpu_s;
use process::roof::Roof;
use tiface::kernel::cpu::adam::{AdamStep, adam};
use tiface::kernel::cpu::hash;
use tiface::kernel::cpu::losses::{self, LossWeights, Targets};
use tiface::kernel::cpu::mlp::{HIDDEN, OUTPUTS, OUTPUTS_PADDED, RGB_PADDED, Weights};
use tiface::kernel::cpu::neus::{self, ColorRule, Segments};
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

const COLORS: ColorRule = ColorRule { min_weight: 1e-4, group_weight: 0.05 };

const STEP: AdamStep = AdamStep {
    lr: 1e-4,
    beta1: 0.9,
    beta2: 0.99,
    epsilon: 1e-15,
    weight_decay: 0.0,
    step: 5,
    skip_zero: true,
};

/// A step; adds the CPU seconds of each kernel. Returns the number of samples that show.
fn kernels(i: &Input, state: &mut [Vec<f32>; 4], parts: &mut [f64; 7]) -> usize {
    let mut clock = cpu_s();
    let mut lap = |k: usize| {
        let now = cpu_s();
        parts[k] += now - clock;
        clock = now;
    };
    let w = Weights::new(i.shape.layout(), &i.flat);
    let [p, m, v, g] = state;
    let mut a = sdf::geometry(&i.shape, bytemuck::cast_slice(p), &w, &i.x);
    lap(0);
    let segments =
        Segments { offsets: &i.offsets, direction: &i.directions, t: &i.t, dt: &i.dt, colors: COLORS };
    let weights = neus::weights(segments, a.output(), 20.0, 0.5);
    lap(1);
    let sources = neus::color_sources(segments, &weights);
    let shown = neus::shown(&sources);
    let colors = shown.len();
    a.shade(&w, shown, &i.d);
    lap(5);
    let out = neus::composite(segments, a.output(), &weights, &sources);
    lap(1);
    let targets =
        Targets { offsets: &i.offsets, color: &i.directions, alpha: &i.alpha, background: &i.directions };
    let (_, g_out) = losses::of_rays(&out, targets, &WEIGHTS);
    lap(2);
    let (mut g_field, _) = neus::composite_backward(segments, a.output(), &sources, 20.0, 0.5, &g_out);
    lap(1);
    losses::of_samples(a.output(), &WEIGHTS, &mut g_field);
    lap(2);
    let g_network = sdf::backward(&a, &w, &g_field, bytemuck::cast_slice_mut(g));
    lap(3);
    let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
    assert!(finite(&out) && finite(&g_network) && finite(g), "a value or a gradient is not finite");
    drop(a);
    lap(6);
    adam(p, m, v, g, &STEP);
    lap(4);
    colors
}

/// Operations of the networks in a step with `shown` colors: geometry, color, backward.
fn operations(i: &Input, shown: usize) -> [f64; 3] {
    let (layout, samples, shown) = (i.shape.layout(), N as f64, shown as f64);
    let (inputs, colors) = (layout.padded(), layout.color_padded());
    // multiply-adds of a sample: outputs, then the gradient by the inputs
    let geometry = HIDDEN * (2 * inputs + OUTPUTS_PADDED);
    let color = HIDDEN * (colors + HIDDEN + RGB_PADDED);
    // gradients by weights and by what they multiply; of the first layer also second order
    let by_geometry = HIDDEN * (4 * inputs + OUTPUTS + OUTPUTS_PADDED);
    let by_color = HIDDEN * (2 * colors + 2 * HIDDEN + 4 + 3);
    let twice = |multiply_adds: usize| 2.0 * multiply_adds as f64;
    [twice(geometry) * samples, twice(color) * shown, twice(by_geometry) * samples + twice(by_color) * shown]
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
    let roof = Roof::measure();
    let repeat = 10;
    let start = [i.table.clone(), vec![0.0; 2 * entries], vec![0.0; 2 * entries], vec![0.0; 2 * entries]];
    let mut state = start.clone();
    let mut parts = [0.0; 7];
    kernels(&i, &mut state, &mut [0.0; 7]);
    let mut again = start;
    kernels(&i, &mut again, &mut [0.0; 7]);
    assert!(state == again, "the same step gives other bytes");
    let mut shown = 0;
    for _ in 0..repeat {
        shown = kernels(&i, &mut state, &mut parts);
    }
    let [geometry, neus, losses, backward, adam, color, _] = parts.map(|p| 1e3 * p / repeat as f64);
    let step = geometry + neus + losses + backward + adam + color;
    let of = operations(&i, shown);
    println!(
        "a step {step:.1} CPU ms, {:.0} k samples per core-second, {shown} of {N} samples show: geometry {}, color {}, \
         NeuS {neus:.1}, losses {losses:.1}, backward {}, AdamW {}",
        N as f64 / step,
        roof.computed(geometry, of[0]),
        roof.computed(color, of[1]),
        roof.computed(backward, of[2]),
        // at most: three arrays and the gradient, read and written
        roof.moved(adam, (8 * 4 * 2 * entries) as f64),
    );
}
