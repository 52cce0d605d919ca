//! The poller: tags of many stations, read again and again, and what was read as a stream of samples.
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
//! let sample = poller.next().await.expect("it has not been closed")?;
//! match sample.value() {
//!     Some(value) => println!("{} is {value} ({})", sample.name, sample.quality),
//!     None => println!("{} is not known: {}", sample.name, sample.quality),
//! }
//! # Ok(()) });
//! ```
//!
//! # What it does
//!
//! - Each station has a task of its own. Tags of one [`ScanClass`] are read together, by a [`Plan`](crate::plan::Plan),
//!   once a period, at a random time of it unless the class says which. A request at a time is on its way to a station;
//!   calls of others go first ([`CallOptions::background`](crate::CallOptions::background)).
//! - When a cycle is due and the one before is not over, it is skipped and counted ([`Counters::overruns`]).
//! - The values of a cycle of several requests are given out together, when a check (4E) has confirmed that no reply among
//!   them was a duplicate out of order. If one was, they are dropped and read again, as often as reads are retried; then the
//!   cycle is abandoned with [`Error::Duplicates`](crate::Error::Duplicates).
//! - A sample has values, the time of the reply they came in, and a [`Quality`]. What fails is never a zero: a value is
//!   *stale*, the last one that was read, or *bad*, and then it is not there. The quality changes with time, too, when
//!   no answer comes.
//! - A sample is given after each reading, or by change, as the [`PollTag`] says. A consumer who is too slow loses the
//!   oldest samples, and is told so ([`Missed`]); the poller never waits for it.
//! - A request that the PLC refuses is taken apart, until the tags at fault are found. These are bad, and are tried again
//!   now and then ([`ScanClass::probe_refused`]); the others go on. A request that is refused though its halves are not is
//!   not sent again: its gap is not read through any more, or its length is a limit from then on.
//! - How long the PLC takes to answer is measured, and the plans change with it.
//!
//! Values of one sample come from one scan of the PLC only as far as a plan promises it: each value does; tags that were
//! added with [`PolledStation::add_one_scan`] do together.

mod batch;
mod class;
mod cycle;
mod device;
mod driver;
mod error;
mod known;
mod lesson;
mod plans;
mod point;
mod points;
mod queue;
mod sample;
mod stats;
mod trip;
mod work;

use std::fmt;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::task::{Context, Poll};

use futures::Stream;
use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio::time::Instant;
use tokio_util::task::TaskTracker;

pub use self::class::{PollTag, ScanClass};
pub use self::error::PollError;
pub use self::queue::Missed;
pub use self::sample::{Quality, Reason, Sample, Stamp, TagId};
pub use self::stats::{ClassStats, Counters, PollerStats};

use self::device::Device;
use self::known::Polled;
use self::plans::Plans;
use self::queue::Queue;
use crate::plan::{CostModel, Limits};
use crate::random::Random;
use crate::station::Station;

/// Reads tags again and again: a [`Stream`] of [`Sample`]s, or of [`Missed`] where some were dropped. See
/// [the module](self).
///
/// It ends, with `None`, when it has been closed and all samples are taken. Dropping it closes it.
#[derive(Debug)]
pub struct Poller {
    handle: PollerHandle,
}

/// A handle of a [`Poller`], to add stations to it and to look at it. Cheap to clone.
#[derive(Clone)]
pub struct PollerHandle {
    shared: Arc<Shared>,
}

/// The tags of one station in a [`Poller`]. Cheap to clone; dropping it changes nothing: the tags are polled until they
/// are removed.
#[derive(Clone)]
pub struct PolledStation {
    shared: Arc<Shared>,
    unit: Arc<Unit>,
}

/// What a [`Poller`] is made from: see [`Poller::builder`].
#[derive(Clone, Copy, Debug)]
#[must_use]
pub struct PollerBuilder {
    capacity: usize,
    seed: Option<u64>,
}

/// How a station is polled: what it takes, and what requests cost.
#[derive(Clone, Debug, Default)]
#[must_use]
#[non_exhaustive]
pub struct StationPolling {
    /// `None`: the protocol's own.
    limits: Option<Arc<Limits>>,
    cost: Option<CostModel>,
}

#[derive(Debug)]
struct Shared {
    queue: Queue,
    tasks: TaskTracker,
    next_id: AtomicU64,
    random: Mutex<Random>,
    epoch: Instant,
    plans: Arc<Plans>,
    /// The protocol's own.
    limits: Arc<Limits>,
    units: Mutex<Units>,
}

#[derive(Debug, Default)]
struct Units {
    closed: bool,
    now: Vec<Weak<Unit>>,
    /// What those did that are no more.
    before: Counters,
}

