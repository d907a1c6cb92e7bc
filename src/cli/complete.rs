//! `tiface completions`: what shells complete, with keys of the configuration and their values.

use crate::config;
use clap::Command;
use clap_complete::env::Shells;
use clap_complete::{CompleteEnv, CompletionCandidate, Shell};
use std::ffi::OsStr;

/// Variable by which a shell asks for completions.
const COMPLETE: &str = "TIFACE_COMPLETE";

/// Bash code that completes the values of `--set key=value`.
const WHOLE_WORDS: &str = "# `key=value` is one word\nCOMP_WORDBREAKS=${COMP_WORDBREAKS//=}\n";

/// Returns the script that makes a shell ask this program for completions.
pub(super) fn script(shell: Shell) -> String {
    let mut script = Vec::new();
    if let Some(shell) = Shells::builtins().completer(&shell.to_string()) {
        // memory takes every byte
        let _ = shell.write_registration(COMPLETE, "tiface", "tiface", "tiface", &mut script);
    }
    if shell == Shell::Bash {
        script.extend_from_slice(WHOLE_WORDS.as_bytes());
    }
    String::from_utf8_lossy(&script).into_owned()
}

/// Answers a shell that asks for completions, and ends the process; does nothing otherwise.
pub(super) fn answer(command: fn() -> Command) {
    CompleteEnv::with_factory(command).var(COMPLETE).complete();
}

/// Completes a key of the configuration.
pub(super) fn complete_key(typed: &OsStr) -> Vec<CompletionCandidate> {
    candidates(typed, "")
}

/// Completes `KEY=VALUE`: the key, then a word that it takes, or the next of a list.
pub(super) fn complete_setting(typed: &OsStr) -> Vec<CompletionCandidate> {
    let typed = typed.to_str().unwrap_or_default();
    let Some((key, _)) = typed.split_once('=') else { return candidates(OsStr::new(typed), "=") };
    let begun = &typed[..=typed.rfind(['=', ',']).unwrap_or(key.len())];
    let settings = config::known_words(key).into_iter().map(|word| format!("{begun}{word}"));
    settings.filter(|setting| setting.starts_with(typed)).map(CompletionCandidate::new).collect()
}

/// Returns the keys that begin with what was typed, each followed by `end`.
fn candidates(typed: &OsStr, end: &str) -> Vec<CompletionCandidate> {
    let typed = typed.to_str().unwrap_or_default();
    let found = config::keys().filter(|(name, _)| name.starts_with(typed));
    found.map(|(name, doc)| CompletionCandidate::new(name + end).help(Some(doc.into()))).collect()
}
