use std::collections::BTreeMap;

use bytes::BytesMut;
use tracing::debug;

use super::fault::{Conditions, Faults};
use super::quirk::emit;
use super::{Error, Execute, PageReply, Plc};
use crate::ErrorCode;
use crate::command::{
    Code, Command, ReadProgramPage, Request, RequestError, encode_refusal, encode_reply, with_command,
};
use crate::wire::{Frame, Framing, Received, ascii};

/// A line with simulated PLCs, each at its station number.
///
/// ```
/// use bytes::BytesMut;
/// use fatek::sim::{Bus, Plc};
/// use fatek::wire::{AsciiCodec, Framing};
/// use tokio_util::codec::Decoder;
///
/// let pump = Plc::new();
/// let bus = Bus::new().with_station(1, Plc::new())?.with_station(2, pump.clone())?;
///
/// let mut line = BytesMut::from(&b"\x0202411FA\x03"[..]); // RUN to station 2
/// let mut replies = BytesMut::new();
/// while let Some(received) = AsciiCodec::new().decode(&mut line)? {
///     bus.answer(&received, Framing::Ascii, &mut replies);
/// }
/// assert!(pump.is_running());
/// assert_eq!(&replies[..], b"\x0202410F9\x03");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Bus {
    stations: BTreeMap<u8, Plc>,
    /// `None` without faults: no queue and no timer is used then.
    conditions: Option<Conditions>,
}

impl Bus {
    /// A line without PLCs: no request is answered.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A line with one PLC, at station number 1.
    pub(super) fn of_one(plc: Plc) -> Self {
        Self { stations: BTreeMap::from([(1, plc)]), conditions: None }
    }

    /// Adds a PLC to the line. It replaces the one with the same number.
    ///
    /// # Errors
    /// [`Error::Station`] unless the station number is 1 to 254.
    pub fn with_station(mut self, station: u8, plc: Plc) -> Result<Self, Error> {
        if !(1..=254).contains(&station) {
            return Err(Error::Station { station });
        }
        self.stations.insert(station, plc);
        Ok(self)
    }

    /// Sets the faults, the speed and the log of the line; see [`fault`](super::fault).
    ///
    /// Applied by [`serve`](super::serve), [`Server`](super::Server),
    /// [`UdpServer`](super::UdpServer) and [`connector`](super::connector), if set before the bus
    /// is passed to them. [`answer`](Self::answer) ignores them, since it has no clock.
    ///
    /// A clone of `faults` can change the rules while the line is in use. Use new faults for each
    /// bus: clones share their counts and their log.
    #[must_use]
    pub fn with_faults(mut self, faults: Faults) -> Self {
        self.conditions = Some(Conditions::new(faults));
        self
    }

    /// The PLC with this station number.
    #[must_use]
    pub fn plc(&self, station: u8) -> Option<&Plc> {
        self.stations.get(&station)
    }

    /// The faults of the line.
    #[must_use]
    pub fn faults(&self) -> Option<&Faults> {
        self.conditions.as_ref().map(Conditions::faults)
    }

    /// Executes a request, and appends the reply as a whole frame.
    ///
    /// Frames to absent stations, frames with a bad checksum and noise are ignored. A broadcast is
    /// executed by all stations and not answered. The reply to an unreadable request is the error
    /// code of [`RequestError::error_code`].
    pub fn answer(&self, received: &Received, framing: Framing, replies: &mut BytesMut) {
        let Received::Frame(frame) = &self.taken_for(received.clone(), framing) else {
            return;
        };
        if frame.station == BROADCAST {
            let request = Request::decode(frame, framing);
            let mut unsent = BytesMut::new();
            for plc in self.stations.values() {
                respond(plc, frame, &request, framing, &mut unsent);
                unsent.clear();
            }
        } else if let Some(plc) = self.plc(frame.station) {
            respond(plc, frame, &Request::decode(frame, framing), framing, replies);
        }
    }

    pub(super) fn plcs(&self) -> impl Iterator<Item = (u8, &Plc)> {
        self.stations.iter().map(|(&station, plc)| (station, plc))
    }

    /// The station numbers of the PLCs on the line.
    pub(super) fn stations(&self) -> impl Iterator<Item = u8> {
        self.stations.keys().copied()
    }

    pub(crate) fn conditions(&self) -> Option<&Conditions> {
        self.conditions.as_ref()
    }
}

/// The station number of broadcasts.
pub(super) const BROADCAST: u8 = 0;

/// Executes a request on a PLC, and appends its reply. Returns `false` if the PLC refused it.
pub(super) fn respond(
    plc: &Plc,
    frame: &Frame,
    request: &Result<Request, RequestError>,
    framing: Framing,
    replies: &mut BytesMut,
) -> bool {
    debug!(station = frame.station, ?request, "received");
    let quirks = plc.quirks();
    if let Some(reply) = quirks.own_reply(frame) {
        let reply = reply.map(|data| Frame { data, ..frame.clone() });
        reply.iter().for_each(|reply| emit(reply, framing, replies));
        return reply.is_some();
    }
    let start = replies.len();
    let mut responder = Responder { plc, station: frame.station, framing, replies };
    let executed = match request {
        Err(error) => responder.refuse(frame.command, error),
        Ok(Request::ReadProgramPage(request)) => responder.reply_page(request),
        Ok(request) => with_command!(request, request => responder.reply(request)),
    };
    quirks.change_reply(replies, start, frame, framing);
    executed
}

/// Executes requests on one PLC, and encodes the replies.
struct Responder<'a> {
    plc: &'a Plc,
    station: u8,
    framing: Framing,
    replies: &'a mut BytesMut,
}

impl Responder<'_> {
    fn reply<C: Execute>(&mut self, request: &C) -> bool {
        self.encode(request, self.plc.execute(request))
    }

    fn reply_page(&mut self, request: &ReadProgramPage) -> bool {
        match self.plc.execute(request) {
            // Only the ASCII framing has this command.
            Ok(page) if self.plc.form_of_page_reply() == PageReply::Bare => {
                let code = Code::ReadProgramPage.into();
                ascii::emit(self.replies, self.station, code, |fields| request.write_reply(&page, fields));
                true
            }
            reply => self.encode(request, reply),
        }
    }

    fn encode<C: Command>(&mut self, request: &C, reply: Result<C::Reply, ErrorCode>) -> bool {
        encode_reply(request, reply.as_ref().map_err(|&error| error), self.framing, self.station, self.replies);
        reply.is_ok()
    }

    fn refuse(&mut self, command: u8, error: &RequestError) -> bool {
        encode_refusal(command, error.error_code(), self.framing, self.station, self.replies);
        false
    }
}

#[cfg(test)]
mod tests;
