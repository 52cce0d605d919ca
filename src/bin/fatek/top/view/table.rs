//! Tables whose columns fit the width of the terminal.

use std::borrow::Cow;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::Span;

use crate::top::theme::Theme;

/// Blanks between two columns.
const GAP: usize = 2;

/// A column. Narrow terminals leave out those of the lowest rank.
#[derive(Clone, Copy, Debug)]
pub(super) struct Column<C> {
    pub(super) id: C,
    pub(super) title: &'static str,
    pub(super) width: usize,
    /// 0 is always shown.
    pub(super) rank: u8,
    pub(super) is_right: bool,
}

/// A cell of a row.
#[derive(Clone, Debug)]
pub(super) struct Cell {
    pub(super) text: String,
    pub(super) style: Style,
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self { text, style: Style::new() }
    }
}

/// Leaves out columns until the others fit.
pub(super) fn fit<C>(mut columns: Vec<Column<C>>, width: usize) -> Vec<Column<C>> {
    while total(&columns) > width {
        let worst = columns.iter().enumerate().max_by_key(|(_, column)| column.rank);
        match worst.map(|(place, column)| (place, column.rank)) {
            Some((place, 1..)) => drop(columns.remove(place)),
            Some((_, 0)) | None => break,
        }
    }
    columns
}

/// Columns that the others leave free.
pub(super) fn rest<C>(columns: &[Column<C>], width: usize) -> usize {
    width.saturating_sub(total(columns))
}

fn total<C>(columns: &[Column<C>]) -> usize {
    columns.iter().map(|column| column.width + GAP).sum::<usize>().saturating_sub(GAP)
}

/// Draws a header, unless there is one line only, and a row for each item.
pub(super) fn draw<C: Copy>(
    columns: &[Column<C>],
    items: &[usize],
    cell: impl Fn(usize, C) -> Cell,
    (selected, theme): (Option<usize>, Theme),
    (area, buffer): (Rect, &mut Buffer),
) {
    let mut lines = (area.y..area.bottom()).map(|y| Rect { y, height: 1, ..area });
    if area.height > 1
        && let Some(line) = lines.next()
    {
        let title = |column: &Column<C>| Cell { text: column.title.to_owned(), style: theme.header() };
        row(columns, title, line, buffer);
    }
    for (&item, line) in items.iter().zip(lines) {
        row(columns, |column| cell(item, column.id), line, buffer);
        if selected == Some(item) {
            buffer.set_style(line, theme.selected());
        }
    }
}

fn row<C>(columns: &[Column<C>], cell: impl Fn(&Column<C>) -> Cell, line: Rect, buffer: &mut Buffer) {
    let mut left = usize::from(line.x);
    for column in columns {
        let free = usize::from(line.right()).saturating_sub(left);
        let Cell { text, style } = cell(column);
        let shown = column.width.min(free);
        let text = cut(&text, shown);
        let indent = if column.is_right { shown.saturating_sub(width(&text)) } else { 0 };
        // Within the line, whose columns are those of a terminal.
        let x = left.saturating_add(indent) as u16;
        buffer.set_stringn(x, line.y, &text, shown, style);
        left = left.saturating_add(column.width + GAP);
    }
}

/// Width of a text in columns.
pub(in crate::top) fn width(text: &str) -> usize {
    if text.is_ascii() { text.len() } else { Span::raw(text).width() }
}

/// Cuts a text to this number of columns, with an ellipsis.
pub(super) fn cut(text: &str, columns: usize) -> Cow<'_, str> {
    if width(text) <= columns {
        return text.into();
    }
    let mut kept = String::new();
    let mut used = 1;
    for character in text.chars() {
        used += width(character.encode_utf8(&mut [0; 4]));
        if used > columns {
            break;
        }
        kept.push(character);
    }
    if columns > 0 {
        kept.push('…');
    }
    kept.into()
}

/// The end of a text in this number of columns.
pub(super) fn end(text: &str, columns: usize) -> String {
    let mut used = 0;
    let fits = |&(_, character): &(usize, char)| {
        used += width(character.encode_utf8(&mut [0; 4]));
        used <= columns
    };
    let from = text.char_indices().rev().take_while(fits).last().map_or(text.len(), |(place, _)| place);
    text[from..].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_cut_by_columns() {
        for (text, columns, expected) in [
            ("level", 5, "level"),
            ("level", 4, "lev…"),
            ("level", 1, "…"),
            ("level", 0, ""),
            ("中中中", 5, "中中…"),
            ("中中中", 4, "中…"),
            ("", 0, ""),
        ] {
            let shown = cut(text, columns);
            assert_eq!(shown, expected, "{columns}");
            assert!(width(&shown) <= columns);
        }
        assert_eq!(
            (end("level", 3), end("level", 9), end("a中", 2), end("a中", 1)),
            ("vel".into(), "level".into(), "中".into(), "".into())
        );
    }

    #[test]
    fn columns_of_low_rank_are_left_out_first() {
        let column = |id, width, rank| Column { id, title: "", width, rank, is_right: false };
        let ids = |width| {
            let columns = vec![column('a', 10, 0), column('b', 5, 2), column('c', 5, 1)];
            fit(columns, width).iter().map(|column| column.id).collect::<String>()
        };
        assert_eq!(
            (ids(24), ids(23), ids(17), ids(16), ids(0)),
            ("abc".into(), "ac".into(), "ac".into(), "a".into(), "a".into())
        );
    }
}
