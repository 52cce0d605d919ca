//! The command line.
//!
//! Exit statuses: 0, done; 1, it failed; 2, faults of the command line or of the configuration.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use fatek_bridge::config::Config;
use tracing_subscriber::EnvFilter;

/// Daemon that carries data of FATEK / FACON PLCs to MQTT, NATS, Prometheus and a web page
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a configuration until SIGINT or SIGTERM
    Run {
        /// Configuration
        #[arg(env = "FATEK_BRIDGE_CONFIG", value_name = "FILE")]
        config: PathBuf,
    },
}

/// The status of faults of the command line or of the configuration.
const STATUS_USAGE: u8 = 2;

/// Runs the command of the arguments.
pub(crate) fn main() -> ExitCode {
    let cli = Cli::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn,fatek_bridge=info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(false).init();
    match cli.command {
        Command::Run { config } => run(&config),
    }
}

fn run(path: &std::path::Path) -> ExitCode {
    let config = match Config::load(path) {
        Ok(config) => config,
        Err(error) => {
            error.to_string().lines().for_each(|line| eprintln!("error: {line}"));
            return ExitCode::from(STATUS_USAGE);
        }
    };
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("error: cannot start: {error}");
            return ExitCode::FAILURE;
        }
    };
    let result = runtime.block_on(fatek_bridge::run::run(config));
    // Without a limit, a write to a pipe that is not read would hold up the end.
    runtime.shutdown_timeout(std::time::Duration::from_millis(100));
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}
