use std::time::Duration;

use bytes::Bytes;

use crate::ErrorCode;
use crate::command::Request;

/// Maximum number of replies that wait for the next connection.
pub(super) const MAX_LEFT_OVER: usize = 64;

/// A reply to an earlier client that is still on its way when a run begins.
///
/// For starts behind a serial device server that another client has just used. See
/// [`Faults::left_over`](super::Faults::left_over) for an example.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOver {
    pub(super) content: LeftOverContent,
    pub(super) delay: Duration,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum LeftOverContent {
    Reply { station: u8, request: Request, error: Option<ErrorCode> },
    Bytes(Bytes),
}

impl LeftOver {
    /// The reply of a station to this request.
    ///
    /// The request is executed when the connection opens. The log has an entry for it, with
    /// [`Fault::LeftOver`](super::Fault::LeftOver). A station that is not on the bus sends none.
    #[must_use]
    pub fn reply(station: u8, request: Request) -> Self {
        let content = LeftOverContent::Reply { station, request, error: None };
        Self { content, delay: Duration::ZERO }
    }

    /// Any bytes, such as a reply in the framing of the bus. The log has no entry for them.
    #[must_use]
    pub fn bytes(bytes: impl Into<Bytes>) -> Self {
        Self { content: LeftOverContent::Bytes(bytes.into()), delay: Duration::ZERO }
    }

    /// Makes the reply a refusal, so that the request is not executed. No effect on bytes.
    #[must_use]
    pub fn error(mut self, refusal: ErrorCode) -> Self {
        if let LeftOverContent::Reply { error, .. } = &mut self.content {
            *error = Some(refusal);
        }
        self
    }

    /// Sets the time from the opening of the connection to the reply. Default: 0.
    #[must_use]
    pub fn delay(mut self, delay: Duration) -> Self {
        self.delay = delay;
        self
    }
}
