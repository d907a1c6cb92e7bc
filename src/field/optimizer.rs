//! AdamW over named parameters.
//!
//! Not burn's `ModuleOptimizer`: every group has its own learning rate and decay, the hash table
//! updates touched rows only, and the moments go into the same safetensors checkpoint as the weights,
//! by name, so that a resumed run gives the same bytes.

use super::ops;
use crate::kernel::adam::AdamStep;
use burn::module::Param;
use burn::tensor::{Device, Gradients, Tensor};

/// First and second moment of one parameter.
pub struct Moments<const D: usize> {
    /// Running mean of the gradient.
    pub first: Tensor<D>,
    /// Running mean of its square.
    pub second: Tensor<D>,
}

impl<const D: usize> Moments<D> {
    /// All zero, without autodiff.
    pub fn zeros(shape: [usize; D], device: &Device) -> Moments<D> {
        Moments { first: Tensor::zeros(shape, device), second: Tensor::zeros(shape, device) }
    }
}

/// Takes the parameter's gradient out of `gradients` and makes one step. Parameters that took no part in
/// the loss (no gradient) stay as they are.
pub fn update<const D: usize>(
    param: &mut Param<Tensor<D>>,
    moments: &mut Moments<D>,
    gradients: &mut Gradients,
    step: AdamStep,
) {
    let value = param.val();
    let Some(g) = value.grad_remove(gradients) else { return };
    let id = param.id;
    // give up every other reference, so that the update happens in place
    *param = Param::initialized(id, Tensor::zeros([1; D], &value.device().inner()));
    let p = value.inner();
    let device = p.device();
    let first = std::mem::replace(&mut moments.first, Tensor::zeros([1; D], &device));
    let second = std::mem::replace(&mut moments.second, Tensor::zeros([1; D], &device));
    let (p, first, second) = ops::adam_step(p, first, second, g, step);
    *moments = Moments { first, second };
    *param = Param::initialized(id, p.autodiff().require_grad());
}
