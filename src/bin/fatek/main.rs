//! The `fatek` command line: client for FATEK PLCs, simulator, and frame decoder.

mod args;
mod backup;
mod byte_size;
mod clock;
mod complete;
mod confirm;
mod connect;
mod control;
mod conversation;
mod decode;
mod detect;
mod doctor;
mod duration;
mod enquiry;
mod failure;
mod forced;
mod hint;
mod listen;
mod names;
mod output;
mod ping;
mod plan;
mod plot;
mod ports;
#[path = "../../printable.rs"]
mod printable;
mod probe;
mod program;
mod progress;
mod ranges;
mod read;
mod record;
mod replay;
mod retry;
mod scan;
mod screen;
mod signal;
mod sim;
mod status;
mod targets;
mod top;
mod traffic;
mod transfer;
mod watch;
mod write;

use std::ffi::OsString;
use std::io::{self, Write};
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{ArgMatches, CommandFactory, FromArgMatches};
use fatek::command::{ControlPlc, DiscreteControl};
use tracing_subscriber::EnvFilter;

use self::args::{Cli, Command, DiscreteArgs, LinkArgs, Plc, ProgramCommand, ReplayArgs};
use self::failure::Failure;
use self::output::{Output, coloured, complain, printable_lines};
use self::printable::{excerpt, printable};
use self::ranges::DiscreteRange;
use self::targets::Chosen;

fn main() -> ExitCode {
    if complete::complete() {
        return ExitCode::SUCCESS;
    }
    let mut command = args::with_sections(Cli::command());
    let parsed = command.try_get_matches_from_mut(arguments()).and_then(|matches| {
        let mut cli = Cli::from_arg_matches(&matches)?;
        cli.plant.is_given = is_given(&matches, "config");
        cli.plant.has_other_plc = is_given(&matches, "links") || is_given(&matches, "station");
        Ok(cli)
    });
    let cli = match parsed {
        Ok(cli) => cli,
        Err(error) => return refuse(error.format(&mut command)),
    };
    let output = Output::new(cli.common.format.unwrap_or_default(), cli.common.quiet);
    match run(&cli, &output) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => report(&failure, &output),
    }
}

/// Returns whether an option is on the command line, before or after the command, and not in the environment
/// alone.
fn is_given(matches: &ArgMatches, id: &str) -> bool {
    // An unknown id is that of another command.
    let has = |matches: &ArgMatches| {
        matches.try_contains_id(id).is_ok() && matches.value_source(id) == Some(ValueSource::CommandLine)
    };
    has(matches) || matches.subcommand().is_some_and(|(_, matches)| is_given(matches, id))
}

/// The arguments, with each `@NAME` before the command as `--plc=NAME`.
fn arguments() -> Vec<OsString> {
    let command = Cli::command();
    // Options whose value is the next argument.
    let takes_value = |option: &str| {
        let mut arguments = command.get_arguments().filter(|argument| argument.get_action().takes_values());
        arguments.any(|argument| option.strip_prefix("--").is_some_and(|name| argument.get_long() == Some(name)))
    };
    let mut arguments: Vec<OsString> = std::env::args_os().collect();
    let mut is_value = false;
    for argument in arguments.iter_mut().skip(1) {
        let Some(text) = argument.to_str() else { break };
        if std::mem::replace(&mut is_value, takes_value(text)) || text.starts_with('-') {
            continue;
        }
        match text.strip_prefix('@') {
            Some(name) => *argument = format!("--plc={name}").into(),
            None => break,
        }
    }
    arguments
}

