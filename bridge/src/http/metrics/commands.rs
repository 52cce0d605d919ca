//! Metrics of commands, if an output takes any.

use std::fmt;

use super::{Labels, Writer};
use crate::command::PlcCommandStats;
use crate::http::Shared;

/// A result of commands, and its number.
type ResultCounter = (&'static str, fn(&PlcCommandStats) -> u64);

/// The results of commands.
const RESULTS: [ResultCounter; 3] =
    [("ok", |plc| plc.ok), ("refused", |plc| plc.refused), ("unknown", |plc| plc.unknown)];

pub(super) fn write(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let Some(commands) = &shared.bridge.commands else { return Ok(()) };
    let is_ready = u64::from(commands.failure().is_none());
    let help = "0 if no command can be executed, since the file of their ids cannot be used";
    to.gauge("commands_ready", None, help, [(vec![], is_ready)])?;
    let stats = commands.stats();
    let plcs = || stats.plcs.iter().map(|(plc, stats)| (&**plc, stats));
    let of = |name, result| vec![("plc", name), ("result", result)];
    let results = plcs().flat_map(|(name, plc)| RESULTS.map(|(result, count)| (of(name, result), count(plc))));
    to.counter("commands", None, "Commands by result; unknown: they may have been executed", results)?;
    let labels = |name| -> Labels<'_> { vec![("plc", name)] };
    let repeated = plcs().map(|(name, plc)| (labels(name), plc.repeated));
    to.counter("commands_repeated", None, "Repetitions of commands, which were not executed again", repeated)?;
    let waiting = plcs().map(|(name, plc)| (labels(name), u64::try_from(plc.waiting).unwrap_or(u64::MAX)));
    to.gauge("commands_waiting", None, "Commands that wait or run", waiting)?;
    let pulses = plcs().map(|(name, plc)| (labels(name), u64::try_from(plc.pulses_open).unwrap_or(u64::MAX)));
    to.gauge("commands_open_pulses", None, "Pulses that have begun and whose end is not confirmed", pulses)?;
    to.counter("commands_without_plc", None, "Commands for a PLC that does not exist", [(vec![], stats.no_plc)])
}