/// A station, as its task and its handles see it.
#[derive(Debug)]
struct Unit {
    station: Station,
    /// `None` once it has been stopped.
    device: Mutex<Option<Device>>,
    changed: Notify,
}

impl PollerBuilder {
    /// How many samples wait for the consumer at most. Default: 65,536.
    pub fn capacity(self, samples: usize) -> Self {
        Self { capacity: samples, ..self }
    }

    /// Where the random phases come from, so that a test can be repeated. Default: another one each time.
    pub fn seed(self, seed: u64) -> Self {
        Self { seed: Some(seed), ..self }
    }

    /// Makes the poller.
    #[must_use]
    pub fn build(self) -> Poller {
        let shared = Shared {
            queue: Queue::new(self.capacity),
            tasks: TaskTracker::new(),
            next_id: AtomicU64::new(1),
            random: Mutex::new(Random::new(self.seed.unwrap_or_else(Random::seed))),
            epoch: Instant::now(),
            plans: Arc::default(),
            limits: Arc::default(),
            units: Mutex::default(),
        };
        Poller { handle: PollerHandle { shared: Arc::new(shared) } }
    }
}

impl StationPolling {
    /// The defaults: the protocol's limits, and the cost of what the link says of its line.
    pub fn new() -> Self {
        Self::default()
    }

    /// What the PLC takes.
    pub fn limits(self, limits: Limits) -> Self {
        Self { limits: Some(Arc::new(limits)), ..self }
    }

    /// What requests cost. The latency in it is that of the beginning, until it has been measured.
    pub fn cost(self, cost: CostModel) -> Self {
        Self { cost: Some(cost), ..self }
    }
}

impl Poller {
    /// A poller with the default settings.
    #[must_use]
    pub fn new() -> Self {
        Self::builder().build()
    }

    /// A poller with settings.
    pub fn builder() -> PollerBuilder {
        PollerBuilder { capacity: 65_536, seed: None }
    }

    /// A handle, for other tasks than the one that takes the samples.
    #[must_use]
    pub fn handle(&self) -> PollerHandle {
        self.handle.clone()
    }

    /// As [`PollerHandle::station`].
    ///
    /// # Errors
    /// [`PollError::Closed`], [`PollError::NoRuntime`].
    pub fn station(&self, station: &Station) -> Result<PolledStation, PollError> {
        self.handle.station(station)
    }

    /// As [`PollerHandle::close`].
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
    /// Polls tags of this station. Each call makes another set of tags, with a task of its own.
    ///
    /// The options of the station hold for the requests, but all of them give way to other calls.
    ///
    /// # Errors
    /// [`PollError::Closed`]; [`PollError::NoRuntime`] outside of a Tokio runtime.
    pub fn station(&self, station: &Station) -> Result<PolledStation, PollError> {
        self.station_with(station, StationPolling::new())
    }

    /// Polls tags of this station, which takes only this, or whose requests cost that.
    ///
    /// # Errors
    /// [`PollError::Closed`]; [`PollError::NoRuntime`] outside of a Tokio runtime.
    pub fn station_with(&self, station: &Station, polling: StationPolling) -> Result<PolledStation, PollError> {
        let runtime = Handle::try_current().map_err(|_| PollError::NoRuntime)?;
        let shared = &self.shared;
        let StationPolling { limits, cost } = polling;
        let limits = limits.unwrap_or_else(|| shared.limits.clone());
        let cost = cost.unwrap_or_else(|| CostModel::of_link(station.link()));
        let seed = lock(&shared.random).next();
        let polled = Polled { station: station.number(), retries: station.options().retries };
        let device = Device::new(polled, (limits, cost), shared.epoch, seed, shared.plans.clone());
        let unit = Arc::new(Unit {
            station: station.with_options(station.options().background(true)),
            device: Mutex::new(Some(device)),
            changed: Notify::new(),
        });
        {
            // With the lock that `close` takes, so that no unit is forgotten by it.
            let mut units = lock(&shared.units);
            if units.closed {
                return Err(PollError::Closed);
            }
            if units.now.len() == units.now.capacity() {
                units.now.retain(|unit| unit.strong_count() > 0);
            }
            units.now.push(Arc::downgrade(&unit));
            shared.tasks.spawn_on(driver::run(shared.clone(), unit.clone()), &runtime);
        }
        Ok(PolledStation { shared: shared.clone(), unit })
    }

    /// What is known of all tags now: the newest sample of each, whether it was given or not.
    #[must_use]
    pub fn snapshot(&self) -> Vec<Sample> {
        let mut samples = Vec::new();
        for unit in self.shared.units() {
            samples.extend(self.shared.snapshot(&unit));
        }
        samples
    }

