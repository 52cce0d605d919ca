//! State of the dashboard: the PLCs and tags with their latest values, and the state of the
//! display.
//!
//! Nothing here does I/O or reads a clock: [`Model::update`] takes events, and returns what is to
//! be done.
//!
//! Invariants:
//! - A value is sent only after a `y` that was typed at a prompt, which was shown whole, with PLC,
//!   tag, present and new value.
//! - One write at a time waits for its result. A failure is shown before the next write begins.
//! - The lists are in order after each key: the next one is for what the display will show.
//! - While the display is paused, `live` goes on, and `frozen` is shown. Prompts have the live
//!   value.

use std::time::Duration;

use fatek::command::StatusFlags;
use fatek::tag::TagValue;
use ratatui::layout::{Rect, Size};
use tokio::time::Instant;

use super::dialog::Draft;
use super::history::History;
use super::layout::Areas;
use super::list::List;
use super::order::Order;
use crate::names::{NamedTag, Table};
use crate::printable::printable;
use crate::screen::Key;
use crate::write::Write;

/// Settings of the command line.
#[derive(Clone, Copy, Debug)]
pub(super) struct Settings {
    pub(super) interval: Duration,
    pub(super) special: bool,
    pub(super) read_only: bool,
}

/// A PLC as configured. All texts are printable.
#[derive(Debug)]
pub(super) struct PlcInfo {
    pub(super) label: String,
    /// Link and station.
    pub(super) address: String,
    pub(super) names: Table,
}

/// A tag as configured. All texts are printable.
#[derive(Debug)]
pub(super) struct TagInfo {
    /// Number of its PLC.
    pub(super) plc: usize,
    pub(super) label: String,
    pub(super) named: NamedTag,
    pub(super) unit: String,
    pub(super) comment: String,
    /// Text that a filter is searched in: PLC, label and elements in lower case.
    pub(super) searched: String,
}

/// State of a connection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Connection {
    #[default]
    Idle,
    Opening,
    Up,
    Down,
    Closed,
}

/// Counters of a PLC.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Counters {
    pub(super) round_trip: Option<RoundTrip>,
    pub(super) requests: u64,
    /// Bad replies and refusals.
    pub(super) errors: u64,
    pub(super) timeouts: u64,
    pub(super) retries: u64,
}

/// Round trips: the last one, a moving average, and the longest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct RoundTrip {
    pub(super) last: Duration,
    pub(super) mean: Duration,
    pub(super) longest: Duration,
}

/// Failure of the last request to a PLC.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Trouble {
    /// One or two words.
    pub(super) word: &'static str,
    pub(super) text: String,
}

/// Link and counters of a PLC, as the library has them.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Health {
    pub(super) connection: Connection,
    /// Reason why the connection is down.
    pub(super) reason: String,
    pub(super) is_offline: bool,
    pub(super) has_answered: bool,
    pub(super) counters: Counters,
}

/// State of a PLC.
#[derive(Clone, Debug, Default)]
pub(super) struct PlcState {
    pub(super) health: Health,
    pub(super) flags: Option<StatusFlags>,
    pub(super) trouble: Option<Trouble>,
}

/// Quality of a tag. The order is that of the display: the worst first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Level {
    Bad,
    Stale,
    #[default]
    Unread,
    Good,
}

/// State of a tag.
#[derive(Clone, Debug, Default)]
pub(super) struct TagState {
    pub(super) value: Option<TagValue>,
    pub(super) level: Level,
    /// Reason why the quality is not good.
    pub(super) reason: String,
    pub(super) at: Option<Instant>,
    pub(super) history: History,
}

/// The values at one time.
#[derive(Clone, Debug)]
pub(super) struct Data {
    pub(super) now: Instant,
    pub(super) plcs: Vec<PlcState>,
    pub(super) tags: Vec<TagState>,
}

/// A reading of a tag.
#[derive(Clone, Debug)]
pub(super) struct Reading {
    pub(super) tag: usize,
    pub(super) value: Option<TagValue>,
    pub(super) level: Level,
    pub(super) reason: String,
    /// Failure of its request; `None` if the PLC has answered, or no request was made.
    pub(super) trouble: Option<Trouble>,
    pub(super) at: Instant,
}

