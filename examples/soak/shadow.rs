//! What the PLCs of a line may hold. No I/O and no clock.
//!
//! A cell holds one of several values: the one that was confirmed last, or one of a write of which nobody knows whether it
//! was executed. Of each value it is known since when it may be there, and until when it may have been:
//!
//! ```text
//! begin ──▶ may be there ──┬─ refused, or never sent ─────────▶ is not there any more
//!                          ├─ another one was confirmed or read ▶ is not there any more
//!                          └─ no answer: stays as it is
//! ```
//!
//! A PLC executes what it hears in order, so what was read or confirmed later than a write was sent tells what has become of
//! that write. What must hold: at every time at least one value may be there; and only owners write, one write after the other.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use fatek::Error;
use fatek::command::Request;
use tokio::time::Instant;

use crate::layout::{Kind, Place};

/// All cells of a line, and what the journal of its PLCs must say.
#[derive(Debug)]
pub(crate) struct Shadow {
    line: usize,
    owners: usize,
    /// By station, owner and kind.
    cells: Vec<Cell>,
    /// How often a request that is not one of its kind was called for, and how often confirmed, since the last audit.
    controls: HashMap<(usize, Request), (u64, u64)>,
    /// Writes that the caller has allowed to be repeated, since the last audit.
    repeatable: HashSet<(usize, Request)>,
}

/// A write that was begun.
#[derive(Clone, Debug)]
#[must_use]
pub(crate) struct Write {
    parts: Vec<(Place, u64)>,
    control: Option<(usize, Request)>,
}

impl Shadow {
    pub(crate) fn new(line: usize, stations: usize, owners: usize) -> Self {
        let places = (0..stations).flat_map(|station| {
            (0..owners).flat_map(move |owner| Kind::ALL.into_iter().map(move |kind| Place { station, owner, kind }))
        });
        let cells = places.map(|place| Cell::new(place.value(line, 0))).collect();
        Self { line, owners, cells, controls: HashMap::new(), repeatable: HashSet::new() }
    }

    /// Begins to write the next version to these cells, in one request; gives the values.
    pub(crate) fn begin(&mut self, places: &[Place], now: Instant) -> (Write, Vec<u32>) {
        let mut write = Write { parts: Vec::new(), control: None };
        let mut values = Vec::new();
        for &place in places {
            let line = self.line;
            let cell = self.cell(place);
            cell.version = cell.version.wrapping_add(1);
            let value = place.value(line, cell.version);
            write.parts.push((place, cell.begin(value, now)));
            values.push(value);
        }
        (write, values)
    }

    /// Begins to broadcast the next version to the stations.
    pub(crate) fn begin_broadcast(&mut self, owner: usize, stations: usize, now: Instant) -> u32 {
        let places: Vec<_> = (0..stations).map(|station| Place { station, owner, kind: Kind::Cast }).collect();
        let (_unanswered, values) = self.begin(&places, now);
        values[0]
    }

    /// Begins a request that has no version: the journal can only count it.
    pub(crate) fn begin_control(&mut self, place: Place, on: bool, request: Request, now: Instant) -> Write {
        let id = self.cell(place).begin(on.into(), now);
        let control = (place.station, request);
        self.controls.entry(control.clone()).or_default().0 += 1;
        Write { parts: vec![(place, id)], control: Some(control) }
    }

    pub(crate) fn may_be_repeated(&mut self, station: usize, request: Request) {
        self.repeatable.insert((station, request));
    }

    /// A write has ended. One whose future was dropped never does.
    pub(crate) fn end(&mut self, write: &Write, result: &Result<(), Error>, now: Instant) {
        for &(place, id) in &write.parts {
            let cell = self.cell(place);
            match result {
                Ok(()) => cell.confirmed(id, now),
                Err(error) if !error.may_have_executed() => cell.refused(id, now),
                Err(_) => {}
            }
        }
        if let (Ok(()), Some(control)) = (result, &write.control) {
            self.controls.entry(control.clone()).or_default().1 += 1;
        }
    }

