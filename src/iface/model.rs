//! The trainable parameters, as a burn module.

use crate::config::iface::IfaceConfig;
use crate::field::{self, ops};
use crate::kernel::hash;
use crate::kernel::mlp::{HIDDEN, OUTPUTS};
use crate::kernel::rng;
use crate::kernel::sdf::FieldShape;
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use std::sync::Arc;

/// Hash table, geometry network with weight norm, colour network without biases, variance.
#[derive(Module, Debug)]
pub struct Model {
    /// `[entries, 2]`
    pub table: Param<Tensor<2>>,
    /// Directions of the first layer, `[64, 3 + 2 levels]`: columns position, then hash features.
    pub v1: Param<Tensor<2>>,
    /// Row lengths of the first layer, `[64, 1]`.
    pub g1: Param<Tensor<2>>,
    /// `[64]`
    pub b1: Param<Tensor<1>>,
    /// Directions of the second layer, `[13, 64]`.
    pub v2: Param<Tensor<2>>,
    /// `[13, 1]`
    pub g2: Param<Tensor<2>>,
    /// `[13]`
    pub b2: Param<Tensor<1>>,
    /// `[64, 32]`, with the colour skip `[64, 32 + 2 levels]`
    pub c1: Param<Tensor<2>>,
    /// `[64, 64]`
    pub c2: Param<Tensor<2>>,
    /// `[3, 64]`
    pub c3: Param<Tensor<2>>,
    /// v of inv_s = exp(10 v), `[1]`.
    pub variance: Param<Tensor<1>>,
}

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

/// The named start values of every parameter, in the order of [`Model`]'s fields.
///
/// Sphere initialisation of NeuS' geometry network: `sdf ≈ ‖x / radius‖ − ½` times `radius` for the
/// band presets, so that the initial gradient has length one; the published code leaves the factor out
/// and starts with gradients of 1 / radius.
pub fn initial(config: &IfaceConfig, seed: u64) -> Vec<(&'static str, Vec<usize>, Vec<f32>)> {
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
    // row 0 is the sdf; the others are features of the colour network
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
    vec![
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

impl Model {
    /// From named values in the order of [`initial`]; trainable.
    pub fn from_values(values: Vec<(Vec<usize>, Vec<f32>)>, device: &Device) -> Model {
        let mut values = values.into_iter();
        let mut next = || values.next().expect("as many values as parameters");
        fn param<const D: usize>((shape, v): (Vec<usize>, Vec<f32>), device: &Device) -> Param<Tensor<D>> {
            let shape: [usize; D] = shape.try_into().expect("shapes were checked against the model");
            Param::from_tensor(field::tensor(v, shape, device).autodiff().require_grad())
        }
        Model {
            table: param(next(), device),
            v1: param(next(), device),
            g1: param(next(), device),
            b1: param(next(), device),
            v2: param(next(), device),
            g2: param(next(), device),
            b2: param(next(), device),
            c1: param(next(), device),
            c2: param(next(), device),
            c3: param(next(), device),
            variance: param(next(), device),
        }
    }

    /// The flat network weights of [`Layout`], weight norm applied: W = g · v / ‖v‖ row by row.
    pub fn weights(&self) -> Tensor<1> {
        let norm = |v: Tensor<2>, g: Tensor<2>| -> Tensor<1> {
            let length = v.clone().square().sum_dim(1).sqrt().clamp_min(1e-12); // [out, 1]
            (v / length * g).flatten(0, 1)
        };
        Tensor::cat(
            vec![
                norm(self.v1.val(), self.g1.val()),
                self.b1.val(),
                norm(self.v2.val(), self.g2.val()),
                self.b2.val(),
                self.c1.val().flatten(0, 1),
                self.c2.val().flatten(0, 1),
                self.c3.val().flatten(0, 1),
            ],
            0,
        )
    }

    /// NeuS sharpness, `[1]`.
    pub fn inv_s(&self) -> Tensor<1> {
        (self.variance.val() * 10.0).exp()
    }

    /// The field at points: see [`ops::sdf_field`].
    pub fn field(&self, shape: &Arc<FieldShape>, x: Tensor<2>, direction: Tensor<2>) -> Tensor<2> {
        ops::sdf_field(self.table.val(), self.weights(), x.autodiff(), direction.autodiff(), shape.clone())
    }

    /// Every parameter by name, on the host.
    pub fn values(&self) -> Vec<(&'static str, Vec<usize>, Vec<f32>)> {
        fn read<const D: usize>(p: &Param<Tensor<D>>) -> (Vec<usize>, Vec<f32>) {
            let t = p.val().inner();
            (t.dims().to_vec(), field::values(t))
        }
        let all = [
            ("table", read(&self.table)),
            ("v1", read(&self.v1)),
            ("g1", read(&self.g1)),
            ("b1", read(&self.b1)),
            ("v2", read(&self.v2)),
            ("g2", read(&self.g2)),
            ("b2", read(&self.b2)),
            ("c1", read(&self.c1)),
            ("c2", read(&self.c2)),
            ("c3", read(&self.c3)),
            ("variance", read(&self.variance)),
        ];
        all.into_iter().map(|(name, (shape, v))| (name, shape, v)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use crate::kernel::mlp::Weights;
    use crate::kernel::sdf;

    #[test]
    fn the_start_is_a_sphere_of_half_the_box_with_unit_gradient() {
        let config = IfaceConfig { log2_table: 12, levels: 6, ..IfaceConfig::preset(Preset::Draft) };
        let device = Device::flex();
        let values = initial(&config, 7).into_iter().map(|(_, s, v)| (s, v)).collect();
        let model = Model::from_values(values, &device);
        let shape = shape(&config);
        let w = Weights::new(shape.layout(), &field::values(model.weights().inner()));
        let table = field::values(model.table.val().inner());
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
