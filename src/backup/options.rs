/// Options for restoring a backup.
///
/// By default a running PLC keeps running, only elements that differ are written, forced discretes
/// stay as they are, and the backup of another PLC or one with special elements is refused.
///
/// ```
/// use fatek::backup::RestoreOptions;
///
/// let options = RestoreOptions::new().stop_first(true).run_again(true);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
#[must_use]
pub struct RestoreOptions {
    pub(super) if_running: IfRunning,
    pub(super) run_again: bool,
    pub(super) write_forced: bool,
    pub(super) accept_other_plc: bool,
    pub(super) bridge: usize,
    pub(super) attempts: u32,
    pub(super) special: SpecialElements,
}

/// Treatment of special elements of a backup: R3840 to R4167 and M1912 to M2001, as
/// [`special_range`](crate::memory_map::special_range) has them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum SpecialElements {
    /// A backup with special elements is not restored:
    /// [`RestoreFailure::Special`](super::RestoreFailure::Special) before anything is sent.
    #[default]
    Refuse,
    /// They are neither compared nor written, and all others are restored.
    /// [`RestoreReport::special`](super::RestoreReport::special) names them.
    Skip,
    /// They are restored as all others.
    Write,
}

/// Treatment of a PLC that runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum IfRunning {
    Continue,
    Refuse,
    Stop,
}

impl RestoreOptions {
    /// The defaults.
    pub fn new() -> Self {
        Self {
            if_running: IfRunning::Continue,
            run_again: false,
            write_forced: false,
            accept_other_plc: false,
            bridge: 0,
            attempts: 3,
            special: SpecialElements::Refuse,
        }
    }

    /// Sets whether a running PLC is stopped if something is to be written; its status confirms
    /// that. All elements are compared again when it has stopped. Default: `false`, a running
    /// program may overwrite restored elements. Replaces [`require_stopped`](Self::require_stopped).
    ///
    /// If another client starts the PLC meanwhile, that is
    /// [`RestoreFailure::SetRunning`](super::RestoreFailure::SetRunning). The status is read just before
    /// the first write and at the end: a PLC that was started and stopped in between is not noticed.
    pub fn stop_first(self, stop: bool) -> Self {
        self.choose(IfRunning::Stop, stop)
    }

    /// Sets whether a running PLC is refused with
    /// [`RestoreFailure::Running`](super::RestoreFailure::Running) before anything is written, and
    /// one that is started later with
    /// [`RestoreFailure::SetRunning`](super::RestoreFailure::SetRunning). The status is read as with
    /// [`stop_first`](Self::stop_first), which this replaces. Default: `false`.
    pub fn require_stopped(self, require: bool) -> Self {
        self.choose(IfRunning::Refuse, require)
    }

    /// Chooses one treatment of a PLC that runs, or takes this choice back.
    fn choose(self, treatment: IfRunning, chosen: bool) -> Self {
        let if_running = match (chosen, self.if_running == treatment) {
            (true, _) => treatment,
            (false, true) => IfRunning::Continue,
            (false, false) => self.if_running,
        };
        Self { if_running, ..self }
    }

    /// With [`stop_first`](Self::stop_first): sets whether the PLC is started when all elements are
    /// restored, if it ran before; its status confirms that. Default: `false`.
    pub fn run_again(self, run: bool) -> Self {
        Self { run_again: run, ..self }
    }

    /// Sets whether disabled discretes are written, too: their forced state becomes that of the
    /// backup. Default: `false`.
    pub fn write_forced(self, write: bool) -> Self {
        Self { write_forced: write, ..self }
    }

    /// Sets whether the backup of another PLC is restored: one with another station number, model or
    /// version of the operating system than the backup states. Default: `false`, that is
    /// [`RestoreFailure::OtherPlc`](super::RestoreFailure::OtherPlc) before anything is written.
    /// [`RestoreReport::other_plc`](super::RestoreReport::other_plc) has the differences in either case.
    pub fn accept_other_plc(self, accept: bool) -> Self {
        Self { accept_other_plc: accept, ..self }
    }

    /// Writes up to this number of equal elements between two that differ, if both then fit into one
    /// request. Default: 0. A higher number saves requests, and overwrites changes that a running
    /// program makes to these elements meanwhile.
    pub fn bridge(self, elements: usize) -> Self {
        Self { bridge: elements, ..self }
    }

    /// Sets the treatment of special elements, R3840 to R4167 and M1912 to M2001. Default:
    /// [`SpecialElements::Refuse`]. Writing them can cause system or I/O errors.
    pub fn special(self, special: SpecialElements) -> Self {
        Self { special, ..self }
    }

    /// How often a write, STOP or RUN is sent at most, if there is no reply and a read shows no effect.
    /// Default: 3; at least 1.
    pub fn attempts(self, attempts: u32) -> Self {
        Self { attempts: attempts.max(1), ..self }
    }
}

impl Default for RestoreOptions {
    fn default() -> Self {
        Self::new()
    }
}
