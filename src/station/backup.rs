use super::Station;
use crate::backup::{Backup, BackupError, Restore, RestoreError, RestoreOptions, RestoreReport, TakeBackup};
use crate::tag::Tag;

/// Ranges of registers and discretes.
impl Station {
    /// Reads ranges of elements (44, 46), to be saved, compared or written back.
    ///
    /// Elements that the PLC refuses to read are [missing](crate::backup::Missing) in the backup.
    /// To see the progress, or to resume after a failure, use [`TakeBackup`].
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let backup = station.back_up(["R0-R299".parse()?, "M0-M1911".parse()?]).await?;
    /// assert_eq!(backup.value_count(), 2212);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// [`BackupError::Invalid`] if the ranges cannot be a backup; nothing is sent.
    /// [`BackupError::Call`], with all that was read, if a request fails.
    pub async fn back_up(&self, ranges: impl IntoIterator<Item = Tag>) -> Result<Backup, BackupError> {
        TakeBackup::new(ranges)?.run(self).await
    }

    /// Writes those elements of a backup that differ from the PLC (45, 47), reads all back and
    /// compares.
    ///
    /// To see the progress, to compare only, or to resume after a failure, use [`Restore`].
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::backup::RestoreOptions;
    ///
    /// let backup = station.back_up(["D0-D99".parse()?]).await?;
    /// let report = station.restore(&backup, RestoreOptions::new().stop_first(true).run_again(true)).await?;
    /// assert!(report.written.is_empty()); // it holds all that
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [`Restore::run`].
    pub async fn restore(&self, backup: &Backup, options: RestoreOptions) -> Result<RestoreReport, RestoreError> {
        Restore::new(backup, options).run(self).await
    }
}
