//! PLCs whose batches the broker refuses, while it may take those of others. No I/O, and no clock.
//!
//! ```text
//!          a batch is refused                 time                       refused
//! taken ─────────────────────▶ waiting ─────────────────▶ attempt ────────────────▶ waiting
//!   ▲                             ▲                          │ taken
//!   │ all parked are sent         └── a batch is refused ────┤
//!   └──────────────────────────────────────────────────── ready
//! ```
//!
//! The batches of such a PLC are parked behind the first that was refused. One of them is sent from time to time, with
//! growing delays; when it is taken, the others follow. After [`HOLD`], in which others were taken, the PLC is
//! given up: its batches are dropped, but for one at a time that is an attempt. If none of any PLC is taken, all
//! are kept: then the broker refuses the output, and the buffer decides. A new connection begins with all of them
//! kept, and an attempt for each.
//!
//! Some brokers close the connection after a refusal: mosquitto 2.0 with `max_queued_messages 0`. After such a loss
//! everything goes on as on one connection, and the PLCs have attempts in turn: else each connection would end with
//! its first attempt, and always that of the same PLC.
//!
//! Invariants:
//! - the batches of a PLC are sent in their order;
//! - a batch is dropped only while the broker takes batches of other PLCs.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use crate::backoff::Backoff;
use crate::buffer::Entry;

/// The time for which the batches of a refused PLC are kept while those of others are taken. A pause of others that
/// is longer does not count.
pub(super) const HOLD: Duration = Duration::from_secs(600);
/// The time between two attempts, if the second one comes before its time; and the time after a refusal within which
/// the end of a connection counts as its effect.
pub(super) const SHORTEST: Duration = Duration::from_secs(1);
/// The batches that are parked, of all PLCs.
pub(super) const MAX_PARKED: usize = 16_384;
/// Their bytes.
pub(super) const MAX_BYTES: usize = 16 << 20;

/// The refused PLCs, and their batches.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    plcs: BTreeMap<Arc<str>, Refused>,
    /// Batches of PLCs that are taken again: they are sent before all others.
    ready: VecDeque<Entry>,
    /// The parked batches, without the ready ones, and their bytes.
    parked: usize,
    bytes: usize,
    taken: Option<Taken>,
}

/// Batches of PLCs that are not refused are taken.
#[derive(Debug)]
struct Taken {
    /// Since when, without a pause that is longer than [`HOLD`].
    begin: Instant,
    last: Instant,
    /// The PLC of the last one.
    plc: Arc<str>,
}

#[derive(Debug)]
struct Refused {
    since: Instant,
    /// When a batch was refused last.
    last: Instant,
    why: String,
    backoff: Backoff,
    next: Next,
    /// By position.
    parked: BTreeMap<u64, Entry>,
    /// `true`: nothing is parked any more.
    is_given_up: bool,
    /// `true`: a reload has removed it from the configuration.
    is_removed: bool,
}

/// The next attempt of a PLC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Next {
    At(Instant),
    /// It may be sent.
    Due,
    InFlight,
}

/// The fate of a batch that comes next.
#[derive(Debug)]
pub(super) enum Passed {
    /// It is sent.
    Send(Entry),
    /// It waits.
    Parked,
    /// It is given up.
    Dropped(Entry),
}

/// The effect of a refusal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// The batches of the PLC were taken before. The number of PLCs that are refused now.
    New(usize),
    /// The batch waits for the next attempt.
    Again,
    /// The batch is dropped, as all of this PLC.
    Dropped,
}

impl Refusals {
    /// Returns whether no more batches should be read: too many are parked.
    pub(super) fn is_full(&self) -> bool {
        self.parked >= MAX_PARKED || self.bytes >= MAX_BYTES
    }

    /// Returns whether no PLC is refused, and no batch is ready.
    pub(super) fn is_empty(&self) -> bool {
        self.plcs.is_empty() && self.ready.is_empty()
    }

    /// Returns whether batches of PLCs that are taken again wait to be sent.
    pub(super) fn has_ready(&self) -> bool {
        !self.ready.is_empty()
    }

    /// Returns whether the batches of a PLC are refused.
    pub(super) fn is_refused(&self, plc: &Arc<str>) -> bool {
        self.plcs.contains_key(plc)
    }

    /// A batch that is sent before all others: an attempt, or a ready one.
    pub(super) fn take(&mut self) -> Option<Entry> {
        if let Some(attempt) = self.take_attempt() {
            return Some(attempt);
        }
        while let Some(entry) = self.ready.pop_front() {
            if !self.is_refused(&entry.batch.plc) {
                return Some(entry);
            }
            // It was refused again.
            self.park(entry);
        }
        None
    }

