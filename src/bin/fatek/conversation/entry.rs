//! Results of an analysis: exchanges, and frames and bytes without one.

use std::time::Duration;

use bytes::Bytes;
use fatek::ErrorCode;
use fatek::command::{Class, Code, ReplyError, Request};
use fatek::wire::{Frame, Framing};

use super::{Direction, Timestamp};

/// A result of the analysis of one connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Entry {
    pub(crate) connection: u64,
    /// Time of the request, or of the frame or bytes themselves.
    pub(crate) at: Timestamp,
    pub(crate) found: Found,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Found {
    /// Boxed, since it is much larger than the others.
    Exchange(Box<Exchange>),
    /// A frame of the PLC that is no reply to an open request.
    Stray { reply: SeenFrame, why: StrayReply },
    /// Bytes that belong to no good frame.
    Bad { direction: Direction, bytes: Bytes, framing: Framing },
    /// Bytes that the source does not have.
    Missing { direction: Direction, count: u64 },
}

/// A request, and its reply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Exchange {
    pub(crate) request: SeenFrame,
    /// The request, or the rule that it breaks.
    pub(crate) decoded: Result<Request, String>,
    /// 1, and one more for each retry.
    pub(crate) attempt: u32,
    pub(crate) outcome: Outcome,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    Answered(Answer),
    /// No reply before a later request was answered, or before the end.
    Unanswered,
    /// No reply before the client sent the same request again.
    Retried,
    /// To all stations, none of which replies.
    Broadcast,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Answer {
    /// From the end of the request to the end of the reply.
    pub(crate) round_trip: Duration,
    pub(crate) reply: SeenFrame,
    pub(crate) verdict: Verdict,
    /// It may also be the reply to the request before or after.
    pub(crate) is_ambiguous: bool,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The values as a text.
    Values(String),
    Refused(ErrorCode),
    /// The reply to a request that breaks a rule.
    Unknown,
    /// No reply to this request: the rule that it breaks.
    Mismatch(String),
}

impl Verdict {
    /// The meaning of a frame as the reply to a request of its station. The error is the rule that it
    /// breaks, or empty for a frame of another command.
    pub(super) fn of(
        request: &SeenFrame,
        decoded: &Result<Request, String>,
        reply: &SeenFrame,
    ) -> Result<Self, String> {
        if request.frame.command != reply.frame.command {
            return Err(String::new());
        }
        let Ok(request) = decoded else { return Ok(Self::Unknown) };
        match request.decode_reply(&reply.frame, reply.framing) {
            Ok(values) => {
                let (text, request) = (values.to_string(), format!("{request}: "));
                Ok(Self::Values(text.strip_prefix(&request).unwrap_or(&text).to_owned()))
            }
            Err(ReplyError::Plc(code)) => Ok(Self::Refused(code)),
            Err(error) => Err(error.to_string()),
        }
    }
}

/// The place of a frame of the PLC that is no reply to an open request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum StrayReply {
    /// A copy of the last reply of its station.
    Doubled,
    /// The reply to a request after which another one was answered or sent; with the time since then.
    Late(Duration),
    Unexpected,
}

/// A frame with its bytes as they were on the wire.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SeenFrame {
    pub(crate) frame: Frame,
    pub(crate) bytes: Bytes,
    pub(crate) framing: Framing,
}

impl SeenFrame {
    /// Command and data as a text of one line.
    pub(crate) fn text(&self) -> String {
        let text = self.frame.to_string();
        text.split_once(": ").map_or(text.clone(), |(_, text)| text.to_owned())
    }
}

impl Exchange {
    /// The meaning of another reply to this request, as a text.
    pub(crate) fn text_of_reply(&self, reply: &SeenFrame) -> String {
        match Verdict::of(&self.request, &self.decoded, reply) {
            Ok(Verdict::Values(values)) => values,
            Ok(Verdict::Refused(code)) => code.to_string(),
            Ok(Verdict::Unknown | Verdict::Mismatch(_)) | Err(_) => reply.text(),
        }
    }

    /// The request as a text of one line.
    pub(crate) fn text(&self) -> String {
        self.decoded.as_ref().map_or_else(|_| self.request.text(), ToString::to_string)
    }

    /// Returns whether the request may change a PLC: it is not known to read only.
    pub(crate) fn may_write(&self) -> bool {
        let class = self.decoded.as_ref().map(|request| Code::class(request.code()));
        class.is_err() || class.is_ok_and(|class| class != Class::Read)
    }
}
