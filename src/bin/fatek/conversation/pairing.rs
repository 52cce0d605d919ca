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
//! After bytes of the PLC that are bad or missing, which may have been the reply, a request is given up
//! when the client sends another one. After a silence of the station ([`CLIENT_WAITS`]) it is suspect:
//! either the client has given it up, or it does not wait for replies and the station is slow. A reply
//! that fits a suspect request and a later one is held, until one of the two is refuted:
//! - Replies to all open requests: the station was slow, and they are paired in order.
//! - A reply that fits in one of the two cases only.
//! - Another request after a silence as long as the reply would have taken, or round trips that would
//!   be much longer than the others: the suspect requests are given up.
//!
//! If neither is refuted ([`MAX_HELD`], or the end), the suspect requests are given up, and the replies
//! are ambiguous; so are those that follow, until the station is silent long enough for the reply that
//! might still come. The last unanswered requests are kept, to know their late replies.
//!
//! Invariants: held replies of a station fit in both cases, and there are fewer than open requests.
//! Suspect requests of a station are its oldest ones.

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

/// Suspect requests of a station. One more makes the oldest an unanswered one.
const MAX_SUSPECT: usize = 4;

/// Held replies of a station, which delay the output.
const MAX_HELD: usize = 8;

/// Held replies whose round trips tell whether suspect requests are given up.
const MANY_HELD: usize = 4;

const BROADCAST: u8 = 0;

#[derive(Debug)]
pub(super) struct Pairer {
    connection: u64,
    /// In order of arrival.
    open: VecDeque<OpenRequest>,
    unanswered: VecDeque<OpenRequest>,
    /// Last reply of each station, with its time.
    last_replies: BTreeMap<u8, (Timestamp, Bytes)>,
    /// Replies that fit a suspect request and a later one, of each station.
    held: BTreeMap<u8, Vec<HeldReply>>,
    /// Stations whose replies are ambiguous, each with the silence that ends it.
    ambiguous: BTreeMap<u8, Duration>,
    /// Longest round trip of each station that is not ambiguous.
    longest_round_trips: BTreeMap<u8, Duration>,
}

#[derive(Debug)]
struct HeldReply {
    at: Timestamp,
    seen: SeenFrame,
    /// Number of suspect requests that are given up if not all are answered: no more than leave a request
    /// that was sent before this reply. It does not grow from one reply to the next.
    given_up: usize,
}

/// The requests that held replies belong to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Assignment {
    /// All open ones in order: the station was slow.
    InOrder,
    /// Those behind the suspect ones, which the client has given up, as far as there are enough.
    SuspectGivenUp,
}

#[derive(Clone, Debug)]
struct OpenRequest {
    at: Timestamp,
    seen: SeenFrame,
    decoded: Result<Request, String>,
    attempt: u32,
    /// Bytes that are bad or missing have come since.
    is_doubtful: bool,
    /// Another request was sent after a silence.
    is_suspect: bool,
}

impl Pairer {
    pub(super) fn new(connection: u64) -> Self {
        Self {
            connection,
            open: VecDeque::new(),
            unanswered: VecDeque::new(),
            last_replies: BTreeMap::new(),
            held: BTreeMap::new(),
            ambiguous: BTreeMap::new(),
            longest_round_trips: BTreeMap::new(),
        }
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
        while let Some((&station, _)) = self.held.first_key_value() {
            self.give_up_suspect(station, entries);
        }
        while let Some(request) = self.open.pop_front() {
            self.close(request, entries);
        }
    }

    fn give_up(&mut self, now: Timestamp, entries: &mut Vec<Entry>) {
        while let Some(first) = self.open.front()
            && (self.open.len() > MAX_OPEN || now.saturating_sub(first.at) > GIVE_UP_AFTER)
        {
            let station = first.seen.frame.station;
            if self.held.contains_key(&station) {
                self.give_up_suspect(station, entries);
            } else if let Some(first) = self.open.pop_front() {
                self.close(first, entries);
            }
        }
    }

