//! The tags as readers see them, and the differences between two looks at the poller.
//!
//! Invariants:
//! - the states are in the order of the PLCs and of their tags in the configuration; a reader knows a tag by
//!   its place in this order, until the next snapshot;
//! - a bad tag has no value.

use std::collections::HashMap;
use std::ops::Range;
use std::time::{Duration, Instant};

use fatek::plant::PlantTag;
use fatek::poll::{Quality, Sample, TagId};
use serde::{Serialize, Serializer};
use serde_json::Value;

use crate::batch::milliseconds;
use crate::registry::{Plcs, PolledPlc};

/// The quality of a tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Grade {
    /// The last reading.
    Good,
    /// The last value that was read; later readings failed.
    Stale,
    /// No value.
    Bad,
}

/// The state of a tag.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TagState {
    /// The value, or a list of several; `Null` of a bad tag.
    pub(super) value: Value,
    /// Its quality.
    pub(super) grade: Grade,
    /// Why it is not good.
    pub(super) why: Option<String>,
    /// The time of the reply; of a bad tag, when it became bad.
    pub(super) at: Instant,
    /// The same as milliseconds since 1970.
    pub(super) ts: u64,
}

impl TagState {
    pub(super) fn of(sample: &Sample) -> Self {
        let (grade, why) = match &sample.quality {
            Quality::Good => (Grade::Good, None),
            Quality::Stale(reason) => (Grade::Stale, Some(reason.to_string())),
            Quality::Bad(reason) => (Grade::Bad, Some(reason.to_string())),
            // A quality of a later version.
            other => (Grade::Bad, Some(other.to_string())),
        };
        let json = |value| serde_json::to_value(value).unwrap_or(Value::Null);
        let value = match (grade, sample.values()) {
            (Grade::Bad, _) => Value::Null,
            (Grade::Good | Grade::Stale, [single]) => json(single),
            (Grade::Good | Grade::Stale, several) => several.iter().map(json).collect(),
        };
        Self { value, grade, why, at: sample.at.instant.into_std(), ts: milliseconds(sample.at.time) }
    }

    /// The age of the value at a time; of a bad tag, for how long it has been bad.
    pub(super) fn age(&self, now: Instant) -> Milliseconds {
        Milliseconds(now.saturating_duration_since(self.at))
    }

    /// A good value as a number: a discrete is 0 or 1.
    pub(super) fn number(&self) -> Option<f64> {
        match (self.grade, &self.value) {
            (Grade::Good, Value::Bool(on)) => Some(f64::from(u8::from(*on))),
            (Grade::Good, value) => value.as_f64(),
            (Grade::Stale | Grade::Bad, _) => None,
        }
    }
}

/// A time that is shown as whole milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Milliseconds(pub(super) Duration);

impl Serialize for Milliseconds {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u64(u64::try_from(self.0.as_millis()).unwrap_or(u64::MAX))
    }
}

/// The states of all tags, at the last look.
#[derive(Debug, Default)]
pub(super) struct View {
    plcs: Vec<PlcView>,
    states: Vec<Option<TagState>>,
    places: HashMap<TagId, usize>,
    /// The generation of the PLCs; `None` before the first look.
    generation: Option<u64>,
}

/// A PLC with the places of its tags.
#[derive(Debug)]
pub(super) struct PlcView {
    /// The PLC.
    pub(super) polled: PolledPlc,
    /// The places of its tags.
    pub(super) places: Range<usize>,
}

/// The places of tags that differ from the look before.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Changes {
    /// Value or quality differs.
    pub(super) values: Vec<usize>,
    /// Read anew with the same value.
    pub(super) read: Vec<usize>,
}

impl View {
    /// The PLCs in the order of their names.
    pub(super) fn plcs(&self) -> &[PlcView] {
        &self.plcs
    }

    /// The states; `None` before the first look.
    pub(super) fn states(&self) -> &[Option<TagState>] {
        &self.states
    }

    /// Returns whether a configuration was applied since the last [`rebuild`](Self::rebuild).
    pub(super) fn is_outdated(&self, plcs: &Plcs) -> bool {
        self.generation != Some(plcs.generation())
    }

    /// Takes over the PLCs and their tags. Returns the earlier place of each tag.
    pub(super) fn rebuild(&mut self, plcs: &Plcs) -> Vec<Option<usize>> {
        let earlier = std::mem::take(self);
        self.generation = Some(plcs.generation());
        let mut states = earlier.states;
        let mut moved = Vec::new();
        for plc in plcs.iter() {
            let first = self.states.len();
            for id in &plc.ids {
                let place = earlier.places.get(id).copied();
                self.places.insert(*id, self.states.len());
                self.states.push(place.and_then(|place| states.get_mut(place)?.take()));
                moved.push(place);
            }
            self.plcs.push(PlcView { polled: plc.clone(), places: first..self.states.len() });
        }
        moved
    }

    /// Looks at the current sample of each tag.
    pub(super) fn look(&mut self) -> Changes {
        let mut changes = Changes::default();
        for plc in &self.plcs {
            for sample in plc.polled.polled.snapshot() {
                let Some(place) = self.places.get(&sample.id) else { continue };
                let Some(known) = self.states.get_mut(*place) else { continue };
                take(known, &sample, *place, &mut changes);
            }
        }
        changes
    }
}

/// Takes the state of a sample over, and notes the difference.
fn take(known: &mut Option<TagState>, sample: &Sample, place: usize, changes: &mut Changes) {
    if let Some(known) = known {
        // Most tags, between two of their readings.
        if known.at == sample.at.instant.into_std() && known.grade == Grade::Good && sample.is_good() {
            return;
        }
        let state = TagState::of(sample);
        if (&known.value, known.grade, &known.why) == (&state.value, state.grade, &state.why) {
            if known.at != state.at {
                changes.read.push(place);
                *known = state;
            }
            return;
        }
    }
    changes.values.push(place);
    *known = Some(TagState::of(sample));
}

/// Returns whether the values of a tag are drawn as a line: numbers and discretes, one a tag.
pub(super) fn is_drawn(tag: &PlantTag) -> bool {
    !tag.tag().tag_type().is_text() && tag.tag().value_count() == 1
}
