//! What a training step of a field moves and computes, counted from the kernels, and what that would
//! take on a GPU of which nothing is known but its data sheet. **A prediction**, not a measurement.

use super::sdf::Sdf;
use crate::kernel::cpu::hash;
use crate::kernel::cpu::mlp::{HIDDEN, OUTPUTS};
use crate::kernel::cpu::sdf::{FieldShape, WIDTH};
use serde::Serialize;

/// A kernel, or some that belong together.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct KernelCost {
    /// What it does.
    pub name: &'static str,
    /// Bytes read and written; of table rows the 32 that a memory transfer has.
    pub bytes: f64,
    /// Floating-point operations, two a multiplication with addition.
    pub flops: f64,
    /// Atomic additions.
    pub atomics: f64,
}

/// A GPU by its data sheet.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GpuSheet {
    /// Its name.
    pub name: &'static str,
    /// Memory bandwidth, bytes a second.
    pub bandwidth: f64,
    /// Floating-point operations a second, 32 bits, without matrix units.
    pub flops: f64,
    /// Last-level cache, bytes.
    pub cache: f64,
}

/// Data sheets of the makers; Apple and integrated GPUs share the memory's bandwidth with the processor.
pub const GPUS: [GpuSheet; 8] = [
    GpuSheet { name: "H100 SXM", bandwidth: 3.35e12, flops: 66.9e12, cache: 50e6 },
    GpuSheet { name: "A100 40 GB", bandwidth: 1.555e12, flops: 19.5e12, cache: 40e6 },
    GpuSheet { name: "RTX 4090", bandwidth: 1.008e12, flops: 82.6e12, cache: 72e6 },
    GpuSheet { name: "RTX 3090", bandwidth: 0.936e12, flops: 35.6e12, cache: 6e6 },
    GpuSheet { name: "L4", bandwidth: 0.3e12, flops: 30.3e12, cache: 48e6 },
    GpuSheet { name: "M2 Max", bandwidth: 0.4e12, flops: 13.6e12, cache: 48e6 },
    GpuSheet { name: "Radeon 780M (integrated)", bandwidth: 0.09e12, flops: 8.3e12, cache: 2e6 },
    GpuSheet { name: "Iris Xe 96 (integrated)", bandwidth: 0.068e12, flops: 2.1e12, cache: 3.8e6 },
];

/// Share of the bandwidth that streaming kernels reach.
const STREAMED: f64 = 0.6;
/// Share of the peak that products through workgroup memory reach without matrix units.
const COMPUTED: f64 = 0.25;
/// Atomic additions to different words, as a share of the words that the cache could be asked for at five times the
/// memory's bandwidth.
const ADDED: f64 = 0.25;
/// Seconds of a launch that follows another on the device.
const LAUNCH: f64 = 4e-6;

/// The kernels of a step with so many samples and rays, as if all levels took part.
pub fn step_cost(shape: &FieldShape, samples: usize, rays: usize) -> Vec<KernelCost> {
    let layout = shape.layout();
    let (n, r) = (samples as f64, rays as f64);
    let levels = shape.levels.len() as f64;
    let (features, hidden, outputs, width) = (2.0 * levels, HIDDEN as f64, OUTPUTS as f64, WIDTH as f64);
    let (padded, color) = (layout.padded() as f64, layout.color_padded() as f64);
    let entries = hash::entries(&shape.levels) as f64;
    // of 8 n corners on a level some are the same entry
    let touched: f64 = shape
        .levels
        .iter()
        .map(|level| {
            let own = level.entries as f64;
            own * -(-8.0 * n / own).exp_m1()
        })
        .sum();
    let words = |name, words: f64, flops: f64, atomics: f64| KernelCost {
        name,
        bytes: 4.0 * words,
        flops: 2.0 * flops,
        atomics,
    };
    let rows = 8.0 * 8.0 * levels; // 8 corners, 32 bytes a transfer
    let geometry = padded * hidden + hidden * outputs;
    let colors = color * hidden + hidden * hidden + 3.0 * hidden;
    vec![
        words("draw and march", 40.0 * r + 9.0 * n, 60.0 * n, 0.0),
        words("hash features", n * (3.0 + rows + 4.0 * features), n * 8.0 * features * 4.0, 0.0),
        words(
            "networks",
            n * (5.0 * features + 6.0 + 3.0 * hidden + outputs + width),
            n * (geometry + hidden * padded + 3.0 * features + colors),
            0.0,
        ),
        words("compositing and losses", n * (4.0 * width + 16.0) + 60.0 * r, 200.0 * n, 0.0),
        words(
            "backward of the color network",
            n * (2.0 * features + 2.0 * hidden + 2.0 * outputs + 2.0 * width + 6.0),
            n * 2.0 * colors,
            0.0,
        ),
        words(
            "backward of the geometry network",
            n * (6.0 * features + hidden + outputs + 6.0),
            n * (4.0 * padded * hidden + 2.0 * outputs * hidden),
            0.0,
        ),
        words(
            "scatter into the table",
            n * (3.0 + 2.0 * features + 3.0 + rows),
            n * 8.0 * features * 6.0,
            n * 16.0 * levels,
        ),
        words("optimizer", 2.0 * entries + 2.0 * touched * 7.0, 2.0 * touched * 12.0, 0.0),
    ]
}