    /// Notes that bytes of the PLC are bad or missing.
    pub(super) fn doubt(&mut self) {
        self.open.iter_mut().for_each(|request| request.is_doubtful = true);
    }

    /// Time of the last reply of a station.
    fn heard_at(&self, station: u8) -> Timestamp {
        self.last_replies.get(&station).map_or(Timestamp::ZERO, |&(at, _)| at)
    }

    /// Decides about the open requests of a station when the client sends another one: doubtful ones are
    /// given up, and those after a silence are suspect.
    fn before_request(&mut self, station: u8, now: Timestamp, entries: &mut Vec<Entry>) {
        let heard_at = self.heard_at(station);
        let silence = now.saturating_sub(heard_at);
        if let Some(age) = self.age_of_held(station) {
            let is_doubtful = self.own(station).any(|open| open.is_doubtful);
            if silence >= age || self.are_suspect_given_up(station) {
                self.assign(station, Assignment::SuspectGivenUp, false, entries);
            } else if is_doubtful {
                self.give_up_suspect(station, entries);
            }
        }
        let is_quiet = self.ambiguous.get(&station).is_some_and(|&limit| silence >= limit);
        if is_quiet && self.own(station).next().is_none() {
            self.ambiguous.remove(&station);
        }
        let is_holding = self.held.contains_key(&station);
        let mut suspect = 0;
        // From the newest on, so that the oldest suspect ones are given up.
        for mut request in std::mem::take(&mut self.open).into_iter().rev() {
            let is_own = request.seen.frame.station == station;
            let is_silent = now.saturating_sub(request.at.max(heard_at)) > CLIENT_WAITS;
            // With held replies, later requests may have been answered already.
            request.is_suspect |= is_own && is_silent && !is_holding;
            suspect += usize::from(is_own && request.is_suspect);
            if is_own && (request.is_doubtful || (request.is_suspect && suspect > MAX_SUSPECT)) {
                request.is_doubtful = true;
            }
            self.open.push_front(request);
        }
        for request in std::mem::take(&mut self.open) {
            if request.seen.frame.station == station && request.is_doubtful {
                self.close(request, entries);
            } else {
                self.open.push_back(request);
            }
        }
    }

    fn request(&mut self, at: Timestamp, seen: SeenFrame, entries: &mut Vec<Entry>) {
        let decoded = Request::decode(&seen.frame, seen.framing).map_err(|error| error.to_string());
        let mut request = OpenRequest { at, seen, decoded, attempt: 1, is_doubtful: false, is_suspect: false };
        let station = request.seen.frame.station;
        if station == BROADCAST {
            entries.push(self.entry(request, Outcome::Broadcast));
            return;
        }
        let is_same = |other: &OpenRequest| other.seen.frame == request.seen.frame;
        if self.held.contains_key(&station) && self.open.iter().any(is_same) {
            // A retry, if the open one has no reply yet.
            self.give_up_suspect(station, entries);
        }
        let retried = self.open.iter().position(|open| is_same(open) && !open.is_suspect);
        if let Some(same) = retried.and_then(|same| self.open.remove(same)) {
            request.attempt = same.attempt.saturating_add(1);
            self.remember(same.clone());
            entries.push(self.entry(same, Outcome::Retried));
        }
        self.before_request(station, at, entries);
        self.open.push_back(request);
        self.give_up(at, entries);
    }

