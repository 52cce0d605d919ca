//! The clock of a PLC: read and set.

use super::Station;
use crate::clock::{CLOCK_LEN, CLOCK_PRESENT, CLOCK_REGISTERS, CLOCK_SETTABLE, CLOCK_WRONG, Clock, ClockFailure};
use crate::command::{ReadDiscretes, ReadRegisters, WriteDiscretes, WriteRegisters};
use crate::element::Discrete;
use crate::error::Error;

/// The clock.
impl Station {
    /// Reads the clock: M1954 (44), then R4128 to R4134 in one request (46), so of one scan.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let clock = station.read_clock().await?;
    /// println!("{clock}, {} s since 2000", clock.seconds_since_2000());
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// [`Error::Clock`] with [`ClockFailure::Missing`] or [`ClockFailure::Invalid`]; those of
    /// [every method](Self#errors).
    ///
    /// Cancel-safe: it only reads.
    pub async fn read_clock(&self) -> Result<Clock, Error> {
        self.check_clock().await?;
        self.read_clock_registers().await
    }

    /// Sets the clock: M1952 to 1 (45), R4128 to R4134 in one request (47), M1952 to 0, then reads
    /// M1955 and the clock, which must have that time within a minute.
    ///
    /// A PLC without a clock is refused before anything is written. If a request fails after M1952 was
    /// set, or may have been, M1952 is set back once more. No write is retried unless the
    /// [options](crate::CallOptions::with_retry_writes) say so.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.set_clock(&fatek::Clock::new((26, 11, 29), (6, 30, 0), 0)?).await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// [`Error::Clock`]; those of [every method](Self#errors) up to the write of M1952. Its
    /// [`may_have_executed`](Error::may_have_executed) is `true` if the clock may be set.
    ///
    /// # Cancel safety
    /// A dropped future can leave M1952 at 1, with the clock set or not. Calling this again completes
    /// it.
    pub async fn set_clock(&self, clock: &Clock) -> Result<(), Error> {
        self.check_clock().await?;
        if let Err(error) = self.write_settable(true).await {
            // The result of the first error is the one that counts.
            if error.may_have_executed() {
                let _ = self.write_settable(false).await;
            }
            return Err(error);
        }
        let written = self.call(WriteRegisters::new(CLOCK_REGISTERS, clock.to_registers())?).await;
        let ended = self.write_settable(false).await;
        let interrupted = |source| self.clock_error(ClockFailure::Interrupted { source: Box::new(source) });
        written.and(ended).map_err(interrupted)?;
        if self.read_one(CLOCK_WRONG).await.map_err(interrupted)? {
            return Err(self.clock_error(ClockFailure::Refused));
        }
        let found = self.read_clock_registers().await.map_err(interrupted)?;
        let after = found.seconds_since_2000().checked_sub(clock.seconds_since_2000());
        if after.is_none_or(|seconds| seconds > 60) {
            return Err(self.clock_error(ClockFailure::Differs { written: *clock, found }));
        }
        Ok(())
    }

    async fn check_clock(&self) -> Result<(), Error> {
        if self.read_one(CLOCK_PRESENT).await? { Ok(()) } else { Err(self.clock_error(ClockFailure::Missing)) }
    }

    async fn read_one(&self, discrete: Discrete) -> Result<bool, Error> {
        Ok(self.call(ReadDiscretes::new(discrete, 1)?).await?.contains(&true))
    }

    async fn write_settable(&self, on: bool) -> Result<(), Error> {
        self.call(WriteDiscretes::new(CLOCK_SETTABLE, [on])?).await
    }

    async fn read_clock_registers(&self) -> Result<Clock, Error> {
        let values = self.call(ReadRegisters::new(CLOCK_REGISTERS, CLOCK_LEN)?).await?;
        let mut registers = [0; CLOCK_LEN];
        registers.iter_mut().zip(values).for_each(|(register, value)| *register = value);
        Clock::from_registers(registers).map_err(|invalid| self.clock_error(ClockFailure::Invalid(invalid)))
    }

    fn clock_error(&self, failure: ClockFailure) -> Error {
        Error::Clock { station: self.number(), failure: Box::new(failure) }
    }
}

#[cfg(all(test, feature = "sim"))]
mod tests {
    use super::*;
    use crate::command::Value;
    use crate::sim::{self, Change, Fault, Rule};
    use crate::{discrete, register};

    fn clock(second: u8) -> Clock {
        Clock::new((26, 11, 29), (6, 30, second), 3).unwrap()
    }

