//! The order of the requests to one port of a host, and the results. No I/O and no clock.
//!
//! States: the status of the next station is due ([`Step::Status`]), its detailed status
//! ([`Step::Detail`]), a new connection ([`Step::Open`]), or nothing ([`Step::End`]). Inputs: the end
//! of a request, and the end of the connection.
//!
//! Invariants:
//! - Each framing and station is asked at most 1 + `retries` times, and once while nothing has come
//!   from the host, but for the first station.
//! - After the first good frame its framing is the only one.
//! - A connection is opened again only after a reply on it, and at most twice for each station.

use std::time::Duration;

use fatek::command::{BriefStatus, DetailedStatus, ReadStatus};
use fatek::wire::Framing;

use crate::enquiry::{Heard, Reply};

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
pub(crate) enum Step {
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
    /// Open the connection again.
    Open,
    End,
}

/// Column `answer` of the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Answer {
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

impl Answer {
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
    pub(crate) answer: Answer,
    pub(crate) brief: Option<BriefStatus>,
    pub(crate) detailed: Option<DetailedStatus>,
    pub(crate) time: Option<Duration>,
    pub(crate) notes: Vec<String>,
    /// Status requests and replies: a reply more is of a second station, or a duplicate.
    requests: u32,
    replies: u32,
}

impl Found {
    fn new(framing: Option<Framing>, station: Option<u8>, answer: Answer) -> Self {
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
    is_open_due: bool,
    has_ended: bool,
    /// A good frame came.
    is_alive: bool,
    /// A reply came on the current connection.
    is_answering: bool,
    opened_again: usize,
    heard: Heard,
    found: Vec<Found>,
}

impl<'q> Trial<'q> {
    /// `framing`: that of another port of the host, if it is known.
    pub(crate) fn new(questions: &'q Questions, framing: Option<Framing>) -> Self {
        let framings = match framing {
            Some(framing) => vec![framing],
            None => questions.framings.clone(),
        };
        Self {
            questions,
            framings,
            position: 0,
            asked: 0,
            is_detail_due: false,
            is_open_due: false,
            has_ended: false,
            is_alive: false,
            is_answering: false,
            opened_again: 0,
            heard: Heard::default(),
            found: Vec::new(),
        }
    }

    /// The next step. Its result is to be given before the next one is asked for.
    pub(crate) fn step(&self) -> Step {
        let Some((framing, station)) = self.current() else { return Step::End };
        if self.is_open_due {
            Step::Open
        } else if self.is_detail_due {
            Step::Detail { framing, station }
        } else {
            Step::Status { framing, station }
        }
    }

    /// The framing of the host, if a good frame has come.
    pub(crate) fn framing(&self) -> Option<Framing> {
        self.framings.first().copied().filter(|_| self.is_alive)
    }

    /// The stations that have answered until now.
    pub(crate) fn found(&self) -> &[Found] {
        &self.found
    }

    /// Takes the result of [`Step::Status`].
    pub(crate) fn status(&mut self, reply: Option<(Reply<BriefStatus>, Duration)>, heard: Heard) {
        let Some((framing, station)) = self.current() else { return };
        self.asked += 1;
        let Some((reply, time)) = reply else {
            self.take(framing, heard);
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
                found.answer = Answer::Ok;
                found.brief = Some(brief);
                if asked > 1 {
                    found.notes.push(format!("after {asked} requests"));
                }
                self.is_detail_due = true;
            }
            Reply::Refused(code) => {
                found.answer = Answer::Refused;
                found.notes.push(code.to_string());
                self.next_station();
            }
        }
        // After the reply: more of this station are duplicates.
        self.take(framing, heard);
    }

    /// Takes the result of [`Step::Detail`].
    pub(crate) fn detail(&mut self, reply: Option<Reply<DetailedStatus>>, heard: Heard) {
        let Some((framing, station)) = self.current() else { return };
        self.is_answering |= reply.is_some();
        self.take(framing, heard);
        let found = self.entry(framing, station);
        match reply {
            Some(Reply::Good(detailed)) => found.detailed = Some(detailed),
            // Some models have no detailed status.
            Some(Reply::Refused(_)) => {}
            None => found.notes.push("no answer to the detailed status (53)".to_owned()),
        }
        self.next_station();
    }

    /// Takes a new connection, the result of [`Step::Open`].
    pub(crate) fn opened(&mut self) {
        self.is_open_due = false;
        self.is_answering = false;
    }

