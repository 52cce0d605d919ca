//! The order of the requests to one port of a host, and the results. No I/O and no clock.
//!
//! States: the status of the next station is due ([`TrialStep::Status`]), its detailed status
//! ([`TrialStep::Detail`]), late replies ([`TrialStep::Listen`]), a new connection
//! ([`TrialStep::Open`]), or nothing ([`TrialStep::End`]). Inputs: the end of a request or of listening,
//! and the end of the connection.
//!
//! Invariants:
//! - Each framing and station is asked at most 1 + `retries` times, and once while nothing has come
//!   from the host, but for the first station.
//! - After the first good frame its framing is the only one.
//! - A connection is opened again after a reply on it, at most twice for each station, and for the next
//!   framing if it ended without a reply.
//! - After unanswered requests to a host that is there, a framing is left only after listening.
//! - Garbage belongs to the station that was asked, if its framing is the one of the port.

use std::time::Duration;

use fatek::command::{BriefStatus, DetailedStatus, ReadStatus};
use fatek::wire::Framing;

use crate::enquiry::{Reply, Traffic};

/// Stations, framings and retries of the requests to each port.
#[derive(Clone, Debug)]
pub(crate) struct Questions {
    pub(crate) stations: Vec<u8>,
    pub(crate) framings: Vec<Framing>,
    /// Retries of a request.
    pub(crate) retries: u32,
}

impl Questions {
    /// Most requests to a port that stays silent.
    pub(crate) fn when_silent(&self) -> u32 {
        // There are at most 254 stations and two framings.
        let stations = u32::try_from(self.stations.len()).unwrap_or(u32::MAX);
        let framings = u32::try_from(self.framings.len()).unwrap_or(u32::MAX);
        stations.saturating_add(self.retries).saturating_mul(framings)
    }
}

/// The next thing to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TrialStep {
    /// Read the status (40).
    Status {
        framing: Framing,
        station: u8,
    },
    /// Read the detailed status (53).
    Detail {
        framing: Framing,
        station: u8,
    },
    /// Listen for late replies, without a request.
    Listen {
        framing: Framing,
    },
    /// Open the connection again.
    Open,
    End,
}

/// Column `answer` of the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StationAnswer {
    Ok,
    /// Error code.
    Refused,
    /// No good reply, or unexpected frames besides.
    Bad,
    /// A reply after the timeout only.
    Late,
    /// A connection, and no answer of a station.
    Silent,
    /// Traffic, and no answer of a station: perhaps another protocol.
    Other,
}

impl StationAnswer {
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Refused => "refused",
            Self::Bad => "bad",
            Self::Late => "late",
            Self::Silent => "silent",
            Self::Other => "other",
        }
    }

    pub(crate) fn is_bad(self) -> bool {
        match self {
            Self::Bad | Self::Late => true,
            Self::Ok | Self::Refused | Self::Silent | Self::Other => false,
        }
    }
}

/// A station that has answered, or a port that accepts connections and is silent.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Found {
    /// `None` of a silent port.
    pub(crate) framing: Option<Framing>,
    pub(crate) station: Option<u8>,
    pub(crate) answer: StationAnswer,
    pub(crate) brief: Option<BriefStatus>,
    pub(crate) detailed: Option<DetailedStatus>,
    pub(crate) time: Option<Duration>,
    pub(crate) notes: Vec<String>,
    /// Status requests and replies: a reply more is of a second station, or a duplicate.
    requests: u32,
    replies: u32,
}

impl Found {
    fn new(framing: Option<Framing>, station: Option<u8>, answer: StationAnswer) -> Self {
        Self {
            framing,
            station,
            answer,
            brief: None,
            detailed: None,
            time: None,
            notes: Vec::new(),
            requests: 0,
            replies: 0,
        }
    }
}

/// Bytes of no frame after requests to a station.
#[derive(Clone, Copy, Debug)]
struct Garbage {
    framing: Framing,
    station: u8,
    bytes: usize,
}

