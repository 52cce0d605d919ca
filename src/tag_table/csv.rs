//! Tables of spreadsheets.

use csv::{ReaderBuilder, StringRecord};

use super::Fault;
use super::draft::{Column, Draft, Row};
use super::error::line_at;

/// Parses a table; all faults are in the draft.
pub(super) fn parse(text: &str) -> Draft {
    let mut draft = Draft::default();
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let (separator, skipped) = separator(text);
    let rest = text.get(skipped..).unwrap_or_default();
    let mut lines = Lines { text: rest.as_bytes(), at: 0, line: if skipped > 0 { 2 } else { 1 } };
    let mut reader =
        ReaderBuilder::new().has_headers(false).flexible(true).delimiter(separator).from_reader(rest.as_bytes());
    let mut titles: Option<Vec<Option<Column>>> = None;
    for record in reader.records() {
        let record = match record {
            Ok(record) => record,
            // The text is UTF-8, and records may have any number of cells.
            Err(error) => {
                let line = error.position().map_or(1, |position| lines.line_of(position.byte()));
                draft.fault(line, None, Fault::Syntax { message: error.to_string() });
                break;
            }
        };
        let line = record.position().map_or(1, |position| lines.line_of(position.byte()));
        let is_ignored = record.iter().all(|cell| cell.trim().is_empty())
            || record.get(0).is_some_and(|cell| cell.trim_start().starts_with('#'));
        match &titles {
            _ if is_ignored => {}
            None => titles = Some(columns(&record, line, &mut draft)),
            Some(columns) => add(&record, columns, line, &mut draft),
        }
    }
    if titles.is_none() {
        draft.fault(1, None, Fault::NoTitles);
    }
    draft
}

/// Counts lines. The reader does it as well, but a record behind CRLF has the line before.
struct Lines<'t> {
    text: &'t [u8],
    at: usize,
    /// The line there.
    line: usize,
}

impl Lines<'_> {
    /// The line of a record that begins at this offset, or behind line feeds there.
    fn line_of(&mut self, offset: u64) -> usize {
        let offset = usize::try_from(offset).unwrap_or(usize::MAX);
        let rest = self.text.get(offset..).unwrap_or_default();
        let feeds = rest.iter().take_while(|&&byte| matches!(byte, b'\r' | b'\n')).count();
        let begin = offset.saturating_add(feeds).max(self.at);
        let passed = self.text.get(self.at..begin).unwrap_or_default();
        self.line = self.line.saturating_add(line_at(passed).saturating_sub(1));
        self.at = begin;
        self.line
    }
}

/// The separator of cells, and the length of a line `sep=;`.
fn separator(text: &str) -> (u8, usize) {
    let first = text.split_inclusive('\n').next().unwrap_or_default();
    let bytes = first.trim_end().as_bytes();
    if let [b's' | b'S', b'e' | b'E', b'p' | b'P', b'=', separator] = bytes {
        return (*separator, first.len());
    }
    // Titles have no separators themselves.
    let titles = text.lines().find(|line| !line.trim().is_empty() && !line.trim_start().starts_with('#'));
    let count = |separator: u8| titles.unwrap_or_default().bytes().filter(|&byte| byte == separator).count();
    let most = [b'\t', b';', b','].into_iter().max_by_key(|&separator| count(separator));
    (most.unwrap_or(b','), 0)
}

/// The columns of the titles; `None` for one that is ignored.
fn columns(titles: &StringRecord, line: usize, draft: &mut Draft) -> Vec<Option<Column>> {
    let mut columns = Vec::new();
    for title in titles.iter().map(str::trim) {
        let is_ignored = title.is_empty() || title.starts_with('#');
        let column = Column::titled(title);
        if column.is_some() && columns.contains(&column) {
            draft.fault(line, Some(title), Fault::DoubleColumn);
        } else if column.is_none() && !is_ignored {
            draft.fault(line, None, Fault::Unknown { title: title.to_owned() });
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

fn add(record: &StringRecord, columns: &[Option<Column>], line: usize, draft: &mut Draft) {
    if ![Column::Name, Column::At].into_iter().all(|column| columns.contains(&Some(column))) {
        // The fault of the titles says it once.
        return;
    }
    let mut row = Row::at(line);
    for (number, cell) in record.iter().map(str::trim).enumerate() {
        match columns.get(number) {
            Some(Some(column)) => row.set(*column, line, cell),
            Some(None) => {}
            None if cell.is_empty() => {}
            None => return draft.fault(line, None, Fault::MoreCells),
        }
    }
    draft.add(&row);
}
