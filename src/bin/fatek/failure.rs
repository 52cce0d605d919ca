//! Why a subcommand failed, and the exit status that says so.

use std::fmt;
use std::io;
use std::path::PathBuf;
use std::process::ExitCode;

use fatek::backup::{RestoreError, RestoreFailure, RestoreReport};
use fatek::file::FileError;
use fatek::program::{PlcState, ProgramError, WriteProgramError, WriteState};

use crate::output::complain;

#[derive(Debug)]
pub(crate) enum Failure {
    /// The command line has an error. Nothing was sent.
    Usage(String),
    /// A call failed; what it was for, if there can be a doubt.
    Call { what: Option<String>, error: fatek::Error },
    /// So many pings stayed without an answer.
    Lost { lost: u32, sent: u32 },
    /// So many pings had a bad answer.
    Spoilt { spoilt: u32, sent: u32 },
    /// Of so many stations, none answered.
    Nobody { asked: usize },
    /// So many of the stations that were asked answered badly, or too late.
    BadStations { bad: usize },
    /// So many frames, of all, are bad.
    BadFrames { bad: usize, all: usize },
    /// Somebody was asked, and has not said yes. Nothing was changed.
    Declined,
    /// A file could not be saved, or is not what it should be.
    File(FileError),
    /// A file is none of this program, and may be one of bytes and nothing else.
    NotRaw(FileError),
    /// A program could not be read.
    Program(ProgramError),
    /// A program could not be written.
    WriteProgram(WriteProgramError),
    /// A backup could not be restored.
    Restore(RestoreError),
    /// A restoring was stopped by the user; how far it has come.
    BrokenOff(Box<RestoreReport>),
    /// The PLC has refused to give so many elements, of all; the others are saved, if there are any.
    Missing { missing: usize, all: usize, file: Option<PathBuf> },
    /// The writing of a program was stopped by the user; how far it has come.
    WriteBrokenOff(Box<WriteState>),
    /// A reading was stopped by the user, after so many pages.
    ReadBrokenOff { pages: usize },
    /// So many parts of what the PLC holds, of all, are not as in the file.
    Differs { what: &'static str, differing: usize, all: usize },
    /// The simulator cannot listen.
    Listen { url: String, error: io::Error },
    /// Stdout cannot be written to.
    Output(io::Error),
    /// There is no runtime.
    Runtime(io::Error),
}

impl Failure {
    pub(crate) fn usage(error: impl fmt::Display) -> Self {
        Self::Usage(error.to_string())
    }

    /// A failed call for this.
    pub(crate) fn of(what: impl fmt::Display) -> impl FnOnce(fatek::Error) -> Self {
        move |error| Self::Call { what: Some(what.to_string()), error }
    }

    /// Tells it on stderr, and gives the exit status.
    pub(crate) fn report(&self) -> ExitCode {
        // Who has closed our stdout does not want to know more: `fatek read … | head -1` went well.
        if let Self::Output(error) = self
            && error.kind() == io::ErrorKind::BrokenPipe
        {
            return ExitCode::SUCCESS;
        }
        complain(format_args!("error: {self}"));
        if let Self::Usage(_) = self {
            complain(format_args!("\nFor more information, try '--help'."));
        }
        ExitCode::from(self.exit_status())
    }

    fn exit_status(&self) -> u8 {
        match self {
            Self::Output(_) | Self::Runtime(_) | Self::Declined => 1,
            Self::File(FileError::Io { .. } | FileError::NotAFile { .. }) => 1,
            Self::BrokenOff(_) | Self::WriteBrokenOff(_) | Self::ReadBrokenOff { .. } => 1,
            Self::Usage(_) => 2,
            Self::Missing { .. } => 3,
            Self::Restore(error) => of_restore(&error.source),
            Self::Call { error, .. } => of_call(error),
            Self::Program(error) => of_program(error),
            Self::WriteProgram(error) => of_program(&error.source),
            Self::File(_) | Self::NotRaw(_) | Self::Differs { .. } => 7,
            Self::Lost { .. } | Self::Nobody { .. } => 4,
            Self::Listen { .. } => 5,
            Self::Spoilt { .. } | Self::BadStations { .. } | Self::BadFrames { .. } => 6,
        }
    }
}

/// How the writing of a program that has ended in the middle is brought to its end.
fn go_on(state: &WriteState, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    // Another process does not know that it ran.
    let run = state.was_stopped && state.plc != PlcState::Running;
    f.write_str(match (state.is_half_written(), run) {
        (true, true) => "; the same command again does that, and then `fatek run` runs it",
        (true, false) => "; the same command again does that",
        (false, true) => "; `fatek run` runs it",
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

/// Why a call failed; of a write in several requests, why it went no further.
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
        Self::Call { what: None, error }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Usage(message) => f.write_str(message),
            Self::Call { what: Some(what), error } => write!(f, "{what}: {error}"),
            Self::Call { what: None, error } => error.fmt(f),
            Self::Lost { lost, sent } => write!(f, "{lost} of {sent} had no answer"),
            Self::Spoilt { spoilt, sent } => write!(f, "{spoilt} of {sent} had a bad answer"),
            Self::Nobody { asked: 1 } => f.write_str("the station did not answer"),
            Self::Nobody { asked } => write!(f, "none of {asked} stations answered"),
            Self::BadStations { bad } => write!(f, "{bad} answered badly"),
            Self::BadFrames { bad: 1, all: 1 } => f.write_str("this is no good frame"),
            Self::BadFrames { bad, all } => write!(f, "{bad} of {all} are no good frames"),
            Self::Declined => f.write_str("not confirmed: nothing was changed"),
            Self::File(error) => error.fmt(f),
            Self::NotRaw(error) => write!(f, "{error}; a file of bytes and nothing else is taken with --raw"),
            Self::Program(error) => error.fmt(f),
            Self::WriteProgram(error) => match *error.source {
                ProgramError::Running => {
                    f.write_str("the PLC runs, and nothing was written: stop it first, or have it stopped with --stop")
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
                    go_on(&error.state, f)
                }
            },
            Self::Restore(error) => error.fmt(f),
            Self::BrokenOff(report) => write!(f, "interrupted: {report}"),
            Self::WriteBrokenOff(state) => {
                write!(f, "interrupted: {state}")?;
                go_on(state, f)
            }
            Self::ReadBrokenOff { pages } => write!(f, "interrupted: {pages} pages were read; nothing is saved"),
            Self::Missing { missing, all, file: None } => {
                write!(f, "{missing} of {all} elements are missing; nothing is saved")
            }
            Self::Missing { missing, all, file: Some(file) } => {
                write!(f, "{missing} of {all} elements are missing; the others are in {}", file.display())
            }
            Self::Differs { what, differing, all } => write!(f, "{differing} of {all} {what} differ"),
            Self::Listen { url, error } => write!(f, "cannot listen on {url}: {error}"),
            Self::Output(error) => write!(f, "cannot write to stdout: {error}"),
            Self::Runtime(error) => write!(f, "cannot start: {error}"),
        }
    }
}
