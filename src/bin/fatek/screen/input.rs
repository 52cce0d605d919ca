//! Input from the terminal, as far as displays use it.

use ratatui::crossterm::event::{Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use tokio::time::Instant;

/// An input.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Input {
    Key(Key),
    /// Text pasted into the terminal, which is no key.
    Paste(String),
    /// A change of size, or another event that is no key.
    Other,
}

/// A key that was pressed or repeated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Key {
    Char(char),
    /// A letter with Ctrl.
    Control(char),
    Enter,
    Escape,
    Backspace,
    Tab,
    Up,
    Down,
    PageUp,
    PageDown,
    Home,
    End,
    /// A key that no display uses.
    Other,
}

/// Keys without a character.
const KEYS: [(KeyCode, Key); 11] = [
    (KeyCode::Enter, Key::Enter),
    (KeyCode::Esc, Key::Escape),
    (KeyCode::Backspace, Key::Backspace),
    (KeyCode::Tab, Key::Tab),
    (KeyCode::BackTab, Key::Tab),
    (KeyCode::Up, Key::Up),
    (KeyCode::Down, Key::Down),
    (KeyCode::PageUp, Key::PageUp),
    (KeyCode::PageDown, Key::PageDown),
    (KeyCode::Home, Key::Home),
    (KeyCode::End, Key::End),
];

impl From<Event> for Input {
    fn from(event: Event) -> Self {
        match event {
            Event::Key(key) => Key::of(key).map_or(Self::Other, Self::Key),
            Event::Paste(text) => Self::Paste(text),
            Event::Resize(..) | Event::FocusGained | Event::FocusLost | Event::Mouse(_) => Self::Other,
        }
    }
}

impl Key {
    fn of(event: KeyEvent) -> Option<Self> {
        if event.kind == KeyEventKind::Release {
            return None;
        }
        let [is_control, is_alt] = [KeyModifiers::CONTROL, KeyModifiers::ALT].map(|key| event.modifiers.contains(key));
        if is_alt && !is_control {
            // Esc and a key in quick succession are the same bytes as the key with Alt.
            return Some(Self::Escape);
        }
        if let KeyCode::Char(character) = event.code {
            // AltGr is Ctrl and Alt on Windows.
            let is_alt_gr = cfg!(windows) && is_alt;
            return Some(match is_control && !is_alt_gr {
                true => Self::Control(character.to_ascii_lowercase()),
                false => Self::Char(character),
            });
        }
        Some(KEYS.iter().find(|(code, _)| *code == event.code).map_or(Self::Other, |(_, key)| *key))
    }
}

/// Times of inputs: those of a burst have the time of its first one, however late they are taken.
#[derive(Debug, Default)]
pub(super) struct InputTimes {
    /// Time of a burst that goes on.
    burst: Option<Instant>,
}

impl InputTimes {
    /// The time of the next input. `now`: when it was taken; `has_more`: another one was there then.
    pub(super) fn next(&mut self, now: Instant, has_more: bool) -> Instant {
        let at = self.burst.unwrap_or(now);
        self.burst = has_more.then_some(at);
        at
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn inputs_of_a_burst_have_the_time_of_the_first_one() {
        let start = Instant::now();
        let (mut times, second) = (InputTimes::default(), |second| start + Duration::from_secs(second));
        let taken = [(1, true), (2, true), (3, false), (4, false), (5, true), (6, false)];
        let at = taken.map(|(now, has_more)| times.next(second(now), has_more));
        assert_eq!(at, [1, 1, 1, 4, 5, 5].map(second));
    }

    #[test]
    fn keys_have_their_modifiers() {
        let input = |code, modifiers| Input::from(Event::Key(KeyEvent::new(code, modifiers)));
        assert_eq!(input(KeyCode::Char('c'), KeyModifiers::CONTROL), Input::Key(Key::Control('c')));
        assert_eq!(input(KeyCode::Char('G'), KeyModifiers::SHIFT), Input::Key(Key::Char('G')));
        let alt_gr = input(KeyCode::Char('@'), KeyModifiers::CONTROL | KeyModifiers::ALT);
        assert_eq!(alt_gr, Input::Key(if cfg!(windows) { Key::Char('@') } else { Key::Control('@') }));
        assert_eq!(input(KeyCode::BackTab, KeyModifiers::SHIFT), Input::Key(Key::Tab));
        for code in [KeyCode::F(5), KeyCode::Left, KeyCode::Delete, KeyCode::Insert] {
            assert_eq!(input(code, KeyModifiers::NONE), Input::Key(Key::Other));
        }
        let released = KeyEvent::new_with_kind(KeyCode::Char('y'), KeyModifiers::NONE, KeyEventKind::Release);
        assert_eq!(Input::from(Event::Key(released)), Input::Other);
    }

    #[test]
    fn a_key_with_alt_is_escape_as_it_has_the_bytes_of_both() {
        // Without this, Esc and `y` in quick succession confirmed a write.
        for code in [KeyCode::Char('y'), KeyCode::Enter, KeyCode::Backspace] {
            let key = KeyEvent::new(code, KeyModifiers::ALT);
            assert_eq!(Input::from(Event::Key(key)), Input::Key(Key::Escape), "{code}");
        }
    }
}
