//! Full-screen display on a terminal, for `top` and `watch --plot`.
//!
//! The terminal is restored when a [`Screen`] is dropped, and before the message of a panic in any
//! thread or task. A panic of a task does not end the command: [`Screen::draw`] notices it.

mod input;

use std::ffi::OsStr;
use std::io::{self, IsTerminal, Write};
use std::panic;
use std::sync::Once;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use ratatui::backend::CrosstermBackend;
use ratatui::buffer::Buffer;
use ratatui::crossterm::cursor::Show;
use ratatui::crossterm::event::{self, DisableBracketedPaste, EnableBracketedPaste};
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode, size,
};
use ratatui::crossterm::{execute, queue};
use ratatui::layout::{Rect, Size};
use ratatui::{Frame, Terminal, TerminalOptions, Viewport};
use tokio::sync::mpsc;
use tokio::time::Instant;
use tracing::level_filters::LevelFilter;

use self::input::InputTimes;
pub(crate) use self::input::{Input, Key};
use crate::failure::Failure;
use crate::output::{Format, Output};
use crate::signal;

/// Set while the terminal shows the display.
static IS_OPEN: AtomicBool = AtomicBool::new(false);

/// Size of a terminal without one, such as a serial console.
const DEFAULT_SIZE: (u16, u16) = (80, 24);

/// The display.
pub(crate) struct Screen {
    terminal: Terminal<CrosstermBackend<io::Stdout>>,
    inputs: mpsc::Receiver<io::Result<(Input, Instant)>>,
    is_ascii: bool,
}

/// Fails without a terminal to draw on. Call it before the first request.
pub(crate) fn can_be_drawn(command: &str, instead: &str, output: &Output) -> Result<(), Failure> {
    let usage = |reason: &str| Err(Failure::Usage(format!("{command} {reason}")));
    if output.format != Format::Table {
        return usage(&format!("draws on a terminal and has no --format; {instead}"));
    }
    if !io::stdin().is_terminal() || !io::stdout().is_terminal() {
        return usage(&format!("needs a terminal, at stdin and stdout; {instead}"));
    }
    if std::env::var_os("TERM").is_some_and(|terminal| terminal == "dumb") {
        return usage(&format!("needs a terminal that can move its cursor (TERM is dumb); {instead}"));
    }
    if LevelFilter::current() != LevelFilter::OFF && io::stderr().is_terminal() {
        return usage("would be overwritten by log lines: redirect them (2> FILE), or leave out -v and RUST_LOG");
    }
    Ok(())
}

/// Returns whether colours are wanted: `NO_COLOR` is not set, or is empty.
pub(crate) fn has_colours() -> bool {
    are_colours_wanted(std::env::var_os("NO_COLOR").as_deref())
}

fn are_colours_wanted(no_color: Option<&OsStr>) -> bool {
    no_color.is_none_or(OsStr::is_empty)
}

impl Screen {
    /// Takes the terminal.
    pub(crate) fn open() -> Result<Self, Failure> {
        static HOOKS: Once = Once::new();
        HOOKS.call_once(|| {
            let report = panic::take_hook();
            panic::set_hook(Box::new(move |info| {
                restore();
                report(info);
            }));
            // Without output, which would wait for the blocked command.
            signal::before_forced_exit(|| drop(disable_raw_mode()));
        });
        enable_raw_mode().map_err(Failure::Runtime)?;
        IS_OPEN.store(true, Ordering::Relaxed);
        let opened = execute!(io::stdout(), EnterAlternateScreen, EnableBracketedPaste).and_then(|()| {
            let viewport = match size() {
                Ok((1.., 1..)) => Viewport::Fullscreen,
                Ok(_) | Err(_) => Viewport::Fixed(Rect::new(0, 0, DEFAULT_SIZE.0, DEFAULT_SIZE.1)),
            };
            Terminal::with_options(CrosstermBackend::new(io::stdout()), TerminalOptions { viewport })
        });
        match opened {
            Ok(terminal) => Ok(Self { terminal, inputs: read_inputs(), is_ascii: !is_utf8() }),
            Err(error) => {
                restore();
                Err(Failure::Output(error))
            }
        }
    }

    /// Adapts the display to the size of the terminal, and returns it.
    pub(crate) fn resized(&mut self) -> Result<Size, Failure> {
        self.terminal.autoresize().map_err(Failure::Output)?;
        Ok(self.terminal.get_frame().area().as_size())
    }

    /// Draws all cells with the next frame, also those that have not changed.
    pub(crate) fn clear(&mut self) -> Result<(), Failure> {
        // `Terminal::clear` asks the terminal for the place of the cursor. The answer comes with
        // the keys, which another thread reads.
        let area = self.terminal.get_frame().area();
        self.terminal.resize(area).map_err(Failure::Output)
    }

    /// Waits for the next key or change of size. Its time is not later than any frame that was
    /// drawn after it came.
    pub(crate) async fn input(&mut self) -> Result<(Input, Instant), Failure> {
        let closed = || Err(io::ErrorKind::UnexpectedEof.into());
        self.inputs.recv().await.unwrap_or_else(closed).map_err(Failure::Input)
    }

