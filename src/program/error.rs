use std::fmt;

use super::header::ProgramKind;
use super::write_state::WriteState;
use crate::error::{Error, ErrorCode};
use crate::printable::excerpt;
use crate::transfer::{OtherStation, RunCause, RunCommand, RunFailure};

/// Error: pages are not a program.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidProgram {
    /// Page 0 is not a header.
    #[error("page 0: it begins with {:02X} {:02X}, where `FB` or `FM` was expected", found[0], found[1])]
    #[non_exhaustive]
    Mark {
        /// Its bytes 0 and 1.
        found: [u8; 2],
    },
    /// Page 0 is not a header.
    #[error("page 0: bytes 2 and 3 are {:02X} {:02X}, where two digits were expected", found[0], found[1])]
    #[non_exhaustive]
    Digits {
        /// Its bytes 2 and 3.
        found: [u8; 2],
    },
    /// The header does not fit the PLC that it was read from.
    #[error("page 0: the header states a ladder of {header} words, and the status (53) one of {status}")]
    #[non_exhaustive]
    Size {
        /// The size in page 0.
        header: u16,
        /// The size in 53.
        status: u16,
    },
    /// Pages are missing, or there are too many.
    #[error("{found} pages, where {expected} were expected: page 0 states a ladder of {ladder_words} words, 64 a page")]
    #[non_exhaustive]
    Pages {
        /// The number of pages.
        found: usize,
        /// The number that the header requires, itself included.
        expected: usize,
        /// The size in page 0.
        ladder_words: u16,
    },
    /// The bytes are not whole pages.
    #[error("{bytes} bytes are no whole pages: a page has 128")]
    #[non_exhaustive]
    Length {
        /// The number of bytes.
        bytes: usize,
    },
    /// There is no header.
    #[error("there is no page 0")]
    Empty,
}

/// A request of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ProgramAction {
    /// 40 or 53.
    ReadStatus,
    /// 4F.
    ReadPage(u16),
    /// 50.
    WritePage(u16),
    /// 41, stop.
    Stop,
    /// 41, run.
    Run,
    /// 4E: confirm that no reply was an out-of-order duplicate.
    Confirm,
}

impl fmt::Display for ProgramAction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ReadStatus => f.write_str("read the status"),
            Self::ReadPage(page) => write!(f, "read page {page}"),
            Self::WritePage(page) => write!(f, "write page {page}"),
            Self::Stop => f.write_str("stop the PLC"),
            Self::Run => f.write_str("run the PLC"),
            Self::Confirm => f.write_str("confirm what was read"),
        }
    }
}

/// Error: a program cannot be read or written.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum ProgramError {
    /// A request failed: no reply, no connection, a refusal.
    #[non_exhaustive]
    Call {
        /// The request.
        action: ProgramAction,
        /// Its error.
        source: Error,
    },
    /// The PLC does not hold a program.
    Invalid(InvalidProgram),
    /// The program changed while it was read, or between two runs. The pages are dropped; the next
    /// run starts from the beginning.
    #[non_exhaustive]
    Changed {
        /// The page that changed; `None` for the PLC's type, version or ladder size.
        page: Option<u16>,
    },
    /// An earlier run has read pages of another station, or has stopped or written it, and did not
    /// succeed. Nothing was sent, and a [`WriteState`] is that of the other station.
    #[non_exhaustive]
    OtherStation {
        /// The station of the earlier run, and its endpoint.
        begun: String,
        /// The station of this run, and its endpoint.
        station: String,
    },
    /// The program has another size than that of the PLC.
    #[non_exhaustive]
    SizeMisfit {
        /// Words of the program.
        program: u16,
        /// Words of the PLC.
        plc: u16,
    },
    /// The program is for another kind of PLC.
    #[non_exhaustive]
    KindMisfit {
        /// The kind of the program.
        program: ProgramKind,
        /// The kind of the program in the PLC.
        plc: ProgramKind,
    },
    /// The program lacks this page, which the PLC that it was read from refused, and this PLC has it.
    #[non_exhaustive]
    HasRefusedPage {
        /// The page.
        page: u16,
    },
    /// The PLC is not the one that the program was read from: see
    /// [`WriteState::other_plc`](super::WriteState::other_plc).
    OtherPlc,
    /// The PLC uses a ROM pack or memory card, and would refuse every page.
    MemoryCard,
    /// The PLC runs, and [`WriteOptions::stop_first`](super::WriteOptions::stop_first) was not chosen.
    Running,
    /// STOP was sent, and the PLC still runs.
    StillRunning,
    /// Another client started the PLC while its program was written.
    SetRunning,
    /// A page was written, and reads back differently.
    #[non_exhaustive]
    NotTaken {
        /// The page.
        page: u16,
    },
    /// Pages were equal to the program's and no longer are; they are in [`WriteState::unwritten`].
    #[non_exhaustive]
    Differs {
        /// The pages.
        pages: Vec<u16>,
    },
    /// The PLC refuses to run the program: it is faulty (5, 7), has another id (6), or needs a
    /// function that the PLC lacks (9).
    #[non_exhaustive]
    RunRefused {
        /// The reply of the PLC.
        error: ErrorCode,
    },
    /// RUN was sent, and the PLC does not run.
    NotRunning,
}

