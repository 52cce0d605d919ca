//! The PLCs that are polled, with their tags: shared by the collector, the outputs, the page and the reload.
//!
//! A configuration is applied in two phases. First all new and changed tags are added to the poller, which plans
//! their requests; if one fails, all of them are removed again and nothing has changed. Then the old tags are
//! removed, and samples are taken for the new ones. Tags that did not change stay as they are: they miss no cycle.

mod change;

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, RwLock, RwLockReadGuard};
use std::time::Duration;

use fatek::plant::{Plant, PlantPlc};
use fatek::poll::{PolledStation, PollerHandle, ScanClass, TagId};
use fatek::{Pool, Station};

pub use self::change::Changes;
use self::change::Staged;
use crate::batch::Batch;
use crate::fleet::Gate;

/// A PLC that is polled.
#[derive(Clone, Debug)]
pub struct PolledPlc {
    /// The PLC of the configuration.
    pub plc: PlantPlc,
    /// Its station.
    pub station: Station,
    /// Its tags in the poller.
    pub polled: PolledStation,
    /// The ids of its tags in the poller, in the order of the configuration.
    pub ids: Vec<TagId>,
    /// The scan classes of its tags, in the same order.
    pub classes: Vec<ScanClass>,
    /// In a fleet: the fencing token of the ownership; 0 without a fleet, and for a link that no other member has.
    pub revision: u64,
    /// In a fleet: the gate of the ownership.
    pub gate: Gate,
    /// When this bridge began to poll it with this link, in milliseconds since 1970.
    pub since: u64,
}

/// A PLC of the configuration that this bridge does not poll: in a fleet, another member does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Elsewhere {
    /// Another member polls it, or will.
    Member,
    /// This bridge has lost it, and perhaps no member polls it: so it is offline until one does.
    Lost,
}

/// The PLCs of a plant that a bridge polls.
#[derive(Clone, Copy, Debug)]
pub enum Share<'a> {
    /// All.
    All,
    /// In a fleet: those with an ownership here.
    Owned(&'a HashMap<Arc<str>, PlcOwnership>),
}

/// The ownership of a PLC by a member of a fleet.
#[derive(Clone, Debug)]
pub struct PlcOwnership {
    /// The fencing token; 0 for a link that no other member has.
    pub revision: u64,
    /// Open while requests may be sent to the PLC.
    pub gate: Gate,
}

impl Share<'_> {
    /// The ownership of a PLC; `None`: another member polls it.
    fn of(&self, plc: &str) -> Option<PlcOwnership> {
        match self {
            Self::All => Some(PlcOwnership { revision: 0, gate: Gate::always_open() }),
            Self::Owned(plcs) => plcs.get(plc).cloned(),
        }
    }
}

/// PLC and name of a tag in the poller.
#[derive(Clone, Debug)]
pub struct Place {
    /// The name of the PLC.
    pub plc: Arc<str>,
    /// The name of the tag.
    pub tag: Arc<str>,
    /// The place of the tag among those of its PLC, from 0; another after a reload.
    pub index: usize,
    /// In a fleet: the fencing token of the ownership; 0 without a fleet.
    pub revision: u64,
    /// In a fleet: the gate of the ownership. Samples that come behind it may be older than those of the next owner.
    pub gate: Gate,
}

/// All PLCs that are polled. Cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct Registry {
    plcs: Arc<RwLock<Plcs>>,
    /// Held while a configuration is applied.
    apply: Arc<Mutex<()>>,
    /// `true` while tags may be in the poller and not here.
    is_applying: Arc<AtomicBool>,
    /// `true` once the bridge gives its PLCs away: no configuration is applied any more.
    is_frozen: Arc<AtomicBool>,
}

/// The PLCs by name, and the places of their tags.
///
/// Invariant: `places` has the tags of `plcs`, and no others.
#[derive(Debug, Default)]
pub struct Plcs {
    plcs: BTreeMap<Arc<str>, PolledPlc>,
    places: HashMap<TagId, Place>,
    /// In a fleet: all other PLCs of the configuration.
    elsewhere: HashMap<Arc<str>, Elsewhere>,
    generation: u64,
}

