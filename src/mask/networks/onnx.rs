//! ONNX networks in a session: a file is read once, looked through, recognised, and run by one of two engines.
//!
//! | engine | when | what it runs |
//! | --- | --- | --- |
//! | tract (built in) | no library is named | float32 files of the public generation |
//! | ONNX Runtime | the user names its library | those too, and recent exporters, float16, int8 |
//!
//! The bytes are read once: the same ones are hashed, looked through ([`scan`]) and given to the engine,
//! so no other file is ever opened and the record tells what has really run. Nothing is downloaded.
//!
//! Engines are large programs fed with a stranger's file. Every call into one runs under `catch_unwind`: a
//! panic inside becomes an error that names the file. (The process's panic hook still shows its line, and
//! an engine that runs out of memory ends the process; what can be foreseen is refused before.)

mod contract;
mod error;
mod ort;
mod scan;
mod tract;
mod wire;

pub use self::contract::Contract;
pub use self::error::MaskNetworkError;
pub use self::ort::Runtime;
pub use self::scan::Interface;

use self::scan::Fault;
use crate::io::{self, Limits};
use sha2::{Digest, Sha256};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// The numbers of an array.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Values {
    /// 32-bit floats.
    F32(Vec<f32>),
    /// 64-bit integers.
    I64(Vec<i64>),
}

/// An array to feed: row-major.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tensor {
    /// Extents.
    pub shape: Vec<usize>,
    /// As many values as the extents' product.
    pub values: Values,
}

impl Tensor {
    /// An array of floats.
    pub(super) fn f32(shape: &[usize], values: Vec<f32>) -> Tensor {
        debug_assert_eq!(shape.iter().product::<usize>(), values.len());
        Tensor { shape: shape.to_vec(), values: Values::F32(values) }
    }

    /// An array of integers.
    pub(super) fn i64(shape: &[usize], values: Vec<i64>) -> Tensor {
        debug_assert_eq!(shape.iter().product::<usize>(), values.len());
        Tensor { shape: shape.to_vec(), values: Values::I64(values) }
    }
}

/// An array a network gave: finite floats, row-major.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Output {
    /// Extents.
    pub shape: Vec<usize>,
    /// As many values as the extents' product.
    pub values: Vec<f32>,
}

/// What bounds a session.
#[derive(Clone, Debug)]
pub(super) struct SessionLimits {
    /// Bytes of a network's file.
    pub file_bytes: u64,
    /// Bytes of the largest single array the built-in engine may plan.
    pub array_bytes: u64,
    /// Threads of ONNX Runtime inside one run; 0: as many as it likes.
    pub threads: usize,
}

enum Engine {
    Tract(Box<tract::Model>),
    Ort(ort::Model),
}

/// A network ready to run.
pub(super) struct Session {
    /// Its file.
    pub path: PathBuf,
    /// Bytes of the file.
    pub bytes: u64,
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: String,
    /// What it takes and gives.
    pub interface: Interface,
    /// Which network it is.
    pub contract: Contract,
    engine: Engine,
}

impl Session {
    /// Reads, looks through, recognises and loads a file; with `runtime` ONNX Runtime runs it, else tract.
    pub(super) fn open(
        path: &Path,
        runtime: Option<&Runtime>,
        limits: &SessionLimits,
    ) -> Result<Session, MaskNetworkError> {
        let reading = Limits { file_bytes: limits.file_bytes, ..Limits::default() };
        let bytes = io::read_bytes(path, &reading)?;
        let interface = scan::scan(&bytes).map_err(|fault| match fault {
            Fault::Broken(broken) => {
                MaskNetworkError::NotOnnx { path: path.into(), offset: broken.at, problem: broken.problem }
            }
            Fault::Refused(problem, hint) => {
                MaskNetworkError::Refused { path: path.into(), problem, hint: hint.into() }
            }
        })?;
        let contract = contract::recognise(&interface).map_err(|why| MaskNetworkError::NotRecognised {
            path: path.into(),
            found: format!("{why} ({})", interface.in_words()),
            hint:
                "give a SAM encoder and its decoder, or a ViTMatte network, exported with transformers or by \
                   SAM's own script"
                    .into(),
        })?;
        let engine = match runtime {
            None => {
                let outputs = interface.outputs.iter().map(|p| p.name.clone()).collect();
                guarded(|| tract::Model::load(&bytes, outputs, limits.array_bytes))
                    .map(|model| Engine::Tract(Box::new(model)))
            }
            Some(runtime) => guarded(|| ort::Model::load(runtime, &bytes, limits.threads)).map(Engine::Ort),
        };
        let engine = match engine {
            Ok(engine) => engine,
            Err(problem) => return Err(engine_error(path, &interface, runtime.is_some(), "load", problem)),
        };
        let sha256 = hexadecimal(&bytes);
        Ok(Session { path: path.into(), bytes: bytes.len() as u64, sha256, interface, contract, engine })
    }

