//! The interface between a transfer and its driver.

use std::time::Duration;

use crate::command::{BriefStatus, DetailedStatus, PAGE_WORDS, ProgramPage, Value};
use crate::element::{Discrete, Width};
use crate::error::Error;
use crate::progress::Phase;
use crate::tag::Tag;

/// The next step of a transfer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Step {
    /// Send this request, then [`Transfer::handle`].
    Send(Request),
    /// Confirm all held replies, then [`Transfer::confirmed`].
    Confirm,
    Done,
}

/// A request of a transfer.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Request {
    /// 40.
    Status,
    /// 53.
    DetailedStatus,
    /// 41.
    Stop,
    /// 41.
    Run,
    /// No request: gives the PLC time to obey.
    Pause,
    /// 4F.
    ReadPage(u16),
    /// 50, with the response timeout, if it differs from the station's.
    WritePage { page: u16, content: ProgramPage, timeout: Option<Duration> },
    /// 44, 46. `shorter`: the last element may be left to the next request.
    Read { range: Tag, shorter: bool },
    /// 43, in several requests if one does not hold this number of discretes.
    ReadDisabled(Discrete, usize),
    /// 45, 47.
    Write(Tag, Vec<Value>),
}

impl Request {
    /// Bytes of program or memory that this request moves, if it covers `elements` of its range.
    pub(crate) fn content_len(&self) -> impl Fn(usize) -> usize + use<> {
        let (page, width) = match self {
            Self::ReadPage(_) | Self::WritePage { .. } => (2 * PAGE_WORDS, None),
            Self::Read { range, .. } | Self::Write(range, _) => (0, Some(range.first().width())),
            Self::Status | Self::DetailedStatus | Self::Stop | Self::Run | Self::Pause | Self::ReadDisabled(..) => {
                (0, None)
            }
        };
        move |elements| match width {
            None => page,
            Some(Width::Bit) => elements.div_ceil(8),
            Some(Width::Word) => elements.saturating_mul(2),
            Some(Width::DWord) => elements.saturating_mul(4),
        }
    }
}

/// The reply to a [`Request`].
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Reply {
    Status(BriefStatus),
    DetailedStatus(DetailedStatus),
    Page(ProgramPage),
    Values(Vec<Value>),
    Disabled(Vec<bool>),
    Done,
}

/// How far a transfer has come in its current phase.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Position {
    pub(crate) phase: Phase,
    pub(crate) done: usize,
    /// 0 as long as the number of steps is not known: nothing is reported then.
    pub(crate) total: usize,
}

/// A transfer of many requests: a state machine without I/O and clock.
///
/// The driver calls [`next`](Self::next), then [`handle`](Self::handle) or
/// [`confirmed`](Self::confirmed), or [`rewind`](Self::rewind) instead of either.
pub(crate) trait Transfer {
    /// The place of a request, to which the transfer can go back.
    type Mark: Copy;
    type Failure;

    /// `true` if confirmed replies are kept when a run fails. The driver then confirms them at the
    /// end.
    const KEEPS_PARTIAL: bool = false;

    /// The next step. A write, STOP or RUN counts as sent from here on.
    ///
    /// # Errors
    /// The transfer cannot continue.
    fn next(&mut self) -> Result<Step, Self::Failure>;

    /// The mark of the request that [`next`](Self::next) returned last.
    fn mark(&self) -> Self::Mark;

    /// Handles the result of a request.
    ///
    /// # Errors
    /// The transfer cannot continue.
    fn handle(&mut self, result: Result<Reply, Error>) -> Result<(), Self::Failure>;

    /// Handles the result of [`Step::Confirm`]; `Ok`: all replies so far are good.
    ///
    /// # Errors
    /// The transfer cannot continue.
    fn confirmed(&mut self, result: Result<(), Error>) -> Result<(), Self::Failure>;

    /// Goes back: replies to requests from this mark on may belong to other requests.
    fn rewind(&mut self, mark: Self::Mark);

    /// Replies before this mark are confirmed; `None`: all replies.
    fn keep(&mut self, first_held: Option<Self::Mark>) {
        let _ = first_held;
    }

    /// Replies from this mark on are not reliable, and the run ends.
    fn distrust(&mut self, first_held: Self::Mark) {
        let _ = first_held;
    }

    fn position(&self) -> Position;
}