    fn failure(error: Error) -> ClockFailure {
        match error {
            Error::Clock { failure, .. } => *failure,
            other => panic!("{other}"),
        }
    }

    #[tokio::test(start_paused = true)]
    async fn the_clock_is_set_by_one_write_between_two_of_m1952() {
        let bench = sim::station().await;
        bench.plc.set_clock(Some(clock(0)));
        bench.station.set_clock(&clock(59)).await.unwrap();
        assert_eq!((bench.plc.clock(), bench.station.read_clock().await.unwrap()), (Some(clock(59)), clock(59)));
        let registers = clock(59).to_registers();
        let values =
            registers.iter().enumerate().map(|(n, &value)| Change::value(CLOCK_REGISTERS.nth(n).unwrap(), value));
        let mut changes = vec![Change::value(CLOCK_SETTABLE, true)];
        changes.extend(values);
        changes.push(Change::value(CLOCK_SETTABLE, false));
        assert_eq!(bench.log().changes(1), changes);
    }

    #[tokio::test(start_paused = true)]
    async fn a_plc_without_a_clock_is_refused_before_a_write() {
        let bench = sim::station().await;
        assert!(matches!(failure(bench.station.read_clock().await.unwrap_err()), ClockFailure::Missing));
        let error = bench.station.set_clock(&clock(0)).await.unwrap_err();
        assert_eq!(error.to_string(), "station 1: the PLC has no clock: M1954 is 0");
        assert!(!error.may_have_executed());
        assert_eq!(bench.log().changes(1), []);
    }

    #[tokio::test(start_paused = true)]
    async fn registers_that_hold_no_time_are_an_error() {
        let bench = sim::station().await;
        bench.plc.write(discrete!("M1954"), true).unwrap();
        let error = bench.station.read_clock().await.unwrap_err();
        assert_eq!(
            error.to_string(),
            "station 1: the clock registers hold no time: month 0 of a clock is out of the range 1 to 12"
        );
        assert!(!error.may_have_executed());
    }

    #[tokio::test(start_paused = true)]
    async fn a_lost_write_is_in_doubt_and_m1952_is_set_back() {
        let bench = sim::station().await;
        bench.plc.set_clock(Some(clock(0)));
        let lost = Rule::new(Fault::DropReply).command(crate::command::Code::WriteRegisters);
        bench.faults.add_rule(lost);
        let error = bench.station.set_clock(&clock(30)).await.unwrap_err();
        assert!(error.may_have_executed() && error.is_timeout(), "{error}");
        assert!(matches!(failure(error), ClockFailure::Interrupted { .. }));
        assert_eq!(bench.plc.read(discrete!("M1952")), Value::Bit(false));
    }

    /// M1952 stayed 1 if the reply to its first write was lost.
    #[tokio::test(start_paused = true)]
    async fn m1952_is_set_back_if_its_own_write_is_in_doubt() {
        let bench = sim::station().await;
        bench.plc.set_clock(Some(clock(0)));
        let lost = Rule::new(Fault::DropReply).command(crate::command::Code::WriteDiscretes).times(1);
        bench.faults.add_rule(lost);
        let error = bench.station.set_clock(&clock(30)).await.unwrap_err();
        assert!(error.may_have_executed() && error.is_timeout(), "{error}");
        assert_eq!(bench.plc.read(discrete!("M1952")), Value::Bit(false));
        assert_eq!(bench.plc.clock(), Some(clock(0)));
    }

    #[tokio::test(start_paused = true)]
    async fn writes_without_m1952_do_not_set_the_clock() {
        let bench = sim::station().await;
        bench.plc.set_clock(Some(clock(0)));
        bench.station.write_registers(register!("R4128"), &[17]).await.unwrap();
        assert_eq!((bench.plc.clock(), bench.station.read_clock().await.unwrap()), (Some(clock(0)), clock(0)));
    }

    #[tokio::test(start_paused = true)]
    async fn a_wrong_value_sets_m1955_and_leaves_the_clock() {
        let bench = sim::station().await;
        bench.plc.set_clock(Some(clock(0)));
        for (on, wrong) in [(true, false), (false, true)] {
            bench.station.write_discretes(discrete!("M1952"), &[on]).await.unwrap();
            bench.station.write_registers(register!("R4132"), &[13]).await.unwrap();
            assert_eq!(bench.plc.read(discrete!("M1955")), Value::Bit(wrong));
        }
        assert_eq!((bench.plc.clock(), bench.plc.read(register!("R4132"))), (Some(clock(0)), Value::Word(11)));
    }
}
