//! Arguments and help texts.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum, ValueHint};
use fatek::Endpoint;
use fatek_bridge::config::{Environment, Name, Period};

use super::fleet::args::FleetArgs;

/// Daemon that carries data of FATEK / FACON PLCs to MQTT, NATS, Prometheus and a web page
#[derive(Debug, Parser)]
#[command(version, after_help = AFTER_HELP, max_term_width = 80)]
pub(super) struct Cli {
    #[command(flatten)]
    pub(super) log: LogArgs,
    #[command(subcommand)]
    pub(super) command: Command,
}

const AFTER_HELP: &str = "\
Environment:
  FATEK_BRIDGE_CONFIG         the FILE of run, check and print-config
  FATEK_BRIDGE_ID             in place of bridge.id, without --id
  FATEK_BRIDGE_HTTP           in place of bridge.http
  FATEK_BRIDGE_HTTP_TOKEN     in place of the content of bridge.token_file
  FATEK_BRIDGE_MQTT_PASSWORD  in place of the content of mqtt.password_file
  FATEK_BRIDGE_NATS_CREDS     in place of the content of nats.creds_file
  FATEK_BRIDGE_NATS_PASSWORD  in place of the content of nats.password_file
  CREDENTIALS_DIRECTORY       folder of secrets, set by systemd
  STATE_DIRECTORY             folder of the buffer, set by systemd

Exit status:
  0  done
  1  it failed; check --strict: warnings
  2  faults of the command line or of the configuration
  3  the store of the fleet was deleted or set back: a member that knows the
     older one has stopped, and is started again by hand

Examples:
  fatek-bridge demo
  fatek-bridge import boiler.csv --link tcp://192.168.2.9 > plant.toml
  fatek-bridge check plant.toml
  fatek-bridge run plant.toml";

/// Log on stderr.
#[derive(Debug, Args)]
#[command(next_help_heading = "Log")]
pub(super) struct LogArgs {
    /// Filter of the log on stderr, such as debug or warn,fatek=debug
    ///
    /// Under systemd lines have no time, which the journal adds.
    #[arg(long = "log", global = true, env = "RUST_LOG", hide_env_values = true, value_name = "FILTER")]
    #[arg(default_value = "warn,fatek_bridge=info")]
    pub(super) log_filter: String,
    /// Format of the log
    #[arg(long = "log-format", global = true, value_name = "FORMAT", value_enum, default_value_t)]
    pub(super) log_format: LogFormat,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum LogFormat {
    /// Lines of text
    #[default]
    Text,
    /// Lines of JSON
    Json,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    Run(RunArgs),
    Check(CheckArgs),
    Demo(DemoArgs),
    PrintConfig(PrintArgs),
    Import(ImportArgs),
    /// Print the JSON Schema of the configuration, for editors
    ///
    /// Draft 2020-12. Taplo and Even Better TOML complete keys by it and mark faults. The first line of a
    /// configuration names it: #:schema ./fatek-bridge.schema.json
    #[command(after_help = "Examples:
  fatek-bridge schema > fatek-bridge.schema.json")]
    Schema,
    Fleet(FleetArgs),
}

/// Run a configuration until SIGINT or SIGTERM
///
/// SIGHUP reloads it: the difference is applied, and a configuration with faults changes nothing. SIGTERM and
/// SIGINT deliver what is in the buffer, for a limited time.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge run plant.toml
  fatek-bridge run plant.toml --log debug
  fatek-bridge run plant.toml --id hall-2
  FATEK_BRIDGE_MQTT_PASSWORD=secret fatek-bridge run plant.toml")]
pub(super) struct RunArgs {
    #[command(flatten)]
    pub(super) file: FileArgs,
}

/// The configuration.
#[derive(Debug, Args)]
pub(super) struct FileArgs {
    /// Configuration
    #[arg(env = "FATEK_BRIDGE_CONFIG", hide_env_values = true, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(super) config: PathBuf,
    /// Name of this bridge, in place of bridge.id and FATEK_BRIDGE_ID
    ///
    /// In a fleet it is the name of the member, so that all members can have one file. Without any it is the name of
    /// the host.
    #[arg(long, value_name = "NAME", value_parser = name)]
    pub(super) id: Option<Name>,
}

impl FileArgs {
    /// The variables of this process, with the options.
    pub(super) fn environment(&self) -> Environment {
        Environment::with_id(self.id.as_ref())
    }
}

/// Check a configuration: plans, load of the links, missing files, doubtful settings
///
/// Connects to nothing and makes nothing. The load of a link is the share of its time that the requests take: on a
/// serial line by its speed, on a network by the round trip.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge check plant.toml
  fatek-bridge check plant.toml --round-trip 20ms --strict
  fatek-bridge check plant.toml --format json

JSON: object with file; plans, each with plc, station, link, class, every_ms,
tags, requests, bytes and time_ms; links, each with link, id, hosts, plcs,
requests_per_second, bytes_per_second and load_percent; outputs, each with name,
server, topic and commands; findings, each with severity, line, key and text.
Of a link, hosts are the members of a fleet that can reach it; none: all can.

Exit status: 0 without faults, 1 with warnings and --strict, 2 with faults.")]
pub(super) struct CheckArgs {
    #[command(flatten)]
    pub(super) file: FileArgs,
    /// Time of a request on a network, and response time of a PLC on a serial line
    #[arg(long, value_name = "TIME", default_value = "5ms", value_parser = time)]
    pub(super) round_trip: Duration,
    /// Exit status 1 if there are warnings
    #[arg(long)]
    pub(super) strict: bool,
    /// Output format
    #[arg(long, value_name = "FORMAT", value_enum, default_value_t)]
    pub(super) format: Format,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    /// Aligned columns
    #[default]
    Table,
    /// One JSON document
    Json,
}

/// Try it: simulated PLCs, the web page, and lines of JSON on stdout
///
/// Nothing else is needed. One of the PLCs falls silent from time to time. Ctrl-C ends it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge demo
  fatek-bridge demo --http 127.0.0.1:8080 --quiet
  fatek-bridge demo --for 10s
  fatek-bridge demo --print-config > plant.toml")]
pub(super) struct DemoArgs {
    /// Address of the page [default: 127.0.0.1:9187, or a free port if that is taken]
    #[arg(long, value_name = "ADDRESS:PORT")]
    pub(super) http: Option<SocketAddr>,
    /// No lines on stdout
    #[arg(short, long)]
    pub(super) quiet: bool,
    /// End after this time, 1s or more
    #[arg(long = "for", value_name = "TIME", value_parser = time_of_demo)]
    pub(super) duration: Option<Duration>,
    /// Print the configuration of the demo and end
    #[arg(long)]
    pub(super) print_config: bool,
}

/// Print a configuration with the defaults in force
///
/// The text is a configuration itself. Comments are left out, tables of tags are named by their whole path,
/// and secrets are not in it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge print-config plant.toml")]
pub(super) struct PrintArgs {
    #[command(flatten)]
    pub(super) file: FileArgs,
}

/// Convert tables of tags to sections of a configuration
///
/// A table is CSV with the columns name and at, and any of class, unit, comment and group; or TOML, if its
/// name ends in .toml. The sections go to stdout, for one PLC or for a template.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge import boiler.csv --link tcp://192.168.2.9 --station 1
  fatek-bridge import tank.csv valves.csv --plc mixer --link udp://192.168.2.3
  fatek-bridge import tank.csv --template tank --class fast=500ms")]
pub(super) struct ImportArgs {
    /// Table of tags
    #[arg(required = true, value_name = "TABLE", value_hint = ValueHint::FilePath)]
    pub(super) tables: Vec<PathBuf>,
    /// Name of the PLC [default: that of the first table, without its extension]
    #[arg(long, value_name = "NAME", value_parser = name)]
    pub(super) plc: Option<Name>,
    /// Link to the PLC, such as tcp://192.168.2.3:500
    #[arg(long, value_name = "URL", required_unless_present = "template")]
    pub(super) link: Option<Endpoint>,
    /// Station number of the PLC, 1 to 254
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=254))]
    pub(super) station: u8,
    /// Make a template of this name, in place of a PLC
    #[arg(long, value_name = "NAME", value_parser = name, conflicts_with_all = ["plc", "link", "station"])]
    pub(super) template: Option<Name>,
    /// Period of a class of the tables; repeat for others [default: 1s]
    #[arg(long = "class", value_name = "NAME=TIME", value_parser = class)]
    pub(super) classes: Vec<(Name, Period)>,
}

