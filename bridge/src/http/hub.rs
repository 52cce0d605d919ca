//! The hub looks at the poller now and then, and sends the differences to all readers at once.
//!
//! Each reader gets a snapshot first, taken under the same lock that frames are sent under: so the frames
//! that follow are exactly the differences from it. A reader that is too slow misses frames, and gets a
//! snapshot again.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use fatek::plant::{PlantTag, WriteRule};
use serde::Serialize;
use serde_json::Value;
use tokio::sync::{Semaphore, broadcast};
use tokio::time::{MissedTickBehavior, interval_at};
use tokio_util::sync::CancellationToken;

use super::history::{History, MAX_SLOTS};
use super::status::{Memory, Status};
use super::view::{Changes, Grade, Milliseconds, PlcView, TagState, View, is_drawn};
use crate::run::Bridge;

/// The time between two frames.
const TICK: Duration = Duration::from_millis(500);
/// The frames between two slots of the history.
const TICKS_A_SLOT: u32 = 4;
/// The frames between two looks at the figures.
const TICKS_A_STATUS: u32 = 2;
/// The frames that wait for a slow reader before it misses some.
const FRAMES: usize = 8;
/// The event streams at once.
pub(super) const MAX_STREAMS: usize = 32;

/// The hub, shared by its task and the readers.
#[derive(Debug)]
pub(super) struct Hub {
    state: Mutex<State>,
    frames: broadcast::Sender<Bytes>,
    /// Permits of event streams.
    pub(super) streams: Arc<Semaphore>,
    /// Snapshots that readers got because they had missed frames.
    pub(super) resyncs: AtomicU64,
}

/// State of the hub.
#[derive(Debug)]
pub(super) struct State {
    /// The tags.
    pub(super) view: View,
    /// Their last values.
    pub(super) history: History,
    /// The figures, at the last look.
    pub(super) status: Arc<Status>,
    /// For the figures of the next look.
    memory: Memory,
    /// When it looked last.
    pub(super) looked: Instant,
}

impl Hub {
    /// Makes a hub that has looked at the bridge once.
    pub(super) fn new(bridge: &Bridge) -> Self {
        let state = State {
            view: View::default(),
            history: History::new(),
            status: Arc::default(),
            memory: Memory::default(),
            looked: Instant::now(),
        };
        let hub = Self {
            state: Mutex::new(state),
            frames: broadcast::Sender::new(FRAMES),
            streams: Arc::new(Semaphore::new(MAX_STREAMS)),
            resyncs: AtomicU64::new(0),
        };
        hub.look(bridge, true, true);
        hub
    }

    /// Locks what the hub knows. Not across an `await`.
    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns a snapshot, and the frames that follow it.
    pub(super) fn join(&self) -> (Bytes, broadcast::Receiver<Bytes>) {
        let state = self.lock();
        (state.snapshot(Instant::now()), self.frames.subscribe())
    }

    /// As [`join`](Self::join), for a reader that has missed frames.
    pub(super) fn join_again(&self) -> (Bytes, broadcast::Receiver<Bytes>) {
        self.resyncs.fetch_add(1, Ordering::Relaxed);
        self.join()
    }

    /// Looks at the bridge until `stop` is cancelled.
    pub(super) async fn run(self: Arc<Self>, bridge: Bridge, stop: CancellationToken) {
        let mut ticks = interval_at(tokio::time::Instant::now() + TICK, TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut tick: u32 = 1;
        while stop.run_until_cancelled(ticks.tick()).await.is_some() {
            let is_slot = tick.is_multiple_of(TICKS_A_SLOT);
            // Without a reader the history alone needs a look.
            if is_slot || self.frames.receiver_count() > 0 {
                self.look(&bridge, is_slot, tick.is_multiple_of(TICKS_A_STATUS));
            }
            tick = tick.wrapping_add(1);
        }
    }

    /// Looks at the tags, and sends the differences.
    fn look(&self, bridge: &Bridge, is_slot: bool, with_status: bool) {
        let now = Instant::now();
        let mut state = self.lock();
        let is_rebuilt = state.follow(bridge);
        let changes = state.view.look();
        state.looked = now;
        if with_status {
            let State { view, memory, .. } = &mut *state;
            state.status = Arc::new(memory.status(bridge, view, now));
        }
        if is_slot {
            let State { view, history, .. } = &mut *state;
            history.push(view.states().iter().map(|state| state.as_ref().and_then(TagState::number)));
        }
        if self.frames.receiver_count() > 0 {
            let frame = if is_rebuilt { state.snapshot(now) } else { state.changes(changes, with_status, now) };
            // It fails if the last reader has just gone.
            let _ = self.frames.send(frame);
        }
    }
}

impl State {
    /// Takes over PLCs and tags if a reload has changed them, and returns whether it has.
    fn follow(&mut self, bridge: &Bridge) -> bool {
        let plcs = bridge.registry.read();
        let is_outdated = self.view.is_outdated(&plcs);
        if is_outdated {
            let moved = self.view.rebuild(&plcs);
            self.history.rebuild(&moved);
        }
        is_outdated
    }

