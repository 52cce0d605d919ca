//! The methods of contents that are saved in files, and the fields that all of them have.

use std::time::SystemTime;

use super::{FormatError, Lines, UNKNOWN, parse_utc, utc};
use crate::command::{BriefStatus, DetailedStatus};
use crate::hex;

/// The PLC and time of the reading; all `None` if the content was not read from a PLC.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Origin {
    /// In whole seconds, as files have it.
    pub(crate) read_at: Option<SystemTime>,
    pub(crate) brief: Option<BriefStatus>,
    pub(crate) detailed: Option<DetailedStatus>,
}

/// The text of a field that may not be known.
pub(crate) fn optional_field(value: Option<String>) -> String {
    value.unwrap_or_else(|| UNKNOWN.to_owned())
}

impl Origin {
    /// The names of its fields.
    pub(crate) const FIELDS: [&str; 4] = ["read", "about", "brief", "status"];

    /// Its lines in a file. `about` is for people; it follows from other fields.
    pub(crate) fn lines(&self, about: Option<String>) -> String {
        format!(
            "read {}\nabout {}\nbrief {}\nstatus {}\n",
            optional_field(self.read_at.map(utc)),
            optional_field(about),
            optional_field(self.brief.map(|status| hex::encode(&status.raw()))),
            optional_field(self.detailed.as_ref().map(|status| hex::encode(status.raw()))),
        )
    }

    pub(crate) fn parse(lines: &mut Lines<'_>) -> Result<Self, FormatError> {
        let read_at = lines.optional("read", "a time such as 2026-11-22T07:09:13Z", parse_utc)?;
        lines.field("about")?;
        let brief = lines.optional("brief", "three bytes in hexadecimal digits", |text| {
            Some(BriefStatus::from_raw(hex::decode(text)?.try_into().ok()?))
        })?;
        let detailed = lines.optional("status", "28 to 249 bytes in hexadecimal digits", |text| {
            DetailedStatus::from_raw(hex::decode(text)?)
        })?;
        Ok(Self { read_at, brief, detailed })
    }
}

/// The methods of a content with a `format` module beside it, and the fields `origin` and
/// `unknown_fields`.
macro_rules! file_methods {
    ($content:ident, $name:literal, $(#[$form:meta])+) => {
        impl $content {
            $(#[$form])+
            #[must_use]
            pub fn to_file(&self) -> String {
                format::write(self)
            }

            /// Parses the content of a file, of this or an older [version](crate::file#versions), or of a
            /// newer one with the same major version.
            ///
            /// # Errors
            /// [`FormatError`](crate::file::FormatError), which names the line and the rule, for a foreign
            /// file, another major version, and a file that is cut off or changed in a single bit.
            pub fn from_file(content: &[u8]) -> Result<Self, crate::file::FormatError> {
                format::read(content)
            }

            #[doc = concat!("Saves the ", $name, ". The old content of the file stays until the new one is")]
            /// complete on the disk.
            ///
            /// Blocks until the disk has written it.
            ///
            /// # Errors
            /// [`FileError`](crate::file::FileError); the file is as it was before.
            pub fn save(&self, path: impl AsRef<std::path::Path>) -> Result<(), crate::file::FileError> {
                crate::file::save(path.as_ref(), self.to_file().as_bytes())
            }

            /// Loads a file of [`save`](Self::save). Blocks until the disk has read it.
            ///
            /// # Errors
            /// [`FileError`](crate::file::FileError), which names the file and the fault.
            pub fn load(path: impl AsRef<std::path::Path>) -> Result<Self, crate::file::FileError> {
                crate::file::load_as(path.as_ref(), Self::from_file)
            }

            /// The brief status (40) of the PLC when it was read: its capacity and, on older units, its
            /// model. `None` if it was not read from a PLC.
            #[must_use]
            pub fn brief_status(&self) -> Option<crate::command::BriefStatus> {
                self.origin.brief
            }

            /// The detailed status (53) of the PLC when it was read. `None` if it was not read from a PLC,
            /// or from one without this status.
            #[must_use]
            pub fn status(&self) -> Option<&crate::command::DetailedStatus> {
                self.origin.detailed.as_ref()
            }

            /// The time of reading by the clock of the computer, in whole seconds. `None` if it was not
            /// read from a PLC.
            #[must_use]
            pub fn read_at(&self) -> Option<std::time::SystemTime> {
                self.origin.read_at
            }

            /// Names of the fields that this version of the library does not know, if it was read from a
            /// file of a [newer version](crate::file#versions). They are ignored.
            #[must_use]
            pub fn unknown_fields(&self) -> &[String] {
                &self.unknown_fields
            }
        }
    };
}
pub(crate) use file_methods;
