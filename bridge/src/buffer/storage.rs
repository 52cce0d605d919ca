//! The thread that does the log's work on disk. Nothing else touches the file.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::{Notify, watch};

use super::disk::{Disk, DiskError};
use super::jobs::Job;
use super::log::Log;
use crate::batch::milliseconds;

/// The time between two looks for work that is not urgent.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// The time for the last commits.
pub(super) const CLOSE_WITHIN: Duration = Duration::from_secs(20);
/// The commits that may fail at the end.
const CLOSE_FAILURES: u32 = 5;

/// The log, shared by the poller, the outputs and the storage thread.
#[derive(Debug)]
pub(super) struct Shared {
    state: Mutex<State>,
    /// Wakes the outputs.
    pub(super) changed: Notify,
    /// An output needs the present values.
    pub(super) present: Notify,
    /// Wakes the storage thread.
    work: Condvar,
    /// The start, and the buffer's time then.
    started: (Instant, u64),
}

#[derive(Debug)]
pub(super) struct State {
    pub(super) log: Log,
    /// The storage thread waits.
    is_idle: bool,
    is_closing: bool,
}

impl Shared {
    /// `time`: the buffer's time now.
    pub(super) fn new(log: Log, time: u64) -> Self {
        Self {
            state: Mutex::new(State { log, is_idle: false, is_closing: false }),
            changed: Notify::new(),
            present: Notify::new(),
            work: Condvar::new(),
            started: (Instant::now(), time),
        }
    }

    /// Locks the state, poisoned or not: no code under this lock leaves it inconsistent.
    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The buffer's time in milliseconds: it does not follow the clock.
    pub(super) fn now(&self) -> u64 {
        let (started, time) = self.started;
        time.saturating_add(u64::try_from(started.elapsed().as_millis()).unwrap_or(u64::MAX))
    }

    /// Wakes the storage thread if it waits and there is work.
    pub(super) fn wake_storage(&self, state: &mut State) {
        if state.is_idle && (state.is_closing || state.log.is_urgent()) {
            state.is_idle = false;
            self.work.notify_one();
        }
    }

    /// Makes the storage thread write all and end.
    pub(super) fn start_closing(&self) {
        let mut state = self.lock();
        state.is_closing = true;
        self.wake_storage(&mut state);
    }
}

/// Starts the storage thread. The receiver is told when it has ended.
pub(super) fn start(shared: Arc<Shared>, disk: Disk) -> std::io::Result<watch::Receiver<bool>> {
    spawn(move || Storage { shared, disk }.run())
}

/// Starts a thread. The receiver is told when it has ended; after a panic it loses its sender.
pub(super) fn spawn(work: impl FnOnce() + Send + 'static) -> std::io::Result<watch::Receiver<bool>> {
    let (ended, receiver) = watch::channel(false);
    std::thread::Builder::new().name("buffer".to_owned()).spawn(move || {
        work();
        ended.send_replace(true);
    })?;
    Ok(receiver)
}

struct Storage {
    shared: Arc<Shared>,
    disk: Disk,
}

impl Storage {
    fn run(mut self) {
        while let Some(job) = self.next_job() {
            self.execute(&job);
            self.shared.changed.notify_waiters();
        }
        self.close();
    }

    /// Waits for a job. `None`: the log is to be closed.
    fn next_job(&self) -> Option<Job> {
        let mut state = self.shared.lock();
        loop {
            if state.is_closing {
                return None;
            }
            if let Some(job) = state.log.plan(self.shared.now(), false) {
                return Some(job);
            }
            state.is_idle = true;
            let waited = self.shared.work.wait_timeout(state, LOOK_EVERY);
            state = waited.map_or_else(|poisoned| poisoned.into_inner().0, |(state, _)| state);
            state.is_idle = false;
        }
    }

    /// Writes all that is left, for a limited time.
    fn close(mut self) {
        let until = Instant::now() + CLOSE_WITHIN;
        let mut failures = 0;
        while let Some(job) = self.plan_last() {
            if !self.execute(&job) {
                failures += 1;
                std::thread::sleep(LOOK_EVERY);
            }
            if failures >= CLOSE_FAILURES || Instant::now() >= until {
                let batches = self.shared.lock().log.unspilled_count();
                tracing::error!(batches, "the disk did not take these batches in time");
                break;
            }
            self.shared.changed.notify_waiters();
        }
        self.disk.close();
        self.shared.changed.notify_waiters();
    }

    fn plan_last(&self) -> Option<Job> {
        self.shared.lock().log.plan(self.shared.now(), true)
    }

    /// Does a job and reports how it ended. Returns whether it was done.
    fn execute(&mut self, job: &Job) -> bool {
        match self.try_job(job) {
            Ok(()) => true,
            Err(DiskError::Damaged(why)) => {
                self.replace(&why);
                false
            }
            Err(error @ (DiskError::Io(_) | DiskError::InUse)) => {
                self.fail(&error);
                false
            }
        }
    }

    fn try_job(&mut self, job: &Job) -> Result<(), DiskError> {
        match job {
            Job::Commit(commit) => {
                let file_len = self.disk.commit(commit, milliseconds(SystemTime::now()))?;
                let mut state = self.shared.lock();
                let failed_before = state.log.failure().is_some();
                state.log.committed(commit, self.shared.now(), file_len);
                if failed_before && state.log.failure().is_none() {
                    tracing::info!("the buffer is on disk again");
                }
            }
            Job::Load(load) => {
                let read = self.disk.load(load)?;
                self.shared.lock().log.loaded(load, read);
            }
            Job::Compact => {
                let file_len = self.disk.compact()?;
                self.shared.lock().log.compacted(file_len);
            }
        }
        Ok(())
    }

    /// Notes an error of the system. redb takes nothing after one until the file is opened anew.
    fn fail(&mut self, error: &DiskError) {
        self.disk.close();
        let mut state = self.shared.lock();
        let failed_before = state.log.failure().is_some();
        state.log.failed(error.to_string(), self.shared.now());
        drop(state);
        if !failed_before {
            let path = self.disk.path().display();
            tracing::error!(%error, "the buffer cannot use {path}: it goes on in memory and tries again");
        }
    }

    /// Begins a new file in place of a damaged one.
    fn replace(&mut self, why: &str) {
        let path = self.disk.path().to_owned();
        match self.disk.move_aside() {
            Ok(place) => {
                let mut state = self.shared.lock();
                state.log.file_lost(self.shared.now());
                drop(state);
                tracing::error!("the buffer {} was damaged ({why}): it is now {}", path.display(), place.display());
            }
            Err(error) => self.fail(&DiskError::Io(format!("damaged ({why}), and cannot be moved aside: {error}"))),
        }
    }
}
