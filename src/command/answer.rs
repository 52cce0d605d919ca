use std::fmt;

use bytes::BytesMut;

use super::{Command, encode_reply};
use crate::wire::Framing;

/// A request of any command and the reply that belongs to it, as [`Station::forward`](crate::Station::forward) gives them.
///
/// It can be sent on in any framing that the request [could be sent in](super::Request::encode), whichever one the reply
/// came in. Its `Debug` form shows both.
pub struct Answer {
    exchange: Box<dyn Exchange>,
}

impl Answer {
    pub(crate) fn new<C: Command>(request: C, reply: C::Reply) -> Self {
        Self { exchange: Box::new(Answered { request, reply }) }
    }

    /// Appends the reply as a whole frame, as the PLC with this number sends it.
    ///
    /// That is the very frame that the PLC has sent, except that its digits are upper-case and that a program page (4F)
    /// always has its error digit.
    pub fn encode(&self, framing: Framing, station: u8, dst: &mut BytesMut) {
        self.exchange.encode_reply(framing, station, dst);
    }
}

impl fmt::Debug for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.exchange.fmt(f)
    }
}

trait Exchange: fmt::Debug + Send + Sync {
    fn encode_reply(&self, framing: Framing, station: u8, dst: &mut BytesMut);
}

#[derive(Debug)]
struct Answered<C: Command> {
    request: C,
    reply: C::Reply,
}

impl<C: Command> Exchange for Answered<C> {
    fn encode_reply(&self, framing: Framing, station: u8, dst: &mut BytesMut) {
        encode_reply(&self.request, Ok(&self.reply), framing, station, dst);
    }
}
