//! Output of `fatek watch`: lines on stdout, and the log file.

use std::collections::HashMap;
use std::time::SystemTime;

use fatek::poll::{Sample, TagId};

use super::lines::Lines;
use super::log::LogFile;
use super::time_format::TimeFormat;
use super::wide::Wide;
use crate::args::WatchArgs;
use crate::failure::Failure;
use crate::output::{Cell, Format, Output, print};
use crate::targets::Target;

/// PLC and column of a tag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Place {
    /// Index of the PLC.
    pub(super) plc: usize,
    /// Name of the tag, without that of its PLC.
    pub(super) label: String,
    /// Bits of its elements.
    pub(super) bits: usize,
}

/// A line: the same cells for each format, and their text in a table.
#[derive(Debug, PartialEq)]
pub(super) struct Line {
    /// Text of a table, without the time.
    pub(super) table: String,
    pub(super) time: SystemTime,
    /// All columns but the time.
    pub(super) cells: Vec<Cell>,
    /// The same as JSON.
    pub(super) json: serde_json::Map<String, serde_json::Value>,
}

/// Lines of values, or of readings.
#[derive(Debug)]
enum Layout {
    Lines(Lines),
    Wide(Wide),
}

/// Prints a line per value or per reading, and logs it.
#[derive(Debug)]
pub(super) struct Printer<'o> {
    output: &'o Output,
    layout: Layout,
    time_format: TimeFormat,
    log: Option<LogFile>,
    count: u64,
}

impl<'o> Printer<'o> {
    /// Opens the log file, if there is one.
    pub(super) fn new(
        places: &HashMap<TagId, Place>,
        targets: &[Target],
        args: &WatchArgs,
        output: &'o Output,
    ) -> Result<Self, Failure> {
        let plcs: Vec<String> = targets.iter().map(|target| target.label.clone()).collect();
        let layout = match args.wide {
            true => Layout::Wide(Wide::new(places, &plcs, args.on_change)),
            false => Layout::Lines(Lines::new(places, &plcs)),
        };
        let mut printer = Self { output, layout, time_format: TimeFormat::new(args.local_time), log: None, count: 0 };
        if let Some(path) = &args.log.file {
            let header = printer.csv(&printer.columns().iter().map(String::as_str).collect::<Vec<_>>())?;
            printer.log = Some(LogFile::open(path, header, args.log.size, args.log.keep)?);
        }
        Ok(printer)
    }

    /// Number of lines so far.
    pub(super) fn count(&self) -> u64 {
        self.count
    }

    /// Names of the columns.
    fn columns(&self) -> Vec<String> {
        let others = match &self.layout {
            Layout::Lines(lines) => lines.columns(),
            Layout::Wide(wide) => wide.columns(),
        };
        std::iter::once("time".to_owned()).chain(others).collect()
    }

    pub(super) fn header(&self) -> Result<(), Failure> {
        let width = self.time_format.width();
        let header = match &self.layout {
            Layout::Lines(lines) => lines.header(),
            Layout::Wide(wide) => wide.header(),
        };
        match self.output.format {
            Format::Table => print(format_args!("{:width$}  {header}", "TIME")),
            Format::Json => Ok(()),
            Format::Csv => self.output.csv_line(&self.columns().iter().map(String::as_str).collect::<Vec<_>>()),
        }
    }

    pub(super) fn sample(&mut self, sample: Sample) -> Result<(), Failure> {
        let lines = match &mut self.layout {
            Layout::Lines(lines) => vec![lines.line(&sample)],
            Layout::Wide(wide) => wide.take(sample, SystemTime::now()),
        };
        lines.into_iter().try_for_each(|line| self.line(line))
    }

    /// Prints the last readings, if samples of them were missed. `ended`: the readings of each PLC.
    pub(super) fn finish(&mut self, ended: &[u64]) -> Result<(), Failure> {
        let lines = match &mut self.layout {
            Layout::Lines(_) => Vec::new(),
            Layout::Wide(wide) => wide.finish_missed(ended, SystemTime::now()),
        };
        lines.into_iter().try_for_each(|line| self.line(line))
    }

    fn line(&mut self, line: Line) -> Result<(), Failure> {
        self.count += 1;
        let Line { table, time, cells, mut json } = line;
        let time = self.time_format.format(time);
        let csv: Vec<&str> = std::iter::once(&*time).chain(cells.iter().map(Cell::csv)).collect();
        // The log first: it stays if the reader of stdout has closed it.
        if self.log.is_some() {
            let text = self.csv(&csv)?;
            self.log.iter_mut().try_for_each(|log| log.line(&text))?;
        }
        match self.output.format {
            Format::Table => print(format_args!("{}", format!("{time}  {table}").trim_end())),
            Format::Json => {
                json.shift_insert(0, "time".to_owned(), time.into());
                self.output.json_line(&json.into())
            }
            Format::Csv => self.output.csv_line(&csv),
        }
    }

    fn csv(&self, cells: &[&str]) -> Result<Vec<u8>, Failure> {
        self.output.csv_text([cells].into_iter(), false).map_err(Failure::Output)
    }
}
