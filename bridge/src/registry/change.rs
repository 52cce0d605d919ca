//! The difference between the PLCs that are polled and those of a configuration.

use std::collections::{BTreeMap, HashMap};
use std::error::Error;
use std::fmt;
use std::sync::Arc;
use std::time::SystemTime;

use fatek::Pool;
use fatek::plant::{Plant, PlantPlc, PlantTag};
use fatek::poll::{PolledStation, PollerHandle, ScanClass, TagId};

use super::{Place, PlcOwnership, Plcs, PolledPlc, default_class};
use crate::batch::milliseconds;

/// The number of PLCs and tags that a configuration has changed. Tags of new and removed PLCs are counted, too.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Changes {
    /// PLCs that are polled now and were not before.
    pub plcs_added: usize,
    /// PLCs whose link or station is another.
    pub plcs_moved: usize,
    /// PLCs that are not polled any more.
    pub plcs_removed: usize,
    /// Tags that are new, or are polled in another way.
    pub tags_added: usize,
    /// Tags that are gone, or are polled in another way.
    pub tags_removed: usize,
    /// Tags that are polled as before.
    pub tags_kept: usize,
}

impl fmt::Display for Changes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plcs_added, plcs_moved, plcs_removed, tags_added, tags_removed, tags_kept } = self;
        write!(f, "PLCs: {plcs_added} added, {plcs_moved} moved, {plcs_removed} removed; ")?;
        write!(f, "tags: {tags_added} added, {tags_removed} removed, {tags_kept} kept")
    }
}

/// PLCs that are polled by the next configuration; samples of their new tags are not taken yet.
#[derive(Debug, Default)]
pub(super) struct Staged {
    plcs: BTreeMap<Arc<str>, StagedPlc>,
}

#[derive(Debug)]
struct StagedPlc {
    plc: PolledPlc,
    is: Kind,
    /// Tags that the poller has got now.
    added: Vec<TagId>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    New,
    Moved,
    Kept,
}

impl Staged {
    /// Adds the tags of a PLC to the poller that it does not have. On error, those of this call that were added
    /// before the fault are removed by [`undo`](Self::undo).
    pub(super) fn add(
        &mut self,
        plant: &Plant,
        plc: &PlantPlc,
        ownership: PlcOwnership,
        old: Option<&PolledPlc>,
        pool: &Pool,
        poller: &PollerHandle,
    ) -> Result<(), Box<dyn Error + Send + Sync>> {
        let is_same = |old: &&PolledPlc| {
            let (before, after) = (&old.plc, plc);
            // Each ownership has a link of its own.
            before.endpoint() == after.endpoint()
                && before.station() == after.station()
                && old.revision == ownership.revision
        };
        let (is, kept) = match (old, old.filter(is_same)) {
            (None, _) => (Kind::New, None),
            (Some(_), None) => (Kind::Moved, None),
            (Some(_), Some(kept)) => (Kind::Kept, Some(kept)),
        };
        let (station, polled) = match kept {
            Some(kept) => (kept.station.clone(), kept.polled.clone()),
            None => {
                let station = pool.station(plc.endpoint().clone(), plc.station())?;
                let polled = poller.station(&station)?;
                (station, polled)
            }
        };
        let tags: Vec<&PlantTag> = plc.tags().collect();
        let class_of = |tag: &&PlantTag| {
            let class = tag.class().and_then(|name| plant.class(name));
            class.map_or_else(default_class, fatek::plant::PlantClass::scan_class)
        };
        let classes: Vec<ScanClass> = tags.iter().map(class_of).collect();
        let known = kept.map(known_tags).unwrap_or_default();
        let is_polled = |tag: &PlantTag, class: &ScanClass| {
            let (id, old, old_class) = known.get(tag.name())?;
            (old.poll_tag() == tag.poll_tag() && **old_class == *class).then_some(*id)
        };
        let mut ids: Vec<Option<TagId>> = tags.iter().zip(&classes).map(|(tag, class)| is_polled(tag, class)).collect();
        let name: Arc<str> = plc.name().into();
        let staged = StagedPlc {
            plc: PolledPlc {
                plc: plc.clone(),
                station,
                polled: polled.clone(),
                ids: Vec::new(),
                classes: classes.clone(),
                revision: ownership.revision,
                gate: ownership.gate,
                since: kept.map_or_else(|| milliseconds(SystemTime::now()), |kept| kept.since),
            },
            is,
            added: Vec::new(),
        };
        // Entered before its tags are added, so that `undo` finds them.
        let staged = self.plcs.entry(name).or_insert(staged);
        add_missing(&polled, &tags, &classes, &mut ids, &mut staged.added)?;
        staged.plc.ids = ids.into_iter().flatten().collect();
        Ok(())
    }

