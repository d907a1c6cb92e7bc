//! The coarse operations of the fields, and their CPU implementation.
//!
//! [`FieldOps`] is what a model may call: the macro routes tensors to the concrete backend.
//! [`FieldKernels`] is what a concrete backend has in addition, for the shared backward of
//! [`super::autodiff`]: it may have associated types, which the macro could not see.

use crate::kernel::adam::{self, AdamStep};
use crate::kernel::mlp::Weights;
use crate::kernel::neus::{self, Rays};
use crate::kernel::sdf::{self, Activations, FieldShape};
use crate::kernel::vm::mask::VmRay;
use crate::kernel::vm::{self, DecoderWeights, Grid, Penalty, Rendered, VmField};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{DType, Int, Tensor, TensorData};
use std::fmt::Debug;
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

    /// See [`penalised`].
    fn penalised(x: FloatTensor<Self>, penalty: Arc<GridPenalty>) -> FloatTensor<Self>;

    /// See [`adam_step`].
    fn adam_step(
        p: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        g: FloatTensor<Self>,
        step: AdamStep,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
}

/// What only concrete backends have: forwards that keep what the backward needs.
pub trait FieldKernels: FieldOps {
    /// Kept by [`FieldKernels::sdf_field_forward`].
    type SavedField: Clone + Send + Debug + 'static;
    /// Kept by [`FieldKernels::neus_forward`].
    type SavedRays: Clone + Send + Debug + 'static;
    /// Kept by [`FieldKernels::vm_render_forward`].
    type SavedVm: Clone + Send + Debug + 'static;

    /// [`vm_render`] that remembers.
    fn vm_render_forward(
        density: FloatTensor<Self>,
        color: FloatTensor<Self>,
        network: FloatTensor<Self>,
        batch: Arc<VmBatch>,
    ) -> (FloatTensor<Self>, Self::SavedVm);

    /// Gradients by density, appearance and network.
    fn vm_render_backward(
        saved: Self::SavedVm,
        g: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);

    /// The gradient `g` of the values `x` with the penalty's own added.
    fn penalise(x: FloatTensor<Self>, g: FloatTensor<Self>, penalty: &GridPenalty) -> FloatTensor<Self>;

    /// [`sdf_field`] that remembers.
    fn sdf_field_forward(
        table: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        x: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        shape: Arc<FieldShape>,
    ) -> (FloatTensor<Self>, Self::SavedField);

    /// Gradients by table and weights.
    fn sdf_field_backward(
        saved: Self::SavedField,
        g: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);

    /// [`neus()`] that remembers.
    fn neus_forward(
        field: FloatTensor<Self>,
        inv_s: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        t: FloatTensor<Self>,
        dt: FloatTensor<Self>,
        offsets: IntTensor<Self>,
        anneal: f32,
    ) -> (FloatTensor<Self>, Self::SavedRays);

    /// Gradients by field and `inv_s`.
    fn neus_backward(saved: Self::SavedRays, g: FloatTensor<Self>) -> (FloatTensor<Self>, FloatTensor<Self>);
}

/// The fused signed-distance field: see [`crate::kernel::sdf`].
///
/// # Shapes
///
/// - table: `[entries, 2]`; weights: `[P]` as [`crate::kernel::mlp::Layout`] describes
/// - x: `[n, 3]` in the field's box; direction: `[n, 3]` unit
/// - output: `[n, 8]` = sdf, ∇sdf (3), rgb (3), ln of the local sharpness's share; differentiable by table and weights
pub fn sdf_field(
    table: Tensor<2>,
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
    pub rays: Vec<VmRay>,
    /// Filled by the forward: densities looked up.
    pub density_samples: AtomicU64,
    /// Filled by the forward: colours decoded.
    pub color_samples: AtomicU64,
}

impl VmBatch {
    /// A batch that nothing is known about yet.
    pub fn new(field: Arc<VmField>, rays: Vec<VmRay>) -> VmBatch {
        VmBatch { field, rays, density_samples: AtomicU64::new(0), color_samples: AtomicU64::new(0) }
    }
}

