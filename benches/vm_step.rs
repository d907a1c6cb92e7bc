//! The kernels of one training step of the vector-matrix field, in CPU time.
//!
//! ```text
//! cargo bench --bench vm_step            # all threads; a grid of the start and one of the end
//! RAYON_NUM_THREADS=1 cargo bench --bench vm_step
//! ```
//!
//! The published settings for heads: density 16, 4, 4, appearance 48, 12, 12 channels, basis 72 →
//! 27, decoder 30 → 128 → 128 → 3, 4096 rays, step ratio 0.5; color and mask loss, total variation
//! of both grids, backward to every parameter, Adam.
//!
//! CPU time (user + system of the process) is what is compared: it does not depend on what else the
//! machine does. Adam's stands beside its share of the peak of the machine's memory.

mod process;

#[path = "vm_step/scene.rs"]
mod scene;

use process::roof::Roof;
use process::{cpu_s, peak_gib};
use scene::{Scene, scene};
use tiface::kernel::cpu::adam::{AdamStep, adam};
use tiface::kernel::cpu::vm::losses::{BackgroundMode, MaskTerm, Targets, of_rays};
use tiface::kernel::cpu::vm::{self, DecoderWeights, VmField};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const RAYS: usize = 4096;
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

/// What is trained: values, both moments and gradients of density, appearance and decoder.
struct Training {
    field: VmField,
    arrays: [[Vec<f32>; 4]; 3],
    color: Vec<[f32; 3]>,
    alpha: Vec<f32>,
    background: Vec<[f32; 3]>,
}

impl Training {
    fn new(s: &Scene, masked: bool) -> Training {
        let mut field = s.field.clone();
        field.mask = field.mask.filter(|_| masked);
        let zeros = |v: &Vec<f32>| vec![0.0; v.len()];
        let arrays = [&s.density, &s.color, &s.network].map(|v| [v.clone(), zeros(v), zeros(v), zeros(v)]);
        Training {
            field,
            arrays,
            color: s.target.as_chunks().0.to_vec(),
            alpha: s.background.iter().map(|b| 1.0 - b).collect(),
            background: vec![[0.0; 3]; s.rays.len()],
        }
    }

    /// One step; adds the seconds of forward, losses, backward, penalty, Adam. Densities looked up,
    /// colors decoded.
    fn step(&mut self, s: &Scene, parts: &mut [f64; 6]) -> [u64; 2] {
        let mut clock = cpu_s();
        let mut lap = |k: usize| {
            let now = cpu_s();
            parts[k] += now - clock;
            clock = now;
        };
        let [[density, .., g_density], [color, .., g_color], [network, .., g_network]] = &mut self.arrays;
        let weights = DecoderWeights::new(self.field.decoder, network);
        let rendered = vm::render(&self.field, density, color, &weights, &s.rays, &s.jitter);
        let counts = [rendered.density_samples, rendered.color_samples];
        lap(0);
        let targets = Targets { color: &self.color, alpha: &self.alpha, background: &self.background };
        let mode = BackgroundMode { lift: 0.0, target: false };
        let (_, g_out) = of_rays(&rendered.out, targets, mode, MaskTerm::L2(0.01));
        lap(1);
        *g_network = vm::backward(&self.field, density, &weights, rendered, &g_out, g_density, g_color);
        lap(2);
        vm::penalize(&self.field.density, TV, density, g_density);
        vm::penalize(&self.field.color, TV, color, g_color);
        lap(3);
        let finite = self.arrays.iter().all(|[.., g]| g.iter().all(|g| g.is_finite()));
        assert!(finite, "a gradient is not finite");
        lap(5);
        for ([p, m, v, g], step) in self.arrays.iter_mut().zip([GRID, GRID, NETWORK]) {
            adam(p, m, v, g, &step);
        }
        lap(4);
        counts
    }
}

fn regime(roof: &Roof, name: &str, size: [usize; 3], peak: f32, repeat: usize) {
    let s = scene(size, peak, RAYS);
    let lattice: u64 = s.rays.iter().map(|r| s.field.lattice.points(r)).sum();
    let [density, color, network] = [s.density.len(), s.color.len(), s.network.len()];
    println!("\n{name}: {size:?} vertices, {density} + {color} + {network} parameters");
    for masked in [true, false] {
        let mut training = Training::new(&s, masked);
        let mut parts = [0.0; 6];
        let mut counts = [0; 2];
        (0..3).for_each(|_| counts = training.step(&s, &mut [0.0; 6]));
        (0..repeat).for_each(|_| counts = training.step(&s, &mut parts));
        let [forward, losses, backward, penalty, adam, _] = parts.map(|p| 1e3 * p / repeat as f64);
        let step = forward + losses + backward + penalty + adam;
        println!(
            "  {} {step:8.1} CPU ms: {:6.1} k rays, {:7.0} k lattice samples per core-second; a ray looks up {:.1} and \
             decodes {:.1}\n      march + forward {forward:.1}, losses {losses:.1}, backward {backward:.1}, penalty \
             {penalty:.1}, Adam {}",
            if masked { "masked " } else { "no mask" },
            RAYS as f64 / step,
            lattice as f64 / step,
            counts[0] as f64 / RAYS as f64,
            counts[1] as f64 / RAYS as f64,
            // values, moments and gradient, read and written
            roof.moved(adam, (8 * 4 * (density + color + network)) as f64),
        );
    }
    println!("  most memory so far {:.1} GiB", peak_gib());
}

fn main() {
    println!("{RAYS} rays, {} threads", rayon::current_num_threads());
    let roof = Roof::measure();
    regime(&roof, "early", [141, 157, 94], 1.0, 10);
    regime(&roof, "late", [141, 157, 94], 60.0, 10);
    regime(&roof, "last grid", [331, 368, 220], 140.0, 5);
}
