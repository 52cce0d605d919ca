//! Registers and discretes: read, saved, compared, written back.
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::backup::{Backup, RestoreOptions};
//!
//! let ranges = ["R0-R299", "D0-D99", "M0-M1911"].map(|range| range.parse().unwrap());
//! let backup = station.back_up(ranges).await?;
//! assert!(backup.is_complete());
//! let file = backup.to_file(); // or backup.save("plant.backup")?
//! assert_eq!(Backup::from_file(file.as_bytes())?, backup);
//!
//! station.write_registers(fatek::register!("R7"), &[1]).await?;
//! let report = station.restore(&backup, RestoreOptions::new()).await?; // writes what differs, and reads it back
//! assert_eq!(report.written, ["R7".parse()?]);
//! # Ok(()) });
//! ```
//!
//! A range is a [`Tag`]: `R0-R3839`, `DR0-DR98`, `M0-M1911`, `WM0-WM96`. Of its type only one thing matters: whether a value
//! takes two registers, as in `R0-R9:f32`. Such pairs, like the elements of 32 bits, are never split between two requests, are
//! written whole where one half differs, and where the PLC refuses one half, the whole is missing. Two
//! ranges of a backup must not share memory, as `R0-R9` and `DR4` would.
//!
//! # What a backup is
//!
//! For each element of its ranges it has a value that the PLC has answered, or the reason why there is none: a [`Missing`].
//! Nothing that could not be read is ever a zero. A request that the PLC refuses is taken apart until the elements that it does
//! not give are found; all others are read.
//!
//! **Values are not of one moment.** A request brings up to 64 registers or 256 discretes from one scan of the PLC, and the next
//! comes from a later one. If the values must fit together, stop the PLC before, or have its program hold them still.
//!
//! [`Station::back_up`](crate::Station::back_up) reads it in one go. [`TakeBackup`] does the same, tells how far it has come, and
//! goes on after a failure or when its future has been dropped. Its states are the cells of the backup: what is
//! [`NotRead`](Missing::NotRead) is still to be read. A cell has a value only when a check has confirmed that the reply was no
//! duplicate out of order.
//!
//! # What is restored
//!
//! [`Station::restore`](crate::Station::restore), and [`Restore`], which tells how far it has come, can compare without writing,
//! and can be run again:
//!
//! ```text
//! Look (40) ─▶ Compare (44, 46) … ─▶ Forced? (43) … ─▶ [Ready (40)] ─▶ Write (45, 47) … ─▶ Verify (44, 46) … ─┐
//!                 ▲                       something │ │ runs                │  ▲                                 │
//!                 │ it has stopped     differs, and │ │ now                 │  │ what still differs              │
//!                 │                   it is to stop ▼ ▼                     ▼  │                                 ▼
//!         Stopped? (40) ⇄ Stop (41) ◀───────────────┴─┘      Check (44, 46), if there was no answer     [Last look (40)]
//!                                                                                                                │
//!                                                             Done ◀─ [Running? (40) ⇄ Run (41)] ◀───────────────┘
//! ```
//!
//! Inputs are the replies of the PLC and the options. What must always hold:
//! - Only values are written that are in the backup and were found to differ from it. Elements that are missing in
//!   the backup are neither read nor written; [`RestoreReport::missing`] names them. By choice ([`RestoreOptions::bridge`]) equal elements of the backup between two
//!   that differ are written, too, where that saves a request.
//! - Nothing is written before all has been compared, and unless the PLC gives all elements.
//! - Compare, Forced, Check and Verify are left only when a check (4E) has confirmed that no reply was a duplicate out of order;
//!   if one was, they begin again, as often as reads are retried. Writes among which such a duplicate came are in doubt until
//!   Verify has read them back.
//! - A write that had no answer is not repeated before a read has shown that it still differs. Until it is settled, its elements
//!   are [`in_doubt`](RestoreReport::in_doubt), and not among those that were never sent.
//! - An element counts as written when the PLC has confirmed that, or a read has shown it.
//! - When something was written, all is read once more. Success means: at that reading each element held what the backup holds,
//!   save those that were left out. What did not stick, because a running program has its own mind, is an error that names
//!   it.
//! - A PLC is stopped only by choice, and only when something is to be written and the PLC has all of it; then all is compared
//!   again. It is run again only by choice, if it ran before, and if all has been restored.
//! - One that is to stand still ([`stop_first`](RestoreOptions::stop_first),
//!   [`require_stopped`](RestoreOptions::require_stopped)) is looked at just before the first write, and once more when all is
//!   read back. Success means that it was stopped both times; if somebody has set it running, that is
//!   [`SetRunning`](RestoreFailure::SetRunning), and it is left so.
//!
//! Running it again continues, in this process or another: what is written already does not differ any more.
//!
//! **What is left out.** Inputs `X` and the contacts `T` and `C` of timers and counters, also as words: what is written there is
//! overwritten in the next scan. They are in a backup for comparing, and [`RestoreReport::left_out`] names them. All else can be
//! restored: outputs `Y`, relays `M`, steps `S`, the values `RT` and `RC` of timers and counters, registers `R`, `D`, `F`. Think
//! before you include some: outputs switch what is wired to them, even in a stopped PLC; and special relays and registers
//! (by model, such as `M1912` on, `R3840` on) have effects of their own, or cannot be written.
//!
//! **Forced discretes.** A discrete that is disabled (42) was forced to its state by somebody, perhaps for their safety. It stays
//! as it is, and [`RestoreReport::forced`] names it; so does a word, or a value of two, with such a discrete in it. To write it all the same there is
//! [`RestoreOptions::write_forced`].

