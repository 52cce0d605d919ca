//! Errors of calls, and the error codes of replies.

mod seen;

use std::fmt;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use crate::clock::ClockFailure;
use crate::command::{Code, InvalidRequest};
use crate::tag::{Tag, TagAccessError};

pub(crate) use self::seen::Rounded;
pub use self::seen::Seen;

/// Error code of a refusal.
///
/// Source: protocol reference, section 4 (manuals 000 and 002 section 3, 001 section 2.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum ErrorCode {
    /// 2: illegal value.
    #[error("illegal value (2)")]
    IllegalValue,
    /// 3: the memory is a ROM pack.
    #[error("write prohibited, the PLC has a ROM pack (3)")]
    WriteProhibited,
    /// 4: illegal format, or the command cannot be executed.
    #[error("illegal format, or the command cannot be executed (4)")]
    IllegalFormat,
    /// 5: cannot run, the checksum of the ladder is wrong.
    #[error("cannot run: ladder checksum error (5)")]
    LadderChecksum,
    /// 6: cannot run, the id of the PLC is not the ladder's.
    #[error("cannot run: the PLC's id is not the ladder's (6)")]
    IdMismatch,
    /// 7: cannot run, syntax error in the ladder.
    #[error("cannot run: syntax error (7)")]
    Syntax,
    /// 9: cannot run, the ladder uses a function that the PLC does not support.
    #[error("cannot run: function not supported (9)")]
    NotSupported,
    /// A: illegal address.
    #[error("illegal address (A)")]
    IllegalAddress,
    /// A code that is in no manual.
    #[error("unknown error code ({0:X})")]
    Unknown(u8),
}

impl ErrorCode {
    /// The error with this code; `None` for 0, which is success.
    #[must_use]
    pub fn from_u8(code: u8) -> Option<Self> {
        Some(match code {
            0x0 => return None,
            0x2 => Self::IllegalValue,
            0x3 => Self::WriteProhibited,
            0x4 => Self::IllegalFormat,
            0x5 => Self::LadderChecksum,
            0x6 => Self::IdMismatch,
            0x7 => Self::Syntax,
            0x9 => Self::NotSupported,
            0xA => Self::IllegalAddress,
            other => Self::Unknown(other),
        })
    }
}

impl ErrorCode {
    /// Returns whether it may be due to the request: the PLC may accept another one for the same values.
    /// The others are about the state of the PLC.
    pub(crate) fn is_about_the_request(self) -> bool {
        match self {
            Self::IllegalValue | Self::IllegalFormat | Self::IllegalAddress | Self::NotSupported | Self::Unknown(_) => {
                true
            }
            Self::WriteProhibited | Self::LadderChecksum | Self::IdMismatch | Self::Syntax => false,
        }
    }

    /// Returns whether it may mean that the device does not know the command.
    pub(crate) fn is_about_the_command(self) -> bool {
        match self {
            Self::IllegalFormat | Self::NotSupported | Self::Unknown(_) => true,
            Self::IllegalValue
            | Self::WriteProhibited
            | Self::LadderChecksum
            | Self::IdMismatch
            | Self::Syntax
            | Self::IllegalAddress => false,
        }
    }
}

impl From<ErrorCode> for u8 {
    fn from(code: ErrorCode) -> Self {
        match code {
            ErrorCode::IllegalValue => 0x2,
            ErrorCode::WriteProhibited => 0x3,
            ErrorCode::IllegalFormat => 0x4,
            ErrorCode::LadderChecksum => 0x5,
            ErrorCode::IdMismatch => 0x6,
            ErrorCode::Syntax => 0x7,
            ErrorCode::NotSupported => 0x9,
            ErrorCode::IllegalAddress => 0xA,
            // 0 is success, so it must not be sent for an error.
            ErrorCode::Unknown(code) => code.max(1),
        }
    }
}

