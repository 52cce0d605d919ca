//! Confirmation before a PLC is changed.

use std::io::{self, BufRead, IsTerminal, Write};
use std::thread;

use tokio::sync::oneshot;

use crate::failure::Failure;
use crate::output::complain;
use crate::printable::printable;
use crate::signal::unless_signalled;

/// Fails without `--yes` and without a terminal. Call it before the first request.
pub(crate) fn can_be_confirmed(yes: bool) -> Result<(), Failure> {
    if yes || (io::stdin().is_terminal() && io::stderr().is_terminal()) {
        return Ok(());
    }
    Err(Failure::Usage("confirmation required, but there is no terminal: give --yes or --dry-run".to_owned()))
}

/// Prompts for confirmation, unless `--yes` was given. A signal ends the prompt.
pub(crate) async fn confirm(question: &str, yes: bool) -> Result<(), Failure> {
    can_be_confirmed(yes)?;
    if yes {
        return Ok(());
    }
    let mut stderr = io::stderr().lock();
    write!(stderr, "{} [y/N] ", printable(question)).and_then(|()| stderr.flush()).map_err(Failure::Runtime)?;
    drop(stderr);
    let (sender, line) = oneshot::channel();
    // Not a blocking task of the runtime, which would wait for it at its end.
    thread::spawn(move || sender.send(read_line()));
    let interrupted = Failure::interrupted(": nothing was changed");
    let line = unless_signalled(line).await?.map_err(|signal| {
        complain(format_args!(""));
        interrupted(signal)
    })?;
    let line = line.unwrap_or_else(|_| Err(io::ErrorKind::BrokenPipe.into())).map_err(Failure::Runtime)?;
    if means_yes(&line) { Ok(()) } else { Err(Failure::Declined) }
}

fn read_line() -> io::Result<String> {
    let mut line = String::new();
    io::stdin().lock().read_line(&mut line).map(|_| line)
}

fn means_yes(line: &str) -> bool {
    matches!(line.trim(), "y" | "Y" | "yes" | "Yes" | "YES")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_y_and_yes_confirm() {
        for yes in ["y\n", "Y", " yes\r\n"] {
            assert!(means_yes(yes), "{yes:?}");
        }
        for no in ["", "\n", "n\n", "yep\n", "no\n", "y e s\n"] {
            assert!(!means_yes(no), "{no:?}");
        }
    }
}