/// A regulariser of one grid.
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
/// and summed. The penalty's value is not part of any loss tensor: see
/// [`crate::kernel::vm::total_variation`].
pub fn penalised(x: Tensor<1>, penalty: Arc<GridPenalty>) -> Tensor<1> {
    Tensor::from_dispatch(<Dispatch as FieldOps>::penalised(x.into_dispatch(), penalty))
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

/// Gradient buffers that are all zero and wait for the next step. The optimiser leaves a gradient zero
/// where it touched it, so a step never pays for clearing the whole table.
static ZEROED: Mutex<Vec<FlexTensor>> = Mutex::new(Vec::new());

fn take_zeroed(shape: &[usize]) -> FlexTensor {
    let mut free = ZEROED.lock().expect("no panic while the pool is locked");
    match free.iter().position(|t| t.shape().to_vec() == shape) {
        Some(i) => free.swap_remove(i),
        None => flex(vec![0.0; shape.iter().product()], shape),
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

impl FieldOps for Flex {
    fn sdf_field(
        table: FlexTensor,
        weights: FlexTensor,
        x: FlexTensor,
        direction: FlexTensor,
        shape: Arc<FieldShape>,
    ) -> FlexTensor {
        Self::sdf_field_forward(table, weights, x, direction, shape).0
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
        Self::neus_forward(field, inv_s, direction, t, dt, offsets, anneal).0
    }

    fn vm_render(
        density: FlexTensor,
        color: FlexTensor,
        network: FlexTensor,
        batch: Arc<VmBatch>,
    ) -> FlexTensor {
        Self::vm_render_forward(density, color, network, batch).0
    }

    fn penalised(x: FlexTensor, _: Arc<GridPenalty>) -> FlexTensor {
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

/// What the CPU keeps of a field evaluation.
#[derive(Debug)]
pub struct SavedField {
    activations: Activations,
    weights: Weights,
    table: Vec<usize>,
}

/// What the CPU keeps of a compositing.
#[derive(Clone, Debug)]
pub struct SavedRays {
    field: FlexTensor,
    inv_s: f32,
    direction: FlexTensor,
    t: FlexTensor,
    dt: FlexTensor,
    offsets: Arc<Vec<i32>>,
    anneal: f32,
}

impl SavedRays {
    fn rays(&self) -> Rays<'_> {
        Rays {
            offsets: &self.offsets,
            direction: rows(&self.direction),
            t: slice(&self.t),
            dt: slice(&self.dt),
        }
    }
}

/// What the CPU keeps of rays through a vector-matrix field.
#[derive(Debug)]
pub struct SavedVm {
    density: FlexTensor,
    color_len: usize,
    weights: DecoderWeights,
    batch: Arc<VmBatch>,
    /// Taken by the backward, which works in its buffers.
    rendered: Mutex<Option<Rendered>>,
}

fn integers(t: IntTensor<Flex>) -> Vec<i32> {
    let t = if t.is_contiguous() { t } else { t.to_contiguous() };
    match t.dtype() {
        DType::I32 => t.as_slice::<i32>().expect("contiguous").to_vec(),
        _ => t.into_data().iter::<i64>().map(|v| v as i32).collect(),
    }
}

impl FieldKernels for Flex {
    type SavedField = Arc<SavedField>;
    type SavedRays = SavedRays;
    type SavedVm = Arc<SavedVm>;

    fn vm_render_forward(
        density: FlexTensor,
        color: FlexTensor,
        network: FlexTensor,
        batch: Arc<VmBatch>,
    ) -> (FlexTensor, Self::SavedVm) {
        let [density, color, network] = [density, color, network].map(contiguous);
        let weights = DecoderWeights::new(batch.field.decoder, slice(&network));
        let mut rendered = vm::render(&batch.field, slice(&density), slice(&color), &weights, &batch.rays);
        batch.density_samples.store(rendered.density_samples, Ordering::Relaxed);
        batch.color_samples.store(rendered.color_samples, Ordering::Relaxed);
        let out = flex(std::mem::take(&mut rendered.out), [batch.rays.len(), vm::RAY_WIDTH]);
        let color_len = color.shape().num_elements();
        let rendered = Mutex::new(Some(rendered));
        (out, Arc::new(SavedVm { density, color_len, weights, batch, rendered }))
    }

    fn vm_render_backward(saved: Self::SavedVm, g: FlexTensor) -> (FlexTensor, FlexTensor, FlexTensor) {
        let g = contiguous(g);
        let rendered = saved.rendered.lock().expect("no panic while it is locked").take();
        let rendered = rendered.expect("a graph is walked back once");
        let mut g_density = take_zeroed(&[saved.density.shape().num_elements()]);
        let mut g_color = take_zeroed(&[saved.color_len]);
        let flat = vm::backward(
            &saved.batch.field,
            slice(&saved.density),
            &saved.weights,
            rendered,
            slice(&g),
            g_density.storage_mut::<f32>(),
            g_color.storage_mut::<f32>(),
        );
        let n = flat.len();
        (g_density, g_color, flex(flat, [n]))
    }

    fn penalise(x: FlexTensor, g: FlexTensor, penalty: &GridPenalty) -> FlexTensor {
        let [x, mut g] = [x, g].map(contiguous);
        vm::penalise(&penalty.grid, &penalty.penalty, slice(&x), g.storage_mut::<f32>());
        g
    }

    fn sdf_field_forward(
        table: FlexTensor,
        weights: FlexTensor,
        x: FlexTensor,
        direction: FlexTensor,
        shape: Arc<FieldShape>,
    ) -> (FlexTensor, Self::SavedField) {
        let [table, weights, x, direction] = [table, weights, x, direction].map(contiguous);
        let weights = Weights::new(shape.layout(), slice(&weights));
        let activations = sdf::forward(&shape, rows(&table), &weights, rows(&x), rows(&direction));
        let out = flex(activations.output().to_vec(), [x.shape()[0], sdf::WIDTH]);
        let saved = SavedField { activations, weights, table: table.shape().to_vec() };
        (out, Arc::new(saved))
    }

    fn sdf_field_backward(saved: Self::SavedField, g: FlexTensor) -> (FlexTensor, FlexTensor) {
        let g = contiguous(g);
        let mut g_table = take_zeroed(&saved.table);
        let entries: &mut [[f32; 2]] = bytemuck::cast_slice_mut(g_table.storage_mut::<f32>());
        let flat = sdf::backward(&saved.activations, &saved.weights, slice(&g), entries);
        let n = flat.len();
        (g_table, flex(flat, [n]))
    }

    fn neus_forward(
        field: FlexTensor,
        inv_s: FlexTensor,
        direction: FlexTensor,
        t: FlexTensor,
        dt: FlexTensor,
        offsets: IntTensor<Self>,
        anneal: f32,
    ) -> (FlexTensor, Self::SavedRays) {
        let [field, inv_s, direction, t, dt] = [field, inv_s, direction, t, dt].map(contiguous);
        let inv_s = slice(&inv_s)[0];
        let offsets = Arc::new(integers(offsets));
        let saved = SavedRays { field, inv_s, direction, t, dt, offsets, anneal };
        let out = neus::forward(saved.rays(), slice(&saved.field), inv_s, anneal);
        (flex(out, [saved.offsets.len() - 1, neus::RAY_WIDTH]), saved)
    }

    fn neus_backward(saved: Self::SavedRays, g: FlexTensor) -> (FlexTensor, FlexTensor) {
        let g = contiguous(g);
        let (g_field, g_s) =
            neus::backward(saved.rays(), slice(&saved.field), saved.inv_s, saved.anneal, slice(&g));
        let samples = g_field.len() / sdf::WIDTH;
        (flex(g_field, [samples, sdf::WIDTH]), flex(vec![g_s], [1]))
    }
}
