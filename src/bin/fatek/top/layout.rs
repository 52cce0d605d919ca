//! Areas of the display: which lines show the title, the PLCs, the tags, the details and the keys.

use ratatui::layout::{Rect, Size};

/// The areas from top to bottom. Each may have no lines: a small terminal shows the selected rows
/// alone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Areas {
    pub(super) title: Rect,
    pub(super) plcs: Rect,
    pub(super) tags: Rect,
    /// The selected item in full.
    pub(super) details: Rect,
    /// Message, line to be edited, or the keys.
    pub(super) foot: Rect,
}

impl Areas {
    /// Areas of a terminal of this size. `edits`: the foot is a line to be edited, and is always
    /// shown.
    pub(super) fn new(size: Size, plcs: usize, tags: usize, edits: bool) -> Self {
        let height = size.height;
        let foot = u16::from(edits || height >= 3);
        let title = u16::from(height >= 5);
        let details = match height {
            0..8 => 0,
            8..20 => 1,
            20.. => 2,
        };
        let rest = height.saturating_sub(foot + title + details);
        // With their header, and at most a third. A small terminal shows the tags.
        let plc_lines = u16::try_from(plcs.saturating_add(1)).unwrap_or(u16::MAX);
        let plcs = match (tags, height) {
            (0, _) => rest,
            (_, 0..8) => 0,
            (_, 8..) => plc_lines.min((height / 3).max(2)),
        };
        // A blank line between the tables.
        let gap = u16::from(tags > 0 && plcs > 0 && height >= 16);
        let lines = [title, plcs, gap, rest.saturating_sub(plcs + gap), details, foot];
        let mut from = 0;
        let [title, plcs, _, tags, details, foot] = lines.map(|lines| {
            let lines = lines.min(height - from);
            let area = Rect::new(0, from, size.width, lines);
            from += lines;
            area
        });
        Self { title, plcs, tags, details, foot }
    }

    /// Number of rows of a table below its header. A table of one line has no header.
    pub(super) fn rows(table: Rect) -> usize {
        usize::from(if table.height > 1 { table.height - 1 } else { table.height })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn heights(height: u16, plcs: usize, tags: usize, edits: bool) -> [u16; 5] {
        let areas = Areas::new(Size::new(80, height), plcs, tags, edits);
        [areas.title, areas.plcs, areas.tags, areas.details, areas.foot].map(|area| area.height)
    }

    #[test]
    fn every_size_shows_a_selected_row_or_the_line_to_be_edited() {
        for (height, expected) in [
            (24, [1, 4, 15, 2, 1]),
            (16, [1, 4, 8, 1, 1]),
            (10, [1, 3, 4, 1, 1]),
            (5, [1, 0, 3, 0, 1]),
            (3, [0, 0, 2, 0, 1]),
            (2, [0, 0, 2, 0, 0]),
            (1, [0, 0, 1, 0, 0]),
            (0, [0, 0, 0, 0, 0]),
        ] {
            assert_eq!(heights(height, 3, 100, false), expected, "{height}");
        }
        assert_eq!(heights(1, 3, 100, true), [0, 0, 0, 0, 1]);
        assert_eq!(heights(0, 3, 100, true), [0; 5]);
    }

    #[test]
    fn without_tags_the_plcs_have_their_lines() {
        assert_eq!(heights(24, 3, 0, false), [1, 20, 0, 2, 1]);
        assert_eq!(heights(1, 3, 0, false), [0, 1, 0, 0, 0]);
        assert_eq!(heights(24, 254, 5, false), [1, 8, 11, 2, 1]);
    }

    #[test]
    fn areas_do_not_overlap_and_fill_the_terminal() {
        for height in 0..60 {
            for (plcs, tags) in [(1, 0), (1, 5), (254, 1000)] {
                let sum: u16 = heights(height, plcs, tags, true).iter().sum();
                assert!(sum == height || sum + 1 == height, "{height}: {sum}");
            }
        }
    }
}
