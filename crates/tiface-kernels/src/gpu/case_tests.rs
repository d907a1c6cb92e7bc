//! A signed-distance field to test kernels on.

use crate::cpu::hash;
use crate::cpu::sdf::{FieldShape, WIDTH};
use tiface_base::math::rng;

/// A field with lively weights, samples in its box seen from anywhere, and gradients of its output.
/// Positions and scales have few digits, so that the cells of all samples are found alike.
pub(super) struct Case {
    pub shape: FieldShape,
    pub table: Vec<[f32; 2]>,
    pub flat: Vec<f32>,
    pub x: Vec<[f32; 3]>,
    pub direction: Vec<[f32; 3]>,
    pub g_out: Vec<[f32; WIDTH]>,
}

impl Case {
    pub fn new(samples: usize, levels: usize, color_skip: bool, active: usize) -> Case {
        let mut levels = hash::levels(levels, 4, 1.4, 10);
        levels.iter_mut().for_each(|l| l.scale = l.scale.round());
        let soften = if color_skip { 1.5 } else { 0.0 };
        let shape = FieldShape { levels, radius: 2.0, active, color_skip, soften };
        let normal = |stream: u64, i: usize| rng::normal(7, stream, i as u64);
        let table = (0..hash::entries(&shape.levels)).map(|i| [normal(1, 2 * i), normal(1, 2 * i + 1)]);
        let at = |i: usize| rng::below(7, 2, i as u64, 1025) as f32 / 256.0 - 2.0;
        let unit = |v: [f32; 3]| {
            let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
            v.map(|c| c / length)
        };
        Case {
            table: table.map(|e| e.map(|v| 0.3 * v)).collect(),
            flat: (0..shape.layout().len()).map(|i| 0.12 * normal(3, i)).collect(),
            x: (0..samples).map(|i| [at(3 * i), at(3 * i + 1), at(3 * i + 2)]).collect(),
            direction: (0..samples).map(|i| unit([0, 1, 2].map(|k| normal(4, 3 * i + k)))).collect(),
            g_out: (0..samples).map(|i| std::array::from_fn(|k| normal(5, WIDTH * i + k))).collect(),
            shape,
        }
    }
}
