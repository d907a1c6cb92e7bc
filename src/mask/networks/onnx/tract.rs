//! The built-in engine: `tract`, in Rust, one thread to a run.
//!
//! It wants every shape fixed. The file is parsed once; for each set of input shapes a plan is made from it
//! (0.2 to 1 s for public networks) and kept, since the photographs of a capture share their size.

use super::{Output, Tensor, Values};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use tract_onnx::prelude::*;
use tract_onnx::tract_hir::infer::Factoid;

/// Name and version, as recorded with a run.
pub(super) const NAME: &str = "tract 0.23.9";

/// Plans kept of one file; the oldest goes first. Each holds its own packed weights.
const KEPT_PLANS: usize = 4;

type Plan = Arc<TypedRunnableModel>;
/// Shape of every input in the order of the model, and the outputs asked for.
type Key = (Vec<Vec<usize>>, Vec<String>);

/// A parsed file and its plans.
pub(super) struct Model {
    parsed: InferenceModel,
    inputs: Vec<String>,
    outputs: Vec<String>,
    array_bytes: u64,
    plans: Mutex<VecDeque<(Key, Plan)>>,
}

impl Model {
    /// Parses; shapes that the file states for inner arrays are not trusted, exporters write wrong ones.
    /// `outputs`: the names of the file's outputs, in order.
    pub(super) fn load(bytes: &[u8], outputs: Vec<String>, array_bytes: u64) -> Result<Model, String> {
        let parsed = tract_onnx::onnx()
            .with_ignore_output_shapes(true)
            .with_ignore_value_info(true)
            .model_for_read(&mut &bytes[..])
            .map_err(|e| sentence(&e))?;
        let inputs = parsed
            .input_outlets()
            .map_err(|e| sentence(&e))?
            .iter()
            .map(|outlet| parsed.node(outlet.node).name.clone())
            .collect();
        Ok(Model { parsed, inputs, outputs, array_bytes, plans: Mutex::default() })
    }

    /// The plan for these shapes, made when there is none yet.
    pub(super) fn plan(&self, inputs: &[(&str, Tensor)], outputs: &[&str]) -> Result<Plan, String> {
        let shapes = self.ordered(inputs)?.into_iter().map(|t| t.shape.clone()).collect();
        let key: Key = (shapes, outputs.iter().map(|o| o.to_string()).collect());
        // held while planning: photographs that come together wait for the one plan they share
        let mut plans = self.plans.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, plan)) = plans.iter().find(|(k, _)| *k == key) {
            return Ok(plan.clone());
        }
        let plan = self.make(inputs, outputs).map_err(|e| sentence(&e))?;
        if plans.len() >= KEPT_PLANS {
            plans.pop_front();
        }
        plans.push_back((key, plan.clone()));
        Ok(plan)
    }

    fn make(&self, inputs: &[(&str, Tensor)], outputs: &[&str]) -> TractResult<Plan> {
        let mut model = self.parsed.clone();
        for (i, tensor) in self.ordered(inputs).map_err(|e| anyhow_from(&e))?.into_iter().enumerate() {
            let kind = match tensor.values {
                Values::F32(_) => f32::datum_type(),
                Values::I64(_) => i64::datum_type(),
            };
            model.set_input_fact(i, InferenceFact::dt_shape(kind, tensor.shape.as_slice()))?;
        }
        let mut wanted = Vec::new();
        for name in outputs {
            let place = self.outputs.iter().position(|o| o == name);
            let outlet = place.and_then(|i| model.outputs.get(i).copied());
            wanted.push(outlet.ok_or_else(|| anyhow_from(&format!("there is no output `{name}`")))?);
        }
        model.select_output_outlets(&wanted)?;
        model.analyse(false)?;
        self.bounded(&model)?;
        model.into_optimized()?.into_runnable()
    }

    /// Refuses a graph with an array no photograph needs, before the engine makes it.
    fn bounded(&self, model: &InferenceModel) -> TractResult<()> {
        for node in model.nodes() {
            for output in &node.outputs {
                let Some(shape) = output.fact.shape.concretize() else { continue };
                let extents = shape.iter().map(|d| d.to_i64().unwrap_or(1).unsigned_abs());
                let bytes = extents.fold(4u64, |n, d| n.saturating_mul(d));
                if bytes > self.array_bytes {
                    let problem = format!("its node `{}` asks for an array of {bytes} bytes", node.name);
                    return Err(anyhow_from(&problem));
                }
            }
        }
        Ok(())
    }

    /// The inputs in the order of the model.
    fn ordered<'a>(&self, inputs: &'a [(&str, Tensor)]) -> Result<Vec<&'a Tensor>, String> {
        let find = |name: &String| {
            let found = inputs.iter().find(|(n, _)| n == name).map(|(_, t)| t);
            found.ok_or_else(|| format!("it asks for `{name}`, which is not fed"))
        };
        self.inputs.iter().map(find).collect()
    }

    /// One run.
    pub(super) fn run(&self, inputs: &[(&str, Tensor)], outputs: &[&str]) -> Result<Vec<Output>, String> {
        let plan = self.plan(inputs, outputs)?;
        let mut fed = TVec::new();
        for tensor in self.ordered(inputs)? {
            let made = match &tensor.values {
                Values::F32(v) => tract_onnx::prelude::Tensor::from_shape(&tensor.shape, v),
                Values::I64(v) => tract_onnx::prelude::Tensor::from_shape(&tensor.shape, v),
            };
            fed.push(made.map_err(|e| sentence(&e))?.into_tvalue());
        }
        let given = plan.run(fed).map_err(|e| sentence(&e))?;
        given
            .iter()
            .map(|value| {
                let view = value.to_plain_array_view::<f32>().map_err(|e| sentence(&e))?;
                Ok(Output { shape: view.shape().to_vec(), values: view.iter().copied().collect() })
            })
            .collect()
    }
}

fn anyhow_from(problem: &str) -> TractError {
    TractError::msg(problem.to_string())
}

/// Where and why, in a sentence: the first of what the engine says, and the beginning of the innermost; the
/// pages of shape algebra between them go to the log.
fn sentence(error: &TractError) -> String {
    tracing::debug!(target: "tract", "{error:#}");
    let (first, root) = (error.to_string(), error.root_cause().to_string());
    let why = root.split([':', '[', '\n']).next().unwrap_or_default().trim();
    if first.contains(why) { first } else { format!("{first}: {why}") }
}
