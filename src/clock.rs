//! The clock of a PLC: date, time and weekday in R4128 to R4134.
//!
//! [`Station::read_clock`](crate::Station::read_clock) reads it and
//! [`Station::set_clock`](crate::Station::set_clock) sets it.
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::clock::Clock;
//!
//! let clock = Clock::new((26, 11, 29), (6, 30, 0), 0)?;
//! station.set_clock(&clock).await?;
//! assert_eq!(station.read_clock().await?.to_string(), "2026-11-29 06:30:00 weekday 0");
//! # Ok(()) });
//! ```
//!
//! The PLC knows neither time zone nor summer time. Years are 0 to 99; here they are 2000 to 2099 for
//! leap years. The manual at hand has weekdays 0 to 6 and does not say which day is 0, so a weekday is
//! a number that is neither computed from the date nor compared with it.
//!
//! Source: FBs manual, chapter on the clock: R4128 to R4134, M1952 to M1955.

use std::fmt;

use crate::element::{Discrete, Register};
use crate::{discrete, register};

/// Second, minute, hour, day, month, year and weekday, in this order.
pub(crate) const CLOCK_REGISTERS: Register = register!("R4128");
pub(crate) const CLOCK_LEN: usize = 7;
/// 1 lets the clock registers be set.
pub(crate) const CLOCK_SETTABLE: Discrete = discrete!("M1952");
/// 1 if there is a clock.
pub(crate) const CLOCK_PRESENT: Discrete = discrete!("M1954");
/// 1 if a value that was set is wrong.
pub(crate) const CLOCK_WRONG: Discrete = discrete!("M1955");

/// Date, time and weekday of a PLC's clock. All parts are in their ranges.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Clock {
    year: u8,
    month: u8,
    day: u8,
    hour: u8,
    minute: u8,
    second: u8,
    weekday: u8,
}

/// Error: a part of a date or time is out of its range.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{part} {value} of a clock is out of the range {min} to {max}")]
#[non_exhaustive]
pub struct InvalidClock {
    /// The part: year, month, day, hour, minute, second or weekday.
    pub part: &'static str,
    /// Its value.
    pub value: u16,
    /// The lowest value allowed.
    pub min: u16,
    /// The highest value allowed, for a day that of its month.
    pub max: u16,
}

/// The reason why a clock cannot be read or was not set.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum ClockFailure {
    /// M1954 is 0: the PLC has no clock. Nothing was written.
    Missing,
    /// The clock registers do not hold a date and a time. Nothing was written by a read.
    Invalid(InvalidClock),
    /// M1955 is 1 after the clock was set: the PLC takes the value for wrong.
    Refused,
    /// The clock does not have the time, within a minute, that was written.
    #[non_exhaustive]
    Differs {
        /// The time that was written.
        written: Clock,
        /// The time that was read then.
        found: Clock,
    },
    /// A request failed after M1952 was set to 1. The clock may be set or not, and M1952 may still be 1.
    #[non_exhaustive]
    Interrupted {
        /// The error of the request.
        source: Box<crate::Error>,
    },
}

impl ClockFailure {
    /// Returns whether the clock can have been set.
    #[must_use]
    pub fn may_have_executed(&self) -> bool {
        match self {
            Self::Missing | Self::Invalid(_) => false,
            Self::Refused | Self::Differs { .. } | Self::Interrupted { .. } => true,
        }
    }

    /// The error of the request that failed, if that is the reason.
    #[must_use]
    pub fn call_error(&self) -> Option<&crate::Error> {
        if let Self::Interrupted { source } = self { Some(source) } else { None }
    }
}

impl Clock {
    /// A clock of year (0 to 99), month and day, of hour (0 to 23), minute and second, and of a
    /// weekday (0 to 6).
    ///
    /// # Errors
    /// [`InvalidClock`] names the first part that is out of its range. The days of February follow
    /// from the years 2000 to 2099.
    pub fn new(date: (u8, u8, u8), time: (u8, u8, u8), weekday: u8) -> Result<Self, InvalidClock> {
        let ((year, month, day), (hour, minute, second)) = (date, time);
        Self::from_registers([second, minute, hour, day, month, year, weekday].map(u16::from))
    }

