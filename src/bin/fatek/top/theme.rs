//! Styles of the dashboard: with colours, or with bold and reversed text alone.

use ratatui::style::{Color, Modifier, Style};

use super::model::Level;

#[derive(Clone, Copy, Debug)]
pub(crate) struct Theme {
    has_colours: bool,
}

impl Theme {
    pub(crate) fn new(has_colours: bool) -> Self {
        Self { has_colours }
    }

    pub(crate) fn has_colours(self) -> bool {
        self.has_colours
    }

    /// Title line.
    pub(crate) fn title(self) -> Style {
        Style::new().add_modifier(Modifier::REVERSED)
    }

    pub(crate) fn header(self) -> Style {
        Style::new().add_modifier(Modifier::BOLD)
    }

    pub(super) fn selected(self) -> Style {
        Style::new().add_modifier(Modifier::REVERSED)
    }

    pub(crate) fn trouble(self) -> Style {
        self.coloured(Color::Red).add_modifier(Modifier::BOLD)
    }

    pub(super) fn level(self, level: Level) -> Style {
        match level {
            Level::Good => self.coloured(Color::Green),
            Level::Stale => self.coloured(Color::Yellow),
            Level::Unread => Style::new(),
            Level::Bad => self.trouble(),
        }
    }

    /// Text of a station that answers.
    pub(super) fn fine(self) -> Style {
        self.coloured(Color::Green)
    }

    pub(super) fn sparkline(self) -> Style {
        self.coloured(Color::Cyan)
    }

    /// Lines of a plot.
    pub(crate) fn line(self, number: usize) -> Style {
        const COLOURS: [Color; 6] = [Color::Cyan, Color::Yellow, Color::Green, Color::Magenta, Color::Blue, Color::Red];
        self.coloured(COLOURS[number % COLOURS.len()])
    }

    fn coloured(self, colour: Color) -> Style {
        if self.has_colours { Style::new().fg(colour) } else { Style::new() }
    }
}
