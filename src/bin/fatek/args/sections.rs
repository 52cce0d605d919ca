//! Help of `fatek` itself, with its commands in sections.

use clap::builder::StyledStr;
use std::fmt::Write as _;

/// The commands in the order of the help. Each is in one section.
const SECTIONS: [(&str, &[&str]); 6] = [
    ("Values", &["read", "write", "watch", "top", "plan"]),
    ("Discretes", &["set", "reset", "enable", "disable", "forced"]),
    ("PLC", &["status", "run", "stop", "clock", "program", "backup", "restore"]),
    ("Lines", &["ping", "scan", "detect", "ports", "probe", "doctor"]),
    ("Tests", &["sim", "decode", "record", "replay"]),
    ("Shell", &["completions", "man", "help"]),
];

/// Returns the command with sections of its subcommands in the help.
pub(crate) fn with_sections(command: clap::Command) -> clap::Command {
    let style = command.get_styles().clone();
    let (header, literal) = (style.get_header(), style.get_literal());
    let mut text = String::new();
    let about = |name: &str| match name {
        "help" => "Print this message, or the help of a command".to_owned(),
        name => command
            .find_subcommand(name)
            .and_then(|found| found.get_about())
            .map(StyledStr::to_string)
            .unwrap_or_default(),
    };
    let width = SECTIONS.iter().flat_map(|(_, names)| names.iter()).map(|name| name.len()).max().unwrap_or(0);
    for (section, names) in SECTIONS {
        // Writing to a string does not fail.
        let _ = write!(text, "\n{header}{section}:{header:#}\n");
        for name in names {
            let _ = writeln!(text, "  {literal}{name:width$}{literal:#}  {}", about(name));
        }
    }
    let template = format!(
        "{{before-help}}{{about-with-newline}}\n{{usage-heading}} {{usage}}\n{text}\n{{all-args}}{{after-help}}"
    );
    // The list of all subcommands is replaced by the sections.
    let command = command.mut_subcommands(|subcommand| subcommand.hide(true)).help_template(template);
    // The usage would not show hidden subcommands.
    command.override_usage("fatek [OPTIONS] [@NAME]... <COMMAND>")
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::args::Cli;

    #[test]
    fn each_command_is_in_one_section() {
        let mut listed: Vec<&str> = SECTIONS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        let command = Cli::command();
        let mut all: Vec<&str> = command.get_subcommands().map(clap::Command::get_name).chain(["help"]).collect();
        listed.sort_unstable();
        all.sort_unstable();
        assert_eq!(listed, all);
    }

    #[test]
    fn sections_fit_80_columns() {
        let help = with_sections(Cli::command()).render_help().to_string();
        let (begin, end) = (help.find("Values:").unwrap(), help.find("Options:").unwrap());
        for line in help[begin..end].lines() {
            assert!(line.len() <= 80, "{} columns: {line}", line.len());
        }
        assert!(!help.contains("Commands:"), "{help}");
    }
}
