//! Subcommands `fatek backup FILE RANGE…` and `fatek restore FILE`.

use std::collections::HashSet;
use std::path::Path;
use std::time::Duration;

use fatek::backup::{
    Backup, BackupError, Difference, Restore, RestoreError, RestoreFailure, RestoreOptions, RestoreReport, TakeBackup,
};
use fatek::program::PlcState;
use fatek::tag::Tag;
use fatek::{Element, Station, Value};

use crate::args::{BackupArgs, Plc, RestoreArgs};
use crate::confirm::{can_be_confirmed, confirm};
use crate::connect;
use crate::failure::Failure;
use crate::output::{Cell, Output, Rows, complain};
use crate::retry::{Direction, is_line_failure, retry, write_progress};
use crate::signal;
use crate::transfer::{Reporter, warn_of_unknown_fields};

/// Checks ranges and file before the first request.
pub(crate) async fn backup(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &BackupArgs,
    output: &Output,
) -> Result<(), Failure> {
    if args.compare {
        let backup = load(&args.file, &args.ranges)?;
        let report = compare(&connect::station(plc, timeout)?, &backup, RestoreOptions::new(), output).await?;
        output.rows(&rows(report.differences.iter().chain(&report.left_out_differences)))?;
        // A refused input counts as different.
        let refused: usize = report.refused.iter().map(|refused| refused.range.element_count()).sum();
        report_refused(&report);
        let differing = report.differences.len() + report.left_out_differences.len() + refused;
        let all = report.compared + refused;
        if differing == 0 {
            output.remark(format_args!("all {all} elements are equal"));
            return Ok(());
        }
        return Err(Failure::Differs { parts: "elements", differing, all });
    }
    let taking = TakeBackup::new(args.ranges.iter().copied()).map_err(Failure::usage)?;
    // Before the transfer, which may be long.
    fatek::file::can_save(&args.file)?;
    let reporter = Reporter::new(output);
    let mut taking = taking.on_progress(reporter.callback());
    let station = connect::station(plc, timeout)?;
    let progress = |taking: &TakeBackup, error: &BackupError| {
        let BackupError::Call { source, .. } = error else { return None };
        is_line_failure(source).then(|| taking.partial().value_count())
    };
    let note = |taking: &TakeBackup, error: &BackupError| {
        let cause = std::error::Error::source(error).map_or_else(|| error.to_string(), ToString::to_string);
        format!("{cause}; {} elements read", taking.partial().value_count())
    };
    let run = async |taking: &mut TakeBackup| taking.run(&station).await;
    let result = retry(&mut taking, Direction::Read, (&reporter, output), run, progress, note).await;
    reporter.end_line();
    let backup = result.map_err(|error| match error {
        BackupError::Call { source, partial, .. } if partial.value_count() > 0 => {
            let (values, all) = (partial.value_count(), partial.element_count());
            Failure::of(format_args!("nothing was saved, {values} of {all} elements read"))(source)
        }
        BackupError::Call { source, .. } => source.into(),
        BackupError::Invalid(_) | BackupError::OtherStation { .. } | BackupError::OtherPlc { .. } | _ => {
            Failure::usage(error)
        }
    })?;
    let (values, all) = (backup.value_count(), backup.element_count());
    let missing = backup.missing();
    for missing in &missing {
        complain(format_args!("{} is missing: {}", missing.range, missing.reason));
    }
    if values == 0 {
        return Err(Failure::Missing { missing: all, all, file: None });
    }
    backup.save(&args.file)?;
    output.remark(format_args!("{}: {values} elements", args.file.display()));
    match all - values {
        0 => Ok(()),
        missing => Err(Failure::Missing { missing, all, file: Some(args.file.clone()) }),
    }
}

/// Loads and checks the file before the first request.
pub(crate) async fn restore(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &RestoreArgs,
    output: &Output,
) -> Result<(), Failure> {
    let backup = load(&args.file, &args.ranges)?;
    if !args.consent.dry_run {
        can_be_confirmed(args.consent.yes)?;
    }
    let station = connect::station(plc, timeout)?;
    if args.consent.dry_run {
        let report = compare(&station, &backup, options(args), output).await?;
        output.rows(&rows(to_be_written(&report)))?;
        let (written, all) = (count(&report.to_write), report.compared);
        let stopped = match (is_to_stop(&report, args), args.run) {
            (true, true) => "; the PLC runs, and would be stopped and started again",
            (true, false) => "; the PLC runs, and would be stopped",
            (false, _) => "",
        };
        output.remark(format_args!("{written} of {all} elements would be written{stopped}"));
        return Ok(());
    }
    if !args.consent.yes {
        // The differences are shown before the prompt.
        let report = compare(&station, &backup, options(args), output).await?;
        output.rows(&rows(to_be_written(&report)))?;
        if report.to_write.is_empty() {
            output.remark(format_args!("{report}"));
            return Ok(());
        }
        confirm(&question(plc, &report, args), false)?;
    }
    let stopped = signal::stopped().map_err(Failure::Runtime)?;
    let reporter = Reporter::new(output);
    let mut restore = Restore::new(&backup, options(args)).on_progress(reporter.callback());
    let mut before = 0;
    let ended = tokio::select! {
        biased;
        _ = stopped => None,
        ended = restore_with_retries(&mut restore, &station, &mut before, (&reporter, output)) => Some(ended),
    };
    reporter.end_line();
    // The report covers the last attempt only.
    let before = if before > 0 { format!("{before} written by earlier attempts") } else { String::new() };
    let report = match ended {
        Some(Ok(report)) => report,
        failed => {
            if !before.is_empty() {
                complain(format_args!("{before}"));
            }
            let interrupted = || Err(Failure::RestoreInterrupted(Box::new(restore.report())));
            return failed.map_or_else(interrupted, |ended| ended.or_else(|error| explain(error, output)).map(drop));
        }
    };
    report_skipped(&report, output);
    let separator = if before.is_empty() { "" } else { "; " };
    output.remark(format_args!("{report}{separator}{before}"));
    Ok(())
}

