//! The promise itself: a result is given to a call only if it is the reply to this call's own request.
//!
//! The witness knows of each frame which request it answers, and of each line whether it kept to the assumption: replies
//! and their copies come in the order of the requests, copies of a taken reply before the window has passed in silence, and
//! old replies before the silence that replaced a check. A station that broke it is *tainted* until a check has come back.

use std::collections::BTreeMap;

use super::state::{End, Id, Micros};

/// What a frame is, by the one who sent it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Mark {
    /// The request of this link that it answers; `None`: one of an earlier process.
    pub(crate) request: Option<usize>,
    /// Its place in the order of the requests.
    pub(crate) order: u64,
    /// The content of its registers.
    pub(crate) tag: u16,
    pub(crate) refusal: Option<u8>,
    pub(crate) broadcast: bool,
}

/// The tag of content that is the same in many replies.
pub(crate) const COMMON: u16 = 0xFFF;

impl Mark {
    /// The place in the order of a request of this link.
    pub(crate) fn order_of(request: usize) -> u64 {
        3 * request as u64 + 3
    }

    /// The place of replies to what others asked before this request of the link.
    pub(crate) fn order_before(request: usize) -> u64 {
        3 * request as u64 + 1
    }
}

#[derive(Debug, Default)]
pub(crate) struct Witness {
    asked: Vec<Asked>,
    heard: Vec<Mark>,
    stations: BTreeMap<u8, Order>,
    window: Micros,
}

#[derive(Debug)]
struct Asked {
    station: u8,
    call: Option<Id>,
    at: Micros,
    nonce: bool,
}

#[derive(Debug, Default)]
struct Order {
    /// The place of the newest reply.
    newest: u64,
    /// When the first reply of that place came.
    first: Micros,
    last: Micros,
    tainted: bool,
}

impl Witness {
    pub(crate) fn new(window: Micros) -> Self {
        Self { window, ..Self::default() }
    }

    pub(crate) fn asked(&mut self, station: u8, call: Option<Id>, nonce: bool, at: Micros) {
        self.asked.push(Asked { station, call, at, nonce });
    }

    /// A frame has come from a station.
    pub(crate) fn heard(&mut self, station: u8, mark: Option<Mark>, at: Micros) {
        let order = self.stations.entry(station).or_default();
        let (last, asked) = (std::mem::replace(&mut order.last, at), self.asked.len());
        let Some(mark) = mark else {
            order.tainted = true;
            return;
        };
        self.heard.push(mark);
        let request = mark.request.and_then(|number| Some((number, self.asked.get(number)?)));
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
            && (number + 1 == asked && request.nonce && mark.refusal.is_none())
        {
            order.tainted = false;
        }
    }

    /// The station was silent for the quiet time before what is asked next.
    pub(crate) fn was_silent(&mut self, station: u8) {
        let next = Mark::order_of(self.asked.len());
        let order = self.stations.entry(station).or_default();
        (order.newest, order.tainted) = (next - 1, false);
    }

    /// A call has ended: the result must be its own.
    pub(crate) fn ended(&self, id: Id, end: &End) -> Result<(), String> {
        let own = self.asked.iter().rposition(|asked| asked.call == Some(id));
        let (Some(own), End::Done(_) | End::Refused { .. }) = (own, end) else { return Ok(()) };
        let station = self.asked[own].station;
        if station == 0 || self.stations.get(&station).is_some_and(|order| order.tainted) {
            return Ok(());
        }
        let of_own = |mark: &&Mark| mark.request == Some(own);
        let found = match end {
            End::Done(words) => match words.first() {
                None => self.heard.iter().filter(of_own).any(|mark| mark.refusal.is_none()),
                Some(word) if word & 0xFFF == COMMON => true,
                Some(first) => {
                    // The first may be the second of the reply, where the request began before.
                    let in_order = words.iter().zip(first >> 12..).all(|(&word, n)| word == first & 0xFFF | n << 12);
                    in_order && self.heard.iter().filter(of_own).any(|mark| mark.tag == first & 0xFFF)
                }
            },
            End::Refused { code, .. } => self.heard.iter().filter(of_own).any(|mark| mark.refusal == Some(*code)),
            _ => true,
        };
        if found { Ok(()) } else { Err(format!("call {id} was given the reply to another request: {end:?}")) }
    }
}