    /// The sum of all there is now. It asks every station, so call it every second rather than for every sample.
    #[must_use]
    pub fn stats(&self) -> PollerStats {
        let units = lock(&self.shared.units);
        let mut stats = PollerStats { counters: units.before, ..PollerStats::default() };
        for unit in units.now.iter().filter_map(Weak::upgrade) {
            unit.with(|device| stats.count(device.classes(), &device.counters()));
        }
        drop(units);
        let (samples, missed) = self.shared.queue.totals();
        PollerStats { samples, missed, ..stats }
    }

    /// Stops polling, and returns when all that was on its way has been given up. The samples that there are can still be
    /// taken.
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
    /// Reads these tags once a period from now on. The result has the id of each, in their order.
    ///
    /// All tags of one class are read together, whenever they were added.
    ///
    /// # Errors
    /// Nothing is added then: [`PollError::Period`], [`PollError::Deadband`]; [`PollError::Plan`] when the station's limits
    /// say that a tag cannot be read; [`PollError::Closed`].
    pub fn add(&self, class: ScanClass, tags: impl IntoIterator<Item = PollTag>) -> Result<Vec<TagId>, PollError> {
        self.add_tags(class, tags, false)
    }

    /// As [`add`](Self::add), for tags that must come from one scan of the PLC: they are read in one request.
    ///
    /// If the PLC refuses one of them, all of them are bad.
    ///
    /// # Errors
    /// As [`add`](Self::add); [`PollError::Plan`] when they are more than one request holds, [`PollError::NoTags`] without
    /// any.
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
        let added = self.unit.with(|device| device.add(class, tags, one_scan, Stamp::now()));
        added.unwrap_or(Err(PollError::Closed))?;
        self.unit.changed.notify_one();
        Ok(ids)
    }

    /// Reads a tag no more; says whether it was there. No sample of it is made after this, but some that were may still
    /// wait to be taken.
    ///
    /// Of tags that must come from one scan, the others stay.
    pub fn remove(&self, id: TagId) -> bool {
        let removed = self.unit.with(|device| device.remove(id, Instant::now())).unwrap_or(false);
        self.unit.changed.notify_one();
        removed
    }

    /// Reads nothing more of this station, for all its handles.
    pub fn stop(&self) {
        self.shared.end(&self.unit);
    }

    /// What is known of a tag now: its newest sample, whether it was given or not. `None`: it is not polled.
    #[must_use]
    pub fn latest(&self, id: TagId) -> Option<Sample> {
        self.unit.with(|device| self.shared.give(|samples| device.sample(id, Stamp::now(), samples))).flatten()
    }

    /// What is known of all its tags now.
    #[must_use]
    pub fn snapshot(&self) -> Vec<Sample> {
        self.shared.snapshot(&self.unit)
    }

    /// What its classes do.
    #[must_use]
    pub fn classes(&self) -> Vec<ClassStats> {
        self.unit.with(|device| device.classes().collect()).unwrap_or_default()
    }
}

impl fmt::Debug for PolledStation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PolledStation({} classes)", self.classes().len())
    }
}

impl Shared {
    fn close(&self) {
        let units = {
            let mut units = lock(&self.units);
            units.closed = true;
            std::mem::take(&mut units.now)
        };
        units.iter().filter_map(Weak::upgrade).for_each(|unit| self.end(&unit));
        self.tasks.close();
        self.queue.close();
    }

    /// Ends the polling of a station. What it has done is not forgotten.
    fn end(&self, unit: &Unit) {
        // Whoever adds up what all have done finds it in one of the two places.
        let mut units = lock(&self.units);
        if let Some(device) = lock(&unit.device).take() {
            units.before.add(&device.counters());
            unit.changed.notify_one();
        }
    }

    /// Does something that may make samples, and gives them away. To be called under the lock of their device, as the
    /// removal of tags is, so that nothing of a tag comes after it.
    fn give<T>(&self, make: impl FnOnce(&mut Vec<Sample>) -> T) -> T {
        let mut samples = Vec::new();
        let made = make(&mut samples);
        self.queue.push(samples);
        made
    }

    fn snapshot(&self, unit: &Unit) -> Vec<Sample> {
        let snapshot = unit.with(|device| self.give(|samples| device.snapshot(Stamp::now(), samples)));
        snapshot.unwrap_or_default()
    }

    fn units(&self) -> Vec<Arc<Unit>> {
        lock(&self.units).now.iter().filter_map(Weak::upgrade).collect()
    }
}

impl Unit {
    /// `None`: it has been stopped.
    fn with<T>(&self, act: impl FnOnce(&mut Device) -> T) -> Option<T> {
        lock(&self.device).as_mut().map(act)
    }
}

/// What is done under these locks leaves what they guard whole.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
