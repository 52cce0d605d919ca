//! Repeats a transfer after line failures, while each run makes progress.

use std::time::Duration;

use fatek::Error::{BadReply, Connect, Disconnected, Timeout};
use tokio::time::sleep;

use crate::transfer::Reporter;

/// Limit of repetitions of a transfer that writes.
const MAX_REPEATS: u32 = 5;
/// Pause before a transfer that writes is repeated.
const PAUSE: Duration = Duration::from_millis(500);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    /// Repeated at once, without a limit: each run reads something.
    Read,
    /// Repeated after a pause, a few times.
    Write,
}

/// Runs a transfer until it succeeds, or fails otherwise than by the line, or makes no progress.
///
/// `progress`: after a run that may be repeated, a number that must grow from run to run, from more
/// than 0. `note`: the remark when it is repeated.
pub(crate) async fn retry<T, O, E>(
    transfer: &mut T,
    direction: Direction,
    reporter: &Reporter<'_>,
    mut run: impl AsyncFnMut(&mut T) -> Result<O, E>,
    progress: impl Fn(&T, &E) -> Option<usize>,
    mut note: impl FnMut(&T, &E) -> String,
) -> Result<O, E> {
    let (mut best, mut repeats) = (0, 0);
    loop {
        let error = match run(transfer).await {
            Ok(done) => return Ok(done),
            Err(error) => error,
        };
        let may_repeat = direction == Direction::Read || repeats < MAX_REPEATS;
        match progress(transfer, &error) {
            Some(progress) if may_repeat && progress > best => best = progress,
            Some(_) | None => return Err(error),
        }
        repeats += 1;
        reporter.remark(format_args!("{}; resuming", note(transfer, &error)));
        if direction == Direction::Write {
            sleep(PAUSE).await;
        }
    }
}

/// The progress of a transfer that writes: `None` if the run has written nothing.
pub(crate) fn write_progress(written: usize, left: usize) -> Option<usize> {
    (written > 0).then(|| usize::MAX - left)
}

/// Returns whether a transfer failed because the line did, by the error of its request. A refusal
/// by the PLC is final.
pub(crate) fn is_line_failure(call_error: Option<&fatek::Error>) -> bool {
    matches!(call_error, Some(Timeout { .. } | BadReply { .. } | Disconnected { .. } | Connect { .. }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::{FormatArg, Output};

    /// Runs a transfer that leaves these numbers of steps. Returns the number of runs.
    async fn runs(direction: Direction, left: &[usize]) -> usize {
        let output = Output::new(FormatArg::Csv, true);
        let reporter = Reporter::new(&output);
        let mut runs = 0;
        let run = async |runs: &mut usize| {
            *runs += 1;
            left.get(*runs - 1).copied().map_or(Ok(()), Err)
        };
        let progress = |_: &usize, left: &usize| match direction {
            Direction::Read => Some(100 - left),
            Direction::Write => write_progress(1, *left),
        };
        let _ = retry(&mut runs, direction, &reporter, run, progress, |_, _| String::new()).await;
        runs
    }

    #[tokio::test(start_paused = true)]
    async fn a_transfer_is_repeated_while_it_makes_progress() {
        for direction in [Direction::Read, Direction::Write] {
            assert_eq!(runs(direction, &[]).await, 1);
            assert_eq!(runs(direction, &[90, 80, 70]).await, 4);
            assert_eq!(runs(direction, &[90, 80, 80, 70]).await, 3);
            assert_eq!(runs(direction, &[90, 95, 70]).await, 2);
        }
        assert_eq!(runs(Direction::Read, &[100, 90]).await, 1, "the first run has read nothing");
        let many: Vec<usize> = (0..20).rev().collect();
        assert_eq!((runs(Direction::Read, &many).await, runs(Direction::Write, &many).await), (21, 6));
    }
}
