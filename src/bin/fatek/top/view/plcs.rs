//! Table of the PLCs.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;

use super::table::{self, Cell, Column, width};
use crate::top::layout::Areas;
use crate::top::model::{Connection, Focus, Model};
use crate::top::theme::Theme;

#[derive(Clone, Copy, Debug)]
enum Id {
    Plc,
    Link,
    Station,
    Mode,
    Last,
    Mean,
    Longest,
    Requests,
    Errors,
    Timeouts,
    Retries,
    Address,
}

pub(super) fn draw(model: &Model, theme: Theme, area: Rect, buffer: &mut Buffer) {
    let label = model.plcs.iter().map(|plc| width(&plc.label)).max().unwrap_or(0).clamp(5, 16);
    let column = |id, title, width, rank, is_right| Column { id, title, width, rank, is_right };
    let mut columns = table::fit(
        vec![
            column(Id::Plc, "PLC", label, 0, false),
            column(Id::Link, "LINK", 7, 2, false),
            column(Id::Station, "STATION", 9, 0, false),
            column(Id::Mode, "MODE", 4, 3, false),
            column(Id::Last, "LAST", 6, 4, true),
            column(Id::Mean, "MEAN", 6, 7, true),
            column(Id::Longest, "MAX", 6, 6, true),
            column(Id::Requests, "REQ", 7, 8, true),
            column(Id::Errors, "ERRORS", 6, 3, true),
            column(Id::Timeouts, "T/O", 5, 4, true),
            column(Id::Retries, "RETRY", 5, 5, true),
        ],
        area.width.into(),
    );
    let rest = table::rest(&columns, area.width.into());
    if rest >= 22 {
        columns.push(column(Id::Address, "ADDRESS", rest - 2, 9, false));
    }
    let data = model.data();
    let cell = |plc: usize, id: Id| -> Cell {
        let (info, state) = (&model.plcs[plc], &data.plcs[plc]);
        let counters = state.health.counters;
        let trip = counters.round_trip;
        match id {
            Id::Plc => info.label.clone().into(),
            Id::Link => {
                let style = match state.health.connection {
                    Connection::Up => theme.fine(),
                    Connection::Down | Connection::Closed => theme.trouble(),
                    Connection::Idle | Connection::Opening => ratatui::style::Style::new(),
                };
                Cell { text: state.health.connection.word().to_owned(), style }
            }
            Id::Station => {
                let style = match (state.is_troubled(), state.health.has_answered) {
                    (true, _) => theme.trouble(),
                    (false, true) => theme.fine(),
                    (false, false) => ratatui::style::Style::new(),
                };
                Cell { text: state.station_word().to_owned(), style }
            }
            Id::Mode => match state.flags.map(|flags| flags.running()) {
                Some(true) => "run".to_owned().into(),
                Some(false) => Cell { text: "stop".to_owned(), style: theme.header() },
                None => "-".to_owned().into(),
            },
            Id::Last => milliseconds(trip.map(|trip| trip.last)).into(),
            Id::Mean => milliseconds(trip.map(|trip| trip.mean)).into(),
            Id::Longest => milliseconds(trip.map(|trip| trip.longest)).into(),
            Id::Requests => counters.requests.to_string().into(),
            Id::Errors => number(counters.errors, theme),
            Id::Timeouts => number(counters.timeouts, theme),
            Id::Retries => number(counters.retries, theme),
            Id::Address => info.address.clone().into(),
        }
    };
    let selected = model.plc_list.selected().filter(|_| model.focus == Focus::Plcs);
    let items = model.plc_list.shown(Areas::rows(area));
    table::draw(&columns, items, cell, (selected, theme), (area, buffer));
}

/// A counter of troubles.
fn number(count: u64, theme: Theme) -> Cell {
    let style = if count > 0 { theme.header() } else { ratatui::style::Style::new() };
    Cell { text: count.to_string(), style }
}

/// A time in milliseconds, with three digits or more.
fn milliseconds(time: Option<Duration>) -> String {
    let Some(time) = time else { return "-".to_owned() };
    let milliseconds = time.as_secs_f64() * 1e3;
    match milliseconds {
        ..9.995 => format!("{milliseconds:.2}"),
        ..99.95 => format!("{milliseconds:.1}"),
        _ => format!("{milliseconds:.0}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trips_have_three_digits() {
        for (micros, expected) in
            [(0, "0.00"), (123, "0.12"), (9_994, "9.99"), (9_996, "10.0"), (99_960, "100"), (1_234_567, "1235")]
        {
            assert_eq!(milliseconds(Some(Duration::from_micros(micros))), expected);
        }
        assert_eq!(milliseconds(None), "-");
    }
}
