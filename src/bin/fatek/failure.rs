//! Errors of subcommands, with their messages and exit statuses.

use std::fmt;
use std::io;
use std::path::PathBuf;

use fatek::backup::{RestoreError, RestoreFailure, RestoreReport};
use fatek::file::FileError;
use fatek::program::{PlcState, ProgramError, WriteProgramError, WriteState};

#[derive(Debug)]
pub(crate) enum Failure {
    /// Error in the command line. Nothing was sent.
    Usage(String),
    /// Failed call, with its subject if there are several calls.
    Call { subject: Option<String>, error: fatek::Error },
    /// Pings without a reply.
    Lost { lost: u32, sent: u32 },
    /// Pings with a bad reply.
    BadReplies { bad: u32, sent: u32 },
    /// No station of the scanned range answered.
    NoStation { scanned: usize },
    /// Stations with bad or late replies.
    BadStations { bad: usize },
    /// Bad frames, and bytes outside frames.
    BadFrames { bad: usize, all: usize },
    /// The user did not confirm. Nothing was changed.
    Declined,
    /// A file cannot be saved or loaded.
    File(FileError),
    /// A file without the header of saved files: perhaps a raw file.
    NotRaw(FileError),
    /// A program could not be read.
    Program(ProgramError),
    /// A program could not be written.
    WriteProgram(WriteProgramError),
    /// A backup could not be restored.
    Restore(RestoreError),
    /// Restore interrupted by the user.
    RestoreInterrupted(Box<RestoreReport>),
    /// Elements refused by the PLC. `file` has the others, if there are any.
    Missing { missing: usize, all: usize, file: Option<PathBuf> },
    /// Program download interrupted by the user.
    WriteInterrupted(Box<WriteState>),
    /// Program upload interrupted by the user.
    ReadInterrupted { pages: usize },
    /// Contents of PLC and file differ. `parts` is pages or elements.
    Differs { parts: &'static str, differing: usize, all: usize },
    /// The simulator cannot listen.
    Listen { url: String, error: io::Error },
    /// Stdout cannot be written.
    Output(io::Error),
    /// The runtime, a signal handler or the terminal failed.
    Runtime(io::Error),
}

impl Failure {
    pub(crate) fn usage(error: impl fmt::Display) -> Self {
        Self::Usage(error.to_string())
    }

    /// Returns a constructor of [`Failure::Call`] with this subject.
    pub(crate) fn of(subject: impl fmt::Display) -> impl FnOnce(fatek::Error) -> Self {
        move |error| Self::Call { subject: Some(subject.to_string()), error }
    }

    /// Whether the reader of stdout has closed it.
    pub(crate) fn is_broken_pipe(&self) -> bool {
        matches!(self, Self::Output(error) if error.kind() == io::ErrorKind::BrokenPipe)
    }

    /// Exit status, as listed in `fatek --help`.
    pub(crate) fn exit_status(&self) -> u8 {
        match self {
            Self::Output(_) | Self::Runtime(_) | Self::Declined => 1,
            Self::File(FileError::Io { .. } | FileError::NotAFile { .. }) => 1,
            Self::RestoreInterrupted(_) | Self::WriteInterrupted(_) | Self::ReadInterrupted { .. } => 1,
            Self::Usage(_) => 2,
            Self::Missing { .. } => 3,
            Self::Restore(error) => of_restore(&error.source),
            Self::Call { error, .. } => of_call(error),
            Self::Program(error) => of_program(error),
            Self::WriteProgram(error) => of_program(&error.source),
            Self::File(_) | Self::NotRaw(_) | Self::Differs { .. } => 7,
            Self::Lost { .. } | Self::NoStation { .. } => 4,
            Self::Listen { .. } => 5,
            Self::BadReplies { .. } | Self::BadStations { .. } | Self::BadFrames { .. } => 6,
        }
    }
}

/// Writes the commands that complete an interrupted program download.
fn write_remedy(state: &WriteState, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    // A repeated command finds a stopped PLC, and does not start it.
    let must_run = state.was_stopped && state.plc != PlcState::Running;
    f.write_str(match (state.is_half_written(), must_run) {
        (true, true) => "; repeat the command, then start the PLC with `fatek run`",
        (true, false) => "; repeat the command",
        (false, true) => "; start the PLC with `fatek run`",
        (false, false) => "",
    })
}

fn of_call(error: &fatek::Error) -> u8 {
    match cause(error) {
        fatek::Error::Invalid(_) => 2,
        fatek::Error::Plc { .. } => 3,
        fatek::Error::Timeout { .. } | fatek::Error::Offline { .. } => 4,
        fatek::Error::Connect { .. } | fatek::Error::Disconnected { .. } | fatek::Error::Closed { .. } => 5,
        fatek::Error::OutOfStep { sent: false, .. } => 4,
        fatek::Error::BadReply { .. } | fatek::Error::OutOfStep { .. } | fatek::Error::Duplicates { .. } => 6,
        fatek::Error::QueueFull { .. } | fatek::Error::PartlyWritten { .. } | _ => 1,
    }
}

fn of_program(error: &ProgramError) -> u8 {
    match error {
        ProgramError::Call { source, .. } => of_call(source),
        ProgramError::RunRefused { .. } => 3,
        ProgramError::Invalid(_)
        | ProgramError::Changed { .. }
        | ProgramError::OtherStation { .. }
        | ProgramError::SizeMisfit { .. }
        | ProgramError::KindMisfit { .. }
        | ProgramError::MemoryCard
        | ProgramError::Running
        | ProgramError::StillRunning
        | ProgramError::SetRunning
        | ProgramError::NotTaken { .. }
        | ProgramError::Differs { .. }
        | ProgramError::NotRunning
        | _ => 7,
    }
}

fn of_restore(error: &RestoreFailure) -> u8 {
    match error {
        RestoreFailure::Call { source, .. } => of_call(source),
        RestoreFailure::NotThere { .. } => 3,
        RestoreFailure::OtherStation { .. }
        | RestoreFailure::Running
        | RestoreFailure::StillRunning
        | RestoreFailure::SetRunning { .. }
        | RestoreFailure::Differs { .. }
        | RestoreFailure::NotRunning
        | _ => 7,
    }
}

/// Cause of a failed call; for a write of several requests, that of the first failed request.
fn cause(error: &fatek::Error) -> &fatek::Error {
    if let fatek::Error::PartlyWritten { source, .. } = error { cause(source) } else { error }
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        Self::File(error)
    }
}

