//! Lines of a text that is read as a stream, of bounded length.

use std::io::{BufRead, Read};

use super::SourceError;

/// Longest line. Those of recordings and logs are shorter than 10 KiB.
const MAX_LINE_LEN: u64 = 1024 * 1024;

/// Reads lines, with their numbers from 1. Bytes that are no UTF-8 are replaced.
pub(super) struct Lines<R> {
    reader: R,
    number: u64,
}

/// A line without its end. `is_whole`: its line feed is there, too.
pub(super) struct Line {
    pub(super) number: u64,
    pub(super) text: String,
    pub(super) is_whole: bool,
}

impl<R: BufRead> Lines<R> {
    pub(super) fn new(reader: R) -> Self {
        Self { reader, number: 0 }
    }

    pub(super) fn next(&mut self) -> Result<Option<Line>, SourceError> {
        let mut bytes = Vec::new();
        let read = (&mut self.reader).take(MAX_LINE_LEN).read_until(b'\n', &mut bytes)?;
        if read == 0 {
            return Ok(None);
        }
        self.number += 1;
        let is_whole = bytes.last() == Some(&b'\n');
        if !is_whole && u64::try_from(read).is_ok_and(|read| read >= MAX_LINE_LEN) {
            return Err(SourceError::Content(format!("line {}: longer than {MAX_LINE_LEN} bytes", self.number)));
        }
        let text = String::from_utf8_lossy(&bytes);
        let text = text.trim_end_matches(['\r', '\n']).to_owned();
        Ok(Some(Line { number: self.number, text, is_whole }))
    }
}
