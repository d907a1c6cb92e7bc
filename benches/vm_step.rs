//! One training step of the vector-matrix field, two ways, in CPU time.
//!
//! ```text
//! cargo bench --bench vm_step            # all threads; a grid of the start and one of the end
//! RAYON_NUM_THREADS=1 cargo bench --bench vm_step
//! ```
//!
//! The published settings for heads: density 16, 4, 4, appearance 48, 12, 12 channels, basis 72 → 27, decoder
//! 30 → 128 → 128 → 3, 4096 rays, step ratio 0.5; color and mask loss, total variation of both grids,
//! backward to every parameter, Adam. Ours is the step as training runs it: fused operations, empty space
//! skipped before the field is touched. Plain is the published algorithm in burn tensors on the same device,
//! the whole batch at once as published; `pieces` is the same with 512 rays at a time and gradients added up,
//! which the caches like better. Before anything is timed, both must give the same rays and the same
//! gradients. `no mask` is both ways before a mask is there.
//!
//! CPU time (user + system of the process) is what is compared: it does not depend on what else the machine
//! does.

mod process;

#[path = "vm_step/plain.rs"]
mod plain;
#[path = "vm_step/scene.rs"]
mod scene;

use burn::tensor::{Device, Tensor};
use plain::{Counts, Plain};
use process::{cpu_s, peak_gib};
use scene::{Scene, scene};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use tiface::field::ops::{self, GridPenalty, VmBatch};
use tiface::field::parameters::Parameter;
use tiface::field::{tensor, values};
use tiface::kernel::adam::AdamStep;
use tiface::kernel::vm::{self, Penalty};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const RAYS: usize = 4096;
/// Pieces of rays whose tensors stay near the caches; the published batch is one piece.
const PIECE: usize = 512;
/// 0.01 · 1.0, published.
const TV: f32 = 0.01;
/// Tiny rates: every repetition meets the same field.
const GRID: AdamStep = AdamStep {
    lr: 1e-7,
    beta1: 0.9,
    beta2: 0.99,
    epsilon: 1e-8,
    weight_decay: 0.0,
    step: 5,
    skip_zero: false,
};
const NETWORK: AdamStep = AdamStep { lr: 1e-8, ..GRID };

/// Color and mask losses of the rays `own`, as their part of the whole batch's. `out` is `[own, 5]`.
pub fn losses(out: Tensor<2>, s: &Scene, own: Range<usize>, device: &Device) -> Tensor<1> {
    let (n, all) = (own.len(), s.rays.len());
    let target: Tensor<2> = tensor(s.target[3 * own.start..3 * own.end].to_vec(), [n, 3], device).autodiff();
    let background: Tensor<2> = tensor(s.background[own].to_vec(), [n, 1], device).autodiff();
    let count: f32 = s.background.iter().sum();
    let color = (out.clone().narrow(1, 0, 3).clamp(0.0, 1.0) - target).square().sum() / (3 * all) as f64;
    let mask = (out.narrow(1, 3, 1).square() * background).sum() / count;
    color + mask * 0.01
}

/// The step as training runs it.
struct Ours {
    parameters: [Parameter; 3],
    batch: Arc<VmBatch>,
    penalties: [Arc<GridPenalty>; 2],
}

impl Ours {
    fn new(s: &Scene, masked: bool, tv: f32, device: &Device) -> Ours {
        let mut field = s.field.clone();
        field.mask = field.mask.filter(|_| masked);
        let penalty = Penalty { tv, ..Penalty::default() };
        let parameter = |(name, v): (_, &Vec<f32>)| Parameter::new(name, &[v.len()], v.clone(), device);
        let all = [("density", &s.density), ("color", &s.color), ("network", &s.network)];
        Ours {
            parameters: all.map(parameter),
            penalties: [field.density, field.color].map(|grid| Arc::new(GridPenalty { grid, penalty })),
            batch: Arc::new(VmBatch::new(Arc::new(field), s.rays.clone())),
        }
    }

    fn forward(&self) -> Tensor<2> {
        let [density, color, network] = self.parameters.each_ref().map(|p| p.flat());
        let density = ops::penalized(density, self.penalties[0].clone());
        let color = ops::penalized(color, self.penalties[1].clone());
        ops::vm_render(density, color, network, self.batch.clone())
    }