    /// The clock of the registers R4128 to R4134: second, minute, hour, day, month, year, weekday.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn from_registers(registers: [u16; CLOCK_LEN]) -> Result<Self, InvalidClock> {
        let [second, minute, hour, day, month, year, weekday] = registers;
        let year = part("year", year, 0, 99)?;
        let month = part("month", month, 1, 12)?;
        Ok(Self {
            year,
            month,
            day: part("day", day, 1, days_of(year, month))?,
            hour: part("hour", hour, 0, 23)?,
            minute: part("minute", minute, 0, 59)?,
            second: part("second", second, 0, 59)?,
            weekday: part("weekday", weekday, 0, 6)?,
        })
    }

    /// The contents of the registers R4128 to R4134.
    #[must_use]
    pub fn to_registers(&self) -> [u16; CLOCK_LEN] {
        let Self { year, month, day, hour, minute, second, weekday } = *self;
        [second, minute, hour, day, month, year, weekday].map(u16::from)
    }

    /// The time after a number of seconds since 2000-01-01 00:00:00, with this weekday; `None` after
    /// 2099 and for a weekday above 6.
    ///
    /// There are no leap seconds. Of a Unix time, subtract 946684800.
    #[must_use]
    pub fn from_seconds_since_2000(seconds: u64, weekday: u8) -> Option<Self> {
        let (mut days, seconds) = (seconds / 86_400, seconds % 86_400);
        let mut date = (0_u8, 1_u8);
        while days >= u64::from(days_of(date.0, date.1)) {
            days = days.saturating_sub(days_of(date.0, date.1).into());
            date = if date.1 == 12 { (date.0.saturating_add(1), 1) } else { (date.0, date.1.saturating_add(1)) };
            if date.0 > 99 {
                return None;
            }
        }
        let small = |number: u64| u8::try_from(number).ok();
        let day = small(days.saturating_add(1))?;
        let time = (small(seconds / 3600)?, small(seconds / 60 % 60)?, small(seconds % 60)?);
        Self::new((date.0, date.1, day), time, weekday).ok()
    }

    /// The seconds since 2000-01-01 00:00:00, without leap seconds.
    #[must_use]
    pub fn seconds_since_2000(&self) -> u64 {
        let months = (0..=self.year).flat_map(|year| (1..=12).map(move |month| (year, month)));
        let before = months.take_while(|&month| month < (self.year, self.month));
        let days: u64 = before.map(|(year, month)| u64::from(days_of(year, month))).sum();
        let days = days.saturating_add(u64::from(self.day)).saturating_sub(1);
        let hours = days.saturating_mul(24).saturating_add(self.hour.into());
        let minutes = hours.saturating_mul(60).saturating_add(self.minute.into());
        minutes.saturating_mul(60).saturating_add(self.second.into())
    }

    /// The year, 0 to 99.
    #[must_use]
    pub fn year(&self) -> u8 {
        self.year
    }

    /// The month, 1 to 12.
    #[must_use]
    pub fn month(&self) -> u8 {
        self.month
    }

    /// The day of the month, from 1.
    #[must_use]
    pub fn day(&self) -> u8 {
        self.day
    }

    /// The hour, 0 to 23.
    #[must_use]
    pub fn hour(&self) -> u8 {
        self.hour
    }

    /// The minute, 0 to 59.
    #[must_use]
    pub fn minute(&self) -> u8 {
        self.minute
    }

    /// The second, 0 to 59.
    #[must_use]
    pub fn second(&self) -> u8 {
        self.second
    }

    /// The weekday, 0 to 6. No manual at hand says which day is 0.
    #[must_use]
    pub fn weekday(&self) -> u8 {
        self.weekday
    }
}

impl fmt::Display for Clock {
    /// `2026-11-29 06:30:00 weekday 0`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { year, month, day, hour, minute, second, weekday } = self;
        write!(f, "20{year:02}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02} weekday {weekday}")
    }
}

impl fmt::Display for ClockFailure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing => write!(f, "the PLC has no clock: {CLOCK_PRESENT} is 0"),
            Self::Invalid(invalid) => write!(f, "the clock registers hold no time: {invalid}"),
            Self::Refused => write!(f, "the PLC takes the time for wrong: {CLOCK_WRONG} is 1"),
            Self::Differs { written, found } => write!(f, "the clock was set to {written}, and has {found}"),
            Self::Interrupted { source } => {
                write!(f, "the clock may be set or not, and {CLOCK_SETTABLE} may still be 1: {source}")
            }
        }
    }
}

