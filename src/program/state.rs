//! How far a writing has come.

use std::fmt;

/// What state a PLC is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum PlcState {
    /// It ran when it last answered.
    Running,
    /// It was stopped when it last answered, and nothing has been sent to it since that would start it.
    Stopped,
    /// It has not answered, or not since it was told to stop or to run.
    Unknown,
}

impl fmt::Display for PlcState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Running => "the PLC runs",
            Self::Stopped => "the PLC is stopped",
            Self::Unknown => "whether the PLC runs is not known",
        })
    }
}

/// How far the writing of a program has come, and in what state the PLC is.
///
/// Its `Display` is a line for people.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct WriteState {
    /// The pages that this run has written and read back, in this order, and not found to be others since.
    pub written: Vec<u16>,
    /// The other pages that earlier runs of the same [`WriteProgram`](super::WriteProgram) have written, and that have been read
    /// back.
    pub written_before: Vec<u16>,
    /// The pages that differ, or with [`WriteOptions::all_pages`](super::WriteOptions::all_pages) were to be written, and whose
    /// write was not sent; and those that were found to be others in the end. If it ended while pages were compared, only
    /// those found by then.
    pub unwritten: Vec<u16>,
    /// The pages that may have been written, or in part: their write was sent, and that they are as they should be was not seen, or
    /// only in a reply that may have been a duplicate of another one.
    pub in_doubt: Vec<u16>,
    /// Whether this run, or an earlier one of the same [`WriteProgram`](super::WriteProgram), has written a page, or perhaps,
    /// since all pages were last found to be the program's.
    pub touched: bool,
    /// Whether all pages have been found to be the program's. `false`, too, if they have not been compared yet.
    pub whole: bool,
    /// Whether the PLC was running and has been stopped, by this run or an earlier one of the same
    /// [`WriteProgram`](super::WriteProgram).
    pub was_stopped: bool,
    /// Whether it runs.
    pub plc: PlcState,
}

impl WriteState {
    /// Whether the PLC may hold a part of the new program and a part of the old one, by this run or an earlier one of the
    /// same [`WriteProgram`](super::WriteProgram).
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
        let Self { written, written_before, in_doubt, plc, .. } = self;
        let plc = match (plc, self.was_stopped) {
            (PlcState::Stopped, true) => "the PLC ran before and is stopped now".to_owned(),
            (PlcState::Unknown, true) => "the PLC ran before, and whether it runs now is not known".to_owned(),
            _ => plc.to_string(),
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
                _ => write!(f, "{}", Pages(written_before))?,
            }
            return write!(f, ": the PLC may hold a half of the program, and {plc}: write the rest before it runs");
        }
        let all = written.len().saturating_add(self.left());
        write!(f, "{} of the {all} pages that differ are written", written.len())?;
        if !written.is_empty() {
            write!(f, " ({})", Pages(written))?;
        }
        match in_doubt.as_slice() {
            [] => {}
            [page] => write!(f, ", page {page} perhaps")?,
            pages => write!(f, ", pages {} perhaps", Pages(pages))?,
        }
        if self.left() == 0 {
            return write!(f, ", which is not confirmed, and {plc}: compare them before it runs");
        }
        write!(f, ", and {plc}: write the rest before it runs")
    }
}

/// Pages as people write them: `0-3, 7`.
struct Pages<'a>(&'a [u16]);

impl fmt::Display for Pages<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut pages = self.0.to_vec();
        pages.sort_unstable();
        for (place, run) in pages.chunk_by(|page, next| page.checked_add(1) == Some(*next)).enumerate() {
            if place > 0 {
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
    fn pages_are_told_as_ranges() {
        for (pages, text) in
            [(&[][..], ""), (&[5], "5"), (&[1, 2, 3, 7, 0], "0-3, 7"), (&[65535, 65534], "65534-65535")]
        {
            assert_eq!(Pages(pages).to_string(), text);
        }
    }
}
