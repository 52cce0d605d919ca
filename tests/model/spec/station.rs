//! Rule of docs/DESIGN.md, "In step", for one station.

use std::collections::BTreeSet;

use super::super::state::{CallClass, HeldReply, InFlight, LinkSettings, Micros, ProbeTimer};

/// State of a station.
#[derive(Debug)]
pub(crate) struct Station {
    /// Any frame may arrive. Only a check may be sent; its echo, or silence, clears this.
    pub(crate) suspect: bool,
    /// 4E was refused, without proof, since the last proof.
    pub(crate) refused: bool,
    /// The last taken reply, while a copy of it may arrive.
    owed: Option<Owed>,
    /// Commands of broadcasts that the station may answer.
    broadcasts: BTreeSet<u8>,
    /// Command and data of the last taken reply.
    last: Option<(u8, Vec<u8>)>,
    pub(crate) strays: Strays,
    /// Commands of requests that were not answered in time, since the last proof.
    late: BTreeSet<u8>,
    /// Registers that exist, as replies have shown.
    pub(crate) answered: BTreeSet<u16>,
    /// Last event that restarts the silence: a frame, a timeout, a new connection.
    pub(crate) silence_from: Micros,
    /// Longest duration of recent exchanges.
    slowest: Micros,
    pub(crate) timeouts: u32,
    pub(crate) offline: Option<ProbeTimer>,
    /// Longest response timeout of any request so far.
    pub(crate) longest_timeout: Micros,
    round_trip: Option<RoundTrip>,
    /// Time at which a frame was sent to it last.
    pub(crate) sent_at: Option<Micros>,
}

/// Smoothed round trip and deviation, as of RFC 6298, in nanoseconds.
#[derive(Clone, Copy, Debug)]
struct RoundTrip {
    smoothed: u64,
    deviation: u64,
}

/// Shape of a positive reply. A refusal matches every size of its command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shape {
    pub(crate) command: u8,
    pub(crate) size: usize,
}

/// Transmission time of a byte, as a link assumes it for a network.
const BYTE_NANOS: Micros = 800;

/// Numbers of frames that no request took, without copies of the last taken reply.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Strays {
    pub(crate) all: u32,
    /// Those that are no late reply and no answer to a broadcast.
    pub(crate) unexpected: u32,
}

#[derive(Debug)]
struct Owed {
    shape: Shape,
    refused: bool,
    data: Vec<u8>,
    silence_from: Micros,
    /// Time that the line was in use since then.
    busy_nanos: Micros,
    window: Micros,
}

/// Kinds of reply for which an owed frame could be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Ambiguity {
    None,
    Refusal,
    Reply,
}

impl Station {
    /// Takes the round trip of a proven reply.
    pub(crate) fn measured(&mut self, sample: Micros) {
        let sample = sample * 1000;
        let next = self.round_trip.map_or(RoundTrip { smoothed: sample, deviation: sample / 2 }, |before| {
            let off = before.smoothed.abs_diff(sample);
            RoundTrip {
                smoothed: before.smoothed - before.smoothed / 8 + sample / 8,
                deviation: before.deviation - before.deviation / 4 + off / 4,
            }
        });
        self.round_trip = Some(next);
    }

    /// The round trip to be expected; 0: not known.
    pub(crate) fn expected_round_trip(&self) -> Micros {
        let expected = |known: RoundTrip| known.smoothed + known.deviation.max(known.smoothed / 4);
        self.round_trip.map_or(0, expected) / 1000
    }
}

impl Default for Station {
    fn default() -> Self {
        Self {
            suspect: true,
            refused: false,
            owed: None,
            broadcasts: BTreeSet::new(),
            last: None,
            strays: Strays::default(),
            late: BTreeSet::new(),
            answered: BTreeSet::new(),
            round_trip: None,
            sent_at: None,
            silence_from: 0,
            slowest: 0,
            timeouts: 0,
            offline: None,
            longest_timeout: 0,
        }
    }
}

impl Station {
    /// Makes the station suspect: any frame may arrive from now on.
    pub(crate) fn make_suspect(&mut self, at: Micros) {
        self.suspect = true;
        self.silence_from = at;
    }

    pub(crate) fn reconnected(&mut self, at: Micros) {
        self.make_suspect(at);
        self.refused = false;
    }

    /// Handles a timeout: the reply may come late.
    pub(crate) fn timed_out(&mut self, command: u8, at: Micros) {
        self.make_suspect(at);
        self.late.insert(command);
    }

