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
}

/// PLC and name of a tag in the poller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The name of the PLC.
    pub plc: Arc<str>,
    /// The name of the tag.
    pub tag: Arc<str>,
    /// The place of the tag among those of its PLC, from 0; another after a reload.
    pub index: usize,
}

/// All PLCs that are polled. Cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct Registry {
    plcs: Arc<RwLock<Plcs>>,
    /// Held while a configuration is applied.
    apply: Arc<Mutex<()>>,
    /// `true` while tags may be in the poller and not here.
    is_applying: Arc<AtomicBool>,
}

/// The PLCs by name, and the places of their tags.
///
/// Invariant: `places` has the tags of `plcs`, and no others.
#[derive(Debug, Default)]
pub struct Plcs {
    plcs: BTreeMap<Arc<str>, PolledPlc>,
    places: HashMap<TagId, Place>,
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

/// The scan class of tags without one: each second.
pub fn default_class() -> ScanClass {
    ScanClass::every(Duration::from_secs(1))
}

impl Registry {
    /// Locks the PLCs. Not across an `await`.
    pub fn read(&self) -> RwLockReadGuard<'_, Plcs> {
        self.plcs.read().unwrap_or_else(PoisonError::into_inner)
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
        let _apply = self.apply.lock().unwrap_or_else(PoisonError::into_inner);
        let _applying = Applying::new(&self.is_applying);
        let mut staged = Staged::default();
        for plc in plant.plcs() {
            let old = self.read().get(plc.name()).cloned();
            if let Err(error) = staged.add(plant, plc, old.as_ref(), pool, poller) {
                staged.undo();
                return Err(AddError { plc: plc.name().to_owned(), error });
            }
        }
        let mut plcs = self.plcs.write().unwrap_or_else(PoisonError::into_inner);
        Ok(staged.commit(&mut plcs))
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

    /// The place of a tag.
    #[must_use]
    pub fn place(&self, id: TagId) -> Option<&Place> {
        self.places.get(&id)
    }
}

#[cfg(test)]
mod tests;