mod block;
mod error;
mod format;
mod held;
mod report;
mod restore;
mod restoring;
mod take;
mod target;

use std::fmt;
use std::path::Path;
use std::time::SystemTime;

pub use self::error::{BackupError, InvalidBackup, RestoreError, RestoreFailure};
pub use self::report::{RefusedRange, RestoreReport};
pub use self::restore::{Restore, RestoreOptions};
pub use self::take::TakeBackup;

use self::block::{Block, check_overlaps, part, plain, runs};
use crate::command::{BriefStatus, DetailedStatus, Value};
use crate::element::Element;
use crate::error::ErrorCode;
use crate::file::{self, FileError, FormatError};
use crate::tag::Tag;

/// What ranges of registers and discretes held, and what is known of the PLC that it comes from.
///
/// See [the module](self).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Backup {
    origin: Origin,
    blocks: Vec<Block>,
}

/// What is known of the PLC and of the reading; nothing before it began.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Origin {
    station: Option<u8>,
    /// In whole seconds, as files have it.
    read_at: Option<SystemTime>,
    brief: Option<BriefStatus>,
    detailed: Option<DetailedStatus>,
}

/// Why there is no value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Missing {
    /// It has not been read, because the reading was broken off.
    NotRead,
    /// The PLC has refused to give it.
    Refused(ErrorCode),
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotRead => f.write_str("not read"),
            Self::Refused(error) => write!(f, "refused: {error}"),
        }
    }
}

/// Consecutive elements that are missing for one reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct MissingRange {
    /// Which ones.
    pub range: Tag,
    /// Why.
    pub reason: Missing,
}

/// An element that does not hold what it should.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Difference {
    /// Which one.
    pub element: Element,
    /// What it should hold.
    pub expected: Value,
    /// What it holds; `None` if that is not known.
    pub found: Option<Value>,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { element, expected, found } = self;
        match found {
            Some(found) => write!(f, "{element}: {found}, where {expected} was expected"),
            None => write!(f, "{element}: not known, where {expected} was expected"),
        }
    }
}

impl Backup {
    /// A backup of these ranges, of which nothing has been read yet.
    ///
    /// # Errors
    /// [`InvalidBackup::Empty`] and [`InvalidBackup::Overlap`].
    pub fn of(ranges: impl IntoIterator<Item = Tag>) -> Result<Self, InvalidBackup> {
        let ranges: Vec<Tag> = ranges.into_iter().map(plain).collect();
        if ranges.is_empty() {
            return Err(InvalidBackup::Empty);
        }
        check_overlaps(&ranges)?;
        Ok(Self { origin: Origin::default(), blocks: ranges.into_iter().map(Block::new).collect() })
    }

    /// Its ranges, in the order in which they were given. Those of pairs have the type `u32`.
    pub fn ranges(&self) -> impl Iterator<Item = Tag> {
        self.blocks.iter().map(|block| block.range)
    }

    /// All its elements, range by range.
    pub fn elements(&self) -> impl Iterator<Item = (Element, Result<Value, Missing>)> {
        self.blocks.iter().flat_map(Block::elements)
    }

    /// How many elements it has.
    #[must_use]
    pub fn element_count(&self) -> usize {
        self.blocks.iter().map(|block| block.cells.len()).sum()
    }

    /// What an element held; `None` if it is in none of the ranges, by this name.
    #[must_use]
    pub fn value(&self, element: impl Into<Element>) -> Option<Result<Value, Missing>> {
        let element = element.into();
        self.blocks.iter().find_map(|block| block.cells.get(block.place(element)?).copied())
    }

