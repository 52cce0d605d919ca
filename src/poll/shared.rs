//! State shared by the handles of a poller and the tasks of its stations.

use std::collections::HashMap;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use tokio::sync::Notify;
use tokio_util::task::TaskTracker;

use super::plan_cache::PlanCache;
use super::queue::SampleQueue;
use super::schedule::{LineSchedule, PollerSchedule};
use super::station_poller::StationPoller;
use super::{Counters, Sample, Stamp};
use crate::link::Link;
use crate::plan::Limits;
use crate::random::Random;
use crate::station::Station;

#[derive(Debug)]
pub(super) struct PollerShared {
    pub(super) queue: SampleQueue,
    pub(super) tasks: TaskTracker,
    pub(super) next_id: AtomicU64,
    pub(super) random: Mutex<Random>,
    pub(super) schedule: Arc<PollerSchedule>,
    pub(super) plan_cache: Arc<PlanCache>,
    /// The limits of the protocol.
    pub(super) limits: Arc<Limits>,
    /// Locked before the lock of a station.
    pub(super) stations: Mutex<StationRegistry>,
}

#[derive(Debug, Default)]
pub(super) struct StationRegistry {
    pub(super) closed: bool,
    pub(super) active: Vec<Weak<StationShared>>,
    /// The schedules of the lines of these stations, by the [identity](crate::Link::identity) of the link.
    lines: HashMap<usize, Weak<LineSchedule>>,
    /// Counters of the stations that are not polled any more.
    pub(super) retired: Counters,
}

/// A polled station, shared by its task and its handles.
#[derive(Debug)]
pub(super) struct StationShared {
    pub(super) handle: Station,
    /// `None` once polling has been stopped.
    pub(super) poller: Mutex<Option<StationPoller>>,
    /// Wakes the task: tags were added or removed, or polling was stopped.
    pub(super) changed: Notify,
}

impl StationRegistry {
    /// Returns the schedule of the line of a link.
    pub(super) fn line(&mut self, link: &Link, poller: &Arc<PollerSchedule>) -> Arc<LineSchedule> {
        // A station keeps its link and this schedule, so another link has this identity only after both.
        if let Some(line) = self.lines.get(&link.identity()).and_then(Weak::upgrade) {
            return line;
        }
        if self.lines.len() == self.lines.capacity() {
            self.lines.retain(|_, line| line.strong_count() > 0);
        }
        let line = Arc::new(LineSchedule::new(poller.clone()));
        self.lines.insert(link.identity(), Arc::downgrade(&line));
        line
    }
}

impl PollerShared {
    pub(super) fn close(&self) {
        let stations = {
            let mut stations = lock(&self.stations);
            stations.closed = true;
            std::mem::take(&mut stations.active)
        };
        stations.iter().filter_map(Weak::upgrade).for_each(|station| self.stop(&station));
        self.tasks.close();
        self.queue.close();
    }

    /// Closes the poller if none of its stations is polled any more: their runtime has ended, and its
    /// stream must end, too.
    pub(super) fn close_if_nothing_is_polled(&self) {
        if self.active_stations().iter().all(|station| lock(&station.poller).is_none()) {
            self.close();
        }
    }

    /// Stops polling a station and keeps its counters.
    pub(super) fn stop(&self, station: &StationShared) {
        // Under the registry's lock, so that statistics count the station exactly once.
        let mut stations = lock(&self.stations);
        if let Some(poller) = lock(&station.poller).take() {
            stations.retired.add(&poller.counters());
            station.changed.notify_one();
        }
    }

    /// Runs `make` and queues the samples it makes.
    ///
    /// Call it under the lock of the station's poller. Tags are removed under the same lock, so no
    /// sample of a tag is queued after its removal.
    pub(super) fn queue_samples<T>(&self, make: impl FnOnce(&mut Vec<Sample>) -> T) -> T {
        let mut samples = Vec::new();
        let made = make(&mut samples);
        self.queue.push(samples);
        made
    }

    pub(super) fn snapshot(&self, station: &StationShared) -> Vec<Sample> {
        let snapshot = station.with(|poller| self.queue_samples(|samples| poller.snapshot(Stamp::now(), samples)));
        snapshot.unwrap_or_default()
    }

    pub(super) fn active_stations(&self) -> Vec<Arc<StationShared>> {
        lock(&self.stations).active.iter().filter_map(Weak::upgrade).collect()
    }
}

impl StationShared {
    /// Runs `act` on the poller; `None` if polling has been stopped.
    pub(super) fn with<T>(&self, act: impl FnOnce(&mut StationPoller) -> T) -> Option<T> {
        lock(&self.poller).as_mut().map(act)
    }
}

/// Locks a mutex, poisoned or not: no code under these locks leaves its data inconsistent.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
