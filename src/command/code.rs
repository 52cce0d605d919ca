use std::fmt;

use super::Code;
use crate::wire::Framing;

impl Code {
    /// Returns whether the framing has this command. The ASCII framing has all, the binary framing
    /// has no program pages.
    #[must_use]
    pub fn is_in(self, framing: Framing) -> bool {
        match self.row().framings {
            Framings::Both => true,
            Framings::AsciiOnly => framing == Framing::Ascii,
        }
    }

    /// The name, as in the manuals: `read registers`.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.row().name
    }

    /// The effect on the PLC.
    #[must_use]
    pub fn class(self) -> Class {
        self.row().class
    }

    /// The place of the error code in the reply.
    #[must_use]
    pub fn error_field(self) -> ErrorField {
        self.row().error
    }
}

impl fmt::Display for Code {
    /// The name and the code: `read registers (46h)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({:02X}h)", self.name(), u8::from(*self))
    }
}

/// The effect of a command on the PLC.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Class {
    /// No effect: the command can be repeated.
    Read,
    /// Changes memory or program.
    Write,
    /// Changes the state of the PLC or of a discrete: RUN, STOP, forcing.
    Control,
}

/// The place of the error code in a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorField {
    /// Before the data. Data follows only code 0.
    Leading,
    /// Nowhere: the reply is the echo of the request.
    Absent,
    /// Before the data or nowhere. Text and figure of the manual differ, so the length of the reply
    /// decides.
    ByLength,
}

/// A row of the command table.
pub(super) struct Row {
    pub(super) name: &'static str,
    pub(super) class: Class,
    pub(super) framings: Framings,
    pub(super) error: ErrorField,
}

pub(super) enum Framings {
    Both,
    AsciiOnly,
}
