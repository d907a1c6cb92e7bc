//! ONNX networks in a session: a file is read once, recognized, and run by tract.
//!
//! The same bytes are hashed and given to the engine, and a file that refers to another one is
//! refused, so the record describes exactly what ran. Nothing is downloaded.
//!
//! The engine is a large program that reads untrusted files. Every call into it runs under
//! `catch_unwind`: a panic inside becomes an error that names the file. (The process's panic hook
//! still prints its line.) Arrays beyond a limit are refused before they are allocated.
//!
//! tract wants every shape fixed. The file is parsed once; for each set of input shapes a plan is
//! made from it (0.2 to 1 s for public networks) and kept, since the photographs of a capture share
//! their size. A run uses one thread.
//!
//! ONNX Runtime, loaded from a library of the user's, was tried as a second engine: ViTMatte-S on a
//! photograph of 384 × 512 pixels takes 2.4 CPU s with tract and 1.3 with ONNX Runtime. It also
//! runs float16 and int8 files and more of what recent exporters write; but it needs a library to
//! be installed, cannot be kept from large arrays, and a crash ends the process.

mod engine;
mod network;

pub(crate) use self::engine::{NetworkArray, file_error};
pub use self::network::NetworkFile;
pub(crate) use self::network::{Contract, Role};

use self::engine::{NetworkInputs, guarded, one_line};
use self::network::{I64, Port, in_words};
use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tract_onnx::pb;
use tract_onnx::prelude::*;
use tract_onnx::tract_hir::infer::Factoid;

/// Bytes of a network's file at most; a Protocol Buffers message cannot be larger.
const MAX_FILE_BYTES: u64 = 2 << 30;

/// A network ready to run.
pub(crate) struct NetworkSession {
    /// Its file.
    pub file: NetworkFile,
    /// Inputs, in the file's order.
    pub inputs: Vec<Port>,
    /// Which network it is.
    pub contract: Contract,
    /// The outputs that are asked for.
    outputs: Vec<String>,
    model: TractModel,
}

impl NetworkSession {
    /// Reads, recognizes and loads a file, which must be of a form of this role. `array_bytes` is
    /// the size of the largest single array that may be planned.
    pub(crate) fn open(role: Role, path: &Path, array_bytes: u64) -> Result<NetworkSession> {
        let bytes = io::read_bytes(path, &Limits { file_bytes: MAX_FILE_BYTES, ..Limits::default() })?;
        if names_another_file(&bytes) {
            return Err(file_error(
                path,
                "is refused: its weights lie in another file",
                "take a file that holds its weights itself; `onnx.save(onnx.load(FILE), NEW)` in Python makes one",
            ));
        }
        let read = || tract_onnx::onnx().proto_model_for_read(&mut &bytes[..]).map_err(|e| format!("{e:#}"));
        let not_onnx = |why: String| {
            let hint = "copy the file again; a broken download, or the web page around it, looks like this";
            file_error(path, &format!("is not a valid ONNX file: {}", one_line(&why)), hint)
        };
        let proto = guarded(read).map_err(not_onnx)?;
        let graph = proto.graph.as_ref().ok_or_else(|| not_onnx("it holds no graph".into()))?;
        // older files list their weights among the inputs
        let weights: std::collections::HashSet<_> = graph.initializer.iter().map(|t| &t.name).collect();
        let inputs = graph.input.iter().filter(|p| !weights.contains(&p.name));
        let inputs: Vec<Port> = inputs.map(Port::new).collect();
        let outputs: Vec<Port> = graph.output.iter().map(Port::new).collect();
        let contract = network::recognize(&inputs, &outputs).map_err(|why| {
            file_error(
                path,
                &format!("is no network that is known: {}", one_line(&why)),
                "give a SAM encoder and its decoder, a ViTMatte network, or one that takes a picture and gives its \
                 alpha, exported with transformers or by its publisher's own script",
            )
        })?;
        let Role(key, named) = role;
        if contract.role() != role {
            let hint = format!("give the file where a {contract} is asked for");
            return Err(file_error(path, &format!("is a {contract}, but was given as {named}"), hint));
        }
        let outputs = contract.outputs(&outputs);
        let model = guarded(|| TractModel::load(&proto, &outputs, array_bytes));
        let model = model.map_err(|e| engine_error(path, "load", &e))?;
        let file = NetworkFile::new(key, path, &bytes, contract, NAME);
        Ok(NetworkSession { file, inputs, contract, outputs, model })
    }