/// An event for the dashboard.
#[derive(Clone, Debug)]
pub(super) enum Event {
    /// A key, and the time when it was typed.
    Key(Key, Instant),
    /// Text pasted into the terminal.
    Paste(String),
    Resize(Size),
    Reading(Reading),
    /// Readings that were dropped, because the display was too slow.
    Missed(u64),
    /// Status of a PLC (40).
    Status {
        plc: usize,
        status: Result<StatusFlags, Trouble>,
    },
    Health {
        plc: usize,
        health: Health,
    },
    /// Result of the write that was asked for.
    Written(Result<(), String>),
}

/// Work for the driver.
#[derive(Clone, Debug)]
pub(super) enum Effect {
    Quit,
    /// Draw all cells again.
    Redraw,
    Write {
        plc: usize,
        write: Write,
    },
}

/// The tables, by the keys for moving.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Focus {
    Plcs,
    Tags,
}

/// Meaning of the keys.
#[derive(Clone, Debug)]
pub(super) enum Mode {
    Normal,
    Help,
    /// Editing of the filter. `before`: the filter for Esc.
    Filter {
        before: String,
    },
    /// Editing of the value for this tag.
    Value {
        tag: usize,
        text: String,
        error: Option<String>,
    },
    /// Prompt before a write.
    Confirm(Draft),
}

/// Message at the foot, until the next key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) text: String,
    pub(super) is_error: bool,
}

/// Failure of a write. It stays until Esc, or until a key that is typed after it was shown.
#[derive(Clone, Debug)]
pub(super) struct WriteFailure {
    /// Subject and reason, printable.
    pub(super) text: String,
    /// Time of the first frame.
    pub(super) shown_at: Option<Instant>,
}

/// The dashboard.
#[derive(Debug)]
pub(super) struct Model {
    pub(super) settings: Settings,
    pub(super) plcs: Vec<PlcInfo>,
    pub(super) tags: Vec<TagInfo>,
    pub(super) live: Data,
    pub(super) frozen: Option<Data>,
    pub(super) size: Size,
    pub(super) focus: Focus,
    pub(super) order: Order,
    pub(super) filter: String,
    pub(super) plc_list: List,
    pub(super) tag_list: List,
    pub(super) mode: Mode,
    pub(super) message: Option<Message>,
    /// Subject of the write whose result is awaited.
    pub(super) pending: Option<String>,
    pub(super) write_failure: Option<WriteFailure>,
}

impl PlcInfo {
    pub(super) fn new(label: &str, address: &str, names: Table) -> Self {
        Self { label: printable(label).to_string(), address: printable(address).to_string(), names }
    }
}

impl TagInfo {
    /// A tag of one value, with its label.
    pub(super) fn new(plc: usize, info: &PlcInfo, label: &str, named: NamedTag) -> Self {
        let (unit, comment) = named.name().map(|name| info.names.unit_and_comment(name)).unwrap_or_default();
        let text = |text: &str| printable(text).to_string();
        let (label, unit, comment) = (text(label), text(unit), text(comment));
        let searched = format!("{}/{label} {}", info.label, named.tag).to_lowercase();
        Self { plc, label, unit, comment, searched, named }
    }
}

impl PlcState {
    /// One or two words about the station.
    pub(super) fn station_word(&self) -> &'static str {
        match &self.trouble {
            _ if self.health.is_offline => "offline",
            Some(trouble) => trouble.word,
            None if self.health.has_answered => "online",
            None => "-",
        }
    }

    pub(super) fn is_troubled(&self) -> bool {
        self.health.is_offline || self.trouble.is_some()
    }
}

impl Connection {
    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Opening => "opening",
            Self::Up => "up",
            Self::Down => "down",
            Self::Closed => "closed",
        }
    }
}

impl Level {
    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Bad => "bad",
            Self::Stale => "stale",
            Self::Unread => "unread",
            Self::Good => "good",
        }
    }
}

impl Model {
    pub(super) fn new(settings: Settings, plcs: Vec<PlcInfo>, tags: Vec<TagInfo>, now: Instant) -> Self {
        let live =
            Data { now, plcs: vec![PlcState::default(); plcs.len()], tags: vec![TagState::default(); tags.len()] };
        let focus = if tags.is_empty() { Focus::Plcs } else { Focus::Tags };
        let mut model = Self {
            settings,
            plcs,
            tags,
            live,
            frozen: None,
            size: Size::default(),
            focus,
            order: Order::default(),
            filter: String::new(),
            plc_list: List::default(),
            tag_list: List::default(),
            mode: Mode::Normal,
            message: None,
            pending: None,
            write_failure: None,
        };
        model.arrange();
        model
    }