impl From<ProgramError> for Failure {
    fn from(error: ProgramError) -> Self {
        Self::Program(error)
    }
}

impl From<WriteProgramError> for Failure {
    fn from(error: WriteProgramError) -> Self {
        Self::WriteProgram(error)
    }
}

impl From<RestoreError> for Failure {
    fn from(error: RestoreError) -> Self {
        Self::Restore(error)
    }
}

impl From<fatek::Error> for Failure {
    fn from(error: fatek::Error) -> Self {
        Self::Call { subject: None, error }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Usage(message) => f.write_str(message),
            Self::Call { subject: Some(subject), error } => write!(f, "{subject}: {error}"),
            Self::Call { subject: None, error } => error.fmt(f),
            Self::Lost { lost, sent } => write!(f, "{lost} of {sent} requests had no reply"),
            Self::BadReplies { bad, sent } => write!(f, "{bad} of {sent} requests had a bad reply"),
            Self::NoStation { scanned: 1 } => f.write_str("the station did not answer"),
            Self::NoStation { scanned } => write!(f, "none of {scanned} stations answered"),
            Self::BadStations { bad } => write!(f, "stations with bad replies: {bad}"),
            Self::BadFrames { bad: 1, all: 1 } => f.write_str("bad frame"),
            Self::BadFrames { bad, all } => write!(f, "bad frames: {bad} of {all}"),
            Self::Declined => f.write_str("not confirmed: nothing was changed"),
            Self::File(error) => error.fmt(f),
            Self::NotRaw(error) => write!(f, "{error}; for a raw file give --raw"),
            Self::Program(error) => error.fmt(f),
            Self::WriteProgram(error) => match *error.source {
                ProgramError::Running => {
                    f.write_str("the PLC runs, nothing was written: stop it first, or give --stop")
                }
                ProgramError::RunRefused { .. } => error.fmt(f),
                ProgramError::Call { .. }
                | ProgramError::Invalid(_)
                | ProgramError::Changed { .. }
                | ProgramError::OtherStation { .. }
                | ProgramError::SizeMisfit { .. }
                | ProgramError::KindMisfit { .. }
                | ProgramError::MemoryCard
                | ProgramError::StillRunning
                | ProgramError::SetRunning
                | ProgramError::NotTaken { .. }
                | ProgramError::Differs { .. }
                | ProgramError::NotRunning
                | _ => {
                    error.fmt(f)?;
                    write_remedy(&error.state, f)
                }
            },
            Self::Restore(error) => error.fmt(f),
            Self::RestoreInterrupted(report) => write!(f, "interrupted: {report}"),
            Self::WriteInterrupted(state) => {
                write!(f, "interrupted: {state}")?;
                write_remedy(state, f)
            }
            Self::ReadInterrupted { pages } => write!(f, "interrupted after {pages} pages: nothing was saved"),
            Self::Missing { missing, all, file: None } => {
                write!(f, "{missing} of {all} elements are missing; nothing was saved")
            }
            Self::Missing { missing, all, file: Some(file) } => {
                write!(f, "{missing} of {all} elements are missing; the others were saved to {}", file.display())
            }
            Self::Differs { parts, differing, all } => write!(f, "{differing} of {all} {parts} differ"),
            Self::Listen { url, error } => write!(f, "cannot listen on {url}: {error}"),
            Self::Output(error) => write!(f, "cannot write to stdout: {error}"),
            Self::Runtime(error) => write!(f, "cannot start: {error}"),
        }
    }
}
