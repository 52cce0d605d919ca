//! Test oracle for the promise itself: a call gets only the reply to its own request. It does not
//! use the rules.
//!
//! The oracle records the request of each frame, and whether each station kept the assumptions:
//! replies and their copies come in the order of the requests; copies of a taken reply come before
//! the copy window has passed in silence; old replies come before the silence that replaces a
//! check. A station that broke them is *tainted* until a check is answered.

use std::collections::BTreeMap;

use super::state::{CallResult, Id, Micros};

/// Origin of a frame, attached by its sender.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Mark {
    /// Number of the request that it answers; `None`: a request of an earlier process.
    pub(crate) request: Option<usize>,
    /// Position in the order of the requests.
    pub(crate) order: u64,
    /// Content of its registers.
    pub(crate) tag: u16,
    pub(crate) refusal: Option<u8>,
    pub(crate) broadcast: bool,
}

/// Tag of content that several replies share.
pub(crate) const COMMON_TAG: u16 = 0xFFF;

impl Mark {
    /// Position of a request of this link.
    pub(crate) fn order_of(request: usize) -> u64 {
        3 * request as u64 + 3
    }

    /// Position of requests that other clients sent before this one.
    pub(crate) fn order_before(request: usize) -> u64 {
        3 * request as u64 + 1
    }
}

#[derive(Debug, Default)]
pub(crate) struct Oracle {
    requests: Vec<SentRequest>,
    received: Vec<Mark>,
    stations: BTreeMap<u8, ReplyOrder>,
    window: Micros,
}

#[derive(Debug)]
struct SentRequest {
    station: u8,
    call: Option<Id>,
    at: Micros,
    nonce: bool,
}

#[derive(Debug, Default)]
struct ReplyOrder {
    /// Position of the newest reply.
    newest: u64,
    /// Arrival of the first reply with that position.
    first: Micros,
    last: Micros,
    tainted: bool,
}

impl Oracle {
    pub(crate) fn new(window: Micros) -> Self {
        Self { window, ..Self::default() }
    }

    pub(crate) fn request_sent(&mut self, station: u8, call: Option<Id>, nonce: bool, at: Micros) {
        self.requests.push(SentRequest { station, call, at, nonce });
    }

    /// Records a frame of a station.
    pub(crate) fn frame_received(&mut self, station: u8, mark: Option<Mark>, at: Micros) {
        let order = self.stations.entry(station).or_default();
        let (last, count) = (std::mem::replace(&mut order.last, at), self.requests.len());
        let Some(mark) = mark else {
            order.tainted = true;
            return;
        };
        self.received.push(mark);
        let request = mark.request.and_then(|number| Some((number, self.requests.get(number)?)));
        if mark.order > order.newest {
            (order.newest, order.first) = (mark.order, at);
        } else if mark.order < order.newest {
            order.tainted = true;
            return;
        } else if let (Some((_, request)), false) = (request, mark.broadcast) {
            let window = self.window.max(2 * order.first.saturating_sub(request.at));
            order.tainted |= at - last >= window;
        }
        if let Some((number, request)) = request
            && (number + 1 == count && request.nonce && mark.refusal.is_none())
        {
            order.tainted = false;
        }
    }

    /// Records that the station was silent for the quiet time before the next request.
    pub(crate) fn was_silent(&mut self, station: u8) {
        let next = Mark::order_of(self.requests.len());
        let order = self.stations.entry(station).or_default();
        (order.newest, order.tainted) = (next - 1, false);
    }

    /// Checks the result of a call.
    pub(crate) fn ended(&self, id: Id, end: &CallResult) -> Result<(), String> {
        let own = self.requests.iter().rposition(|request| request.call == Some(id));
        let (Some(own), CallResult::Done(_) | CallResult::Refused { .. }) = (own, end) else { return Ok(()) };
        let station = self.requests[own].station;
        if station == 0 || self.stations.get(&station).is_some_and(|order| order.tainted) {
            return Ok(());
        }
        let of_own = |mark: &&Mark| mark.request == Some(own);
        let found = match end {
            CallResult::Done(words) => match words.first() {
                None => self.received.iter().filter(of_own).any(|mark| mark.refusal.is_none()),
                Some(word) if word & 0xFFF == COMMON_TAG => true,
                Some(first) => {
                    // The first register may be the second of the reply if the request began
                    // earlier.
                    let in_order = words.iter().zip(first >> 12..).all(|(&word, n)| word == first & 0xFFF | n << 12);
                    in_order && self.received.iter().filter(of_own).any(|mark| mark.tag == first & 0xFFF)
                }
            },
            CallResult::Refused { code, .. } => {
                self.received.iter().filter(of_own).any(|mark| mark.refusal == Some(*code))
            }
            _ => true,
        };
        if found { Ok(()) } else { Err(format!("call {id} was given the reply to another request: {end:?}")) }
    }
}
