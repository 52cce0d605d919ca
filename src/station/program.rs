use super::Station;
use crate::program::{Program, ProgramError, ReadProgram, WriteOptions, WriteProgram, WriteProgramError, WriteReport};

/// Whole programs.
impl Station {
    /// Reads the whole program (4F). ASCII framing only.
    ///
    /// To see the progress, or to resume after a failure, use [`ReadProgram`].
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let program = station.read_program().await?;
    /// assert_eq!(program.pages().len(), 207);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [`ReadProgram::run`].
    pub async fn read_program(&self) -> Result<Program, ProgramError> {
        ReadProgram::new().run(self).await
    }

    /// Writes those pages of the program that differ from the PLC's (50), reads them back and
    /// compares. ASCII framing only.
    ///
    /// It is an error if the PLC is in RUN, unless the [options](WriteOptions) stop it. To see the
    /// progress, use [`WriteProgram`].
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
    /// Those of [`WriteProgram::run`].
    pub async fn write_program(
        &self,
        program: &Program,
        options: WriteOptions,
    ) -> Result<WriteReport, WriteProgramError> {
        WriteProgram::new(program, options).run(self).await
    }
}
