//! What is saved in files: one frame around every kind of content, and saving that never leaves half a file.
//!
//! A file is text, so that people can look into it and tools can compare two of them:
//!
//! ```text
//! fatek file 1: program          the format's version, and what kind of content this is
//! length 53214                   how many bytes lie between this line and the last
//! …                              the content, lines of `name value`
//! crc32 1A2B3C4D                 CRC-32 (ISO-HDLC) of all that stands before this line
//! ```
//!
//! Lines end with a line feed, and the last line is the end of the file. What has been saved is loaded again; a file
//! that lacks anything, has anything more, or of which a single bit is another is refused, and the error says what is wrong.

mod error;
mod frame;
mod lines;
mod save;
mod utc;

pub use self::error::{FileError, FormatError};
pub(crate) use self::frame::{Kind, frame, unframe};
pub(crate) use self::lines::{Lines, in_form};
pub use self::save::can_save;
pub(crate) use self::save::{load, load_as, save};
pub(crate) use self::utc::parse_utc;
pub use self::utc::utc;
