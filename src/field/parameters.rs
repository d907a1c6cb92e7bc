//! Trainable arrays with their AdamW moments.
//!
//! Not burn's `ModuleOptimizer`: every group has its own learning rate and decay, the hash table
//! updates touched rows only, and the moments go into the same safetensors checkpoint as the weights,
//! by name, so that a resumed run gives the same bytes.

use super::checkpoint::Checkpoint;
use super::{ops, tensor, values};
use crate::Result;
use crate::kernel::adam::AdamStep;
use burn::tensor::{Device, Gradients, Tensor};
use std::ops::RangeInclusive;

/// A trainable array, flat on its device, and the optimizer's moments of it.
pub struct Parameter {
    /// Its name in checkpoints.
    pub name: &'static str,
    shape: Vec<usize>,
    value: Tensor<1>,
    /// Running means of the gradient and of its square.
    moments: [Tensor<1>; 2],
}

fn leaf(value: Tensor<1>) -> Tensor<1> {
    value.autodiff().require_grad()
}

impl Parameter {
    /// Returns a parameter of these values, as many as `shape` says, with zero moments.
    pub fn new(name: &'static str, shape: &[usize], values: Vec<f32>, device: &Device) -> Parameter {
        let n = values.len();
        let moments = [(); 2].map(|_| Tensor::zeros([n], device));
        Parameter { name, shape: shape.to_vec(), value: leaf(tensor(values, [n], device)), moments }
    }

    /// Returns the values as part of a graph.
    pub fn flat(&self) -> Tensor<1> {
        self.value.clone()
    }

    /// Returns the values as part of a graph, in the parameter's shape.
    pub fn shaped<const D: usize>(&self) -> Tensor<D> {
        self.value
            .clone()
            .reshape::<D, [usize; D]>(self.shape.clone().try_into().expect("a shape of D extents"))
    }

    /// Returns its shape.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// How many values there are.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Is there none?
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the values on the host.
    pub fn values(&self) -> Vec<f32> {
        values(self.value.clone().inner())
    }

    /// Returns values, running mean of the gradient and that of its square, on the host.
    pub fn state(&self) -> [Vec<f32>; 3] {
        let [first, second] = self.moments.each_ref().map(|m| values(m.clone()));
        [self.values(), first, second]
    }

    /// Returns a parameter like it with other values and moments, as many as it has.
    pub fn with(&self, state: [Vec<f32>; 3]) -> Parameter {
        let device = self.moments[0].device();
        let [value, first, second] = state.map(|v| {
            assert_eq!(v.len(), self.len());
            tensor(v, [self.len()], &device)
        });
        Parameter { name: self.name, shape: self.shape.clone(), value: leaf(value), moments: [first, second] }
    }

    /// Gives it these, as many as it has.
    pub fn set(&mut self, state: [Vec<f32>; 3]) {
        *self = self.with(state);
    }

    /// Is every value a finite number?
    pub fn is_finite(&self) -> bool {
        self.values().iter().all(|v| v.is_finite())
    }

    /// Is every number of its gradient finite? So it is where it took no part in the loss.
    pub fn has_finite_gradient(&self, gradients: &Gradients) -> bool {
        self.value.grad(gradients).is_none_or(|g| values(g).iter().all(|g| g.is_finite()))
    }

    /// Takes the gradient out of `gradients` and makes one step. A parameter that took no part in the loss
    /// (no gradient) stays as it is.
    pub fn update(&mut self, gradients: &mut Gradients, step: AdamStep) {
        let Some(g) = self.value.grad_remove(gradients) else { return };
        // give up every other reference, so that the update happens in place
        let device = g.device();
        let taken = || Tensor::zeros([1], &device);
        let p = std::mem::replace(&mut self.value, taken()).inner();
        let [m, v] = std::mem::replace(&mut self.moments, [taken(), taken()]);
        let (p, m, v) = ops::adam_step(p, m, v, g, step);
        self.moments = [m, v];
        self.value = leaf(p);
    }

    /// Moves values that left a range to its ends.
    pub fn keep_within(&mut self, range: RangeInclusive<f32>) {
        let device = self.value.device();
        let value = std::mem::replace(&mut self.value, Tensor::zeros([1], &device)).inner();
        self.value = leaf(value.clamp(*range.start(), *range.end()));
    }

    /// Makes the moments zero, as before the first step.
    pub fn forget_moments(&mut self) {
        self.moments = [(); 2].map(|_| Tensor::zeros([self.len()], &self.moments[0].device()));
    }

    /// Gives it other values, a flat array of any length, and zero moments.
    pub fn replace(&mut self, values: Vec<f32>) {
        *self = Parameter::new(self.name, &[values.len()], values, &self.moments[0].device());
    }

    /// Puts the values into a checkpoint, and the moments with them unless nobody goes on from it.
    pub fn save(&self, into: &mut Checkpoint, with_moments: bool) {
        let mut put = |kind: &str, v| into.put_floats(&format!("{kind}.{}", self.name), &self.shape, v);
        put("model", self.values());
        if with_moments {
            let [first, second] = self.moments.each_ref().map(|m| values(m.clone()));
            put("first", first);
            put("second", second);
        }
    }

    /// Takes the values out of a checkpoint, and the moments with them unless nobody goes on from it. `shape` is
    /// what they must have there; nothing is reserved by it.
    pub fn restore(&mut self, shape: &[usize], from: &mut Checkpoint, with_moments: bool) -> Result<()> {
        let device = self.moments[0].device();
        let values = from.floats(&format!("model.{}", self.name), shape)?;
        let n = values.len();
        self.moments = if with_moments {
            let first = from.floats(&format!("first.{}", self.name), shape)?;
            let second = from.squares(&format!("second.{}", self.name), shape)?;
            [first, second].map(|m| tensor(m, [n], &device))
        } else {
            [(); 2].map(|_| Tensor::zeros([1], &device))
        };
        self.value = leaf(tensor(values, [n], &device));
        self.shape = shape.to_vec();
        Ok(())
    }
}
