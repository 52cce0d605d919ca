//! Whole programs: read, saved, compared, written.
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::program::WriteOptions;
//!
//! let program = station.read_program().await?; // 53, page 0 and all others
//! println!("{}: {} pages", program.header(), program.pages().len());
//! let file = program.to_file(); // or program.save("pump.program")?
//! assert_eq!(fatek::Program::from_file(file.as_bytes())?, program);
//!
//! // Only pages that differ are written; each is read back and compared.
//! let report = station.write_program(&program, WriteOptions::new().stop_first().run_again()).await?;
//! assert!(report.written.is_empty());
//! # Ok(()) });
//! ```
//!
//! Programs are transferred in the ASCII framing only; in the binary one all of this fails with
//! [`InvalidRequest::NotInFraming`](crate::command::InvalidRequest::NotInFraming) before anything is sent.
//!
//! # Reading
//!
//! [`Station::read_program`](crate::Station::read_program) reads it in one go. [`ReadProgram`] does the same, tells how far it
//! has come, and goes on after a failure or when its future has been dropped:
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::program::ReadProgram;
//!
//! let mut read = ReadProgram::new().on_progress(|progress| eprintln!("{progress}"));
//! let mut more_attempts = 0..5;
//! let program = loop {
//!     match read.run(&station).await {
//!         Err(error) if error.call_error().is_some() && more_attempts.next().is_some() => eprintln!("{error}; going on"),
//!         result => break result?,
//!     }
//! };
//! # assert_eq!(program.ladder_words(), 13184);
//! # Ok(()) });
//! ```
//!
//! States of one run, the first of them again at the beginning of each:
//!
//! ```text
//! Brief (40) ─▶ Status (53) ─▶ Header (page 0) ─▶ Page n … ─▶ [Again n …] ─▶ LastHeader ─▶ LastStatus ─▶ Done
//! ```
//!
//! What must always hold:
//! - Nothing is kept of a page but what a reply to the request for this very page has brought. A check (4E) every 64 pages and in
//!   the end confirms that: if a duplicate of a reply came out of order, what was read since the last check is read again, as often
//!   as reads are retried. Pages that are not confirmed are dropped when a run ends.
//! - The header fits the ladder size of 53; so the number of pages is known before the second is asked for.
//! - Pages of two runs come together only if both are with the same station, by number and endpoint, and the PLC's type, version and ladder size and its page 0 are still the same; and
//!   they are compared once more when all pages are there. A change of one of these is
//!   [`ProgramError::Changed`], and then nothing is kept.
//!
//! A change of other pages, by somebody else at the same time, shows in none of these. [`ReadProgram::twice`] reads all pages
//! again and compares them.
//!
//! # Writing
//!
//! [`Station::write_program`](crate::Station::write_program) and [`WriteProgram`], which tells how far it has come and can be run
//! again:
//!
//! ```text
//! Fit (53) ─▶ Kind (page 0) ─▶ Compare n … ─┬─ nothing differs ─▶ Done
//!                                           ▼
//!            Look (40) ── it runs ─▶ Stop (41) ⇄ Stopped? (40)
//!              │ it is stopped             │ yes
//!              ▼                           ▼
//!            Write n (50) ⇄ ReadBack n (4F) … ─▶ [Verify n …] ─▶ Final (40) ─▶ [Run (41) ⇄ Running? (40)] ─▶ Done
//!
//! a failure:  LastLook (40) ── it runs ─▶ StopAgain (41) ⇄ (40) ─▶ Failed      nothing written, or no answer to it: Failed
//! ```
//!
//! [`WriteProgram::compare`] and [`WriteProgram::dry_run`] end before Look. A dry run fails where the writing would; to a
//! comparison it is no matter whether the PLC runs or has a ROM pack.
//!
//! What must always hold:
//! - Nothing is written, and nothing is stopped, unless the program fits the PLC: size, kind, no ROM pack. The one exception is a
//!   PLC that an earlier run of the same [`WriteProgram`] has left half-written, as below.
//! - Nothing is written before the PLC's status has said that it is stopped.
//! - What was read is acted upon only when a check (4E) has confirmed it: the comparison before the first page is written, each
//!   status, and all pages that were read back before the program is said to be written, and before RUN. If a duplicate of a reply
//!   came out of order, the pages since the last check are compared or read back again, as often as reads are retried.
//! - A page counts as written when it has been read back and is what it should be. A page whose write had no answer, or that
//!   reads back as something else, is written again, a bounded number of times. That is harmless: it is the same page.
//! - RUN is sent only if it was asked for, the PLC ran before and has obeyed a STOP from here, and every page has been found to
//!   be the program's: by the comparison, or when it was read back.
//! - No half-written PLC is left alone after a failure before its status has been asked for once more; if that fails as well,
//!   the error says that it is not known whether the PLC runs.
//! - That a page has been written is forgotten only when all have been found to be the program's, not when a run begins. A PLC
//!   that was left half-written and runs when the next run begins is compared, from a page on that was not written, and stopped
//!   at the first one that differs: [`ProgramError::SetRunning`]. If none differs, somebody else has written the rest, and
//!   nothing is touched. If it cannot be compared, as a request fails, it is stopped, whatever it holds.
//! - What is known of one PLC is not used on another: until a run has ended well, a [`WriteProgram`] goes on with the station that
//!   it was begun with, or fails with [`ProgramError::OtherStation`] before anything is sent.
//! - What a STOP or RUN has done that had no answer is not known until the status has been read; one that was refused, or never
//!   sent, has done nothing.
//! - A page whose write was sent, and which has not been read back since as it should be, is [in doubt](WriteState::in_doubt),
//!   and neither written nor [unwritten](WriteState::unwritten). That holds, too, when the future was dropped:
//!   [`WriteProgram::state`].
//! - So after any failure, a dropped future or a crash between the first page and the last, the PLC is stopped.
//! - That it is still stopped is looked at every 16 pages and at the end. If somebody else has set it running in between, it is
//!   stopped again, if a page has been written, and the writing fails with [`ProgramError::SetRunning`], for two are at work there.
//!
//! **Resuming** needs the program and the PLC, and nothing else: whoever writes the program again, in this process or the
//! next, compares all pages, finds those that were written to be the same, and writes the rest. What a `WriteProgram` that is run again
//! knows besides is whether the PLC ran before it was first stopped, and that it may hold a half.
//!
//! **Order.** The ladder's pages are written in ascending order and the header, page 0, last. So as long as the ladder is
//! not whole, the header is the one from before. Where both headers are the same, which is so for two programs of one
//! PLC, a half-written program is told by nothing but the comparison with the program itself, and by the PLC's own check
//! of the ladder when it is to run (errors 5 and 7). That is why nothing here starts a PLC without having compared.

