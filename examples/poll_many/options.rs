//! The command line.

use std::fmt;
use std::time::Duration;

pub(crate) const HELP: &str = "\
Polls simulated PLCs, which run in a second process, and says what that costs.

  --plcs N                  how many PLCs [default: 1000]
  --interval TIME           how often each is polled [default: 1s]
  --for TIME                for how long, once all are up [default: 60s]
  --connects-per-second N   how many connections are begun a second [default: 1000; a pool's own: 200]
  --restart-at TIME         then the simulator is killed and started again
  --down-for TIME           after this long [default: 5s]
  --one-port-each           PLCs differ by port and not by loopback address; the default where only 127.0.0.1 is one

Times are such as 500ms, 2s or 1m.
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
    /// The shortest and the longest pause after a failed attempt to connect: the link's own.
    pub(crate) backoff: (Duration, Duration),
}

impl Options {
    /// `None`: help is wanted.
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
                _ => return Err(format!("`{name}` is not known")),
            }
        }
        if options.restart_at.is_some_and(|at| at >= options.run_for) {
            return Err("--restart-at must be before the end, which --for says".to_owned());
        }
        Ok(Some(options))
    }

    /// How long all connections take to be opened at the gate's pace.
    pub(crate) fn start(&self) -> Duration {
        Duration::from_secs_f64(f64::from(self.plcs) / f64::from(self.connects_per_second))
    }

    /// After how long it has failed: the back-off, the gate, and a call.
    pub(crate) fn longest_start(&self) -> Duration {
        self.start().max(self.backoff.1) * 2 + self.interval + Duration::from_secs(20)
    }
}

impl fmt::Display for Options {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plcs, interval, run_for, connects_per_second, .. } = self;
        write!(
            f,
            "{plcs} PLCs, each polled every {interval:?}, for {run_for:?}; {connects_per_second} connects a second"
        )
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
    let unit_at = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let seconds_per_unit = match unit {
        "ms" => 0.001,
        "s" => 1.0,
        "m" => 60.0,
        _ => return Err(format!("{name} must be a time such as 500ms, 2s or 1m, not `{text}`")),
    };
    match number.parse::<f64>() {
        Ok(number) if (0.001..=86_400.0).contains(&(number * seconds_per_unit)) => {
            Ok(Duration::from_secs_f64(number * seconds_per_unit))
        }
        _ => Err(format!("{name} must be from 1ms to a day, not `{text}`")),
    }
}
