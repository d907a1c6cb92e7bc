//! One backward per operation, shared by every device.

use super::ops::{FieldKernels, FieldOps, GridPenalty, VmBatch};
use crate::kernel::adam::AdamStep;
use crate::kernel::sdf::FieldShape;
use burn::backend::Autodiff;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::{FloatTensor, IntTensor};
use std::sync::Arc;

#[derive(Debug)]
struct SdfFieldBackward;

impl<B: FieldKernels> Backward<B, 2> for SdfFieldBackward {
    type State = B::SavedField;

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let g = grads.consume::<B>(&ops.node);
        let (g_table, g_weights) = B::sdf_field_backward(ops.state, g);
        let [table, weights] = ops.parents;
        if let Some(node) = table {
            grads.register::<B>(node.id, g_table);
        }
        if let Some(node) = weights {
            grads.register::<B>(node.id, g_weights);
        }
    }
}

#[derive(Debug)]
struct NeusBackward;

impl<B: FieldKernels> Backward<B, 2> for NeusBackward {
    type State = B::SavedRays;

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let g = grads.consume::<B>(&ops.node);
        let (g_field, g_inv_s) = B::neus_backward(ops.state, g);
        let [field, inv_s] = ops.parents;
        if let Some(node) = field {
            grads.register::<B>(node.id, g_field);
        }
        if let Some(node) = inv_s {
            grads.register::<B>(node.id, g_inv_s);
        }
    }
}

#[derive(Debug)]
struct VmRenderBackward;

impl<B: FieldKernels> Backward<B, 3> for VmRenderBackward {
    type State = B::SavedVm;

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let g = grads.consume::<B>(&ops.node);
        let (g_density, g_color, g_network) = B::vm_render_backward(ops.state, g);
        for (node, g) in ops.parents.into_iter().zip([g_density, g_color, g_network]) {
            if let Some(node) = node {
                grads.register::<B>(node.id, g);
            }
        }
    }
}

#[derive(Debug)]
struct PenalisedBackward;

impl<B: FieldKernels> Backward<B, 1> for PenalisedBackward {
    type State = (FloatTensor<B>, Arc<GridPenalty>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let g = grads.consume::<B>(&ops.node);
        let (x, penalty) = ops.state;
        let [parent] = ops.parents;
        if let Some(node) = parent {
            grads.register::<B>(node.id, B::penalise(x, g, &penalty));
        }
    }
}

impl<B: FieldKernels, C: CheckpointStrategy> FieldOps for Autodiff<B, C> {
    fn vm_render(
        density: FloatTensor<Self>,
        color: FloatTensor<Self>,
        network: FloatTensor<Self>,
        batch: Arc<VmBatch>,
    ) -> FloatTensor<Self> {
        let (density, density_node) = density.into_parts();
        let (color, color_node) = color.into_parts();
        let (network, network_node) = network.into_parts();
        let nodes = [density_node, color_node, network_node];
        match VmRenderBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (out, saved) = B::vm_render_forward(density, color, network, batch);
                prep.finish(saved, out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::vm_render(density, color, network, batch)),
        }
    }

    fn penalised(x: FloatTensor<Self>, penalty: Arc<GridPenalty>) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        match PenalisedBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish((x.clone(), penalty), x),
            OpsKind::UnTracked(prep) => prep.finish(x),
        }
    }

    fn sdf_field(
        table: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        x: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        shape: Arc<FieldShape>,
    ) -> FloatTensor<Self> {
        let (table, table_node) = table.into_parts();
        let (weights, weights_node) = weights.into_parts();
        let (x, direction) = (x.into_primitive(), direction.into_primitive());
        match SdfFieldBackward.prepare::<C>([table_node, weights_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (out, saved) = B::sdf_field_forward(table, weights, x, direction, shape);
                prep.finish(saved, out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::sdf_field(table, weights, x, direction, shape)),
        }
    }

    fn neus(
        field: FloatTensor<Self>,
        inv_s: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        t: FloatTensor<Self>,
        dt: FloatTensor<Self>,
        offsets: IntTensor<Self>,
        anneal: f32,
    ) -> FloatTensor<Self> {
        let (field, field_node) = field.into_parts();
        let (inv_s, inv_s_node) = inv_s.into_parts();
        let (direction, t, dt) = (direction.into_primitive(), t.into_primitive(), dt.into_primitive());
        match NeusBackward.prepare::<C>([field_node, inv_s_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (out, saved) = B::neus_forward(field, inv_s, direction, t, dt, offsets, anneal);
                prep.finish(saved, out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::neus(field, inv_s, direction, t, dt, offsets, anneal)),
        }
    }

    /// Not differentiable: an update of leaves, outside any graph.
    fn adam_step(
        p: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        g: FloatTensor<Self>,
        step: AdamStep,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        let [p, m, v, g] = [p, m, v, g].map(|t| t.into_primitive());
        let (p, m, v) = B::adam_step(p, m, v, g, step);
        use burn::backend::AutodiffBackend;
        (Self::from_inner(p), Self::from_inner(m), Self::from_inner(v))
    }
}