    /// Handles a frame that no request takes.
    pub(crate) fn stray(&mut self, command: u8, data: &[u8], at: Micros) {
        self.silence_from = at;
        if let Some(owed) = &mut self.owed {
            (owed.silence_from, owed.busy_nanos) = (at, 0);
        }
        let is_copy = self.last.as_ref().is_some_and(|(last, content)| (*last, &content[..]) == (command, data));
        self.suspect |= !is_copy;
        let is_unexpected = !is_copy && !self.late.contains(&command) && !self.broadcasts.contains(&command);
        self.strays.all += u32::from(!is_copy);
        self.strays.unexpected += u32::from(is_unexpected);
    }

    pub(crate) fn broadcast(&mut self, command: u8, at: Micros) {
        self.broadcasts.insert(command);
        self.silence_from = at;
    }

    /// The line was in use for a frame of this number of bytes, which is no silence. Noise and
    /// incomplete frames do not count, as in the link.
    pub(crate) fn add_busy(&mut self, bytes: usize) {
        if let Some(owed) = &mut self.owed {
            owed.busy_nanos += BYTE_NANOS * Micros::try_from(bytes).unwrap();
        }
    }

    /// Drops an owed copy once its window has passed in silence.
    pub(crate) fn expire_owed(&mut self, at: Micros) {
        let silent = |owed: &Owed| 1000 * at.saturating_sub(owed.silence_from + owed.window);
        self.owed.take_if(|owed| at >= owed.silence_from + owed.window && silent(owed) >= owed.busy_nanos);
    }

    pub(crate) fn ambiguity(&self, shape: Shape) -> Ambiguity {
        let taken = match &self.owed {
            Some(owed) if owed.shape == shape => Ambiguity::Reply,
            Some(owed) if owed.shape.command == shape.command => Ambiguity::Refusal,
            _ => Ambiguity::None,
        };
        if self.broadcasts.contains(&shape.command) { Ambiguity::Reply } else { taken }
    }

    /// Returns whether owed replies permit a request of this shape.
    pub(crate) fn allows(&self, class: CallClass, shape: Shape) -> bool {
        match class {
            CallClass::Write => self.ambiguity(shape) == Ambiguity::None,
            CallClass::Read => self.ambiguity(shape) <= Ambiguity::Refusal,
            CallClass::Page => true,
        }
    }

    /// Returns whether the reply provably answers the request of this shape.
    pub(crate) fn proves(&self, class: CallClass, shape: Shape, held: &HeldReply) -> bool {
        let ambiguity = self.ambiguity(shape);
        match class {
            CallClass::Write => true,
            _ if self.suspect => false,
            _ if held.answer.is_err() => ambiguity == Ambiguity::None,
            CallClass::Read => true,
            CallClass::Page => {
                ambiguity == Ambiguity::None
                    || self.owed.as_ref().is_some_and(|owed| !owed.refused && owed.data != held.data)
            }
        }
    }

    /// Records that the reply was taken: a copy of it may arrive, but no older frame.
    pub(crate) fn reply_taken(
        &mut self,
        in_flight: &InFlight,
        shape: Shape,
        held: &HeldReply,
        settings: &LinkSettings,
        at: Micros,
    ) {
        self.slowest = (at - in_flight.sent).max(self.slowest * 7 / 8);
        let window = settings.window.max(2 * self.slowest);
        let refused = held.answer.is_err();
        self.owed = Some(Owed { shape, refused, data: held.data.clone(), silence_from: at, busy_nanos: 0, window });
        self.broadcasts.clear();
        self.last = Some((shape.command, held.data.clone()));
        self.silence_from = at;
    }

    /// Handles the reply to a check; returns whether it proves the station in step.
    pub(crate) fn checked(
        &mut self,
        in_flight: &InFlight,
        shape: Shape,
        held: &HeldReply,
        settings: &LinkSettings,
        at: Micros,
    ) -> bool {
        let refused = held.answer.is_err();
        let echo = shape.command == 0x4E && shape.size > 0 && !refused;
        let unproven = self.suspect || refused && self.ambiguity(shape) > Ambiguity::None;
        let proof = echo || !unproven;
        self.silence_from = at;
        if !proof {
            self.refused |= shape.command == 0x4E && refused;
            return false;
        }
        if echo {
            self.suspect = false;
            self.late.clear();
        }
        self.refused = false;
        self.reply_taken(in_flight, shape, held, settings, at);
        true
    }

    /// Records a silence of the quiet time, which proves the station in step.
    pub(crate) fn was_silent(&mut self) {
        (self.suspect, self.refused, self.owed) = (false, false, None);
        self.broadcasts.clear();
        self.late.clear();
    }

    pub(crate) fn quiet_time(&self, settings: &LinkSettings) -> Micros {
        settings.quiet.max(self.longest_timeout)
    }
}
