//! How far the writing of a program has come.

use std::fmt;

use crate::file::{PlcDifference, listed};
use crate::transfer::PlcState;

/// Result of writing a program, by the run that succeeded and the runs before it: the PLC holds it.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct WriteReport {
    /// Pages that this run wrote, in this order; each was read back.
    pub written: Vec<u16>,
    /// Other pages that earlier runs of the same [`WriteProgram`](super::WriteProgram) wrote, and
    /// that were correct when they were read back.
    pub written_before: Vec<u16>,
    /// Number of pages of the program.
    pub pages: u16,
    /// `true` if the PLC ran and was stopped, by this run or an earlier one of the same
    /// [`WriteProgram`](super::WriteProgram).
    pub was_stopped: bool,
    /// `true` if the PLC runs now.
    pub running: bool,
    /// How the PLC differs from the one that the program was read from: see
    /// [`WriteState::other_plc`].
    pub other_plc: Vec<PlcDifference>,
}

/// How far the writing of a program has come, and the state of the PLC.
///
/// Its `Display` is one line for people.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct WriteState {
    /// Pages that this run wrote and read back, in this order, and did not find different since.
    pub written: Vec<u16>,
    /// Other pages that earlier runs of the same [`WriteProgram`](super::WriteProgram) wrote, and
    /// that have been read back.
    pub written_before: Vec<u16>,
    /// Pages to write that were not sent: those that differ, or all with
    /// [`WriteOptions::all_pages`](super::WriteOptions::all_pages), and those that differed at the
    /// end. If the run ended while pages were compared, only those found by then.
    pub unwritten: Vec<u16>,
    /// Pages that may have been written, or in part: they were sent and not read back, or only by a
    /// reply that may have been a duplicate of another one.
    pub in_doubt: Vec<u16>,
    /// `true` if this run, or an earlier one of the same [`WriteProgram`](super::WriteProgram),
    /// wrote a page or may have, since all pages were last found equal.
    pub touched: bool,
    /// `true` if all pages were found equal. `false` also if they have not been compared yet.
    pub whole: bool,
    /// `true` if the PLC ran and was stopped, by this run or an earlier one of the same
    /// [`WriteProgram`](super::WriteProgram).
    pub was_stopped: bool,
    /// `true` if the PLC runs.
    pub plc: PlcState,
    /// How the PLC differs from the one that the program was read from, as far as that is known:
    /// model and version of the operating system. Empty until the status of the PLC is read.
    pub other_plc: Vec<PlcDifference>,
}

impl WriteState {
    /// Returns whether the PLC may hold parts of two programs, because of this run or an earlier
    /// one of the same [`WriteProgram`](super::WriteProgram).
    #[must_use]
    pub fn is_half_written(&self) -> bool {
        self.touched && !self.whole
    }

    /// How many pages are still to be written, those in doubt included.
    #[must_use]
    pub fn left(&self) -> usize {
        self.unwritten.len().saturating_add(self.in_doubt.len())
    }
}

impl fmt::Display for WriteState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.write_pages(f)?;
        if self.other_plc.is_empty() {
            return Ok(());
        }
        write!(f, "; another PLC than that of the program: {}", listed(&self.other_plc))
    }
}

impl WriteState {
    /// Writes the pages and the state of the PLC.
    fn write_pages(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { written, written_before, in_doubt, plc, .. } = self;
        let plc = match (plc, self.was_stopped) {
            (PlcState::Stopped, true) => "the PLC ran before and is stopped now".to_owned(),
            (PlcState::Unknown, true) => "the PLC ran before, and whether it runs now is not known".to_owned(),
            (PlcState::Running, true) | (_, false) => plc.to_string(),
        };
        if self.whole {
            return write!(f, "the program is written, and {plc}");
        }
        if !self.is_half_written() {
            return write!(f, "nothing was written, and {plc}");
        }
        if written.is_empty() && self.left() == 0 {
            f.write_str("this run has written no page, and earlier ones ")?;
            match written_before.len() {
                0 => f.write_str("perhaps one")?,
                _ => write!(f, "{}", PageList(written_before))?,
            }
            return write!(f, ": the PLC may hold a part of the program, and {plc}: write the rest before it runs");
        }
        let all = written.len().saturating_add(self.left());
        write!(f, "{} of the {all} pages that differ are written", written.len())?;
        if !written.is_empty() {
            write!(f, " ({})", PageList(written))?;
        }
        match in_doubt.as_slice() {
            [] => {}
            [page] => write!(f, ", page {page} perhaps")?,
            pages => write!(f, ", pages {} perhaps", PageList(pages))?,
        }
        if self.left() == 0 {
            return write!(f, ", which is not confirmed, and {plc}: compare them before it runs");
        }
        write!(f, ", and {plc}: write the rest before it runs")
    }
}

/// Page numbers as ranges: `0-3, 7`.
struct PageList<'a>(&'a [u16]);

impl fmt::Display for PageList<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut pages = self.0.to_vec();
        pages.sort_unstable();
        for (index, run) in pages.chunk_by(|page, next| page.checked_add(1) == Some(*next)).enumerate() {
            if index > 0 {
                f.write_str(", ")?;
            }
            match run {
                [first, .., last] => write!(f, "{first}-{last}")?,
                run => run.iter().try_for_each(|page| write!(f, "{page}"))?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_are_written_as_ranges() {
        for (pages, text) in
            [(&[][..], ""), (&[5], "5"), (&[1, 2, 3, 7, 0], "0-3, 7"), (&[65535, 65534], "65534-65535")]
        {
            assert_eq!(PageList(pages).to_string(), text);
        }
    }
}
