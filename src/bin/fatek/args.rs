//! Arguments and help texts of the command line.

mod backup;
mod data;
mod decode;
mod doctor;
mod find;
mod line;
mod model;
mod program;
mod record;
mod scan;
mod sections;
mod shell;
mod sim;
mod top;
mod watch;

use std::fmt;
use std::time::Duration;

use clap::{ArgAction, Args, Parser, Subcommand, ValueHint};
use clap_complete::ArgValueCompleter;

pub(crate) use self::backup::{BackupArgs, RestoreArgs, SpecialArg};
pub(crate) use self::data::{DiscreteArgs, ForcedArgs, PlanArgs, ReadArgs, WriteArgs};
pub(crate) use self::decode::DecodeArgs;
pub(crate) use self::doctor::DoctorArgs;
pub(crate) use self::find::{DetectArgs, PortsArgs};
pub(crate) use self::line::{ClockArgs, PingArgs, ProbeArgs};
pub(crate) use self::model::ModelArgs;
pub(crate) use self::program::{ProgramCommand, ProgramFile, ProgramReadArgs, ProgramVerifyArgs, ProgramWriteArgs};
pub(crate) use self::record::{RecordArgs, ReplayArgs, TimingArg, WritesArg};
pub(crate) use self::scan::{DiscoverArgs, ScanArgs};
pub(crate) use self::sections::with_sections;
pub(crate) use self::shell::{CompletionsArgs, ManArgs};
pub(crate) use self::sim::{SimArgs, model as sim_model};
pub(crate) use self::top::TopArgs;
pub(crate) use self::watch::WatchArgs;
use crate::failure::Failure;
use crate::output::FormatArg;
use crate::targets::PlantArgs;
use crate::{complete, duration};

/// Command line client for FATEK / FACON PLCs, with a simulator and a frame decoder
///
/// `fatek @NAME COMMAND` takes link and station of a PLC of --config. Data goes to stdout, messages to
/// stderr. `program write`, `restore`, `top`, `doctor --write` and `replay --writes send` ask for confirmation.
/// All other commands that change a PLC act at once.
#[derive(Debug, Parser)]
#[command(version, after_help = AFTER_HELP, after_long_help = AFTER_LONG_HELP)]
pub(crate) struct Cli {
    #[command(flatten)]
    pub(crate) plc: DefaultPlc,
    #[command(flatten)]
    pub(crate) plant: PlantArgs,
    #[command(flatten)]
    pub(crate) common: Common,
    #[command(subcommand)]
    pub(crate) command: Command,
}

const AFTER_HELP: &str = "See `fatek --help` for links, tags, exit statuses and examples.";

const AFTER_LONG_HELP: &str = "\
Links:
  tcp://HOST[:PORT][?framing=ascii|binary]
  udp://HOST[:PORT][?framing=ascii|binary]
  serial:PATH[?baud=9600&frame=7E1&framing=ascii|binary]
    RS-485 driver switched by RTS: rs485=rts or rs485=rts-inverted
    Lines of the port: dtr=on|off, rts=on|off
  Default framing: ascii. The M series needs binary.
  Default port: 500 with ascii; with binary the port is required.

Tags:
  M100           discrete, on or off (X Y M S T C)
  R5             16-bit register, unsigned (R D F RT RC WX WY WM WS WT WC)
  DR2            32-bit register, unsigned (DR DD DF DRT DRC DWX DWY DWM DWS
                 DWT DWC)
  DRC200         32-bit counter (DRC200 to DRC255; there is no RC200)
  R0-R9          range, both ends included; DRC200-DRC205 is six counters
  R5:i16         type: bool, u16, i16, u32, i32, f32, u64, i64, f64,
                 bcd16, bcd32, hex, text;
                 with -hi the high word or byte first: f32-hi, text-hi;
                 also float, double, int, dint, word and the like
  R100:f32       32-bit value in two 16-bit registers, R100 the low word
  R5:i16*0.1-40  scaled number: gain, offset, or both
  R0-R9:text     text in up to 64 registers, two characters each, low byte
                 first; text-hi: high byte first

Times:
  500ms, 2s, 1.5s, 10m, 2h: number and unit, at most 24h

Exit status:
  0  success
  1  file or output error, or no confirmation
  2  usage error: nothing was sent
  3  error code from the PLC; read and backup: also for a part
  4  timeout: no reply; scan and detect: from no station or module;
     detect: the line is busy; doctor: the PLC fell silent
  5  no connection, or lost
  6  bad reply; scan: also from one station of several; decode: bad frame
  7  file damaged or of another PLC, or contents, values or replies differ;
     doctor: an assumption is contradicted
  129, 130, 143  ended by SIGHUP, by SIGINT (Ctrl-C), or by SIGTERM; watch,
     top, sim, record and replay --listen end with 0

