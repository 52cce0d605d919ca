//! The capabilities of the stations of a link, shared by its handles.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use tokio::time::Instant;

use super::by_station::ByStation;
use crate::capabilities::{Capabilities, KnownCapabilities};

#[derive(Debug, Default)]
pub(super) struct SharedCapabilities {
    /// Boxed: of most stations nothing is known.
    known: Mutex<ByStation<Box<KnownCapabilities>>>,
    /// `true` once something is known of any station, so that other links need no lock.
    has_any: AtomicBool,
}

impl SharedCapabilities {
    pub(super) fn has_any(&self) -> bool {
        self.has_any.load(Ordering::Acquire)
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
        if !self.has_any() {
            return Capabilities::new();
        }
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.get(station).map_or_else(Capabilities::new, |known| read(known))
    }

    pub(super) fn with(&self, station: u8, work: impl FnOnce(&mut KnownCapabilities)) {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.with(station, Box::default, |known| work(known));
        self.has_any.store(true, Ordering::Release);
    }
}