pub(super) fn name(text: &str) -> Result<Name, &'static str> {
    Name::parse(text).ok_or("a name has 1 to 64 of the characters A-Z a-z 0-9 _ -")
}

pub(super) fn time(text: &str) -> Result<Duration, &'static str> {
    const DAY: Duration = Duration::from_secs(24 * 3600);
    let time = humantime::parse_duration(text).ok().filter(|time| *time <= DAY);
    time.ok_or("a time is a number with a unit, at most 24h, such as 500ms or 10s")
}

fn time_of_demo(text: &str) -> Result<Duration, &'static str> {
    let time = time(text)?;
    if time >= Duration::from_secs(1) { Ok(time) } else { Err("the demo runs for 1s or more") }
}

fn class(text: &str) -> Result<(Name, Period), &'static str> {
    let (class, period) = text.split_once('=').ok_or("a class has a period, as in fast=500ms")?;
    let period = time(period)?;
    if period < Duration::from_millis(1) {
        return Err("a period is 1ms or more");
    }
    Ok((name(class)?, Period(period)))
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn help_texts_fit_80_columns() {
        Cli::command().debug_assert();
        assert_eq!(check(&mut Cli::command()), ["run", "check", "demo", "print-config", "import", "schema", "fleet"]);
    }

    /// Checks the help of a command and of those below it, whose names it returns.
    fn check(command: &mut clap::Command) -> Vec<String> {
        for text in [command.render_help(), command.render_long_help()] {
            for line in text.to_string().lines() {
                assert!(line.chars().count() <= 80, "{}: {line}", command.get_name());
            }
        }
        let names: Vec<String> = command.get_subcommands().map(|command| command.get_name().to_owned()).collect();
        names.iter().for_each(|name| drop(check(command.find_subcommand_mut(name).unwrap())));
        names.into_iter().filter(|name| name != "help").collect()
    }

    #[test]
    fn classes_are_a_name_and_a_period() {
        assert_eq!(class("fast=500ms").unwrap().1, Period(Duration::from_millis(500)));
        for text in ["fast", "fast=", "fast=5", "a b=1s", "fast=10us", "=1s"] {
            assert!(class(text).is_err(), "{text}");
        }
    }
}
