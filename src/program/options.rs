use std::time::Duration;

/// Options for writing a program.
///
/// By default a running PLC and the program of another PLC are refused, only pages that differ are
/// written, each written page is read back, and the PLC stays stopped.
///
/// ```
/// use std::time::Duration;
/// use fatek::program::WriteOptions;
///
/// let options = WriteOptions::new().stop_first(true).page_timeout(Duration::from_secs(5));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
#[must_use]
pub struct WriteOptions {
    pub(super) stop_first: bool,
    pub(super) run_again: bool,
    pub(super) all_pages: bool,
    pub(super) verify_all: bool,
    pub(super) accept_other_plc: bool,
    pub(super) attempts: u32,
    pub(super) page_timeout: Option<Duration>,
}

impl WriteOptions {
    /// The defaults.
    pub fn new() -> Self {
        Self {
            stop_first: false,
            run_again: false,
            all_pages: false,
            verify_all: false,
            accept_other_plc: false,
            attempts: 3,
            page_timeout: None,
        }
    }

    /// Sets whether a running PLC is stopped if a page is to be written; its status confirms that.
    /// Default: `false`, a running PLC is [`ProgramError::Running`](super::ProgramError::Running)
    /// before anything is written.
    pub fn stop_first(self, stop: bool) -> Self {
        Self { stop_first: stop, ..self }
    }

    /// Sets whether the PLC is started when all pages are written, if it ran before; its status
    /// confirms that. Default: `false`.
    pub fn run_again(self, run: bool) -> Self {
        Self { run_again: run, ..self }
    }

    /// Sets whether all pages are written, not only those that differ. Default: `false`. The first
    /// run reads no page before it is written. Further runs of the same
    /// [`WriteProgram`](super::WriteProgram) compare all pages and do not repeat those that an
    /// earlier run has written.
    pub fn all_pages(self, all: bool) -> Self {
        Self { all_pages: all, ..self }
    }

    /// Sets whether all pages are read and compared at the end, also those that were not written.
    /// Default: `false`.
    pub fn verify_all(self, verify: bool) -> Self {
        Self { verify_all: verify, ..self }
    }

    /// Sets whether the program of another PLC is written: one with another model or version of the
    /// operating system than the file states. Default: `false`, that is
    /// [`ProgramError::OtherPlc`](super::ProgramError::OtherPlc) before anything is changed.
    /// [`WriteState::other_plc`](super::WriteState::other_plc) has the differences in either case.
    pub fn accept_other_plc(self, accept: bool) -> Self {
        Self { accept_other_plc: accept, ..self }
    }

    /// How often a page is written at most, if its write has no reply or it reads back differently.
    /// Default: 3; at least 1.
    pub fn attempts(self, attempts: u32) -> Self {
        Self { attempts: attempts.max(1), ..self }
    }

    /// Response timeout of the write of a page. Default: that of the station. A PLC that keeps its
    /// program in flash memory may need more.
    pub fn page_timeout(self, timeout: Duration) -> Self {
        Self { page_timeout: Some(timeout), ..self }
    }
}

impl Default for WriteOptions {
    fn default() -> Self {
        Self::new()
    }
}
