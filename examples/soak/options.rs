//! Command line options.

use std::fmt;
use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

use crate::layout::{MAX_CALLERS, MAX_LINES, MAX_STATIONS};

pub(crate) const HELP: &str = "\
Soak test: puts load on links to simulated PLCs over real sockets and pseudo-terminals, with all faults, and checks
every value.

  --for TIME       duration [default: 30m]
  --seed N         seed of all random choices [default: random]
  --links N        number of lines, 1 to 16, each with a link: TCP, serial and UDP in both framings [default: 8]
  --stations N     PLCs per line, 2 to 31 [default: 16]
  --callers N      callers per line, 1 to 8 [default: 4]
  --guests N       callers with pools of their own, which call all TCP lines, 0 to 8 [default: 4]
  --pause TIME     mean pause between two calls of a caller [default: 20ms]
  --report TIME    interval of the printed figures [default: 1m]

TIME: number and unit, such as 500ms, 10s, 30m or 2h; 1ms to 7d. The exit status is 1 after a wrong value, a lost or
repeated write, a hang, growth or a leak.
";

#[derive(Clone, Debug)]
pub(crate) struct Options {
    pub(crate) run_for: Duration,
    pub(crate) seed: u64,
    pub(crate) links: usize,
    pub(crate) stations: usize,
    pub(crate) callers: usize,
    pub(crate) guests: usize,
    pub(crate) pause: Duration,
    pub(crate) report: Duration,
}

impl Options {
    /// Returns `None` for `--help`.
    pub(crate) fn parse(mut args: impl Iterator<Item = String>) -> Result<Option<Self>, String> {
        let mut options = Self {
            run_for: Duration::from_secs(30 * 60),
            seed: RandomState::new().hash_one(0) >> 32,
            links: 8,
            stations: 16,
            callers: 4,
            guests: 4,
            pause: Duration::from_millis(20),
            report: Duration::from_secs(60),
        };
        while let Some(name) = args.next() {
            let mut value = || args.next().ok_or_else(|| format!("{name} needs a value"));
            match name.as_str() {
                "--for" => options.run_for = time(&name, &value()?)?,
                "--seed" => options.seed = number(&name, &value()?, u64::MAX)?,
                "--links" => options.links = count(&name, &value()?, 1, MAX_LINES)?,
                "--stations" => options.stations = count(&name, &value()?, 2, MAX_STATIONS)?,
                "--callers" => options.callers = count(&name, &value()?, 1, MAX_CALLERS / 2)?,
                "--guests" => options.guests = count(&name, &value()?, 0, MAX_CALLERS / 2)?,
                "--pause" => options.pause = time(&name, &value()?)?,
                "--report" => options.report = time(&name, &value()?)?,
                "--help" | "-h" => return Ok(None),
                _ => return Err(format!("unknown option `{name}`")),
            }
        }
        Ok(Some(options))
    }
}

impl fmt::Display for Options {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { run_for, seed, links, stations, callers, guests, .. } = self;
        write!(
            f,
            "{links} lines of {stations} stations, {callers} callers each and {guests} guests, for {run_for:?}; \
             --seed {seed}: same faults, other times of events"
        )
    }
}

fn number(name: &str, text: &str, max: u64) -> Result<u64, String> {
    let number = text.parse().ok().filter(|&number| number <= max);
    number.ok_or_else(|| format!("{name} must be a number up to {max}, not `{text}`"))
}

fn count(name: &str, text: &str, min: usize, max: usize) -> Result<usize, String> {
    let number = text.parse().ok().filter(|number| (min..=max).contains(number));
    number.ok_or_else(|| format!("{name} must be a number from {min} to {max}, not `{text}`"))
}

fn time(name: &str, text: &str) -> Result<Duration, String> {
    let limits = Duration::from_millis(1)..=Duration::from_secs(7 * 24 * 3600);
    match humantime::parse_duration(text) {
        Ok(time) if limits.contains(&time) => Ok(time),
        Ok(_) => Err(format!("{name} must be from 1ms to 7d, not `{text}`")),
        Err(error) => Err(format!("{name} must be a time such as 500ms, 10s or 2h, not `{text}`: {error}")),
    }
}
