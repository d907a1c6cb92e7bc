//! The trainable parameters: hash table, geometry network with weight norm, color network without
//! biases, variance, in three groups.
//!
//! | | shape | |
//! |---|---|---|
//! | `table` | `[entries, 2]` | |
//! | `v1`, `g1`, `b1` | `[64, 3 + 2 levels]`, `[64, 1]`, `[64]` | directions, row lengths, bias |
//! | `v2`, `g2`, `b2` | `[13, 64]`, `[13, 1]`, `[13]` | |
//! | `c1`, `c2`, `c3` | `[64, 32]`, `[64, 64]`, `[3, 64]` | `c1` with skip `[64, 32 + 2 levels]` |
//! | `variance` | `[1]` | v of inv_s = exp(10 v) |
//!
//! Columns of `v1` are the position, then the features.

use crate::config::iface::IfaceConfig;
use crate::field::parameters::{HostGroup, ParameterPart};
use tiface_base::math::rng;
use tiface_kernels::cpu::hash;
use tiface_kernels::cpu::mlp::{HIDDEN, OUTPUTS};
use tiface_kernels::cpu::sdf::FieldShape;

/// Returns the shape of the field that a configuration describes.
pub fn shape(config: &IfaceConfig) -> FieldShape {
    FieldShape {
        levels: hash::levels(config.levels, config.base_resolution, config.growth, config.log2_table),
        radius: config.radius,
        active: config.levels,
        color_skip: config.color_skip,
        soften: (config.soften as f32).ln(),
    }
}

/// Returns the parameters before the first step.
///
/// Sphere initialization of NeuS' geometry network: `sdf ≈ ‖x / radius‖ − ½` times `radius` for the
/// band presets, so that the initial gradient has length one; the published code leaves the factor
/// out and starts with gradients of 1 / radius.
pub fn initial(config: &IfaceConfig, seed: u64) -> [HostGroup; 3] {
    let shape = shape(config);
    let layout = shape.layout();
    let (inputs, colored) = (layout.inputs, layout.color_inputs());
    let entries = hash::entries(&shape.levels);
    let table: Vec<f32> = (0..2 * entries as u64).map(|i| 2e-4 * rng::uniform(seed, 101, i) - 1e-4).collect();
    let first = (2.0f32).sqrt() / (HIDDEN as f32).sqrt();
    let v1: Vec<f32> = (0..HIDDEN * inputs)
        .map(|i| if i % inputs < 3 { first * rng::normal(seed, 102, i as u64) } else { 0.0 })
        .collect();
    let mean = std::f32::consts::PI.sqrt() / (HIDDEN as f32).sqrt();
    let scale = if config.unit_start { config.radius } else { 1.0 };
    // Row 0 is the sdf; the other rows are features for the color network.
    let apart = |i: usize| i >= HIDDEN && config.spread_features;
    let v2: Vec<f32> = (0..OUTPUTS * HIDDEN)
        .map(|i| {
            let n = rng::normal(seed, 103, i as u64);
            if apart(i) { first * n } else { scale * (mean + 1e-4 * n) }
        })
        .collect();
    let b2: Vec<f32> = (0..OUTPUTS).map(|o| if apart(o * HIDDEN) { 0.0 } else { -0.5 * scale }).collect();
    let lengths = |v: &[f32], n: usize| -> Vec<f32> {
        v.chunks(n).map(|row| row.iter().map(|x| x * x).sum::<f32>().sqrt()).collect()
    };
    let xavier = |stream: u64, out: usize, padded: usize, n: usize| -> Vec<f32> {
        let bound = (6.0 / (n + padded) as f32).sqrt();
        (0..out * n).map(|i| bound * (2.0 * rng::uniform(seed, stream, i as u64) - 1.0)).collect()
    };
    let (g1, g2) = (lengths(&v1, inputs), lengths(&v2, HIDDEN));
    let network = [
        v1,
        g1,
        vec![0.0; HIDDEN],
        v2,
        g2,
        b2,
        xavier(104, HIDDEN, HIDDEN, colored),
        xavier(105, HIDDEN, HIDDEN, HIDDEN),
        xavier(106, 3, 16, HIDDEN),
    ];
    let mut parts = parts(config).into_iter();
    [table, network.concat(), vec![config.variance as f32]]
        .map(|values| HostGroup::new(parts.next().unwrap_or_default(), values))
}

/// Returns names and shapes of the parameters in each of the three groups.
pub fn parts(config: &IfaceConfig) -> [Vec<ParameterPart>; 3] {
    let shape = shape(config);
    let layout = shape.layout();
    let (inputs, colored) = (layout.inputs, layout.color_inputs());
    let part = |name, shape: &[usize]| ParameterPart { name, shape: shape.to_vec() };
    [
        vec![part("table", &[hash::entries(&shape.levels), 2])],
        vec![
            part("v1", &[HIDDEN, inputs]),
            part("g1", &[HIDDEN, 1]),
            part("b1", &[HIDDEN]),
            part("v2", &[OUTPUTS, HIDDEN]),
            part("g2", &[OUTPUTS, 1]),
            part("b2", &[OUTPUTS]),
            part("c1", &[HIDDEN, colored]),
            part("c2", &[HIDDEN, HIDDEN]),
            part("c3", &[3, HIDDEN]),
        ],
        vec![part("variance", &[1])],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use tiface_kernels::cpu::mlp::Weights;
    use tiface_kernels::cpu::{sdf, weight_norm};

    #[test]
    fn the_start_is_a_sphere_of_half_the_box_with_unit_gradient() {
        let config = IfaceConfig { log2_table: 12, levels: 6, ..IfaceConfig::preset(Preset::Draft) };
        let shape = shape(&config);
        let [table, network, _] = initial(&config, 7);
        let (table, flat) = (table.values(), weight_norm::forward(shape.layout(), network.values()));
        let w = Weights::new(shape.layout(), &flat);
        let x = [[0.5, 0.0, 0.0], [0.0, -0.9, 0.0], [0.3, 0.3, 0.3]];
        for ((sdf, n), x) in sdf::gradients(&shape, bytemuck::cast_slice(table), &w, &x).iter().zip(x) {
            let r = (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]).sqrt();
            let slope = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
            // 64 random directions approximate the norm to some ten percent
            assert!((sdf - (r - 0.5)).abs() < 0.2, "{sdf} at {r}");
            assert!((slope - 1.0).abs() < 0.4, "{slope}");
        }
    }
}