/// The days of a month, 1 to 12.
fn days_of(year: u8, month: u8) -> u16 {
    match month {
        4 | 6 | 9 | 11 => 30,
        2 if year.is_multiple_of(4) => 29,
        2 => 28,
        _ => 31,
    }
}

fn part(part: &'static str, value: u16, min: u16, max: u16) -> Result<u8, InvalidClock> {
    let checked = u8::try_from(value).ok().filter(|_| (min..=max).contains(&value));
    checked.ok_or(InvalidClock { part, value, min, max })
}

// The registers are read in one request, so in one scan cycle.
const _: () = assert!(CLOCK_LEN <= crate::command::MAX_UNITS);

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn each_part_has_its_range() {
        let error = |date, time, weekday| Clock::new(date, time, weekday).unwrap_err().to_string();
        assert_eq!(error((100, 1, 1), (0, 0, 0), 0), "year 100 of a clock is out of the range 0 to 99");
        assert_eq!(error((0, 0, 1), (0, 0, 0), 0), "month 0 of a clock is out of the range 1 to 12");
        assert_eq!(error((0, 13, 1), (0, 0, 0), 0), "month 13 of a clock is out of the range 1 to 12");
        assert_eq!(error((23, 4, 31), (0, 0, 0), 0), "day 31 of a clock is out of the range 1 to 30");
        assert_eq!(error((23, 2, 29), (0, 0, 0), 0), "day 29 of a clock is out of the range 1 to 28");
        assert_eq!(error((0, 1, 0), (0, 0, 0), 0), "day 0 of a clock is out of the range 1 to 31");
        assert_eq!(error((0, 1, 1), (24, 0, 0), 0), "hour 24 of a clock is out of the range 0 to 23");
        assert_eq!(error((0, 1, 1), (0, 60, 0), 0), "minute 60 of a clock is out of the range 0 to 59");
        assert_eq!(error((0, 1, 1), (0, 0, 60), 0), "second 60 of a clock is out of the range 0 to 59");
        assert_eq!(error((0, 1, 1), (0, 0, 0), 7), "weekday 7 of a clock is out of the range 0 to 6");
        assert!(Clock::new((24, 2, 29), (23, 59, 59), 6).is_ok() && Clock::new((0, 2, 29), (0, 0, 0), 0).is_ok());
    }

    #[test]
    fn a_register_above_a_byte_is_out_of_range() {
        assert_eq!(Clock::from_registers([256, 0, 0, 1, 1, 0, 0]).map_err(|error| error.value), Err(256));
    }

    #[test]
    fn registers_are_in_the_order_of_the_manual() {
        let clock = Clock::new((26, 11, 29), (6, 30, 15), 3).unwrap();
        assert_eq!(clock.to_registers(), [15, 30, 6, 29, 11, 26, 3]);
    }

    #[test]
    fn known_times_have_their_seconds() {
        // date -u -d 2026-11-29T06:30:15Z +%s: 1795933815
        let clock = Clock::new((26, 11, 29), (6, 30, 15), 3).unwrap();
        assert_eq!(clock.seconds_since_2000(), 1_795_933_815 - 946_684_800);
        assert_eq!(Clock::new((0, 1, 1), (0, 0, 0), 0).unwrap().seconds_since_2000(), 0);
        let last = Clock::new((99, 12, 31), (23, 59, 59), 0).unwrap();
        assert_eq!(Clock::from_seconds_since_2000(last.seconds_since_2000(), 0), Some(last));
        assert_eq!(Clock::from_seconds_since_2000(last.seconds_since_2000() + 1, 0), None);
        assert_eq!(Clock::from_seconds_since_2000(u64::MAX, 0), None);
    }

    proptest! {
        #[test]
        fn seconds_and_registers_come_back(seconds in 0_u64..3_155_760_000, weekday in 0_u8..=6) {
            let clock = Clock::from_seconds_since_2000(seconds, weekday).unwrap();
            prop_assert_eq!(clock.seconds_since_2000(), seconds);
            prop_assert_eq!(Clock::from_registers(clock.to_registers()), Ok(clock));
        }
    }
}
