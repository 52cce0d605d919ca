use std::fmt;

use super::header::ProgramKind;
use super::state::WriteState;
use crate::error::{Error, ErrorCode};

/// Why some pages are no program: the page, and the rule.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidProgram {
    /// Page 0 is no header.
    #[error("page 0: it begins with {:02X} {:02X}, where `FB` or `FM` was expected", found[0], found[1])]
    #[non_exhaustive]
    Mark {
        /// Its bytes 0 and 1.
        found: [u8; 2],
    },
    /// Page 0 is no header.
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
        /// What page 0 says.
        header: u16,
        /// What 53 says.
        status: u16,
    },
    /// Pages are missing, or there are too many.
    #[error("{found} pages, where {expected} were expected: page 0 states a ladder of {ladder_words} words, 64 a page")]
    #[non_exhaustive]
    Pages {
        /// How many there are.
        found: usize,
        /// How many there must be, the header included.
        expected: usize,
        /// What page 0 says.
        ladder_words: u16,
    },
    /// No whole pages.
    #[error("{bytes} bytes are no whole pages: a page has 128")]
    #[non_exhaustive]
    Length {
        /// How many there are.
        bytes: usize,
    },
    /// There is not even a header.
    #[error("there is no page 0")]
    Empty,
}

/// What was asked of the PLC in a transfer.
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
    /// 4E: confirm that no reply was a duplicate out of order.
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

/// Why a program could not be read or written.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProgramError {
    /// A request failed: no answer, no connection, a refusal.
    #[error("cannot {action}: {source}")]
    #[non_exhaustive]
    Call {
        /// What was asked.
        action: ProgramAction,
        /// Why it failed.
        source: Error,
    },
    /// What the PLC holds is no program.
    #[error("the PLC holds no program that this library knows: {0}")]
    Invalid(#[from] InvalidProgram),
    /// Somebody has changed the program while it was read, or between two runs. What was read is thrown away; the next run
    /// begins anew.
    #[error(
        "the program was changed while it was read: {} was another before",
        page.map_or("the PLC's type, version or ladder size".to_owned(), |page| format!("page {page}"))
    )]
    #[non_exhaustive]
    Changed {
        /// The page that is another now; `None` for the PLC's type, version or ladder size.
        page: Option<u16>,
    },
    /// An earlier run has read pages of another station, or has stopped or written it, and has not ended well. Nothing was sent,
    /// and a [`WriteState`] is that of the other one.
    #[error("this was begun with {begun}, and cannot go on with {station}")]
    #[non_exhaustive]
    OtherStation {
        /// The station of the earlier run, and its endpoint.
        begun: String,
        /// The one that was to be written now.
        station: String,
    },
    /// The program is not as large as the PLC's.
    #[error("the program has a ladder of {program} words, and the PLC one of {plc}")]
    #[non_exhaustive]
    SizeMisfit {
        /// What the program has.
        program: u16,
        /// What the PLC has.
        plc: u16,
    },
    /// The program is for another kind of PLC.
    #[error("the program is of the kind {program}, and that of the PLC of the kind {plc}")]
    #[non_exhaustive]
    KindMisfit {
        /// What the program is for.
        program: ProgramKind,
        /// What the PLC holds.
        plc: ProgramKind,
    },
    /// The PLC has a ROM pack or memory card in use, and would refuse every page.
    #[error("the PLC has a ROM pack or memory card in use, which cannot be written")]
    MemoryCard,
    /// The PLC runs, and was not to be stopped.
    #[error("the PLC runs: stop it first, or have it stopped")]
    Running,
    /// The PLC has been told to stop, and runs all the same.
    #[error("the PLC does not stop")]
    StillRunning,
    /// Somebody else has set the PLC running while it was written.
    #[error("somebody has set the PLC running while its program was written")]
    SetRunning,
    /// A page was written, and is not what was written.
    #[error("page {page} reads back as something else than was written")]
    #[non_exhaustive]
    NotTaken {
        /// Which one.
        page: u16,
    },
    /// Pages that were the program's are so no more; [`WriteState::unwritten`] has them, too.
    #[error("{} pages are not the program's any more, the first of them page {}", pages.len(), pages.first().unwrap_or(&0))]
    #[non_exhaustive]
    Differs {
        /// Which ones.
        pages: Vec<u16>,
    },
    /// The PLC has refused to run the program: it has found a fault in it (5, 7), it has another id (6), or lacks a function
    /// (9).
    #[error("the PLC refuses to run the program: {error}")]
    #[non_exhaustive]
    RunRefused {
        /// What it answered.
        error: ErrorCode,
    },
    /// The PLC has been told to run, and does not.
    #[error("the PLC does not run")]
    NotRunning,
}

impl ProgramError {
    /// The request that failed, if that is the error: whether the connection is at fault, or what the PLC answered.
    #[must_use]
    pub fn call_error(&self) -> Option<&Error> {
        match self {
            Self::Call { source, .. } => Some(source),
            _ => None,
        }
    }
}

/// Why a program was not written, how far it came, and in what state the PLC is.
///
/// Writing it again compares all pages and writes those that are not yet the program's.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct WriteProgramError {
    /// Why it went no further.
    pub source: Box<ProgramError>,
    /// How far it came.
    pub state: Box<WriteState>,
}

impl fmt::Display for WriteProgramError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}; {}", self.source, self.state)
    }
}

impl std::error::Error for WriteProgramError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&*self.source)
    }
}
