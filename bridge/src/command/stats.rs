//! Figures of commands, for the metrics and the page.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::reply::{Outcome, Reply};

/// Figures of the commands for one PLC, since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlcCommandStats {
    /// Commands whose write was confirmed.
    pub ok: u64,
    /// Commands that wrote nothing.
    pub refused: u64,
    /// Commands of which it is not known whether they wrote.
    pub unknown: u64,
    /// Repetitions of a command, which got its reply.
    pub repeated: u64,
    /// Commands that wait or run now.
    pub waiting: usize,
    /// Pulses that have begun and whose end is not confirmed yet.
    pub pulses_open: usize,
}

/// Figures of all commands.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CommandStats {
    /// By the name of the PLC, for those that got a command.
    pub plcs: BTreeMap<Arc<str>, PlcCommandStats>,
    /// Commands for a PLC that does not exist.
    pub no_plc: u64,
}

/// The figures, shared with the readers.
#[derive(Clone, Debug, Default)]
pub(super) struct Figures(Arc<Mutex<CommandStats>>);

impl Figures {
    pub(super) fn snapshot(&self) -> CommandStats {
        self.lock().clone()
    }

    pub(super) fn of(&self, plc: &str, change: impl FnOnce(&mut PlcCommandStats)) {
        let mut stats = self.lock();
        match stats.plcs.get_mut(plc) {
            Some(known) => change(known),
            None => change(stats.plcs.entry(plc.into()).or_default()),
        }
    }

    pub(super) fn count(&self, plc: &str, reply: &Reply) {
        self.of(plc, |stats| {
            let counter = match reply.result() {
                Outcome::Ok => &mut stats.ok,
                Outcome::Refused => &mut stats.refused,
                Outcome::Unknown => &mut stats.unknown,
            };
            *counter = counter.saturating_add(1);
        });
    }

    pub(super) fn count_no_plc(&self) {
        let mut stats = self.lock();
        stats.no_plc = stats.no_plc.saturating_add(1);
    }

    fn lock(&self) -> MutexGuard<'_, CommandStats> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
