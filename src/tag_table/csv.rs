//! Tables of spreadsheets.
//!
//! The records are divided here: a reader that is lenient with quotes would lose the lines behind a
//! quote that is not closed.

use std::borrow::Cow;

use super::Fault;
use super::draft::{Column, Draft, Row};

/// Parses a table; all faults are in the draft.
pub(super) fn parse(text: &str) -> Draft {
    let mut draft = Draft::default();
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let (separator, skipped) = separator(text);
    let mut records = Records { text, at: skipped, line: if skipped > 0 { 2 } else { 1 }, separator };
    let mut titles: Option<Vec<Option<Column>>> = None;
    while let Some((line, record)) = records.next() {
        match (record, &titles) {
            (Err((line, fault)), _) => draft.fault(line, None, fault),
            (Ok(cells), _) if cells.iter().all(|cell| cell.is_empty()) => {}
            (Ok(cells), None) => titles = Some(columns(&cells, line, &mut draft)),
            (Ok(cells), Some(columns)) => add(&cells, columns, line, &mut draft),
        }
    }
    if titles.is_none() && draft.is_good() {
        draft.fault(1, None, Fault::NoTitles);
    }
    draft
}

/// The records of a text: cells, without blanks around them.
struct Records<'t> {
    text: &'t str,
    at: usize,
    /// The line there, from 1.
    line: usize,
    separator: u8,
}

/// The cells of a record, or a fault with its line.
type Cells<'t> = Result<Vec<Cow<'t, str>>, (usize, Fault)>;

impl<'t> Records<'t> {
    /// The next record and its line; lines that begin with `#` are passed.
    fn next(&mut self) -> Option<(usize, Cells<'t>)> {
        while self.rest().trim_start_matches(' ').starts_with('#') {
            self.skip_line();
        }
        if self.rest().is_empty() {
            return None;
        }
        let line = self.line;
        let mut cells = Vec::new();
        loop {
            self.at = self.at.saturating_add(self.blanks());
            let cell = if self.byte() == Some(b'"') { self.quoted() } else { Ok(self.plain()) };
            match cell {
                Ok(cell) => cells.push(cell),
                Err(fault) => return Some((line, Err(fault))),
            }
            if self.byte() != Some(self.separator) {
                self.end_line();
                return Some((line, Ok(cells)));
            }
            self.at = self.at.saturating_add(1);
        }
    }

    fn rest(&self) -> &'t str {
        self.text.get(self.at..).unwrap_or_default()
    }

    fn byte(&self) -> Option<u8> {
        self.text.as_bytes().get(self.at).copied()
    }

    /// The number of blanks here, but for the separator.
    fn blanks(&self) -> usize {
        let is_blank = |byte: &u8| matches!(byte, b' ' | b'\t') && *byte != self.separator;
        self.rest().bytes().take_while(is_blank).count()
    }

    /// A cell without quotes, up to the separator or the end of the line.
    fn plain(&mut self) -> Cow<'t, str> {
        let rest = self.rest();
        let len = rest.bytes().take_while(|byte| !matches!(byte, b'\r' | b'\n') && *byte != self.separator).count();
        self.at = self.at.saturating_add(len);
        rest.get(..len).unwrap_or_default().trim().into()
    }

    /// A cell in quotes. After a fault, the next record is the next line.
    fn quoted(&mut self) -> Result<Cow<'t, str>, (usize, Fault)> {
        let (opened_at, line) = (self.at, self.line);
        let mut cell = String::new();
        loop {
            self.at = self.at.saturating_add(1);
            let rest = self.rest();
            let Some(len) = rest.find('"') else {
                self.at = opened_at;
                self.skip_line();
                return Err((line, Fault::OpenQuote));
            };
            let part = rest.get(..len).unwrap_or_default();
            cell.push_str(part);
            self.line = self.line.saturating_add(part.matches('\n').count());
            self.at = self.at.saturating_add(len).saturating_add(1);
            if self.byte() != Some(b'"') {
                break;
            }
            cell.push('"');
        }
        self.at = self.at.saturating_add(self.blanks());
        match self.byte() {
            None | Some(b'\r' | b'\n') => {}
            Some(byte) if byte == self.separator => {}
            Some(_) => {
                let line = self.line;
                self.skip_line();
                return Err((line, Fault::BehindQuote));
            }
        }
        Ok(cell.trim().to_owned().into())
    }

    fn skip_line(&mut self) {
        let len = self.rest().bytes().take_while(|byte| !matches!(byte, b'\r' | b'\n')).count();
        self.at = self.at.saturating_add(len);
        self.end_line();
    }

    /// Passes the end of a line: LF, CRLF, or CR.
    fn end_line(&mut self) {
        let len = match self.rest().as_bytes() {
            [b'\r', b'\n', ..] => 2,
            [b'\r' | b'\n', ..] => 1,
            _ => return,
        };
        self.at = self.at.saturating_add(len);
        self.line = self.line.saturating_add(1);
    }
}

/// The separator of cells, and the length of a line `sep=;`.
fn separator(text: &str) -> (u8, usize) {
    let first = text.split_inclusive('\n').next().unwrap_or_default();
    let marked = first.trim_end_matches(['\r', '\n']).trim_matches('"').as_bytes();
    if let [b's' | b'S', b'e' | b'E', b'p' | b'P', b'=', separator] = marked {
        return (*separator, first.len());
    }
    let titles = text.lines().find(|line| !line.trim().is_empty() && !line.trim_start().starts_with('#'));
    let mut counts = [(b'\t', 0_usize), (b';', 0), (b',', 0)];
    let mut is_quoted = false;
    for byte in titles.unwrap_or_default().bytes() {
        is_quoted ^= byte == b'"';
        if let Some((_, count)) = counts.iter_mut().find(|(separator, _)| *separator == byte && !is_quoted) {
            *count = count.saturating_add(1);
        }
    }
    let most = counts.into_iter().max_by_key(|(_, count)| *count);
    (most.map_or(b',', |(separator, _)| separator), 0)
}

/// The columns of the titles; `None` for one that is ignored.
fn columns(titles: &[Cow<'_, str>], line: usize, draft: &mut Draft) -> Vec<Option<Column>> {
    let mut columns = Vec::new();
    for title in titles {
        let is_ignored = title.is_empty() || title.starts_with('#');
        let column = Column::titled(title);
        if column.is_some() && columns.contains(&column) {
            draft.fault(line, Some(title), Fault::DoubleColumn);
        } else if column.is_none() && !is_ignored {
            draft.fault(
                line,
                None,
                Fault::Unknown { title: title.to_string(), known: "name at class unit comment group" },
            );
        }
        columns.push(column);
    }
    for required in [Column::Name, Column::At] {
        if !columns.contains(&Some(required)) {
            draft.fault(line, Some(required.as_str()), Fault::Missing);
        }
    }
    columns
}

fn add(cells: &[Cow<'_, str>], columns: &[Option<Column>], line: usize, draft: &mut Draft) {
    if ![Column::Name, Column::At].into_iter().all(|column| columns.contains(&Some(column))) {
        // The fault of the titles says it once.
        return;
    }
    let mut row = Row::at(line);
    for (number, cell) in cells.iter().enumerate() {
        match columns.get(number) {
            Some(Some(column)) => row.set(*column, line, cell),
            Some(None) => {}
            None if cell.is_empty() => {}
            None => return draft.fault(line, None, Fault::MoreCells),
        }
    }
    draft.add(&row);
}
