//! `tiface completions`: what a shell needs to complete commands and options.

use super::stdout::print;
use crate::Result;
use clap::Command;
use clap_complete::{Shell, generate};

pub(super) fn run(shell: Shell, command: &mut Command) -> Result<()> {
    let mut script = Vec::new();
    generate(shell, command, "tiface", &mut script);
    print(&String::from_utf8_lossy(&script))?;
    Ok(())
}