    fn snapshot(&self, now: Instant) -> Bytes {
        let states = self.view.states().iter();
        event(
            "snapshot",
            &Snapshot {
                slot: self.history.newest(),
                slot_ms: Milliseconds(TICK * TICKS_A_SLOT),
                slots: MAX_SLOTS,
                plcs: self.view.plcs().iter().map(PlcForm::of).collect(),
                values: states.map(|state| ValueForm::of(state.as_ref(), now)).collect(),
                status: &self.status,
            },
        )
    }

    fn changes(&self, changes: Changes, with_status: bool, now: Instant) -> Bytes {
        let state = |place: usize| self.view.states().get(place).and_then(Option::as_ref);
        let value = |place: &usize| (*place, ValueForm::of(state(*place), now));
        event(
            "changes",
            &ChangesForm {
                slot: self.history.newest(),
                values: changes.values.iter().map(value).collect(),
                read: runs(changes.read.iter().filter_map(|place| Some((state(*place)?.age(now), *place)))),
                status: with_status.then_some(&*self.status),
            },
        )
    }
}

/// Runs of places with one age: `[age, first, last]`.
///
/// All tags of a request have one age, and are neighbours mostly, so this is short.
fn runs(places: impl Iterator<Item = (Milliseconds, usize)>) -> Vec<(Milliseconds, usize, usize)> {
    let mut runs: Vec<(Milliseconds, usize, usize)> = Vec::new();
    for (age, place) in places {
        match runs.last_mut() {
            Some((of_run, _, last)) if *of_run == age && place.checked_sub(1) == Some(*last) => *last = place,
            Some(_) | None => runs.push((age, place, place)),
        }
    }
    runs
}

/// Encodes a server-sent event. JSON has no line feed outside of texts, and escapes those within.
fn event(name: &str, form: &impl Serialize) -> Bytes {
    let mut event = format!("event: {name}\ndata: ").into_bytes();
    if let Err(error) = serde_json::to_writer(&mut event, form) {
        // No form has keys or numbers that JSON lacks.
        tracing::error!(%error, "an event cannot be encoded");
        return Bytes::new();
    }
    event.extend_from_slice(b"\n\n");
    event.into()
}

#[derive(Serialize)]
struct Snapshot<'s> {
    slot: u64,
    slot_ms: Milliseconds,
    slots: usize,
    plcs: Vec<PlcForm<'s>>,
    /// In the order of the PLCs and their tags.
    values: Vec<ValueForm<'s>>,
    status: &'s Status,
}

#[derive(Serialize)]
struct ChangesForm<'s> {
    slot: u64,
    values: Vec<(usize, ValueForm<'s>)>,
    read: Vec<(Milliseconds, usize, usize)>,
    #[serde(skip_serializing_if = "Option::is_none")]
    status: Option<&'s Status>,
}

/// Value, quality, age and reason.
#[derive(Serialize)]
struct ValueForm<'s>(Option<&'s Value>, Grade, Milliseconds, Option<&'s str>);

impl<'s> ValueForm<'s> {
    fn of(state: Option<&'s TagState>, now: Instant) -> Self {
        match state {
            Some(state) => Self(Some(&state.value), state.grade, state.age(now), state.why.as_deref()),
            None => Self(None, Grade::Bad, Milliseconds(Duration::ZERO), Some("not read yet")),
        }
    }
}

#[derive(Serialize)]
struct PlcForm<'s> {
    plc: &'s str,
    tags: Vec<TagForm<'s>>,
}

impl<'s> PlcForm<'s> {
    fn of(plc: &'s PlcView) -> Self {
        Self { plc: plc.polled.plc.name(), tags: plc.polled.plc.tags().map(TagForm::of).collect() }
    }
}

#[derive(Serialize)]
struct TagForm<'s> {
    tag: &'s str,
    at: String,
    /// Its values are drawn as a line.
    drawn: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    unit: Option<&'s str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    class: Option<&'s str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    group: Option<&'s str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    comment: Option<&'s str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    write: Option<WriteForm>,
}

#[derive(Serialize)]
struct WriteForm {
    min: Option<f64>,
    max: Option<f64>,
    pulse_ms: Option<Milliseconds>,
}

impl WriteForm {
    fn of(rule: WriteRule) -> Self {
        Self { min: rule.min, max: rule.max, pulse_ms: rule.pulse.map(Milliseconds) }
    }
}

impl<'s> TagForm<'s> {
    fn of(tag: &'s PlantTag) -> Self {
        Self {
            tag: tag.name(),
            at: tag.tag().to_string(),
            drawn: is_drawn(tag),
            unit: tag.unit(),
            class: tag.class(),
            group: tag.group(),
            comment: tag.comment(),
            write: tag.write().map(WriteForm::of),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_with_one_age_are_one_run() {
        let ms = |ms| Milliseconds(Duration::from_millis(ms));
        let places = [(ms(5), 0), (ms(5), 1), (ms(5), 2), (ms(7), 3), (ms(5), 4), (ms(5), 6)];
        assert_eq!(runs(places.into_iter()), [(ms(5), 0, 2), (ms(7), 3, 3), (ms(5), 4, 4), (ms(5), 6, 6)]);
        assert_eq!(runs(std::iter::empty()), []);
    }

    #[test]
    fn an_event_is_one_line_with_any_texts() {
        let event = event("changes", &["a\nb\r\n", "</script>"]);
        assert_eq!(&event[..], b"event: changes\ndata: [\"a\\nb\\r\\n\",\"</script>\"]\n\n");
    }
}
