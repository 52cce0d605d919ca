//! The poller: polls tags of many stations periodically and yields samples as a stream.
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use std::time::Duration;
//! use fatek::poll::{PollTag, Poller, ScanClass};
//! use futures::StreamExt;
//!
//! let mut poller = Poller::new();
//! let boiler = poller.station(&station)?;
//! let fast = ScanClass::every(Duration::from_millis(100));
//! boiler.add(fast, [PollTag::new("level", "R100:f32".parse()?).deadband(0.5)])?;
//! boiler.add(ScanClass::every(Duration::from_secs(10)), [PollTag::new("serial number", "R0-R9".parse()?)])?;
//!
//! let sample = poller.next().await.expect("the poller is open")?;
//! match sample.value() {
//!     Some(value) => println!("{} is {value} ({})", sample.name, sample.quality),
//!     None => println!("{} has no value: {}", sample.name, sample.quality),
//! }
//! # Ok(()) });
//! ```
//!
//! # Behaviour
//!
//! - **Scheduling.** Each station has a task of its own. A [`Plan`](crate::plan::Plan) reads all
//!   tags of one [`ScanClass`] together, once a period. The phase is random unless the class sets
//!   it. One request per station is in flight at a time, and calls of other users take precedence
//!   ([`CallOptions::with_background`](crate::CallOptions::with_background)).
//! - **First readings.** Tags of a class without a phase do not wait for the next due time: they are
//!   read 10 ms after they were added, or a second after the last cycle of their class began. First
//!   readings of different lines are spread, 5000 a second, and those of one line leave half of its
//!   time to other requests. A [`Pool`](crate::Pool) limits the connections a second. A first reading
//!   that fails is repeated, after pauses of 1 s that double up to the period.
//! - **Overruns.** A cycle that falls due while the previous one is running is skipped and counted
//!   in [`Counters::overruns`].
//! - **Confirmation.** The values of a cycle of several requests are reported together, after a
//!   check (4E) has confirmed that none of the replies was a duplicate out of order. If one was,
//!   the values are dropped and read again, up to the number of retries of a read. Then the cycle
//!   is abandoned with [`Error::Duplicates`](crate::Error::Duplicates).
//! - **Quality.** A sample has values, the time of their reply, and a [`Quality`]. A failure never
//!   yields a zero: the tag is *stale* and keeps its last values, or *bad* and has none. Quality
//!   also degrades with age while no reply comes.
//! - **Report by exception.** A sample is reported after each reading or on change, as set in
//!   [`PollTag`]. [`PolledStation::report_all`] reports all tags again.
//! - **Bounded queue.** If the consumer is too slow, the oldest samples are dropped and reported as
//!   [`Missed`]. The poller never waits for the consumer.
//! - **Refusals.** A request that the PLC refuses is halved until the refused tags are found. These
//!   are bad and are probed periodically ([`ScanClass::probe_refused`]); the other tags are polled
//!   as before. If a request is refused although both halves are accepted, the poller learns a
//!   limit: it no longer reads through that gap, or no longer sends requests of that length.
//! - **Adaptive plans.** The plans adapt to the measured response time of the PLC.
//!
//! The values of a sample come from one scan of the PLC only as far as its plan promises that: each
//! single value does, and so do tags added together with [`PolledStation::add_one_scan`].

mod builder;
mod class;
mod class_state;
mod compiled_plan;
mod context;
mod cycle;
mod driver;
mod error;
mod in_flight;
mod latency;
mod learned_limit;
mod plan_cache;
mod polled_struct;
mod queue;
mod sample;
mod schedule;
mod shared;
mod station_poller;
mod stats;
mod tag_map;
mod tag_state;

use std::fmt;
use std::pin::Pin;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, Weak};
use std::task::{Context, Poll};

use futures::Stream;
use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio::time::Instant;

pub use self::builder::{PollerBuilder, StationPolling};
pub use self::class::{PollTag, ScanClass};
pub use self::error::PollError;
pub use self::polled_struct::{NotCurrent, PolledStruct};
pub use self::queue::Missed;
pub use self::sample::{Quality, Reason, Sample, Stamp, TagId};
pub use self::stats::{ClassStats, Counters, PollerStats};

use self::context::StationParams;
use self::shared::{PollerShared, StationShared, lock};
use self::station_poller::StationPoller;
use crate::plan::CostModel;
use crate::station::Station;

/// A poller: a [`Stream`] of [`Sample`]s, with [`Missed`] in place of dropped ones.
///
/// The stream ends after [`close`](Self::close), when all queued samples have been taken. Dropping
/// the poller closes it. See [the module](self).
#[derive(Debug)]
pub struct Poller {
    handle: PollerHandle,
}

