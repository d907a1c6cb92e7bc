//! The program as a user starts it, away from anybody's own configuration.

use std::path::Path;
use std::process::{Command, Output};

/// Runs `tiface` with these words in a folder, to its end.
pub fn tiface(folder: &Path, words: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tiface"))
        .args(words)
        .current_dir(folder)
        .env("XDG_CONFIG_HOME", folder)
        .env_remove("RUST_LOG")
        .env("NO_COLOR", "1")
        .output()
        .unwrap()
}