/// Why a call failed.
///
/// [`may_have_executed`](Self::may_have_executed) tells whether the PLC can have executed it. The
/// text has the whole cause; [`source`](std::error::Error::source) has only what is behind that.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Error {
    /// The request breaks a rule of the protocol. Nothing was sent.
    Invalid(InvalidRequest),
    /// A tag and a Rust type, or a tag and a value, do not fit. Nothing was written, and nothing was
    /// sent unless the values that were read are the reason.
    Tag(Box<TagAccessError>),
    /// The PLC refused the request.
    #[non_exhaustive]
    Plc {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// The error code of the refusal.
        error: ErrorCode,
        /// `true` if the request was sent before without a reply, so that it can have been
        /// executed.
        repeated: bool,
    },
    /// No reply came within the timeout.
    #[non_exhaustive]
    Timeout {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// The time since the call was made.
        after: Duration,
        /// `true` if the request was sent.
        sent: bool,
        /// Number of times that the request was sent. 0 although the station was asked: the check
        /// (4E) before it was not answered.
        attempts: u32,
        /// `true` if a check (4E) was sent for the call last, and was not answered. If neither that
        /// is the case nor the request was sent, the call was queued behind others.
        checked: bool,
        /// Traffic received instead of the reply.
        seen: Seen,
    },
    /// Frames came within the timeout, but no reply to this request.
    #[non_exhaustive]
    BadReply {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// The time since the call was made.
        after: Duration,
        /// Why the first such frame was not a reply to this request.
        reason: String,
        /// `true` if the request was sent.
        sent: bool,
        /// Number of times that the request was sent.
        attempts: u32,
        /// Other traffic received.
        seen: Seen,
    },
    /// Replies to earlier requests may still come, so that no reply can be matched to this request.
    #[non_exhaustive]
    OutOfStep {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// The time since the call was made.
        after: Duration,
        /// `true` if the request was sent. `false` if the station refuses the check (4E) and the
        /// quiet time did not pass or is longer than the timeout of the call.
        sent: bool,
    },
    /// Duplicates came out of order during a job of several requests, also in all its repetitions.
    #[non_exhaustive]
    Duplicates {
        /// The station.
        station: u8,
        /// `true` if a request can have been executed without a reliable reply: `true` for writes.
        sent: bool,
    },
    /// The station did not answer several times in a row: calls fail until it answers a probe.
    #[non_exhaustive]
    Offline {
        /// The station.
        station: u8,
        /// Time until the next probe.
        probe_in: Duration,
        /// `true` if the request was sent before the station was found offline.
        sent: bool,
    },
    /// The queue of calls for this station is full. Nothing was sent.
    #[non_exhaustive]
    QueueFull {
        /// The station.
        station: u8,
        /// Maximum number of waiting calls.
        limit: usize,
    },
    /// The [send gate](crate::SendGate) of the link is closed.
    #[non_exhaustive]
    GateClosed {
        /// The station; 0 for a broadcast.
        station: u8,
        /// The command.
        code: Code,
        /// `true` if the gate closed within the request, of which a part was written, or if the request
        /// was sent before without a reply. `false`: no byte of it was written.
        sent: bool,
    },
    /// The connection could not be opened.
    #[non_exhaustive]
    Connect {
        /// The endpoint.
        endpoint: String,
        /// The error of the transport.
        source: Arc<io::Error>,
        /// `true` if the request was sent before, over a connection that was lost.
        sent: bool,
    },
    /// The connection was lost.
    #[non_exhaustive]
    Disconnected {
        /// The endpoint.
        endpoint: String,
        /// The error of the transport.
        source: Arc<io::Error>,
        /// `true` if the request, or a part of it, was sent.
        sent: bool,
    },
    /// A write of several requests failed after the first one, or was not confirmed at its end.
    #[non_exhaustive]
    PartlyWritten {
        /// Number of values, from the first on, that were certainly written.
        written: usize,
        /// Number of values to write.
        count: usize,
        /// The error of the next request.
        ///
        /// Its [`may_have_executed`](Self::may_have_executed) tells whether its values, as many as
        /// one request takes, can have been written. Values behind those were not written.
        source: Box<Error>,
    },
    /// The PLC refused a request of a call for several tags. If the request was for several, it does not say
    /// because of which.
    #[non_exhaustive]
    RefusedTags {
        /// The tags of the request, at least one.
        tags: Vec<Tag>,
        /// The refusal.
        source: Box<Error>,
    },
    /// A read that a write depends on failed; nothing was written. See
    /// [`Station::modify_bits`](crate::Station::modify_bits).
    #[non_exhaustive]
    ReadBeforeWrite {
        /// The error of the read.
        source: Box<Error>,
    },
    /// The clock of the PLC cannot be read or was not set.
    #[non_exhaustive]
    Clock {
        /// The station.
        station: u8,
        /// The reason.
        failure: Box<ClockFailure>,
    },
    /// The link is closed, or its task has ended with its runtime.
    #[non_exhaustive]
    Closed {
        /// `true` if the request was sent before.
        sent: bool,
    },
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Invalid(invalid) => write!(f, "invalid request: {invalid}"),
            Self::Tag(error) => error.fmt(f),
            Self::Plc { station, code, error, repeated: _ } => write!(f, "station {station} refused {code}: {error}"),
            Self::Timeout { station, code, after, sent, attempts, checked, seen } => {
                let after = Rounded(*after);
                match (sent, checked) {
                    (true, _) => {
                        write!(f, "station {station} did not answer {code} within {after}")?;
                        if *attempts > 1 {
                            write!(f, ", sent {attempts} times")?;
                        }
                    }
                    (false, true) => write!(
                        f,
                        "station {station} did not answer the check before {code} within {after}, and the \
                         request was not sent"
                    )?,
                    (false, false) => write!(f, "{code} to station {station} was queued for {after} and never sent")?,
                }
                came(seen, "; instead came: ", f)
            }
            Self::BadReply { station, code, after, reason, sent: _, attempts, seen } => {
                write!(f, "station {station} gave no usable reply to {code} within {}", Rounded(*after))?;
                if *attempts > 1 {
                    write!(f, ", sent {attempts} times")?;
                }
                write!(f, ": {reason}")?;
                came(seen, "; besides came: ", f)
            }
            Self::OutOfStep { station, code, after: _, sent: true } => write!(
                f,
                "station {station}, {code}: the reply may be a late one, or a duplicate of one, to an earlier request"
            ),
            Self::OutOfStep { station, code, after, sent: false } => write!(
                f,
                "station {station}, {code}: not sent within {}: replies to earlier requests may be under way, and the \
                 station refuses the check, so it must be silent for the quiet time first",
                Rounded(*after)
            ),
            Self::Duplicates { station, sent: _ } => write!(
                f,
                "station {station} sends duplicates of replies out of order: the results of several requests cannot be \
                 trusted"
            ),
            Self::Offline { station, probe_in, sent: _ } => {
                write!(f, "station {station} is offline; the next probe is due in {}", Rounded(*probe_in))
            }
            Self::QueueFull { station, limit } => {
                write!(f, "{limit} calls are waiting for station {station} already")
            }
            Self::GateClosed { station, code, sent: false } => {
                write!(f, "{code} to station {station} was not sent: the send gate is closed")
            }
            Self::GateClosed { station, code, sent: true } => write!(
                f,
                "{code} to station {station} may have been executed: it was sent, whole or in part, before the send \
                 gate closed"
            ),
            Self::Connect { endpoint, source, sent: _ } => write!(f, "cannot connect to {endpoint}: {source}"),
            Self::Disconnected { endpoint, source, sent: _ } => {
                write!(f, "the connection to {endpoint} was lost: {source}")
            }
            Self::PartlyWritten { written, count, source } => {
                write!(f, "{written} of {count} values were written, and then: {source}")
            }
            Self::RefusedTags { tags, source } => write!(f, "{}: {source}", Tags(tags)),
            Self::ReadBeforeWrite { source } => {
                write!(f, "nothing was written, since the read before failed: {source}")
            }
            Self::Clock { station, failure } => write!(f, "station {station}: {failure}"),
            Self::Closed { sent: _ } => f.write_str("the link is closed"),
        }
    }
}