    /// Whether a read that began then may have found this value there; else what it may have found.
    pub(crate) fn check(&self, place: Place, value: u32, began: Instant) -> Result<(), String> {
        self.cells[self.index(place)]
            .check(value, began)
            .map_err(|may| format!("{place:?} cannot hold {value:08X}, {may}"))
    }

    /// It holds this value, and no write to it is under way.
    pub(crate) fn holds(&mut self, place: Place, value: u32, now: Instant) {
        self.cell(place).holds(value, now);
    }

    fn cell(&mut self, place: Place) -> &mut Cell {
        let index = self.index(place);
        &mut self.cells[index]
    }

    fn index(&self, place: Place) -> usize {
        (place.station * self.owners + place.owner) * Kind::ALL.len() + place.kind.index()
    }

    /// How often a request may have been executed since the last audit: at least, and at most.
    pub(crate) fn executions(&self, station: usize, request: &Request) -> (u64, Option<u64>) {
        let key = (station, request.clone());
        match self.controls.get(&key) {
            Some(&(called, confirmed)) => (confirmed, Some(called)),
            None if self.repeatable.contains(&key) => (0, None),
            None => (0, Some(1)),
        }
    }

    /// The requests that are only counted.
    pub(crate) fn controls(&self) -> impl Iterator<Item = &(usize, Request)> {
        self.controls.keys()
    }

    /// An audit is done: from now on the journal is a new one.
    pub(crate) fn forget_executions(&mut self) {
        self.controls.clear();
        self.repeatable.clear();
    }
}

/// For how long it is remembered what a cell could hold: longer than any read takes.
const MEMORY: Duration = Duration::from_secs(60);

#[derive(Debug)]
struct Cell {
    version: u16,
    next_id: u64,
    values: Vec<Held>,
}

#[derive(Debug)]
struct Held {
    id: u64,
    value: u32,
    /// `None`: it may still be there.
    until: Option<Instant>,
}

impl Cell {
    fn new(value: u32) -> Self {
        // All that most of them will ever need, so that memory does not grow while they are written for the first time.
        let mut values = Vec::with_capacity(4);
        values.push(Held { id: 0, value, until: None });
        Self { version: 0, next_id: 1, values }
    }

    fn begin(&mut self, value: u32, now: Instant) -> u64 {
        self.values.retain(|held| held.until.is_none_or(|until| now.saturating_duration_since(until) < MEMORY));
        let id = self.next_id;
        self.next_id += 1;
        self.values.push(Held { id, value, until: None });
        id
    }

    fn confirmed(&mut self, id: u64, now: Instant) {
        self.end_all(now, |held| held.id != id);
    }

    fn refused(&mut self, id: u64, now: Instant) {
        self.end_all(now, |held| held.id == id);
    }

    fn holds(&mut self, value: u32, now: Instant) {
        self.end_all(now, |held| held.value != value);
    }

    fn end_all(&mut self, now: Instant, which: impl Fn(&Held) -> bool) {
        for held in self.values.iter_mut().filter(|held| held.until.is_none() && which(held)) {
            held.until = Some(now);
        }
    }

    fn check(&self, value: u32, began: Instant) -> Result<(), String> {
        let possible = |held: &&Held| held.until.is_none_or(|until| until >= began);
        if self.values.iter().filter(possible).any(|held| held.value == value) {
            return Ok(());
        }
        let may: Vec<_> = self.values.iter().filter(possible).map(|held| format!("{:08X}", held.value)).collect();
        let earlier = self.values.iter().any(|held| held.value == value);
        Err(format!("only {}{}", may.join(" or "), if earlier { "; it did earlier" } else { "" }))
    }
}

#[cfg(test)]
mod tests {
    use fatek::Register;
    use fatek::command::{InvalidRequest, WriteRegisters};

    use super::*;

    const PLACE: Place = Place { station: 2, owner: 3, kind: Kind::Double(1) };

    fn shadow() -> (Shadow, Instant) {
        let now = Instant::now();
        (Shadow::new(1, 4, 4), now)
    }

    fn at(start: Instant, seconds: u64) -> Instant {
        start + Duration::from_secs(seconds)
    }

