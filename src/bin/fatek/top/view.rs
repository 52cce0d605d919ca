//! Drawing of the dashboard.

mod plcs;
mod table;
mod tags;

use humantime::format_duration;
use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::{Position, Rect};
use ratatui::style::Style;
use ratatui::widgets::{Block, Clear, Widget};

use super::dialog::{Prompt, wrapped};
use super::model::{Focus, Mode, Model};
use super::order::Order;
use super::theme::Theme;

use self::table::cut;
pub(super) use self::table::width;

/// Keys at the foot.
const KEYS: &str = "q quit  ? help  / filter  s sort  r reverse  space pause  w write  tab table";
const PLC_KEYS: &str = "q quit  ? help  / filter  space pause";

const HELP: [&str; 13] = [
    "up down j k        select a row; also PgUp PgDn, Home End, g G",
    "tab                to the other table",
    "s, r               next sort key; reverse the order",
    "/                  filter by PLC, name and element; Esc clears it",
    "space, p           pause the display; polling goes on",
    "w, Enter           write a value to the selected tag, after a prompt",
    "Ctrl-L             redraw the screen",
    "?, h               this help",
    "q, Ctrl-C          quit",
    "",
    "Round trips in ms: the last one, moving average, longest.",
    "ERRORS: bad replies and refusals. AGE: since the value was read.",
    "TREND: recent values, from the lowest to the highest of them.",
];

/// Draws a frame.
pub(super) fn draw(model: &Model, theme: Theme, frame: &mut Frame<'_>) {
    let areas = model.areas();
    // A terminal that has just become smaller has areas of the old size.
    let fit = |area: Rect, frame: &Frame<'_>| area.intersection(frame.area());
    title(model, theme, fit(areas.title, frame), frame.buffer_mut());
    plcs::draw(model, theme, fit(areas.plcs, frame), frame.buffer_mut());
    tags::draw(model, theme, fit(areas.tags, frame), frame.buffer_mut());
    details(model, fit(areas.details, frame), frame.buffer_mut());
    foot(model, theme, fit(areas.foot, frame), frame);
    match &model.mode {
        Mode::Normal | Mode::Filter { .. } | Mode::Value { .. } => {}
        Mode::Help => {
            let width = frame.area().width.min(68);
            let height = frame.area().height.min(HELP.len() as u16 + 2);
            let [x, y] = [(frame.area().width - width) / 2, (frame.area().height - height) / 2];
            window("Keys", &HELP, Rect::new(x, y, width, height), frame.buffer_mut());
        }
        Mode::Confirm(draft) => {
            let prompt = Prompt::new(model, draft, model.size);
            let lines: Vec<&str> = prompt.lines.iter().map(String::as_str).collect();
            window("Write", &lines, fit(prompt.area, frame), frame.buffer_mut());
        }
    }
}

fn title(model: &Model, theme: Theme, area: Rect, buffer: &mut Buffer) {
    let count = |number: usize, thing: &str| format!("{number} {thing}{}", if number == 1 { "" } else { "s" });
    let mut parts = vec!["fatek top".to_owned(), count(model.plcs.len(), "PLC")];
    if model.frozen.is_some() {
        parts.insert(0, "PAUSED".to_owned());
    }
    let order = model.order;
    if !model.tags.is_empty() {
        parts.push(count(model.tags.len(), "tag"));
        if order != Order::default() {
            parts.push(format!("{}{}", order.key.word(), if order.is_reversed { ", reversed" } else { "" }));
        }
    }
    parts.push(format!("every {}", format_duration(model.settings.interval)));
    if !model.filter.is_empty() {
        let shown = if model.tags.is_empty() { model.plc_list.len() } else { model.tag_list.len() };
        parts.push(format!("/{} ({shown} shown)", model.filter));
    }
    buffer.set_style(area, theme.title());
    put(buffer, area, 0, &format!(" {}", parts.join(" · ")), theme.title());
}