    fn reply(&mut self, at: Timestamp, seen: SeenFrame, entries: &mut Vec<Entry>) {
        let station = seen.frame.station;
        let copied = self.last_replies.insert(station, (at, seen.bytes.clone()));
        let copied = copied.is_some_and(|(_, last)| last == seen.bytes);
        let Some(seen) = self.hold(at, seen, entries) else { return };
        let fitting = self.open.iter().enumerate().find_map(|(i, open)| Some((i, open.verdict(&seen)?)));
        if let Some((number, verdict)) = fitting {
            return self.answer(number, at, seen, verdict, false, entries);
        }
        let late = self.unanswered.iter().position(|request| request.verdict(&seen).is_some());
        let why = if copied {
            StrayReply::Doubled
        } else if let Some(request) = late.and_then(|late| self.unanswered.remove(late)) {
            StrayReply::Late(at.saturating_sub(request.at))
        } else if let Some((number, rule)) =
            self.open.iter().enumerate().find_map(|(i, open)| Some((i, open.mismatch(&seen)?)))
        {
            return self.answer(number, at, seen, Verdict::Mismatch(rule), false, entries);
        } else {
            StrayReply::Unexpected
        };
        entries.push(Entry { connection: self.connection, at, found: Found::Stray { reply: seen, why } });
    }

    /// Holds a reply that fits a suspect request and a later one. Returns all others.
    fn hold(&mut self, at: Timestamp, seen: SeenFrame, entries: &mut Vec<Entry>) -> Option<SeenFrame> {
        let station = seen.frame.station;
        let is_holding = self.held.contains_key(&station);
        let fits = |open: Option<&OpenRequest>| open.is_some_and(|open| open.verdict(&seen).is_some());
        if !is_holding && self.own(station).any(|open| fits(Some(open))) {
            // A station answers in order: suspect requests before the first that fits are lost.
            while let Some(first) = self.open.iter().position(|open| open.seen.frame.station == station)
                && self.open.get(first).is_some_and(|open| open.is_suspect && !fits(Some(open)))
                && let Some(lost) = self.open.remove(first)
            {
                self.close(lost, entries);
            }
        }
        if !self.own(station).any(|open| open.is_suspect) {
            return Some(seen);
        }
        let suspect = self.own(station).filter(|open| open.is_suspect).count();
        let number = self.held.get(&station).map_or(0, Vec::len) + 1;
        let given_up = suspect.min(self.given_up(station).unwrap_or(suspect));
        let given_up = given_up.min(self.own(station).count().saturating_sub(number));
        self.held.entry(station).or_default().push(HeldReply { at, seen, given_up });
        let (fits_in_order, fits_behind) = (self.held_fit(station, 0), self.held_fit(station, given_up));
        let held = self.held.entry(station).or_default();
        // A copy of the reply before looks the same as an equal reply.
        let is_copy = matches!(&held[..], [.., before, last] if before.seen.bytes == last.seen.bytes);
        match (fits_in_order, fits_behind) {
            // No more requests than replies.
            (true, _) if given_up == 0 => self.assign(station, Assignment::InOrder, is_copy, entries),
            (true, true) if held.len() < MAX_HELD => {}
            (true, true) => self.give_up_suspect(station, entries),
            (true, false) => self.assign(station, Assignment::InOrder, false, entries),
            (false, true) => self.assign(station, Assignment::SuspectGivenUp, false, entries),
            (false, false) => {
                let last = held.pop();
                self.give_up_suspect(station, entries);
                return last.map(|last| last.seen);
            }
        }
        None
    }

    /// Number of suspect requests of a station that are given up if not all are answered; `None` without
    /// held replies.
    fn given_up(&self, station: u8) -> Option<usize> {
        self.held.get(&station)?.last().map(|held| held.given_up)
    }

    /// Returns whether each held reply fits the request at its place, behind some that are given up.
    fn held_fit(&self, station: u8, given_up: usize) -> bool {
        let held = self.held.get(&station).map_or(&[][..], Vec::as_slice);
        let mut own = self.own(station).skip(given_up);
        held.iter().all(|held| own.next().is_some_and(|open| open.verdict(&held.seen).is_some()))
    }

    /// Open requests of a station.
    fn own(&self, station: u8) -> impl Iterator<Item = &OpenRequest> {
        self.open.iter().filter(move |open| open.seen.frame.station == station)
    }