    fn never_sent() -> Result<(), Error> {
        Err(Error::Invalid(InvalidRequest::Station { station: 0 }))
    }

    #[test]
    fn a_confirmed_value_is_the_only_one_for_reads_that_begin_later() {
        let (mut shadow, start) = shadow();
        let (write, values) = shadow.begin(&[PLACE], at(start, 1));
        let (old, new) = (PLACE.value(1, 0), values[0]);
        // Under way: both.
        assert!(shadow.check(PLACE, old, at(start, 1)).is_ok() && shadow.check(PLACE, new, at(start, 1)).is_ok());
        shadow.end(&write, &Ok(()), at(start, 2));
        // A read that began before it was confirmed may have been executed before it, too.
        assert!(shadow.check(PLACE, old, at(start, 1)).is_ok());
        let error = shadow.check(PLACE, old, at(start, 3)).unwrap_err();
        assert!(error.contains("it did earlier"), "{error}");
        assert!(shadow.check(PLACE, new, at(start, 3)).is_ok());
    }

    #[test]
    fn a_write_that_never_ends_leaves_both_until_one_is_read() {
        let (mut shadow, start) = shadow();
        let (_dropped, values) = shadow.begin(&[PLACE], at(start, 1));
        let (old, new) = (PLACE.value(1, 0), values[0]);
        assert!(shadow.check(PLACE, old, at(start, 9)).is_ok() && shadow.check(PLACE, new, at(start, 9)).is_ok());
        shadow.holds(PLACE, old, at(start, 10));
        assert!(shadow.check(PLACE, new, at(start, 11)).is_err());
        assert!(shadow.check(PLACE, old, at(start, 11)).is_ok());
    }

    #[test]
    fn a_write_that_was_never_sent_is_not_there() {
        let (mut shadow, start) = shadow();
        let (write, values) = shadow.begin(&[PLACE], at(start, 1));
        shadow.end(&write, &never_sent(), at(start, 2));
        assert!(shadow.check(PLACE, values[0], at(start, 3)).is_err());
    }

    #[test]
    fn the_value_of_another_place_is_never_right() {
        let (shadow, start) = shadow();
        for other in
            [Place { station: 3, ..PLACE }, Place { owner: 2, ..PLACE }, Place { kind: Kind::Double(2), ..PLACE }]
        {
            assert!(shadow.check(PLACE, other.value(1, 0), start).is_err());
        }
        assert!(shadow.check(PLACE, PLACE.value(0, 0), start).is_err());
    }

    #[test]
    fn what_was_forgotten_is_no_longer_kept() {
        let (mut shadow, start) = shadow();
        for second in 0..10_000 {
            let (write, _) = shadow.begin(&[PLACE], at(start, second));
            shadow.end(&write, &Ok(()), at(start, second));
        }
        assert!(shadow.cells[shadow.index(PLACE)].values.len() < 70);
    }

    #[test]
    fn each_write_may_be_executed_once_and_each_control_as_often_as_called_for() {
        let (mut shadow, start) = shadow();
        let write = Request::WriteRegisters(WriteRegisters::new(Register::r(0), [1]).unwrap());
        let control = Request::WriteRegisters(WriteRegisters::new(Register::r(1), [1]).unwrap());
        let repeatable = Request::WriteRegisters(WriteRegisters::new(Register::r(2), [1]).unwrap());
        let place = Place { kind: Kind::Switch, ..PLACE };
        let confirmed = shadow.begin_control(place, true, control.clone(), start);
        shadow.end(&confirmed, &Ok(()), start);
        let _dropped = shadow.begin_control(place, true, control.clone(), start);
        shadow.may_be_repeated(2, repeatable.clone());
        assert_eq!(shadow.executions(2, &write), (0, Some(1)));
        assert_eq!(shadow.executions(2, &control), (1, Some(2)));
        assert_eq!(shadow.executions(2, &repeatable), (0, None));
        shadow.forget_executions();
        assert_eq!(shadow.executions(2, &control), (0, Some(1)));
    }
}
