//! A request to a station of which nothing is known yet: its reply, and all other traffic. No I/O and
//! no clock; [`exchange`] has both.
//!
//! A [`Link`](fatek::Link) is for stations that are known: it checks each connection with a loop-back
//! and takes its framing for granted. Here any traffic is a result. Stale replies do no harm: the
//! status of a station, with its number, is true also if it is late.

pub(crate) mod exchange;

use bytes::{Bytes, BytesMut};
use fatek::ErrorCode;
use fatek::command::{Command, InvalidRequest, ReplyError, encode_request};
use fatek::wire::{Codec, Frame, Framing, Received, Side};
use tokio_util::codec::Decoder;

/// Limit of the received bytes that are kept for messages.
const MAX_SAMPLE: usize = 64;
/// Limit of the frames that are kept.
const MAX_FRAMES: usize = 64;

/// A reply to a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Reply<T> {
    Good(T),
    Refused(ErrorCode),
}

/// Traffic besides the reply.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Traffic {
    /// All received bytes, those of the reply included.
    pub(crate) bytes: usize,
    /// Bytes of no good frame.
    pub(crate) garbage: usize,
    /// Echoes of the request.
    pub(crate) echoes: usize,
    /// Good frames that are no reply to the request; the first [`MAX_FRAMES`].
    pub(crate) frames: Vec<Frame>,
    /// The first bytes of no good frame.
    pub(crate) sample: Vec<u8>,
}

impl Traffic {
    /// Adds the traffic of another request.
    pub(crate) fn add(&mut self, other: Self) {
        self.bytes += other.bytes;
        self.garbage += other.garbage;
        self.echoes += other.echoes;
        self.frames.extend(other.frames);
        self.frames.truncate(MAX_FRAMES);
        self.keep(&other.sample);
    }

    fn discard(&mut self, bytes: &[u8]) {
        self.garbage += bytes.len();
        self.keep(bytes);
    }

    fn keep(&mut self, bytes: &[u8]) {
        let room = MAX_SAMPLE.saturating_sub(self.sample.len());
        self.sample.extend(bytes.iter().take(room));
    }
}

/// A request in one framing, and the traffic since it was sent.
///
/// Invariants: at most one reply is returned; each received byte is counted once; memory is bounded
/// by the longest frame, [`MAX_SAMPLE`] and [`MAX_FRAMES`].
#[derive(Debug)]
pub(crate) struct Enquiry<C> {
    command: C,
    framing: Framing,
    station: u8,
    request: Bytes,
    codec: Codec,
    buffer: BytesMut,
    is_answered: bool,
    traffic: Traffic,
}

impl<C: Command> Enquiry<C> {
    pub(crate) fn new(command: C, framing: Framing, station: u8) -> Result<Self, InvalidRequest> {
        let mut request = BytesMut::new();
        encode_request(&command, framing, station, &mut request)?;
        Ok(Self {
            command,
            framing,
            station,
            request: request.freeze(),
            codec: Codec::new(framing, Side::Client),
            buffer: BytesMut::new(),
            is_answered: false,
            traffic: Traffic::default(),
        })
    }

    /// The bytes to be sent.
    pub(crate) fn request(&self) -> Bytes {
        self.request.clone()
    }

    /// Takes received bytes. Returns the reply if they complete it.
    pub(crate) fn receive(&mut self, bytes: &[u8]) -> Option<Reply<C::Reply>> {
        self.traffic.bytes += bytes.len();
        self.buffer.extend_from_slice(bytes);
        let mut reply = None;
        while let Ok(Some(item)) = self.codec.decode(&mut self.buffer) {
            reply = self.take(item).or(reply);
        }
        reply
    }

    /// Ends it: the traffic besides the reply. Incomplete frames are garbage.
    pub(crate) fn end(mut self) -> Traffic {
        while let Ok(Some(item)) = self.codec.decode_eof(&mut self.buffer) {
            self.take(item);
        }
        self.traffic
    }