    /// Name and version of the engine.
    pub(super) fn engine(&self) -> String {
        match &self.engine {
            Engine::Tract(_) => tract::NAME.into(),
            Engine::Ort(_) => ort::NAME.into(),
        }
    }

    /// Does one run at a time use all threads? tract runs several side by side, each on one thread.
    pub(super) fn runs_alone(&self) -> bool {
        matches!(self.engine, Engine::Ort(_))
    }

    /// Makes ready for inputs of these shapes, so that a file that cannot be run is refused early.
    pub(super) fn prepare(
        &self,
        inputs: &[(&str, Tensor)],
        outputs: &[&str],
    ) -> Result<(), MaskNetworkError> {
        match &self.engine {
            Engine::Tract(model) => guarded(|| model.plan(inputs, outputs).map(|_| ()))
                .map_err(|problem| engine_error(&self.path, &self.interface, false, "load", problem)),
            Engine::Ort(_) => Ok(()),
        }
    }

    /// Feeds the inputs by name; gives the outputs asked for, every number of them finite.
    pub(super) fn run(
        &self,
        inputs: &[(&str, Tensor)],
        outputs: &[&str],
    ) -> Result<Vec<Output>, MaskNetworkError> {
        self.prepare(inputs, outputs)?;
        let given = match &self.engine {
            Engine::Tract(model) => guarded(|| model.run(inputs, outputs)),
            Engine::Ort(model) => guarded(|| model.run(inputs, outputs)),
        };
        let given = given.map_err(|problem| {
            engine_error(&self.path, &self.interface, self.runs_alone(), "run", problem)
        })?;
        for (name, output) in outputs.iter().zip(&given) {
            if output.shape.iter().product::<usize>() != output.values.len() {
                return Err(self.unusable(name, "its numbers do not fill its extents"));
            }
            if let Some(i) = output.values.iter().position(|v| !v.is_finite()) {
                let of = output.values.len();
                let problem = format!("number {} of {of} is {}", i + 1, output.values[i]);
                return Err(self.unusable(name, problem));
            }
        }
        Ok(given)
    }

    /// The output is not as its form promises.
    pub(super) fn unusable(&self, output: &str, problem: impl Into<String>) -> MaskNetworkError {
        MaskNetworkError::Output { path: self.path.clone(), output: output.into(), problem: problem.into() }
    }

    /// Extent of one axis of an input, where the file fixes it.
    pub(super) fn input_extent(&self, name: &str, axis: usize) -> Option<usize> {
        let port = self.interface.inputs.iter().find(|p| p.name == name)?;
        port.extent(axis).and_then(|d| usize::try_from(d).ok())
    }
}

/// SHA-256 in hexadecimal.
fn hexadecimal(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

/// Runs a piece of an engine; a panic inside becomes its message.
///
/// `AssertUnwindSafe`: what an engine shares between runs is a list of finished plans behind a lock, changed
/// by one push, so a run that panics leaves nothing half made that a later run would see.
fn guarded<T>(piece: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    match catch_unwind(AssertUnwindSafe(piece)) {
        Ok(result) => result,
        Err(panic) => {
            let said = panic
                .downcast_ref::<String>()
                .map(String::as_str)
                .or_else(|| panic.downcast_ref::<&str>().copied())
                .unwrap_or("it gave no reason");
            Err(format!("it broke down: {said}"))
        }
    }
}

fn engine_error(
    path: &Path,
    interface: &Interface,
    runtime: bool,
    doing: &'static str,
    problem: String,
) -> MaskNetworkError {
    let narrow = if interface.is_float32() { "" } else { ", or use the float32 file of this network" };
    let hint = if runtime {
        format!("take a newer ONNX Runtime, or the file from its publisher again{narrow}")
    } else {
        format!(
            "ONNX Runtime runs files that the built-in engine cannot: name its library, 1.17 or later \
             (`pip install onnxruntime` brings one){narrow}"
        )
    };
    let engine = if runtime { ort::NAME } else { tract::NAME };
    MaskNetworkError::Engine {
        path: path.into(),
        engine: engine.into(),
        doing,
        problem: in_one_line(&problem),
        hint,
    }
}

/// What an engine says, without line breaks and not endless.
fn in_one_line(said: &str) -> String {
    let words: Vec<&str> = said.split_whitespace().collect();
    let line = words.join(" ");
    match line.char_indices().nth(300) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line,
    }
}

#[cfg(test)]
pub(super) mod made;
#[cfg(test)]
pub(super) mod tests;
