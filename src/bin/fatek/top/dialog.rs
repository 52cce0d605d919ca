//! The prompt before a write.

use ratatui::layout::{Rect, Size};
use tokio::time::Instant;

use super::model::{Level, Model};
use super::view::width;
use crate::printable::printable;
use crate::write::Write;

/// A write that is to be confirmed.
#[derive(Clone, Debug)]
pub(super) struct Draft {
    pub(super) tag: usize,
    pub(super) write: Write,
    /// The values that are stored by it, printable.
    pub(super) values: String,
    /// Time of the first frame: a key that was typed before is no answer.
    pub(super) shown_at: Option<Instant>,
}

impl Draft {
    pub(super) fn new(tag: usize, write: Write) -> Self {
        let values: Vec<String> = write.stored_values().iter().map(ToString::to_string).collect();
        Self { tag, write, values: printable(&values.join(",")).to_string(), shown_at: None }
    }
}

/// Widest prompt.
const MAX_WIDTH: u16 = 76;

/// Question of the prompt.
const QUESTION: &str = "Write it? y: yes, any other key: no";

/// The lines of a prompt and the place of its frame.
#[derive(Clone, Debug)]
pub(super) struct Prompt {
    pub(super) lines: Vec<String>,
    pub(super) area: Rect,
    /// `false` if the terminal is too small to show all of it. It cannot be confirmed then.
    pub(super) is_whole: bool,
}

impl Prompt {
    /// The prompt for a draft on a terminal of this size.
    pub(super) fn new(model: &Model, draft: &Draft, size: Size) -> Self {
        let width = size.width.min(MAX_WIDTH);
        // Frame and a blank on both sides.
        let (columns, height) = (usize::from(width.saturating_sub(4)), size.height);
        let fields = fields(model, draft);
        let lines: Vec<String> = fields
            .iter()
            .flat_map(|(name, text)| wrapped(&format!("{name:5}{text}"), columns))
            .chain(wrapped(QUESTION, columns))
            .collect();
        let needed = u16::try_from(lines.len()).unwrap_or(u16::MAX).saturating_add(2);
        let is_whole = columns >= 12 && needed <= height;
        let shown = needed.min(height);
        let area = Rect::new((size.width - width) / 2, (height - shown) / 2, width, shown);
        Self { lines, area, is_whole }
    }
}

/// PLC, tag, present value and new value.
fn fields(model: &Model, draft: &Draft) -> [(&'static str, String); 4] {
    let info = &model.tags[draft.tag];
    let plc = &model.plcs[info.plc];
    // Also while the display is paused.
    let state = &model.live.tags[draft.tag];
    let with_unit = |value: String| if info.unit.is_empty() { value } else { format!("{value} {}", info.unit) };
    let present = match &state.value {
        Some(value) => with_unit(printable(&value.to_string()).to_string()),
        None => "no value".to_owned(),
    };
    let present = match state.level {
        Level::Good => present,
        Level::Unread => format!("{present} (not read yet)"),
        Level::Bad | Level::Stale => format!("{present} ({}: {})", state.level.word(), state.reason),
    };
    let elements = draft.write.tag().to_string();
    let tag = if info.label == elements { elements } else { format!("{} ({elements})", info.label) };
    [
        ("PLC", format!("{} ({})", plc.label, plc.address)),
        ("Tag", tag),
        ("Now", present),
        ("New", with_unit(draft.values.clone())),
    ]
}

/// Breaks a text into lines of this number of columns: at blanks, or within long words.
pub(super) fn wrapped(text: &str, columns: usize) -> Vec<String> {
    let (mut lines, mut line, mut used) = (Vec::new(), String::new(), 0);
    for character in text.chars() {
        let width = width(character.encode_utf8(&mut [0; 4]));
        if used + width > columns && !line.is_empty() {
            // At the last blank in the second half of the line.
            let blank = line.rfind(' ').map(|blank| blank + 1).filter(|place| *place > line.len() / 2);
            let next = line.split_off(blank.unwrap_or(line.len()));
            lines.push(std::mem::replace(&mut line, next).trim_end().to_owned());
            used = self::width(&line);
        }
        line.push(character);
        used += width;
    }
    lines.push(line);
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_wrapped_by_columns() {
        assert_eq!(wrapped("abcdefg", 3), ["abc", "def", "g"]);
        assert_eq!(wrapped("中中a", 3), ["中", "中a"]);
        assert_eq!(wrapped("one two three", 8), ["one two", "three"]);
        assert_eq!(wrapped("a verylongword", 6), ["a very", "longwo", "rd"]);
        assert_eq!(wrapped("", 3), [""]);
        assert_eq!(wrapped("ab", 0), ["a", "b"], "no line is without a character");
    }
}
