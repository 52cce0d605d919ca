//! Tables of text with aligned columns.

use std::fmt;

use crate::printable::printable;

/// A table. Columns are as wide as their widest cell, and two blanks apart.
#[derive(Clone, Debug)]
pub(crate) struct Columns<const N: usize> {
    rows: Vec<[String; N]>,
    right: [bool; N],
}

impl<const N: usize> Columns<N> {
    /// A table with these titles.
    pub(crate) fn new(titles: [&str; N]) -> Self {
        Self { rows: vec![titles.map(str::to_owned)], right: [false; N] }
    }

    /// Aligns these columns to the right.
    pub(crate) fn right(mut self, columns: impl IntoIterator<Item = usize>) -> Self {
        for column in columns {
            if let Some(right) = self.right.get_mut(column) {
                *right = true;
            }
        }
        self
    }

    /// Adds a row. Control characters are escaped.
    pub(crate) fn row(&mut self, cells: [String; N]) {
        self.rows.push(cells.map(|cell| printable(&cell).to_string()));
    }
}

impl<const N: usize> fmt::Display for Columns<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut widths = [0; N];
        for row in &self.rows {
            for (width, cell) in widths.iter_mut().zip(row) {
                *width = cell.chars().count().max(*width);
            }
        }
        for row in &self.rows {
            let mut line = String::new();
            for ((cell, width), right) in row.iter().zip(widths).zip(self.right) {
                let separator = if line.is_empty() { "" } else { "  " };
                line.push_str(separator);
                line.push_str(&if right { format!("{cell:>width$}") } else { format!("{cell:<width$}") });
            }
            writeln!(f, "{}", line.trim_end())?;
        }
        Ok(())
    }
}

/// A text of at most this width: of a longer one the beginning and the end.
pub(crate) fn cut(text: &str, width: usize) -> String {
    let count = text.chars().count();
    let kept = width.saturating_sub(2);
    if count <= width {
        return text.to_owned();
    }
    let head = kept.div_ceil(2);
    let tail = kept.saturating_sub(head);
    let end: String = text.chars().skip(count.saturating_sub(tail)).collect();
    format!("{}..{end}", text.chars().take(head).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_and_texts_escaped() {
        let mut columns = Columns::new(["NAME", "COUNT"]).right([1]);
        columns.row(["a\u{1b}".to_owned(), "7".to_owned()]);
        columns.row(["é".to_owned(), "12345678".to_owned()]);
        assert_eq!(columns.to_string(), "NAME        COUNT\na\\u{1b}         7\né        12345678\n");
    }

    #[test]
    fn a_long_text_keeps_its_ends() {
        assert_eq!(cut("tcp://host", 10), "tcp://host");
        assert_eq!(cut("serial:/dev/serial/by-id/usb-FTDI?baud=19200", 20), "serial:/d..aud=19200");
        assert_eq!(cut("abc", 2), "..");
    }
}