    /// One step; adds the seconds of forward, backward (with the penalty), Adam.
    fn step(&mut self, s: &Scene, device: &Device, parts: &mut [f64; 3]) {
        let start = cpu_s();
        let loss = losses(self.forward(), s, 0..s.rays.len(), device);
        let forward = cpu_s();
        let mut gradients = loss.backward();
        drop(loss);
        let backward = cpu_s();
        for (p, step) in self.parameters.iter_mut().zip([GRID, GRID, NETWORK]) {
            p.update(&mut gradients, step);
        }
        let adam = cpu_s();
        for (part, s) in parts.iter_mut().zip([forward - start, backward - forward, adam - backward]) {
            *part += s;
        }
    }
}

/// Both ways must give the same rays and gradients: no error above a thousandth of the largest value.
///
/// A sample's gradient jumps where its weight passes the color threshold, its feature passes zero or a hidden
/// unit its kink, so `s` must have no ray on which rounding decides such a case.
fn compare(s: &Scene, masked: bool, tv: f32, device: &Device, plain: (Tensor<2>, Vec<Tensor<2>>)) {
    let ours = Ours::new(s, masked, tv, device);
    let out = ours.forward();
    let gradients = losses(out.clone(), s, 0..s.rays.len(), device).backward();
    let own = ours.parameters.each_ref().map(|p| values(p.flat().grad(&gradients).expect("took part")));
    let wanted = plain::flat(&plain.1);
    let column = |t: &Tensor<2>, c: Range<usize>| values(t.clone().narrow(1, c.start, c.len()));
    let out = out.inner();
    let mut pairs = vec![
        ("color", column(&out, 0..3), column(&plain.0, 0..3)),
        ("opacity", column(&out, 3..4), column(&plain.0, 3..4)),
        ("depth", column(&out, 4..5), column(&plain.0, 4..5)),
    ];
    for (name, (a, b)) in
        ["d density", "d appearance", "d network"].into_iter().zip(own.into_iter().zip(wanted))
    {
        pairs.push((name, a, b));
    }
    let mut line = String::new();
    for (name, a, b) in pairs {
        assert_eq!(a.len(), b.len());
        let largest = b.iter().fold(0f32, |m, v| m.max(v.abs()));
        let error = a.iter().zip(&b).fold(0f32, |m, (a, b)| m.max((a - b).abs())) / largest;
        line += &format!(" {name} {error:.0e}");
        assert!(error < 1e-3 && largest > 0.0, "{name}: error {error:.1e} of the largest, {largest:.1e}");
    }
    let mask = if masked { "" } else { ", no mask" };
    println!("    agree, TV {tv}{mask}:{line}");
}

fn rate(name: &str, ms: f64, samples: f64, rest: &str) {
    println!(
        "  {name:<15} {ms:8.1} CPU ms: {:6.1} k rays, {:7.0} k lattice samples per core-second{rest}",
        RAYS as f64 / ms,
        samples / ms
    );
}

/// Ours, timed; CPU milliseconds of a step.
fn time_ours(s: &Scene, masked: bool, repeat: usize, device: &Device) -> (f64, String, [u64; 2]) {
    let mut ours = Ours::new(s, masked, TV, device);
    let mut parts = [0.0; 3];
    (0..3).for_each(|_| ours.step(s, device, &mut [0.0; 3]));
    let start = cpu_s();
    (0..repeat).for_each(|_| ours.step(s, device, &mut parts));
    let step = 1e3 * (cpu_s() - start) / repeat as f64;
    let f = &s.field;
    let penalty = Penalty { tv: TV, ..Penalty::default() };
    let (mut a, mut b) = (vec![0.0; s.density.len()], vec![0.0; s.color.len()]);
    vm::penalize(&f.color, &penalty, &s.color, &mut b);
    let start = cpu_s();
    for _ in 0..repeat {
        vm::penalize(&f.density, &penalty, &s.density, &mut a);
        vm::penalize(&f.color, &penalty, &s.color, &mut b);
    }
    let penalty = 1e3 * (cpu_s() - start) / repeat as f64;
    let [forward, backward, adam] = parts.map(|p| 1e3 * p / repeat as f64);
    let parts = format!(
        "\n      march + forward {forward:.1}, backward {:.1}, penalty {penalty:.1}, Adam {adam:.1}",
        backward - penalty
    );
    let count = |c: &std::sync::atomic::AtomicU64| c.load(Ordering::Relaxed);
    (step, parts, [count(&ours.batch.density_samples), count(&ours.batch.color_samples)])
}

