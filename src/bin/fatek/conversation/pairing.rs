//! Pairing of requests with replies on one connection.
//!
//! There is no transaction number in the protocol, and a reply does not repeat the address that it
//! answers. A reply belongs to the oldest open request of its station that it fits, since a station
//! answers in order.
//!
//! States of a request:
//! - open
//! - answered
//! - retried: the client has sent the same request again
//! - unanswered: a later request of its station was answered, or the client has given it up, or
//!   [`GIVE_UP_AFTER`] or [`MAX_OPEN`] was exceeded, or the connection has ended
//!
//! A client that waits for each reply has given a request up when it sends another one after a silence
//! of the station ([`CLIENT_WAITS`]), or after bytes of the PLC that are bad or missing, which may have
//! been the reply. Otherwise all replies after a lost one would belong to the request before theirs.
//! The last unanswered requests are kept, to know their late replies.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use bytes::Bytes;
use fatek::command::Request;
use fatek::wire::{Framing, MAX_FRAME_LEN};

use super::entry::{Answer, Entry, Exchange, Found, Outcome, SeenFrame, StrayReply, Verdict};
use super::{Direction, Timestamp};

/// Open requests of a connection. One more makes the oldest an unanswered one.
pub(super) const MAX_OPEN: usize = 32;

/// Unanswered requests whose late replies are known.
const MAX_UNANSWERED: usize = 8;

/// Time after which an open request is unanswered.
const GIVE_UP_AFTER: Duration = Duration::from_secs(30);

/// Silence of a station in which clients that do not wait for replies send further requests.
const CLIENT_WAITS: Duration = Duration::from_millis(50);

const BROADCAST: u8 = 0;

#[derive(Debug)]
pub(super) struct Pairer {
    connection: u64,
    /// In order of arrival.
    open: VecDeque<OpenRequest>,
    unanswered: VecDeque<OpenRequest>,
    /// Last reply of each station, with its time.
    last_replies: BTreeMap<u8, (Timestamp, Bytes)>,
}

#[derive(Clone, Debug)]
struct OpenRequest {
    at: Timestamp,
    seen: SeenFrame,
    decoded: Result<Request, String>,
    attempt: u32,
    /// Bytes that are bad or missing have come since.
    is_doubtful: bool,
}

impl Pairer {
    pub(super) fn new(connection: u64) -> Self {
        Self { connection, open: VecDeque::new(), unanswered: VecDeque::new(), last_replies: BTreeMap::new() }
    }

    pub(super) fn push(&mut self, direction: Direction, at: Timestamp, seen: SeenFrame, entries: &mut Vec<Entry>) {
        self.give_up(at, entries);
        match direction {
            Direction::ToPlc => self.request(at, seen, entries),
            Direction::FromPlc => self.reply(at, seen, entries),
        }
    }

    /// Takes bytes of no good frame. Those of successive items are one entry.
    pub(super) fn push_bad(
        &mut self,
        direction: Direction,
        at: Timestamp,
        bytes: Bytes,
        framing: Framing,
        entries: &mut Vec<Entry>,
    ) {
        if direction == Direction::FromPlc {
            self.doubt();
        }
        if let Some(Entry { found: Found::Bad { direction: last, bytes: before, .. }, connection, at: last_at }) =
            entries.last_mut()
            && (*last, *connection, *last_at) == (direction, self.connection, at)
            && before.len() + bytes.len() <= MAX_FRAME_LEN
        {
            *before = [&before[..], &bytes[..]].concat().into();
            return;
        }
        entries.push(Entry { connection: self.connection, at, found: Found::Bad { direction, bytes, framing } });
    }

    /// Ends all open requests.
    pub(super) fn finish(&mut self, entries: &mut Vec<Entry>) {
        while let Some(request) = self.open.pop_front() {
            self.close(request, entries);
        }
    }

    fn give_up(&mut self, now: Timestamp, entries: &mut Vec<Entry>) {
        while let Some(first) = self.open.front()
            && (self.open.len() > MAX_OPEN || now.saturating_sub(first.at) > GIVE_UP_AFTER)
            && let Some(first) = self.open.pop_front()
        {
            self.close(first, entries);
        }
    }

    /// Notes that bytes of the PLC are bad or missing.
    pub(super) fn doubt(&mut self) {
        self.open.iter_mut().for_each(|request| request.is_doubtful = true);
    }

    /// Ends the open requests of a station that the client has given up when it sends another one.
    fn close_given_up(&mut self, station: u8, now: Timestamp, entries: &mut Vec<Entry>) {
        let heard_at = self.last_replies.get(&station).map_or(Timestamp::ZERO, |&(at, _)| at);
        for request in std::mem::take(&mut self.open) {
            let is_silent = now.saturating_sub(request.at.max(heard_at)) > CLIENT_WAITS;
            if request.seen.frame.station == station && (request.is_doubtful || is_silent) {
                self.close(request, entries);
            } else {
                self.open.push_back(request);
            }
        }
    }

