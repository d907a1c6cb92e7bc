//! The coarse operations of the fields, and their CPU implementation.
//!
//! [`FieldOps`] is what a model may call: the macro routes tensors to the concrete backend.
//! [`FieldKernels`] is what a concrete backend has in addition, for the shared backward of
//! [`super::autodiff`]: it may have associated types, which the macro could not see.

use crate::kernel::adam::{self, AdamStep};
use crate::kernel::march::MarchRay;
use crate::kernel::mlp::Weights;
use crate::kernel::neus::{self, Rays};
use crate::kernel::sdf::{self, FieldShape};
use crate::kernel::vm::{self, DecoderWeights, Grid, Penalty, VmField};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{DType, Int, Tensor, TensorData};
use std::fmt::{self, Debug};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// Operations that models call through the free functions of this module.
#[backend_extension(Flex, Autodiff)]
pub trait FieldOps: Backend {
    /// See [`sdf_field`].
    fn sdf_field(
        table: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        x: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        shape: Arc<FieldShape>,
    ) -> FloatTensor<Self>;

    /// See [`neus()`].
    fn neus(
        field: FloatTensor<Self>,
        inv_s: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        t: FloatTensor<Self>,
        dt: FloatTensor<Self>,
        offsets: IntTensor<Self>,
        anneal: f32,
    ) -> FloatTensor<Self>;

    /// See [`vm_render`].
    fn vm_render(
        density: FloatTensor<Self>,
        color: FloatTensor<Self>,
        network: FloatTensor<Self>,
        batch: Arc<VmBatch>,
    ) -> FloatTensor<Self>;

    /// See [`penalized`].
    fn penalized(x: FloatTensor<Self>, penalty: Arc<GridPenalty>) -> FloatTensor<Self>;

    /// See [`adam_step`].
    fn adam_step(
        p: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        g: FloatTensor<Self>,
        step: AdamStep,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
}

/// The backward of one evaluated operation: from the gradient of its output to those of its `N` inputs.
///
/// It owns what the forward kept on its device, and gives that up when it is applied.
pub struct Pullback<B: Backend, const N: usize>(Arc<Mutex<Option<BoxedPullback<B, N>>>>);

type BoxedPullback<B, const N: usize> = Box<dyn FnOnce(FloatTensor<B>) -> [FloatTensor<B>; N] + Send>;

/// The output of an operation, and its backward.
pub type Evaluated<B, const N: usize> = (FloatTensor<B>, Pullback<B, N>);

impl<B: Backend, const N: usize> Pullback<B, N> {
    /// Wraps the backward.
    pub fn new(backward: impl FnOnce(FloatTensor<B>) -> [FloatTensor<B>; N] + Send + 'static) -> Self {
        Pullback(Arc::new(Mutex::new(Some(Box::new(backward)))))
    }

    /// Returns the gradients of the inputs.
    pub fn apply(&self, g: FloatTensor<B>) -> [FloatTensor<B>; N] {
        let backward = self.0.lock().expect("no panic while it is locked").take();
        backward.expect("a graph is walked back once")(g)
    }
}

impl<B: Backend, const N: usize> Clone for Pullback<B, N> {
    fn clone(&self) -> Self {
        Pullback(self.0.clone())
    }
}

impl<B: Backend, const N: usize> Debug for Pullback<B, N> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Pullback")
    }
}

/// What only concrete backends have: forwards that come with their backward.
pub trait FieldKernels: FieldOps {
    /// [`sdf_field`]; gradients by table and weights.
    fn evaluate_sdf_field(
        table: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        x: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        shape: Arc<FieldShape>,
    ) -> Evaluated<Self, 2>;

    /// [`neus()`]; gradients by field and `inv_s`.
    fn evaluate_neus(
        field: FloatTensor<Self>,
        inv_s: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        t: FloatTensor<Self>,
        dt: FloatTensor<Self>,
        offsets: IntTensor<Self>,
        anneal: f32,
    ) -> Evaluated<Self, 2>;

    /// [`vm_render`]; gradients by density, appearance and network.
    fn evaluate_vm_render(
        density: FloatTensor<Self>,
        color: FloatTensor<Self>,
        network: FloatTensor<Self>,
        batch: Arc<VmBatch>,
    ) -> Evaluated<Self, 3>;

