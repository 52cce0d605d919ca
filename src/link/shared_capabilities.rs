//! The capabilities of the stations of a link, shared by its handles.

use std::sync::{Mutex, OnceLock, PoisonError};

use tokio::time::Instant;

use super::by_station::ByStation;
use crate::capabilities::{Capabilities, KnownCapabilities};

#[derive(Debug, Default)]
pub(super) struct SharedCapabilities {
    /// Made once something is known of any station; on most links nothing is.
    known: OnceLock<Box<Mutex<ByStation<KnownCapabilities>>>>,
}

impl SharedCapabilities {
    pub(super) fn has_any(&self) -> bool {
        self.known.get().is_some()
    }

    /// The declared capabilities of a station, and those learned.
    pub(super) fn get(&self, station: u8) -> Capabilities {
        self.read(station, |known| known.get(Instant::now()))
    }

    /// The declared capabilities of a station.
    pub(super) fn declared(&self, station: u8) -> Capabilities {
        self.read(station, |known| known.declared().clone())
    }

    fn read(&self, station: u8, read: impl FnOnce(&KnownCapabilities) -> Capabilities) -> Capabilities {
        let Some(known) = self.known.get() else { return Capabilities::new() };
        let known = known.lock().unwrap_or_else(PoisonError::into_inner);
        known.get(station).map_or_else(Capabilities::new, read)
    }

    pub(super) fn with(&self, station: u8, work: impl FnOnce(&mut KnownCapabilities)) {
        let mut known = self.known.get_or_init(Box::default).lock().unwrap_or_else(PoisonError::into_inner);
        known.with(station, KnownCapabilities::default, work);
    }
}
