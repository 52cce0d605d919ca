use super::Station;
use crate::backup::{Backup, BackupError, Restore, RestoreError, RestoreOptions, RestoreReport, TakeBackup};
use crate::tag::Tag;

/// Ranges of registers and discretes.
impl Station {
    /// 44, 46: reads what ranges of elements hold, to be saved, compared or written back. What the PLC refuses to give is
    /// [missing](crate::backup::Missing) in the backup.
    ///
    /// To see how far it has come, or to go on after a failure, use [`TakeBackup`].
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let backup = station.back_up(["R0-R299".parse()?, "M0-M1911".parse()?]).await?;
    /// assert_eq!(backup.value_count(), 2212);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// [`BackupError::Invalid`] when the ranges are none for a backup; nothing is sent. [`BackupError::Call`], with what has been
    /// read, when a request fails.
    pub async fn back_up(&self, ranges: impl IntoIterator<Item = Tag>) -> Result<Backup, BackupError> {
        TakeBackup::new(ranges)?.run(self).await
    }

    /// 45, 47: writes those elements of a backup that differ from what the PLC holds, reads all back and compares.
    ///
    /// To see how far it has come, to compare alone, or to go on after a failure, use [`Restore`].
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::backup::RestoreOptions;
    ///
    /// let backup = station.back_up(["D0-D99".parse()?]).await?;
    /// let report = station.restore(&backup, RestoreOptions::new().stop_first().run_again()).await?;
    /// assert!(report.written.is_empty()); // it holds all that
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for [`Restore::run`].
    pub async fn restore(&self, backup: &Backup, options: RestoreOptions) -> Result<RestoreReport, RestoreError> {
        Restore::new(backup, options).run(self).await
    }
}