/// Displays the tags of a request, of which there can be many.
struct Tags<'t>(&'t [Tag]);

impl fmt::Display for Tags<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const SHOWN: usize = 8;
        let (shown, more) = self.0.split_at_checked(SHOWN).unwrap_or((self.0, &[]));
        for (n, tag) in shown.iter().enumerate() {
            write!(f, "{}{tag}", if n > 0 { ", " } else { "" })?;
        }
        if more.is_empty() { Ok(()) } else { write!(f, " and {} more", more.len()) }
    }
}

fn came(seen: &Seen, before: &str, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    if seen.is_nothing() { Ok(()) } else { write!(f, "{before}{seen}") }
}

impl std::error::Error for Error {
    /// The cause behind the one that the text already has, so that a chain of causes names each
    /// once.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Invalid(invalid) => invalid.source(),
            Self::Tag(error) => error.source(),
            Self::Connect { source, .. } | Self::Disconnected { source, .. } => source.source(),
            Self::PartlyWritten { source, .. }
            | Self::RefusedTags { source, .. }
            | Self::ReadBeforeWrite { source } => source.source(),
            Self::Clock { failure, .. } => failure.call_error().and_then(std::error::Error::source),
            Self::Plc { .. }
            | Self::Timeout { .. }
            | Self::BadReply { .. }
            | Self::OutOfStep { .. }
            | Self::Duplicates { .. }
            | Self::Offline { .. }
            | Self::QueueFull { .. }
            | Self::GateClosed { .. }
            | Self::Closed { .. } => None,
        }
    }
}