    /// Takes the end of the connection in place of the result of a request.
    pub(crate) fn lost(&mut self, reason: &str, heard: Heard) {
        let Some((framing, _)) = self.current() else { return };
        self.take(framing, heard);
        // Some devices close the connection after each reply, and a station takes two.
        if self.is_answering && self.opened_again < 2 * self.questions.stations.len() {
            self.opened_again += 1;
            self.is_open_due = true;
        } else {
            self.end(reason);
        }
    }

    /// Ends it before all requests were sent, for this reason.
    pub(crate) fn end(&mut self, reason: &str) {
        if self.found.is_empty() {
            self.found.push(Found::new(None, None, Answer::Silent));
        }
        if let Some(found) = self.found.last_mut() {
            found.notes.push(reason.to_owned());
        }
        self.has_ended = true;
    }

    /// The results. `is_connected`: a connection was accepted, so that a port without answers is a
    /// result, too.
    pub(crate) fn into_found(mut self, is_connected: bool) -> Vec<Found> {
        let is_noisy = self.heard.garbage > 0 || self.heard.echoes > 0 || !self.heard.frames.is_empty();
        if self.found.is_empty() && (is_connected || is_noisy) {
            self.found.push(Found::new(None, None, Answer::Silent));
        }
        if let Some(found) = self.found.last_mut() {
            match found.answer {
                Answer::Silent if is_noisy => found.answer = Answer::Other,
                Answer::Ok if self.heard.garbage > 0 => found.answer = Answer::Bad,
                Answer::Ok | Answer::Refused | Answer::Bad | Answer::Late | Answer::Silent | Answer::Other => {}
            }
            found.notes.extend(besides(&self.heard, is_connected));
        }
        self.found
    }

    /// The current framing and station; `None` at the end.
    fn current(&self) -> Option<(Framing, u8)> {
        let framing = self.framings.first().filter(|_| !self.has_ended)?;
        Some((*framing, *self.questions.stations.get(self.position)?))
    }

    /// Takes other traffic: frames of stations that are late or answer twice are results.
    fn take(&mut self, framing: Framing, mut heard: Heard) {
        for frame in std::mem::take(&mut heard.frames) {
            self.keep_to(framing);
            match frame.decode_reply(&ReadStatus, framing) {
                Ok(brief) if self.questions.stations.contains(&frame.station) => {
                    self.late(framing, frame.station, brief);
                }
                Ok(_) | Err(_) => heard.frames.push(frame),
            }
        }
        self.heard.add(heard);
    }

    /// Takes a status that was not waited for.
    fn late(&mut self, framing: Framing, station: u8, brief: BriefStatus) {
        let most = self.questions.retries.saturating_add(1);
        let found = self.entry(framing, station);
        found.replies += 1;
        if found.requests == 0 {
            found.requests = most;
            found.answer = Answer::Late;
            found.brief = Some(brief);
            found.notes.push("a reply after the timeout: increase --timeout".to_owned());
        } else if found.replies > found.requests && found.answer == Answer::Ok {
            found.answer = Answer::Bad;
            found.notes.push("more replies than requests: a second station with this number?".to_owned());
        }
    }

    fn entry(&mut self, framing: Framing, station: u8) -> &mut Found {
        let position = self.found.iter().position(|found| found.station == Some(station));
        let position = position.unwrap_or_else(|| {
            self.found.push(Found::new(Some(framing), Some(station), Answer::Bad));
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
        self.position = 0;
        // The framing of a host that has sent good frames is the only one that is left.
        if self.framings.is_empty() || self.is_alive {
            self.has_ended = true;
        } else {
            self.framings.remove(0);
        }
    }
}

/// Texts for the traffic that belongs to no station.
fn besides(heard: &Heard, is_connected: bool) -> Vec<String> {
    let mut notes = Vec::new();
    if heard.garbage > 0 {
        // An IPsec gateway answers on UDP 500, too.
        let other = if is_connected { "" } else { "; another protocol (IPsec has UDP 500, too)?" };
        notes.push(format!("{} bytes that are no frame{other}", heard.garbage));
    }
    if heard.echoes > 0 {
        notes.push("requests are echoed".to_owned());
    }
    if let Some(frame) = heard.frames.first() {
        notes.push(format!("{} other frames, such as of station {}", heard.frames.len(), frame.station));
    }
    notes
}

#[cfg(test)]
mod tests;
