//! Subcommand `fatek doctor`: examines one PLC for the assumptions of this crate.
//!
//! - `check.rs` a check as data, `checks/` the list of them: assumption, source, requests, judgement. No I/O.
//! - `request.rs` requests, also wrong ones; `exchange.rs` bytes sent and received; `facts.rs` facts by them.
//! - `run.rs` sends the requests, over `line.rs`: at a bounded rate, in step by loop-backs.
//! - `report.rs`, `evidence.rs`, `times.rs` the report.
//!
//! Invariants:
//! - Without `--write` no request writes or controls.
//! - One request at a time, but for the checks of order and of connections.
//! - A value that a check has written is restored also if the examination is interrupted. It counts as restored when
//!   it is read back; until then no other check writes.

mod check;
mod checks;
mod evidence;
mod exchange;
mod facts;
mod line;
mod report;
mod request;
mod run;
mod times;

use std::ops::RangeInclusive;
use std::path::Path;
use std::time::{Duration, Instant};

use fatek::link::defaults;
use fatek::memory_map::special_range;
use fatek::{Element, Endpoint, Station, Symbol};

use self::check::{Check, Choice, Verdict};
use self::checks::Numbers;
use self::line::{Connect, Medium};
use self::report::{Contents, Report};
use self::request::{Requests, Unit, unit_of};
use self::run::{DUPLICATE, End, Pace, Runner};
use crate::args::{DoctorArgs, Plc};
use crate::confirm::{can_be_confirmed, confirm};
use crate::connect;
use crate::failure::Failure;
use crate::output::{Format, Output, complain, print};
use crate::progress::StatusLine;
use crate::signal::unless_signalled;
use crate::transfer::shown;

/// Requests of the check of order.
const LOAD: usize = 24;

pub(crate) async fn doctor(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &DoctorArgs,
    output: &Output,
) -> Result<(), Failure> {
    let endpoint = connect::endpoint(plc.link()?)?;
    let requests = Requests { framing: endpoint.framing(), station: connect::number(plc)? };
    let element = args.write.map(writable).transpose()?;
    if let Some(path) = &args.report {
        fatek::file::can_save(path)?;
    }
    let numbers = Numbers {
        connections: args.connections.into(),
        idle: args.idle.unwrap_or(Duration::from_secs(60)),
        load: LOAD,
        element: element.clone(),
    };
    let choice = Choice {
        quick: args.quick,
        load: !args.no_load,
        idle: args.idle,
        unknown_commands: args.unknown_commands,
        write: element.is_some(),
    };
    let checks = checks::all(requests, &numbers);
    let pace = Pace {
        timeout: timeout.unwrap_or_else(|| default_timeout(&endpoint)),
        interval: Duration::from_secs(1) / u32::from(args.rate),
    };
    let estimate = estimate(&checks, choice, pace, &numbers);
    if let Some(element) = &element {
        can_be_confirmed(args.yes)?;
        output.remark(format_args!("{estimate}"));
        let output = if is_output(element) { " (a physical output)" } else { "" };
        confirm(&format!("Write {element}{output} of {plc}, and restore it?"), args.yes).await?;
    } else {
        output.remark(format_args!("{estimate}"));
    }
    let began = Instant::now();
    let mut runner = Runner::new(endpoint.clone(), requests, &checks, choice, pace);
    let progress = StatusLine::new(output);
    let all = checks.len();
    let show =
        |place: usize, check: &Check| progress.show(format_args!("check {} of {all}: {}", place + 1, check.name));
    let ended = unless_signalled(runner.run(show)).await;
    drop(progress);
    if let Err(undo) = runner.undo().await {
        complain(format_args!("restoring was not confirmed: check it with `fatek write {} --verify`", undo.assignment));
    }
    let ended = ended?;
    if let Ok(Err(_)) = &ended
        && runner.examined.iter().all(Option::is_none)
    {
        // Nothing came, or no connection could be opened: a link says why.
        drop(runner);
        return Err(unanswered(&connect::station(plc, timeout)?).await);
    }
    let failure = match &ended {
        Ok(Ok(())) => None,
        Ok(Err(End::Silent)) => {
            Some(Failure::EndedEarly { reason: "the PLC does not answer any more".to_owned(), status: 4 })
        }
        Ok(Err(End::Lost(error))) => {
            Some(Failure::EndedEarly { reason: format!("no connection any more: {error}"), status: 5 })
        }
        Err(signal) => Some(Failure::interrupted("")(*signal)),
    };
    let contents = Contents { evidence: args.evidence, values: args.values, address: args.with_address };
    let report = Report::new(&checks, &runner.examined, &runner.facts, contents, (runner.sent, began.elapsed()))
        .with_address(args.with_address.then(|| plc.to_string()))
        .with_ended(failure.as_ref().map(public));
    if let Some(path) = &args.report {
        save(&report, path)?;
    }
    match output.format {
        Format::Table => print(format_args!("{}", report.text()))?,
        Format::Json => output.json(&report.json())?,
        Format::Csv => output.rows(&report.rows())?,
    }
    output.remark(format_args!("{}", report.summary()));
    if let Some(path) = &args.report {
        output.remark(format_args!("saved {}; docs/HARDWARE.md says where to send it", shown(path)));
    }
    match (failure, report.count(Verdict::Contradicts)) {
        (Some(failure), _) => Err(failure),
        (None, 0) => Ok(()),
        (None, contradictions) => Err(Failure::Contradicted { contradictions, all: report.len() }),
    }
}

