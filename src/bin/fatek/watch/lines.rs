//! A line per value.

use std::collections::HashMap;

use fatek::poll::{Sample, TagId};
use serde_json::Map;

use super::printer::{Line, Place};
use crate::output::Cell;

/// Lines with the columns tag, value and quality.
#[derive(Debug)]
pub(super) struct Lines {
    /// Width of the tag column in characters.
    width: usize,
}

const COLUMNS: [&str; 3] = ["tag", "value", "quality"];

impl Lines {
    /// `plcs`: their names, which are part of the names of tags if there are several.
    pub(super) fn new(places: &HashMap<TagId, Place>, plcs: &[String]) -> Self {
        let plc = |place: &Place| plcs.get(place.plc).filter(|_| plcs.len() > 1);
        let prefix = |place: &Place| plc(place).map_or(0, |plc| plc.chars().count() + 1);
        let widths = places.values().map(|place| prefix(place) + place.label.chars().count());
        Self { width: widths.max().unwrap_or(0).max(3) }
    }

    pub(super) fn columns(&self) -> Vec<String> {
        COLUMNS.map(str::to_owned).into()
    }

    pub(super) fn header(&self) -> String {
        format!("{:1$}  VALUE", "TAG", self.width)
    }

    pub(super) fn line(&self, sample: &Sample) -> Line {
        let width = self.width;
        let value = Cell::from(sample.value().cloned());
        let (name, quality) = (sample.name.to_string(), sample.quality.to_string());
        let shown = match (sample.is_good(), value.text.is_empty()) {
            (true, _) => value.text.clone(),
            (false, true) => format!("({quality})"),
            (false, false) => format!("{} ({quality})", value.text),
        };
        let table = format!("{name:width$}  {shown}");
        let cells = [name.into(), value, quality.into()];
        let json =
            COLUMNS.into_iter().zip(&cells).map(|(column, cell): (_, &Cell)| (column.to_owned(), cell.json.clone()));
        Line { table, time: sample.at.time, json: json.collect::<Map<_, _>>(), cells: cells.into() }
    }
}
