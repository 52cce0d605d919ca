//! Registers and discretes: read, save, compare and restore them.
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
//! let report = station.restore(&backup, RestoreOptions::new()).await?; // writes and verifies R7
//! assert_eq!(report.written, ["R7".parse()?]);
//! # Ok(()) });
//! ```
//!
//! A range is a [`Tag`]: `R0-R3839`, `DR0-DR98`, `M0-M1911`, `WM0-WM96`. Of its type only one thing
//! matters: how many registers a value takes, such as two in `R0-R9:f32`. Such values, like elements
//! of 32 bits, are never split between two requests. They are written whole if a part differs, and
//! missing if the PLC refuses a part. Two ranges of a backup must not share memory, as `R0-R9`
//! and `DR4` would.
//!
//! # Contents
//!
//! Each element of the ranges has a value from a reply of the PLC, or the reason why it has none: a
//! [`Missing`]. An element that could not be read is never zero. A request that the PLC refuses is
//! halved until the refused elements are found; all others are read. Requests are no longer than the
//! declared [capabilities](crate::capabilities) of the station allow.
//!
//! **Values are not of one moment.** A request reads up to 64 registers or 256 discretes of one
//! scan cycle, and the next request reads a later one. If values must be consistent, stop the PLC
//! before, or have its program hold them.
//!
//! [`Station::back_up`](crate::Station::back_up) reads a backup in one run. [`TakeBackup`] also
//! reports progress, and continues after a failure or a dropped future. Its states are the cells of
//! the backup: those that are [`NotRead`](Missing::NotRead) are still to be read. A cell has a
//! value only when a check (4E) has confirmed that the reply was no out-of-order duplicate.
//!
//! # Restoring
//!
//! [`Station::restore`](crate::Station::restore) restores a backup in one run. [`Restore`] also
//! reports progress, compares without writing, and can be run again:
//!
//! ```text
//! Look (40) ─▶ Compare (44, 46) … ─▶ Forced (43) … ─▶ [Ready (40)] ─▶ Write (45, 47) … ─▶ Verify (44, 46) … ─┐
//!                 ▲                  elements differ,  │ it runs       │  ▲                                  │
//!                 │ it has stopped    PLC is to stop   ▼ now           ▼  │ elements that still differ       ▼
//!            Stop (41, 40) ◀─────────────────────────────     Check (44, 46), if there was no reply  [LastLook (40)]
//!                                                                                                            │
//!                                                              Done ◀─ [Run (41, 40)] ◀──────────────────────┘
//! ```
//!
//! Inputs are the replies of the PLC and the options. Invariants:
//! - Only elements with a value in the backup that were found different are written. Elements that
//!   are missing in the backup are neither read nor written; [`RestoreReport::missing`] names them.
//!   With [`RestoreOptions::bridge`], equal elements between two that differ are written too, if
//!   that saves a request.
//! - Nothing is written before all elements have been compared, and unless the PLC has all of them.
//! - Compare, Forced, Check and Verify end only when a check (4E) has confirmed that no reply was
//!   an out-of-order duplicate. If one was, they begin again, as often as reads are retried. Writes
//!   with such a duplicate among their replies are in doubt until Verify has read them back.
//! - A write without a reply is repeated only after a read has shown that the elements still
//!   differ. Until then they are [`in_doubt`](RestoreReport::in_doubt), and not among those never
//!   sent.
//! - An element counts as written when the PLC has confirmed the write, or a read has shown it.
//! - If a write was sent, all elements are read back. Success means that each element then held its
//!   value, except those that were left out. Elements overwritten by the running program are
//!   reported as errors.
//! - A backup is restored only to the PLC that it states, by station number, model and version of
//!   the operating system, unless [`RestoreOptions::accept_other_plc`] is chosen. Each run reads
//!   the status (40, 53) first to find out.
//! - A PLC is stopped only by option, and only if an element is to be written and the PLC has all
//!   elements; all are compared again then. It is started again only by option, if it ran before,
//!   and if all elements are restored.
//! - With [`stop_first`](RestoreOptions::stop_first) and
//!   [`require_stopped`](RestoreOptions::require_stopped) the status is read just before the first
//!   write and after Verify. Success means that the PLC was stopped both times. If another client
//!   has started it, that is [`SetRunning`](RestoreFailure::SetRunning), and the PLC keeps running.
//!
//! Running it again continues, in this process or another: elements that are written no longer
//! differ.
//!
//! **Elements that are left out.** Inputs `X` and the contacts `T` and `C` of timers and counters,
//! also as words, are overwritten in every scan cycle. A backup has them for comparing;
//! [`RestoreReport::left_out`] names them. All others can be restored: outputs `Y`, relays `M`,
//! steps `S`, the values `RT` and `RC` of timers and counters, registers `R`, `D`, `F`. Select them
//! with care: outputs switch what is wired to them, even in a stopped PLC, and special relays and
//! registers (by model, such as from `M1912` and `R3840` on) have effects of their own, or are
//! read-only.
//!
//! **Forced discretes.** A disabled discrete (42) was forced to its state, perhaps for safety. It
//! stays as it is, and [`RestoreReport::forced`] names it, and words and values of several words with
//! such a discrete. [`RestoreOptions::write_forced`] writes them.

mod block;
mod error;
mod format;
mod options;
mod report;
mod restore;
mod restoring;
mod take;
mod taking;
mod target;

use std::fmt;

pub use self::error::{BackupError, InvalidBackup, RestoreError, RestoreFailure};
pub use self::options::{RestoreOptions, SpecialElements};
pub use self::report::{RefusedRange, RestoreReport};
pub use self::restore::Restore;
pub use self::take::TakeBackup;
pub use crate::transfer::PlcState;

