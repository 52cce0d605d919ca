//! Asking before a PLC is changed.

use std::io::{self, BufRead, IsTerminal, Write};

use crate::failure::Failure;

/// Whether what would be confirmed can be: with `--yes`, or by somebody at a terminal. To be asked before anything is sent.
pub(crate) fn can_be_confirmed(yes: bool) -> Result<(), Failure> {
    if yes || (io::stdin().is_terminal() && io::stderr().is_terminal()) {
        return Ok(());
    }
    Err(Failure::Usage("this changes the PLC, and there is no terminal to ask at: say --yes (or --dry-run)".to_owned()))
}

/// Asks, unless `--yes` was said.
pub(crate) fn confirm(question: &str, yes: bool) -> Result<(), Failure> {
    can_be_confirmed(yes)?;
    if yes {
        return Ok(());
    }
    let mut stderr = io::stderr().lock();
    let asked = write!(stderr, "{question} [y/N] ").and_then(|()| stderr.flush());
    let mut answer = String::new();
    asked.and_then(|()| io::stdin().lock().read_line(&mut answer)).map_err(Failure::Runtime)?;
    if means_yes(&answer) { Ok(()) } else { Err(Failure::Declined) }
}

fn means_yes(answer: &str) -> bool {
    matches!(answer.trim(), "y" | "Y" | "yes" | "Yes" | "YES")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_yes_is_a_yes() {
        for yes in ["y\n", "Y", " yes\r\n"] {
            assert!(means_yes(yes), "{yes:?}");
        }
        for no in ["", "\n", "n\n", "yep\n", "no\n", "y e s\n"] {
            assert!(!means_yes(no), "{no:?}");
        }
    }
}
