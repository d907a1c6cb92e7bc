//! `tiface completions`: what a shell needs to complete commands and options.

use super::ending::{Ending, say};
use crate::run::Exit;
use clap::Command;
use clap_complete::{Shell, generate};

pub(super) fn go(shell: Shell, command: &mut Command) -> Result<Exit, Ending> {
    let mut script = Vec::new();
    generate(shell, command, "tiface", &mut script);
    say(&String::from_utf8_lossy(&script))?;
    Ok(Exit::Done)
}