/// The requests to one port.
#[derive(Debug)]
pub(crate) struct Trial<'q> {
    questions: &'q Questions,
    /// The framings that are left, the current one first.
    framings: Vec<Framing>,
    /// Position of the current station.
    position: usize,
    /// Requests to the current station.
    asked: u32,
    is_detail_due: bool,
    is_listen_due: bool,
    is_open_due: bool,
    has_ended: bool,
    /// A connection was accepted: the host is there, even if it is silent.
    is_connected: bool,
    /// A status in the current framing was not answered in time.
    is_unanswered: bool,
    /// A good frame came.
    is_alive: bool,
    /// A reply came on the current connection.
    is_answering: bool,
    opened_again: usize,
    garbage: Vec<Garbage>,
    /// All traffic that is no reply; its garbage is also in `garbage`.
    traffic: Traffic,
    found: Vec<Found>,
}

impl<'q> Trial<'q> {
    /// `framing`: that of another port of the host, if it is known. It is tried first, and not alone: each
    /// port has a setting of its own. `is_connected`: a connection was accepted, so that a port without
    /// answers is a result, too.
    pub(crate) fn new(questions: &'q Questions, framing: Option<Framing>, is_connected: bool) -> Self {
        let mut framings = questions.framings.clone();
        framings.sort_by_key(|other| framing.is_some_and(|known| known != *other));
        Self {
            questions,
            framings,
            position: 0,
            asked: 0,
            is_detail_due: false,
            is_listen_due: false,
            is_open_due: false,
            has_ended: false,
            is_connected,
            is_unanswered: false,
            is_alive: false,
            is_answering: false,
            opened_again: 0,
            garbage: Vec::new(),
            traffic: Traffic::default(),
            found: Vec::new(),
        }
    }

    /// The next step. Its result is to be given before the next one is asked for.
    pub(crate) fn step(&self) -> TrialStep {
        if self.is_open_due && !self.has_ended {
            return TrialStep::Open;
        }
        if let Some(&framing) = self.framings.first().filter(|_| self.is_listen_due && !self.has_ended) {
            return TrialStep::Listen { framing };
        }
        let Some((framing, station)) = self.current() else { return TrialStep::End };
        if self.is_detail_due { TrialStep::Detail { framing, station } } else { TrialStep::Status { framing, station } }
    }

    /// The framing of the host, if a good frame has come.
    pub(crate) fn framing(&self) -> Option<Framing> {
        self.framings.first().copied().filter(|_| self.is_alive)
    }

    /// The stations that have answered until now.
    pub(crate) fn found(&self) -> &[Found] {
        &self.found
    }

    /// Takes the result of [`TrialStep::Status`].
    pub(crate) fn status(&mut self, reply: Option<(Reply<BriefStatus>, Duration)>, traffic: Traffic) {
        let Some((framing, station)) = self.current() else { return };
        self.asked += 1;
        let Some((reply, time)) = reply else {
            self.take(framing, station, traffic);
            self.unanswered();
            return;
        };
        self.keep_to(framing);
        self.is_answering = true;
        let asked = self.asked;
        let found = self.entry(framing, station);
        found.requests = asked;
        found.replies += 1;
        found.time = Some(time);
        match reply {
            Reply::Good(brief) => {
                found.answer = StationAnswer::Ok;
                found.brief = Some(brief);
                if asked > 1 {
                    found.notes.push(format!("after {asked} requests"));
                }
                self.is_detail_due = true;
            }
            Reply::Refused(code) => {
                found.answer = StationAnswer::Refused;
                found.notes.push(code.to_string());
                self.next_station();
            }
        }
        // After the reply: more of this station are duplicates.
        self.take(framing, station, traffic);
    }