/// The kernels of a step of a vector-matrix field whose grids have so many floats, at so many samples whose density is
/// looked up, and so many of those that get color; counts of a decoder of 128 units with 27 appearance features.
pub fn vm_step_cost(floats: f64, density: f64, color: f64) -> Vec<KernelCost> {
    let kernel = |name, bytes: f64, flops: f64, atomics: f64| KernelCost { name, bytes, flops, atomics };
    vec![
        kernel("march", 20.0 * density, 1_000.0 * density, 0.0),
        kernel("density", 592.0 * density, 290.0 * density, 0.0),
        kernel("weights and compositing", 70.0 * density + 40.0 * color, 80.0 * density, 0.0),
        kernel("decoder", 1_750.0 * color, 53e3 * color, 0.0),
        kernel("backward of the decoder", 10_500.0 * color, 158e3 * color, 0.0),
        kernel("scatter color", 2_000.0 * color, 1_500.0 * color, 432.0 * color),
        // a third of the samples carry weight
        kernel("scatter density", 200.0 * density, 170.0 * density, 48.0 * density),
        kernel("total variation", 12.0 * floats, 10.0 * floats, 0.0),
        kernel("optimizer", 32.0 * floats, 12.0 * floats, 0.0),
    ]
}

/// Seconds a kernel takes on a GPU: what is slowest of moving, computing and adding.
pub fn predict(kernel: &KernelCost, gpu: &GpuSheet) -> f64 {
    let moved = kernel.bytes / (STREAMED * gpu.bandwidth);
    let computed = kernel.flops / (COMPUTED * gpu.flops);
    let added = kernel.atomics / (ADDED * 5.0 * gpu.bandwidth / 4.0);
    moved.max(computed).max(added) + 3.0 * LAUNCH
}

/// Bytes of device memory that so many samples of a step take, with the table, its moments and gradient.
pub fn memory(shape: &FieldShape, samples: usize) -> f64 {
    let [words, _] = Sdf::words_per_sample(shape);
    4.0 * (samples * (words + 19)) as f64 + 32.0 * hash::entries(&shape.levels) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_those_worked_out_by_hand() {
        // the published field: 16 levels, 35 inputs padded to 40, 32 color inputs
        let levels = hash::levels(16, 32, 1.3195, 19);
        let shape = FieldShape { levels, radius: 1.0, active: 16, color_skip: false, soften: 0.0 };
        let cost = step_cost(&shape, 1000, 100);
        let named = |name: &str| *cost.iter().find(|k| k.name == name).unwrap();
        let padded = shape.layout().padded() as f64;
        // forward: W1, W2, W1ᵀ, Jᵀ, C1, C2, C3
        let flops = 2e3 * (64.0 * padded + 64.0 * 13.0 + 64.0 * padded + 96.0 + 64.0 * 32.0 + 4096.0 + 192.0);
        assert_eq!(named("networks").flops, flops);
        // eight corners of two features on sixteen levels
        assert_eq!(named("scatter into the table").atomics, 1000.0 * 256.0);
        // ten times the samples cost ten times as much, but for what is done once
        let more = step_cost(&shape, 10_000, 1000);
        assert!((more[2].bytes / cost[2].bytes - 10.0).abs() < 1e-9);
        // every kernel takes at least its launches, and no GPU is faster than its memory
        for gpu in &GPUS {
            assert!(cost.iter().all(|k| predict(k, gpu) > k.bytes / gpu.bandwidth));
        }
        // three planes and lines of 331 x 368 x 220, 64 channels: 5.9 million floats, of 32 bytes each
        let floats = 64.0 * ((331 * 368 + 331 * 220 + 368 * 220) / 3 + (331 + 368 + 220) / 3) as f64;
        let last = *vm_step_cost(floats, 4e5, 4e4).last().unwrap();
        assert!((last.bytes / 1e6 - 188.8).abs() < 0.1, "{}", last.bytes);
        assert!(memory(&shape, 1 << 18) > 4.0 * (1 << 18) as f64 * 300.0);
    }
}
