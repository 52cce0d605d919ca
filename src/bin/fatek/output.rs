//! Data on stdout as a table, JSON or CSV, and messages on stderr.

use std::fmt::{self, Write as _};
use std::io::{self, IsTerminal, Write};
use std::time::Duration;

use clap::ValueEnum;
use clap::builder::Styles;
use comfy_table::presets::NOTHING;
use fatek::tag::TagValue;
use serde_json::Value;

use crate::failure::Failure;

use crate::printable::{is_unprintable, printable};

/// Argument of `--format`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum FormatArg {
    /// Aligned columns
    #[default]
    Table,
    /// One JSON document
    Json,
    /// Comma-separated values with a header line
    Csv,
    /// CSV for spreadsheets: no cell is a formula
    CsvSafe,
}

/// Output format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Table,
    Json,
    Csv,
}

#[derive(Debug)]
pub(crate) struct Output {
    pub(crate) format: Format,
    /// Cells of CSV that a spreadsheet would take for formulas get a prefix.
    guards_formulas: bool,
    pub(crate) quiet: bool,
}

impl Output {
    pub(crate) fn new(format: FormatArg, quiet: bool) -> Self {
        let (format, guards_formulas) = match format {
            FormatArg::Table => (Format::Table, false),
            FormatArg::Json => (Format::Json, false),
            FormatArg::Csv => (Format::Csv, false),
            FormatArg::CsvSafe => (Format::Csv, true),
        };
        Self { format, guards_formulas, quiet }
    }

    /// Prints rows, and nothing in place of an empty table. JSON is an array of objects with the columns as keys.
    pub(crate) fn rows(&self, rows: &Rows) -> Result<(), Failure> {
        match self.format {
            // A header alone says nothing; programs get an empty document.
            Format::Table if rows.is_empty() => Ok(()),
            Format::Table => print(format_args!("{}", rows.table())),
            Format::Json => self.json(&rows.json()),
            Format::Csv => self.csv(rows.records().iter().map(Vec::as_slice)).map_err(Failure::Output),
        }
    }

    /// Prints one JSON document.
    pub(crate) fn json(&self, document: &Value) -> Result<(), Failure> {
        print(format_args!("{}", ascii_controls(&format!("{document:#}"))))
    }

    /// Prints one JSON document on one line.
    pub(crate) fn json_line(&self, document: &Value) -> Result<(), Failure> {
        print(format_args!("{}", ascii_controls(&document.to_string())))
    }

    /// Prints a line of comma-separated values on stdout.
    pub(crate) fn csv_line(&self, values: &[&str]) -> Result<(), Failure> {
        self.csv([values].into_iter()).map_err(Failure::Output)
    }

    fn csv<'a>(&self, records: impl Iterator<Item = &'a [&'a str]>) -> io::Result<()> {
        let mut stdout = io::stdout().lock();
        // Written to memory first: `csv` would hide that an error is a broken pipe.
        let text = self.csv_text(records, stdout.is_terminal())?;
        stdout.write_all(&text)?;
        stdout.flush()
    }

    /// Lines of comma-separated values. A file gets the characters themselves, a terminal escapes.
    pub(crate) fn csv_text<'a>(
        &self,
        records: impl Iterator<Item = &'a [&'a str]>,
        is_terminal: bool,
    ) -> io::Result<Vec<u8>> {
        let mut writer = csv::Writer::from_writer(Vec::new());
        for record in records {
            writer.write_record(record.iter().map(|cell| self.csv_cell(cell, is_terminal)))?;
        }
        writer.into_inner().map_err(|error| error.into_error())
    }

    fn csv_cell(&self, cell: &str, is_terminal: bool) -> String {
        let prefix = if self.guards_formulas && is_formula(cell) { "'" } else { "" };
        if is_terminal { format!("{prefix}{}", printable(cell)) } else { format!("{prefix}{cell}") }
    }

    /// Returns whether programs read the output: an empty result is a document, too.
    pub(crate) fn is_for_programs(&self) -> bool {
        self.format != Format::Table
    }

    /// Prints a message to stderr, unless `--quiet` was given.
    pub(crate) fn remark(&self, text: fmt::Arguments<'_>) {
        if !self.quiet {
            complain(text);
        }
    }
}