    /// Removes all tags and PLCs that were added.
    pub(super) fn undo(self) {
        for StagedPlc { plc, is, added } in self.plcs.into_values() {
            match is {
                Kind::New | Kind::Moved => plc.polled.stop(),
                Kind::Kept => added.into_iter().for_each(|id| {
                    plc.polled.remove(id);
                }),
            }
        }
    }

    /// Returns whether it has a PLC of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.plcs.contains_key(name)
    }

    /// Puts the staged PLCs in the place of those with their names, and ends polling of the tags that these have no
    /// more.
    pub(super) fn commit(self, plcs: &mut Plcs) -> Changes {
        let mut changes = Changes::default();
        plcs.generation = plcs.generation.saturating_add(1);
        for (name, StagedPlc { plc, is, added }) in self.plcs {
            let (revision, gate) = (plc.revision, plc.gate.clone());
            let place = |(index, tag): (usize, &PlantTag)| Place {
                plc: name.clone(),
                tag: tag.name().into(),
                index,
                revision,
                gate: gate.clone(),
            };
            let old = plcs.plcs.remove(&name);
            old.iter().flat_map(|old| &old.ids).for_each(|id| drop(plcs.places.remove(id)));
            plcs.places.extend(plc.ids.iter().copied().zip(plc.plc.tags().enumerate().map(place)));
            let kept = plc.ids.len().saturating_sub(added.len());
            changes.tags_kept = changes.tags_kept.saturating_add(kept);
            changes.tags_added = changes.tags_added.saturating_add(added.len());
            let old_tags = old.as_ref().map_or(0, |old| old.ids.len());
            changes.tags_removed = changes.tags_removed.saturating_add(old_tags.saturating_sub(kept));
            let counter = match is {
                Kind::New => Some(&mut changes.plcs_added),
                Kind::Moved => Some(&mut changes.plcs_moved),
                Kind::Kept => None,
            };
            counter.into_iter().for_each(|counter| *counter = counter.saturating_add(1));
            if let Some(old) = old {
                match is {
                    Kind::New | Kind::Moved => old.polled.stop(),
                    Kind::Kept => old.ids.iter().filter(|id| !plcs.places.contains_key(id)).for_each(|id| {
                        old.polled.remove(*id);
                    }),
                }
            }
            plcs.elsewhere.remove(&name);
            plcs.plcs.insert(name, plc);
        }
        changes
    }
}

/// The tags of a PLC by name, with id and class.
fn known_tags(plc: &PolledPlc) -> HashMap<&str, (TagId, &PlantTag, &ScanClass)> {
    let ids = plc.ids.iter().zip(&plc.classes);
    plc.plc.tags().zip(ids).map(|(tag, (id, class))| (tag.name(), (*id, tag, class))).collect()
}

/// Adds the tags without an id to the poller: those of one class at once, because each call plans anew.
fn add_missing(
    polled: &PolledStation,
    tags: &[&PlantTag],
    classes: &[ScanClass],
    ids: &mut [Option<TagId>],
    added: &mut Vec<TagId>,
) -> Result<(), fatek::poll::PollError> {
    let mut distinct: Vec<&ScanClass> = Vec::new();
    classes.iter().for_each(|class| {
        if !distinct.contains(&class) {
            distinct.push(class);
        }
    });
    for class in distinct {
        let is_missing = |at: &usize| ids.get(*at).is_some_and(Option::is_none) && classes.get(*at) == Some(class);
        let missing: Vec<usize> = (0..tags.len()).filter(is_missing).collect();
        let tags = missing.iter().filter_map(|at| tags.get(*at)).map(|tag| tag.poll_tag());
        let new = polled.add(*class, tags)?;
        added.extend(&new);
        for (at, id) in missing.into_iter().zip(new) {
            if let Some(place) = ids.get_mut(at) {
                *place = Some(id);
            }
        }
    }
    Ok(())
}