impl From<InvalidRequest> for Error {
    fn from(invalid: InvalidRequest) -> Self {
        Self::Invalid(invalid)
    }
}

impl Error {
    /// Names the tags of a request that the PLC refused; other errors stay as they are.
    pub(crate) fn of_tags(self, tags: &[Tag]) -> Self {
        if let Self::PartlyWritten { written, count, source } = self {
            return Self::PartlyWritten { written, count, source: Box::new(source.of_tags(tags)) };
        }
        let is_refusal = matches!(self, Self::Plc { .. });
        if is_refusal { Self::RefusedTags { tags: tags.to_vec(), source: Box::new(self) } } else { self }
    }

    /// Returns `true` if no reply came in time, also of a station that is offline.
    ///
    /// For [`PartlyWritten`](Self::PartlyWritten), [`RefusedTags`](Self::RefusedTags) and
    /// [`ReadBeforeWrite`](Self::ReadBeforeWrite) this and the following methods tell of its source.
    #[must_use]
    pub fn is_timeout(&self) -> bool {
        match self {
            Self::Timeout { .. } | Self::Offline { .. } => true,
            Self::PartlyWritten { source, .. }
            | Self::RefusedTags { source, .. }
            | Self::ReadBeforeWrite { source } => source.is_timeout(),
            Self::Clock { failure, .. } => failure.call_error().is_some_and(Self::is_timeout),
            Self::Invalid(_)
            | Self::Tag(_)
            | Self::Plc { .. }
            | Self::BadReply { .. }
            | Self::OutOfStep { .. }
            | Self::Duplicates { .. }
            | Self::Connect { .. }
            | Self::Disconnected { .. }
            | Self::QueueFull { .. }
            | Self::GateClosed { .. }
            | Self::Closed { .. } => false,
        }
    }

    /// Returns `true` if there is no connection, or if it was lost.
    #[must_use]
    pub fn is_connect(&self) -> bool {
        match self {
            Self::Connect { .. } | Self::Disconnected { .. } => true,
            Self::PartlyWritten { source, .. }
            | Self::RefusedTags { source, .. }
            | Self::ReadBeforeWrite { source } => source.is_connect(),
            Self::Clock { failure, .. } => failure.call_error().is_some_and(Self::is_connect),
            Self::Invalid(_)
            | Self::Tag(_)
            | Self::Plc { .. }
            | Self::Timeout { .. }
            | Self::Offline { .. }
            | Self::BadReply { .. }
            | Self::OutOfStep { .. }
            | Self::Duplicates { .. }
            | Self::QueueFull { .. }
            | Self::GateClosed { .. }
            | Self::Closed { .. } => false,
        }
    }

