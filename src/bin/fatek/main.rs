//! The `fatek` command line: reads and writes FATEK PLCs, plays one, and explains frames.

mod args;
mod backup;
mod confirm;
mod connect;
mod control;
mod decode;
mod duration;
mod failure;
mod output;
mod ping;
mod plan;
mod program;
mod progress;
mod read;
mod retry;
mod scan;
mod signal;
mod sim;
mod status;
mod transfer;
mod watch;
mod write;

use std::io::{self, IsTerminal};
use std::process::ExitCode;

use clap::Parser;
use tracing_subscriber::EnvFilter;

use self::args::{Cli, Command, ProgramCommand};
use self::failure::Failure;
use self::output::Output;

fn main() -> ExitCode {
    let cli = Cli::parse();
    let output = Output::new(cli.common.format.unwrap_or_default(), cli.common.quiet);
    match run(&cli, &output) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(),
    }
}

fn run(cli: &Cli, output: &Output) -> Result<(), Failure> {
    trace(cli.common.verbose);
    // One task talks to one PLC: one thread is enough, even for the simulator.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(Failure::Runtime)?;
    let timeout = cli.common.timeout;
    let station = |plc| connect::station(&cli.plc.or(plc), timeout);
    runtime.block_on(async {
        match &cli.command {
            Command::Sim(args) => sim::sim(args).await,
            Command::Read(args) => read::read(&station(&args.plc)?, &args.tags, output).await,
            Command::Write(args) => write::write(&station(&args.plc)?, &args.assignments, output).await,
            Command::Status(args) => status::status(&station(&args.plc)?, output).await,
            Command::Run(args) => control::run(&station(&args.plc)?, output).await,
            Command::Stop(args) => control::stop(&station(&args.plc)?, output).await,
            Command::Enable(args) => control::enable(&station(&args.plc)?, &args.discretes, output).await,
            Command::Disable(args) => control::disable(&station(&args.plc)?, &args.discretes, output).await,
            Command::Set(args) => control::set(&station(&args.plc)?, &args.discretes, output).await,
            Command::Reset(args) => control::reset(&station(&args.plc)?, &args.discretes, output).await,
            Command::Ping(args) => {
                // What is lost shall show: nothing is sent again.
                let station = station(&args.plc)?.with_options(connect::options(timeout).retries(0));
                ping::ping(&station, args, output).await
            }
            Command::Scan(args) => {
                let endpoint = connect::endpoint(cli.plc.link(&args.link).as_deref())?;
                scan::scan(endpoint, args, timeout, output).await
            }
            Command::Plan(args) => plan::plan(cli.plc.link(&args.link).as_deref(), args, output),
            Command::Watch(args) => watch::watch(&station(&args.plc)?, args, output).await,
            Command::Program(ProgramCommand::Read(args)) => program::read(&station(&args.plc)?, args, output).await,
            Command::Program(ProgramCommand::Write(args)) => {
                program::write(&cli.plc.or(&args.plc), timeout, args, output).await
            }
            Command::Program(ProgramCommand::Verify(args)) => {
                program::verify(&cli.plc.or(&args.plc), timeout, args, output).await
            }
            Command::Program(ProgramCommand::Info(file)) => program::info(file, output),
            Command::Backup(args) => backup::backup(&cli.plc.or(&args.plc), timeout, args, output).await,
            Command::Restore(args) => backup::restore(&cli.plc.or(&args.plc), timeout, args, output).await,
            Command::Decode(args) => decode::decode(args, output),
        }
    })
}

/// Shows what the library does, on stderr: as `RUST_LOG` says, else as `-v` says.
fn trace(verbose: u8) {
    let filter = match (std::env::var("RUST_LOG"), verbose) {
        (Ok(filter), 0) if !filter.is_empty() => EnvFilter::new(filter),
        (_, 0) => return,
        (_, 1) => EnvFilter::new("fatek=debug"),
        (_, _) => EnvFilter::new("fatek=trace"),
    };
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(io::stderr)
        .with_ansi(io::stderr().is_terminal())
        .init();
}