/// Prints an error of the arguments, which it quotes, or the help.
fn refuse(mut error: clap::Error) -> ExitCode {
    if !error.use_stderr() || error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        // Own texts only.
        error.exit();
    }
    // Other values are own texts, or a suggestion, which is handled below.
    let quoted = |value: &ContextValue| {
        if let ContextValue::String(text) = value {
            Some(ContextValue::String(excerpt(text).to_string()))
        } else if let ContextValue::Strings(texts) = value {
            Some(ContextValue::Strings(texts.iter().map(|text| excerpt(text).to_string()).collect()))
        } else {
            None
        }
    };
    let context: Vec<_> = error.context().filter_map(|(kind, value)| Some((kind, quoted(value)?))).collect();
    let is_quoted_whole = context.iter().all(|(kind, value)| error.get(*kind) == Some(value));
    for (kind, value) in context {
        error.insert(kind, value);
    }
    if !is_quoted_whole {
        error.insert(ContextKind::Suggested, ContextValue::None);
    }
    // A write error is ignored: there is no other place to report it.
    let _ = write!(anstream::stderr().lock(), "{}", coloured(&printable_lines(&error.to_string())));
    ExitCode::from(2)
}

/// Prints the error to stderr and returns the exit status.
fn report(failure: &Failure, output: &Output) -> ExitCode {
    // Success for `fatek read … | head -1`: the reader has closed the pipe on purpose.
    if failure.is_broken_pipe() {
        return ExitCode::SUCCESS;
    }
    if let Failure::Table(_) | Failure::Plant(_) = failure {
        // One line for each fault; the texts of the file in it are escaped.
        format!("error: {failure}").lines().for_each(|line| complain(format_args!("{line}")));
    } else {
        complain(format_args!("error: {failure}"));
    }
    for hint in hint::of(failure) {
        output.remark(format_args!("hint: {hint}"));
    }
    if let Failure::Usage(_) = failure {
        complain(format_args!(""));
        complain(format_args!("For more information, try '--help'."));
    }
    ExitCode::from(failure.exit_status())
}

