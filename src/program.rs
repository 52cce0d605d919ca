//! Whole programs: read, save, compare and write them.
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
//! let report = station.write_program(&program, WriteOptions::new().stop_first(true).run_again(true)).await?;
//! assert!(report.written.is_empty());
//! # Ok(()) });
//! ```
//!
//! Programs are transferred in the ASCII framing only. In the binary framing all of this fails with
//! [`InvalidRequest::NotInFraming`](crate::command::InvalidRequest::NotInFraming) before anything is
//! sent.
//!
//! # Reading
//!
//! [`Station::read_program`](crate::Station::read_program) reads a program in one run.
//! [`ReadProgram`] also reports progress, and continues after a failure or a dropped future:
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::program::ReadProgram;
//!
//! let mut read = ReadProgram::new().on_progress(|progress| eprintln!("{progress}"));
//! let mut more_attempts = 0..5;
//! let program = loop {
//!     match read.run(&station).await {
//!         Err(error) if error.call_error().is_some() && more_attempts.next().is_some() => eprintln!("{error}"),
//!         result => break result?,
//!     }
//! };
//! # assert_eq!(program.ladder_words(), 13184);
//! # Ok(()) });
//! ```
//!
//! Every run goes through these stages:
//!
//! ```text
//! Brief (40) ─▶ Status (53) ─▶ Header (page 0) ─▶ Page n … ─▶ [Behind ─▶ Before] ─▶ [Again n …]
//!                                                                                       │
//!                     Done ◀─ LastStatus ◀─ [StillRefused] ◀─ LastHeader ◀──────────────┘
//! ```
//!
//! Invariants:
//! - A page is the reply to a request for this very page. A check (4E) every 64 pages and at the end
//!   confirms that. If an out-of-order duplicate came, the pages since the last check are read again,
//!   as often as reads are retried. Pages that are not confirmed are dropped when a run ends.
//! - The header fits the ladder size of 53, so the number of pages is known before page 1 is read.
//!   An FBs can state more than it has: the first page from page 2 on that it refuses with error 2 or A
//!   ends the ladder, if it refuses the last page, too, has the page before, and refuses the page still
//!   when all others are read. The program says so ([`Program::refused_page`]).
//! - Pages of two runs are combined only if both runs are with the same station, by number and
//!   endpoint, and the PLC's type, version, ladder size and page 0 are equal. They are compared once
//!   more when all pages are read. A change is [`ProgramError::Changed`], and nothing is kept then.
//!
//! A change of other pages by another client at the same time shows in none of these.
//! [`ReadProgram::twice`] reads all pages again and compares them.
//!
//! # Writing
//!
//! [`Station::write_program`](crate::Station::write_program) writes a program in one run.
//! [`WriteProgram`] also reports progress, and can be run again:
//!
//! ```text
//! Fit (53) ─▶ Kind (page 0) ─▶ Compare n … ─┬─ no page differs ─▶ Done
//!                                           ▼
//!            Look (40) ── it runs ─▶ Stop (41, 40)
//!              │ it is stopped         │ it has stopped
//!              ▼                       ▼
//!            Write n (50) ⇄ ReadBack n (4F) … ─▶ [Verify n …] ─▶ Look (40) ─▶ [Run (41, 40)] ─▶ Done
//!
//! a failure:  half-written ─▶ Secure (40, and if it runs: 41, 40) ─▶ Failed        otherwise ─▶ Failed
//! ```
//!
//! [`WriteProgram::compare`] and [`WriteProgram::dry_run`] end before Look. A dry run fails where
//! writing would fail. A comparison ignores whether the PLC runs or has a ROM pack.
//!
//! Invariants:
//! - Nothing is written or stopped unless the program fits the PLC: size, kind, no ROM pack, and model and
//!   OS version of the PLC that it was read from, unless [`WriteOptions::accept_other_plc`] is chosen. The
//!   exception is a PLC that an earlier run of the same [`WriteProgram`] has left half-written.
//! - Nothing is written before the status of the PLC has shown that it is stopped.
//! - Replies are used only when a check (4E) has confirmed them: the comparison before the first
//!   write, every status, and all pages that were read back before success and before RUN. If an
//!   out-of-order duplicate came, the pages since the last check are compared or read back again, as
//!   often as reads are retried.
//! - A page counts as written when it reads back correctly. A page whose write had no reply, or that
//!   reads back differently, is written again, a bounded number of times. This is harmless: the
//!   content is the same.
//! - RUN is sent only if it was requested, the PLC ran before and obeyed a STOP of this transfer, and
//!   every page was found equal, in the comparison or when it was read back.
//! - After a failure the status of a half-written PLC is read once more, and a PLC that runs is
//!   stopped. If that fails as well, the error says that the state of the PLC is not known.
//! - That a page was written is forgotten when all pages are found equal, not when a run begins. If a
//!   PLC was left half-written and runs when the next run begins, the comparison starts with a page
//!   that was not written, and the PLC is stopped at the first page that differs:
//!   [`ProgramError::SetRunning`]. If no page differs, another client has written the rest, and the
//!   PLC keeps running. If a request of the comparison fails, the PLC is stopped.
//! - Until a run succeeds, a [`WriteProgram`] continues with the station of its first run, or fails
//!   with [`ProgramError::OtherStation`] before anything is sent.
//! - The effect of a STOP or RUN without a reply is not known until the status has been read. One
//!   that was refused, or never sent, had no effect.
//! - A page that was sent and has not been read back correctly since is
//!   [in doubt](WriteState::in_doubt), neither written nor [unwritten](WriteState::unwritten), also
//!   after a dropped future: [`WriteProgram::state`].
//! - So after any failure, dropped future or crash between the first page and the last, the PLC is
//!   stopped.
//! - The status is read every 16 pages and at the end. If another client has started the PLC, it is
//!   stopped again, if a page was written, and writing fails with [`ProgramError::SetRunning`].
//!
//! **Resuming** needs the program and the PLC only. Writing the program again, from any process,
//! compares all pages, finds the written ones equal, and writes the rest. A [`WriteProgram`] that is
//! run again also knows whether the PLC ran before it was first stopped, and whether it may be
//! half-written.
//!
//! **Order.** The pages of the ladder are written in ascending order and the header, page 0, last, so
//! the header is the old one until the ladder is complete. If both headers are equal, as in two
//! programs for one PLC, only a comparison shows a half-written program, or the PLC's own check of
//! the ladder at RUN (errors 5 and 7). Therefore no PLC is started without a comparison.

