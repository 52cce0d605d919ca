//! Expected memory of the PLCs of a line. No I/O and no clock.
//!
//! The possible values of a cell are the last confirmed one and those of writes in doubt:
//!
//! ```text
//! begin ──▶ possible ──┬─ refused, or never sent ───────────▶ no longer possible
//!                      ├─ other value confirmed or read ────▶ no longer possible
//!                      └─ no reply: stays possible
//! ```
//!
//! A PLC executes requests in order, so a later read or confirmation resolves the writes in doubt
//! before it.
//!
//! Invariants: every cell has at least one possible value at any time; only the owner writes a
//! cell, one write at a time.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use fatek::Error;
use fatek::command::Request;
use tokio::time::Instant;

use crate::layout::{Kind, Place};

/// Expected cells of a line, and expected journal of its PLCs.
#[derive(Debug)]
pub(crate) struct ExpectedMemory {
    line: usize,
    owners: usize,
    /// Cells by station, owner and kind.
    cells: Vec<Cell>,
    /// Numbers of calls and of confirmations of each control command since the last audit.
    controls: HashMap<(usize, Request), (u64, u64)>,
    /// Writes with retries allowed, since the last audit.
    repeatable: HashSet<(usize, Request)>,
}

/// Write in progress.
#[derive(Clone, Debug)]
#[must_use]
pub(crate) struct Write {
    parts: Vec<(Place, u64)>,
    control: Option<(usize, Request)>,
}

impl ExpectedMemory {
    pub(crate) fn new(line: usize, stations: usize, owners: usize) -> Self {
        let places = (0..stations).flat_map(|station| {
            (0..owners).flat_map(move |owner| Kind::ALL.into_iter().map(move |kind| Place { station, owner, kind }))
        });
        let cells = places.map(|place| Cell::new(place.value(line, 0))).collect();
        Self { line, owners, cells, controls: HashMap::new(), repeatable: HashSet::new() }
    }

    /// Begins a write of the next version of these cells in one request. Returns the values.
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

    /// Begins a broadcast of the next version to all stations.
    pub(crate) fn begin_broadcast(&mut self, owner: usize, stations: usize, now: Instant) -> u32 {
        let places: Vec<_> = (0..stations).map(|station| Place { station, owner, kind: Kind::Broadcast }).collect();
        let (_unanswered, values) = self.begin(&places, now);
        values[0]
    }

    /// Begins a control command, which has no version: the journal counts it.
    pub(crate) fn begin_control(&mut self, place: Place, on: bool, request: Request, now: Instant) -> Write {
        let id = self.cell(place).begin(on.into(), now);
        let control = (place.station, request);
        self.controls.entry(control.clone()).or_default().0 += 1;
        Write { parts: vec![(place, id)], control: Some(control) }
    }

    pub(crate) fn may_be_repeated(&mut self, station: usize, request: Request) {
        self.repeatable.insert((station, request));
    }

    /// Ends a write. A write with a dropped future has no end.
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

    /// Checks that a read begun at `began` may return this value. The error lists the possible
    /// values.
    pub(crate) fn check(&self, place: Place, value: u32, began: Instant) -> Result<(), String> {
        self.cells[self.index(place)]
            .check(value, began)
            .map_err(|possible| format!("{place:?}: wrong value {value:08X}, {possible}"))
    }

    /// Notes that the cell has this value, and that no write to it is in progress.
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

    /// Minimum and maximum number of executions of a request since the last audit.
    pub(crate) fn executions(&self, station: usize, request: &Request) -> (u64, Option<u64>) {
        let key = (station, request.clone());
        match self.controls.get(&key) {
            Some(&(called, confirmed)) => (confirmed, Some(called)),
            None if self.repeatable.contains(&key) => (0, None),
            None => (0, Some(1)),
        }
    }

    /// Control commands since the last audit.
    pub(crate) fn controls(&self) -> impl Iterator<Item = &(usize, Request)> {
        self.controls.keys()
    }

    /// Resets the expected journal after an audit.
    pub(crate) fn forget_executions(&mut self) {
        self.controls.clear();
        self.repeatable.clear();
    }
}

/// Time for which former values are kept: longer than any read.
const RETENTION: Duration = Duration::from_secs(60);

#[derive(Debug)]
struct Cell {
    version: u16,
    next_id: u64,
    values: Vec<PossibleValue>,
}

#[derive(Debug)]
struct PossibleValue {
    id: u64,
    value: u32,
    /// End of the time in which the value was possible, if it has ended.
    until: Option<Instant>,
}

impl Cell {
    fn new(value: u32) -> Self {
        // Enough for most cells, so that the first writes do not look like growth of memory.
        let mut values = Vec::with_capacity(4);
        values.push(PossibleValue { id: 0, value, until: None });
        Self { version: 0, next_id: 1, values }
    }