/// Prints one or more lines on stdout.
pub(crate) fn print(lines: fmt::Arguments<'_>) -> Result<(), Failure> {
    let mut stdout = io::BufWriter::new(io::stdout().lock());
    writeln!(stdout, "{}", printable_lines(&lines.to_string())).and_then(|()| stdout.flush()).map_err(Failure::Output)
}

/// Waits until the reader of stdout has closed it, and returns the error that a write would have.
///
/// Never returns if stdout is a file, or the system cannot tell.
#[cfg(unix)]
#[allow(deprecated, reason = "the function that replaces `with_interest` needs a newer Tokio than Cargo.toml")]
pub(crate) async fn stdout_closed() -> io::Error {
    use tokio::io::Interest;
    use tokio::io::unix::AsyncFd;

    if let Ok(stdout) = AsyncFd::with_interest(io::stdout(), Interest::ERROR)
        && stdout.ready(Interest::ERROR).await.is_ok()
    {
        return io::ErrorKind::BrokenPipe.into();
    }
    std::future::pending().await
}

/// Never returns.
#[cfg(not(unix))]
pub(crate) async fn stdout_closed() -> io::Error {
    std::future::pending().await
}

/// Prints a line on stderr; a line feed in it is escaped. A write error is ignored: there is no
/// other place to report it.
pub(crate) fn complain(line: fmt::Arguments<'_>) {
    let _ = writeln!(anstream::stderr().lock(), "{}", coloured(&printable(&line.to_string()).to_string()));
}

/// A printable text with the colour of its first word: `error:`, `warning:` or `hint:`. The stream
/// of the caller removes it where colours are not wanted.
pub(crate) fn coloured(text: &str) -> String {
    let styles = Styles::styled();
    let kinds = [("error:", *styles.get_error()), ("warning:", *styles.get_invalid()), ("hint:", *styles.get_valid())];
    for (word, style) in kinds {
        if let Some(rest) = text.strip_prefix(word) {
            return format!("{style}{word}{style:#}{rest}");
        }
    }
    text.to_owned()
}

/// Lines with all unprintable characters escaped but line feeds.
pub(crate) fn printable_lines(lines: &str) -> String {
    lines.split('\n').map(|line| printable(line).to_string()).collect::<Vec<_>>().join("\n")
}

/// Escapes unprintable characters of a JSON document in its strings; the value stays the same. JSON
/// writers escape those of ASCII only.
fn ascii_controls(json: &str) -> String {
    let mut escaped = String::with_capacity(json.len());
    for character in json.chars() {
        if character == '\n' || !is_unprintable(character) {
            escaped.push(character);
            continue;
        }
        for unit in character.encode_utf16(&mut [0; 2]) {
            // Writing to a string does not fail.
            let _ = write!(escaped, "\\u{unit:04x}");
        }
    }
    escaped
}

/// Returns whether a spreadsheet may take the cell for a formula. Numbers are none.
fn is_formula(cell: &str) -> bool {
    let is_number = || cell.parse::<f64>().is_ok_and(f64::is_finite);
    cell.starts_with(['=', '+', '-', '@', '\t', '\r', '\n']) && !is_number()
}

/// A number with its noun: `1 line`, `2 lines`.
pub(crate) fn counted(count: u64, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// Bytes as hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect()
}

/// Version of an operating system.
pub(crate) fn version((major, minor): (u8, u8)) -> String {
    format!("{major}.{minor}")
}

/// Table with a header.
#[derive(Debug)]
pub(crate) struct Rows {
    columns: Vec<&'static str>,
    rows: Vec<Vec<Cell>>,
}