    /// The values to be shown.
    pub(super) fn data(&self) -> &Data {
        self.frozen.as_ref().unwrap_or(&self.live)
    }

    /// Prepares the next frame: sets the time, and brings the tables into order.
    pub(super) fn frame(&mut self, now: Instant) {
        self.live.now = now;
        self.arrange();
    }

    /// Notes that the frame is on the terminal since this time.
    pub(super) fn drawn(&mut self, at: Instant) {
        if let Mode::Confirm(draft) = &mut self.mode {
            draft.shown_at.get_or_insert(at);
        }
        let is_shown = self.shown_failure().is_some();
        if let Some(failure) = self.write_failure.as_mut().filter(|_| is_shown) {
            failure.shown_at.get_or_insert(at);
        }
    }

    /// The failure of a write, if the display has a place for it: a window above the foot, or on a
    /// small terminal the foot.
    pub(super) fn shown_failure(&self) -> Option<&WriteFailure> {
        let foot = self.areas().foot;
        let has_place = match &self.mode {
            Mode::Normal => foot.height > 0,
            Mode::Filter { .. } | Mode::Value { error: None, .. } => Self::has_notices(foot),
            Mode::Value { error: Some(_), .. } | Mode::Help | Mode::Confirm(_) => false,
        };
        self.write_failure.as_ref().filter(|_| has_place)
    }

    /// Returns whether a window with a line of text fits above the foot.
    pub(super) fn has_notices(foot: Rect) -> bool {
        foot.y >= 3
    }

    /// Texts about writes that the user has not seen, at the end of the command.
    pub(super) fn unseen(&self) -> impl Iterator<Item = String> {
        let failure = self.write_failure.as_ref().filter(|failure| failure.shown_at.is_none());
        let failure = failure.map(|failure| format!("not confirmed: {}", failure.text));
        let pending = self.pending.as_ref();
        let pending = pending.map(|subject| format!("the write {subject} had no reply yet: it may have been executed"));
        failure.into_iter().chain(pending)
    }

    /// The areas of the display.
    pub(super) fn areas(&self) -> Areas {
        let edits = matches!(self.mode, Mode::Filter { .. } | Mode::Value { .. });
        Areas::new(self.size, self.plcs.len(), self.tags.len(), edits)
    }

    /// Filters, sorts and scrolls the tables.
    pub(super) fn arrange(&mut self) {
        let filter = self.filter.to_lowercase();
        let mut tags: Vec<usize> =
            (0..self.tags.len()).filter(|&tag| self.tags[tag].searched.contains(&filter)).collect();
        self.order.sort(&mut tags, &self.tags, self.data());
        self.tag_list.set_order(tags);
        let is_shown = |plc: &PlcInfo| {
            // The filter is that of the tags, if there are any.
            !self.tags.is_empty() || plc.label.to_lowercase().contains(&filter)
        };
        self.plc_list.set_order((0..self.plcs.len()).filter(|&plc| is_shown(&self.plcs[plc])).collect());
        if self.focus == Focus::Tags
            && let Some(tag) = self.tag_list.selected()
        {
            // The PLC of the selected tag is shown.
            self.plc_list.select_place(self.tags[tag].plc);
        }
        let areas = self.areas();
        self.plc_list.scroll(Areas::rows(areas.plcs));
        self.tag_list.scroll(Areas::rows(areas.tags));
    }

    pub(super) fn say(&mut self, text: impl Into<String>) {
        self.message = Some(Message { text: text.into(), is_error: false });
    }

    pub(super) fn complain(&mut self, text: impl AsRef<str>) {
        self.message = Some(Message { text: printable(text.as_ref()).to_string(), is_error: true });
    }

    /// The tag with the name of its PLC, if there are several.
    pub(super) fn subject(&self, tag: usize) -> String {
        let info = &self.tags[tag];
        if self.plcs.len() > 1 { format!("{}/{}", self.plcs[info.plc].label, info.label) } else { info.label.clone() }
    }
}
