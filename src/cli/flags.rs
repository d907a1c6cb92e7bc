//! Options of commands that set keys of the configuration: those that the rows of its tables state.

use super::options::KeyOption;
use crate::config::{Flag, Takes, all_keys, key};
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches, value_parser};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use tiface_base::{Error, Result, io};

/// The options of a command that set keys, as they are given.
#[derive(Debug, Default)]
pub(super) struct KeyFlags(Vec<GivenFlag>);

#[derive(Debug)]
struct GivenFlag {
    /// The key that it sets.
    key: String,
    flag: Flag,
    /// One, or more of an option that is repeatable.
    values: Vec<OsString>,
}

impl KeyFlags {
    /// Returns the options as keys of the configuration; files by their absolute path, so that the
    /// run finds them from any working directory.
    pub fn options(&self) -> Result<Vec<KeyOption>> {
        self.0.iter().map(GivenFlag::option).collect()
    }

    /// Returns the value that is given of a key, as typed.
    pub fn typed(&self, key: &str) -> Option<&Path> {
        let given = self.0.iter().find(|given| given.key == key)?;
        given.values.first().map(Path::new)
    }
}

impl GivenFlag {
    fn option(&self) -> Result<KeyOption> {
        let long = self.flag.long;
        let words: Vec<String> = self.values.iter().map(|v| v.to_string_lossy().into_owned()).collect();
        let value = match self.flag.takes {
            Takes::Text(_) => words.concat(),
            Takes::Switch(value) => return Ok((format!("--{long} {value}"), self.key.clone(), value.into())),
            Takes::Each(_) => serde_json::json!(words).to_string(),
            Takes::File => self.file()?,
        };
        let typed = words.iter().map(|word| format!("--{long} {word}")).collect::<Vec<_>>().join(" ");
        Ok((typed, self.key.clone(), value))
    }

    /// Returns the absolute path of a file.
    fn file(&self) -> Result<String> {
        let path: PathBuf = self.values.iter().collect();
        let path = io::real_path(&path)?;
        path.to_str().map(String::from).ok_or_else(|| {
            Error::cannot(format!("the path `{}` is not UTF-8", path.display()), "rename the file")
        })
    }
}

/// Returns every key that an option sets, with its documentation and the option.
fn flags() -> impl Iterator<Item = (String, &'static str, Flag)> {
    all_keys().filter_map(|(key, row)| Some((key, row.doc, row.flag?)))
}

impl Args for KeyFlags {
    /// Adds the options that have this command in their rows.
    fn augment_args(command: Command) -> Command {
        let name = command.get_name().to_owned();
        let own = flags().filter(|(_, _, flag)| flag.commands.contains(&name.as_str()));
        own.fold(command, |command, (key, doc, flag)| command.arg(related(arg(key, doc, flag))))
    }

    fn augment_args_for_update(command: Command) -> Command {
        KeyFlags::augment_args(command)
    }
}

fn arg(key: String, doc: &'static str, flag: Flag) -> Arg {
    // clap's own style: no full stop
    let help = if flag.help.is_empty() { doc.trim_end_matches('.') } else { flag.help };
    let arg = Arg::new(key).long(flag.long).help(help);
    match flag.takes {
        Takes::Text(name) => arg.value_name(name),
        Takes::Each(name) => arg.value_name(name).action(ArgAction::Append),
        Takes::File => arg.value_name("FILE").value_parser(value_parser!(PathBuf)),
        Takes::Switch(_) => arg.action(ArgAction::SetTrue),
    }
}

/// Adds what no row states: other names, and which options need or exclude each other.
fn related(arg: Arg) -> Arg {
    match arg.get_long() {
        Some("prompts") => arg.alias("points"),
        Some("point") => arg.conflicts_with(key!(mask.prompts)).allow_hyphen_values(true),
        Some("view") => arg.requires(key!(mask.point)),
        Some("alpha-net") => arg.conflicts_with_all([key!(mask.prompts), key!(mask.point)]),
        _ => arg,
    }
}

impl FromArgMatches for KeyFlags {
    fn from_arg_matches(found: &ArgMatches) -> Result<KeyFlags, clap::Error> {
        let given = |(key, _, flag): (String, &str, Flag)| {
            // the options of other commands are not known here
            let is_known = found.try_contains_id(&key).unwrap_or(false);
            let is_given = is_known && found.value_source(&key) == Some(ValueSource::CommandLine);
            let values = found.try_get_raw(&key).ok().flatten().filter(|_| is_given)?;
            Some(GivenFlag { values: values.map(OsString::from).collect(), key, flag })
        };
        Ok(KeyFlags(flags().filter_map(given).collect()))
    }

    fn update_from_arg_matches(&mut self, found: &ArgMatches) -> Result<(), clap::Error> {
        *self = KeyFlags::from_arg_matches(found)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Cli;
    use clap::CommandFactory;

    /// A value that the option of a key takes; no file is opened.
    fn sample(flag: &Flag) -> Option<&'static str> {
        match flag.takes {
            Takes::Switch(_) => None,
            Takes::Each(_) => Some("1,2,1"),
            _ => Some("Cargo.toml"),
        }
    }

    #[test]
    fn every_option_of_a_row_is_one_of_its_commands_and_sets_its_key() {
        let mut count = 0;
        for (key, _, flag) in flags() {
            for name in flag.commands {
                // each alone, but the view of a click
                let mut words = vec!["tiface".to_owned(), (*name).into(), format!("--{}", flag.long)];
                words.extend(sample(&flag).map(String::from));
                if key == key!(mask.view) {
                    words.extend(["--point", "1,2,1"].map(String::from));
                }
                let found = Cli::command().try_get_matches_from(&words).unwrap_or_else(|e| panic!("{e}"));
                let given = KeyFlags::from_arg_matches(found.subcommand().unwrap().1).unwrap();
                let options = given.options().unwrap();
                let (_, _, value) = options.iter().find(|(_, set, _)| *set == key).unwrap();
                match flag.takes {
                    Takes::Switch(stands_for) => assert_eq!(value, stands_for),
                    Takes::Each(_) => assert_eq!(value, "[\"1,2,1\"]"),
                    Takes::Text(_) => assert_eq!(value, "Cargo.toml"),
                    Takes::File => assert!(Path::new(value).is_absolute(), "{value}"),
                }
                assert_eq!(options.len(), if key == key!(mask.view) { 2 } else { 1 });
                count += 1;
            }
        }
        // seven of clicks for two commands, and eight of a mesh, four and two of one
        assert_eq!(count, 14 + 8 + 4 + 2);
    }

    #[test]
    fn no_option_is_given_where_none_is_typed() {
        for name in ["run", "mask", "mesh", "render", "ensemble"] {
            let found = Cli::command().try_get_matches_from(["tiface", name]).unwrap();
            let given = KeyFlags::from_arg_matches(found.subcommand().unwrap().1).unwrap();
            assert!(given.0.is_empty() && given.typed(key!(mask.prompts)).is_none(), "{given:?}");
        }
    }
}