    /// What is missing, and why.
    #[must_use]
    pub fn missing(&self) -> Vec<MissingRange> {
        let mut missing = Vec::new();
        for block in &self.blocks {
            for run in runs(&block.cells, Result::is_err) {
                let cells = block.cells.get(run.clone()).unwrap_or_default();
                let mut start = run.start;
                for same in cells.chunk_by(|one, next| one == next) {
                    let end = start.saturating_add(same.len());
                    if let Some(&Err(reason)) = same.first() {
                        missing.push(MissingRange { range: part(block.range, &(start..end)), reason });
                    }
                    start = end;
                }
            }
        }
        missing
    }

    /// Whether nothing is missing.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.value_count() == self.element_count()
    }

    /// How many elements have a value.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.blocks.iter().flat_map(|block| &block.cells).filter(|cell| cell.is_ok()).count()
    }

    /// The same backup, with these parts of it alone.
    ///
    /// # Errors
    /// [`InvalidBackup::NotIn`] for a range that is not wholly within one of its own, [`InvalidBackup::SplitsPair`] where a value
    /// of two registers would be in it by half; [`InvalidBackup::Empty`] and [`InvalidBackup::Overlap`].
    pub fn select(&self, ranges: impl IntoIterator<Item = Tag>) -> Result<Self, InvalidBackup> {
        let mut selected = Vec::new();
        for range in ranges {
            let cells = self.blocks.iter().find_map(|block| {
                let start = block.place(range.first())?;
                let end = start.checked_add(range.element_count())?;
                Some((block.range, start, block.cells.get(start..end)?.to_vec()))
            });
            let (whole, start, cells) = cells.ok_or(InvalidBackup::NotIn { range })?;
            let per_value = whole.elements_per_value();
            if !start.is_multiple_of(per_value) || !cells.len().is_multiple_of(per_value) {
                return Err(InvalidBackup::SplitsPair { range, whole });
            }
            let range = Tag::spanning(range.first(), whole.tag_type(), cells.len()).unwrap_or(range);
            selected.push(Block { range, cells });
        }
        if selected.is_empty() {
            return Err(InvalidBackup::Empty);
        }
        check_overlaps(&selected.iter().map(|block| block.range).collect::<Vec<_>>())?;
        Ok(Self { origin: self.origin.clone(), blocks: selected })
    }

    /// Where the other one does not hold what this one holds. What is missing here is not compared; what is missing there, or
    /// not in its ranges by the same name, is a difference.
    #[must_use]
    pub fn differences(&self, other: &Self) -> Vec<Difference> {
        let known = self.elements().filter_map(|(element, cell)| Some((element, cell.ok()?)));
        let compared = known.map(|(element, expected)| {
            let found = other.value(element).and_then(Result::ok);
            Difference { element, expected, found }
        });
        compared.filter(|difference| difference.found != Some(difference.expected)).collect()
    }

    /// The station number of the PLC that it was read from; `None` if nothing has been read.
    #[must_use]
    pub fn station(&self) -> Option<u8> {
        self.origin.station
    }

    /// When the reading began, by the clock of the computer that did it, in whole seconds.
    #[must_use]
    pub fn read_at(&self) -> Option<SystemTime> {
        self.origin.read_at
    }

    /// The brief status (40) of the PLC when the reading began.
    #[must_use]
    pub fn brief_status(&self) -> Option<BriefStatus> {
        self.origin.brief
    }

    /// The detailed status (53) of the PLC when the reading began; `None`, too, if the PLC does not have it.
    #[must_use]
    pub fn status(&self) -> Option<&DetailedStatus> {
        self.origin.detailed.as_ref()
    }

    /// The content of a file with this backup: text, which people can read and tools can compare.
    ///
    /// ```text
    /// fatek file 1: backup
    /// length 257
    /// station 1
    /// read 2026-11-22T07:09:13Z
    /// about RUN                                         what the next two mean, for people
    /// brief 015400                                      the bytes of 40, or `-`
    /// status -                                          the bytes of 53, or `-`
    /// range R0-R9
    /// R0 0001 0002 00FF 0000 0000 0000 0000 0000        eight registers a line, in hexadecimal digits
    /// missing R8-R9 refused A
    /// range M0-M15
    /// M0 00000000 00000001                              64 discretes a line, the first one first
    /// crc32 1A2B3C4D
    /// ```
    #[must_use]
    pub fn to_file(&self) -> String {
        format::write(self)
    }

    /// The backup in the content of a file.
    ///
    /// # Errors
    /// [`FormatError`], which names the line and the rule, for anything but exactly what [`to_file`](Self::to_file) has made: a
    /// foreign file, a later version, one that is cut off, one in which a bit has changed.
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
}

#[cfg(test)]
mod tests;
