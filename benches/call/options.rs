//! Command line options.

use std::time::Duration;

use crate::Setting;
use crate::clients::Way;

pub(crate) const HELP: &str = "\
Measures calls over loopback TCP, compared with a bare write and read and with tokio-modbus.

  --rounds N        number of rounds [default: 41]
  --round-ms N      approximate duration of a round per method, in ms [default: 60]
  --requests N      requests per caller and round [default: by --round-ms]
  --runtime NAME    runtime: current_thread or multi_thread [default: both]
  --setting L,C     setting: L links with C callers each, such as 64,1 [default: all]
  --way NAME        method; repeat for more [default: all]
  --csv             write docs/performance/call.csv
  --test            test run with a few requests of each method
";

#[derive(Debug)]
pub(crate) struct Options {
    pub(crate) rounds: usize,
    pub(crate) round: Duration,
    pub(crate) requests: Option<usize>,
    pub(crate) csv: bool,
    runtime: Option<String>,
    setting: Option<String>,
    ways: Vec<String>,
}

impl Options {
    /// Returns `None` for `--help`.
    pub(crate) fn parse(mut args: impl Iterator<Item = String>) -> Result<Option<Self>, String> {
        let mut options = Self {
            rounds: 41,
            round: Duration::from_millis(60),
            requests: None,
            csv: false,
            runtime: None,
            setting: None,
            ways: Vec::new(),
        };
        while let Some(name) = args.next() {
            let mut value = || args.next().ok_or_else(|| format!("{name} needs a value"));
            match name.as_str() {
                "--rounds" => options.rounds = number(&name, &value()?)?,
                "--round-ms" => options.round = Duration::from_millis(number(&name, &value()?)? as u64),
                "--requests" => options.requests = Some(number(&name, &value()?)?),
                "--runtime" => options.runtime = Some(value()?),
                "--setting" => options.setting = Some(value()?),
                "--way" => options.ways.push(value()?),
                "--csv" => options.csv = true,
                "--test" => (options.rounds, options.requests) = (2, Some(1)),
                // Given by Cargo.
                "--bench" => {}
                "--help" | "-h" => return Ok(None),
                _ => return Err(format!("unknown option `{name}`")),
            }
        }
        match options.ways.iter().find(|name| !Way::ALL.iter().any(|way| way.name() == *name)) {
            Some(unknown) => Err(format!("unknown method `{unknown}`")),
            None => Ok(Some(options)),
        }
    }

    pub(crate) fn selects(&self, runtime: &str, setting: Setting) -> bool {
        let Setting { links, callers } = setting;
        self.runtime.as_deref().is_none_or(|only| only == runtime)
            && self.setting.as_deref().is_none_or(|only| only == format!("{links},{callers}"))
    }

    pub(crate) fn selects_way(&self, way: Way) -> bool {
        self.ways.is_empty() || self.ways.iter().any(|name| name == way.name())
    }
}

fn number(name: &str, text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(number @ 1..=100_000) => Ok(number),
        _ => Err(format!("{name} must be a number from 1 to 100000, not `{text}`")),
    }
}
