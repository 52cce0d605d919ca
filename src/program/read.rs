use std::fmt;
use std::time::SystemTime;

use super::reading::Reading;
use super::{Program, ProgramAction, ProgramError};
use crate::command::{Command, ReadProgramPage};
use crate::error::Error;
use crate::progress::Progress;
use crate::station::Station;
use crate::transfer::Driver;

/// The reading of a program, which can be interrupted and continued.
///
/// The [module's documentation](super#reading) has an example. Pages that have been read are kept
/// when a run fails or its future is dropped. The next run continues with the same station only, by
/// number and endpoint.
#[derive(Default)]
#[must_use]
pub struct ReadProgram {
    reading: Reading,
    driver: Driver,
}

impl ReadProgram {
    /// Prepares reading.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets whether all pages are read a second time and compared: a page that changed meanwhile is
    /// [`ProgramError::Changed`]. Default: `false`.
    pub fn twice(mut self, twice: bool) -> Self {
        self.reading.twice = twice;
        self
    }

    /// Sets a callback, called after each page. The PLC waits while it runs.
    pub fn on_progress(mut self, callback: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.driver.on_progress(callback);
        self
    }

    /// How many pages have been read and confirmed. They are kept when a run fails or its future is
    /// dropped; up to 64 pages that were read after the last check are not.
    #[must_use]
    pub fn pages_done(&self) -> usize {
        self.reading.pages_done()
    }

    /// Reads the pages that are missing and returns the program.
    ///
    /// Each request is a read of its own, with the timeouts and retries of the station's
    /// [options](Station::options); [`CallOptions::with_background`](crate::CallOptions::with_background)
    /// gives all other calls of the link precedence. A check (4E) after every 64 pages and at the
    /// end confirms that no reply was an out-of-order duplicate. If one was, the pages since the last
    /// check are read again, as often as reads are retried. The future can be dropped at any time.
    ///
    /// # Errors
    /// - [`ProgramError::Call`] if a request fails: run it again to continue;
    /// - [`ProgramError::OtherStation`] if pages have been read from another one; nothing is sent;
    /// - [`ProgramError::Invalid`] if page 0 is no header, or states another size than 53;
    /// - [`ProgramError::Changed`] if the program changed meanwhile. Nothing is kept then.
    pub async fn run(&mut self, station: &Station) -> Result<Program, ProgramError> {
        let framing = check_framing(station);
        framing.map_err(|source| ProgramError::Call { action: ProgramAction::ReadPage(0), source })?;
        self.driver.admit(station, self.pages_done() > 0)?;
        self.reading.begin();
        self.driver.run(&mut self.reading, station).await?;
        self.reading.finish(SystemTime::now())
    }
}

/// Programs exist in the ASCII framing only.
///
/// # Errors
/// [`Error::Invalid`] in the binary framing; nothing was sent.
pub(super) fn check_framing(station: &Station) -> Result<(), Error> {
    Ok(ReadProgramPage::new(0).check(station.link().framing())?)
}

impl fmt::Debug for ReadProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ReadProgram").field("pages_done", &self.pages_done()).finish_non_exhaustive()
    }
}
