use std::fmt;

use bytes::BytesMut;

use super::{Command, encode_reply};
use crate::wire::{Frame, Framing};

/// The reply to a request of any command, from [`Station::forward`](crate::Station::forward) or
/// [`Request::decode_reply`](super::Request::decode_reply).
///
/// It can be encoded in every framing that its request [can be sent in](super::Request::encode).
/// `Debug` and `Display` show the request as well: `read registers (46h) R12 to R13: 7, 8`, or
/// `control RUN/STOP (41h) run: done`. `Display` has at most 800 characters on one line, all of them
/// printable.
pub struct ForwardedReply {
    exchange: Box<dyn AnyExchange>,
}

impl ForwardedReply {
    pub(crate) fn new<C: Command>(request: C, reply: C::Reply) -> Self {
        Self { exchange: Box::new(Exchange { request, reply }) }
    }

    /// Appends the reply as a complete frame from the PLC with this number.
    ///
    /// The frame equals that of the PLC, but its digits are upper case, and a program page (4F) has
    /// its error digit.
    pub fn encode(&self, framing: Framing, station: u8, dst: &mut BytesMut) {
        self.exchange.encode_reply(framing, station, dst);
    }

    /// The reply as a frame from the PLC with this number, as [`Frame::reply`] makes it.
    #[must_use]
    pub fn to_frame(&self, framing: Framing, station: u8) -> Frame {
        self.exchange.to_frame(framing, station)
    }
}

impl fmt::Debug for ForwardedReply {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.exchange.fmt(f)
    }
}

impl fmt::Display for ForwardedReply {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.exchange.fmt_text(f)
    }
}

trait AnyExchange: fmt::Debug + Send + Sync {
    fn encode_reply(&self, framing: Framing, station: u8, dst: &mut BytesMut);
    fn to_frame(&self, framing: Framing, station: u8) -> Frame;
    fn fmt_text(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result;
}

#[derive(Debug)]
struct Exchange<C: Command> {
    request: C,
    reply: C::Reply,
}

impl<C: Command> AnyExchange for Exchange<C> {
    fn encode_reply(&self, framing: Framing, station: u8, dst: &mut BytesMut) {
        encode_reply(&self.request, Ok(&self.reply), framing, station, dst);
    }

    fn to_frame(&self, framing: Framing, station: u8) -> Frame {
        Frame::reply(station, &self.request, Ok(&self.reply), framing)
    }

    fn fmt_text(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.request)?;
        C::fmt_reply(&self.reply, f)
    }
}