    /// Feeds the inputs by name; gives the outputs of its form, every number of them finite.
    pub(crate) fn run(&self, inputs: &[(&str, NetworkArray)]) -> Result<Vec<NetworkArray>> {
        let run = || {
            let mut fed = Vec::new();
            for port in &self.inputs {
                let found = inputs.iter().find(|(name, _)| *name == port.name);
                fed.push((port, &found.ok_or(format!("`{}` is not fed", port.name))?.1));
            }
            self.model.run(&fed)
        };
        let given = guarded(run).map_err(|e| engine_error(&self.file.path, "run", &e))?;
        if given.len() != self.outputs.len() {
            return Err(self.unusable(&self.outputs[0], "the engine left outputs out"));
        }
        for (name, output) in self.outputs.iter().zip(&given) {
            if output.shape.iter().product::<usize>() != output.values.len() {
                return Err(self.unusable(name, "its numbers do not fill its extents"));
            }
            if let Some(i) = output.values.iter().position(|v| !v.is_finite()) {
                let (v, of) = (output.values[i], output.values.len());
                return Err(self.unusable(name, format!("number {} of {of} is {v}", i + 1)));
            }
        }
        Ok(given)
    }

    /// Checks the extents of an output, `None` where any will do.
    pub(crate) fn expect(&self, output: usize, found: &NetworkArray, dims: &[Option<usize>]) -> Result<()> {
        let fits =
            |(found, expected): (&usize, &Option<usize>)| *found > 0 && expected.is_none_or(|e| e == *found);
        if found.shape.len() == dims.len() && found.shape.iter().zip(dims).all(fits) {
            return Ok(());
        }
        let problem = format!("it is {:?}, expected {}", found.shape, in_words(dims.iter().copied()));
        Err(self.unusable(&self.outputs[output], problem))
    }

    /// Returns the error for an output that does not match its declared form.
    pub(crate) fn unusable(&self, output: &str, problem: impl std::fmt::Display) -> Error {
        let hint = "take the network's file from its publisher again; its weights or its graph are damaged";
        file_error(&self.file.path, &format!("gave an unusable `{output}`: {problem}"), hint)
    }

    /// Checks that the first output is one picture, and returns its width and height.
    pub(crate) fn one_picture(&self, found: &NetworkArray) -> Result<(usize, usize)> {
        match found.shape[..] {
            [.., height, width] if width > 0 && width * height == found.values.len() => Ok((width, height)),
            _ => {
                let problem = format!("it is {:?}, expected [1, 1, height, width]", found.shape);
                Err(self.unusable(&self.outputs[0], problem))
            }
        }
    }

    /// Extent of one axis of an input, where the file fixes it.
    pub(crate) fn input_extent(&self, name: &str, axis: usize) -> Option<usize> {
        self.inputs.iter().find(|p| p.name == name)?.extent(axis)
    }
}

/// Returns whether an engine could open another file for this one's sake. Weights elsewhere are
/// named by an entry with the key `location`, and pieces compiled for a device by the operator
/// `EPContext`. Whatever the message around them, in functions or training graphs too, the key's
/// eight letters stand behind their length: 8, or 8 spelled longer.
fn names_another_file(bytes: &[u8]) -> bool {
    let at = |i: usize| bytes[..i].last().is_some_and(|&length| length == 8 || length == 0);
    bytes.windows(8).enumerate().any(|(i, w)| w == b"location" && at(i))
        || bytes.windows(9).any(|w| w == b"EPContext")
}

fn engine_error(path: &Path, doing: &str, problem: &str) -> Error {
    let hint = "use the float32 file that the network's publisher offers; float16 and int8 files, and some that recent \
                exporters write, are not supported";
    Error::cannot(format!("{} cannot {doing} `{}`: {}", NAME, path.display(), one_line(problem)), hint)
}

/// Name and version, as recorded with a run.
const NAME: &str = "tract 0.23.9";

/// Plans kept of one file. Each holds its own packed weights.
const KEPT_PLANS: usize = 4;

type Runnable = Arc<TypedRunnableModel>;

/// A parsed file and its plans by the shapes of its inputs.
struct TractModel {
    parsed: InferenceModel,
    array_bytes: u64,
    plans: Mutex<HashMap<Vec<Vec<usize>>, Runnable>>,
}

impl TractModel {
    /// Takes the graph of a file; shapes that it states for inner arrays are not trusted, exporters
    /// write wrong ones. `outputs`: those that will be asked for. `array_bytes`: bytes of the
    /// largest array that may be planned.
    fn load(proto: &pb::ModelProto, outputs: &[String], array_bytes: u64) -> Result<TractModel, String> {
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

    /// Returns the plan for these shapes, made on the first call.
    fn plan(&self, fed: &NetworkInputs) -> TractResult<Runnable> {
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

    /// Returns what is known of a node's outputs once what is known of its inputs is taken in.
    /// Inferring also computes what is constant, so the extents alone are asked for first.
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
    fn run(&self, fed: &NetworkInputs) -> Result<Vec<NetworkArray>, String> {
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

/// Returns where and why, in a sentence: the first of what the engine says, and the beginning of
/// the innermost; the pages of shape algebra between them go to the log.
fn sentence(error: &TractError) -> String {
    tracing::debug!(target: "tract", "{error:#}");
    let (first, root) = (error.to_string(), error.root_cause().to_string());
    let why = root.split([':', '[', '\n']).next().unwrap_or_default().trim();
    if first.contains(why) { first } else { format!("{first}: {why}") }
}

#[cfg(test)]
pub(crate) mod tests;
