//! Arguments of `fatek completions` and `fatek man`.

use std::path::PathBuf;

use clap::Args;
use clap::builder::PossibleValuesParser;

use crate::complete;

/// Print the completion script of a shell
///
/// The script completes commands and options, the PLCs of --config and FATEK_CONFIG, and the names of
/// their tags and of --tags.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  echo 'source <(fatek completions bash)' >> ~/.bashrc
  echo 'source <(fatek completions zsh)' >> ~/.zshrc
  fatek completions fish > ~/.config/fish/completions/fatek.fish

The script runs fatek at the tab key: print it anew after an update.")]
pub(crate) struct CompletionsArgs {
    /// Shell
    #[arg(value_parser = PossibleValuesParser::new(complete::shells()), value_name = "SHELL")]
    pub(crate) shell: String,
}

/// Write the man pages to a folder
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek man ~/.local/share/man/man1 && man fatek-read")]
pub(crate) struct ManArgs {
    /// Folder, created if it is missing; existing pages are replaced
    #[arg(value_name = "FOLDER")]
    pub(crate) folder: PathBuf,
}
