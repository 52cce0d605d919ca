//! The command line.
//!
//! Exit statuses: 0, done; 1, it failed; 2, faults of the command line or of the configuration; 3, the store of the
//! fleet was deleted or set back.

mod args;
mod commands;
mod fleet;
mod log;

use std::io::{self, Write as _};
use std::process::ExitCode;

use clap::Parser as _;
use clap::error::ErrorKind;

use self::args::{Cli, Command};
use crate::printable::printable;

/// The status of a member whose store was deleted or set back: it must not be started again by a program.
const STATUS_STORE: u8 = 3;

/// The status of faults of the command line or of the configuration.
const STATUS_USAGE: u8 = 2;

/// The status of a failure.
const STATUS_FAILED: u8 = 1;

/// Runs the command of the arguments.
pub(crate) fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return refuse(&error),
    };
    if let Err(error) = log::start(&cli.log) {
        return complain(&format!("--log: {error}"), STATUS_USAGE);
    }
    let done = match cli.command {
        Command::Run(args) => commands::run(&args.file),
        Command::Check(args) => commands::check(&args),
        Command::Demo(args) => commands::demo(&args),
        Command::PrintConfig(args) => commands::print_config(&args.file),
        Command::Import(args) => commands::import(&args),
        Command::Schema => commands::schema(),
        Command::Fleet(args) => fleet::run(&args.command),
    };
    match done {
        Ok(status) => status,
        // The reader of stdout has closed it on purpose, as `head` does.
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(error) => complain(&format!("cannot write to stdout: {error}"), STATUS_FAILED),
    }
}

/// Prints an error of the arguments, which it quotes, or the help.
fn refuse(error: &clap::Error) -> ExitCode {
    let text = error.to_string();
    let is_own = !error.use_stderr() || error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand;
    if is_own || text.lines().all(|line| printable(line).to_string() == line) {
        error.exit();
    }
    text.lines().for_each(|line| eprintln!("{}", printable(line)));
    ExitCode::from(STATUS_USAGE)
}

/// Prints an error, of which each line is one, and returns the status.
fn complain(error: &str, status: u8) -> ExitCode {
    error.lines().for_each(|line| eprintln!("error: {}", printable(line)));
    ExitCode::from(status)
}

/// Prints a text on stdout. Control characters besides line feeds are escaped.
fn print(text: &str) -> io::Result<()> {
    let mut stdout = io::BufWriter::new(io::stdout().lock());
    text.lines().try_for_each(|line| writeln!(stdout, "{}", printable(line)))?;
    stdout.flush()
}