/// Both ways on the rays of a batch that rounding leaves alone: with and without mask, at once and in pieces.
fn check(s: &Scene, device: &Device) {
    let undecided = [true, false].map(|masked| Plain::new(s, masked, device).undecided(s, device));
    let decided = s.without(|i| undecided.iter().any(|u| u[i]));
    println!("  compared on {} rays, where no gradient hangs on rounding:", decided.rays.len());
    for (masked, tv, chunk) in [(true, 0.0, RAYS), (true, TV, PIECE), (false, 0.0, RAYS)] {
        let (out, gradients, _) = Plain::new(&decided, masked, device).gradients(&decided, tv, chunk, device);
        compare(&decided, masked, tv, device, (out, gradients));
    }
}

/// Plain, timed after a step that warms up.
fn time_plain(s: &Scene, masked: bool, chunk: usize, repeat: usize, device: &Device) -> (f64, Counts) {
    let mut plain = Plain::new(s, masked, device);
    let mut step = || {
        let (_, gradients, counts) = plain.gradients(s, TV, chunk, device);
        plain.adam(gradients, &GRID, &NETWORK);
        counts
    };
    let mut counts = step();
    let start = cpu_s();
    (0..repeat).for_each(|_| counts = step());
    (1e3 * (cpu_s() - start) / repeat as f64, counts)
}

fn regime(name: &str, size: [usize; 3], peak: f32, repeat: usize, device: &Device) {
    let s = scene(size, peak, RAYS);
    let lattice: u64 = s.rays.iter().map(|r| s.field.lattice.points(r)).sum();
    println!(
        "\n{name}: {size:?} vertices, {} + {} + {} parameters",
        s.density.len(),
        s.color.len(),
        s.network.len()
    );
    check(&s, device);
    let (plain, counts) = time_plain(&s, true, RAYS, 3, device);
    let (pieces, _) = time_plain(&s, true, PIECE, 3, device);
    let (ours, parts, [density, color]) = time_ours(&s, true, repeat, device);
    let per = |n: u64| n as f64 / RAYS as f64;
    println!(
        "  a ray: {} lattice steps, {:.1} in the box, {:.1} in the mask, {:.1} looked up until its light is exactly 0 \
         ({:.1} % skipped), {:.1} colors",
        s.field.lattice.samples,
        per(lattice),
        per(counts.density as u64),
        per(density),
        100.0 * (1.0 - density as f64 / lattice as f64),
        per(color)
    );
    println!(
        "  plain counts: {} in the box, {} densities, {} colors",
        counts.inside, counts.density, counts.color
    );
    rate("ours", ours, lattice as f64, &parts);
    rate("plain", plain, lattice as f64, &format!("; {:.1} × ours", plain / ours));
    rate("plain, pieces", pieces, lattice as f64, &format!("; {:.1} × ours", pieces / ours));
    let (bare, _) = time_plain(&s, false, RAYS, 1, device);
    let (own, _, _) = time_ours(&s, false, repeat.div_ceil(2), device);
    rate("ours, no mask", own, lattice as f64, "");
    rate(
        "plain, no mask",
        bare,
        lattice as f64,
        &format!("; {:.1} × ours without, {:.1} × ours with the mask", bare / own, bare / ours),
    );
    println!("  most memory so far {:.1} GiB", peak_gib());
}

fn main() {
    let device = Device::flex();
    println!("{RAYS} rays, {} threads", rayon::current_num_threads());
    regime("early", [141, 157, 94], 1.0, 10, &device);
    regime("late", [141, 157, 94], 60.0, 10, &device);
    regime("last grid", [331, 368, 220], 140.0, 5, &device);
}
