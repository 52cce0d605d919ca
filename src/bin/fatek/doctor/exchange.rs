//! Exchanges of an examination: requests, with everything that came.

use std::time::Duration;

use bytes::Bytes;
use fatek::wire::{Discard, Frame, Framing};

use super::request::{Request, Shape};

/// An action of a check.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Ask {
    /// A request that is repeated up to twice if no reply fits.
    Reply(Request),
    /// A request that changes the PLC: sent once.
    Once(Request),
    /// Bytes that no reply is expected to. The request says which reply one would be.
    Silence(Request, Bytes),
    /// Requests that are sent together.
    Burst(Vec<Request>),
    /// Requests one at a time, without a pause behind each reply.
    Load(Vec<Request>),
    /// A status request on each of this number of connections, which are open together.
    Connections(usize),
    /// A status request after this time without any.
    Idle(Duration),
    /// Two requests right behind each other, the second from another port. UDP only.
    TwoPorts(Request, Request),
    /// A loop-back that separates earlier replies from later ones.
    Sync(Request),
}

/// An action with its result.
#[derive(Clone, Debug)]
pub(crate) struct Exchange {
    pub(crate) ask: Ask,
    /// The attempts; of load, several connections or ports one for each.
    pub(crate) attempts: Vec<Attempt>,
}

/// A request that was sent once, with everything that came.
#[derive(Clone, Debug, Default)]
pub(crate) struct Attempt {
    pub(crate) sent: Bytes,
    pub(crate) arrivals: Vec<Arrival>,
    /// The connection was closed, or could not be opened.
    pub(crate) closed: bool,
}

/// Something that came.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    /// From the end of sending to the last byte.
    pub(crate) after: Duration,
    /// It came when it was not awaited: behind the reply, or after the timeout.
    pub(crate) unawaited: bool,
    pub(crate) item: Item,
    /// Number of reads, or datagrams, that it came in.
    pub(crate) pieces: usize,
    /// The longest pause between two of them.
    pub(crate) pause: Duration,
    /// It came from another UDP port than the one that was asked.
    pub(crate) other_port: bool,
}

#[derive(Clone, Debug)]
pub(crate) enum Item {
    /// A frame, with its bytes.
    Frame(Frame, Bytes),
    /// The request itself.
    Echo(Bytes),
    Noise(Discard, Bytes),
}

/// The answer to a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Answer<'a> {
    /// The data behind the error code.
    Data(&'a [u8]),
    Refused(u8),
    /// No reply that fits.
    None,
}

impl Ask {
    /// The request that a reply is awaited to.
    pub(crate) fn request(&self) -> Option<&Request> {
        match self {
            Self::Reply(request) | Self::Once(request) | Self::Silence(request, _) | Self::Sync(request) => {
                Some(request)
            }
            Self::Burst(_) | Self::Load(_) | Self::Connections(_) | Self::Idle(_) | Self::TwoPorts(..) => None,
        }
    }

    /// The number of requests that it sends if each is answered.
    pub(crate) fn requests(&self) -> usize {
        match self {
            Self::Reply(_) | Self::Once(_) | Self::Silence(..) | Self::Sync(_) | Self::Idle(_) => 1,
            Self::Burst(requests) | Self::Load(requests) => requests.len(),
            Self::Connections(connections) => *connections,
            Self::TwoPorts(..) => 2,
        }
    }
}

impl Exchange {
    /// The answer to the request, of the first attempt that has one.
    pub(crate) fn answer(&self, framing: Framing) -> Answer<'_> {
        let Some(request) = self.ask.request() else { return Answer::None };
        let answers = self.attempts.iter().map(|attempt| attempt.answer(request, framing));
        answers.into_iter().find(|answer| *answer != Answer::None).unwrap_or(Answer::None)
    }

    /// The frames of the request's command, with any data.
    pub(crate) fn frames(&self) -> impl Iterator<Item = &Frame> {
        let command = self.ask.request().map(|request| request.frame.command);
        let frames = self.attempts.iter().flat_map(Attempt::frames).map(|(_, frame, _)| frame);
        frames.filter(move |frame| Some(frame.command) == command)
    }

    /// The time to the last byte of a short reply to the only attempt.
    ///
    /// A long reply takes its time on a serial line, also on the one behind an Ethernet module.
    pub(crate) fn response_time(&self, framing: Framing) -> Option<Duration> {
        let ([attempt], Ask::Reply(request)) = (&self.attempts[..], &self.ask) else { return None };
        let is_short = |arrival: &&Arrival| matches!(&arrival.item, Item::Frame(_, bytes) if bytes.len() <= SHORT);
        attempt.reply(request, framing).filter(is_short).map(|arrival| arrival.after)
    }
}