#[cfg(all(test, feature = "sim"))]
mod bus_time;
mod error;
mod format;
mod header;
mod read;
mod reading;
mod state;
mod write;
mod writing;

use std::fmt;
use std::path::Path;
use std::time::SystemTime;

use crate::command::{BriefStatus, DetailedStatus, PAGE_WORDS, ProgramPage};
use crate::file::{self, FileError, FormatError};

pub use self::error::{InvalidProgram, ProgramAction, ProgramError, WriteProgramError};
pub use self::header::{ProgramHeader, ProgramKind};
pub use self::read::ReadProgram;
pub use self::state::{PlcState, WriteState};
pub use self::write::{WriteOptions, WriteProgram, WriteReport};

/// How many bytes a page has.
const PAGE_BYTES: usize = 2 * PAGE_WORDS;

/// A whole program: the header and all pages of the ladder, and what is known of the PLC that it comes from.
///
/// Its header fits its size, always. Two programs are equal if all their pages are, wherever they come from.
#[derive(Clone)]
pub struct Program {
    header: ProgramHeader,
    /// The header's page first; as many as the header says.
    pages: Vec<ProgramPage>,
    origin: Option<Origin>,
}

/// What a PLC has said of itself when its program was read.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Origin {
    brief: BriefStatus,
    status: DetailedStatus,
    /// In whole seconds, as files have it.
    read_at: SystemTime,
}

impl Program {
    /// A program of these pages, the header first.
    ///
    /// # Errors
    /// [`InvalidProgram`], which names the page and the rule, unless the header is one and as many pages follow as it says.
    pub fn from_pages(pages: Vec<ProgramPage>) -> Result<Self, InvalidProgram> {
        let header = ProgramHeader::parse(pages.first().ok_or(InvalidProgram::Empty)?)?;
        let expected = usize::from(header.page_count());
        if pages.len() == expected {
            Ok(Self { header, pages, origin: None })
        } else {
            Err(InvalidProgram::Pages { found: pages.len(), expected, ladder_words: header.ladder_words() })
        }
    }