    /// [`penalized`]; the gradient with the penalty's own added.
    fn evaluate_penalized(x: FloatTensor<Self>, penalty: Arc<GridPenalty>) -> Evaluated<Self, 1>;
}

/// The fused signed-distance field: see [`crate::kernel::sdf`].
///
/// # Shapes
///
/// - table: `[2 · entries]`; weights: `[P]` as [`crate::kernel::mlp::Layout`] describes
/// - x: `[n, 3]` in the field's box; direction: `[n, 3]` unit
/// - output: `[n, 8]` = sdf, ∇sdf (3), rgb (3), ln of the local sharpness's share; differentiable by table and weights
pub fn sdf_field(
    table: Tensor<1>,
    weights: Tensor<1>,
    x: Tensor<2>,
    direction: Tensor<2>,
    shape: Arc<FieldShape>,
) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as FieldOps>::sdf_field(
        table.into_dispatch(),
        weights.into_dispatch(),
        x.into_dispatch(),
        direction.into_dispatch(),
        shape,
    ))
}

/// The samples of a batch of rays, as tensors.
#[derive(Clone)]
pub struct RaySamples {
    /// `[rays, 3]` unit.
    pub direction: Tensor<2>,
    /// `[samples]` midpoints.
    pub t: Tensor<1>,
    /// `[samples]` lengths.
    pub dt: Tensor<1>,
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Tensor<1, Int>,
}

/// NeuS compositing: see [`crate::kernel::neus`].
///
/// # Shapes
///
/// - field: `[samples, 8]` of [`sdf_field`]; inv_s: `[1]`; anneal: 0..=1
/// - output: `[rays, 8]` = rgb (3), opacity, Σ w t, Σ w n̂ (3); differentiable by field and inv_s
pub fn neus(field: Tensor<2>, inv_s: Tensor<1>, rays: RaySamples, anneal: f32) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as FieldOps>::neus(
        field.into_dispatch(),
        inv_s.into_dispatch(),
        rays.direction.into_dispatch(),
        rays.t.into_dispatch(),
        rays.dt.into_dispatch(),
        rays.offsets.into_dispatch(),
        anneal,
    ))
}

/// A batch of rays and the field they go through, for [`vm_render`].
#[derive(Debug)]
pub struct VmBatch {
    /// Grids, box, lattice and mask.
    pub field: Arc<VmField>,
    /// `[rays]`
    pub rays: Vec<MarchRay>,
    /// Filled by the forward: densities looked up.
    pub density_samples: AtomicU64,
    /// Filled by the forward: colors decoded.
    pub color_samples: AtomicU64,
}

impl VmBatch {
    /// A batch that nothing is known about yet.
    pub fn new(field: Arc<VmField>, rays: Vec<MarchRay>) -> VmBatch {
        VmBatch { field, rays, density_samples: AtomicU64::new(0), color_samples: AtomicU64::new(0) }
    }
}

/// A regularizer of one grid.
#[derive(Clone, Copy, Debug)]
pub struct GridPenalty {
    /// Layout of the values.
    pub grid: Grid,
    /// Weights of its terms.
    pub penalty: Penalty,
}

/// Rays through a vector-matrix field: see [`crate::kernel::vm`].
///
/// # Shapes
///
/// - density, color: flat planes and lines of the field's two grids; network: flat decoder weights
/// - output: `[rays, 5]` = rgb over black (3), opacity, Σ w t; differentiable by all three
pub fn vm_render(density: Tensor<1>, color: Tensor<1>, network: Tensor<1>, batch: Arc<VmBatch>) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as FieldOps>::vm_render(
        density.into_dispatch(),
        color.into_dispatch(),
        network.into_dispatch(),
        batch,
    ))
}

/// The same values; whoever asks for their gradient gets the penalty's added to it.
///
/// That is the loss with the penalty in it, without a second gradient of the size of the grid to be made
/// and summed. The penalty's value is not part of any loss tensor.
pub fn penalized(x: Tensor<1>, penalty: Arc<GridPenalty>) -> Tensor<1> {
    Tensor::from_dispatch(<Dispatch as FieldOps>::penalized(x.into_dispatch(), penalty))
}

