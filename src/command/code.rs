use std::fmt;

use crate::wire::Framing;

// The commands, as in the manuals' table.
//
// - class:   what it does to the PLC
// - framing: where it exists
// - error:   how its reply carries the error code
codes! {
    // code  variant             name                       class    framing      error
    0x40  ReadStatus          "read brief status"        Read     Both         Leading;
    0x41  ControlPlc          "control RUN/STOP"         Control  Both         Leading;
    0x42  ControlDiscrete     "control one discrete"     Control  Both         Leading;
    0x43  ReadDisabled        "read enable/disable"      Read     Both         Leading;
    0x44  ReadDiscretes       "read discretes"           Read     Both         Leading;
    0x45  WriteDiscretes      "write discretes"          Write    Both         Leading;
    0x46  ReadRegisters       "read registers"           Read     Both         Leading;
    0x47  WriteRegisters      "write registers"          Write    Both         Leading;
    0x48  ReadMixed           "mixed read"               Read     Both         Leading;
    0x49  WriteMixed          "mixed write"              Write    Both         Leading;
    0x4E  LoopBack            "loop back"                Read     Both         Absent;
    0x4F  ReadProgramPage     "read program page"        Read     AsciiOnly    ByLength;
    0x50  WriteProgramPage    "write program page"       Write    AsciiOnly    Leading;
    0x53  ReadDetailedStatus  "read detailed status"     Read     Both         Leading;
}

impl Code {
    /// Whether the framing has this command: program pages are in the ASCII framing only.
    #[must_use]
    pub fn is_in(self, framing: Framing) -> bool {
        match self.row().framings {
            Framings::Both => true,
            Framings::AsciiOnly => framing == Framing::Ascii,
        }
    }

    /// What it is called.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.row().name
    }

    /// What it does to the PLC.
    #[must_use]
    pub fn class(self) -> Class {
        self.row().class
    }

    /// How its reply carries the error code.
    #[must_use]
    pub fn error_field(self) -> ErrorField {
        self.row().error
    }
}

impl fmt::Display for Code {
    /// The name and the code: `read registers (46)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({:02X})", self.name(), u8::from(*self))
    }
}

/// What a command does to the PLC.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Class {
    /// Changes nothing: it can be repeated.
    Read,
    /// Changes memory or program.
    Write,
    /// Changes what the PLC does.
    Control,
}

/// How the reply to a command carries the error code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorField {
    /// First, always; nothing follows it unless it is 0.
    Leading,
    /// Not at all: the reply is the echo of the request.
    Absent,
    /// First or not at all: the manual's text and figure differ, the length decides.
    ByLength,
}

enum Framings {
    Both,
    AsciiOnly,
}

struct Row {
    name: &'static str,
    class: Class,
    framings: Framings,
    error: ErrorField,
}

macro_rules! codes {
    ($($code:literal $variant:ident $name:literal $class:ident $framings:ident $error:ident;)*) => {
        /// The code of a command.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[repr(u8)]
        #[non_exhaustive]
        pub enum Code {
            $(
                #[doc = concat!("`", stringify!($code), "`: ", $name, ".")]
                $variant = $code,
            )*
        }

        impl Code {
            /// Every command, in the manual's order.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            /// The command with this code.
            #[must_use]
            pub fn from_u8(code: u8) -> Option<Self> {
                match code {
                    $($code => Some(Self::$variant),)*
                    _ => None,
                }
            }

            fn row(self) -> Row {
                match self {
                    $(Self::$variant => Row {
                        name: $name,
                        class: Class::$class,
                        framings: Framings::$framings,
                        error: ErrorField::$error,
                    },)*
                }
            }
        }

        impl From<Code> for u8 {
            fn from(code: Code) -> Self {
                match code {
                    $(Code::$variant => $code,)*
                }
            }
        }
    };
}
use codes;
