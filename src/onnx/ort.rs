//! The engine that the user brings: an ONNX Runtime library, loaded from the path named and nowhere else.

use super::network::{Fed, I64, NetworkArray, NetworkFile, file_error, guarded, one_line};
use crate::Result;
use crate::io::{self, Limits};
use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::{OutputSelector, RunOptions, SessionInputValue};
use ort::value::Tensor;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// The engine's name, as recorded with a run; its version is that of the library, recorded too.
pub(super) const NAME: &str = "ONNX Runtime";

/// A process can hold one ONNX Runtime, for good.
static LOADED: Mutex<Option<Runtime>> = Mutex::new(None);

/// A loaded ONNX Runtime.
#[derive(Clone)]
pub struct Runtime {
    /// The library as the user named it.
    pub file: NetworkFile,
    /// The library without links.
    real: PathBuf,
    environment: Environment,
}

impl Runtime {
    /// Loads the library at `path`. A second call with the same library gives the same runtime.
    ///
    /// # Errors
    /// When there is no such file, when it is no ONNX Runtime of 1.17 or later, or when this process
    /// already holds another one.
    pub fn load(path: &Path) -> Result<Runtime> {
        let real = io::real_path(path)?;
        let wrong = |problem: String, hint: &str| {
            file_error(path, &format!("cannot be used as ONNX Runtime: {}", one_line(&problem)), hint)
        };
        let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(runtime) = loaded.as_ref() {
            if runtime.real == real {
                return Ok(runtime.clone());
            }
            let problem = format!("this process already runs `{}`", runtime.file.path.display());
            return Err(wrong(problem, "start the program anew for another library"));
        }
        // also keeps a text file from the system's loader, whose words few understand
        let library = io::read_bytes(path, &Limits::default())?;
        let load = || -> Result<Environment, String> {
            let to_log: ort::logging::LoggerFunction = Arc::new(|_, _, _, _, message: &str| {
                tracing::debug!(target: "onnxruntime", "{message}");
            });
            let builder = ort::init_from(&real).map_err(|e| e.to_string())?.with_name("tiface");
            let environment = builder.with_telemetry(false).with_logger(to_log).build();
            let environment = environment.map_err(|e| e.to_string())?;
            environment.set_log_level(LogLevel::Error);
            Ok(environment)
        };
        let environment = guarded(load).map_err(|problem| {
            wrong(problem, "name a libonnxruntime of 1.17 or later for this machine (`pip install onnxruntime` brings one)")
        })?;
        // what the library says of itself
        let version = guarded(|| Ok(ort::info().to_string())).unwrap_or_default();
        let file = NetworkFile::new("onnxruntime", path, &library, "library", version);
        let runtime = Runtime { file, real, environment };
        *loaded = Some(runtime.clone());
        Ok(runtime)
    }
}

/// A network in ONNX Runtime.
pub(super) struct OrtModel {
    // its bindings allow one run at a time; the run itself spreads over the threads
    session: Mutex<ort::session::Session>,
    outputs: Vec<String>,
}

impl OrtModel {
    /// Loads a network from memory. `outputs`: those that will be asked for.
    pub(super) fn load(
        runtime: &Runtime,
        bytes: &[u8],
        outputs: &[String],
        threads: usize,
    ) -> Result<OrtModel, String> {
        let session = || -> Result<ort::session::Session, ort::Error> {
            let mut builder = ort::session::Session::builder(&runtime.environment)?
                .with_intra_threads(threads)?
                .with_deterministic_compute(true)?
                .with_log_level(LogLevel::Error)?;
            builder.commit_from_memory(bytes)
        };
        let session = Mutex::new(session().map_err(|e| e.to_string())?);
        Ok(OrtModel { session, outputs: outputs.to_vec() })
    }

    /// One run.
    pub(super) fn run(&self, fed: &Fed) -> Result<Vec<NetworkArray>, String> {
        let mut session = self.session.lock().unwrap_or_else(PoisonError::into_inner);
        let mut run = || -> Result<Vec<NetworkArray>, ort::Error> {
            let mut inputs: Vec<(&str, SessionInputValue<'_>)> = Vec::new();
            for (port, array) in fed {
                let value = match port.kind {
                    I64 => Tensor::from_array((array.shape.clone(), array.integers()))?.into(),
                    _ => Tensor::from_array((array.shape.clone(), array.values.clone()))?.into(),
                };
                inputs.push((&port.name, value));
            }
            let wanted = self.outputs.iter().fold(OutputSelector::no_default(), |o, name| o.with(name));
            let options = RunOptions::new()?.with_outputs(wanted);
            let given = session.run_with_options(inputs, &options)?;
            let mut found = Vec::new();
            for value in self.outputs.iter().filter_map(|name| given.get(name.as_str())) {
                let (shape, values) = value.try_extract_tensor::<f32>()?;
                let shape = shape.iter().map(|&d| usize::try_from(d).unwrap_or(0)).collect();
                found.push(NetworkArray { shape, values: values.to_vec() });
            }
            Ok(found)
        };
        run().map_err(|e| e.to_string())
    }
}
