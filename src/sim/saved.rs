//! Simulated PLCs of saved files: a backup as memory, and a program.

use super::{Error, Model, Plc};
use crate::backup::{Backup, Missing};
use crate::program::Program;

impl Model {
    /// A PLC like the one of a backup: with its statuses, the elements of the default model, and all others of
    /// the backup that were not refused.
    ///
    /// A [`Plc`] of it takes the backup, and is not another PLC for [`Restore`](crate::backup::Restore) if it
    /// has the same station number.
    ///
    /// ```
    /// use fatek::backup::TakeBackup;
    /// use fatek::register;
    /// use fatek::sim::{self, Model, Plc};
    ///
    /// # #[tokio::main(flavor = "current_thread")]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let bench = sim::station().await;
    /// bench.plc.write(register!("R7"), 5_u16)?;
    /// let backup = TakeBackup::new(["R0-R99".parse()?])?.run(&bench.station).await?;
    ///
    /// let copy = Plc::with_model(Model::of_backup(&backup));
    /// copy.write_backup(&backup)?;
    /// assert_eq!(copy.read(register!("R7")), 5_u16.into());
    /// # Ok(())
    /// # }
    /// ```
    #[must_use]
    pub fn of_backup(backup: &Backup) -> Self {
        let model = Self::default().statuses(backup.brief_status().as_ref(), backup.status());
        let existing = backup.elements().filter(|(_, value)| !matches!(value, Err(Missing::Refused(_))));
        existing.fold(model, |model, (element, _)| model.including(element))
    }

    /// Sets the size of the ladder to that of a program, and its last page to that of the program's memory.
    #[must_use]
    pub fn for_program(self, program: &Program) -> Self {
        let model = self.ladder_words(program.ladder_words());
        match program.refused_page() {
            Some(page) => model.real_last_page(page.saturating_sub(1)),
            None => model,
        }
    }
}

impl Plc {
    /// Writes the values of a backup as the process, those of inputs and contacts included. Missing elements
    /// stay as they are.
    ///
    /// # Errors
    /// [`Error::BeyondModel`] for a value that the model has no element for; nothing is written then. A PLC
    /// of [`Model::of_backup`] has all of them.
    pub fn write_backup(&self, backup: &Backup) -> Result<(), Error> {
        let values = || backup.elements().filter_map(|(element, value)| Some((element, value.ok()?)));
        if let Some((element, _)) = values().find(|&(element, _)| !self.has(element)) {
            return Err(Error::BeyondModel { element });
        }
        values().try_for_each(|(element, value)| self.write(element, value))
    }

    /// Sets all pages of a program.
    ///
    /// # Errors
    /// [`Error::BeyondProgram`] if the program memory has fewer pages; nothing is set then. That of
    /// [`Model::for_program`] has as many.
    pub fn set_program(&self, program: &Program) -> Result<(), Error> {
        let numbered = || (0_u16..).zip(program.pages());
        let last = self.pages().saturating_sub(1);
        if let Some((page, _)) = numbered().find(|&(page, _)| page > last) {
            return Err(Error::BeyondProgram { page, last });
        }
        numbered().try_for_each(|(page, content)| self.set_page(page, content.clone()))
    }
}

#[cfg(test)]
mod tests;