Examples:
  fatek sim --listen tcp://127.0.0.1:5000 --set R0=5
  fatek --link tcp://192.168.2.3 --station 1 read R0-R9 R100:f32 M0-M7
  fatek --link tcp://192.168.2.3 --station 1 write R0=5 DR2:i32=-7 M0-M2=1,0,1
  export FATEK_LINK=tcp://192.168.2.3 FATEK_STATION=1
  fatek status
  fatek read R0-R9 --format json
  fatek --config plant.toml @mixer read level
  fatek --config plant.toml @all top
  fatek program read pump.program
  fatek backup plant.backup R0-R3839 M0-M1911
  fatek scan 1-16
  fatek scan --network 192.168.1.0/24
  fatek detect /dev/ttyUSB0
  fatek plan R0-R9 R900 --baud 9600
  fatek decode 02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03
  fatek record --listen tcp://127.0.0.1:5000 mixer.recording
  fatek replay mixer.recording --listen tcp://127.0.0.1:5000";

/// Options of every subcommand, accepted before and after its name.
#[derive(Debug, Args)]
#[command(next_help_heading = "Common options")]
pub(crate) struct Common {
    /// Output format [default: table]
    ///
    /// csv-safe puts ' before cells that begin with = + - @ tab CR or LF and are no numbers, so that a
    /// spreadsheet does not run them as formulas. A terminal shows control characters as escapes.
    #[arg(long, global = true, value_enum, value_name = "FORMAT")]
    pub(crate) format: Option<FormatArg>,
    /// Response and connection timeout, up to 24h [default: 1s, serial line 300ms; connection 3s]
    ///
    /// Reads are sent up to three times, all other requests once. `ping` sends every request once;
    /// `scan` has a default of its own.
    #[arg(long, global = true, value_parser = duration::parse_positive, value_name = "TIME")]
    pub(crate) timeout: Option<Duration>,
    /// No progress and no summary on stderr; errors are printed
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Log on stderr: -v debug, -vv trace [default: by RUST_LOG]
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub(crate) verbose: u8,
}

/// PLC given before the subcommand or by the environment.
///
/// The texts are parsed on use: `fatek decode` works with a bad `FATEK_STATION`.
#[derive(Debug, Args)]
pub(crate) struct DefaultPlc {
    /// Link to the PLC, such as tcp://192.168.2.3:500; read, watch and top: repeat for several PLCs
    #[arg(long = "link", env = "FATEK_LINK", hide_env_values = true, value_name = "URL")]
    #[arg(add = ArgValueCompleter::new(complete::links))]
    links: Vec<String>,
    /// Station number, 1 to 254 (`sim` has an option of its own)
    #[arg(long, env = "FATEK_STATION", hide_env_values = true, value_name = "N")]
    station: Option<String>,
    /// Capabilities of the PLC: a file of `fatek probe --format json`
    #[arg(long, env = "FATEK_CAPABILITIES", hide_env_values = true, value_name = "FILE")]
    capabilities: Option<String>,
}

impl DefaultPlc {
    /// Merges the options given after the subcommand, which have precedence. An empty variable
    /// counts as unset.
    pub(crate) fn or(&self, plc: &Plc) -> Plc {
        let first = |plc: &Option<String>, default: &Option<String>| {
            plc.clone().or_else(|| default.clone()).filter(|text| !text.is_empty())
        };
        let links = if plc.links.is_empty() { &self.links } else { &plc.links };
        // An empty one among several is no link, and is refused as such.
        let is_unset = matches!(&links[..], [only] if only.is_empty());
        Plc {
            links: if is_unset { Vec::new() } else { links.clone() },
            station: first(&plc.station, &self.station),
            capabilities: first(&plc.capabilities, &self.capabilities),
        }
    }

    /// Link and capabilities of a plan.
    pub(crate) fn of_plan(&self, plan: &PlanArgs) -> Plc {
        let (links, capabilities) = (plan.link.links.clone(), plan.capabilities.clone());
        self.or(&Plc { links, station: None, capabilities })
    }

    /// Link alone, for commands without a single station.
    pub(crate) fn link(&self, own: &LinkArgs) -> Result<Option<String>, Failure> {
        let plc = self.or(&Plc { links: own.links.clone(), station: None, capabilities: None });
        plc.link().map(|link| link.map(str::to_owned))
    }
}

/// Link and station of one PLC; of several for commands that take them.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "PLC")]
pub(crate) struct Plc {
    /// Link to the PLC, such as tcp://192.168.2.3:500; read, watch and top: repeat for several PLCs
    /// [env: FATEK_LINK=]
    #[arg(long = "link", value_name = "URL", add = ArgValueCompleter::new(complete::links))]
    pub(crate) links: Vec<String>,
    /// Station number, 1 to 254; read, watch and top: also a list such as 1-4,9 [env: FATEK_STATION=]
    #[arg(long, value_name = "N")]
    pub(crate) station: Option<String>,
    /// Capabilities of the PLC: a file of `fatek probe --format json` [env: FATEK_CAPABILITIES=]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(crate) capabilities: Option<String>,
}

impl Plc {
    /// Its link, for a command that takes one PLC.
    pub(crate) fn link(&self) -> Result<Option<&str>, Failure> {
        match &self.links[..] {
            [] => Ok(None),
            [link] => Ok(Some(link)),
            several => Err(Failure::Usage(format!("this command takes one PLC, not {} links", several.len()))),
        }
    }
}