/// One fused AdamW step: weights, first and second moments after it. In place where the tensors are
/// not shared; `g` is consumed.
pub fn adam_step<const D: usize>(
    p: Tensor<D>,
    m: Tensor<D>,
    v: Tensor<D>,
    g: Tensor<D>,
    step: AdamStep,
) -> (Tensor<D>, Tensor<D>, Tensor<D>) {
    let (p, m, v) = <Dispatch as FieldOps>::adam_step(
        p.into_dispatch(),
        m.into_dispatch(),
        v.into_dispatch(),
        g.into_dispatch(),
        step,
    );
    (Tensor::from_dispatch(p), Tensor::from_dispatch(m), Tensor::from_dispatch(v))
}

type FlexTensor = FloatTensor<Flex>;

fn flex(values: Vec<f32>, shape: impl Into<Vec<usize>>) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape.into()))
}

fn vector(values: Vec<f32>) -> FlexTensor {
    let n = values.len();
    flex(values, [n])
}

/// The tensor with its values in order at the start of its storage, copied only if they are not.
fn contiguous(t: FlexTensor) -> FlexTensor {
    if t.is_contiguous() && t.layout().start_offset() == 0 { t } else { t.to_contiguous() }
}

fn slice(t: &FlexTensor) -> &[f32] {
    t.as_slice::<f32>().expect("made contiguous f32 before")
}

fn rows<const N: usize>(t: &FlexTensor) -> &[[f32; N]] {
    bytemuck::cast_slice(slice(t))
}

/// Gradient buffers that are all zero and wait for the next step. The optimizer leaves a gradient zero
/// where it touched it, so a step never pays for clearing the whole table.
static ZEROED: Mutex<Vec<FlexTensor>> = Mutex::new(Vec::new());

fn take_zeroed(len: usize) -> FlexTensor {
    let mut free = ZEROED.lock().expect("no panic while the pool is locked");
    match free.iter().position(|t| t.shape().num_elements() == len) {
        Some(i) => free.swap_remove(i),
        None => vector(vec![0.0; len]),
    }
}

fn give_back_zeroed(t: FlexTensor) {
    /// Smaller buffers are not worth keeping, and only a few tables train at once.
    const WORTH: usize = 1 << 16;
    const KEPT: usize = 4;
    let mut free = ZEROED.lock().expect("no panic while the pool is locked");
    if t.is_unique() && t.is_contiguous() && t.shape().num_elements() >= WORTH {
        if free.len() == KEPT {
            free.remove(0); // of a grid that has become finer since
        }
        free.push(t);
    }
}

fn integers(t: IntTensor<Flex>) -> Vec<i32> {
    let t = if t.is_contiguous() { t } else { t.to_contiguous() };
    match t.dtype() {
        DType::I32 => t.as_slice::<i32>().expect("contiguous").to_vec(),
        _ => t.into_data().iter::<i64>().map(|v| v as i32).collect(),
    }
}

impl FieldOps for Flex {
    fn sdf_field(
        table: FlexTensor,
        weights: FlexTensor,
        x: FlexTensor,
        direction: FlexTensor,
        shape: Arc<FieldShape>,
    ) -> FlexTensor {
        Self::evaluate_sdf_field(table, weights, x, direction, shape).0
    }

    fn neus(
        field: FlexTensor,
        inv_s: FlexTensor,
        direction: FlexTensor,
        t: FlexTensor,
        dt: FlexTensor,
        offsets: IntTensor<Self>,
        anneal: f32,
    ) -> FlexTensor {
        Self::evaluate_neus(field, inv_s, direction, t, dt, offsets, anneal).0
    }

    fn vm_render(
        density: FlexTensor,
        color: FlexTensor,
        network: FlexTensor,
        batch: Arc<VmBatch>,
    ) -> FlexTensor {
        Self::evaluate_vm_render(density, color, network, batch).0
    }

    fn penalized(x: FlexTensor, _: Arc<GridPenalty>) -> FlexTensor {
        x
    }

