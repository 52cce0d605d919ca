//! Table of the tags.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;

use super::table::{self, Cell, Column, width};
use crate::printable::printable;
use crate::top::layout::Areas;
use crate::top::model::{Focus, Model};
use crate::top::theme::Theme;

#[derive(Clone, Copy, Debug)]
enum Id {
    Plc,
    Tag,
    Value,
    Unit,
    Quality,
    Age,
    Trend,
}

/// Widest trend.
const MAX_TREND: usize = 120;
/// Narrowest trend that is shown.
const MIN_TREND: usize = 8;

pub(super) fn draw(model: &Model, theme: Theme, area: Rect, buffer: &mut Buffer) {
    if area.is_empty() {
        return;
    }
    let columns = columns(model, area.width.into());
    let data = model.data();
    let cell = |tag: usize, id: Id| -> Cell {
        let (info, state) = (&model.tags[tag], &data.tags[tag]);
        match id {
            Id::Plc => model.plcs[info.plc].label.clone().into(),
            Id::Tag => info.label.clone().into(),
            Id::Value => {
                let value = state.value.as_ref().map(|value| printable(&value.to_string()).to_string());
                value.unwrap_or_else(|| "-".to_owned()).into()
            }
            Id::Unit => info.unit.clone().into(),
            Id::Quality => Cell { text: state.level.word().to_owned(), style: theme.level(state.level) },
            Id::Age => state.at.map(|at| age(data.now.saturating_duration_since(at))).unwrap_or_default().into(),
            Id::Trend => {
                let width = columns.last().map_or(0, |column| column.width);
                Cell { text: state.history.sparkline(width), style: theme.sparkline() }
            }
        }
    };
    let selected = model.tag_list.selected().filter(|_| model.focus == Focus::Tags);
    let items = model.tag_list.shown(Areas::rows(area));
    table::draw(&columns, items, cell, (selected, theme), (area, buffer));
}

/// The columns for a width. The trend, which is the last one, takes the rest.
fn columns(model: &Model, total: usize) -> Vec<Column<Id>> {
    let column = |id, title, width, rank, is_right| Column { id, title, width, rank, is_right };
    let widest = |width: &dyn Fn(usize) -> usize| (0..model.tags.len()).map(width).max().unwrap_or(0);
    let (wide, is_wide) = (total >= 100, total >= 40);
    let label = widest(&|tag| width(&model.tags[tag].label)).clamp(3, if wide { 32 } else { 18 });
    let value = if wide { 20 } else { 12 };
    let mut columns = Vec::new();
    if model.plcs.len() > 1 {
        let plc = model.plcs.iter().map(|plc| width(&plc.label)).max().unwrap_or(0);
        columns.push(column(Id::Plc, "PLC", plc.clamp(3, if wide { 16 } else { 10 }), 2, false));
    }
    columns.push(column(Id::Tag, "TAG", if is_wide { label } else { label.min(total / 2).max(1) }, 0, false));
    columns.push(column(Id::Value, "VALUE", value, 0, true));
    let unit = widest(&|tag| width(&model.tags[tag].unit));
    if unit > 0 {
        columns.push(column(Id::Unit, "UNIT", unit.clamp(4, 8), 4, false));
    }
    columns.push(column(Id::Quality, "QUALITY", 7, 1, false));
    columns.push(column(Id::Age, "AGE", 4, 3, true));
    let mut columns = table::fit(columns, total);
    let rest = table::rest(&columns, total);
    if rest >= MIN_TREND + 2 {
        columns.push(column(Id::Trend, "TREND", (rest - 2).min(MAX_TREND), 5, false));
    }
    columns
}

/// An age in at most four characters.
pub(crate) fn age(age: Duration) -> String {
    match age.as_secs() {
        seconds @ ..100 => format!("{seconds}s"),
        seconds @ 100..6_000 => format!("{}m", seconds / 60),
        seconds @ 6_000..360_000 => format!("{}h", seconds / 3600),
        seconds => format!("{}d", (seconds / 86_400).min(999)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ages_have_four_characters_at_most() {
        for (seconds, expected) in [
            (0, "0s"),
            (99, "99s"),
            (100, "1m"),
            (5_999, "99m"),
            (6_000, "1h"),
            (359_999, "99h"),
            (360_000, "4d"),
            (u64::MAX, "999d"),
        ] {
            assert_eq!(age(Duration::from_secs(seconds)), expected);
        }
    }
}
