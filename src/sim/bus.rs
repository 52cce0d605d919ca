use std::collections::BTreeMap;

use bytes::BytesMut;
use tracing::debug;

use super::fault::{Conditions, Faults};
use super::{Error, Execute, PageReply, Plc};
use crate::ErrorCode;
use crate::command::{
    Code, Command, ReadProgramPage, Request, RequestError, encode_refusal, encode_reply, with_command,
};
use crate::wire::{Frame, Framing, Received, ascii};

/// A line with PLCs on it, each at its station number.
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
/// let mut line = BytesMut::from(&b"\x0202411FA\x03"[..]); // station 2, run!
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
    /// What is not as it should be. `None` for a line where all is well: nothing is spent on it then.
    conditions: Option<Conditions>,
}

impl Bus {
    /// A line with no PLC on it: nothing answers.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Puts a PLC on the line, in the place of the one that had this number.
    ///
    /// # Errors
    /// [`Error::Station`] unless the number is 1 to 254.
    pub fn with_station(mut self, station: u8, plc: Plc) -> Result<Self, Error> {
        if !(1..=254).contains(&station) {
            return Err(Error::Station { station });
        }
        self.stations.insert(station, plc);
        Ok(self)
    }

    /// Gives the line faults, a speed and a log; see [`fault`](super::fault). They take the place of those it had.
    ///
    /// [`serve`](super::serve), [`Server`](super::Server), [`UdpServer`](super::UdpServer) and
    /// [`connector`](super::connector) apply them, for a bus that has them when it is given to these.
    /// [`answer`](Self::answer) does not, for it knows no time.
    ///
    /// The faults that are kept can be changed while the line is in use. Give every bus its own: clones share their
    /// counters and their log.
    #[must_use]
    pub fn with_faults(mut self, faults: Faults) -> Self {
        self.conditions = Some(Conditions::new(faults));
        self
    }

    /// The PLC with this number.
    #[must_use]
    pub fn plc(&self, station: u8) -> Option<&Plc> {
        self.stations.get(&station)
    }

    /// The faults that it was given.
    #[must_use]
    pub fn faults(&self) -> Option<&Faults> {
        self.conditions.as_ref().map(Conditions::faults)
    }

    /// Does what was received, and appends the reply as a whole frame.
    ///
    /// Nothing is appended for a frame to a station that is not here, and for one with a bad checksum or other noise:
    /// those are ignored. A broadcast is obeyed by all, and answered by none.
    ///
    /// The reply to a request that cannot be read is the error that [`RequestError::error_code`] says.
    pub fn answer(&self, received: &Received, framing: Framing, replies: &mut BytesMut) {
        let Received::Frame(frame) = received else {
            return;
        };
        if frame.station == BROADCAST {
            let request = Request::decode(frame, framing);
            let mut unsaid = BytesMut::new();
            for plc in self.stations.values() {
                respond(plc, frame, &request, framing, &mut unsaid);
                unsaid.clear();
            }
        } else if let Some(plc) = self.plc(frame.station) {
            respond(plc, frame, &Request::decode(frame, framing), framing, replies);
        }
    }

    /// The numbers of the PLCs on the line.
    pub(super) fn stations(&self) -> impl Iterator<Item = u8> {
        self.stations.keys().copied()
    }

    pub(crate) fn conditions(&self) -> Option<&Conditions> {
        self.conditions.as_ref()
    }
}

/// The station number that means all of them.
pub(super) const BROADCAST: u8 = 0;

/// Has a PLC do what a frame asks, and appends its reply. Says whether it has done it, rather than refused.
pub(super) fn respond(
    plc: &Plc,
    frame: &Frame,
    request: &Result<Request, RequestError>,
    framing: Framing,
    replies: &mut BytesMut,
) -> bool {
    debug!(station = frame.station, ?request, "received");
    let mut responder = Responder { plc, station: frame.station, framing, replies };
    match request {
        Err(fault) => responder.refuse(frame.command, fault),
        Ok(Request::ReadProgramPage(request)) => responder.reply_page(request),
        Ok(request) => with_command!(request, request => responder.reply(request)),
    }
}

/// One PLC, about to reply.
struct Responder<'a> {
    plc: &'a Plc,
    station: u8,
    framing: Framing,
    replies: &'a mut BytesMut,
}

impl Responder<'_> {
    fn reply<C: Execute>(&mut self, request: &C) -> bool {
        self.say(request, self.plc.execute(request))
    }

    fn reply_page(&mut self, request: &ReadProgramPage) -> bool {
        match self.plc.execute(request) {
            // Only the ASCII framing has this command.
            Ok(page) if self.plc.form_of_page_reply() == PageReply::Bare => {
                let code = Code::ReadProgramPage.into();
                ascii::emit(self.replies, self.station, code, |fields| request.write_reply(&page, fields));
                true
            }
            reply => self.say(request, reply),
        }
    }

    fn say<C: Command>(&mut self, request: &C, reply: Result<C::Reply, ErrorCode>) -> bool {
        encode_reply(request, reply.as_ref().map_err(|&error| error), self.framing, self.station, self.replies);
        reply.is_ok()
    }

    fn refuse(&mut self, command: u8, fault: &RequestError) -> bool {
        encode_refusal(command, fault.error_code(), self.framing, self.station, self.replies);
        false
    }
}

#[cfg(test)]
mod tests;
