//! What can be wrong with a network, its files, or what is asked of it.

use crate::io::ReadError;
use std::path::{Path, PathBuf};

/// Why a network gives no mask.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MaskNetworkError {
    /// A file could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A file is not what it was named for.
    #[error("`{}` {problem}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// The engine cannot load or run a network.
    #[error("{engine} cannot {doing} `{}`: {problem}", path.display())]
    Engine {
        /// The network's file.
        path: PathBuf,
        /// Which engine.
        engine: &'static str,
        /// "load" or "run".
        doing: &'static str,
        /// What the engine said, in one line.
        problem: String,
        /// The way out.
        hint: &'static str,
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
    /// Clicks, photograph or files do not suffice.
    #[error("{problem}")]
    Asked {
        /// What is wrong with which of them.
        problem: String,
        /// The way out.
        hint: String,
    },
}

crate::error::error_from!(MaskNetworkError, Cannot);

impl MaskNetworkError {
    pub(in crate::mask::networks) fn file(
        path: &Path,
        problem: impl Into<String>,
        hint: &str,
    ) -> MaskNetworkError {
        MaskNetworkError::File { path: path.into(), problem: problem.into(), hint: hint.into() }
    }

    pub(in crate::mask::networks) fn asked(problem: impl Into<String>, hint: &str) -> MaskNetworkError {
        MaskNetworkError::Asked { problem: problem.into(), hint: hint.into() }
    }

    /// The way out.
    pub fn hint(&self) -> String {
        match self {
            MaskNetworkError::Read(e) => e.hint(),
            MaskNetworkError::File { hint, .. } | MaskNetworkError::Asked { hint, .. } => hint.clone(),
            MaskNetworkError::Engine { hint, .. } => (*hint).into(),
            MaskNetworkError::Output { .. } => {
                "take the network's file from its publisher again; its weights or its graph are damaged"
                    .into()
            }
        }
    }
}

/// What an engine or a file says: one line, no control characters, not endless.
pub(super) fn shown(said: &str) -> String {
    let line = said.split_whitespace().collect::<Vec<_>>().join(" ");
    let line: String = line.chars().filter(|c| !c.is_control()).collect();
    match line.char_indices().nth(300) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line,
    }
}
