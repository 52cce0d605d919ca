//! Subcommand `fatek clock`.

use std::time::SystemTime;

use fatek::{Clock, Station};

use crate::args::ClockArgs;
use crate::failure::Failure;
use crate::output::{Output, Rows};
use crate::printable::excerpt;

pub(crate) async fn clock(station: &Station, args: &ClockArgs, output: &Output) -> Result<(), Failure> {
    if let Some(time) = &args.set {
        let seconds = seconds(time)?;
        let weekday = match args.weekday {
            Some(weekday) => weekday,
            None => following_weekday(station, seconds).await?,
        };
        let clock = Clock::from_seconds_since_2000(seconds, weekday);
        let clock = clock.ok_or_else(out_of_years)?;
        station.set_clock(&clock).await?;
        output.remark(format_args!("the clock was set to {clock}"));
        return Ok(());
    }
    let clock = station.read_clock().await?;
    let mut rows = Rows::new(["time", "weekday"]);
    let text = clock.to_string();
    let time = text.split_once(" weekday").map_or(text.as_str(), |(time, _)| time);
    rows.push([time.into(), u16::from(clock.weekday()).into()]);
    output.rows(&rows)
}

/// The clock of a simulated PLC: the weekday 0 is a Sunday.
pub(crate) fn simulated(time: &str) -> Result<Clock, Failure> {
    const DAY: u64 = 86_400;
    const WEEKDAY_OF_2000: u64 = 6;
    let seconds = seconds(time)?;
    // Below 7.
    let weekday = ((seconds / DAY + WEEKDAY_OF_2000) % 7) as u8;
    Clock::from_seconds_since_2000(seconds, weekday).ok_or_else(out_of_years)
}

fn out_of_years() -> Failure {
    Failure::Usage("the years of a clock are 2000 to 2099".to_owned())
}

/// Seconds since 2000 of `now` in UTC, or of a date and a time without time zone.
fn seconds(text: &str) -> Result<u64, Failure> {
    const UNIX_TIME_OF_2000: u64 = 946_684_800;
    let time = if text == "now" {
        SystemTime::now()
    } else {
        humantime::parse_rfc3339_weak(text).map_err(|error| {
            Failure::Usage(format!("`{}` is not a time such as 2026-11-29T06:30:00: {error}", excerpt(text)))
        })?
    };
    let since_1970 = time.duration_since(SystemTime::UNIX_EPOCH).ok();
    let seconds = since_1970.and_then(|time| time.as_secs().checked_sub(UNIX_TIME_OF_2000));
    seconds.ok_or_else(out_of_years)
}

/// The weekday of a day as the clock of the PLC counts it: no manual says which day is 0.
async fn following_weekday(station: &Station, seconds: u64) -> Result<u8, Failure> {
    const DAY: u64 = 86_400;
    let now = station.read_clock().await?;
    let days = (seconds / DAY + 7 - now.seconds_since_2000() / DAY % 7 + u64::from(now.weekday())) % 7;
    // Below 7.
    Ok(days as u8)
}