/// Prints the elements of a failed restore.
fn explain(error: RestoreError, output: &Output) -> Result<RestoreReport, Failure> {
    let report = &error.report;
    report_refused(report);
    if !report.remaining.is_empty() {
        output.rows(&rows(report.remaining.iter()))?;
    }
    Err(error.into())
}

/// Restores the backup. Resumes after a line failure, while less is left each time.
///
/// Adds to `before` the elements written by all attempts but the last.
async fn restore_with_retries(
    restore: &mut Restore,
    station: &Station,
    before: &mut usize,
    display: (&Reporter, &Output),
) -> Result<RestoreReport, RestoreError> {
    let run = async |restore: &mut Restore| restore.run(station).await;
    let progress = |_: &Restore, error: &RestoreError| {
        let RestoreError { source: RestoreFailure::Call { source, .. }, report, .. } = error else { return None };
        let left = count(&report.unwritten) + count(&report.in_doubt);
        write_progress(count(&report.written), left).filter(|_| is_line_failure(source))
    };
    let note = |_: &Restore, error: &RestoreError| {
        *before += count(&error.report.written);
        error.to_string()
    };
    retry(restore, Direction::Write, display, run, progress, note).await
}

/// Loads the given ranges of a backup file. A selection without any value is an error.
fn load(file: &Path, ranges: &[Tag]) -> Result<Backup, Failure> {
    let mut backup = Backup::load(file)?;
    warn_of_unknown_fields(file, backup.unknown_fields());
    if !ranges.is_empty() {
        backup = backup.select(ranges.iter().copied()).map_err(Failure::usage)?;
    }
    match backup.missing().first() {
        Some(missing) if backup.value_count() == 0 => Err(Failure::Usage(format!(
            "{} has no value in these ranges: {} is missing, {}",
            file.display(),
            missing.range,
            missing.reason
        ))),
        _ => Ok(backup),
    }
}

/// Differences that would be written. Equal elements written along with them are not included.
fn to_be_written(report: &RestoreReport) -> impl Iterator<Item = &Difference> {
    let written: HashSet<Element> = report.to_write.iter().flat_map(Tag::elements).collect();
    report.differences.iter().filter(move |difference| written.contains(&difference.element))
}

fn is_to_stop(report: &RestoreReport, args: &RestoreArgs) -> bool {
    args.stop && report.plc == PlcState::Running && !report.to_write.is_empty()
}

fn count(ranges: &[Tag]) -> usize {
    ranges.iter().map(Tag::element_count).sum()
}

/// Compares PLC and backup.
async fn compare(
    station: &Station,
    backup: &Backup,
    options: RestoreOptions,
    output: &Output,
) -> Result<RestoreReport, Failure> {
    let reporter = Reporter::new(output);
    let mut restore = Restore::new(backup, options).on_progress(reporter.callback());
    let report = restore.compare(station).await;
    reporter.end_line();
    let report = report.or_else(|error| explain(error, output))?;
    report_skipped(&report, output);
    Ok(report)
}

fn rows<'a>(differences: impl Iterator<Item = &'a Difference>) -> Rows {
    let mut rows = Rows::new(["element", "backup", "plc"]);
    for Difference { element, expected, found, .. } in differences {
        rows.push([element.to_string().into(), cell(*expected), found.map(cell).into()]);
    }
    rows
}

fn cell(value: Value) -> Cell {
    match value {
        Value::Bit(on) => Cell { text: u8::from(on).to_string(), json: on.into() },
        Value::Word(word) => u32::from(word).into(),
        Value::DWord(double) => double.into(),
    }
}

fn report_refused(report: &RestoreReport) {
    for refused in &report.refused {
        complain(format_args!("{} was refused: {}", refused.range, refused.error));
    }
}

fn report_skipped(report: &RestoreReport, output: &Output) {
    for missing in &report.missing {
        complain(format_args!("{} is missing in the backup: {}", missing.range, missing.reason));
    }
    for range in &report.left_out {
        output.remark(format_args!("{range} skipped: inputs and contacts cannot be restored"));
    }
    for range in &report.forced {
        complain(format_args!("{range} skipped: it differs, but is disabled; to write it give --forced"));
    }
}

fn options(args: &RestoreArgs) -> RestoreOptions {
    let choose = |chosen, choice: fn(RestoreOptions) -> RestoreOptions, options| {
        if chosen { choice(options) } else { options }
    };
    let mut options = RestoreOptions::new().bridge(args.bridge);
    options = choose(args.stop, RestoreOptions::stop_first, options);
    options = choose(args.run, RestoreOptions::run_again, options);
    options = choose(args.require_stopped, RestoreOptions::require_stopped, options);
    choose(args.forced, RestoreOptions::write_forced, options)
}

fn question(plc: &Plc, report: &RestoreReport, args: &RestoreArgs) -> String {
    let stopped = match (is_to_stop(report, args), args.run) {
        (true, true) => " The PLC is stopped first and started again afterwards.",
        (true, false) => " The PLC is stopped first and stays stopped.",
        (false, _) => "",
    };
    let written = count(&report.to_write);
    let (station, link) = (plc.station.as_deref().unwrap_or_default(), plc.link.as_deref().unwrap_or_default());
    format!(
        "Write {written} of {} elements of {} to station {station} on {link}?{stopped}",
        report.compared,
        args.file.display()
    )
}