#[cfg(all(test, feature = "sim"))]
mod bus_time;
mod error;
mod format;
mod header;
mod options;
mod read;
mod reading;
mod write;
mod write_state;
mod writing;

use std::fmt;
use std::path::Path;

use crate::command::{DetailedStatus, PAGE_WORDS, ProgramPage};
use crate::error::{Error, ErrorCode};
use crate::file::{self, FileError, FormatError, Origin, PlcDifference, file_methods, model_differences};

pub use self::error::{InvalidProgram, ProgramAction, ProgramError, WriteProgramError};
pub use self::header::{ProgramHeader, ProgramKind};
pub use self::options::WriteOptions;
pub use self::read::ReadProgram;
pub use self::write::WriteProgram;
pub use self::write_state::{WriteReport, WriteState};
pub use crate::transfer::PlcState;

/// Bytes of a page.
const PAGE_BYTES: usize = 2 * PAGE_WORDS;

/// The fewest pages of a program whose other pages were refused: the header and a page of the ladder.
const MIN_PAGES: usize = 2;

/// Returns whether a refusal of a page may mean that the memory of the PLC has no such page.
fn ends_the_ladder(refusal: &Error) -> bool {
    matches!(refusal.error_code(), Some(ErrorCode::IllegalAddress | ErrorCode::IllegalValue))
}

/// A whole program: the header, all pages of the ladder, and the status of the PLC it was read from.
///
/// The header fits the number of pages, unless the PLC [refused](Self::refused_page) the pages behind
/// them. Two programs are equal if all their pages are.
#[derive(Clone)]
pub struct Program {
    header: ProgramHeader,
    /// The header first; the number of pages that the header requires, or fewer that a PLC had.
    pages: Vec<ProgramPage>,
    /// All of its fields are known, or none.
    origin: Origin,
    unknown_fields: Vec<String>,
}

file_methods! {
    Program, "program",
    /// The content of a file with this program: text with the pages as hexadecimal digits, time,
    /// status, length and checksum.
}

impl Program {
    /// Makes a program of these pages, the header first.
    ///
    /// # Errors
    /// [`InvalidProgram`], which names the page and the rule: page 0 is not a header, or the number of
    /// pages is not the one that it requires.
    pub fn from_pages(pages: Vec<ProgramPage>) -> Result<Self, InvalidProgram> {
        let header = ProgramHeader::parse(pages.first().ok_or(InvalidProgram::Empty)?)?;
        let expected = usize::from(header.page_count());
        if pages.len() == expected {
            Ok(Self { header, pages, origin: Origin::default(), unknown_fields: Vec::new() })
        } else {
            Err(InvalidProgram::Pages { found: pages.len(), expected, ladder_words: header.ladder_words() })
        }
    }

