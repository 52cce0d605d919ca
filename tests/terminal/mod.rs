//! Runs the command line on a pseudo-terminal, and keeps the screen that a terminal would show.

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Termios, Winsize, tcgetattr, tcsetwinsize};

use crate::process::FATEK;

/// Limit of a wait. It ends a failed test: no test depends on it.
const PATIENCE: Duration = Duration::from_secs(60);

/// `fatek` on a pseudo-terminal, killed on drop.
pub(crate) struct Program {
    child: Child,
    terminal: File,
    /// Side of the program, so that its settings can be read after its end.
    _side: File,
    output: Receiver<Vec<u8>>,
    settings: Termios,
    received: Vec<u8>,
    screen: Screen,
}

impl Program {
    /// Starts it on a terminal of this width and height, in a locale with UTF-8 unless the
    /// variables have another.
    pub(crate) fn start(args: &[&str], size: (u16, u16), variables: &[(&str, &str)]) -> Self {
        let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
        grantpt(&terminal).unwrap();
        unlockpt(&terminal).unwrap();
        let path = ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
        let terminal = File::from(terminal);
        let side = || OpenOptions::new().read(true).write(true).open(&path).unwrap();
        let kept = side();
        set_size(&terminal, size);
        let settings = tcgetattr(&terminal).unwrap();
        let mut command = Command::new(FATEK);
        command.args(args).env("TERM", "xterm-256color").env("LC_ALL", "C.UTF-8");
        for variable in ["NO_COLOR", "RUST_LOG", "FATEK_LINK", "FATEK_STATION", "FATEK_TAGS", "FATEK_CONFIG"] {
            command.env_remove(variable);
        }
        command.envs(variables.iter().copied());
        let child = command.stdin(side()).stdout(side()).stderr(Stdio::from(side())).spawn().unwrap();
        let (sender, output) = channel();
        let mut reader = terminal.try_clone().unwrap();
        // Ends with the test, when both sides are closed.
        thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(len @ 1..) = reader.read(&mut buffer) {
                if sender.send(buffer[..len].to_vec()).is_err() {
                    break;
                }
            }
        });
        Self { child, terminal, _side: kept, output, settings, received: Vec::new(), screen: Screen::new(size) }
    }

    /// Waits until the screen is as wanted.
    #[track_caller]
    pub(crate) fn wait_for(&mut self, name: &str, wanted: impl Fn(&str) -> bool) {
        let begun = Instant::now();
        while !wanted(&self.screen()) {
            assert!(begun.elapsed() < PATIENCE, "{name} did not appear:\n{}", self.screen());
            if let Some(status) = self.child.try_wait().unwrap() {
                panic!("{name} did not appear, {status}:\n{}", self.screen());
            }
            self.receive(Duration::from_millis(50));
        }
    }

    /// Waits until the terminal has received these bytes.
    #[track_caller]
    pub(crate) fn wait_for_bytes(&mut self, name: &str, wanted: &[u8]) {
        let begun = Instant::now();
        while !self.received.windows(wanted.len()).any(|window| window == wanted) {
            assert!(begun.elapsed() < PATIENCE, "{name} did not come:\n{}", self.screen());
            if let Some(status) = self.child.try_wait().unwrap() {
                panic!("{name} did not come, {status}:\n{}", self.screen());
            }
            self.receive(Duration::from_millis(50));
        }
    }

    /// Takes output that comes within this time. Returns whether there was any.
    fn receive(&mut self, within: Duration) -> bool {
        match self.output.recv_timeout(within) {
            Ok(bytes) => {
                self.screen.feed(&bytes);
                self.received.extend_from_slice(&bytes);
                true
            }
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => false,
        }
    }

    pub(crate) fn types(&mut self, keys: &str) {
        self.terminal.write_all(keys.as_bytes()).unwrap();
    }

    pub(crate) fn signal(&self, name: &str) {
        Command::new("kill").args([&format!("-{name}"), &self.child.id().to_string()]).status().unwrap();
    }

    /// Changes the size of the terminal. The process is told as by the kernel: it has no
    /// controlling terminal.
    pub(crate) fn resize(&mut self, size: (u16, u16)) {
        set_size(&self.terminal, size);
        self.screen.resize(size);
        self.signal("WINCH");
    }

    /// Lines of the screen.
    pub(crate) fn screen(&self) -> String {
        self.screen.text()
    }

    /// All bytes that the terminal has received.
    pub(crate) fn received(&self) -> &[u8] {
        &self.received
    }

    /// Waits for the end. Returns its status, and the text on the usual screen. Panics if the
    /// settings of the terminal are others than before, or another screen, or no cursor, is shown.
    #[track_caller]
    pub(crate) fn end(&mut self) -> (i32, String) {
        let begun = Instant::now();
        let status = loop {
            match self.child.try_wait().unwrap() {
                Some(status) => break status,
                None => assert!(begun.elapsed() < PATIENCE, "it runs on:\n{}", self.screen()),
            }
            self.receive(Duration::from_millis(20));
        };
        // The rest of its output is in the terminal.
        while self.receive(Duration::from_millis(200)) {}
        let settings = tcgetattr(&self.terminal).unwrap();
        let modes = |settings: &Termios| {
            (settings.input_modes, settings.output_modes, settings.control_modes, settings.local_modes)
        };
        assert_eq!(modes(&settings), modes(&self.settings), "the settings of the terminal were restored");
        assert!(!self.screen.is_alternate, "the usual screen is shown");
        assert!(!self.screen.is_cursor_hidden, "the cursor is shown");
        (status.code().expect("no signal"), self.screen().trim_end().to_owned())
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn set_size(terminal: &File, (width, height): (u16, u16)) {
    tcsetwinsize(terminal, Winsize { ws_row: height, ws_col: width, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
}

/// The screen of a terminal: as much of the control sequences as `fatek` sends.
struct Screen {
    width: usize,
    cells: Vec<Vec<char>>,
    row: usize,
    column: usize,
    is_alternate: bool,
    is_cursor_hidden: bool,
    /// A sequence or character that is not complete.
    pending: Vec<u8>,
}

impl Screen {
    fn new((width, height): (u16, u16)) -> Self {
        Self {
            width: width.into(),
            cells: vec![vec![' '; width.into()]; height.into()],
            row: 0,
            column: 0,
            is_alternate: false,
            is_cursor_hidden: false,
            pending: Vec::new(),
        }
    }

    /// Clears it: a program draws anew after a change of size.
    fn resize(&mut self, (width, height): (u16, u16)) {
        self.width = width.into();
        self.cells = vec![vec![' '; width.into()]; height.into()];
    }

    fn text(&self) -> String {
        self.cells.iter().map(|line| line.iter().collect::<String>().trim_end().to_owned() + "\n").collect()
    }

    fn feed(&mut self, bytes: &[u8]) {
        self.pending.extend_from_slice(bytes);
        let pending = std::mem::take(&mut self.pending);
        let mut rest = &pending[..];
        while let Some(after) = self.step(rest) {
            rest = after;
        }
        self.pending = rest.to_vec();
    }

    /// Takes a character or a sequence. Returns the bytes behind it; `None` if it is not complete.
    fn step<'b>(&mut self, bytes: &'b [u8]) -> Option<&'b [u8]> {
        let (&first, rest) = bytes.split_first()?;
        match first {
            b'\r' => self.column = 0,
            b'\n' => self.row += 1,
            0x1b => {
                // `ESC [ parameters letter`.
                let (&kind, parameters) = rest.split_first()?;
                assert_eq!(kind, b'[', "unknown sequence {bytes:?}");
                let len = parameters.iter().position(|byte| (0x40..=0x7e).contains(byte))?;
                self.control(std::str::from_utf8(&parameters[..len]).unwrap(), parameters[len]);
                return Some(&parameters[len + 1..]);
            }
            0x20.. => {
                let len =
                    (1..=4).find(|&len| bytes.get(..len).is_some_and(|bytes| std::str::from_utf8(bytes).is_ok()))?;
                let character = std::str::from_utf8(&bytes[..len]).unwrap().chars().next()?;
                if let Some(cell) = self.cells.get_mut(self.row).and_then(|line| line.get_mut(self.column)) {
                    *cell = character;
                }
                self.column += 1;
                return Some(&bytes[len..]);
            }
            other => panic!("control character {other:#04x}"),
        }
        Some(rest)
    }

    fn control(&mut self, parameters: &str, letter: u8) {
        match (parameters, letter) {
            ("?1049", b'h' | b'l') => {
                self.is_alternate = letter == b'h';
                self.clear();
            }
            ("?25", b'h' | b'l') => self.is_cursor_hidden = letter == b'l',
            ("2", b'J') => self.clear(),
            (place, b'H') => {
                let mut numbers = place.split(';').map(|number| number.parse::<usize>().unwrap_or(1) - 1);
                (self.row, self.column) = (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0));
            }
            // Colours; bracketed paste.
            (_, b'm') | ("?2004", b'h' | b'l') => {}
            (parameters, letter) => panic!("unknown sequence {parameters}{}", char::from(letter)),
        }
    }

    fn clear(&mut self) {
        self.cells.iter_mut().for_each(|line| line.fill(' '));
    }
}
