//! Differentiation of the fused operations: one rule for all of them and every device.

use super::ops::{Evaluated, FieldKernels, FieldOps, GridPenalty, Pullback, VmBatch};
use crate::kernel::adam::AdamStep;
use crate::kernel::sdf::FieldShape;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Autodiff, AutodiffBackend, Backend};
use std::sync::Arc;

/// An operation whose backward came with its forward.
#[derive(Debug)]
struct Fused;

impl<B: Backend, const N: usize> Backward<B, N> for Fused {
    type State = Pullback<B, N>;

    fn backward(self, ops: Ops<Self::State, N>, grads: &mut Gradients, _: &mut Checkpointer) {
        let g = grads.consume::<B>(&ops.node);
        for (node, g) in ops.parents.into_iter().zip(ops.state.apply(g)) {
            if let Some(node) = node {
                grads.register::<B>(node.id, g);
            }
        }
    }
}

/// Puts an evaluated operation into the graph; `nodes` are its inputs in the order of the pullback's gradients.
fn tracked<B: Backend, C: CheckpointStrategy, const N: usize>(
    nodes: [NodeGuard; N],
    (out, pullback): Evaluated<B, N>,
) -> FloatTensor<Autodiff<B, C>> {
    match Fused.prepare::<C>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prep) => prep.finish(pullback, out),
        OpsKind::UnTracked(prep) => prep.finish(out),
    }
}

impl<B: FieldKernels, C: CheckpointStrategy> FieldOps for Autodiff<B, C> {
    fn sdf_field(
        table: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        x: FloatTensor<Self>,
        direction: FloatTensor<Self>,
        shape: Arc<FieldShape>,
    ) -> FloatTensor<Self> {
        let ((table, a), (weights, b)) = (table.into_parts(), weights.into_parts());
        let (x, direction) = (x.into_primitive(), direction.into_primitive());
        tracked::<B, C, _>([a, b], B::evaluate_sdf_field(table, weights, x, direction, shape))
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
        let ((field, a), (inv_s, b)) = (field.into_parts(), inv_s.into_parts());
        let [direction, t, dt] = [direction, t, dt].map(|t| t.into_primitive());
        tracked::<B, C, _>([a, b], B::evaluate_neus(field, inv_s, direction, t, dt, offsets, anneal))
    }

    fn vm_render(
        density: FloatTensor<Self>,
        color: FloatTensor<Self>,
        network: FloatTensor<Self>,
        batch: Arc<VmBatch>,
    ) -> FloatTensor<Self> {
        let [(density, a), (color, b), (network, c)] = [density, color, network].map(|t| t.into_parts());
        tracked::<B, C, _>([a, b, c], B::evaluate_vm_render(density, color, network, batch))
    }

    fn penalized(x: FloatTensor<Self>, penalty: Arc<GridPenalty>) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        tracked::<B, C, _>([node], B::evaluate_penalized(x, penalty))
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
        (Self::from_inner(p), Self::from_inner(m), Self::from_inner(v))
    }
}