    /// Takes the result of [`TrialStep::Detail`].
    pub(crate) fn detail(&mut self, reply: Option<Reply<DetailedStatus>>, traffic: Traffic) {
        let Some((framing, station)) = self.current() else { return };
        self.is_answering |= reply.is_some();
        self.take(framing, station, traffic);
        let found = self.entry(framing, station);
        match reply {
            Some(Reply::Good(detailed)) => found.detailed = Some(detailed),
            // Some models have no detailed status.
            Some(Reply::Refused(_)) => {}
            None => found.notes.push("no answer to the detailed status (53)".to_owned()),
        }
        self.next_station();
    }

    /// Takes the result of [`TrialStep::Listen`]. `is_lost`: the connection has ended meanwhile.
    pub(crate) fn listened(&mut self, traffic: Traffic, is_lost: bool) {
        let last = self.questions.stations.last();
        if let (Some(&framing), Some(&station)) = (self.framings.first(), last) {
            self.take(framing, station, traffic);
        }
        self.leave_framing();
        self.is_open_due = is_lost && !self.has_ended;
    }

    /// Takes a new connection, the result of [`TrialStep::Open`].
    pub(crate) fn opened(&mut self) {
        self.is_open_due = false;
        self.is_answering = false;
    }

    /// Takes the end of the connection in place of the result of a request.
    pub(crate) fn lost(&mut self, reason: &str, traffic: Traffic) {
        let Some((framing, station)) = self.current() else { return };
        self.take(framing, station, traffic);
        // Some devices close the connection after each reply, and a station takes two.
        if self.is_answering && self.opened_again < 2 * self.questions.stations.len() {
            self.opened_again += 1;
            self.is_open_due = true;
            return;
        }
        // Others close it after a frame of the other framing.
        let is_only = self.is_alive || self.framings.len() <= 1;
        self.leave_framing();
        if is_only {
            self.end(reason);
        } else {
            self.is_open_due = true;
        }
    }

    /// Ends it before all requests were sent, for this reason.
    pub(crate) fn end(&mut self, reason: &str) {
        if self.found.is_empty() {
            self.found.push(Found::new(None, None, StationAnswer::Silent));
        }
        if let Some(found) = self.found.last_mut() {
            found.notes.push(reason.to_owned());
        }
        self.has_ended = true;
    }

    /// The results, in the order of the stations.
    pub(crate) fn into_found(mut self) -> Vec<Found> {
        let before_framing = self.charge_garbage();
        let Traffic { echoes, frames, .. } = &self.traffic;
        let is_noisy = before_framing > 0 || *echoes > 0 || !frames.is_empty();
        if self.found.is_empty() && (self.is_connected || is_noisy) {
            self.found.push(Found::new(None, None, StationAnswer::Silent));
        }
        self.found.sort_by_key(|found| found.station);
        if let Some(found) = self.found.last_mut() {
            if found.answer == StationAnswer::Silent && is_noisy {
                found.answer = StationAnswer::Other;
            }
            if before_framing > 0 {
                // An IPsec gateway answers on UDP 500, too.
                let other = match (self.is_alive, self.is_connected) {
                    (true, _) => " before the framing was known",
                    (false, true) => "",
                    (false, false) => "; another protocol (IPsec has UDP 500, too)?",
                };
                found.notes.push(format!("{before_framing} bytes that are no frame{other}"));
            }
            found.notes.extend(besides(&self.traffic));
        }
        self.found
    }

    /// Notes garbage at the stations that were asked. Returns the number of bytes in other framings than
    /// that of the port, which say nothing about a station.
    fn charge_garbage(&mut self) -> usize {
        let framing = self.framing();
        let mut others = 0;
        for garbage in std::mem::take(&mut self.garbage) {
            if framing != Some(garbage.framing) {
                others += garbage.bytes;
                continue;
            }
            let found = self.entry(garbage.framing, garbage.station);
            if found.answer == StationAnswer::Ok {
                found.answer = StationAnswer::Bad;
            }
            found.notes.push(format!("{} bytes that are no frame", garbage.bytes));
        }
        others
    }