    fn request(&mut self, at: Timestamp, seen: SeenFrame, entries: &mut Vec<Entry>) {
        let decoded = Request::decode(&seen.frame, seen.framing).map_err(|error| error.to_string());
        let mut request = OpenRequest { at, seen, decoded, attempt: 1, is_doubtful: false };
        if request.seen.frame.station == BROADCAST {
            entries.push(self.entry(request, Outcome::Broadcast));
            return;
        }
        let is_same = |other: &OpenRequest| other.seen.frame == request.seen.frame;
        if let Some(same) = self.open.iter().position(is_same).and_then(|same| self.open.remove(same)) {
            request.attempt = same.attempt.saturating_add(1);
            self.remember(same.clone());
            entries.push(self.entry(same, Outcome::Retried));
        }
        self.close_given_up(request.seen.frame.station, at, entries);
        self.open.push_back(request);
        self.give_up(at, entries);
    }

    fn reply(&mut self, at: Timestamp, seen: SeenFrame, entries: &mut Vec<Entry>) {
        let station = seen.frame.station;
        let fitting = self.open.iter().enumerate().find_map(|(i, open)| Some((i, open.verdict(&seen)?)));
        let copied = self.last_replies.insert(station, (at, seen.bytes.clone()));
        let copied = copied.is_some_and(|(_, last)| last == seen.bytes);
        if let Some((number, verdict)) = fitting {
            return self.answer(number, at, seen, verdict, entries);
        }
        let late = self.unanswered.iter().position(|request| request.verdict(&seen).is_some());
        let why = if copied {
            StrayReply::Doubled
        } else if let Some(request) = late.and_then(|late| self.unanswered.remove(late)) {
            StrayReply::Late(at.saturating_sub(request.at))
        } else if let Some((number, rule)) =
            self.open.iter().enumerate().find_map(|(i, open)| Some((i, open.mismatch(&seen)?)))
        {
            return self.answer(number, at, seen, Verdict::Mismatch(rule), entries);
        } else {
            StrayReply::Unexpected
        };
        entries.push(Entry { connection: self.connection, at, found: Found::Stray { reply: seen, why } });
    }

    /// Ends the open request with this index, and those before it of the same station.
    fn answer(&mut self, number: usize, at: Timestamp, reply: SeenFrame, verdict: Verdict, entries: &mut Vec<Entry>) {
        let later = self.open.split_off((number + 1).min(self.open.len()));
        let answered = self.open.pop_back();
        for earlier in std::mem::take(&mut self.open) {
            if earlier.seen.frame.station == reply.frame.station {
                self.close(earlier, entries);
            } else {
                self.open.push_back(earlier);
            }
        }
        self.open.extend(later);
        if let Some(request) = answered {
            let round_trip = at.saturating_sub(request.at);
            entries.push(self.entry(request, Outcome::Answered(Answer { round_trip, reply, verdict })));
        }
    }

    fn close(&mut self, request: OpenRequest, entries: &mut Vec<Entry>) {
        self.remember(request.clone());
        entries.push(self.entry(request, Outcome::Unanswered));
    }

    fn remember(&mut self, request: OpenRequest) {
        self.unanswered.push_back(request);
        if self.unanswered.len() > MAX_UNANSWERED {
            self.unanswered.pop_front();
        }
    }

    fn entry(&self, request: OpenRequest, outcome: Outcome) -> Entry {
        let OpenRequest { at, seen, decoded, attempt, .. } = request;
        let exchange = Exchange { request: seen, decoded, attempt, outcome };
        Entry { connection: self.connection, at, found: Found::Exchange(Box::new(exchange)) }
    }
}

impl OpenRequest {
    /// The meaning of a reply of its station, or the rule that it breaks; `None` if it is of another
    /// station.
    fn read(&self, reply: &SeenFrame) -> Option<Result<Verdict, String>> {
        let is_own = self.seen.frame.station == reply.frame.station;
        is_own.then(|| Verdict::of(&self.seen, &self.decoded, reply))
    }

    /// The meaning of a reply that fits; `None` if it does not.
    fn verdict(&self, reply: &SeenFrame) -> Option<Verdict> {
        self.read(reply)?.ok()
    }

    /// The rule that a reply with station and command of this request breaks.
    fn mismatch(&self, reply: &SeenFrame) -> Option<String> {
        self.read(reply)?.err().filter(|rule| !rule.is_empty())
    }
}