/// A handle of a [`Poller`]: adds stations, reads statistics, closes it. Cheap to clone.
#[derive(Clone)]
pub struct PollerHandle {
    shared: Arc<PollerShared>,
}

/// The tags of one station in a [`Poller`]. Cheap to clone.
///
/// Dropping it has no effect: the tags are polled until they are removed.
#[derive(Clone)]
pub struct PolledStation {
    shared: Arc<PollerShared>,
    station: Arc<StationShared>,
}

impl Poller {
    /// Makes a poller with the default settings.
    #[must_use]
    pub fn new() -> Self {
        Self::builder().build()
    }

    /// Returns a builder with the default settings.
    pub fn builder() -> PollerBuilder {
        PollerBuilder::new()
    }

    /// Returns a handle, for tasks other than the one that takes the samples.
    #[must_use]
    pub fn handle(&self) -> PollerHandle {
        self.handle.clone()
    }

    /// Adds a station: see [`PollerHandle::station`].
    ///
    /// # Errors
    /// [`PollError::Closed`], [`PollError::NoRuntime`].
    pub fn station(&self, station: &Station) -> Result<PolledStation, PollError> {
        self.handle.station(station)
    }

    /// Stops polling: see [`PollerHandle::close`].
    pub async fn close(&self) {
        self.handle.close().await;
    }
}

impl Default for Poller {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for Poller {
    fn drop(&mut self) {
        self.handle.shared.close();
        self.handle.shared.queue.clear();
    }
}

impl Stream for Poller {
    type Item = Result<Sample, Missed>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.handle.shared.queue.poll_next(cx)
    }
}

impl PollerHandle {
    /// Adds a station with the default settings. Each call makes a separate set of tags and a task.
    ///
    /// The station's call options apply to the requests, except that all of them run in the
    /// background lane.
    ///
    /// # Errors
    /// [`PollError::Closed`]; [`PollError::NoRuntime`] outside of a Tokio runtime.
    pub fn station(&self, station: &Station) -> Result<PolledStation, PollError> {
        self.station_with(station, StationPolling::new())
    }

    /// Adds a station with the given limits and costs: see [`station`](Self::station). The limits are
    /// lowered to the capabilities that are [declared](Station::set_capabilities) now.
    ///
    /// # Errors
    /// [`PollError::Closed`]; [`PollError::NoRuntime`] outside of a Tokio runtime.
    pub fn station_with(&self, station: &Station, polling: StationPolling) -> Result<PolledStation, PollError> {
        let runtime = Handle::try_current().map_err(|_| PollError::NoRuntime)?;
        let shared = &self.shared;
        let StationPolling { limits, cost } = polling;
        let limits = limits.unwrap_or_else(|| shared.limits.clone());
        let limits = match station.link().knows_capabilities() {
            true => Arc::new((*limits).clone().within(&station.declared_capabilities())),
            false => limits,
        };
        let cost = cost.unwrap_or_else(|| CostModel::of_station(station));
        let seed = lock(&shared.random).next();
        let params = StationParams { station: station.number(), retries: station.options().retries };
        let line = lock(&shared.stations).line(station.link(), &shared.schedule);
        let poller = StationPoller::new(params, (limits, cost), line, seed, shared.plan_cache.clone());
        let station = Arc::new(StationShared {
            handle: station.with_options(station.options().with_background(true)),
            poller: Mutex::new(Some(poller)),
            changed: Notify::new(),
        });
        {
            // The lock that `close` takes: a station is either refused here or stopped there.
            let mut stations = lock(&shared.stations);
            if stations.closed {
                return Err(PollError::Closed);
            }
            if stations.active.len() == stations.active.capacity() {
                stations.active.retain(|station| station.strong_count() > 0);
            }
            stations.active.push(Arc::downgrade(&station));
            shared.tasks.spawn_on(driver::run(shared.clone(), station.clone()), &runtime);
        }
        Ok(PolledStation { shared: shared.clone(), station })
    }

    /// Returns the current sample of each tag, including those that were not reported.
    #[must_use]
    pub fn snapshot(&self) -> Vec<Sample> {
        self.shared.active_stations().iter().flat_map(|station| self.shared.snapshot(station)).collect()
    }

    /// Returns the sum over all stations. Locks each of them: call it every second, not per sample.
    #[must_use]
    pub fn stats(&self) -> PollerStats {
        let stations = lock(&self.shared.stations);
        let mut stats = PollerStats { counters: stations.retired, ..PollerStats::default() };
        for station in stations.active.iter().filter_map(Weak::upgrade) {
            station.with(|poller| stats.count(poller.classes(), &poller.counters()));
        }
        drop(stations);
        let (samples, missed) = self.shared.queue.totals();
        PollerStats { samples, missed, ..stats }
    }