/// The reason of an early end, for a report: an error of the system may name an address.
fn public(failure: &Failure) -> String {
    match failure.exit_status() {
        4 => "the PLC did not answer any more".to_owned(),
        5 => "the connection was lost".to_owned(),
        _ => "interrupted".to_owned(),
    }
}

/// The element of `--write`, if it can be written and restored.
fn writable(element: Element) -> Result<String, Failure> {
    let refuse = |rule: &str| Err(Failure::Usage(format!("cannot examine writing with {element}: {rule}")));
    if let Some(range) = special_range(element) {
        return refuse(&format!("it is special ({range})"));
    }
    let symbol = element.symbol();
    if symbol == Symbol::D && SYSTEM_D.contains(&element.address()) {
        return refuse(&format!("the system uses some of D{}-D{}", SYSTEM_D.start(), SYSTEM_D.end()));
    }
    match (unit_of(symbol.as_str()), symbol) {
        (Unit::DWord, _) => refuse("give a discrete or a 16-bit register"),
        (Unit::Word, Symbol::WX | Symbol::WY | Symbol::WM | Symbol::WS | Symbol::WT | Symbol::WC) => {
            refuse("a word of discretes has 16 elements: give one of them")
        }
        (Unit::Bit, Symbol::X | Symbol::T | Symbol::C) => refuse("the PLC sets it"),
        (Unit::Bit | Unit::Word, _) => Ok(element.to_string()),
    }
}

/// Registers D that the system uses in part (facts 1).
const SYSTEM_D: RangeInclusive<u16> = 4000..=4095;

/// Returns whether an element, as text, is a physical output.
fn is_output(element: &str) -> bool {
    element.starts_with('Y')
}

fn default_timeout(endpoint: &Endpoint) -> Duration {
    match endpoint.medium() {
        Medium::Tcp | Medium::Udp => defaults::RESPONSE_TIMEOUT,
        Medium::Serial => defaults::SERIAL_RESPONSE_TIMEOUT,
    }
}

/// The number of requests and the time of an examination, in one line.
fn estimate(checks: &[Check], choice: Choice, pace: Pace, numbers: &Numbers) -> String {
    let chosen = || checks.iter().filter(|check| check.left_out(choice).is_none());
    // Each request that is not answered is followed by a loop-back.
    let silences: usize = chosen().map(|check| check.silences).sum();
    let requests: usize = chosen().map(|check| check.usual).sum::<usize>() + silences;
    let interval = pace.interval.max(DUPLICATE);
    let per_second = (1.0 / interval.as_secs_f64()).round();
    let idle = choice.idle.map_or(Duration::ZERO, |_| numbers.idle);
    let time = interval.mul_f64(requests as f64) + pace.timeout.mul_f64(silences as f64) + idle;
    let written = numbers.element.as_ref().map(|element| format!("writes and restores {element}"));
    let effect = written.unwrap_or_else(|| "reading only".to_owned());
    format!(
        "{} checks, about {requests} requests if each is answered, {per_second}/s, {:.0} s; {effect}",
        chosen().count(),
        time.as_secs_f64().ceil()
    )
}

/// The error of a PLC that does not answer at all, from a link, which knows more causes.
async fn unanswered(station: &Station) -> Failure {
    match station.read_status().await {
        Err(error) => error.into(),
        Ok(_) => Failure::EndedEarly { reason: "the PLC did not answer at first".to_owned(), status: 4 },
    }
}

fn save(report: &Report, path: &Path) -> Result<(), Failure> {
    let is_json = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json"));
    let text = if is_json { format!("{:#}\n", report.json()) } else { report.markdown() };
    Ok(fatek::file::save(path, text.as_bytes())?)
}

#[cfg(test)]
mod tests;