    fn take_attempt(&mut self) -> Option<Entry> {
        let refused = self.plcs.values_mut().find(|plc| plc.next == Next::Due && !plc.parked.is_empty())?;
        let (_, entry) = refused.parked.pop_first()?;
        refused.next = Next::InFlight;
        self.unpark(std::slice::from_ref(&entry));
        Some(entry)
    }

    /// Decides about the batch that comes next in the buffer.
    pub(super) fn pass(&mut self, entry: Entry) -> Passed {
        let Some(refused) = self.plcs.get_mut(&entry.batch.plc) else { return Passed::Send(entry) };
        if refused.is_given_up {
            return match refused.next {
                Next::Due => {
                    refused.next = Next::InFlight;
                    Passed::Send(entry)
                }
                Next::At(_) | Next::InFlight => Passed::Dropped(entry),
            };
        }
        self.park(entry);
        Passed::Parked
    }

    /// Notes that a batch was refused.
    pub(super) fn refused(&mut self, entry: Entry, why: &str, now: Instant) -> (Refusal, Option<Entry>) {
        let plc = entry.batch.plc.clone();
        let is_new = !self.plcs.contains_key(&plc);
        let refused = self.plcs.entry(plc).or_insert_with(|| Refused {
            since: now,
            last: now,
            why: why.to_owned(),
            backoff: Backoff::default(),
            next: Next::InFlight,
            parked: BTreeMap::new(),
            is_given_up: false,
            is_removed: false,
        });
        // Others that were sent before the first refusal are no attempts.
        if refused.next == Next::InFlight {
            refused.next = Next::At(now + refused.backoff.next_delay());
        }
        refused.last = now;
        why.clone_into(&mut refused.why);
        if refused.is_given_up {
            return (Refusal::Dropped, Some(entry));
        }
        self.park(entry);
        (if is_new { Refusal::New(self.plcs.len()) } else { Refusal::Again }, None)
    }

    /// Notes that a batch of a PLC was taken. Returns whether the PLC was refused before.
    pub(super) fn taken(&mut self, plc: &Arc<str>, now: Instant) -> bool {
        match self.plcs.remove(plc) {
            Some(refused) => {
                let parked: Vec<Entry> = refused.parked.into_values().collect();
                self.unpark(&parked);
                self.ready.extend(parked);
                // A change at the broker for one may be one for all.
                let may_try = |other: &&mut Refused| {
                    matches!(other.next, Next::At(_)) && now.duration_since(other.last) >= SHORTEST
                };
                self.plcs.values_mut().filter(may_try).for_each(|other| other.next = Next::Due);
                true
            }
            None => {
                let before = self.taken.as_ref().filter(|taken| now.duration_since(taken.last) < HOLD);
                let begin = before.map_or(now, |taken| taken.begin);
                self.taken = Some(Taken { begin, last: now, plc: plc.clone() });
                false
            }
        }
    }

    /// Notes that an attempt has ended in another way.
    pub(super) fn skipped(&mut self, plc: &str, now: Instant) {
        if let Some(refused) = self.plcs.get_mut(plc).filter(|refused| refused.next == Next::InFlight) {
            refused.next = Next::At(now + refused.backoff.next_delay());
        }
    }

    /// Gives up PLCs whose time is over, or too much of which is parked, if batches of others are taken. Returns
    /// their names and batches. `no_room`: too many batches wait behind them.
    pub(super) fn give_up(&mut self, no_room: bool, now: Instant) -> Vec<(Arc<str>, Vec<Entry>)> {
        let is_flow = |taken: &&Taken| now.duration_since(taken.last) < HOLD && !self.plcs.contains_key(&taken.plc);
        let Some(begin) = self.taken.as_ref().filter(is_flow).map(|taken| taken.begin) else { return Vec::new() };
        let mut waiting: Vec<(usize, Arc<str>)> = Vec::new();
        for (plc, refused) in self.plcs.iter().filter(|(_, refused)| !refused.is_given_up) {
            waiting.push((refused.parked.len(), plc.clone()));
        }
        // The largest first, which make the most room.
        waiting.sort_by(|a, b| b.cmp(a));
        let mut given_up = Vec::new();
        for (_, plc) in waiting {
            let is_full = no_room || self.is_full();
            let Some(refused) = self.plcs.get_mut(&plc) else { continue };
            // Not by a refusal of the time when all were refused.
            let makes_room = is_full && refused.last >= begin;
            if !makes_room && now.duration_since(refused.since.max(begin)) < HOLD {
                continue;
            }
            refused.is_given_up = true;
            let parked: Vec<Entry> = std::mem::take(&mut refused.parked).into_values().collect();
            self.unpark(&parked);
            given_up.push((plc, parked));
        }
        given_up
    }

