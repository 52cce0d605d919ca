//! The command line.

use std::fmt;
use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

use crate::layout::{MAX_CALLERS, MAX_LINES, MAX_STATIONS};

pub(crate) const HELP: &str = "\
Puts load on links to simulated PLCs, over real sockets and pseudo-terminals and with faults of every kind, and compares
every value with what that PLC may hold.

  --for TIME       for how long [default: 30m]
  --seed N         what everything depends on that is left to chance [default: another one each time]
  --links N        how many lines there are, each with a link: TCP, serial and UDP in both framings [default: 8]
  --stations N     how many PLCs each has [default: 16]
  --callers N      how many callers each has [default: 4]
  --guests N       how many callers come by pools of their own to all TCP lines in turn [default: 4]
  --pause TIME     how long a caller pauses between two calls, on average [default: 20ms]
  --report TIME    how often a line of figures is printed [default: 1m]

Times are such as 500ms, 10s or 30m. The exit status is 1 after a wrong value, a lost or repeated write, a hang, growth or
a leak.
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
    /// `None`: help is wanted.
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
                _ => return Err(format!("`{name}` is not known")),
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
             --seed {seed} has the same faults planned, but not the same moments: time is real"
        )
    }
}

fn number(name: &str, text: &str, most: u64) -> Result<u64, String> {
    let number = text.parse().ok().filter(|&number| number <= most);
    number.ok_or_else(|| format!("{name} must be a number up to {most}, not `{text}`"))
}

fn count(name: &str, text: &str, least: usize, most: usize) -> Result<usize, String> {
    let number = text.parse().ok().filter(|number| (least..=most).contains(number));
    number.ok_or_else(|| format!("{name} must be a number from {least} to {most}, not `{text}`"))
}

fn time(name: &str, text: &str) -> Result<Duration, String> {
    let unit_at = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let millis_per_unit = match unit {
        "ms" => 1,
        "s" => 1_000,
        "m" => 60_000,
        "h" => 3_600_000,
        _ => return Err(format!("{name} must be a time such as 500ms, 10s or 30m, not `{text}`")),
    };
    let millis = number.parse::<u64>().ok().and_then(|number| number.checked_mul(millis_per_unit));
    match millis {
        Some(millis @ 1..=604_800_000) => Ok(Duration::from_millis(millis)),
        _ => Err(format!("{name} must be from 1ms to a week, not `{text}`")),
    }
}
