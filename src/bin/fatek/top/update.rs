//! Events of the dashboard: keys, readings, results.

use tokio::time::Instant;

use super::dialog::{Draft, Prompt};
use super::layout::Areas;
use super::list::List;
use super::model::{Effect, Event, Focus, Level, Mode, Model, Reading, Trouble, WriteFailure};
use crate::failure::Failure;
use crate::printable::{is_unprintable, printable};
use crate::screen::Key;
use crate::write::refuse_special;

/// Longest text that can be typed, in characters.
const MAX_TEXT: usize = 200;

impl Model {
    /// Takes an event. Returns the work for the driver.
    pub(super) fn update(&mut self, event: Event) -> Option<Effect> {
        match event {
            Event::Key(key, at) => {
                let effect = self.key(key, at);
                // Keys may come without a frame in between.
                self.arrange();
                effect
            }
            Event::Paste(text) => {
                self.paste(&text);
                self.arrange();
                None
            }
            Event::Resize(size) => {
                self.size = size;
                None
            }
            Event::Reading(reading) => {
                self.reading(reading);
                None
            }
            Event::Missed(count) => {
                self.complain(format!("{count} readings were dropped: the display is too slow"));
                None
            }
            Event::Status { plc, status } => {
                let state = &mut self.live.plcs[plc];
                match status {
                    Ok(flags) => (state.flags, state.trouble) = (Some(flags), None),
                    // The mode is unknown then.
                    Err(trouble) => (state.flags, state.trouble) = (None, Some(trouble)),
                }
                None
            }
            Event::Health { plc, health } => {
                self.live.plcs[plc].health = health;
                None
            }
            Event::Written(result) => {
                let subject = self.pending.take().unwrap_or_default();
                match result {
                    Ok(()) => self.say(format!("wrote {subject}")),
                    Err(error) => {
                        self.message = None;
                        let text = printable(&format!("{subject}: {error}")).to_string();
                        self.write_failure = Some(WriteFailure { text, shown_at: None });
                    }
                }
                None
            }
        }
    }

    fn reading(&mut self, reading: Reading) {
        let Reading { tag, value, level, reason, trouble, at } = reading;
        let state = &mut self.live.tags[tag];
        // Of a stale value, nothing was read.
        state.history.push(value.as_ref().filter(|_| level == Level::Good));
        (state.value, state.level, state.reason, state.at) = (value, level, reason, Some(at));
        let plc = &mut self.live.plcs[self.tags[tag].plc];
        match trouble {
            Some(trouble) => plc.trouble = Some(trouble),
            None if level == Level::Good => plc.trouble = None,
            None => {}
        }
    }

    fn key(&mut self, key: Key, at: Instant) -> Option<Effect> {
        if key == Key::Control('c') {
            return Some(Effect::Quit);
        }
        if key == Key::Control('l') {
            return Some(Effect::Redraw);
        }
        match std::mem::replace(&mut self.mode, Mode::Normal) {
            Mode::Normal => return self.normal_key(key, at),
            // Any key closes it.
            Mode::Help => {}
            Mode::Filter { before } => self.filter_key(before, key),
            Mode::Value { tag, text, .. } => self.value_key(tag, text, key),
            Mode::Confirm(draft) => return self.confirm_key(draft, key, at),
        }
        None
    }

    fn normal_key(&mut self, key: Key, at: Instant) -> Option<Effect> {
        let was_shown = |failure: &WriteFailure| failure.shown_at.is_some_and(|shown_at| shown_at <= at);
        match self.write_failure.take() {
            // Esc closes it, and leaves the filter.
            Some(_) if key == Key::Escape => return None,
            failure => self.write_failure = failure.filter(|failure| !was_shown(failure)),
        }
        self.message = None;
        let page = isize::try_from(self.page()).unwrap_or(isize::MAX);
        match key {
            Key::Char('q') => return Some(Effect::Quit),
            Key::Char('?' | 'h') => self.mode = Mode::Help,
            Key::Char('/') => self.mode = Mode::Filter { before: self.filter.clone() },
            Key::Escape => self.filter.clear(),
            Key::Char('s') => self.order = self.order.next(),
            Key::Char('r') => self.order = self.order.reversed(),
            Key::Char(' ' | 'p') => {
                self.frozen = if self.frozen.is_some() { None } else { Some(self.live.clone()) };
            }
            Key::Char('w') | Key::Enter => self.begin_write(),
            Key::Tab if !self.tags.is_empty() => {
                self.focus = match self.focus {
                    Focus::Plcs => Focus::Tags,
                    Focus::Tags => Focus::Plcs,
                };
            }
            Key::Up | Key::Char('k') => self.list().move_by(-1),
            Key::Down | Key::Char('j') => self.list().move_by(1),
            Key::PageUp => self.list().move_by(-page),
            Key::PageDown => self.list().move_by(page),
            Key::Home | Key::Char('g') => self.list().select_place(0),
            Key::End | Key::Char('G') => self.list().select_place(usize::MAX),
            Key::Char(_) | Key::Control(_) | Key::Backspace | Key::Tab | Key::Other => {}
        }
        None
    }

    /// Number of rows of the table that the keys move in.
    fn page(&self) -> usize {
        let areas = self.areas();
        Areas::rows(match self.focus {
            Focus::Plcs => areas.plcs,
            Focus::Tags => areas.tags,
        })
    }