    fn adam_step(
        p: FlexTensor,
        m: FlexTensor,
        v: FlexTensor,
        g: FlexTensor,
        step: AdamStep,
    ) -> (FlexTensor, FlexTensor, FlexTensor) {
        let [mut p, mut m, mut v, mut g] = [p, m, v, g].map(contiguous);
        adam::adam(p.storage_mut(), m.storage_mut(), v.storage_mut(), g.storage_mut(), &step);
        give_back_zeroed(g);
        (p, m, v)
    }
}

impl FieldKernels for Flex {
    fn evaluate_sdf_field(
        table: FlexTensor,
        weights: FlexTensor,
        x: FlexTensor,
        direction: FlexTensor,
        shape: Arc<FieldShape>,
    ) -> Evaluated<Self, 2> {
        let [table, weights, x, direction] = [table, weights, x, direction].map(contiguous);
        let weights = Weights::new(shape.layout(), slice(&weights));
        let activations = sdf::forward(&shape, rows(&table), &weights, rows(&x), rows(&direction));
        let out = flex(activations.output().to_vec(), [x.shape()[0], sdf::WIDTH]);
        let table = table.shape().num_elements();
        let backward = move |g| {
            let mut g_table = take_zeroed(table);
            let entries = bytemuck::cast_slice_mut(g_table.storage_mut::<f32>());
            let flat = sdf::backward(&activations, &weights, slice(&contiguous(g)), entries);
            [g_table, vector(flat)]
        };
        (out, Pullback::new(backward))
    }

    fn evaluate_neus(
        field: FlexTensor,
        inv_s: FlexTensor,
        direction: FlexTensor,
        t: FlexTensor,
        dt: FlexTensor,
        offsets: IntTensor<Self>,
        anneal: f32,
    ) -> Evaluated<Self, 2> {
        let [field, inv_s, direction, t, dt] = [field, inv_s, direction, t, dt].map(contiguous);
        let inv_s = slice(&inv_s)[0];
        let offsets = integers(offsets);
        let rays = Rays { offsets: &offsets, direction: rows(&direction), t: slice(&t), dt: slice(&dt) };
        let out = neus::forward(rays, slice(&field), inv_s, anneal);
        let out = flex(out, [offsets.len() - 1, neus::RAY_WIDTH]);
        let backward = move |g| {
            let rays = Rays { offsets: &offsets, direction: rows(&direction), t: slice(&t), dt: slice(&dt) };
            let (g_field, g_s) = neus::backward(rays, slice(&field), inv_s, anneal, slice(&contiguous(g)));
            let samples = g_field.len() / sdf::WIDTH;
            [flex(g_field, [samples, sdf::WIDTH]), vector(vec![g_s])]
        };
        (out, Pullback::new(backward))
    }

    fn evaluate_vm_render(
        density: FlexTensor,
        color: FlexTensor,
        network: FlexTensor,
        batch: Arc<VmBatch>,
    ) -> Evaluated<Self, 3> {
        let [density, color, network] = [density, color, network].map(contiguous);
        let weights = DecoderWeights::new(batch.field.decoder, slice(&network));
        let mut rendered = vm::render(&batch.field, slice(&density), slice(&color), &weights, &batch.rays);
        batch.density_samples.store(rendered.density_samples, Ordering::Relaxed);
        batch.color_samples.store(rendered.color_samples, Ordering::Relaxed);
        let out = flex(std::mem::take(&mut rendered.out), [batch.rays.len(), vm::RAY_WIDTH]);
        let color_len = color.shape().num_elements();
        let backward = move |g| {
            let mut g_density = take_zeroed(density.shape().num_elements());
            let mut g_color = take_zeroed(color_len);
            let flat = vm::backward(
                &batch.field,
                slice(&density),
                &weights,
                rendered,
                slice(&contiguous(g)),
                g_density.storage_mut::<f32>(),
                g_color.storage_mut::<f32>(),
            );
            [g_density, g_color, vector(flat)]
        };
        (out, Pullback::new(backward))
    }

    fn evaluate_penalized(x: FlexTensor, penalty: Arc<GridPenalty>) -> Evaluated<Self, 1> {
        let values = x.clone();
        let backward = move |g| {
            let [x, mut g] = [values, g].map(contiguous);
            vm::penalize(&penalty.grid, &penalty.penalty, slice(&x), g.storage_mut::<f32>());
            [g]
        };
        (x, Pullback::new(backward))
    }
}
