//! The trainable parameters.

use crate::Result;
use crate::config::iface::IfaceConfig;
use crate::field::checkpoint::Checkpoint;
use crate::field::parameters::Parameter;
use crate::field::{self, ops};
use crate::kernel::hash;
use crate::kernel::mlp::{HIDDEN, OUTPUTS, Weights};
use crate::kernel::rng;
use crate::kernel::sdf::FieldShape;
use burn::tensor::{Device, Tensor};
use std::sync::Arc;

/// Hash table, geometry network with weight norm, color network without biases, variance:
///
/// | | shape | |
/// |---|---|---|
/// | `table` | `[entries, 2]` | |
/// | `v1`, `g1`, `b1` | `[64, 3 + 2 levels]`, `[64, 1]`, `[64]` | directions, row lengths, bias; columns position, then features |
/// | `v2`, `g2`, `b2` | `[13, 64]`, `[13, 1]`, `[13]` | |
/// | `c1`, `c2`, `c3` | `[64, 32]`, `[64, 64]`, `[3, 64]` | `c1` with the color skip `[64, 32 + 2 levels]` |
/// | `variance` | `[1]` | v of inv_s = exp(10 v) |
pub struct SdfModel(pub [Parameter; 11]);

/// How many parameters, the first ones, make the surface; the others color it and say how sharp it is.
pub const GEOMETRY: usize = 7;

/// Shape of the field that a configuration describes.
pub fn shape(config: &IfaceConfig) -> FieldShape {
    FieldShape {
        levels: hash::levels(config.levels, config.base_resolution, config.growth, config.log2_table),
        radius: config.radius,
        active: config.levels,
        color_skip: config.color_skip,
        soften: (config.soften as f32).ln(),
    }
}

/// The named start values of every parameter, in the order of [`SdfModel`].
///
/// Sphere initialization of NeuS' geometry network: `sdf ≈ ‖x / radius‖ − ½` times `radius` for the
/// band presets, so that the initial gradient has length one; the published code leaves the factor out
/// and starts with gradients of 1 / radius.
pub fn initial(config: &IfaceConfig, seed: u64) -> [(&'static str, Vec<usize>, Vec<f32>); 11] {
    let shape = shape(config);
    let layout = shape.layout();
    let (inputs, colored) = (layout.inputs, layout.color_inputs());
    let entries = hash::entries(&shape.levels);
    let table = (0..2 * entries as u64).map(|i| 2e-4 * rng::uniform(seed, 101, i) - 1e-4).collect();
    let first = (2.0f32).sqrt() / (HIDDEN as f32).sqrt();
    let v1: Vec<f32> = (0..HIDDEN * inputs)
        .map(|i| if i % inputs < 3 { first * rng::normal(seed, 102, i as u64) } else { 0.0 })
        .collect();
    let mean = std::f32::consts::PI.sqrt() / (HIDDEN as f32).sqrt();
    let scale = if config.unit_start { config.radius } else { 1.0 };
    // row 0 is the sdf; the others are features of the color network
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
    [
        ("table", vec![entries, 2], table),
        ("v1", vec![HIDDEN, inputs], v1),
        ("g1", vec![HIDDEN, 1], g1),
        ("b1", vec![HIDDEN], vec![0.0; HIDDEN]),
        ("v2", vec![OUTPUTS, HIDDEN], v2),
        ("g2", vec![OUTPUTS, 1], g2),
        ("b2", vec![OUTPUTS], b2),
        ("c1", vec![HIDDEN, colored], xavier(104, HIDDEN, HIDDEN, colored)),
        ("c2", vec![HIDDEN, HIDDEN], xavier(105, HIDDEN, HIDDEN, HIDDEN)),
        ("c3", vec![3, HIDDEN], xavier(106, 3, 16, HIDDEN)),
        ("variance", vec![1], vec![config.variance as f32]),
    ]
}

impl SdfModel {
    /// Returns the model before the first step.
    pub fn new(config: &IfaceConfig, seed: u64, device: &Device) -> SdfModel {
        SdfModel(
            initial(config, seed).map(|(name, shape, values)| Parameter::new(name, &shape, values, device)),
        )
    }

    /// Takes the model out of a checkpoint.
    pub fn restore(config: &IfaceConfig, from: &mut Checkpoint, device: &Device) -> Result<SdfModel> {
        let mut model = SdfModel::new(config, 0, device);
        for p in &mut model.0 {
            let shape = p.shape().to_vec();
            p.restore(&shape, from, true)?;
        }
        Ok(model)
    }

    /// Returns the flat hash table.
    pub fn table(&self) -> Tensor<1> {
        self.0[0].flat()
    }

    /// Returns the flat network weights of [`Layout`](crate::kernel::mlp::Layout), weight norm applied:
    /// W = g · v / ‖v‖ row by row.
    pub fn weights(&self) -> Tensor<1> {
        let norm = |v: &Parameter, g: &Parameter| -> Tensor<1> {
            let v = v.shaped::<2>();
            let length = v.clone().square().sum_dim(1).sqrt().clamp_min(1e-12); // [out, 1]
            (v / length * g.shaped::<2>()).flatten(0, 1)
        };
        let [_, v1, g1, b1, v2, g2, b2, c1, c2, c3, _] = &self.0;
        Tensor::cat(
            vec![norm(v1, g1), b1.flat(), norm(v2, g2), b2.flat(), c1.flat(), c2.flat(), c3.flat()],
            0,
        )
    }

    /// Returns the NeuS sharpness, `[1]`.
    pub fn inv_s(&self) -> Tensor<1> {
        (self.0[10].flat() * 10.0).exp()
    }

    /// Returns the NeuS sharpness on the host, within what the kernels compute with.
    pub fn sharpness(&self) -> f32 {
        field::values(self.inv_s().inner())[0].clamp(1e-6, 1e6)
    }

    /// Returns the table and the prepared network weights on the host.
    pub fn on_host(&self, shape: &FieldShape) -> (Vec<f32>, Weights) {
        let weights = Weights::new(shape.layout(), &field::values(self.weights().inner()));
        (self.0[0].values(), weights)
    }

    /// Evaluates the field at points: see [`ops::sdf_field`].
    pub fn field(&self, shape: &Arc<FieldShape>, x: Tensor<2>, direction: Tensor<2>) -> Tensor<2> {
        ops::sdf_field(self.table(), self.weights(), x.autodiff(), direction.autodiff(), shape.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use crate::kernel::sdf;

    #[test]
    fn the_start_is_a_sphere_of_half_the_box_with_unit_gradient() {
        let config = IfaceConfig { log2_table: 12, levels: 6, ..IfaceConfig::preset(Preset::Draft) };
        let shape = shape(&config);
        let (table, w) = SdfModel::new(&config, 7, &Device::flex()).on_host(&shape);
        let x = [[0.5, 0.0, 0.0], [0.0, -0.9, 0.0], [0.3, 0.3, 0.3]];
        for ((sdf, n), x) in sdf::gradients(&shape, bytemuck::cast_slice(&table), &w, &x).iter().zip(x) {
            let r = (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]).sqrt();
            let slope = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
            // 64 random directions approximate the norm to some ten percent
            assert!((sdf - (r - 0.5)).abs() < 0.2, "{sdf} at {r}");
            assert!((slope - 1.0).abs() < 0.4, "{slope}");
        }
    }
}