    /// The current framing and station; `None` at the end.
    fn current(&self) -> Option<(Framing, u8)> {
        let framing = self.framings.first().filter(|_| !self.has_ended)?;
        Some((*framing, *self.questions.stations.get(self.position)?))
    }

    /// Takes other traffic after a request to a station: frames of stations that are late or answer twice
    /// are results.
    fn take(&mut self, framing: Framing, station: u8, mut traffic: Traffic) {
        for frame in std::mem::take(&mut traffic.frames) {
            self.keep_to(framing);
            match frame.decode_reply(&ReadStatus, framing) {
                Ok(brief) if self.questions.stations.contains(&frame.station) => {
                    self.late(framing, frame.station, brief);
                }
                Ok(_) | Err(_) => traffic.frames.push(frame),
            }
        }
        if traffic.garbage > 0 {
            let same = |of: &&mut Garbage| (of.framing, of.station) == (framing, station);
            match self.garbage.iter_mut().find(same) {
                Some(garbage) => garbage.bytes += traffic.garbage,
                None => self.garbage.push(Garbage { framing, station, bytes: traffic.garbage }),
            }
        }
        self.traffic.add(traffic);
    }

    /// Takes a status that was not waited for.
    fn late(&mut self, framing: Framing, station: u8, brief: BriefStatus) {
        let most = self.questions.retries.saturating_add(1);
        let found = self.entry(framing, station);
        found.replies += 1;
        if found.requests == 0 {
            found.requests = most;
            found.answer = StationAnswer::Late;
            found.brief = Some(brief);
            found.notes.push("a reply after the timeout: increase --timeout".to_owned());
        } else if found.replies > found.requests && found.answer == StationAnswer::Ok {
            found.answer = StationAnswer::Bad;
            found.notes.push("more replies than requests: a second station with this number?".to_owned());
        }
    }

    fn entry(&mut self, framing: Framing, station: u8) -> &mut Found {
        let position = self.found.iter().position(|found| found.station == Some(station));
        let position = position.unwrap_or_else(|| {
            self.found.push(Found::new(Some(framing), Some(station), StationAnswer::Bad));
            self.found.len() - 1
        });
        &mut self.found[position]
    }

    /// Drops all other framings.
    fn keep_to(&mut self, framing: Framing) {
        self.is_alive = true;
        self.framings.retain(|other| *other == framing);
    }

    fn unanswered(&mut self) {
        self.is_unanswered = true;
        let may_repeat = self.is_alive || self.position == 0;
        if !may_repeat || self.asked > self.questions.retries {
            self.next_station();
        }
    }

    /// Goes on to the next station, after the last one to the next framing.
    fn next_station(&mut self) {
        self.asked = 0;
        self.is_detail_due = false;
        self.position += 1;
        if self.position < self.questions.stations.len() {
            return;
        }
        // The reply of the last station may be late. Hosts that are perhaps not there would take too long.
        if self.is_unanswered && (self.is_connected || self.is_alive) {
            self.is_listen_due = true;
        } else {
            self.leave_framing();
        }
    }

    /// Goes on to the next framing, or ends. The framing of a port that has sent good frames is the only
    /// one that is left.
    fn leave_framing(&mut self) {
        self.position = 0;
        self.asked = 0;
        self.is_listen_due = false;
        self.is_unanswered = false;
        if self.is_alive || self.framings.len() <= 1 {
            self.has_ended = true;
        } else {
            self.framings.remove(0);
        }
    }
}

/// Texts for the traffic that belongs to no station.
fn besides(traffic: &Traffic) -> Vec<String> {
    let mut notes = Vec::new();
    if traffic.echoes > 0 {
        notes.push("requests are echoed".to_owned());
    }
    if let Some(frame) = traffic.frames.first() {
        notes.push(format!("{} other frames, such as of station {}", traffic.frames.len(), frame.station));
    }
    notes
}

#[cfg(test)]
mod tests;
