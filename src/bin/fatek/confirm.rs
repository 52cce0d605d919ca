//! Confirmation before a PLC is changed.

use std::io::{self, BufRead, IsTerminal, Write};

use crate::failure::Failure;
use crate::printable::printable;

/// Fails without `--yes` and without a terminal. Call it before the first request.
pub(crate) fn can_be_confirmed(yes: bool) -> Result<(), Failure> {
    if yes || (io::stdin().is_terminal() && io::stderr().is_terminal()) {
        return Ok(());
    }
    Err(Failure::Usage("confirmation required, but there is no terminal: give --yes or --dry-run".to_owned()))
}

/// Prompts for confirmation, unless `--yes` was given.
pub(crate) fn confirm(question: &str, yes: bool) -> Result<(), Failure> {
    can_be_confirmed(yes)?;
    if yes {
        return Ok(());
    }
    let mut stderr = io::stderr().lock();
    let prompted = write!(stderr, "{} [y/N] ", printable(question)).and_then(|()| stderr.flush());
    let mut line = String::new();
    prompted.and_then(|()| io::stdin().lock().read_line(&mut line)).map_err(Failure::Runtime)?;
    if means_yes(&line) { Ok(()) } else { Err(Failure::Declined) }
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