/// The selected item in full.
fn details(model: &Model, area: Rect, buffer: &mut Buffer) {
    let data = model.data();
    let text = match (model.focus, model.tag_list.selected(), model.plc_list.selected()) {
        (Focus::Tags, Some(tag), _) => {
            let (info, state) = (&model.tags[tag], &data.tags[tag]);
            let elements = info.named.tag.to_string();
            let mut parts = vec![model.subject(tag)];
            parts.extend((elements != info.label).then_some(elements));
            parts.extend((!info.comment.is_empty()).then(|| info.comment.clone()));
            parts.extend(state.value.as_ref().map(|value| crate::printable::printable(&value.to_string()).to_string()));
            parts.extend((!state.reason.is_empty()).then(|| format!("{}: {}", state.level.word(), state.reason)));
            parts.join("  ")
        }
        (Focus::Plcs, _, Some(plc)) => {
            let (info, state) = (&model.plcs[plc], &data.plcs[plc]);
            let mut parts = vec![info.label.clone(), info.address.clone()];
            parts.extend(state.flags.map(|flags| flags.to_string()));
            let reason = state.trouble.as_ref().map(|trouble| &trouble.text);
            let reason = reason.or(Some(&state.health.reason)).filter(|reason| !reason.is_empty());
            parts.extend(reason.cloned());
            parts.join("  ")
        }
        (Focus::Tags, None, _) | (Focus::Plcs, _, None) => "nothing matches the filter".to_owned(),
    };
    // On both lines, if there are two.
    let lines = wrapped(&text, usize::from(area.width.saturating_sub(1)));
    for (number, line) in (0..area.height).zip(&lines) {
        let is_cut = number + 1 == area.height && lines.len() > usize::from(area.height);
        let line = if is_cut { format!("{line}…") } else { line.clone() };
        put(buffer, area, number, &line, Style::new());
    }
}

/// The line that is edited, the message, or the keys.
fn foot(model: &Model, theme: Theme, area: Rect, frame: &mut Frame<'_>) {
    if area.is_empty() {
        return;
    }
    let input = match &model.mode {
        Mode::Filter { .. } => Some((format!("/{}", model.filter), None)),
        Mode::Value { tag, text, error } => {
            Some((format!("new value of {}: {text}", model.subject(*tag)), error.as_deref()))
        }
        Mode::Normal | Mode::Help | Mode::Confirm(_) => None,
    };
    let failure = model.shown_failure();
    if let Some(failure) = failure.filter(|_| Model::has_notices(area)) {
        notice("Write not confirmed; Esc closes", &failure.text, area, frame.buffer_mut());
    }
    let Some((text, error)) = input else {
        let (text, style) = match (&model.message, failure) {
            (_, Some(failure)) if !Model::has_notices(area) => (failure.text.as_str(), theme.trouble()),
            (Some(message), _) if message.is_error => (message.text.as_str(), theme.trouble()),
            (Some(message), _) => (message.text.as_str(), theme.header()),
            (None, _) if model.tags.is_empty() => (PLC_KEYS, Style::new()),
            (None, _) => (KEYS, Style::new()),
        };
        return put(frame.buffer_mut(), area, 0, text, style);
    };
    // The end of a long text is shown, with the cursor behind it.
    let columns = usize::from(area.width.saturating_sub(1));
    let line = table::end(&text, columns);
    put(frame.buffer_mut(), area, 0, &line, theme.header());
    let width = u16::try_from(width(&line)).unwrap_or(u16::MAX);
    frame.set_cursor_position(Position::new(area.x.saturating_add(width).min(area.right() - 1), area.y));
    if let Some(error) = error {
        notice("Not accepted", error, area, frame.buffer_mut());
    }
}

/// Draws a text in a window above the foot.
fn notice(title: &str, text: &str, foot: Rect, buffer: &mut Buffer) {
    let lines: Vec<String> = wrapped(text, usize::from(foot.width.clamp(5, 76) - 4));
    let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
    let height = (lines.len() as u16).saturating_add(2).min(foot.y);
    window(title, &lines, Rect::new(0, foot.y - height, foot.width.min(76), height), buffer);
}

/// Draws lines in a frame, over the tables.
fn window(title: &str, lines: &[&str], area: Rect, buffer: &mut Buffer) {
    Clear.render(area, buffer);
    let block = Block::bordered().title(format!(" {title} "));
    let inner = block.inner(area);
    block.render(area, buffer);
    for (number, line) in (0..inner.height).zip(lines) {
        let [left, width] = [inner.x.saturating_add(1), inner.width.saturating_sub(1)];
        put(buffer, Rect::new(left, inner.y, width, inner.height), number, line, Style::new());
    }
}

/// Writes a text to a line of an area, cut at its width.
fn put(buffer: &mut Buffer, area: Rect, line: u16, text: &str, style: Style) {
    if line < area.height {
        buffer.set_stringn(area.x, area.y + line, cut(text, area.width.into()), area.width.into(), style);
    }
}
