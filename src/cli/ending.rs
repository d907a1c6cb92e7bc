//! How a command ends when it does not end well.

use super::plain::plain;
use crate::config::ConfigError;
use crate::io::{ReadError, WriteError};
use crate::pipeline::PipelineError;
use crate::run::{Exit, Failure, RunError};
use std::io::{ErrorKind, Write};

/// An exit code, what happened, and the way out.
#[derive(Debug)]
pub(super) struct Ending {
    pub exit: Exit,
    pub message: String,
    /// May be empty.
    pub hint: String,
}

impl Ending {
    /// Exit code 1.
    pub fn cannot(message: impl Into<String>, hint: impl Into<String>) -> Ending {
        Ending { exit: Exit::Cannot, message: message.into(), hint: hint.into() }
    }

    /// Exit code 2.
    pub fn usage(message: impl Into<String>, hint: impl Into<String>) -> Ending {
        Ending { exit: Exit::Usage, message: message.into(), hint: hint.into() }
    }

    /// Exit code 3.
    pub fn below(message: impl Into<String>, hint: impl Into<String>) -> Ending {
        Ending { exit: Exit::BelowBar, message: message.into(), hint: hint.into() }
    }
}

impl From<ConfigError> for Ending {
    fn from(e: ConfigError) -> Ending {
        Ending::usage(e.to_string(), e.hint())
    }
}

impl From<PipelineError> for Ending {
    fn from(e: PipelineError) -> Ending {
        Ending { exit: e.exit(), message: e.to_string(), hint: e.hint() }
    }
}

impl From<RunError> for Ending {
    fn from(e: RunError) -> Ending {
        Ending { exit: e.exit(), message: e.to_string(), hint: e.hint() }
    }
}

impl From<Failure> for Ending {
    fn from(e: Failure) -> Ending {
        Ending { exit: e.exit, message: e.error.to_string(), hint: e.hint }
    }
}

impl From<ReadError> for Ending {
    fn from(e: ReadError) -> Ending {
        Ending::cannot(e.to_string(), e.hint())
    }
}

impl From<WriteError> for Ending {
    fn from(e: WriteError) -> Ending {
        Ending::cannot(e.to_string(), e.hint())
    }
}

/// Prints data to stdout, as [`plain`] text. A reader that has gone away (`| head`) is not an error.
pub(super) fn say(text: &str) -> Result<(), Ending> {
    let mut out = std::io::stdout().lock();
    let written = out.write_all(plain(text).as_bytes()).and_then(|()| out.flush());
    match written {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => {
            Err(Ending::cannot(format!("stdout cannot be written: {e}"), "check where it leads"))
        }
        _ => Ok(()),
    }
}
