//! Finds the capabilities of a station by requests that only read.

use std::time::Duration;

use super::{Capabilities, Support, WordSupport};
use crate::command::{
    Code, Command, InvalidRequest, LoopBack, MAX_MIXED_READ_UNITS, MAX_POINTS, MAX_UNITS, ReadDetailedStatus,
    ReadDisabled, ReadDiscretes, ReadMixed, ReadRegisters, ReadStatus, Request,
};
use crate::element::{Discrete, Element, Register, Register32, Symbol};
use crate::error::{Error, ErrorCode};
use crate::plan::WordAreas;
use crate::station::Station;
use crate::wire::{Frame, Framing};

/// Number of exchanges that measure the response time.
const SAMPLES: usize = 5;

/// The answer to a request.
enum Answer<T> {
    Reply(T),
    Refused(ErrorCode),
    /// Not answered, though the station answers others.
    None,
}

impl Station {
    /// Finds the capabilities of the station, by some 30 requests that only read, and
    /// [declares](Self::set_capabilities) them.
    ///
    /// It reads the status (40, 53), R0 to R63, M0 to M255 and their enable states, words of X, Y, M and S, and
    /// the counters DRC200 to DRC202, with the loop-back (4E) between. Not found are commands that write or
    /// control, program pages (4F), which a running PLC may refuse, and answers to broadcasts. A command that is
    /// refused because the PLC lacks the elements counts as supported.
    ///
    /// A request that is not answered twice counts as unanswered if R0 is answered behind it. A largest
    /// request of fewer than the protocol's elements is found by halving; it stays unknown if one more
    /// element is refused for its address. The counters tell their step only if their values differ.
    /// Capabilities that it does not find stay as they were declared.
    ///
    /// # Errors
    /// Those of [every method](Self#errors) if R0 cannot be read, or a request cannot be sent: then the
    /// declared capabilities are as before.
    ///
    /// Cancel-safe: it only reads. If it is dropped, the declared capabilities are as before. Other calls of the
    /// link at the same time may lengthen the response time that it finds.
    pub async fn probe(&self) -> Result<Capabilities, Error> {
        let before = self.declared_capabilities();
        let mut restore = RestoreOnDrop { station: self, before: None };
        // One lost reply is no missing answer. More retries would make the station offline.
        let probe = Probe { station: self.with_options(self.options().with_retries(1)) };
        let mut found = before.clone();
        if let Err(error) = probe.read_register().await {
            // No request is answered before the check of the connection is.
            if !matches!(error, Error::Timeout { checked: true, .. })
                || before.command(Code::LoopBack) == Support::Unanswered
            {
                return Err(error);
            }
            restore.before = Some(before);
            let mut answered = false;
            for code in [Code::LoopBack, Code::ReadStatus] {
                found = found.with_command(code, Support::Unanswered);
                self.set_capabilities(found.clone());
                answered = probe.read_register().await.is_ok();
                if answered {
                    break;
                }
            }
            if !answered {
                return Err(error);
            }
        }
        let found = probe.run(found).await?;
        restore.before = None;
        self.set_capabilities(found.clone());
        Ok(found)
    }
}

/// Restores the declared capabilities, unless the probe succeeds.
struct RestoreOnDrop<'s> {
    station: &'s Station,
    /// `None`: nothing was declared.
    before: Option<Capabilities>,
}

impl Drop for RestoreOnDrop<'_> {
    fn drop(&mut self) {
        if let Some(before) = self.before.take() {
            self.station.set_capabilities(before);
        }
    }
}

struct Probe {
    station: Station,
}

impl Probe {
    /// Replaces the capabilities that a read shows.
    async fn run(&self, mut found: Capabilities) -> Result<Capabilities, Error> {
        let register = first_register()?;
        let discrete = first_discrete()?;
        found.response_time = self.response_time(register).await?.or(found.response_time);

        found = found.with_command(Code::ReadStatus, self.support(ReadStatus).await?);
        found = found.with_command(Code::LoopBack, self.support(LoopBack::new("probe")?).await?);
        found = found.with_command(Code::ReadDetailedStatus, self.support(ReadDetailedStatus).await?);
        found = found.with_command(Code::ReadDisabled, self.support(ReadDisabled::new(discrete, 1)?).await?);

        let registers = |count: usize| ReadRegisters::new(register, count);
        found = found.with_command(Code::ReadRegisters, Support::Supported);
        // A device that takes one register only is asked for two: a value of 32 bits has two.
        let most = self.largest(MAX_UNITS, registers).await?.map(|most| most.max(2));
        found.max_registers = most.or(found.max_registers);

        let support = self.support(ReadDiscretes::new(discrete, 1)?).await?;
        found = found.with_command(Code::ReadDiscretes, support);
        if support == Support::Supported {
            let discretes = |count: usize| ReadDiscretes::new(discrete, count);
            found.max_points = self.largest(MAX_POINTS, discretes).await?.or(found.max_points);
        }

        let mixed = |count: usize| ReadMixed::new(Element::from(register).run(count).collect::<Vec<_>>());
        let support = self.support(mixed(1)?).await?;
        found = found.with_command(Code::ReadMixed, support);
        if support == Support::Supported {
            found.max_mixed = self.largest(MAX_MIXED_READ_UNITS, mixed).await?.or(found.max_mixed);
        }

        for (support, symbol) in found.words.iter_mut().zip(WordAreas::SYMBOLS) {
            *support = self.words_of(symbol).await?;
        }
        found.counter_step = self.counter_step().await?.or(found.counter_step);
        Ok(found)
    }