    fn begin(&mut self, value: u32, now: Instant) -> u64 {
        self.values.retain(|held| held.until.is_none_or(|until| now.saturating_duration_since(until) < RETENTION));
        let id = self.next_id;
        self.next_id += 1;
        self.values.push(PossibleValue { id, value, until: None });
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

    fn end_all(&mut self, now: Instant, which: impl Fn(&PossibleValue) -> bool) {
        for held in self.values.iter_mut().filter(|held| held.until.is_none() && which(held)) {
            held.until = Some(now);
        }
    }

    fn check(&self, value: u32, began: Instant) -> Result<(), String> {
        let possible = |held: &&PossibleValue| held.until.is_none_or(|until| until >= began);
        if self.values.iter().filter(possible).any(|held| held.value == value) {
            return Ok(());
        }
        let others: Vec<_> = self.values.iter().filter(possible).map(|held| format!("{:08X}", held.value)).collect();
        let earlier = self.values.iter().any(|held| held.value == value);
        Err(format!("expected {}{}", others.join(" or "), if earlier { "; an earlier value" } else { "" }))
    }
}

#[cfg(test)]
mod tests {
    use fatek::Register;
    use fatek::command::{InvalidRequest, WriteRegisters};

    use super::*;

    const PLACE: Place = Place { station: 2, owner: 3, kind: Kind::DWord(1) };

    fn expected() -> (ExpectedMemory, Instant) {
        let now = Instant::now();
        (ExpectedMemory::new(1, 4, 4), now)
    }

    fn at(start: Instant, seconds: u64) -> Instant {
        start + Duration::from_secs(seconds)
    }

    fn never_sent() -> Result<(), Error> {
        Err(Error::Invalid(InvalidRequest::Station { station: 0 }))
    }

    #[test]
    fn only_the_confirmed_value_is_possible_for_later_reads() {
        let (mut expected, start) = expected();
        let (write, values) = expected.begin(&[PLACE], at(start, 1));
        let (old, new) = (PLACE.value(1, 0), values[0]);
        // In progress: both are possible.
        assert!(expected.check(PLACE, old, at(start, 1)).is_ok() && expected.check(PLACE, new, at(start, 1)).is_ok());
        expected.end(&write, &Ok(()), at(start, 2));
        // A read begun before the confirmation may have been executed before the write.
        assert!(expected.check(PLACE, old, at(start, 1)).is_ok());
        let error = expected.check(PLACE, old, at(start, 3)).unwrap_err();
        assert!(error.contains("an earlier value"), "{error}");
        assert!(expected.check(PLACE, new, at(start, 3)).is_ok());
    }

    #[test]
    fn dropped_write_leaves_both_values_until_a_read() {
        let (mut expected, start) = expected();
        let (_dropped, values) = expected.begin(&[PLACE], at(start, 1));
        let (old, new) = (PLACE.value(1, 0), values[0]);
        assert!(expected.check(PLACE, old, at(start, 9)).is_ok() && expected.check(PLACE, new, at(start, 9)).is_ok());
        expected.holds(PLACE, old, at(start, 10));
        assert!(expected.check(PLACE, new, at(start, 11)).is_err());
        assert!(expected.check(PLACE, old, at(start, 11)).is_ok());
    }

    #[test]
    fn value_of_an_unsent_write_is_impossible() {
        let (mut expected, start) = expected();
        let (write, values) = expected.begin(&[PLACE], at(start, 1));
        expected.end(&write, &never_sent(), at(start, 2));
        assert!(expected.check(PLACE, values[0], at(start, 3)).is_err());
    }

    #[test]
    fn value_of_another_place_is_impossible() {
        let (expected, start) = expected();
        for other in
            [Place { station: 3, ..PLACE }, Place { owner: 2, ..PLACE }, Place { kind: Kind::DWord(2), ..PLACE }]
        {
            assert!(expected.check(PLACE, other.value(1, 0), start).is_err());
        }
        assert!(expected.check(PLACE, PLACE.value(0, 0), start).is_err());
    }

    #[test]
    fn former_values_are_dropped_after_the_retention_time() {
        let (mut expected, start) = expected();
        for second in 0..10_000 {
            let (write, _) = expected.begin(&[PLACE], at(start, second));
            expected.end(&write, &Ok(()), at(start, second));
        }
        assert!(expected.cells[expected.index(PLACE)].values.len() < 70);
    }

    #[test]
    fn writes_execute_once_and_controls_as_often_as_called() {
        let (mut expected, start) = expected();
        let write = Request::WriteRegisters(WriteRegisters::new(Register::r(0), [1]).unwrap());
        let control = Request::WriteRegisters(WriteRegisters::new(Register::r(1), [1]).unwrap());
        let repeatable = Request::WriteRegisters(WriteRegisters::new(Register::r(2), [1]).unwrap());
        let place = Place { kind: Kind::Switch, ..PLACE };
        let confirmed = expected.begin_control(place, true, control.clone(), start);
        expected.end(&confirmed, &Ok(()), start);
        let _dropped = expected.begin_control(place, true, control.clone(), start);
        expected.may_be_repeated(2, repeatable.clone());
        assert_eq!(expected.executions(2, &write), (0, Some(1)));
        assert_eq!(expected.executions(2, &control), (1, Some(2)));
        assert_eq!(expected.executions(2, &repeatable), (0, None));
        expected.forget_executions();
        assert_eq!(expected.executions(2, &control), (0, Some(1)));
    }
}
