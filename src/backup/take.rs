//! Reading the elements of a backup.

use std::fmt;
use std::time::SystemTime;

use super::taking::Taking;
use super::{Backup, BackupError, InvalidBackup};
use crate::command::{DetailedStatus, InvalidRequest};
use crate::error::Error;
use crate::file::{Origin, whole_seconds};
use crate::progress::Progress;
use crate::station::Station;
use crate::tag::Tag;
use crate::transfer::Driver;

/// The reading of a backup, which can be interrupted and continued.
///
/// Values that have been read are kept when a run fails or its future is dropped. The next run
/// continues with the same station only.
///
/// ```
/// # fatek::sim::doctest(|station| async move {
/// use fatek::backup::TakeBackup;
///
/// let mut taking = TakeBackup::new(["R0-R3839".parse()?])?.on_progress(|progress| eprintln!("{progress}"));
/// let backup = loop {
///     match taking.run(&station).await {
///         Ok(backup) => break backup,
///         Err(error) if taking.partial().value_count() > 0 => eprintln!("{error}; continuing"),
///         Err(error) => return Err(error.into()),
///     }
/// };
/// # assert_eq!(backup.value_count(), 3840);
/// # Ok(()) });
/// ```
#[must_use]
pub struct TakeBackup {
    taking: Taking,
    driver: Driver,
}

impl TakeBackup {
    /// Prepares reading these ranges.
    ///
    /// # Errors
    /// As for [`Backup::of`].
    pub fn new(ranges: impl IntoIterator<Item = Tag>) -> Result<Self, InvalidBackup> {
        Ok(Self::resume(Backup::of(ranges)?))
    }

    /// Prepares reading the elements that are [`Missing::NotRead`](super::Missing::NotRead) in a
    /// backup, from the station of the others.
    pub fn resume(partial: Backup) -> Self {
        Self { taking: Taking::new(partial), driver: Driver::default() }
    }

    /// Sets a callback, called after each request; the steps are elements. The PLC waits while it
    /// runs.
    pub fn on_progress(mut self, callback: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.driver.on_progress(callback);
        self
    }

    /// The values that have been read and confirmed. All others are
    /// [`Missing::NotRead`](super::Missing::NotRead), among them up to 32 requests of a run that failed.
    #[must_use]
    pub fn partial(&self) -> &Backup {
        &self.taking.backup
    }

    /// Reads the elements that are not read, and returns the backup. Elements that the PLC refuses are
    /// missing in it, which is no failure.
    ///
    /// Each request is a read of its own, with the timeouts and retries of the station's
    /// [options](Station::options). A check (4E) after every 32 requests and at the end confirms that
    /// no reply was an out-of-order duplicate. If one was, the requests since the last check are
    /// repeated, as often as reads are retried. The future can be dropped at any time.
    ///
    /// # Errors
    /// - [`BackupError::Call`] if a request fails otherwise than by a refusal: no reply, no
    ///   connection. Run it again to continue. Also, before anything is sent, if the framing of the
    ///   link does not have all addresses.
    /// - [`BackupError::OtherStation`] if elements have been read from a station of another number.
    /// - [`BackupError::OtherPlc`] if they have been read from a PLC whose status (53) states another
    ///   main unit or number of I/O points.
    pub async fn run(&mut self, station: &Station) -> Result<Backup, BackupError> {
        check_in(self.partial().ranges(), station).map_err(|error| self.failed(error))?;
        match self.partial().station() {
            None => self.read_origin(station).await.map_err(|error| self.failed(error))?,
            Some(_) => self.check_origin(station).await?,
        }
        self.taking.begin(station.request_lengths());
        let driven = self.driver.run(&mut self.taking, station).await;
        driven.map(|()| self.partial().clone()).map_err(|error| self.failed(error))
    }

    async fn read_origin(&mut self, station: &Station) -> Result<(), Error> {
        let read_at = Some(whole_seconds(SystemTime::now()));
        let statuses = read_statuses(station).await?;
        self.taking.backup.station = Some(station.number());
        self.taking.backup.origin = Origin { read_at, ..statuses };
        Ok(())
    }

    /// Checks whether the PLC is the one that was read before, as far as that is known.
    async fn check_origin(&self, station: &Station) -> Result<(), BackupError> {
        let Backup { station: before, origin, .. } = self.partial();
        if let Some(backup) = before.filter(|&before| before != station.number()) {
            return Err(BackupError::OtherStation { backup, station: station.number() });
        }
        let Some(backup) = &origin.detailed else { return Ok(()) };
        let plc = unless_refused(station.read_detailed_status().await).map_err(|error| self.failed(error))?;
        let model = |status: &DetailedStatus| (status.main_unit(), status.io_points_code());
        match plc {
            Some(plc) if model(&plc) == model(backup) => Ok(()),
            plc => Err(BackupError::OtherPlc { backup: Box::new(backup.clone()), plc: plc.map(Box::new) }),
        }
    }

    fn failed(&self, source: Error) -> BackupError {
        BackupError::Call { partial: Box::new(self.partial().clone()), source }
    }
}

impl fmt::Debug for TakeBackup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TakeBackup").field("done", &self.taking.confirmed_elements()).finish_non_exhaustive()
    }
}

/// Checks that the framing of the link has the addresses of all ranges.
pub(super) fn check_in(mut ranges: impl Iterator<Item = Tag>, station: &Station) -> Result<(), Error> {
    let framing = station.link().framing();
    ranges.try_for_each(|range| range.check_in(framing)).map_err(|error| InvalidRequest::from(error).into())
}

/// Reads both statuses of a PLC, without the time.
pub(super) async fn read_statuses(station: &Station) -> Result<Origin, Error> {
    let brief = unless_refused(station.read_status().await)?;
    let detailed = unless_refused(station.read_detailed_status().await)?;
    Ok(Origin { read_at: None, brief, detailed })
}

/// `None` for a refusal: not every model has every status.
fn unless_refused<T>(reply: Result<T, Error>) -> Result<Option<T>, Error> {
    match reply {
        Ok(reply) => Ok(Some(reply)),
        Err(Error::Plc { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}