    /// Makes a program of the pages of a PLC, which may have refused those behind them.
    pub(crate) fn from_plc(pages: Vec<ProgramPage>) -> Result<Self, InvalidProgram> {
        let header = ProgramHeader::parse(pages.first().ok_or(InvalidProgram::Empty)?)?;
        // A header and a page of the ladder.
        if (MIN_PAGES..usize::from(header.page_count())).contains(&pages.len()) {
            return Ok(Self { header, pages, origin: Origin::default(), unknown_fields: Vec::new() });
        }
        Self::from_pages(pages)
    }

    /// Makes a program of the bytes of all its pages, as [`to_bytes`](Self::to_bytes) returns them.
    ///
    /// # Errors
    /// [`InvalidProgram`], as for [`from_pages`](Self::from_pages), or if the bytes are not whole pages.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, InvalidProgram> {
        let (pages, rest) = bytes.as_chunks::<PAGE_BYTES>();
        if !rest.is_empty() {
            return Err(InvalidProgram::Length { bytes: bytes.len() });
        }
        Self::from_pages(pages.iter().map(ProgramPage::from_bytes).collect())
    }

    /// The bytes of all pages, the header first, 128 per page, the high byte of each word first.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        self.pages.iter().flat_map(ProgramPage::to_bytes).collect()
    }

    /// Page 0.
    #[must_use]
    pub fn header(&self) -> ProgramHeader {
        self.header
    }

    /// The first page that the PLC refused, although its ladder should have it; `None` for a whole program.
    ///
    /// The memory of an FBs may end before the size that it states. Such a program is written only to a PLC
    /// that refuses this page, too.
    #[must_use]
    pub fn refused_page(&self) -> Option<u16> {
        let count = self.page_count();
        (count < self.header.page_count()).then_some(count)
    }

    /// The number of pages, the header included: those of [`pages`](Self::pages).
    pub(crate) fn page_count(&self) -> u16 {
        // At most 1025.
        u16::try_from(self.pages.len()).unwrap_or(u16::MAX)
    }

    /// Size of the ladder in words, as the header states it.
    #[must_use]
    pub fn ladder_words(&self) -> u16 {
        self.header.ladder_words()
    }

    /// All pages, the header first.
    #[must_use]
    pub fn pages(&self) -> &[ProgramPage] {
        &self.pages
    }

    /// One page; page 0 is the header.
    #[must_use]
    pub fn page(&self, page: u16) -> Option<&ProgramPage> {
        self.pages.get(usize::from(page))
    }

    /// The words of the ladder, as many as the header states, or those before the [refused
    /// page](Self::refused_page).
    pub fn words(&self) -> impl Iterator<Item = u16> {
        let ladder = self.pages.iter().skip(1).flat_map(|page| page.words().iter().copied());
        ladder.take(self.ladder_words().into())
    }

    /// The pages that differ, in ascending order, with those that only one of the programs has.
    #[must_use]
    pub fn differing_pages(&self, other: &Self) -> Vec<u16> {
        let count = self.page_count().max(other.page_count());
        (0..count).filter(|&page| self.page(page) != other.page(page)).collect()
    }

    /// The differences of model and operating system between the PLC that the program was read from and
    /// one with this status. Empty if that PLC is not known, as for a raw file.
    #[must_use]
    pub fn plc_differences(&self, status: &DetailedStatus) -> Vec<PlcDifference> {
        self.status().map(|file| model_differences(file, status)).unwrap_or_default()
    }

    /// Saves the [bytes](Self::to_bytes) alone, for other tools. Such a file has no checksum. One without
    /// the pages that a PLC [refused](Self::refused_page) cannot be loaded again.
    ///
    /// # Errors
    /// [`FileError`]; the file is as it was before.
    pub fn save_raw(&self, path: impl AsRef<Path>) -> Result<(), FileError> {
        file::save(path.as_ref(), &self.to_bytes())
    }

    /// Loads a file of [`save_raw`](Self::save_raw). Only header and length are checked: a change of
    /// other bytes is not found.
    ///
    /// # Errors
    /// [`FileError`], which names the file and the fault.
    pub fn load_raw(path: impl AsRef<Path>) -> Result<Self, FileError> {
        file::load_as(path.as_ref(), |content| Self::from_bytes(content).map_err(FormatError::content))
    }
}

impl PartialEq for Program {
    fn eq(&self, other: &Self) -> bool {
        self.pages == other.pages
    }
}

impl Eq for Program {}

impl fmt::Debug for Program {
    /// Without the pages, of which there may be 1025.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Program").field("header", &self.header).field("origin", &self.origin).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests;
