//! The command line: its words in `command`, a file per command, with its name; those that work on
//! captures share `capture`. The only module that prints.
//!
//! Data goes to stdout, everything else to stderr; the exit code distinguishes errors worth a retry
//! ([`tiface_base::ErrorKind`]).

mod bench;
mod cameras;
mod capture;
mod check;
mod clean;
mod command;
mod complete;
mod config;
mod demo;
mod doctor;
mod experiment;
mod export;
mod flags;
mod options;
mod out;
mod preview;
mod report;
mod requirement;
mod run;
mod screen;
mod signals;
mod status;
mod summary;
mod target;
mod verify;

use crate::config::key;
use crate::run::Stop;
use clap::parser::ValueSource;
use clap::{ArgMatches, CommandFactory, FromArgMatches};
use command::{Cli, Command, ignored};
use options::Common;
use out::Out;
use screen::Screen;
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use tiface_base::{Error, Result};

/// Ends the process after a failed allocation of `bytes`. Does not allocate; loses no more than a
/// kill would.
#[cold]
pub fn out_of_memory(bytes: usize) -> ! {
    let _ = writeln!(
        std::io::stderr(),
        "error: out of memory: {bytes} more bytes are not available\n\n\
         hint: free memory, raise `capture.downscale`, or lower `mesh.resolution` or the `rays` of a field; what is \
         complete is kept: repeat the command to continue"
    );
    signal_hook::low_level::exit(tiface_base::ErrorKind::NotNow.code().into())
}

/// Parses the command line, runs the command and returns the exit code. `collect` gives the
/// allocator's free memory back to the system.
pub fn main(collect: fn()) -> ExitCode {
    tiface_base::io::set_memory_collector(collect);
    complete::answer(Cli::command);
    let parsed =
        Cli::command().try_get_matches().and_then(|found| Ok((Cli::from_arg_matches(&found)?, found)));
    let (Cli { command, common }, found) = match parsed {
        Ok(parsed) => parsed,
        Err(e) => {
            // help and version end here too, with 0; a closed stdout is no error
            let _ = e.print();
            if let Some(hint) = hint_for(&e) {
                let _ = writeln!(std::io::stderr(), "\n{hint}");
            }
            return ExitCode::from(e.exit_code() as u8);
        }
    };
    let invocation = Invocation { common: &common, screen: Screen::new(&common), stop: Stop::new() };
    common.log();
    let makes_nothing = |command: &str| Out::none(common.out.as_deref(), command);
    let begun = refuse_ignored(&found).and_then(|()| signals::listen(&invocation));
    let ended = begun.and_then(|()| match &command {
        Command::Demo { size, views, border } => demo::run(&invocation, size.as_deref(), *views, *border),
        Command::Mask { input, flags, page: true } => {
            capture::page(&invocation, input.path.as_deref(), flags.typed(key!(mask.prompts)))
        }
        Command::Metrics { input, views, mesh, .. } if !(views.is_empty() && mesh.is_empty()) => {
            capture::judge(&invocation, input.path.as_deref(), views, mesh)
        }
        Command::Inspect { capture } => {
            makes_nothing("inspect").and_then(|()| capture::inspect(&common, capture))
        }
        Command::Cameras(options) => cameras::run(&invocation, options),
        Command::Convert { capture, to } => capture::convert(&invocation, capture, to),
        Command::Check { mesh, require, against, seen_by } => makes_nothing("check")
            .and_then(|()| check::run(&common, mesh, require, against.as_deref(), seen_by.as_deref())),
        Command::Export(options) => export::run(&invocation, options),
        Command::Preview(options) => preview::run(&invocation, options),
        Command::Bench(options) => bench::run(&invocation, options),
        Command::Experiment(options) => experiment::run(&invocation, options),
        Command::Status(options) => makes_nothing("status").and_then(|()| status::run(&invocation, options)),
        Command::Report { runs, table } => report::run(&invocation, runs, *table),
        Command::Verify { runs } => makes_nothing("verify").and_then(|()| verify::run(&invocation, runs)),
        Command::Clean { runs, yes } => {
            makes_nothing("clean").and_then(|()| clean::run(&invocation, runs, *yes))
        }
        Command::Config { input, explain } => makes_nothing("config")
            .and_then(|()| config::run(&common, input.path.as_deref(), explain.as_deref())),
        Command::Doctor => makes_nothing("doctor").and_then(|()| doctor::run(&common)),
        Command::Completions { shell } => {
            makes_nothing("completions").and_then(|()| screen::print(&complete::script(*shell)))
        }
        stages => run::run(&invocation, &stages.on_stages(&common)?),
    });
    ExitCode::from(match ended {
        Ok(()) => 0,
        Err(error) => {
            let error = suggest(error);
            invocation.screen.error(&error);
            error.kind().code()
        }
    })
}