    /// Forgets all batches, which are read again. Lets each PLC have an attempt: the connection is another, and perhaps
    /// the broker. So the time for which batches are kept begins anew, unless a refusal has ended the connection.
    pub(super) fn rewind(&mut self, now: Instant) {
        self.ready.clear();
        (self.parked, self.bytes) = (0, 0);
        self.plcs.values_mut().for_each(|refused| refused.parked.clear());
        if let Some(delay) = self.delay_after_refusal(now) {
            self.take_turns(now, delay);
            return;
        }
        self.taken = None;
        for refused in self.plcs.values_mut() {
            refused.next = Next::Due;
            refused.is_given_up = false;
        }
    }

    /// The time until the next attempt, if a refusal has just ended a connection.
    fn delay_after_refusal(&self, now: Instant) -> Option<Duration> {
        let recent = self.plcs.values().filter(|refused| now.duration_since(refused.last) < SHORTEST);
        let delay = |refused: &Refused| match refused.next {
            Next::At(at) => at.duration_since(now).max(SHORTEST),
            Next::Due | Next::InFlight => SHORTEST,
        };
        recent.map(delay).max()
    }

    /// Gives the PLCs attempts one after another. The PLC whose last one was longest ago is first.
    fn take_turns(&mut self, now: Instant, delay: Duration) {
        let mut plcs: Vec<&mut Refused> = self.plcs.values_mut().collect();
        plcs.sort_by_key(|refused| refused.last);
        let mut at = now;
        for refused in plcs {
            at += delay;
            refused.next = Next::At(at);
        }
    }

    /// When the next attempt is due.
    pub(super) fn due(&self) -> Option<Instant> {
        let at = |refused: &Refused| match refused.next {
            Next::At(at) => Some(at),
            Next::Due | Next::InFlight => None,
        };
        self.plcs.values().filter_map(at).min()
    }

    /// Lets the attempts begin that are due.
    pub(super) fn resume(&mut self, now: Instant) {
        for refused in self.plcs.values_mut() {
            if matches!(refused.next, Next::At(at) if at <= now) {
                refused.next = Next::Due;
            }
        }
    }

    /// Notes which PLCs a reload has removed, or brought back. Batches of a removed one are kept as those of others,
    /// and the PLC is forgotten with the last of them. Returns the names of those whose state is another now.
    pub(super) fn configured(&mut self, is_configured: impl Fn(&str) -> bool) -> Vec<Arc<str>> {
        let mut changed = Vec::new();
        for (plc, refused) in &mut self.plcs {
            let is_removed = !is_configured(plc);
            if std::mem::replace(&mut refused.is_removed, is_removed) != is_removed {
                changed.push(plc.clone());
            }
        }
        let is_awaited = |refused: &Refused| refused.next == Next::InFlight || !refused.parked.is_empty();
        self.plcs.retain(|_, refused| !refused.is_removed || is_awaited(refused));
        changed
    }

    /// The refused PLCs of the configuration in a sentence, with the reason of the first; `None` without any.
    pub(super) fn summary(&self) -> Option<String> {
        let mut configured = self.plcs.iter().filter(|(_, refused)| !refused.is_removed);
        let (plc, refused) = configured.next()?;
        Some(match configured.count() {
            0 => format!("batches of {plc}: {}", refused.why),
            more => format!("batches of {plc} and {more} more PLCs: {}", refused.why),
        })
    }

    fn park(&mut self, entry: Entry) {
        if let Some(refused) = self.plcs.get_mut(&entry.batch.plc) {
            self.parked = self.parked.saturating_add(1);
            self.bytes = self.bytes.saturating_add(entry.batch.size());
            // It was sent before, or waits behind one that was.
            refused.parked.insert(entry.position, Entry { replay: true, ..entry });
        }
    }

    /// Counts batches that are not parked any more.
    fn unpark(&mut self, entries: &[Entry]) {
        self.parked = self.parked.saturating_sub(entries.len());
        self.bytes = entries.iter().fold(self.bytes, |sum, entry| sum.saturating_sub(entry.batch.size()));
    }
}