impl Rows {
    pub(crate) fn new<const N: usize>(columns: [&'static str; N]) -> Self {
        Self { columns: columns.into(), rows: Vec::new() }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Leaves out a column that is empty in all rows.
    pub(crate) fn without_empty(mut self, column: &str) -> Self {
        let position = self.columns.iter().position(|name| *name == column);
        let is_empty =
            |position: usize| self.rows.iter().all(|row| row.get(position).is_none_or(|cell| cell.text.is_empty()));
        if let Some(position) = position.filter(|position| is_empty(*position)) {
            self.columns.remove(position);
            self.rows.iter_mut().for_each(|row| drop(row.remove(position)));
        }
        self
    }

    pub(crate) fn push<const N: usize>(&mut self, row: [Cell; N]) {
        debug_assert_eq!(N, self.columns.len());
        self.rows.push(row.into());
    }

    /// Table of aligned columns; the last column is not padded.
    pub(crate) fn table(&self) -> String {
        let mut table = comfy_table::Table::new();
        table.load_preset(NOTHING);
        table.set_header(self.columns.iter().map(|column| column.to_uppercase()));
        for row in &self.rows {
            table.add_row(row.iter().map(|cell| printable(&cell.text).to_string()));
        }
        table.column_iter_mut().for_each(|column| {
            column.set_padding((0, 2));
        });
        let text = table.to_string();
        text.lines().map(str::trim_end).collect::<Vec<_>>().join("\n")
    }

    /// Header and rows as texts.
    fn records(&self) -> Vec<Vec<&str>> {
        let rows = self.rows.iter().map(|row| row.iter().map(Cell::csv).collect());
        std::iter::once(self.columns.clone()).chain(rows).collect()
    }

    pub(crate) fn json(&self) -> Value {
        let cells = |row: &Vec<Cell>| row.iter().map(|cell| cell.json.clone()).collect::<Vec<_>>();
        self.rows.iter().map(|row| self.columns.iter().copied().zip(cells(row)).collect::<Value>()).collect()
    }
}

/// Cell of a row: text for the table, and JSON.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Cell {
    pub(crate) text: String,
    pub(crate) json: Value,
}

impl Cell {
    /// Text for CSV: a JSON string without its quotes, else the text of the table.
    pub(crate) fn csv(&self) -> &str {
        self.json.as_str().unwrap_or(&self.text)
    }
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self { json: text.clone().into(), text }
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        text.to_owned().into()
    }
}

macro_rules! cells_from {
    ($($plain:ty)+) => {
        $(impl From<$plain> for Cell {
            fn from(plain: $plain) -> Self {
                Self { text: plain.to_string(), json: plain.into() }
            }
        })+
    };
}
cells_from! { bool u8 u16 u32 usize }

impl From<Duration> for Cell {
    /// In milliseconds.
    fn from(time: Duration) -> Self {
        let text = format!("{:.3}", time.as_secs_f64() * 1e3);
        Self { json: text.parse::<f64>().map_or(Value::Null, Value::from), text }
    }
}

impl<T: Into<Cell>> From<Option<T>> for Cell {
    /// Unknown values are empty in the table and `null` in JSON.
    fn from(cell: Option<T>) -> Self {
        cell.map_or(Self { text: String::new(), json: Value::Null }, Into::into)
    }
}

