//! Command line options.

use std::fmt;
use std::time::Duration;

pub(crate) const HELP: &str = "\
Polls simulated PLCs in a second process, and prints the time and memory used.

  --plcs N                  number of PLCs, 1 to 1000000 [default: 1000]
  --interval TIME           poll interval [default: 1s]
  --for TIME                duration of the measurement [default: 60s]
  --connects-per-second N   rate limit of connection attempts [default: 1000; default of a pool: 200]
  --restart-at TIME         time at which the simulator is killed [default: never]
  --down-for TIME           time from the kill to the restart [default: 5s]
  --one-port-each           one TCP port per PLC, not one loopback address [default: off on Linux, else on]

TIME: number and unit, such as 500ms, 2s, 1m or 2h; 1ms to 24h.
";

#[derive(Clone, Debug)]
pub(crate) struct Options {
    pub(crate) plcs: u32,
    pub(crate) interval: Duration,
    pub(crate) run_for: Duration,
    pub(crate) connects_per_second: u32,
    pub(crate) restart_at: Option<Duration>,
    pub(crate) down_for: Duration,
    pub(crate) one_port_each: bool,
    /// Shortest and longest back-off of a link: the defaults.
    pub(crate) backoff: (Duration, Duration),
}

impl Options {
    /// Returns `None` for `--help`.
    pub(crate) fn parse(mut args: impl Iterator<Item = String>) -> Result<Option<Self>, String> {
        let mut options = Self {
            plcs: 1000,
            interval: Duration::from_secs(1),
            run_for: Duration::from_secs(60),
            connects_per_second: 1000,
            restart_at: None,
            down_for: Duration::from_secs(5),
            // All of 127.0.0.0/8 is this machine on Linux.
            one_port_each: !cfg!(target_os = "linux"),
            backoff: (Duration::from_millis(100), Duration::from_secs(30)),
        };
        while let Some(name) = args.next() {
            let mut value = || args.next().ok_or_else(|| format!("{name} needs a value"));
            match name.as_str() {
                "--plcs" => options.plcs = number(&name, &value()?)?,
                "--interval" => options.interval = time(&name, &value()?)?,
                "--for" => options.run_for = time(&name, &value()?)?,
                "--connects-per-second" => options.connects_per_second = number(&name, &value()?)?,
                "--restart-at" => options.restart_at = Some(time(&name, &value()?)?),
                "--down-for" => options.down_for = time(&name, &value()?)?,
                "--one-port-each" => options.one_port_each = true,
                "--help" | "-h" => return Ok(None),
                _ => return Err(format!("unknown option `{name}`")),
            }
        }
        if options.restart_at.is_some_and(|at| at >= options.run_for) {
            return Err("--restart-at must be less than --for".to_owned());
        }
        Ok(Some(options))
    }

    /// Time to open all connections at the rate limit.
    pub(crate) fn connect_time(&self) -> Duration {
        Duration::from_secs_f64(f64::from(self.plcs) / f64::from(self.connects_per_second))
    }

    /// Time limit for all PLCs to answer: rate limit, back-off and one call.
    pub(crate) fn start_timeout(&self) -> Duration {
        self.connect_time().max(self.backoff.1) * 2 + self.interval + Duration::from_secs(20)
    }
}

impl fmt::Display for Options {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plcs, interval, run_for, connects_per_second, .. } = self;
        write!(f, "{plcs} PLCs, poll interval {interval:?}, for {run_for:?}; {connects_per_second} connects/s")
    }
}

fn number(name: &str, text: &str) -> Result<u32, String> {
    match text.parse() {
        // The addresses of the PLCs are 127.1.0.0 and up.
        Ok(number @ 1..=1_000_000) => Ok(number),
        _ => Err(format!("{name} must be a number from 1 to 1000000, not `{text}`")),
    }
}

fn time(name: &str, text: &str) -> Result<Duration, String> {
    let limits = Duration::from_millis(1)..=Duration::from_secs(24 * 3600);
    match humantime::parse_duration(text) {
        Ok(time) if limits.contains(&time) => Ok(time),
        Ok(_) => Err(format!("{name} must be from 1ms to 24h, not `{text}`")),
        Err(error) => Err(format!("{name} must be a time such as 500ms, 2s or 2h, not `{text}`: {error}")),
    }
}