/// A PLC whose tags cannot be polled.
#[derive(Debug, thiserror::Error)]
#[error("plc {plc}: {error}")]
pub struct AddError {
    plc: String,
    #[source]
    error: Box<dyn std::error::Error + Send + Sync>,
}

impl AddError {
    /// No PLC can be added, since the bridge is stopping.
    fn stopping() -> Self {
        Self { plc: "any".to_owned(), error: "the bridge is stopping".into() }
    }
}

/// The scan class of tags without one: each second.
pub fn default_class() -> ScanClass {
    ScanClass::every(Duration::from_secs(1))
}

impl Registry {
    /// Locks the PLCs. Not across an `await`.
    pub fn read(&self) -> RwLockReadGuard<'_, Plcs> {
        self.plcs.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns whether a batch is of an ownership before the present one, in a fleet. Its values are history.
    #[must_use]
    pub fn is_former(&self, batch: &Batch) -> bool {
        let is_other = |plc: &PolledPlc| plc.revision != batch.revision;
        batch.revision != 0 && self.read().get(&batch.plc).is_none_or(is_other)
    }

    /// Returns whether a configuration is being applied: the poller may have tags that are not here yet.
    #[must_use]
    pub fn is_applying(&self) -> bool {
        self.is_applying.load(Ordering::Acquire)
    }

    #[cfg(test)]
    pub(crate) fn set_applying(&self, applying: bool) {
        self.is_applying.store(applying, Ordering::Release);
    }

    #[cfg(test)]
    pub(crate) fn take_from(&self, other: &Self) {
        *self.plcs.write().unwrap() = std::mem::take(&mut *other.plcs.write().unwrap());
    }

    /// Polls the PLCs of a plant, and no others. Returns what was changed.
    ///
    /// # Errors
    /// [`AddError`] if a tag cannot be polled; then nothing was changed.
    pub fn apply(&self, plant: &Plant, pool: &Pool, poller: &PollerHandle) -> Result<Changes, AddError> {
        self.apply_share(plant, Share::All, pool, poller)
    }

    /// Polls a share of the PLCs of a plant, and no others. Returns what was changed.
    ///
    /// # Errors
    /// [`AddError`] if a tag cannot be polled; then nothing was changed.
    pub fn apply_share(
        &self,
        plant: &Plant,
        share: Share<'_>,
        pool: &Pool,
        poller: &PollerHandle,
    ) -> Result<Changes, AddError> {
        let _apply = self.apply.lock().unwrap_or_else(PoisonError::into_inner);
        if self.is_frozen.load(Ordering::Acquire) {
            return Err(AddError::stopping());
        }
        let _applying = Applying::new(&self.is_applying);
        let staged = self.stage(plant, plant.plcs(), share, pool, poller)?;
        let mut plcs = self.plcs.write().unwrap_or_else(PoisonError::into_inner);
        let gone: Vec<Arc<str>> = plcs.plcs.keys().filter(|name| !staged.has(name)).cloned().collect();
        let mut changes = staged.commit(&mut plcs);
        gone.iter().for_each(|name| plcs.remove(name, &mut changes));
        let others = plant.plcs().filter(|plc| !plcs.plcs.contains_key(plc.name()));
        let known = |name: &str| plcs.elsewhere.get(name).copied().unwrap_or(Elsewhere::Member);
        plcs.elsewhere = others.map(|plc| (plc.name().into(), known(plc.name()))).collect();
        Ok(changes)
    }

    /// Refuses all further configurations and shares. Waits for one that is being applied: that blocks.
    pub fn freeze(&self) {
        let _apply = self.apply.lock().unwrap_or_else(PoisonError::into_inner);
        self.is_frozen.store(true, Ordering::Release);
    }

    /// Polls PLCs of a plant that this member of a fleet has got, besides those that it polls.
    ///
    /// # Errors
    /// [`AddError`] if a tag cannot be polled; then nothing was changed.
    pub fn take(
        &self,
        plant: &Plant,
        owned: &HashMap<Arc<str>, PlcOwnership>,
        pool: &Pool,
        poller: &PollerHandle,
    ) -> Result<(), AddError> {
        let _apply = self.apply.lock().unwrap_or_else(PoisonError::into_inner);
        let _applying = Applying::new(&self.is_applying);
        let new = owned.keys().filter_map(|name| plant.plc(name));
        let staged = self.stage(plant, new, Share::Owned(owned), pool, poller)?;
        staged.commit(&mut self.plcs.write().unwrap_or_else(PoisonError::into_inner));
        Ok(())
    }