/// Hint for a command with the paths of several heads.
const ONE_HEAD: &str = "hint: this command takes one path; repeat it for each, as in \
    `for head in captures/*; do tiface run \"$head\"; done`";

/// Hint for `--watch` of a command that works.
const WATCH: &str = "hint: beside the working command, `tiface status --watch` shows its progress in a terminal, and \
    `tiface preview RUN --watch` as a page";

/// Returns the hint for a command line that clap refuses: one with another path than the one that
/// its command takes, or with `--watch` of another command.
fn hint_for(error: &clap::Error) -> Option<&'static str> {
    use clap::error::{ContextKind, ContextValue, ErrorKind};
    let Some(ContextValue::String(word)) = error.get(ContextKind::InvalidArg) else { return None };
    match error.kind() {
        ErrorKind::UnknownArgument if word == "--watch" => Some(WATCH),
        ErrorKind::UnknownArgument if !word.starts_with('-') && tiface_base::io::exists(Path::new(word)) => {
            Some(ONE_HEAD)
        }
        _ => None,
    }
}

/// Refuses an option on the command line that the command would ignore.
fn refuse_ignored(found: &ArgMatches) -> Result<()> {
    let Some((command, given)) = found.subcommand() else { return Ok(()) };
    let typed = |id: &&&str| given.value_source(id) == Some(ValueSource::CommandLine);
    match ignored(command).iter().find(typed) {
        Some(id) => {
            let text = format!("`--{id}` has no effect on `{command}`");
            Err(Error::usage(text, format!("leave it out; `tiface {command} --help` lists what has one")))
        }
        None => Ok(()),
    }
}

/// Adds to an error about a path of the command line that does not exist the one that was probably
/// meant.
fn suggest(error: Error) -> Error {
    let text = error.to_string();
    let is_missing = |word: &String| {
        let is_option = word.starts_with('-');
        !is_option && text.starts_with(&format!("`{word}`")) && !tiface_base::io::exists(Path::new(word))
    };
    let mut words = std::env::args_os().skip(1).filter_map(|word| word.into_string().ok());
    let missing = words.find(is_missing);
    match missing.and_then(|word| tiface_base::io::similar(Path::new(&word))) {
        Some(found) if !error.hint().contains("did you mean") => {
            let hint = format!("did you mean `{}`? {}", found.display(), error.hint());
            error.with_hint(hint)
        }
        _ => error,
    }
}

/// A running command.
struct Invocation<'a> {
    /// The options that every command shares.
    pub common: &'a Common,
    /// Output for users.
    pub screen: Arc<Screen>,
    /// Set on a request to stop.
    pub stop: Stop,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_option_that_a_command_ignores_is_refused_and_known() {
        let globals: Vec<String> = Cli::command().get_arguments().map(|a| a.get_id().to_string()).collect();
        for command in Cli::command().get_subcommands() {
            for id in ignored(command.get_name()) {
                assert!(globals.iter().any(|g| g == id), "{id}");
            }
        }
        let refused = |words: &[&str]| {
            let found = Cli::command().try_get_matches_from([&["tiface"], words].concat()).unwrap();
            refuse_ignored(&found).err().map(|e| (e.kind().code(), e.to_string()))
        };
        for words in [&["inspect", "a", "--fresh", "mesh"][..], &["--fresh", "mesh", "inspect", "a"]] {
            assert_eq!(refused(words), Some((2, "`--fresh` has no effect on `inspect`".into())), "{words:?}");
        }
        assert!(refused(&["status", "--deterministic"]).is_some());
        assert_eq!(refused(&["inspect", "a", "--set", "capture.unit_m=2", "--json"]), None);
        assert_eq!(refused(&["run", "a", "--fresh", "mesh", "--deterministic"]), None);
    }
}
