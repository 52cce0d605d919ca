//! The PLCs that are polled, with their tags: shared by the collector, the page and the reload.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;

use fatek::plant::{Plant, PlantPlc};
use fatek::poll::{PolledStation, PollerHandle, ScanClass, TagId};
use fatek::{Pool, Station};

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
}

/// PLC and name of a tag in the poller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The name of the PLC.
    pub plc: Arc<str>,
    /// The name of the tag.
    pub tag: Arc<str>,
}

/// All PLCs that are polled. Cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct Registry(Arc<RwLock<Plcs>>);

/// The PLCs by name, and the places of their tags.
///
/// Invariant: `places` has the tags of `plcs`, and no others.
#[derive(Debug, Default)]
pub struct Plcs {
    plcs: BTreeMap<Arc<str>, PolledPlc>,
    places: HashMap<TagId, Place>,
}

/// A PLC whose tags cannot be polled.
#[derive(Debug, thiserror::Error)]
#[error("{plc}: {error}")]
pub struct AddError {
    plc: String,
    #[source]
    error: Box<dyn std::error::Error + Send + Sync>,
}

/// The scan class of tags without one.
pub fn default_class() -> ScanClass {
    ScanClass::every(Duration::from_secs(1))
}

impl Registry {
    /// Locks the PLCs for reading. Not across an `await`.
    pub fn read(&self) -> RwLockReadGuard<'_, Plcs> {
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Locks the PLCs for a change. Not across an `await`.
    pub fn write(&self) -> RwLockWriteGuard<'_, Plcs> {
        self.0.write().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Plcs {
    /// The PLCs in the order of their names.
    pub fn iter(&self) -> impl Iterator<Item = &PolledPlc> {
        self.plcs.values()
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

    /// Adds a PLC with all of its tags to the poller, in place of one of the same name.
    ///
    /// # Errors
    /// [`AddError`] if a tag cannot be polled; then nothing is polled for it.
    pub fn add(&mut self, plant: &Plant, plc: &PlantPlc, pool: &Pool, poller: &PollerHandle) -> Result<(), AddError> {
        let failed = |error: Box<dyn std::error::Error + Send + Sync>| AddError { plc: plc.name().to_owned(), error };
        let station = pool.station(plc.endpoint().clone(), plc.station()).map_err(|error| failed(Box::new(error)))?;
        let polled = poller.station(&station).map_err(|error| failed(Box::new(error)))?;
        let mut ids = Vec::new();
        for tag in plc.tags() {
            let class = tag.class().and_then(|name| plant.class(name));
            let class = class.map_or_else(default_class, fatek::plant::PlantClass::scan_class);
            match polled.add(class, [tag.poll_tag()]) {
                Ok(added) => ids.extend(added),
                Err(error) => {
                    polled.stop();
                    return Err(failed(Box::new(error)));
                }
            }
        }
        self.remove(plc.name());
        let name: Arc<str> = plc.name().into();
        let place = |tag: &fatek::plant::PlantTag| Place { plc: name.clone(), tag: tag.name().into() };
        self.places.extend(ids.iter().copied().zip(plc.tags().map(place)));
        self.plcs.insert(name, PolledPlc { plc: plc.clone(), station, polled, ids });
        Ok(())
    }

    /// Stops polling a PLC and returns whether it was polled.
    pub fn remove(&mut self, name: &str) -> bool {
        let Some(removed) = self.plcs.remove(name) else { return false };
        removed.polled.stop();
        removed.ids.iter().for_each(|id| {
            self.places.remove(id);
        });
        true
    }
}