    fn take(&mut self, item: Received) -> Option<Reply<C::Reply>> {
        let frame = match item {
            Received::Frame(frame) => frame,
            Received::Discarded { bytes, .. } if bytes == self.request => {
                self.traffic.echoes += 1;
                return None;
            }
            Received::Discarded { bytes, .. } => {
                self.traffic.discard(&bytes);
                return None;
            }
            _ => return None,
        };
        if frame.station == self.station && !self.is_answered {
            let reply = match frame.decode_reply(&self.command, self.framing) {
                Ok(reply) => Some(Reply::Good(reply)),
                Err(ReplyError::Plc(code)) => Some(Reply::Refused(code)),
                Err(_) => None,
            };
            if reply.is_some() {
                self.is_answered = true;
                return reply;
            }
        }
        if Frame::request(self.station, &self.command, self.framing).is_ok_and(|request| request == frame) {
            self.traffic.echoes += 1;
        } else if self.traffic.frames.len() < MAX_FRAMES {
            self.traffic.frames.push(frame);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fatek::command::{BriefStatus, ReadStatus, encode_refusal, encode_reply};

    const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

    fn enquiry(framing: Framing) -> Enquiry<ReadStatus> {
        Enquiry::new(ReadStatus, framing, 3).unwrap()
    }

    fn status(framing: Framing, station: u8) -> BytesMut {
        let mut frame = BytesMut::new();
        encode_reply(&ReadStatus, Ok(&BriefStatus::from_raw([1, 0x40, 0])), framing, station, &mut frame);
        frame
    }

    #[test]
    fn a_reply_in_pieces_is_found_among_garbage_and_echo() {
        for framing in FRAMINGS {
            let mut enquiry = enquiry(framing);
            let mut bytes = enquiry.request().to_vec();
            bytes.extend_from_slice(b"\x06\xff");
            bytes.extend_from_slice(&status(framing, 3));
            let replies: Vec<_> = bytes.chunks(1).filter_map(|byte| enquiry.receive(byte)).collect();
            assert_eq!(replies, [Reply::Good(BriefStatus::from_raw([1, 0x40, 0]))], "{framing}");
            let traffic = enquiry.end();
            assert_eq!((traffic.bytes, traffic.garbage, traffic.echoes), (bytes.len(), 2, 1), "{framing}");
            assert_eq!((traffic.frames.len(), &traffic.sample[..]), (0, &b"\x06\xff"[..]), "{framing}");
        }
    }

    #[test]
    fn frames_of_others_and_duplicates_are_no_replies() {
        for framing in FRAMINGS {
            let mut enquiry = enquiry(framing);
            assert_eq!(enquiry.receive(&status(framing, 4)), None, "{framing}");
            let twice = [status(framing, 3), status(framing, 3)].concat();
            assert!(enquiry.receive(&twice).is_some(), "{framing}");
            assert_eq!(enquiry.receive(&status(framing, 3)), None, "{framing}");
            let stations: Vec<u8> = enquiry.end().frames.iter().map(|frame| frame.station).collect();
            assert_eq!(stations, [4, 3, 3], "{framing}");
        }
    }

    #[test]
    fn a_refusal_is_a_reply() {
        for framing in FRAMINGS {
            let mut enquiry = enquiry(framing);
            let mut frame = BytesMut::new();
            encode_refusal(0x40, ErrorCode::IllegalFormat, framing, 3, &mut frame);
            assert_eq!(enquiry.receive(&frame), Some(Reply::Refused(ErrorCode::IllegalFormat)), "{framing}");
        }
    }

    #[test]
    fn a_reply_in_the_other_framing_is_garbage() {
        for (own, other) in [(Framing::Ascii, Framing::Binary), (Framing::Binary, Framing::Ascii)] {
            let mut enquiry = enquiry(own);
            let frame = status(other, 3);
            assert_eq!(enquiry.receive(&frame), None);
            let traffic = enquiry.end();
            assert_eq!((traffic.garbage, traffic.frames.len()), (frame.len(), 0), "{own}");
        }
    }

    #[test]
    fn endless_traffic_takes_bounded_memory() {
        let mut enquiry = enquiry(Framing::Ascii);
        let other = status(Framing::Ascii, 9).repeat(100);
        for _ in 0..100 {
            assert_eq!(enquiry.receive(&[0x55; 4096]), None);
            assert_eq!(enquiry.receive(&other), None);
        }
        assert!(enquiry.buffer.len() <= fatek::wire::MAX_FRAME_LEN);
        let traffic = enquiry.end();
        assert_eq!((traffic.garbage, traffic.frames.len(), traffic.sample.len()), (409_600, MAX_FRAMES, MAX_SAMPLE));
        let mut sum = traffic.clone();
        sum.add(traffic);
        assert_eq!((sum.garbage, sum.frames.len(), sum.sample.len()), (819_200, MAX_FRAMES, MAX_SAMPLE));
    }
}
