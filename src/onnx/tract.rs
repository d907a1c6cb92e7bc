//! The engine: `tract`, in Rust, one thread to a run.
//!
//! It wants every shape fixed. The file is parsed once; for each set of input shapes a plan is made from it
//! (0.2 to 1 s for public networks) and kept, since the photographs of a capture share their size.

use super::network::{Fed, I64, NetworkArray, Port};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use tract_onnx::pb;
use tract_onnx::prelude::*;
use tract_onnx::tract_hir::infer::Factoid;

/// Name and version, as recorded with a run.
pub(super) const NAME: &str = "tract 0.23.9";

/// Plans kept of one file. Each holds its own packed weights.
const KEPT_PLANS: usize = 4;

type Runnable = Arc<TypedRunnableModel>;

/// A parsed file and its plans by the shapes of its inputs.
pub(super) struct TractModel {
    parsed: InferenceModel,
    array_bytes: u64,
    plans: Mutex<HashMap<Vec<Vec<usize>>, Runnable>>,
}

impl TractModel {
    /// Takes the graph of a file; shapes that it states for inner arrays are not trusted, exporters write wrong
    /// ones. `outputs`: those that will be asked for. `array_bytes`: bytes of the largest array that may be planned.
    pub(super) fn load(
        proto: &pb::ModelProto,
        outputs: &[String],
        array_bytes: u64,
    ) -> Result<TractModel, String> {
        let read = || -> TractResult<InferenceModel> {
            let onnx = tract_onnx::onnx().with_ignore_output_shapes(true).with_ignore_value_info(true);
            let mut parsed = onnx.model_for_proto_model(proto)?;
            let named = proto.graph.iter().flat_map(|g| &g.output).zip(&parsed.outputs);
            let named: HashMap<&str, OutletId> = named.map(|(port, at)| (port.name.as_str(), *at)).collect();
            let wanted: Vec<OutletId> =
                outputs.iter().filter_map(|name| named.get(name.as_str()).copied()).collect();
            parsed.select_output_outlets(&wanted)?;
            Ok(parsed)
        };
        let parsed = read().map_err(|e| sentence(&e))?;
        Ok(TractModel { parsed, array_bytes, plans: Mutex::default() })
    }

    /// The plan for these shapes, made when there is none yet.
    fn plan(&self, fed: &Fed) -> TractResult<Runnable> {
        let key: Vec<Vec<usize>> = fed.iter().map(|(_, array)| array.shape.clone()).collect();
        // held while planning: photographs that come together wait for the one plan they share
        let mut plans = self.plans.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(plan) = plans.get(&key) {
            return Ok(plan.clone());
        }
        let mut model = self.parsed.clone();
        for (i, (port, array)) in fed.iter().enumerate() {
            let kind = if port.kind == I64 { i64::datum_type() } else { f32::datum_type() };
            model.set_input_fact(i, InferenceFact::dt_shape(kind, array.shape.as_slice()))?;
        }
        self.bounded(&mut model)?;
        model.analyse(false)?;
        let plan = model.into_optimized()?.into_runnable()?;
        if plans.len() >= KEPT_PLANS {
            plans.clear();
        }
        plans.insert(key, plan.clone());
        Ok(plan)
    }

    /// Refuses a graph with an array no photograph needs, before the engine makes it.
    fn bounded(&self, model: &mut InferenceModel) -> TractResult<()> {
        for id in model.eval_order()? {
            let about = |e: TractError| e.context(format!("Failed analyse for node {}", model.node(id)));
            let known = self.inferred(model, id).map_err(about)?;
            for (slot, known) in known.into_iter().enumerate() {
                model.set_outlet_fact(OutletId::new(id, slot), known)?;
            }
        }
        Ok(())
    }

    /// What is known of a node's outputs once what is known of its inputs is taken in. Inferring also computes
    /// what is constant, so the extents alone are asked for first.
    fn inferred(&self, model: &InferenceModel, id: usize) -> TractResult<Vec<InferenceFact>> {
        let node = model.node(id);
        let mut op = node.op.clone();
        let (inputs, outputs) = model.node_facts(id)?;
        let seen = op.observe_outlets(model, node)?;
        let seen = seen.iter().map(|at| model.outlet_fact(*at)).collect::<TractResult<TVec<_>>>()?;
        let extents = op.infer_facts(inputs.clone(), outputs.clone(), seen.clone())?.1;
        for shape in extents.iter().filter_map(|fact| fact.shape.concretize()) {
            let extents = shape.iter().map(|d| d.to_i64().unwrap_or(1).unsigned_abs());
            let bytes = extents.fold(4u64, |n, d| n.saturating_mul(d));
            if bytes > self.array_bytes {
                return Err(TractError::msg(format!("it asks for an array of {bytes} bytes")));
            }
        }
        let known = op.infer(inputs, outputs.clone(), seen)?.1;
        known.iter().zip(outputs).map(|(known, old)| known.unify(old)).collect()
    }

    /// One run.
    pub(super) fn run(&self, fed: &Fed) -> Result<Vec<NetworkArray>, String> {
        let run = || -> TractResult<Vec<NetworkArray>> {
            let plan = self.plan(fed)?;
            let value = |(port, array): &(&Port, &NetworkArray)| -> TractResult<TValue> {
                let made = match port.kind {
                    I64 => Tensor::from_shape(&array.shape, &array.integers())?,
                    _ => Tensor::from_shape(&array.shape, &array.values)?,
                };
                Ok(made.into_tvalue())
            };
            let given = plan.run(fed.iter().map(value).collect::<TractResult<TVec<_>>>()?)?;
            let array = |value: &TValue| -> TractResult<NetworkArray> {
                let view = value.to_plain_array_view::<f32>()?;
                Ok(NetworkArray { shape: view.shape().to_vec(), values: view.iter().copied().collect() })
            };
            given.iter().map(array).collect()
        };
        run().map_err(|e| sentence(&e))
    }
}

/// Where and why, in a sentence: the first of what the engine says, and the beginning of the innermost; the
/// pages of shape algebra between them go to the log.
fn sentence(error: &TractError) -> String {
    tracing::debug!(target: "tract", "{error:#}");
    let (first, root) = (error.to_string(), error.root_cause().to_string());
    let why = root.split([':', '[', '\n']).next().unwrap_or_default().trim();
    if first.contains(why) { first } else { format!("{first}: {why}") }
}