impl fmt::Display for Plc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = |text: &Option<String>| text.clone().unwrap_or_default();
        write!(f, "station {} on {}", text(&self.station), self.links.join(", "))
    }
}

/// Link of several stations.
#[derive(Debug, Args)]
#[command(next_help_heading = "PLC")]
pub(crate) struct LinkArgs {
    /// Link to the stations, such as tcp://192.168.2.3:500 [env: FATEK_LINK=]
    #[arg(long = "link", value_name = "URL", add = ArgValueCompleter::new(complete::links))]
    links: Vec<String>,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    Sim(SimArgs),
    Read(ReadArgs),
    Write(WriteArgs),
    /// Print status and memory sizes of the PLC
    Status(PlcArgs),
    /// Start the program of the PLC (RUN)
    Run(PlcArgs),
    /// Stop the program of the PLC (STOP)
    Stop(PlcArgs),
    /// Enable discretes: the program or the input controls them again
    Enable(DiscreteArgs),
    /// Disable discretes: they keep a forced state
    ///
    /// It is independent of the program and the input.
    Disable(DiscreteArgs),
    /// Set discretes on
    Set(DiscreteArgs),
    /// Set discretes off
    Reset(DiscreteArgs),
    Forced(ForcedArgs),
    Ping(PingArgs),
    Watch(WatchArgs),
    Top(TopArgs),
    Scan(ScanArgs),
    Ports(PortsArgs),
    Detect(DetectArgs),
    Plan(PlanArgs),
    /// Upload, download and verify the user program of a PLC
    #[command(subcommand)]
    Program(ProgramCommand),
    Backup(BackupArgs),
    Restore(RestoreArgs),
    Clock(ClockArgs),
    Probe(ProbeArgs),
    Doctor(DoctorArgs),
    Decode(DecodeArgs),
    Record(RecordArgs),
    Replay(ReplayArgs),
    Completions(CompletionsArgs),
    Man(ManArgs),
}

#[derive(Debug, Args)]
pub(crate) struct PlcArgs {
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Options of commands that ask for confirmation.
#[derive(Debug, Args)]
pub(crate) struct Consent {
    /// No confirmation prompt
    #[arg(short, long)]
    pub(crate) yes: bool,
    /// Dry run: print what would be written, change nothing
    #[arg(short = 'n', long)]
    pub(crate) dry_run: bool,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;
    use fatek::link::defaults;

    use super::Cli;
    use crate::scan;

    fn check(command: &clap::Command) {
        for text in [command.get_after_help(), command.get_after_long_help()].into_iter().flatten() {
            for line in text.to_string().lines() {
                assert!(line.len() <= 80, "{}: {line}", command.get_name());
            }
        }
        command.get_subcommands().for_each(check);
    }

    /// Help of the option with this name.
    fn help(command: &clap::Command, name: &str) -> String {
        let argument = command.get_arguments().find(|argument| argument.get_id() == name).expect("the option");
        argument.get_help().expect("a help text").to_string()
    }

    // The texts repeat the constants, so that they can be read in the source.
    #[test]
    fn the_help_states_the_default_timeouts_of_the_library() {
        let time = humantime::format_duration;
        let expected = format!(
            "[default: {}, serial line {}; connection {}]",
            time(defaults::RESPONSE_TIMEOUT),
            time(defaults::SERIAL_RESPONSE_TIMEOUT),
            time(defaults::CONNECT_TIMEOUT)
        );
        let text = help(&Cli::command(), "timeout");
        assert!(text.contains(&expected), "`{text}` should say: {expected}");
    }

    #[test]
    fn the_help_states_the_number_of_attempts_and_the_timeout_of_scan() {
        let command = Cli::command();
        let timeout = command.get_arguments().find(|argument| argument.get_id() == "timeout").expect("the option");
        let attempts = ["once", "twice", "three times", "four times"][usize::try_from(defaults::RETRIES).unwrap()];
        let text = timeout.get_long_help().expect("a long help").to_string();
        assert!(text.contains(&format!("up to {attempts}")), "{text}");

        let scan = command.find_subcommand("scan").expect("the subcommand");
        let seconds = (scan::DEFAULT_TIMEOUT * 254).as_secs_f64().ceil();
        let expected = format!(
            "A line: the default of --timeout is {}: all 254 stations take up to {seconds} s.",
            humantime::format_duration(scan::DEFAULT_TIMEOUT)
        );
        let text = scan.get_after_help().expect("examples").to_string();
        assert!(text.contains(&expected), "{text} should say: {expected}");
        let expected = format!(
            "Networks: the default of --timeout is {}, of a connection {}s, and stations\n{} to {} are asked.",
            humantime::format_duration(scan::network::DEFAULT_TIMEOUT),
            scan::network::MIN_CONNECT_TIMEOUT.as_secs_f64(),
            scan::network::DEFAULT_STATIONS.start(),
            scan::network::DEFAULT_STATIONS.end(),
        );
        assert!(text.contains(&expected), "{text} should say: {expected}");
    }

    #[test]
    fn help_texts_fit_80_columns() {
        Cli::command().debug_assert();
        check(&Cli::command());
    }
}
