//! ONNX networks in a session: a file is read once, recognized, and run by tract.
//!
//! The same bytes are hashed and given to the engine, and a file that refers to another one is refused, so the record
//! describes exactly what ran. Nothing is downloaded.
//!
//! The engine is a large program that reads untrusted files. Every call into it runs under `catch_unwind`: a panic inside
//! becomes an error that names the file. (The process's panic hook still prints its line.) Arrays beyond a limit are
//! refused before they are allocated.
//!
//! ONNX Runtime, loaded from a library of the user's, was tried as a second engine: ViTMatte-S on a photograph of 384 × 512
//! pixels takes 2.4 CPU s with tract and 1.3 with ONNX Runtime. It also runs float16 and int8 files and more of what recent
//! exporters write; but it needs a library to be installed, cannot be kept from large arrays, and a crash ends the process.

mod network;
mod tract;

pub use self::network::NetworkFile;
pub(crate) use self::network::{Contract, NetworkArray, Role, file_error};

use self::network::{Port, guarded, in_words, one_line};
use crate::io::{self, Limits};
use crate::{Error, Result};
use std::path::Path;
use tract_onnx::prelude::Framework;

/// Bytes of a network's file at most; a Protocol Buffers message cannot be larger.
const MOST_FILE_BYTES: u64 = 2 << 30;

/// A network ready to run.
pub(crate) struct NetworkSession {
    /// Its file.
    pub file: NetworkFile,
    /// What it takes, in the file's order.
    pub inputs: Vec<Port>,
    /// Which network it is.
    pub contract: Contract,
    /// The outputs that are asked for.
    outputs: Vec<String>,
    model: tract::TractModel,
}

impl NetworkSession {
    /// Reads, recognizes and loads a file, which must be of a form of this role. `array_bytes` is the size of the largest
    /// single array that may be planned.
    pub(crate) fn open(role: Role, path: &Path, array_bytes: u64) -> Result<NetworkSession> {
        let bytes = io::read_bytes(path, &Limits { file_bytes: MOST_FILE_BYTES, ..Limits::default() })?;
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
            file_error(path, &format!("is not a sound ONNX file: {}", one_line(&why)), hint)
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
        let model = guarded(|| tract::TractModel::load(&proto, &outputs, array_bytes));
        let model = model.map_err(|e| engine_error(path, "load", &e))?;
        let file = NetworkFile::new(key, path, &bytes, contract, tract::NAME);
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

    /// The output is not as its form promises.
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

/// Could an engine open another file for this one's sake? Weights elsewhere are named by an entry with the key
/// `location`, and pieces compiled for a device by the operator `EPContext`. Whatever the message around them, in
/// functions or training graphs too, the key's eight letters stand behind their length: 8, or 8 spelled longer.
fn names_another_file(bytes: &[u8]) -> bool {
    let at = |i: usize| bytes[..i].last().is_some_and(|&length| length == 8 || length == 0);
    bytes.windows(8).enumerate().any(|(i, w)| w == b"location" && at(i))
        || bytes.windows(9).any(|w| w == b"EPContext")
}

fn engine_error(path: &Path, doing: &str, problem: &str) -> Error {
    let hint = "use the float32 file that the network's publisher offers; float16 and int8 files, and some that recent \
                exporters write, are not supported";
    Error::cannot(format!("{} cannot {doing} `{}`: {}", tract::NAME, path.display(), one_line(problem)), hint)
}

#[cfg(test)]
pub(crate) mod tests;