    /// Ends polling of PLCs that this member of a fleet has lost.
    pub fn give_up<'n>(&self, plcs: impl IntoIterator<Item = (&'n Arc<str>, Elsewhere)>) {
        let _apply = self.apply.lock().unwrap_or_else(PoisonError::into_inner);
        let mut registry = self.plcs.write().unwrap_or_else(PoisonError::into_inner);
        for (name, elsewhere) in plcs {
            if registry.plcs.contains_key(name) {
                registry.remove(name, &mut Changes::default());
                registry.elsewhere.insert(name.clone(), elsewhere);
            }
        }
        registry.generation = registry.generation.saturating_add(1);
    }

    /// No member is left: all PLCs that this bridge does not poll are without one.
    pub fn lose_all(&self) {
        let mut registry = self.plcs.write().unwrap_or_else(PoisonError::into_inner);
        registry.elsewhere.values_mut().for_each(|elsewhere| *elsewhere = Elsewhere::Lost);
    }

    /// Forgets of those PLCs that they were lost which another member has.
    pub fn settle(&self, has_member: impl Fn(&str) -> bool) {
        let mut registry = self.plcs.write().unwrap_or_else(PoisonError::into_inner);
        let lost = registry.elsewhere.iter_mut().filter(|(name, _)| has_member(name));
        lost.for_each(|(_, elsewhere)| *elsewhere = Elsewhere::Member);
    }

    /// Adds tags of PLCs to the poller.
    fn stage<'p>(
        &self,
        plant: &Plant,
        plcs: impl Iterator<Item = &'p PlantPlc>,
        share: Share<'_>,
        pool: &Pool,
        poller: &PollerHandle,
    ) -> Result<Staged, AddError> {
        let mut staged = Staged::default();
        for plc in plcs {
            let Some(ownership) = share.of(plc.name()) else { continue };
            let old = self.read().get(plc.name()).cloned();
            if let Err(error) = staged.add(plant, plc, ownership, old.as_ref(), pool, poller) {
                staged.undo();
                return Err(AddError { plc: plc.name().to_owned(), error });
            }
        }
        Ok(staged)
    }
}

/// Sets a flag while it lives, also in a panic.
struct Applying<'a>(&'a AtomicBool);

impl<'a> Applying<'a> {
    fn new(flag: &'a AtomicBool) -> Self {
        flag.store(true, Ordering::Release);
        Self(flag)
    }
}

impl Drop for Applying<'_> {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

impl Plcs {
    /// The PLCs in the order of their names.
    pub fn iter(&self) -> impl Iterator<Item = &PolledPlc> {
        self.plcs.values()
    }

    /// Counts the configurations that were applied: PLCs and tags are the same as long as it is.
    #[must_use]
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// The PLC of this name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&PolledPlc> {
        self.plcs.get(name)
    }

    /// In a fleet: what is known of a PLC that this bridge does not poll; `None`: it polls it, or the configuration
    /// does not have it.
    #[must_use]
    pub fn elsewhere(&self, name: &str) -> Option<Elsewhere> {
        self.elsewhere.get(name).copied()
    }

    /// Ends polling of a PLC, and counts what is removed.
    fn remove(&mut self, name: &str, changes: &mut Changes) {
        let Some(old) = self.plcs.remove(name) else { return };
        old.polled.stop();
        old.ids.iter().for_each(|id| drop(self.places.remove(id)));
        changes.plcs_removed = changes.plcs_removed.saturating_add(1);
        changes.tags_removed = changes.tags_removed.saturating_add(old.ids.len());
    }

    /// The PLCs that this bridge has lost, and no member is known to have got.
    pub fn lost(&self) -> impl Iterator<Item = &Arc<str>> {
        self.elsewhere.iter().filter(|(_, elsewhere)| **elsewhere == Elsewhere::Lost).map(|(name, _)| name)
    }

    /// The place of a tag.
    #[must_use]
    pub fn place(&self, id: TagId) -> Option<&Place> {
        self.places.get(&id)
    }
}

#[cfg(test)]
mod tests;