fn run(cli: &Cli, output: &Output) -> Result<(), Failure> {
    trace(cli.common.verbose);
    // All requests go to one link, so one thread is enough, also for the simulator.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(Failure::Runtime)?;
    let timeout = cli.common.timeout;
    // Those of `sim` are no targets of calls.
    let chosen = if let Command::Sim(_) = cli.command { Chosen::default() } else { cli.plant.load()? };
    let is_alone = if let Command::Scan(args) = &cli.command {
        args.discovery.discover || !args.network.hosts.is_empty()
    } else {
        matches!(
            &cli.command,
            Command::Decode(_)
                | Command::Completions(_)
                | Command::Man(_)
                | Command::Program(ProgramCommand::Info(_))
                | Command::Ports(_)
                | Command::Detect(_)
                | Command::Replay(ReplayArgs { listen: Some(_), .. })
        )
    };
    if is_alone && !chosen.is_empty() {
        return Err(Failure::Usage("this command takes no PLC".to_owned()));
    }
    let plc = |own: &Plc| chosen.plc(cli.plc.or(own));
    let station = |own: &Plc| connect::station(&plc(own)?, timeout);
    let endpoint = |own: &LinkArgs| match chosen.one()? {
        Some(plc) => Ok(plc.endpoint().clone()),
        None => connect::endpoint(cli.plc.link(own)?.as_deref()),
    };
    let targets = |own: &Plc, once| chosen.targets(&cli.plc.or(own), timeout, once);
    let discretes = async |args: &DiscreteArgs, control| {
        let discretes: Vec<_> = args.discretes.iter().flat_map(DiscreteRange::iter).collect();
        write::refuse_special(args.special, discretes.iter().map(|&discrete| discrete.into()))?;
        control::discretes(&station(&args.plc)?, control, &discretes, output).await
    };
    runtime.block_on(async {
        match &cli.command {
            Command::Sim(args) => sim::sim(args, cli.plant.simulated()?.as_ref(), output).await,
            Command::Read(args) => read::read(&targets(&args.plc, true)?, args, output).await,
            Command::Write(args) => write::write(&station(&args.plc)?, args, chosen.one()?, output).await,
            Command::Status(args) => status::status(&station(&args.plc)?, output).await,
            Command::Run(args) => control::plc(&station(&args.plc)?, ControlPlc::Run, output).await,
            Command::Stop(args) => control::plc(&station(&args.plc)?, ControlPlc::Stop, output).await,
            Command::Enable(args) => discretes(args, DiscreteControl::Enable).await,
            Command::Disable(args) => discretes(args, DiscreteControl::Disable).await,
            Command::Set(args) => discretes(args, DiscreteControl::Set).await,
            Command::Reset(args) => discretes(args, DiscreteControl::Reset).await,
            Command::Forced(args) => forced::forced(&station(&args.plc)?, args, output).await,
            Command::Ping(args) => {
                // A retry would hide a lost reply.
                let station = station(&args.plc)?.with_options(connect::options(timeout).with_retries(0));
                ping::ping(&station, args, output).await
            }
            Command::Scan(args) if args.discovery.discover => {
                scan::discover::discover(&args.discovery, timeout, output).await
            }
            Command::Scan(args) if !args.network.hosts.is_empty() => scan::network::scan(args, timeout, output).await,
            Command::Scan(args) => scan::scan(endpoint(&args.link)?, args, timeout, output).await,
            Command::Ports(args) => ports::ports(args, output),
            Command::Detect(args) => detect::detect(args, timeout, output).await,
            Command::Plan(args) => plan::plan(&chosen.plc(cli.plc.of_plan(args))?, args, chosen.one()?, output),
            Command::Top(args) => top::top(&targets(&args.plc, false)?, args, output).await,
            Command::Watch(args) => watch::watch(&targets(&args.plc, false)?, args, output).await,
            Command::Program(ProgramCommand::Read(args)) => program::read(&station(&args.plc)?, args, output).await,
            Command::Program(ProgramCommand::Write(args)) => {
                program::write(&plc(&args.plc)?, timeout, args, output).await
            }
            Command::Program(ProgramCommand::Verify(args)) => {
                program::verify(&plc(&args.plc)?, timeout, args, output).await
            }
            Command::Program(ProgramCommand::Info(file)) => program::info(file, output),
            Command::Backup(args) => backup::backup(&plc(&args.plc)?, timeout, args, output).await,
            Command::Restore(args) => backup::restore(&plc(&args.plc)?, timeout, args, output).await,
            Command::Clock(args) => clock::clock(&station(&args.plc)?, args, output).await,
            Command::Probe(args) => {
                // It finds them anew.
                let plc = Plc { capabilities: None, ..plc(&args.plc)? };
                probe::probe(&connect::station(&plc, timeout)?, output).await
            }
            Command::Doctor(args) => doctor::doctor(&plc(&args.plc)?, timeout, args, output).await,
            Command::Decode(args) => decode::decode(args, output),
            Command::Completions(args) => complete::script(&args.shell),
            Command::Man(args) => complete::man_pages(&args.folder, output),
            Command::Record(args) => record::record(endpoint(&args.link)?, args, timeout, output).await,
            Command::Replay(args) => match &args.listen {
                Some(url) => replay::serve(url, args, output).await,
                None => replay::send(endpoint(&args.link)?, args, timeout, output).await,
            },
        }
    })
}

/// Logs to stderr at the level of `-v`, or without it by the filter in `RUST_LOG`.
fn trace(verbose: u8) {
    let filter = match (std::env::var("RUST_LOG"), verbose) {
        (Ok(filter), 0) if !filter.is_empty() => EnvFilter::new(printable(&filter).to_string()),
        (_, 0) => return,
        (_, 1) => EnvFilter::new("fatek=debug"),
        (_, _) => EnvFilter::new("fatek=trace"),
    };
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(|| LogWriter).with_ansi(false).init();
}

/// Writes log lines to stderr, without control characters.
struct LogWriter;

impl Write for LogWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let text = printable_lines(&String::from_utf8_lossy(line));
        io::stderr().lock().write_all(text.as_bytes()).map(|()| line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().lock().flush()
    }
}
