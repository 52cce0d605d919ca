use std::fmt;
use std::time::Duration;

use super::Reply;
use super::words::WordAreas;
use crate::command::{Candidate, Code, Command, InvalidRequest, ReadDiscretes, ReadMixed, ReadRegisters, Spelling};
use crate::element::{Element, Register, Register32};
use crate::error::Error;
use crate::link::{CallOutcome, Purpose};
use crate::station::{Outcome, Station, StationJob};
use crate::wire::Framing;

/// One request of a [`Plan`](super::Plan) with its cost.
#[derive(Clone, Debug)]
pub struct PlannedRequest {
    pub(super) request: ReadRequest,
    pub(super) values: usize,
    pub(super) request_bytes: usize,
    pub(super) reply_bytes: usize,
    pub(super) time: Duration,
    /// The areas of the discretes that it reads as bits of words.
    pub(super) word_areas: WordAreas,
}

/// A request that reads elements, of one of four kinds.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ReadRequest {
    /// 44: a run of discretes.
    Discretes(ReadDiscretes),
    /// 46: a run of 16-bit registers.
    Registers(ReadRegisters<Register>),
    /// 46: a run of 32-bit registers.
    Registers32(ReadRegisters<Register32>),
    /// 48: elements of any kind.
    Mixed(ReadMixed),
}

impl PlannedRequest {
    /// Returns the request.
    #[must_use]
    pub fn request(&self) -> &ReadRequest {
        &self.request
    }

    /// Returns the number of values of tags that it reads.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.values
    }

    /// Returns the length of request and reply in bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.request_bytes + self.reply_bytes
    }

    /// Returns its duration by the cost model.
    #[must_use]
    pub fn time(&self) -> Duration {
        self.time
    }

    /// Returns whether it reads discretes as bits of words, such as M0 to M15 as `WM0`.
    ///
    /// A PLC may refuse these words although it accepts the discretes.
    #[must_use]
    pub fn has_words_of_discretes(&self) -> bool {
        !self.word_areas.is_empty()
    }
}

impl PlannedRequest {
    /// Returns whether a PLC may refuse the request and accept others with the same values.
    pub(super) fn may_have_fallback(&self) -> bool {
        self.has_words_of_discretes() || self.request.code() == Code::ReadMixed
    }
}

impl ReadRequest {
    /// Sends the request and returns the reply.
    ///
    /// # Errors
    /// As for every method of [`Station`].
    pub async fn call(&self, station: &Station) -> Result<Reply, Error> {
        Ok(match self {
            Self::Discretes(request) => Reply::Bits(station.call(*request).await?),
            Self::Registers(request) => Reply::Words(station.call(*request).await?),
            Self::Registers32(request) => Reply::DWords(station.call(*request).await?),
            Self::Mixed(request) => Reply::Mixed(station.call(request.clone()).await?),
        })
    }

    /// Sends the request as part of a job that the caller keeps: a poll cycle.
    pub(crate) async fn call_in_cycle(&self, station: &Station) -> CallOutcome<Reply> {
        async fn call<C: Command>(
            station: &Station,
            request: C,
            reply: impl FnOnce(C::Reply) -> Reply,
        ) -> CallOutcome<Reply> {
            let CallOutcome { result, replied_at, spelling, shape, proof } =
                station.submit(request, Purpose::Whole).await;
            CallOutcome { result: result.map(reply), replied_at, spelling, shape, proof }
        }
        match self {
            Self::Discretes(request) => call(station, *request, Reply::Bits).await,
            Self::Registers(request) => call(station, *request, Reply::Words).await,
            Self::Registers32(request) => call(station, *request, Reply::DWords).await,
            Self::Mixed(request) => call(station, request.clone(), Reply::Mixed).await,
        }
    }

    /// Sends the request as part of `job`, at this mark.
    pub(crate) async fn call_in_job<M: Copy>(
        &self,
        job: &mut StationJob<'_, M>,
        mark: M,
    ) -> Result<Outcome<M, Reply>, Error> {
        Ok(match self {
            Self::Discretes(request) => job.call(mark, *request, false).await?.map(Reply::Bits),
            Self::Registers(request) => job.call(mark, *request, false).await?.map(Reply::Words),
            Self::Registers32(request) => job.call(mark, *request, false).await?.map(Reply::DWords),
            Self::Mixed(request) => job.call(mark, request.clone(), false).await?.map(Reply::Mixed),
        })
    }

    /// Returns the mixed read of the elements of a run, as a spelling of it.
    pub(super) fn as_mixed_read(&self, framing: Framing) -> Option<Candidate> {
        let candidates = match self {
            Self::Discretes(request) => request.candidates(false, framing),
            Self::Registers(request) => request.candidates(false, framing),
            Self::Registers32(request) => request.candidates(false, framing),
            Self::Mixed(_) => return None,
        };
        candidates.into_iter().flatten().find(|candidate| candidate.spelling.code == Code::ReadMixed)
    }

    /// Returns the spelling that the request has without a reason for another one.
    pub(super) fn plain(&self) -> Spelling {
        match self {
            Self::Discretes(request) => request.plain(),
            Self::Registers(request) => request.plain(),
            Self::Registers32(request) => request.plain(),
            Self::Mixed(request) => request.plain(),
        }
    }

    /// Returns the command.
    pub(super) fn code(&self) -> Code {
        match self {
            Self::Discretes(_) => Code::ReadDiscretes,
            Self::Registers(_) | Self::Registers32(_) => Code::ReadRegisters,
            Self::Mixed(_) => Code::ReadMixed,
        }
    }

    /// Checks that the request is valid and unambiguous in this framing.
    pub(super) fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        match self {
            Self::Discretes(request) => request.check(framing),
            Self::Registers(request) => request.check(framing),
            Self::Registers32(request) => request.check(framing),
            Self::Mixed(request) => request.check(framing),
        }
    }
}

impl fmt::Display for ReadRequest {
    /// Writes the code and the elements: `46 R0-R9`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let run = |f: &mut fmt::Formatter<'_>, code, first: Element, count: usize| {
            write!(f, "{code} {first}")?;
            match first.nth(count.saturating_sub(1)) {
                Ok(last) if last != first => write!(f, "-{last}"),
                Ok(_) | Err(_) => Ok(()),
            }
        };
        match self {
            Self::Discretes(request) => run(f, 44, request.first().into(), request.count()),
            Self::Registers(request) => run(f, 46, request.first().into(), request.count()),
            Self::Registers32(request) => run(f, 46, request.first().into(), request.count()),
            Self::Mixed(request) => {
                f.write_str("48")?;
                request.elements().iter().try_for_each(|element| write!(f, " {element}"))
            }
        }
    }
}