impl Attempt {
    /// The frames that came, with their bytes.
    pub(crate) fn frames(&self) -> impl Iterator<Item = (&Arrival, &Frame, &Bytes)> {
        self.arrivals.iter().filter_map(|arrival| match &arrival.item {
            Item::Frame(frame, bytes) => Some((arrival, frame, bytes)),
            Item::Echo(_) | Item::Noise(..) => None,
        })
    }

    /// The awaited frame that is the reply to the request. The station is not compared.
    pub(crate) fn reply(&self, request: &Request, framing: Framing) -> Option<&Arrival> {
        let mut awaited = self.frames().filter(|(arrival, ..)| !arrival.unawaited);
        awaited.find(|(_, frame, _)| fit(request, frame, framing) != Answer::None).map(|(arrival, ..)| arrival)
    }

    fn answer(&self, request: &Request, framing: Framing) -> Answer<'_> {
        let answers = self.frames().filter(|(arrival, ..)| !arrival.unawaited);
        let mut answers = answers.map(|(_, frame, _)| fit(request, frame, framing));
        answers.find(|answer| *answer != Answer::None).unwrap_or(Answer::None)
    }
}

/// The answer that a frame is to a request.
pub(crate) fn fit<'a>(request: &Request, frame: &'a Frame, framing: Framing) -> Answer<'a> {
    if frame.command != request.frame.command {
        return Answer::None;
    }
    let data = &frame.data[..];
    match request.shape {
        Shape::Echo if data == request.frame.data => return Answer::Data(data),
        Shape::Echo if data.len() != 1 => return Answer::None,
        // A page alone has no error digit.
        Shape::Page if data.len() == PAGE => return Answer::Data(data),
        Shape::Echo | Shape::Page | Shape::Len(_) | Shape::AtLeast(_) | Shape::Any => {}
    }
    let Some((&first, rest)) = data.split_first() else { return Answer::None };
    let code = match framing {
        Framing::Ascii => char::from(first).to_digit(16).and_then(|code| u8::try_from(code).ok()),
        Framing::Binary | _ => Some(first),
    };
    let fits = match request.shape {
        Shape::Len(len) => rest.len() == len,
        Shape::AtLeast(len) => rest.len() >= len,
        Shape::Page => rest.len() == PAGE,
        Shape::Any => true,
        Shape::Echo => false,
    };
    match code {
        None => Answer::None,
        Some(0) => {
            if fits {
                Answer::Data(rest)
            } else {
                Answer::None
            }
        }
        // Data behind an error code are a matter of their own.
        Some(code) => Answer::Refused(code),
    }
}

/// Bytes of a short frame.
const SHORT: usize = 24;
/// Characters of a program page.
const PAGE: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::request::Requests;
    use fatek::command::Code;

    #[test]
    fn a_frame_fits_by_command_error_code_and_length() {
        let requests = Requests { framing: Framing::Ascii, station: 1 };
        let read = requests.read(Code::ReadRegisters, 1, "R0");
        let frame = |command, data: &str| Frame { station: 9, command, data: data.to_owned().into() };
        let fits = |command, data: &str| match fit(&read, &frame(command, data), Framing::Ascii) {
            Answer::Data(data) => Ok(String::from_utf8(data.to_vec()).unwrap()),
            Answer::Refused(code) => Err(Some(code)),
            Answer::None => Err(None),
        };
        assert_eq!(fits(0x46, "01234"), Ok("1234".to_owned()));
        assert_eq!(fits(0x46, "A"), Err(Some(10)));
        assert_eq!(fits(0x46, "20000"), Err(Some(2)));
        for (command, data) in [(0x46, "0123"), (0x46, "012345"), (0x48, "01234"), (0x46, ""), (0x46, "Z")] {
            assert_eq!(fits(command, data), Err(None), "{command} {data}");
        }
        let echo = requests.loop_back("AB");
        assert_eq!(fit(&echo, &frame(0x4E, "AB"), Framing::Ascii), Answer::Data(b"AB"));
        assert_eq!(fit(&echo, &frame(0x4E, "AC"), Framing::Ascii), Answer::None);
        assert_eq!(fit(&echo, &frame(0x4E, "4"), Framing::Ascii), Answer::Refused(4));
    }
}