    /// Sends a request. Fails if the station answers no other either.
    async fn ask<C: Command>(&self, request: C) -> Result<Answer<C::Reply>, Error> {
        match self.station.call(request).await {
            Ok(reply) => Ok(Answer::Reply(reply)),
            Err(Error::Plc { error, .. }) => Ok(Answer::Refused(error)),
            Err(error) if is_silence(&error) => {
                self.read_register().await?;
                Ok(Answer::None)
            }
            Err(error) => Err(error),
        }
    }

    async fn read_register(&self) -> Result<(), Error> {
        self.station.call(ReadRegisters::new(first_register()?, 1)?).await.map(drop)
    }

    /// The support of the command of a request.
    async fn support<C: Command>(&self, request: C) -> Result<Support, Error> {
        Ok(match self.ask(request).await? {
            // With an illegal address the command is known; its elements are not.
            Answer::Reply(_) | Answer::Refused(ErrorCode::IllegalAddress) => Support::Supported,
            Answer::Refused(_) => Support::Refused,
            Answer::None => Support::Unanswered,
        })
    }

    /// The largest accepted count up to `max`; one is accepted. `None` if a shorter memory may be the reason
    /// why one more is refused: other areas may be longer.
    async fn largest<C: Command>(
        &self,
        max: usize,
        request: impl Fn(usize) -> Result<C, InvalidRequest>,
    ) -> Result<Option<usize>, Error> {
        let (mut accepted, mut refused) = (1_usize, max.saturating_add(1));
        let (mut tried, mut is_length) = (max, false);
        while accepted < tried {
            match self.ask(request(tried)?).await? {
                Answer::Reply(_) => accepted = tried,
                Answer::Refused(ErrorCode::IllegalAddress) => (refused, is_length) = (tried, false),
                Answer::Refused(_) | Answer::None => (refused, is_length) = (tried, true),
            }
            tried = accepted.midpoint(refused);
        }
        Ok((accepted == max || is_length).then_some(accepted))
    }

    async fn words_of(&self, discrete: Symbol) -> Result<WordSupport, Error> {
        let word = |address: u16| {
            let element = Element::new(discrete.area().word(), address)?;
            ReadRegisters::new(Register::try_from(element)?, 1)
        };
        match self.ask(word(0)?).await? {
            Answer::Refused(_) | Answer::None => return Ok(WordSupport::Refused),
            Answer::Reply(_) => {}
        }
        match self.ask(word(8)?).await? {
            Answer::Reply(_) => Ok(WordSupport::MultiplesOf8),
            Answer::Refused(_) | Answer::None => Ok(WordSupport::MultiplesOf16),
        }
    }

    /// The step of counters of 32 bits in a run; `None` if they are not there, or have equal values.
    async fn counter_step(&self) -> Result<Option<u8>, Error> {
        let mut values = [0; 3];
        for (value, address) in values.iter_mut().zip(200..) {
            let counter = Register32::new(Symbol::DRC, address).map_err(InvalidRequest::from)?;
            let Answer::Reply(read) = self.ask(ReadRegisters::new(counter, 1)?).await? else { return Ok(None) };
            let [read] = read.as_slice() else { return Ok(None) };
            *value = *read;
        }
        // As a gateway gets it: a request that this crate makes has one of these counters.
        let run =
            Frame { station: self.station.number(), command: Code::ReadRegisters.into(), data: "02DRC0200".into() };
        let Ok(Request::ReadRegisters32(run)) = Request::decode(&run, Framing::Ascii) else { return Ok(None) };
        let Answer::Reply(run) = self.ask(run).await? else { return Ok(None) };
        Ok(step_of(values, &run))
    }

    /// The median of several response times of a read of one register.
    async fn response_time(&self, register: Register) -> Result<Option<Duration>, Error> {
        let mut times = Vec::with_capacity(SAMPLES);
        for _ in 0..SAMPLES {
            self.station.call(ReadRegisters::new(register, 1)?).await?;
            let round_trip = self.station.stats().round_trip.map(|round_trip| round_trip.last);
            debug_assert!(round_trip.is_some(), "a call was answered");
            // The reply has at most two registers in one of its spellings.
            let framing = self.station.link().framing();
            let reply = self.station.link().line().map(|line| line.transmission(framing.frame_overhead()));
            times.extend(round_trip.map(|time| time.saturating_sub(reply.unwrap_or(Duration::ZERO))));
        }
        times.sort_unstable();
        Ok(times.get(SAMPLES / 2).copied())
    }
}

/// Returns whether the station did not answer a request that was sent twice, or answered it by something else.
fn is_silence(error: &Error) -> bool {
    matches!(
        error,
        Error::Timeout { sent: true, attempts: 2.., .. } | Error::BadReply { sent: true, attempts: 2.., .. }
    )
}

fn first_register() -> Result<Register, Error> {
    Ok(Register::new(Symbol::R, 0).map_err(InvalidRequest::from)?)
}

fn first_discrete() -> Result<Discrete, Error> {
    Ok(Discrete::new(Symbol::M, 0).map_err(InvalidRequest::from)?)
}

/// The step of a run of two counters, by the values of three counters one by one. `None` if it does not show.
fn step_of([first, second, third]: [u32; 3], run: &[u32]) -> Option<u8> {
    match run {
        [a, b] if *a == first && *b == second && second != third => Some(1),
        [a, b] if *a == first && *b == third && second != third => Some(2),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_step_of_counters_shows_if_their_values_differ() {
        assert_eq!(step_of([7, 8, 9], &[7, 8]), Some(1));
        assert_eq!(step_of([7, 8, 9], &[7, 9]), Some(2));
        assert_eq!(step_of([7, 8, 8], &[7, 8]), None);
        // They count meanwhile.
        assert_eq!(step_of([7, 8, 9], &[8, 9]), None);
        assert_eq!(step_of([7, 8, 9], &[7]), None);
    }
}