    fn list(&mut self) -> &mut List {
        match self.focus {
            Focus::Plcs => &mut self.plc_list,
            Focus::Tags => &mut self.tag_list,
        }
    }

    fn filter_key(&mut self, before: String, key: Key) {
        if key == Key::Escape {
            self.filter = before;
        } else if key != Key::Enter {
            edit(&mut self.filter, key);
            self.mode = Mode::Filter { before };
        }
    }

    /// Asks for a value of the selected tag, if it may be written.
    fn begin_write(&mut self) {
        let Some(tag) = self.tag_list.selected().filter(|_| self.focus == Focus::Tags) else {
            return self.complain("no tag is selected");
        };
        if self.write_failure.is_some() {
            return self.complain("the failure of the last write was not shown yet");
        }
        if self.pending.is_some() {
            return self.complain("the last write has no result yet");
        }
        match self.check_writable(tag) {
            Ok(()) => self.mode = Mode::Value { tag, text: String::new(), error: None },
            Err(failure) => self.complain(failure.to_string()),
        }
    }

    fn check_writable(&self, tag: usize) -> Result<(), Failure> {
        let info = &self.tags[tag];
        let elements = info.named.tag;
        if self.settings.read_only {
            return Err(Failure::Usage("--read-only was given".to_owned()));
        }
        if elements.is_bits_of_register() {
            let fault = format!("{elements} is a part of {}; use `fatek write --modify-bits`", elements.first());
            return Err(Failure::Usage(fault));
        }
        if let Some(name) = info.named.name() {
            self.plcs[info.plc].names.check_writable(name)?;
        }
        refuse_special(self.settings.special, elements.elements())
    }

    fn value_key(&mut self, tag: usize, mut text: String, key: Key) {
        if key == Key::Escape {
            return self.say("nothing was written");
        }
        if key != Key::Enter {
            edit(&mut text, key);
            self.mode = Mode::Value { tag, text, error: None };
            return;
        }
        let info = &self.tags[tag];
        let names = &self.plcs[info.plc].names;
        let name = info.named.name().unwrap_or_default();
        self.mode = match names.write(info.named.tag, name, &text, false) {
            Ok(write) => Mode::Confirm(Draft::new(tag, write)),
            Err(failure) => Mode::Value { tag, text, error: Some(failure.to_string()) },
        };
    }

    fn confirm_key(&mut self, draft: Draft, key: Key, at: Instant) -> Option<Effect> {
        if !matches!(key, Key::Char('y' | 'Y')) {
            self.say("nothing was written");
            return None;
        }
        if draft.shown_at.is_none_or(|shown_at| at < shown_at) {
            self.mode = Mode::Confirm(draft);
            return None;
        }
        if !Prompt::new(self, &draft, self.size).is_whole {
            self.complain("nothing was written: the terminal is too small for the prompt");
            return None;
        }
        let Draft { tag, write, values, .. } = draft;
        let subject = format!("{}={values}", self.subject(tag));
        self.say(format!("writing {subject}..."));
        self.pending = Some(subject);
        Some(Effect::Write { plc: self.tags[tag].plc, write })
    }

    /// Takes a pasted text in a line that is edited. It is never a key: a `y` in it confirms
    /// nothing.
    fn paste(&mut self, pasted: &str) {
        let text = match &mut self.mode {
            Mode::Filter { .. } => &mut self.filter,
            Mode::Value { text, error, .. } => {
                *error = None;
                text
            }
            Mode::Normal | Mode::Help | Mode::Confirm(_) => return,
        };
        pasted.chars().for_each(|character| edit(text, Key::Char(character)));
    }
}

/// Edits a line at its end.
fn edit(text: &mut String, key: Key) {
    match key {
        Key::Control('u' | 'w') => text.clear(),
        Key::Control('h') | Key::Backspace => drop(text.pop()),
        Key::Char(character) => {
            if !is_unprintable(character) && text.chars().count() < MAX_TEXT {
                text.push(character);
            }
        }
        Key::Control(_) | Key::Enter | Key::Escape | Key::Tab => {}
        Key::Up | Key::Down | Key::PageUp | Key::PageDown | Key::Home | Key::End | Key::Other => {}
    }
}

impl Trouble {
    /// The failure of a call.
    pub(super) fn of(error: &fatek::Error) -> Self {
        let word = match error {
            fatek::Error::Timeout { .. } => "no reply",
            fatek::Error::Offline { .. } => "offline",
            fatek::Error::Connect { .. } | fatek::Error::Disconnected { .. } | fatek::Error::Closed { .. } => "no link",
            fatek::Error::Plc { .. } | fatek::Error::RefusedTags { .. } => "refuses",
            fatek::Error::BadReply { .. } | fatek::Error::OutOfStep { .. } | fatek::Error::Duplicates { .. } => {
                "bad reply"
            }
            fatek::Error::Invalid(_)
            | fatek::Error::Tag(_)
            | fatek::Error::QueueFull { .. }
            | fatek::Error::GateClosed { .. } => "not sent",
            fatek::Error::PartlyWritten { .. } | _ => "failed",
        };
        Self { word, text: printable(&error.to_string()).to_string() }
    }
}
