//! What can be wrong with a network, its files, or what is asked of it.

use crate::io::ReadError;
use std::path::PathBuf;

/// Why a network gives no mask.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MaskNetworkError {
    /// A file could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The bytes are not those of an ONNX file.
    #[error("`{}` is not a sound ONNX file: {problem} (at byte {offset})", path.display())]
    NotOnnx {
        /// The file.
        path: PathBuf,
        /// Where it stops making sense.
        offset: usize,
        /// What is wrong there.
        problem: String,
    },
    /// An ONNX file that is not run, because of what it holds.
    #[error("`{}` is refused: {problem}", path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// What it holds.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// An ONNX file of no known form.
    #[error("`{}` is no SAM or ViTMatte network: {found}", path.display())]
    NotRecognised {
        /// The file.
        path: PathBuf,
        /// Its inputs and outputs.
        found: String,
        /// What keeps it from being one, if it comes near.
        hint: String,
    },
    /// A known network in the place of another.
    #[error("`{}` is a {is}, but was given as {given_as}", path.display())]
    WrongRole {
        /// The file.
        path: PathBuf,
        /// What it is.
        is: String,
        /// What it was given as.
        given_as: String,
    },
    /// An encoder and a decoder that do not belong together.
    #[error("`{}` and `{}` do not fit together: {problem}", encoder.display(), decoder.display())]
    Mismatch {
        /// The encoder's file.
        encoder: PathBuf,
        /// The decoder's file.
        decoder: PathBuf,
        /// What differs.
        problem: String,
    },
    /// A network's processor file says something unusable.
    #[error("`{}`: {problem}", path.display())]
    Processor {
        /// The file, a `preprocessor_config.json`.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The engine cannot load or run the file.
    #[error("{engine} cannot {doing} `{}`: {problem}", path.display())]
    Engine {
        /// The network's file.
        path: PathBuf,
        /// Which engine.
        engine: String,
        /// "load" or "run".
        doing: &'static str,
        /// What the engine said, in one line.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// The network ran and gave something other than its form promises.
    #[error("`{}` gave an unusable `{output}`: {problem}", path.display())]
    Output {
        /// The network's file.
        path: PathBuf,
        /// The output's name.
        output: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The ONNX Runtime library cannot be used.
    #[error("`{}` cannot be used as ONNX Runtime: {problem}", path.display())]
    Library {
        /// The library.
        path: PathBuf,
        /// What is wrong.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// The clicks cannot be used.
    #[error("the clicks cannot be used: {problem}")]
    Clicks {
        /// What is wrong with which of them.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// The photograph, or what comes with it, cannot be used.
    #[error("the photograph cannot be used: {problem}")]
    Photo {
        /// What is wrong.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// A file that is needed was not given.
    #[error("no file was given for {what}")]
    Missing {
        /// Which network.
        what: &'static str,
        /// The way out.
        hint: String,
    },
}

impl MaskNetworkError {
    /// The way out.
    pub fn hint(&self) -> String {
        match self {
            MaskNetworkError::Read(e) => e.hint(),
            MaskNetworkError::NotOnnx { .. } => {
                "copy the file again; a broken download, or the web page around it, looks like this".into()
            }
            MaskNetworkError::Refused { hint, .. }
            | MaskNetworkError::NotRecognised { hint, .. }
            | MaskNetworkError::Engine { hint, .. }
            | MaskNetworkError::Library { hint, .. }
            | MaskNetworkError::Clicks { hint, .. }
            | MaskNetworkError::Photo { hint, .. }
            | MaskNetworkError::Missing { hint, .. } => hint.clone(),
            MaskNetworkError::WrongRole { is, .. } => format!("give the file where a {is} is asked for"),
            MaskNetworkError::Mismatch { .. } => "take encoder and decoder from the same export".into(),
            MaskNetworkError::Processor { .. } => {
                "take the processor file of the same export, or remove it: then the network's published numbers hold"
                    .into()
            }
            MaskNetworkError::Output { .. } => {
                "take the network's file from its publisher again; its weights or its graph are damaged".into()
            }
        }
    }
}
