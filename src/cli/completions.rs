//! `tiface completions`: what a shell needs to complete commands and options, and the manual pages.

use super::out::Out;
use super::stdout::print;
use crate::io;
use crate::{Error, Result};
use clap::{Command, ValueEnum};
use clap_complete::{Shell, generate};
use clap_mangen::Man;

/// What `completions` writes.
#[derive(Clone, Copy, Debug)]
pub(super) enum Form {
    Shell(Shell),
    Man,
}

impl ValueEnum for Form {
    fn value_variants<'a>() -> &'a [Form] {
        use Form::{Man, Shell as For};
        &[
            For(Shell::Bash),
            For(Shell::Zsh),
            For(Shell::Fish),
            For(Shell::PowerShell),
            For(Shell::Elvish),
            Man,
        ]
    }

    fn to_possible_value(&self) -> Option<clap::builder::PossibleValue> {
        match self {
            Form::Shell(shell) => shell.to_possible_value(),
            Form::Man => Some(clap::builder::PossibleValue::new("man")),
        }
    }
}

pub(super) fn run(form: Form, mut command: Command, out: Option<&Out>) -> Result<()> {
    let pages = match (form, out) {
        (Form::Shell(_), Some(_)) => {
            return Err(Error::usage("the script of a shell goes to stdout", "send it on with `> FILE`"));
        }
        (Form::Shell(shell), None) => {
            let mut script = Vec::new();
            generate(shell, &mut command, "tiface", &mut script);
            return print(&String::from_utf8_lossy(&script));
        }
        (Form::Man, None) => vec![page(command)?],
        (Form::Man, Some(_)) => {
            command.build();
            let of_commands: Vec<Command> =
                command.get_subcommands().filter(|c| c.get_name() != "help").cloned().collect();
            let named = of_commands.into_iter().map(|c| {
                // a command's name lives as long as the program
                let name: &'static str = format!("tiface-{}", c.get_name()).leak();
                c.name(name).display_name(name)
            });
            let all: Vec<Command> = named.collect();
            std::iter::once(command).chain(all).map(page).collect::<Result<_>>()?
        }
    };
    let Some(out) = out else { return print(&String::from_utf8_lossy(&pages[0].1)) };
    out.prepare()?;
    pages.iter().try_for_each(|(name, text)| Ok(io::write_atomic(&out.file(name), text)?))
}

/// A manual page and the name of its file.
fn page(command: Command) -> Result<(String, Vec<u8>)> {
    let man = Man::new(command);
    let mut text = Vec::new();
    man.render(&mut text).map_err(|e| Error::new(crate::ErrorKind::Bug, e))?;
    Ok((man.get_filename(), text))
}
