//! Completion of the command line in a shell, and its man pages.
//!
//! `fatek completions SHELL` prints a script for the shell. At the tab key the script runs `fatek -- WORD…`
//! with the variable [`VARIABLE`] set, and `fatek` prints the candidates for the current word.

use std::ffi::{OsStr, OsString};
use std::io::{self, Write};
use std::path::Path;

use clap::CommandFactory;
use clap_complete::engine::SubcommandCandidates;
use clap_complete::env::Shells;
use clap_complete::{CompleteEnv, CompletionCandidate};
use fatek::plant::{Plant, PlantPlc};
use fatek::tag_table::TagTable;

use crate::args::Cli;
use crate::failure::Failure;
use crate::output::Output;
use crate::transfer::shown;

/// Variable with the name of the shell.
const VARIABLE: &str = "FATEK_COMPLETE";

/// Prints the candidates for a completion script. Returns `false` for any other command line.
pub(crate) fn complete() -> bool {
    const WORDS: usize = 2;
    let mut words: Vec<OsString> = std::env::args_os().collect();
    // The variable alone must not disable a command.
    if words.get(1).is_none_or(|first| first != "--") || words.len() == WORDS {
        return false;
    }
    // Shells without this variable complete the last word.
    let index = std::env::var("_CLAP_COMPLETE_INDEX").ok().and_then(|index| index.parse().ok());
    let current = index.unwrap_or(words.len().saturating_sub(WORDS + 1));
    name_plcs(&mut words[WORDS..], current);
    // For `@NAME` in the place of a command.
    let command = || {
        let names = SubcommandCandidates::new(|| named("@"));
        Cli::command().allow_external_subcommands(true).add(names)
    };
    let completed =
        CompleteEnv::with_factory(command).var(VARIABLE).try_complete(words, std::env::current_dir().ok().as_deref());
    // An error must not be printed into the command line that is being typed.
    completed.unwrap_or(true)
}

/// Replaces each `@NAME` before the word at `current` by an option. Bash splits words at `@`.
fn name_plcs(words: &mut [OsString], current: usize) {
    for word in words.iter_mut().take(current).skip(1) {
        match word.to_str().and_then(|word| word.strip_prefix('@')) {
            Some("") => *word = "--plc".into(),
            Some(name) => *word = format!("--plc={name}").into(),
            None => {}
        }
    }
}

/// Prints the script of a shell.
pub(crate) fn script(shell: &str) -> Result<(), Failure> {
    let mut text = Vec::new();
    if let Some(completer) = Shells::builtins().completer(shell) {
        completer.write_registration(VARIABLE, "fatek", "fatek", "fatek", &mut text).map_err(Failure::Output)?;
    }
    let mut stdout = io::stdout().lock();
    stdout.write_all(&text).and_then(|()| stdout.flush()).map_err(Failure::Output)
}

/// Names of the shells.
pub(crate) fn shells() -> Vec<&'static str> {
    Shells::builtins().names().collect()
}

/// Writes a man page of each subcommand to a folder.
pub(crate) fn man_pages(folder: &Path, output: &Output) -> Result<(), Failure> {
    let generated =
        std::fs::create_dir_all(folder).and_then(|()| clap_mangen::generate_to(Cli::command(), folder).map(|_| ()));
    generated.map_err(|error| Failure::ManPages { folder: folder.to_owned(), error })?;
    output.remark(format_args!("{}: man pages of fatek and its commands", shown(folder)));
    Ok(())
}

/// Names of tags: of the chosen PLCs of the plant configuration, and of the table of tags.
pub(crate) fn tags(current: &OsStr) -> Vec<CompletionCandidate> {
    let words = typed();
    let mut candidates = Vec::new();
    let mut push = |name: &str, tag: String| candidates.push(candidate(name, &tag));
    if let Some(table) = value(&words, "--tags", "FATEK_TAGS").and_then(|path| TagTable::load(path).ok()) {
        table.iter().for_each(|entry| push(entry.name(), entry.tag().to_string()));
    }
    let chosen: Vec<String> = values(&words, "--plc").filter_map(|name| name.into_string().ok()).collect();
    for plc in plant(&words).iter().flat_map(Plant::plcs) {
        if chosen.iter().any(|name| name == plc.name() || name == "all") {
            plc.tags().for_each(|tag| push(tag.name(), tag.tag().to_string()));
        }
    }
    matching(candidates, current)
}