    /// A program of the bytes of all its pages and nothing else: what [`to_bytes`](Self::to_bytes) gives.
    ///
    /// # Errors
    /// [`InvalidProgram`], as for [`from_pages`](Self::from_pages), and for a number of bytes that is no number of pages.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, InvalidProgram> {
        let (pages, rest) = bytes.as_chunks::<PAGE_BYTES>();
        if !rest.is_empty() {
            return Err(InvalidProgram::Length { bytes: bytes.len() });
        }
        Self::from_pages(pages.iter().map(ProgramPage::from_bytes).collect())
    }

    /// The bytes of all pages, the header first, the high byte of each word first: 128 for each page.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        self.pages.iter().flat_map(ProgramPage::to_bytes).collect()
    }

    /// What page 0 says.
    #[must_use]
    pub fn header(&self) -> ProgramHeader {
        self.header
    }

    /// The size of the ladder, in words.
    #[must_use]
    pub fn ladder_words(&self) -> u16 {
        self.header.ladder_words()
    }

    /// All pages; the first is the header.
    #[must_use]
    pub fn pages(&self) -> &[ProgramPage] {
        &self.pages
    }

    /// One page; page 0 is the header.
    #[must_use]
    pub fn page(&self, page: u16) -> Option<&ProgramPage> {
        self.pages.get(usize::from(page))
    }

    /// The words of the ladder: as many as the header says, without the header.
    pub fn words(&self) -> impl Iterator<Item = u16> {
        let ladder = self.pages.iter().skip(1).flat_map(|page| page.words().iter().copied());
        ladder.take(self.ladder_words().into())
    }

    /// Which pages differ, in ascending order; a page that only one of the two has does.
    #[must_use]
    pub fn differing_pages(&self, other: &Self) -> Vec<u16> {
        let count = self.header.page_count().max(other.header.page_count());
        (0..count).filter(|&page| self.page(page) != other.page(page)).collect()
    }

    /// The brief status (40) of the PLC when it was read: its capacity and, on older units, its model. `None` if the program
    /// comes from bare pages or bytes.
    #[must_use]
    pub fn brief_status(&self) -> Option<BriefStatus> {
        self.origin.as_ref().map(|origin| origin.brief)
    }

    /// The detailed status (53) of the PLC when it was read. `None` if the program comes from bare pages or bytes.
    #[must_use]
    pub fn status(&self) -> Option<&DetailedStatus> {
        self.origin.as_ref().map(|origin| &origin.status)
    }

    /// When it was read, by the clock of the computer that did, in whole seconds. `None` if it comes from bare pages or bytes.
    #[must_use]
    pub fn read_at(&self) -> Option<SystemTime> {
        self.origin.as_ref().map(|origin| origin.read_at)
    }

    /// The content of a file with this program: text with pages as hexadecimal digits, time, status, length and a checksum.
    #[must_use]
    pub fn to_file(&self) -> String {
        format::write(self)
    }

    /// The program in the content of a file.
    ///
    /// # Errors
    /// [`FormatError`] for anything but exactly what [`to_file`](Self::to_file) has made: a foreign file, a later version, one
    /// that is cut off, one in which a bit has changed.
    pub fn from_file(content: &[u8]) -> Result<Self, FormatError> {
        format::read(content)
    }

    /// Saves it. What was in the file before is there until all of the new is on the disk, and then none of it is.
    ///
    /// This waits for the disk.
    ///
    /// # Errors
    /// [`FileError`]; the file is as it was before.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), FileError> {
        file::save(path.as_ref(), self.to_file().as_bytes())
    }

    /// Loads what [`save`](Self::save) has saved. This waits for the disk.
    ///
    /// # Errors
    /// [`FileError`], which names the file and what is wrong with it.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, FileError> {
        file::load_as(path.as_ref(), Self::from_file)
    }

    /// Saves [its bytes](Self::to_bytes) and nothing else, for other tools. Such a file has no checksum.
    ///
    /// # Errors
    /// [`FileError`]; the file is as it was before.
    pub fn save_raw(&self, path: impl AsRef<Path>) -> Result<(), FileError> {
        file::save(path.as_ref(), &self.to_bytes())
    }

    /// Loads a file of bytes and nothing else.
    ///
    /// # Errors
    /// [`FileError`], which names the file and what is wrong with it. That its bytes are those that were saved, nobody can
    /// say: only the header and the length are checked.
    pub fn load_raw(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let path = path.as_ref();
        let content = file::load(path)?;
        let invalid = |error: InvalidProgram| FormatError::Content { rule: error.to_string() };
        let program = Self::from_bytes(&content).map_err(invalid);
        program.map_err(|source| FileError::Format { path: path.to_owned(), source })
    }

    fn with_origin(self, origin: Origin) -> Self {
        Self { origin: Some(origin), ..self }
    }
}

impl PartialEq for Program {
    fn eq(&self, other: &Self) -> bool {
        self.pages == other.pages
    }
}

impl Eq for Program {}

impl fmt::Debug for Program {
    /// Without the pages, which are many.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Program").field("header", &self.header).field("origin", &self.origin).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests;
