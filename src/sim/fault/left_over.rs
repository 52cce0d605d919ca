use std::time::Duration;

use bytes::Bytes;

use crate::ErrorCode;
use crate::command::Request;

/// A reply to an earlier client that is still on its way when a run begins.
///
/// [`Faults::left_over`](super::Faults::left_over) has an example.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOver {
    pub(super) content: Content,
    pub(super) delay: Duration,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Content {
    Reply { station: u8, request: Request, error: Option<ErrorCode> },
    Bytes(Bytes),
}

impl LeftOver {
    /// The reply of a station to this request, which is executed when the connection opens.
    ///
    /// The log has an entry for it, with [`Fault::LeftOver`](super::Fault::LeftOver). A station that is not on the bus
    /// does not reply.
    #[must_use]
    pub fn reply(station: u8, request: Request) -> Self {
        Self { content: Content::Reply { station, request, error: None }, delay: Duration::ZERO }
    }

    /// These bytes, such as a reply in the framing of the bus. The log has no entry for them.
    #[must_use]
    pub fn bytes(bytes: impl Into<Bytes>) -> Self {
        Self { content: Content::Bytes(bytes.into()), delay: Duration::ZERO }
    }

    /// Makes the reply this refusal: the request is not executed. Bytes stay as they are.
    #[must_use]
    pub fn error(mut self, refusal: ErrorCode) -> Self {
        if let Content::Reply { error, .. } = &mut self.content {
            *error = Some(refusal);
        }
        self
    }

    /// Sets how long after the opening of the connection it is sent: at once by default.
    #[must_use]
    pub fn delay(mut self, delay: Duration) -> Self {
        self.delay = delay;
        self
    }
}