use self::block::{Block, check_overlaps, check_whole, part, plain, runs_by};
use crate::command::Value;
use crate::element::Element;
use crate::error::ErrorCode;
use crate::file::{Origin, file_methods};
use crate::tag::Tag;

/// Values of ranges of registers and discretes, and the status of the PLC they were read from.
///
/// See [the module](self).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Backup {
    /// `None` before reading.
    station: Option<u8>,
    origin: Origin,
    blocks: Vec<Block>,
    unknown_fields: Vec<String>,
}

/// Why an element has no value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Missing {
    /// It has not been read: reading ended before.
    NotRead,
    /// The PLC refused to read it.
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

/// Consecutive elements that are missing for the same reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct MissingRange {
    /// The elements.
    pub range: Tag,
    /// Why they are missing.
    pub reason: Missing,
}

/// An element that does not hold the expected value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Difference {
    /// The element.
    pub element: Element,
    /// The expected value.
    pub expected: Value,
    /// The value that it holds; `None` if that is not known.
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
    /// Makes a backup of these ranges, in which no element has been read.
    ///
    /// # Errors
    /// [`InvalidBackup::Empty`], [`InvalidBackup::BitsOfRegister`] and [`InvalidBackup::Overlap`].
    pub fn of(ranges: impl IntoIterator<Item = Tag>) -> Result<Self, InvalidBackup> {
        let whole = |range| check_whole(range).map(|()| plain(range));
        let ranges: Vec<Tag> = ranges.into_iter().map(whole).collect::<Result<_, _>>()?;
        if ranges.is_empty() {
            return Err(InvalidBackup::Empty);
        }
        check_overlaps(&ranges)?;
        let blocks = ranges.into_iter().map(Block::new).collect();
        Ok(Self { station: None, origin: Origin::default(), blocks, unknown_fields: Vec::new() })
    }

    /// Its ranges, in the given order. Those with values of several registers have the type `u32` or
    /// `u64`.
    pub fn ranges(&self) -> impl Iterator<Item = Tag> {
        self.blocks.iter().map(|block| block.range)
    }

    /// All its elements, range by range.
    pub fn elements(&self) -> impl Iterator<Item = (Element, Result<Value, Missing>)> {
        self.blocks.iter().flat_map(Block::elements)
    }

    /// Number of elements.
    #[must_use]
    pub fn element_count(&self) -> usize {
        self.blocks.iter().map(|block| block.cells.len()).sum()
    }

    /// The value of an element; `None` if no range has it under this symbol.
    #[must_use]
    pub fn value(&self, element: impl Into<Element>) -> Option<Result<Value, Missing>> {
        let element = element.into();
        self.blocks.iter().find_map(|block| block.cells.get(block.index(element)?).copied())
    }

    /// Elements that are missing, and why.
    #[must_use]
    pub fn missing(&self) -> Vec<MissingRange> {
        let of_block = |block: &Block| {
            let range = block.range;
            let runs = runs_by(&block.cells, |cell| cell.err()).into_iter();
            runs.map(move |(run, reason)| MissingRange { range: part(range, &run), reason })
        };
        self.blocks.iter().flat_map(of_block).collect()
    }

    /// Returns whether no element is missing.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.value_count() == self.element_count()
    }

    /// Number of elements that have a value.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.blocks.iter().flat_map(|block| &block.cells).filter(|cell| cell.is_ok()).count()
    }

    /// Returns a backup of parts of this one.
    ///
    /// # Errors
    /// [`InvalidBackup::NotIn`] for a range that is not wholly within one of this backup,
    /// [`InvalidBackup::SplitsPair`] for one that would split a value of several registers,
    /// [`InvalidBackup::BitsOfRegister`], [`InvalidBackup::Empty`] and [`InvalidBackup::Overlap`].
    pub fn select(&self, ranges: impl IntoIterator<Item = Tag>) -> Result<Self, InvalidBackup> {
        let mut selected = Vec::new();
        for range in ranges {
            check_whole(range)?;
            let cells = self.blocks.iter().find_map(|block| {
                let start = block.index(range.first())?;
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
        Ok(Self { blocks: selected, ..self.clone() })
    }

    /// Elements whose value differs in the other backup. Elements that are missing here are not
    /// compared. Elements that are missing there, or in none of its ranges under the same symbol,
    /// differ.
    #[must_use]
    pub fn differences(&self, other: &Self) -> Vec<Difference> {
        let known = self.elements().filter_map(|(element, cell)| Some((element, cell.ok()?)));
        let compared = known.map(|(element, expected)| {
            let found = other.value(element).and_then(Result::ok);
            Difference { element, expected, found }
        });
        compared.filter(|difference| difference.found != Some(difference.expected)).collect()
    }

    /// The station number of the PLC that was read; `None` before reading.
    #[must_use]
    pub fn station(&self) -> Option<u8> {
        self.station
    }
}

file_methods! {
    Backup, "backup",
    /// The content of a file with this backup, as text for people and tools.
    ///
    /// ```text
    /// fatek file 1: backup
    /// length 257
    /// station 1
    /// read 2026-11-22T07:09:13Z
    /// about RUN                                         for people; it follows from the next two
    /// brief 015400                                      bytes of 40, or `-`
    /// status -                                          bytes of 53, or `-`
    /// range R0-R9
    /// R0 0001 0002 00FF 0000 0000 0000 0000 0000        eight registers per line, in hexadecimal digits
    /// missing R8-R9 refused A
    /// range M0-M15
    /// M0 00000000 00000001                              64 discretes per line, the first one first
    /// crc32 1A2B3C4D
    /// ```
}

#[cfg(test)]
mod tests;