    /// Stops polling and waits for the tasks to end. Queued samples can still be taken.
    ///
    /// Cancel-safe: polling stops with the first poll of the future.
    pub async fn close(&self) {
        self.shared.close();
        self.shared.tasks.wait().await;
    }
}

impl fmt::Debug for PollerHandle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PollerHandle({} stations)", self.shared.tasks.len())
    }
}

impl PolledStation {
    /// Adds tags to a class and returns their ids, in the order of the tags.
    ///
    /// All tags of one class are read together, no matter when they were added.
    ///
    /// # Errors
    /// No tag is added on error. [`PollError::Period`], [`PollError::Deadband`];
    /// [`PollError::Plan`] if the station's limits exclude a tag; [`PollError::Closed`].
    pub fn add(&self, class: ScanClass, tags: impl IntoIterator<Item = PollTag>) -> Result<Vec<TagId>, PollError> {
        self.add_tags(class, tags, false)
    }

    /// Adds tags that must come from one scan of the PLC: one request reads all of them.
    ///
    /// If the PLC refuses one of them, all of them are bad. See also [`add`](Self::add).
    ///
    /// # Errors
    /// As [`add`](Self::add); [`PollError::Plan`] if they do not fit in one request;
    /// [`PollError::NoTags`] if there are none.
    pub fn add_one_scan(
        &self,
        class: ScanClass,
        tags: impl IntoIterator<Item = PollTag>,
    ) -> Result<Vec<TagId>, PollError> {
        self.add_tags(class, tags, true)
    }

    fn add_tags(
        &self,
        class: ScanClass,
        tags: impl IntoIterator<Item = PollTag>,
        one_scan: bool,
    ) -> Result<Vec<TagId>, PollError> {
        let id = |tag| (TagId(self.shared.next_id.fetch_add(1, Ordering::Relaxed)), tag);
        let tags: Vec<(TagId, PollTag)> = tags.into_iter().map(id).collect();
        let ids = tags.iter().map(|(id, _)| *id).collect();
        let added = self.station.with(|poller| poller.add(class, tags, one_scan, Stamp::now()));
        added.unwrap_or(Err(PollError::Closed))?;
        self.station.changed.notify_one();
        Ok(ids)
    }

    /// Removes a tag and returns whether it was polled.
    ///
    /// No sample of it is made after this call; queued ones may still be taken. Of tags that must
    /// come from one scan, the others stay.
    pub fn remove(&self, id: TagId) -> bool {
        let removed = self.station.with(|poller| poller.remove(id, Instant::now())).unwrap_or(false);
        self.station.changed.notify_one();
        removed
    }

    /// Stops polling this station, for all its handles.
    pub fn stop(&self) {
        self.shared.stop(&self.station);
    }

    /// Returns the current sample of a tag, reported or not; `None` if the tag is not polled.
    #[must_use]
    pub fn latest(&self, id: TagId) -> Option<Sample> {
        let latest =
            self.station.with(|poller| self.shared.queue_samples(|samples| poller.sample(id, Stamp::now(), samples)));
        latest.flatten()
    }

    /// Returns the current sample of each tag of the station, reported or not.
    #[must_use]
    pub fn snapshot(&self) -> Vec<Sample> {
        self.shared.snapshot(&self.station)
    }

    /// Queues the current sample of each tag that was read or has failed, reported or not, as if all of them
    /// had just changed. For a consumer whose users may have missed samples. Returns their number.
    ///
    /// Each has the time of its reply, or of its failure. They are queued in the order of these times, stale
    /// ones last, and in step with the samples of readings: for each tag, the samples keep their order. A
    /// heartbeat counts from here. Nothing is sent to the PLC.
    ///
    /// A full queue drops the oldest samples ([`Missed`]): call it for many stations in parts.
    pub fn report_all(&self) -> usize {
        let queued = self.station.with(|poller| {
            self.shared.queue_samples(|samples| {
                poller.report_all(Stamp::now(), samples);
                samples.len()
            })
        });
        queued.unwrap_or_default()
    }

    /// Returns the statistics of each class that has tags.
    #[must_use]
    pub fn classes(&self) -> Vec<ClassStats> {
        self.station.with(|poller| poller.classes().collect()).unwrap_or_default()
    }
}

impl fmt::Debug for PolledStation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PolledStation({} classes)", self.classes().len())
    }
}

#[cfg(test)]
mod tests;
