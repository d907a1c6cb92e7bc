//! The program as a user starts it, away from anybody's own configuration, and what it says.

use std::path::Path;
use std::process::{Command, Output};

/// `tiface` with these words in a folder, to be run.
pub fn command(folder: &Path, words: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tiface"));
    command.args(words).current_dir(folder).env("XDG_CONFIG_HOME", folder);
    command.env_remove("RUST_LOG").env("NO_COLOR", "1");
    command
}

/// Runs `tiface` with these words in a folder, to its end.
pub fn tiface(folder: &Path, words: &[&str]) -> Output {
    command(folder, words).output().unwrap()
}

/// Returns the exit code of a program that no signal ended.
pub fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

/// Returns what the program wrote to stderr.
pub fn err(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Returns what the program wrote to stdout.
pub fn out(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Returns all that the program said: stdout, then stderr.
pub fn said(output: &Output) -> String {
    out(output) + &err(output)
}

/// Returns all that a program said that succeeded.
pub fn worked(output: &Output) -> String {
    assert!(output.status.success(), "{:?}: {}", output.status, said(output));
    said(output)
}