/// Names of the PLCs of the plant configuration, for `--plc`.
pub(crate) fn plcs(current: &OsStr) -> Vec<CompletionCandidate> {
    matching(named(""), current)
}

/// Beginnings of links, and serial ports.
pub(crate) fn links(current: &OsStr) -> Vec<CompletionCandidate> {
    let begin = ["tcp://", "udp://", "serial:"].map(|scheme| CompletionCandidate::new(scheme.to_owned()));
    let mut ports: Vec<String> = std::fs::read_dir("/dev")
        .into_iter()
        .flatten()
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| name.starts_with("ttyUSB") || name.starts_with("ttyACM"))
        .collect();
    ports.sort();
    let ports = ports.into_iter().map(|name| CompletionCandidate::new(format!("serial:/dev/{name}")));
    matching(begin.into_iter().chain(ports).collect(), current)
}

fn named(prefix: &str) -> Vec<CompletionCandidate> {
    let plant = plant(&typed());
    let plc = |plc: &PlantPlc| {
        let help = format!("station {} on {}", plc.station(), plc.endpoint());
        candidate(&format!("{prefix}{}", plc.name()), &help)
    };
    let all = plant.iter().map(|_| candidate(&format!("{prefix}all"), "each PLC of the plant"));
    plant.iter().flat_map(Plant::plcs).map(plc).chain(all).collect()
}

fn candidate(value: &str, help: &str) -> CompletionCandidate {
    CompletionCandidate::new(value).help(Some(help.to_owned().into()))
}

fn matching(candidates: Vec<CompletionCandidate>, current: &OsStr) -> Vec<CompletionCandidate> {
    let current = current.as_encoded_bytes();
    let matches = |candidate: &CompletionCandidate| candidate.get_value().as_encoded_bytes().starts_with(current);
    candidates.into_iter().filter(matches).collect()
}

/// The words of the command line that is being typed.
fn typed() -> Vec<OsString> {
    let mut words: Vec<OsString> = std::env::args_os().skip_while(|argument| argument != "--").skip(1).collect();
    let count = words.len();
    name_plcs(&mut words, count);
    words
}

fn plant(words: &[OsString]) -> Option<Plant> {
    Plant::load(value(words, "--config", "FATEK_CONFIG")?).ok()
}

/// The value of an option, or of its variable.
fn value(words: &[OsString], option: &str, variable: &str) -> Option<OsString> {
    values(words, option).last().or_else(|| std::env::var_os(variable)).filter(|value| !value.is_empty())
}

/// The values of an option, as the next word or after `=`. Bash splits words at `=`.
fn values<'w>(words: &'w [OsString], option: &'w str) -> impl Iterator<Item = OsString> + 'w {
    words.iter().enumerate().filter_map(move |(at, word)| {
        if word == option {
            let next = words.get(at + 1)?;
            return if next == "=" { words.get(at + 2).cloned() } else { Some(next.clone()) };
        }
        Some(word.to_str()?.strip_prefix(option)?.strip_prefix('=')?.into())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(texts: &[&str]) -> Vec<OsString> {
        texts.iter().map(OsString::from).collect()
    }

    #[test]
    fn names_before_the_current_word_are_options() {
        let mut typed = words(&["fatek", "@mixer", "@", "boiler", "read", "@x"]);
        name_plcs(&mut typed, 5);
        assert_eq!(typed, words(&["fatek", "--plc=mixer", "--plc", "boiler", "read", "@x"]));
        assert_eq!(values(&typed, "--plc").collect::<Vec<_>>(), words(&["mixer", "boiler"]));
    }

    #[test]
    fn values_stand_behind_a_blank_or_an_equals_sign() {
        let typed = words(&["fatek", "--config", "a.toml", "--config=b.toml", "--config", "=", "c.toml", "--config"]);
        assert_eq!(values(&typed, "--config").collect::<Vec<_>>(), words(&["a.toml", "b.toml", "c.toml"]));
        assert_eq!(values(&typed, "--tags").count(), 0);
    }
}
