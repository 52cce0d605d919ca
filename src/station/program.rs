use super::Station;
use crate::program::{Program, ProgramError, ReadProgram, WriteOptions, WriteProgram, WriteProgramError, WriteReport};

/// Whole programs.
impl Station {
    /// 4F: reads the whole program. ASCII framing only.
    ///
    /// To see how far it has come, or to go on after a failure, use [`ReadProgram`].
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let program = station.read_program().await?;
    /// assert_eq!(program.pages().len(), 207);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for [`ReadProgram::run`].
    pub async fn read_program(&self) -> Result<Program, ProgramError> {
        ReadProgram::new().run(self).await
    }

    /// 50: writes those pages of the program that differ from the PLC's, reads them back and compares. ASCII framing only.
    ///
    /// A PLC that runs is refused, unless the [options](WriteOptions) say otherwise. To see how far it has come, use
    /// [`WriteProgram`].
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::program::WriteOptions;
    ///
    /// let program = station.read_program().await?;
    /// let report = station.write_program(&program, WriteOptions::new()).await?;
    /// assert!(report.written.is_empty()); // it holds this program
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for [`WriteProgram::run`].
    pub async fn write_program(
        &self,
        program: &Program,
        options: WriteOptions,
    ) -> Result<WriteReport, WriteProgramError> {
        WriteProgram::new(program, options).run(self).await
    }
}