    /// Time from the first open request of a station to its first held reply.
    fn age_of_held(&self, station: u8) -> Option<Duration> {
        let held = self.held.get(&station)?.first()?;
        let first = self.own(station).next()?;
        Some(held.at.saturating_sub(first.at))
    }

    /// Returns whether round trips tell that the client has given the suspect requests up: the first
    /// would have taken much longer than all before, or many held replies would have.
    fn are_suspect_given_up(&self, station: u8) -> bool {
        let (Some(age), Some(held)) = (self.age_of_held(station), self.held.get(&station)) else { return false };
        let longest = self.longest_round_trips.get(&station);
        if longest.is_some_and(|longest| age > longest.saturating_mul(2).saturating_add(CLIENT_WAITS)) {
            return true;
        }
        let sum = |requests: &mut dyn Iterator<Item = &OpenRequest>| -> Duration {
            held.iter().zip(requests).map(|(held, request)| held.at.saturating_sub(request.at)).sum()
        };
        let in_order = sum(&mut self.own(station));
        let given_up = sum(&mut self.own(station).skip(self.given_up(station).unwrap_or(0)));
        held.len() >= MANY_HELD && given_up.saturating_mul(4) < in_order
    }

    /// Pairs held replies with the requests behind the suspect ones: ambiguous, unless round trips tell
    /// that it is so.
    fn give_up_suspect(&mut self, station: u8, entries: &mut Vec<Entry>) {
        let Some(age) = self.age_of_held(station) else {
            self.held.remove(&station);
            return;
        };
        let is_ambiguous = !self.are_suspect_given_up(station);
        self.assign(station, Assignment::SuspectGivenUp, is_ambiguous, entries);
        if is_ambiguous {
            self.ambiguous.insert(station, age);
        }
    }

    /// Pairs the held replies of a station.
    fn assign(&mut self, station: u8, assignment: Assignment, is_ambiguous: bool, entries: &mut Vec<Entry>) {
        let mut given_up = match assignment {
            Assignment::InOrder => 0,
            Assignment::SuspectGivenUp => self.given_up(station).unwrap_or(0),
        };
        let Some(held) = self.held.remove(&station) else { return };
        for request in std::mem::take(&mut self.open) {
            if request.seen.frame.station == station && given_up > 0 {
                given_up -= 1;
                self.close(request, entries);
            } else {
                self.open.push_back(request);
            }
        }
        for HeldReply { at, seen, .. } in held {
            let fitting = self.open.iter().enumerate().find_map(|(i, open)| Some((i, open.verdict(&seen)?)));
            if let Some((number, verdict)) = fitting {
                self.answer(number, at, seen, verdict, is_ambiguous, entries);
            }
        }
    }

    /// Ends the open request with this index, and those before it of the same station.
    fn answer(
        &mut self,
        number: usize,
        at: Timestamp,
        reply: SeenFrame,
        verdict: Verdict,
        is_ambiguous: bool,
        entries: &mut Vec<Entry>,
    ) {
        let station = reply.frame.station;
        let later = self.open.split_off((number + 1).min(self.open.len()));
        let answered = self.open.pop_back();
        for earlier in std::mem::take(&mut self.open) {
            if earlier.seen.frame.station == station {
                self.close(earlier, entries);
            } else {
                self.open.push_back(earlier);
            }
        }
        self.open.extend(later);
        if let Some(request) = answered {
            let round_trip = at.saturating_sub(request.at);
            let is_ambiguous = is_ambiguous || self.ambiguous.contains_key(&station);
            if !is_ambiguous {
                let longest = self.longest_round_trips.entry(station).or_default();
                *longest = round_trip.max(*longest);
            }
            let answer = Answer { round_trip, reply, verdict, is_ambiguous };
            entries.push(self.entry(request, Outcome::Answered(answer)));
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