    /// Returns `true` if the same request may succeed later without a change: the line, the PLC or
    /// the queue failed, or the send gate was closed; not the request.
    ///
    /// A refusal by the PLC is not transient. Before a write is repeated, see
    /// [`may_have_executed`](Self::may_have_executed).
    #[must_use]
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Timeout { .. }
            | Self::Offline { .. }
            | Self::BadReply { .. }
            | Self::OutOfStep { .. }
            | Self::Duplicates { .. }
            | Self::Connect { .. }
            | Self::Disconnected { .. }
            | Self::QueueFull { .. }
            | Self::GateClosed { .. } => true,
            Self::PartlyWritten { source, .. }
            | Self::RefusedTags { source, .. }
            | Self::ReadBeforeWrite { source } => source.is_transient(),
            Self::Clock { failure, .. } => failure.call_error().is_some_and(Self::is_transient),
            Self::Invalid(_) | Self::Tag(_) | Self::Plc { .. } | Self::Closed { .. } => false,
        }
    }

    /// Returns whether the PLC can have executed the request; of a write of several requests, any
    /// of them.
    ///
    /// `false` is certain: the request was not sent, or the PLC refused it. `true` is not: whether
    /// to repeat a write is the decision of the caller.
    #[must_use]
    pub fn may_have_executed(&self) -> bool {
        match self {
            Self::Invalid(_) | Self::Tag(_) | Self::QueueFull { .. } | Self::ReadBeforeWrite { .. } => false,
            Self::Plc { repeated, .. } => *repeated,
            Self::RefusedTags { source, .. } => source.may_have_executed(),
            Self::PartlyWritten { .. } => true,
            Self::Clock { failure, .. } => failure.may_have_executed(),
            Self::Timeout { sent, .. }
            | Self::BadReply { sent, .. }
            | Self::OutOfStep { sent, .. }
            | Self::Duplicates { sent, .. }
            | Self::Offline { sent, .. }
            | Self::GateClosed { sent, .. }
            | Self::Connect { sent, .. }
            | Self::Disconnected { sent, .. }
            | Self::Closed { sent } => *sent,
        }
    }

    /// A timeout of a call that nothing else is known of.
    #[cfg(test)]
    pub(crate) fn timeout(station: u8, code: Code, after: Duration, sent: bool) -> Self {
        let attempts = u32::from(sent);
        Self::Timeout { station, code, after, sent, attempts, checked: false, seen: Seen::default() }
    }

    /// The error code of the PLC, if it refused the request.
    #[must_use]
    pub fn error_code(&self) -> Option<ErrorCode> {
        match self {
            Self::Plc { error, .. } => Some(*error),
            Self::PartlyWritten { source, .. }
            | Self::RefusedTags { source, .. }
            | Self::ReadBeforeWrite { source } => source.error_code(),
            Self::Clock { failure, .. } => failure.call_error().and_then(Self::error_code),
            Self::Invalid(_)
            | Self::Tag(_)
            | Self::Timeout { .. }
            | Self::BadReply { .. }
            | Self::OutOfStep { .. }
            | Self::Duplicates { .. }
            | Self::Offline { .. }
            | Self::QueueFull { .. }
            | Self::GateClosed { .. }
            | Self::Connect { .. }
            | Self::Disconnected { .. }
            | Self::Closed { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_tell_what_kind_they_are() {
        let timeout = Error::timeout(1, Code::ReadStatus, Duration::from_secs(1), true);
        let partly = Error::PartlyWritten { written: 64, count: 100, source: Box::new(timeout.clone()) };
        for error in [timeout, partly] {
            assert_eq!((error.is_timeout(), error.is_connect(), error.is_transient()), (true, false, true), "{error}");
        }
        let closed = Error::Closed { sent: false };
        assert_eq!((closed.is_timeout(), closed.is_connect(), closed.is_transient()), (false, false, false));
        let error = ErrorCode::IllegalAddress;
        let refused = Error::Plc { station: 1, code: Code::ReadStatus, error, repeated: false };
        assert_eq!((refused.is_timeout(), refused.is_connect(), refused.is_transient()), (false, false, false));
        let full = Error::QueueFull { station: 1, limit: 16 };
        assert_eq!((full.is_timeout(), full.is_connect(), full.is_transient()), (false, false, true));
        for sent in [false, true] {
            let withheld = Error::GateClosed { station: 1, code: Code::ReadStatus, sent };
            let kinds = (withheld.is_timeout(), withheld.is_connect(), withheld.is_transient());
            assert_eq!((kinds, withheld.may_have_executed()), ((false, false, true), sent), "{withheld}");
        }
    }
}
