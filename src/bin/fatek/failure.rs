//! Errors of subcommands, with their messages and exit statuses.

use std::path::PathBuf;
use std::{fmt, io};

use fatek::backup::{RestoreError, RestoreFailure};
use fatek::file::{FileError, PlcDifference};
use fatek::plant::PlantFileError;
use fatek::program::{PlcState, ProgramError, WriteProgramError, WriteState};
use fatek::tag_table::TableFileError;

use crate::printable::excerpt;
use crate::signal::Signal;
use crate::traffic::TrafficFailure;
use crate::transfer::{listed, shown};

#[derive(Debug, thiserror::Error)]
pub(crate) enum Failure {
    /// Error in the command line. Nothing was sent.
    #[error("{0}")]
    Usage(String),
    /// A table of tags cannot be loaded; one line for each fault.
    #[error(transparent)]
    Table(#[from] TableFileError),
    /// A plant configuration cannot be loaded; one line for each fault.
    #[error(transparent)]
    Plant(#[from] PlantFileError),
    /// Failed call.
    #[error(transparent)]
    Call(#[from] fatek::Error),
    /// Failed call with its subject, one of several.
    #[error("{subject}: {error}")]
    CallOf { subject: String, error: fatek::Error },
    /// Pings without a reply.
    #[error("{lost} of {sent} requests had no reply")]
    Lost { lost: u32, sent: u32, last: Option<fatek::Error> },
    /// Pings with a bad reply.
    #[error("{bad} of {sent} requests had a bad reply")]
    BadReplies { bad: u32, sent: u32, last: Option<fatek::Error> },
    /// No station of the scanned range answered.
    #[error(
        "{}",
        if *scanned == 1 { "the station did not answer".into() } else { format!("none of {scanned} stations answered") }
    )]
    NoStation { scanned: usize },
    /// No station of the scanned networks answered. `failure`: what kept this computer from trying some.
    #[error(
        "no station answered on {hosts} host{}{}",
        if *hosts == 1 { "" } else { "s" },
        failure.as_ref().map_or(String::new(), |failure| format!("; not all could be tried: {failure}"))
    )]
    NoPlc { hosts: u128, failure: Option<String> },
    /// The address of a host name is not known.
    #[error("the address of {} is not known: {error}", excerpt(host))]
    Host { host: String, error: io::Error },
    /// The broadcast for modules cannot be sent, or its replies cannot be received.
    #[error("cannot discover modules: {subject}: {error}")]
    Discover { subject: String, error: io::Error },
    /// No module answered the broadcast.
    #[error("no module answered")]
    NoModule,
    /// Replies to the broadcast in an unknown form only.
    #[error("replies of unknown form: {unknown}")]
    UnknownReplies { unknown: usize },
    /// A port or host cannot be opened.
    #[error("cannot open {}: {error}{hint}", excerpt(link))]
    Open { link: String, error: io::Error, hint: String },
    /// The serial ports of this computer cannot be listed.
    #[error("cannot list the serial ports: {0}")]
    Ports(io::Error),
    /// No settings were found for a line.
    #[error("no answer to {}", crate::detect::requests_text(*tried))]
    NotDetected { tried: usize },
    /// A line ended at each request.
    #[error("{}: the line was lost at each of {}: {error}", excerpt(link), crate::detect::requests_text(*tried))]
    LostLine { link: String, tried: usize, error: io::Error },
    /// Another master is working on a line.
    #[error("the line is busy, nothing was sent: stop the other master, or give --busy")]
    BusyLine,
    /// Stations with bad or late replies.
    #[error("stations with bad replies: {bad}")]
    BadStations { bad: usize },
    /// Bad frames, and bytes outside frames.
    #[error("bad frame{}", if *all == 1 { String::new() } else { format!("s: {bad} of {all}") })]
    BadFrames { bad: usize, all: usize },
    /// The user did not confirm.
    #[error("not confirmed: nothing was changed")]
    Declined,
    /// A file cannot be saved or loaded.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file without the header of saved files: perhaps a raw file.
    #[error("{0}; for a raw file give --raw")]
    NotRaw(FileError),
    /// A program could not be read.
    #[error(transparent)]
    Program(#[from] ProgramError),
    /// A program could not be read, but some of its pages.
    #[error("{error}")]
    ProgramPart { error: ProgramError },
    /// A program could not be written.
    #[error("{}", not_written(.0))]
    WriteProgram(#[from] WriteProgramError),
    /// A backup could not be restored.
    #[error("{}", not_restored(.0))]
    Restore(#[from] RestoreError),
    /// The file is of another PLC, and `--force` was not given.
    #[error("the file is of another PLC: {}; to write it nevertheless, give --force", listed(.0))]
    OtherPlc(Vec<PlcDifference>),
    /// Tags that the PLC refused, or a part of which it refused.
    #[error("{refused} of {all} tags refused, whole or in part")]
    RefusedTags { refused: usize, all: usize },
    /// Ranges that the PLC refused.
    #[error("{refused} of {all} ranges refused")]
    RefusedRanges { refused: usize, all: usize },
    /// Elements refused by the PLC. `file` has the others, if there are any.
    #[error(
        "{missing} of {all} elements are missing; {}",
        file.as_ref().map_or("nothing was saved".into(), |file| format!("the others were saved to {}", shown(file)))
    )]
    Missing { missing: usize, all: usize, file: Option<PathBuf> },
    /// A signal ended the command. `done`: how far it came.
    #[error("interrupted by {signal}{done}")]
    Interrupted { signal: Signal, done: String },
    /// Contents of PLC and file differ. `parts` is pages or elements.
    #[error("{differing} of {all} {parts} differ")]
    Differs { parts: &'static str, differing: usize, all: usize },
    /// Values that were read back differ from those written.
    #[error("{differing} of {all} values read back differ from those written")]
    NotAsWritten { differing: usize, all: usize },
    /// An examination has found contradictions.
    #[error("{contradictions} of {all} assumptions are contradicted")]
    Contradicted { contradictions: usize, all: usize },
    /// An examination could not be completed.
    #[error("ended early: {reason}")]
    EndedEarly { reason: String, status: u8 },
    /// The simulator cannot listen.
    #[error("cannot listen on {}: {error}", excerpt(url))]
    Listen { url: String, error: io::Error },
    /// The log file cannot be opened or written.
    #[error("log file {}: {error}", shown(path))]
    Log { path: PathBuf, error: io::Error },
    /// The man pages cannot be written.
    #[error("man pages in {}: {error}", shown(folder))]
    ManPages { folder: PathBuf, error: io::Error },
    /// Traffic cannot be read, recorded or replayed.
    #[error(transparent)]
    Traffic(#[from] TrafficFailure),
    /// The plant configuration of a simulator cannot be read, or its copy cannot be written.
    #[error("{}: {error}", shown(path))]
    ClientConfig { path: PathBuf, error: io::Error },
    /// Stdout cannot be written.
    #[error("cannot write to stdout: {0}")]
    Output(io::Error),
    /// The terminal cannot be read.
    #[error("cannot read the terminal: {0}")]
    Input(io::Error),
    /// The runtime, a signal handler or the terminal failed.
    #[error("cannot start: {0}")]
    Runtime(io::Error),
}

impl Failure {
    pub(crate) fn usage(error: impl fmt::Display) -> Self {
        Self::Usage(error.to_string())
    }

    /// Returns a constructor of [`Failure::CallOf`] with this subject.
    pub(crate) fn of(subject: impl fmt::Display) -> impl FnOnce(fatek::Error) -> Self {
        move |error| Self::CallOf { subject: subject.to_string(), error }
    }

    /// The failure with the name of its PLC, one of several.
    pub(crate) fn in_target(self, plc: &str) -> Self {
        if let Self::Usage(reason) = self {
            Self::Usage(format!("{plc}: {reason}"))
        } else if let Self::Call(error) = self {
            Self::of(plc)(error)
        } else {
            self
        }
    }

    /// Returns a constructor of [`Failure::Interrupted`]. `done`: how far the command came, empty
    /// or after a colon or a blank.
    pub(crate) fn interrupted(done: impl Into<String>) -> impl FnOnce(Signal) -> Self {
        move |signal| Self::Interrupted { signal, done: done.into() }
    }

    /// The call that failed, or the last one of several.
    pub(crate) fn call_error(&self) -> Option<&fatek::Error> {
        match self {
            Self::Call(error) | Self::CallOf { error, .. } => Some(error),
            Self::Lost { last, .. } | Self::BadReplies { last, .. } => last.as_ref(),
            Self::Program(error) | Self::ProgramPart { error } => error.call_error(),
            Self::WriteProgram(error) => error.source.call_error(),
            Self::Restore(error) => error.source.call_error(),
            Self::Usage(_) | Self::Table(_) | Self::Plant(_) | Self::NoStation { .. } | Self::BadStations { .. } => {
                None
            }
            Self::BadFrames { .. } | Self::Declined | Self::File(_) | Self::NotRaw(_) | Self::OtherPlc(_) => None,
            Self::RefusedTags { .. } | Self::RefusedRanges { .. } | Self::Missing { .. } | Self::Interrupted { .. } => {
                None
            }
            Self::Differs { .. } | Self::NotAsWritten { .. } | Self::Listen { .. } | Self::Log { .. } => None,
            Self::ManPages { .. }
            | Self::ClientConfig { .. }
            | Self::Traffic(_)
            | Self::Output(_)
            | Self::Input(_)
            | Self::Runtime(_) => None,
            Self::NoPlc { .. } | Self::Host { .. } | Self::Discover { .. } | Self::NoModule => None,
            Self::UnknownReplies { .. } | Self::Open { .. } | Self::Ports(_) | Self::NotDetected { .. } => None,
            Self::Contradicted { .. } | Self::EndedEarly { .. } => None,
            Self::LostLine { .. } | Self::BusyLine => None,
        }
    }

    /// Returns whether the reader of stdout has closed it.
    pub(crate) fn is_broken_pipe(&self) -> bool {
        matches!(self, Self::Output(error) if error.kind() == io::ErrorKind::BrokenPipe)
    }

    /// Exit status, as listed in `fatek --help`.
    pub(crate) fn exit_status(&self) -> u8 {
        match self {
            Self::Output(_) | Self::Input(_) | Self::Runtime(_) | Self::Declined => 1,
            Self::Log { .. } | Self::ManPages { .. } => 1,
            Self::Traffic(failure) => failure.exit_status(),
            Self::Ports(_) => 1,
            Self::ClientConfig { .. } => 1,
            Self::File(FileError::Io { .. } | FileError::NotAFile { .. }) => 1,
            Self::Interrupted { signal, .. } => signal.exit_status(),
            Self::Usage(_) | Self::Table(_) | Self::Plant(_) => 2,
            Self::Missing { .. } | Self::RefusedTags { .. } | Self::RefusedRanges { .. } => 3,
            Self::Call(error) | Self::CallOf { error, .. } => of_call(error),
            Self::Restore(RestoreError { source: RestoreFailure::NotThere { .. }, .. }) => 3,
            Self::WriteProgram(error) if is_run_refused(error) => 3,
            Self::Program(error) | Self::ProgramPart { error } => error.call_error().map_or(7, of_call),
            Self::WriteProgram(error) => error.source.call_error().map_or(7, of_call),
            Self::Restore(error) => error.source.call_error().map_or(7, of_call),
            Self::File(_) | Self::NotRaw(_) | Self::Differs { .. } | Self::OtherPlc(_) => 7,
            Self::NotAsWritten { .. } | Self::Contradicted { .. } => 7,
            Self::EndedEarly { status, .. } => *status,
            Self::Lost { .. } | Self::NoStation { .. } | Self::NoModule | Self::NotDetected { .. } => 4,
            Self::BusyLine => 4,
            Self::LostLine { .. } => 5,
            Self::NoPlc { failure: None, .. } => 4,
            Self::NoPlc { failure: Some(_), .. } => 5,
            Self::Listen { .. } | Self::Host { .. } | Self::Discover { .. } | Self::Open { .. } => 5,
            Self::BadReplies { .. } | Self::BadStations { .. } | Self::BadFrames { .. } => 6,
            Self::UnknownReplies { .. } => 6,
        }
    }
}

/// Message of a program that was not written, with the commands that complete the download.
fn not_written(error: &WriteProgramError) -> String {
    if let ProgramError::Running = *error.source {
        return "the PLC runs, nothing was written: stop it first, or give --stop".to_owned();
    }
    if let ProgramError::OtherPlc = *error.source {
        return Failure::OtherPlc(error.state.other_plc.clone()).to_string();
    }
    format!("{error}{}", if is_run_refused(error) { "" } else { remedy(&error.state) })
}

/// Message of a backup that was not restored.
fn not_restored(error: &RestoreError) -> String {
    if let RestoreFailure::OtherPlc = error.source {
        return Failure::OtherPlc(error.report.other_plc.clone()).to_string();
    }
    if let RestoreFailure::Running = error.source {
        return format!("the PLC runs: stop it first, or give --stop; {}", error.report);
    }
    error.to_string()
}

fn is_run_refused(error: &WriteProgramError) -> bool {
    matches!(*error.source, ProgramError::RunRefused { .. })
}

/// State of an interrupted program download, with the commands that complete it.
pub(crate) fn interrupted_write(state: &WriteState) -> String {
    format!(": {state}{}", remedy(state))
}

/// The commands that complete an interrupted program download.
fn remedy(state: &WriteState) -> &'static str {
    // A repeated command finds a stopped PLC, and does not start it.
    let must_run = state.was_stopped && state.plc != PlcState::Running;
    match (state.is_half_written(), must_run) {
        (true, true) => "; repeat the command, then start the PLC with `fatek run`",
        (true, false) => "; repeat the command",
        (false, true) => "; start the PLC with `fatek run`",
        (false, false) => "",
    }
}

fn of_call(error: &fatek::Error) -> u8 {
    match cause(error) {
        fatek::Error::Invalid(_) | fatek::Error::Tag(_) => 2,
        fatek::Error::Plc { .. } => 3,
        fatek::Error::Timeout { .. } | fatek::Error::Offline { .. } => 4,
        fatek::Error::Connect { .. } | fatek::Error::Disconnected { .. } | fatek::Error::Closed { .. } => 5,
        fatek::Error::OutOfStep { sent: false, .. } => 4,
        fatek::Error::BadReply { .. } | fatek::Error::OutOfStep { .. } | fatek::Error::Duplicates { .. } => 6,
        fatek::Error::Clock { .. } => 3,
        fatek::Error::QueueFull { .. } | fatek::Error::GateClosed { .. } | fatek::Error::PartlyWritten { .. } | _ => 1,
    }
}

/// Cause of a failed call; of several requests, of several tags and of a clock, that of the failed request.
fn cause(error: &fatek::Error) -> &fatek::Error {
    let source = if let fatek::Error::PartlyWritten { source, .. }
    | fatek::Error::RefusedTags { source, .. }
    | fatek::Error::ReadBeforeWrite { source, .. } = error
    {
        Some(&**source)
    } else if let fatek::Error::Clock { failure, .. } = error {
        failure.call_error()
    } else {
        None
    };
    source.map_or(error, cause)
}
