//! Writing a backup to a PLC.

use std::fmt;

use super::options::RestoreOptions;
use super::restoring::{RestoreGoal, Restoring};
use super::take::{check_in, read_statuses};
use super::{Backup, RestoreError, RestoreFailure, RestoreReport};
use crate::progress::Progress;
use crate::station::Station;
use crate::transfer::Driver;

/// The restoring of a backup, which can be repeated until it succeeds.
///
/// Each [run](Self::run) compares all elements first, so elements that an earlier run has written are
/// not written again. Unlike a new `Restore` it remembers, until a run succeeds, that the PLC ran
/// before it was stopped. If it was stopped, further runs continue with the same station only, by
/// number and endpoint.
#[must_use]
pub struct Restore {
    restoring: Restoring,
    driver: Driver,
}

impl Restore {
    /// Prepares restoring this backup.
    pub fn new(backup: &Backup, options: RestoreOptions) -> Self {
        Self { restoring: Restoring::new(backup, options), driver: Driver::default() }
    }

    /// Sets a callback, called after each request that read or wrote elements. The PLC waits while it
    /// runs.
    pub fn on_progress(mut self, callback: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.driver.on_progress(callback);
        self
    }

    /// Compares all elements and changes nothing. Another PLC than that of the backup is no error here:
    /// [`RestoreReport::other_plc`] has the differences. Inputs and contacts are compared, too. With
    /// [`stop_first`](RestoreOptions::stop_first) it reports whether the PLC runs;
    /// [`require_stopped`](RestoreOptions::require_stopped) refuses a running one here, too.
    ///
    /// # Errors
    /// As for [`run`](Self::run), as far as that reads.
    pub async fn compare(&mut self, station: &Station) -> Result<RestoreReport, RestoreError> {
        self.drive(station, RestoreGoal::Compare).await
    }

    /// Restores the backup, as the [module's documentation](super#restoring) says.
    ///
    /// The future can be dropped at any time. Elements that were written stay written, and a PLC that
    /// was stopped stays stopped; see [`report`](Self::report).
    ///
    /// # Errors
    /// [`RestoreError`]: the reason, the elements that are written and those that are not, and the
    /// state of the PLC. Its [`source`](RestoreError::source) is
    /// - [`OtherStation`](RestoreFailure::OtherStation) and [`Special`](RestoreFailure::Special) before
    ///   anything is sent;
    /// - [`OtherPlc`](RestoreFailure::OtherPlc), [`Running`](RestoreFailure::Running) and
    ///   [`NotThere`](RestoreFailure::NotThere) before anything is written;
    /// - [`Call`](RestoreFailure::Call) if a request fails: run it again when the PLC is back;
    /// - [`Differs`](RestoreFailure::Differs) if elements were written and not all hold their value;
    /// - [`SetRunning`](RestoreFailure::SetRunning) if another client started a PLC that had to be
    ///   stopped;
    /// - [`StillRunning`](RestoreFailure::StillRunning) and [`NotRunning`](RestoreFailure::NotRunning) if
    ///   the PLC does not obey.
    pub async fn run(&mut self, station: &Station) -> Result<RestoreReport, RestoreError> {
        self.drive(station, RestoreGoal::Restore).await
    }

    /// How far the last run has come, even if its future was dropped.
    #[must_use]
    pub fn report(&self) -> RestoreReport {
        self.restoring.report()
    }

    async fn drive(&mut self, station: &Station, goal: RestoreGoal) -> Result<RestoreReport, RestoreError> {
        let admitted = self.driver.admit(station, self.restoring.is_bound());
        admitted.map_err(|other| self.failed(other.into()))?;
        check_in(self.restoring.ranges(), station).map_err(|source| {
            self.failed(RestoreFailure::Call { doing: "checking the addresses".to_owned(), source })
        })?;
        if let Some(range) = self.restoring.refused_special().filter(|_| goal == RestoreGoal::Restore) {
            return Err(self.failed(RestoreFailure::Special { range }));
        }
        self.restoring.begin(goal, station.request_lengths());
        self.check_origin(station, goal).await.map_err(|source| self.failed(source))?;
        let driven = self.driver.run(&mut self.restoring, station).await;
        driven.map(|()| self.report()).map_err(|source| self.failed(source))
    }

    /// Compares the PLC with the one that was read, as far as the backup states it.
    async fn check_origin(&mut self, station: &Station, goal: RestoreGoal) -> Result<(), RestoreFailure> {
        if self.restoring.has_origin() {
            let plc = read_statuses(station).await;
            let plc = plc.map_err(|source| RestoreFailure::Call { doing: "reading the status".to_owned(), source })?;
            self.restoring.compare_origin(station.number(), &plc);
        }
        if goal == RestoreGoal::Restore && !self.restoring.accepts_plc() {
            return Err(RestoreFailure::OtherPlc);
        }
        Ok(())
    }

    fn failed(&self, source: RestoreFailure) -> RestoreError {
        RestoreError { source, report: Box::new(self.report()) }
    }
}

impl fmt::Debug for Restore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Restore").field("restoring", &self.restoring).finish_non_exhaustive()
    }
}
