//! Input from the terminal, as far as displays use it.

use ratatui::crossterm::event::{Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

/// An input.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Input {
    Key(Key),
    /// Text pasted into the terminal, which is no key.
    Paste(String),
    /// A change of size, or a key that no display uses.
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
        if let KeyCode::Char(character) = event.code {
            let is_control = event.modifiers.contains(KeyModifiers::CONTROL);
            // AltGr is Ctrl and Alt on Windows.
            let is_letter = !event.modifiers.contains(KeyModifiers::ALT);
            return Some(match is_control && is_letter {
                true => Self::Control(character.to_ascii_lowercase()),
                false => Self::Char(character),
            });
        }
        KEYS.iter().find(|(code, _)| *code == event.code).map(|(_, key)| *key)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_have_their_modifiers() {
        let input = |code, modifiers| Input::from(Event::Key(KeyEvent::new(code, modifiers)));
        assert_eq!(input(KeyCode::Char('c'), KeyModifiers::CONTROL), Input::Key(Key::Control('c')));
        assert_eq!(input(KeyCode::Char('G'), KeyModifiers::SHIFT), Input::Key(Key::Char('G')));
        assert_eq!(input(KeyCode::Char('@'), KeyModifiers::CONTROL | KeyModifiers::ALT), Input::Key(Key::Char('@')));
        assert_eq!(input(KeyCode::BackTab, KeyModifiers::SHIFT), Input::Key(Key::Tab));
        assert_eq!(input(KeyCode::F(5), KeyModifiers::NONE), Input::Other);
        let released = KeyEvent::new_with_kind(KeyCode::Char('y'), KeyModifiers::NONE, KeyEventKind::Release);
        assert_eq!(Input::from(Event::Key(released)), Input::Other);
    }
}
