//! Files of programs and backups: one frame around every kind of content, and atomic saving.
//!
//! A file is text, so that people can read it and tools can compare two of them:
//!
//! ```text
//! fatek file 1: program          version of the format, and kind of the content
//! length 53214                   bytes between this line and the last
//! …                              the content: lines of `name value`
//! crc32 1A2B3C4D                 CRC-32 (ISO-HDLC) of all lines before this one
//! ```
//!
//! Lines end with a line feed, and the last line ends the file. A file that is cut off, longer, or
//! different in a single bit is refused; the error names the line and the rule.
//!
//! # Saving
//!
//! A file is saved as a new one in its folder, `.fatek-TARGET-PROCESS-N.new`, which then replaces
//! it. `TARGET` is a checksum of the name of the file. The process holds a lock on the new file
//! until it has its final name.
//!
//! A process that is killed leaves the new file behind. The next save of the same file removes it:
//! every file in the folder whose name has this form and `TARGET`, and that no process has locked.
//! On systems other than Unix it must also be older than a minute. A file system without locks
//! keeps such files. One that several computers use must share their locks.
//!
//! # Versions
//!
//! The version is `major` or `major.minor`; this library writes 1.
//!
//! - Files of the same major version and an older minor version are read.
//! - A newer minor version only adds fields. They are ignored, and `unknown_fields` of the
//!   [program](crate::Program::unknown_fields) or [backup](crate::Backup::unknown_fields) names them.
//! - Another major version is [`FormatError::Version`].
//!
//! To add a field: raise the minor version in `frame.rs`, write the field, and read it as unknown
//! from files of older versions. The folder `tests/fixtures` has a file of each version.

mod difference;
mod error;
mod frame;
mod left_over;
mod lines;
mod save;
mod saved;
mod utc;

pub use self::difference::PlcDifference;
pub(crate) use self::difference::{listed, model_differences};
pub use self::error::{FileError, FormatError};
pub(crate) use self::frame::{Content, Kind, frame, unframe};
pub(crate) use self::lines::{Lines, UNKNOWN};
#[cfg(feature = "config")]
pub(crate) use self::save::load;
pub(crate) use self::save::load_as;
pub use self::save::{can_save, save};
pub(crate) use self::saved::{Origin, file_methods, optional_field};
pub use self::utc::utc;
#[cfg(feature = "serde")]
pub(crate) use self::utc::utc_millis;
pub(crate) use self::utc::{parse_utc, whole_seconds};