    /// Draws a frame: the cells that differ from the last one are sent.
    pub(crate) fn draw(&mut self, draw: impl FnOnce(&mut Frame<'_>)) -> Result<(), Failure> {
        if !IS_OPEN.load(Ordering::Relaxed) {
            return Err(Failure::Output(io::Error::other("a task of this command has panicked")));
        }
        let is_ascii = self.is_ascii;
        let drawn = self.terminal.draw(|frame| {
            draw(frame);
            if is_ascii {
                replace_non_ascii(frame.buffer_mut());
            }
        });
        drawn.map(drop).map_err(Failure::Output)
    }

    /// Returns whether the locale has no other characters than those of ASCII.
    pub(crate) fn is_ascii(&self) -> bool {
        self.is_ascii
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        restore();
    }
}

/// Restores the terminal, once. A write error is ignored: there is no terminal any more.
fn restore() {
    if IS_OPEN.swap(false, Ordering::Relaxed) {
        // First: it does not wait for a terminal that takes no output.
        let _ = disable_raw_mode();
        let mut stdout = io::stdout();
        let _ = queue!(stdout, DisableBracketedPaste, LeaveAlternateScreen, Show).and_then(|()| stdout.flush());
    }
}

/// Starts the thread that reads the terminal. It ends with the process.
fn read_inputs() -> mpsc::Receiver<io::Result<(Input, Instant)>> {
    let (sender, inputs) = mpsc::channel(64);
    thread::spawn(move || {
        let mut times = InputTimes::default();
        loop {
            let event = event::read();
            let (now, is_last) = (Instant::now(), event.is_err());
            // Before this input is sent: an input that is there already is no reaction to it.
            let has_more = !is_last && event::poll(Duration::ZERO).unwrap_or(false);
            let at = times.next(now, has_more);
            if sender.blocking_send(event.map(|event| (Input::from(event), at))).is_err() || is_last {
                break;
            }
        }
    });
    inputs
}

/// Returns whether the terminal shows UTF-8, by the variables of the locale.
fn is_utf8() -> bool {
    if cfg!(windows) {
        return true;
    }
    let variables = ["LC_ALL", "LC_CTYPE", "LANG"].into_iter().filter_map(std::env::var_os);
    is_utf8_locale(variables.map(|value| value.to_string_lossy().into_owned()))
}

/// Returns whether the first of these that is not empty is a locale with UTF-8.
fn is_utf8_locale(mut variables: impl Iterator<Item = String>) -> bool {
    let locale = variables.find(|value| !value.is_empty()).unwrap_or_default().to_lowercase();
    locale.contains("utf-8") || locale.contains("utf8")
}

/// Replaces all characters outside of ASCII: those of the display by similar ones, others by `?`.
fn replace_non_ascii(buffer: &mut Buffer) {
    for cell in &mut buffer.content {
        if cell.symbol().is_ascii() {
            continue;
        }
        let similar = match cell.symbol().chars().next() {
            Some('─' | '━') => '-',
            Some('│' | '┃') => '|',
            Some('┌' | '┐' | '└' | '┘' | '├' | '┤' | '┬' | '┴' | '┼') => '+',
            Some('•' | '\u{2801}'..='\u{28FF}') => '*',
            Some('\u{2800}') => ' ',
            Some('…') => '~',
            Some('▲' | '↑') => '^',
            Some('▼' | '↓') => 'v',
            Some('·') => '-',
            Some('▁') => '_',
            Some('▂') => '.',
            Some('▃') => '-',
            Some('▄') => '=',
            Some('▅') => '+',
            Some('▆') => '*',
            Some('▇') => '#',
            Some('█') => '@',
            Some(_) | None => '?',
        };
        cell.set_char(similar);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratatui::style::Style;

    #[test]
    fn no_color_leaves_no_colours_unless_it_is_empty() {
        assert!(are_colours_wanted(None) && are_colours_wanted(Some(OsStr::new(""))));
        assert!(!are_colours_wanted(Some(OsStr::new("1"))) && !are_colours_wanted(Some(OsStr::new("0"))));
    }

    #[test]
    fn the_first_variable_of_the_locale_decides() {
        let is_utf8 = |variables: &[&str]| is_utf8_locale(variables.iter().map(|&value| value.to_owned()));
        assert!(is_utf8(&["de_DE.UTF-8", "C"]) && is_utf8(&["", "", "C.utf8"]));
        assert!(!is_utf8(&["C", "en_US.UTF-8"]) && !is_utf8(&["POSIX"]) && !is_utf8(&[]) && !is_utf8(&[""]));
    }

    #[test]
    fn a_display_without_utf_8_has_ascii_only() {
        let mut buffer = Buffer::empty(Rect::new(0, 0, 16, 1));
        buffer.set_string(0, 0, "┌─│▁▄█…ä中 ⡇·a", Style::new());
        replace_non_ascii(&mut buffer);
        let shown: String = buffer.content.iter().map(ratatui::buffer::Cell::symbol).collect();
        assert_eq!(shown, "+-|_=@~??  *-a  ");
    }
}
