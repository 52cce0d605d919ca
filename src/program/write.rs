use std::fmt;

use super::options::WriteOptions;
use super::read::check_framing;
use super::write_state::{WriteReport, WriteState};
use super::writing::{WriteGoal, Writing};
use super::{Program, ProgramAction, ProgramError, WriteProgramError};
use crate::progress::Progress;
use crate::station::Station;
use crate::transfer::Driver;

/// The writing of a program, which can be repeated until it succeeds.
///
/// Each [run](Self::run) compares all pages first, so pages that an earlier run has written are not
/// written again. Unlike a new `WriteProgram` it remembers that the PLC ran before it was stopped.
/// Until a run succeeds, it continues with the station of its first run only, by number and endpoint.
#[must_use]
pub struct WriteProgram {
    writing: Writing,
    driver: Driver,
}

impl WriteProgram {
    /// Prepares writing this program.
    pub fn new(program: &Program, options: WriteOptions) -> Self {
        Self { writing: Writing::new(program.clone(), options), driver: Driver::default() }
    }

    /// Sets a callback, called after each page that was read or written. The PLC waits while it runs.
    pub fn on_progress(mut self, callback: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.driver.on_progress(callback);
        self
    }

    /// Returns the pages that differ, and changes nothing.
    ///
    /// # Errors
    /// As for [`run`](Self::run), but a running PLC or a memory card is no error.
    pub async fn compare(&mut self, station: &Station) -> Result<Vec<u16>, WriteProgramError> {
        self.drive(station, WriteGoal::Compare).await?;
        Ok(self.state().unwritten)
    }

    /// Returns the pages that [`run`](Self::run) would write with these options, and changes nothing.
    ///
    /// # Errors
    /// Those of [`run`](Self::run) that occur before anything is changed.
    pub async fn dry_run(&mut self, station: &Station) -> Result<Vec<u16>, WriteProgramError> {
        self.drive(station, WriteGoal::DryRun).await?;
        Ok(self.state().unwritten)
    }

    /// Writes the program, as the [module's documentation](super#writing) says.
    ///
    /// The future can be dropped at any time. The PLC is then as after a failure: if it was stopped,
    /// it stays stopped; see [`state`](Self::state).
    ///
    /// # Errors
    /// [`WriteProgramError`]: the reason, the pages that are written and those that are not, and the
    /// state of the PLC. Its [`source`](WriteProgramError::source) is
    /// - [`OtherStation`](super::ProgramError::OtherStation) before anything is sent;
    /// - [`SizeMisfit`](super::ProgramError::SizeMisfit), [`KindMisfit`](super::ProgramError::KindMisfit),
    ///   [`OtherPlc`](super::ProgramError::OtherPlc), [`MemoryCard`](super::ProgramError::MemoryCard) and
    ///   [`Running`](super::ProgramError::Running) before anything is changed;
    /// - [`Call`](super::ProgramError::Call) if a request fails: run it again when the PLC is back;
    /// - [`StillRunning`](super::ProgramError::StillRunning), [`NotTaken`](super::ProgramError::NotTaken),
    ///   [`SetRunning`](super::ProgramError::SetRunning) and [`Differs`](super::ProgramError::Differs)
    ///   if the PLC does not obey, or another client interferes;
    /// - [`RunRefused`](super::ProgramError::RunRefused) and [`NotRunning`](super::ProgramError::NotRunning)
    ///   if the program is written, and the PLC does not run it.
    pub async fn run(&mut self, station: &Station) -> Result<WriteReport, WriteProgramError> {
        self.drive(station, WriteGoal::Write).await?;
        Ok(self.writing.report())
    }

    /// How far the last run has come, even if its future was dropped.
    #[must_use]
    pub fn state(&self) -> WriteState {
        self.writing.state()
    }

    async fn drive(&mut self, station: &Station, goal: WriteGoal) -> Result<(), WriteProgramError> {
        let admitted = self.driver.admit(station, self.writing.is_bound());
        admitted.map_err(|other| self.failed(other.into()))?;
        let framing = check_framing(station);
        framing.map_err(|source| self.failed(ProgramError::Call { action: ProgramAction::ReadStatus, source }))?;
        self.writing.begin(goal);
        let driven = self.driver.run(&mut self.writing, station).await;
        driven.map_err(|source| self.failed(source))
    }

    fn failed(&self, source: ProgramError) -> WriteProgramError {
        WriteProgramError { source: Box::new(source), state: Box::new(self.state()) }
    }
}

impl fmt::Debug for WriteProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WriteProgram")
            .field("program", self.writing.program())
            .field("options", self.writing.options())
            .finish_non_exhaustive()
    }
}