impl fmt::Display for ProgramError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Call { action, source } => write!(f, "cannot {action}: {source}"),
            Self::Invalid(invalid) => write!(f, "the PLC holds no program that this library knows: {invalid}"),
            Self::Changed { page: Some(page) } => {
                write!(f, "the program changed while it was read: page {page} is different now")
            }
            Self::Changed { page: None } => f.write_str(
                "the program changed while it was read: the PLC's type, version or ladder size is different now",
            ),
            Self::OtherStation { begun, station } => {
                write!(f, "this was begun with {}, and cannot continue with {}", excerpt(begun), excerpt(station))
            }
            Self::SizeMisfit { program, plc } => {
                write!(f, "the program has a ladder of {program} words, and the PLC one of {plc}")
            }
            Self::KindMisfit { program, plc } => {
                write!(f, "the program is of the kind {program}, and that of the PLC of the kind {plc}")
            }
            Self::HasRefusedPage { page } => write!(
                f,
                "the program ends before page {page}, which the PLC that it was read from refused, and this PLC has it"
            ),
            Self::OtherPlc => {
                f.write_str("the program is of another PLC, and `WriteOptions::accept_other_plc` was not chosen")
            }
            Self::MemoryCard => f.write_str("the PLC has a ROM pack or memory card in use, which cannot be written"),
            Self::Running => f.write_str("the PLC runs: stop it first, or choose to have it stopped"),
            Self::StillRunning => f.write_str("the PLC does not stop"),
            Self::SetRunning => f.write_str("another client started the PLC while its program was written"),
            Self::NotTaken { page } => write!(f, "page {page} reads back differently from what was written"),
            Self::Differs { pages } => {
                write!(f, "{} pages are no longer those of the program", pages.len())?;
                pages.first().map_or(Ok(()), |first| write!(f, ", the first is page {first}"))
            }
            Self::RunRefused { error } => write!(f, "the PLC refuses to run the program: {error}"),
            Self::NotRunning => f.write_str("the PLC does not run"),
        }
    }
}

impl std::error::Error for ProgramError {
    /// The cause behind the one that the text has.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Call { source, .. } => source.source(),
            Self::Invalid(invalid) => invalid.source(),
            Self::Changed { .. }
            | Self::OtherStation { .. }
            | Self::SizeMisfit { .. }
            | Self::KindMisfit { .. }
            | Self::HasRefusedPage { .. }
            | Self::OtherPlc
            | Self::MemoryCard
            | Self::Running
            | Self::StillRunning
            | Self::SetRunning
            | Self::NotTaken { .. }
            | Self::Differs { .. }
            | Self::RunRefused { .. }
            | Self::NotRunning => None,
        }
    }
}

impl ProgramError {
    /// The error of the request that failed, if that is the reason.
    #[must_use]
    pub fn call_error(&self) -> Option<&Error> {
        if let Self::Call { source, .. } = self { Some(source) } else { None }
    }
}

impl From<InvalidProgram> for ProgramError {
    fn from(invalid: InvalidProgram) -> Self {
        Self::Invalid(invalid)
    }
}

impl From<OtherStation> for ProgramError {
    fn from(OtherStation { begun, station }: OtherStation) -> Self {
        Self::OtherStation { begun, station }
    }
}

impl From<RunFailure> for ProgramError {
    /// An error of STOP or RUN explains best why the PLC did not obey.
    fn from(RunFailure { cause, command_error }: RunFailure) -> Self {
        let (action, source) = match (cause, command_error) {
            (RunCause::RunRefused { error, .. }, _) => return Self::RunRefused { error },
            (_, Some((RunCommand::Stop, source))) => (ProgramAction::Stop, source),
            (_, Some((RunCommand::Run, source))) => (ProgramAction::Run, source),
            (RunCause::NoStatus(source), None) => (ProgramAction::ReadStatus, source),
            (RunCause::NotConfirmed(source), None) => (ProgramAction::Confirm, source),
            (RunCause::NotObeyed(RunCommand::Stop), None) => return Self::StillRunning,
            (RunCause::NotObeyed(RunCommand::Run), None) => return Self::NotRunning,
        };
        Self::Call { action, source }
    }
}

/// Error: a program was not written, or not completely; with the state of the PLC.
///
/// Writing it again compares all pages and writes those that still differ.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct WriteProgramError {
    /// The reason.
    pub source: Box<ProgramError>,
    /// How far the writing has come.
    pub state: Box<WriteState>,
}

impl fmt::Display for WriteProgramError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}; {}", self.source, self.state)
    }
}

impl std::error::Error for WriteProgramError {
    /// The cause behind the one that the text has.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.source.source()
    }
}