impl From<TagValue> for Cell {
    /// JSON in the form of the library: hexadecimal numbers, NaN and infinities are strings with the
    /// text of the table, which `write` accepts. Texts have quotes in the table only.
    fn from(value: TagValue) -> Self {
        let text = value.to_string();
        let json = serde_json::to_value(&value).unwrap_or_else(|_| text.clone().into());
        Self { text, json }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn json_values_have_the_type_of_the_tag() {
        for (value, json) in [
            (TagValue::Bool(true), "true"),
            (TagValue::U32(u32::MAX), "4294967295"),
            (TagValue::I16(-1), "-1"),
            (TagValue::U64(u64::MAX), "18446744073709551615"),
            (TagValue::I64(i64::MIN), "-9223372036854775808"),
            (TagValue::F64(0.1), "0.1"),
            (TagValue::F32(0.1), "0.1"),
            (TagValue::F32(-500.125), "-500.125"),
            (TagValue::F32(f32::NAN), "\"NaN\""),
            (TagValue::F32(f32::NEG_INFINITY), "\"-inf\""),
            (TagValue::Hex16(0xAA), "\"0x00AA\""),
            (TagValue::Scaled(12.3), "12.3"),
            (TagValue::Scaled(f64::NAN), "\"NaN\""),
            (TagValue::Text("a\"\n".to_owned()), r#""a\"\n""#),
        ] {
            assert_eq!(Cell::from(value).json.to_string(), json);
        }
    }

    #[test]
    fn table_headers_are_upper_case_and_lines_have_no_trailing_blanks() {
        let mut rows = Rows::new(["tag", "value"]);
        rows.push(["R0".into(), 5_u32.into()]);
        rows.push(["R10".into(), "long text".into()]);
        assert_eq!(rows.table(), "TAG  VALUE\nR0   5\nR10  long text");
        assert_eq!(rows.json().to_string(), r#"[{"tag":"R0","value":5},{"tag":"R10","value":"long text"}]"#);
    }

    #[test]
    fn a_column_without_texts_is_left_out() {
        let mut rows = Rows::new(["tag", "value", "note"]);
        rows.push(["R0".into(), 5_u32.into(), None::<String>.into()]);
        assert_eq!(rows.without_empty("note").table(), "TAG  VALUE\nR0   5");
        let mut rows = Rows::new(["tag", "value", "note"]);
        rows.push(["R0".into(), 5_u32.into(), "stale".into()]);
        assert_eq!(rows.without_empty("note").without_empty("other").table(), "TAG  VALUE  NOTE\nR0   5      stale");
    }

    #[test]
    fn cells_that_are_formulas_get_a_prefix_and_numbers_do_not() {
        let (plain, safe) = (Output::new(FormatArg::Csv, true), Output::new(FormatArg::CsvSafe, true));
        for formula in ["=1+1", "+cmd|' /C calc'!A0", "-1+1", "@SUM(A1)", "\t=1", "\r=1", "\n=1", "-", "-inf", "-0x5"] {
            assert_eq!(safe.csv_cell(formula, false), format!("'{formula}"));
            assert_eq!(plain.csv_cell(formula, false), formula);
        }
        for cell in ["", "5", "-5", "+5", "-500.125", "-1e-5", "R0", "a=1", " =1", "'=1", "0x00AA"] {
            assert_eq!(safe.csv_cell(cell, false), cell);
        }
        assert_eq!(plain.csv_cell("a\x1b\n\u{9b}", false), "a\x1b\n\u{9b}", "a file gets the text itself");
        assert_eq!(plain.csv_cell("a\x1b\n\u{9b}", true), "a\\u{1b}\\n\\u{9b}");
    }

    #[test]
    fn json_keeps_its_value_without_raw_controls() {
        let text = "a\x1b\u{7f}\u{9b}2J\u{202e}\u{e0041}\n";
        let printed = ascii_controls(&format!("{:#}", serde_json::json!({ "value": text })));
        assert!(printed.chars().all(|c| c == '\n' || !is_unprintable(c)), "{printed:?}");
        // Before: U+007F to U+E0041 were printed as they are.
        assert!(printed.contains(r"a\u001b\u007f\u009b2J\u202e\udb40\udc41\n"), "{printed}");
        assert_eq!(printed.parse::<Value>().unwrap()["value"], text);
    }

    proptest! {
        #[test]
        fn floats_round_trip_through_json(bits: u32) {
            let number = f32::from_bits(bits);
            prop_assume!(number.is_finite());
            let json = Cell::from(TagValue::F32(number)).json.to_string();
            prop_assert_eq!(json.parse::<f32>().unwrap().to_bits(), bits);
            // Also when parsed as f64 and rounded, as by most programs.
            prop_assert_eq!((json.parse::<f64>().unwrap() as f32).to_bits(), bits);
        }
    }
}
