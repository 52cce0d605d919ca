//! Subcommands `fatek backup FILE RANGE…` and `fatek restore FILE`.

use std::collections::HashSet;
use std::path::Path;
use std::time::Duration;

use fatek::backup::{
    Backup, BackupError, Difference, Restore, RestoreError, RestoreOptions, RestoreReport, SpecialElements, TakeBackup,
};
use fatek::memory_map::special_range;
use fatek::program::PlcState;
use fatek::tag::Tag;
use fatek::{Element, Station, Value};

use crate::args::{BackupArgs, Consent, Plc, RestoreArgs, SpecialArg};
use crate::confirm::{can_be_confirmed, confirm};
use crate::connect;
use crate::failure::Failure;
use crate::output::{Cell, Output, Rows, complain};
use crate::retry::{Direction, is_line_failure, retry, write_progress};
use crate::signal::unless_signalled;
use crate::transfer::{Reporter, other_plc, shown, stops, warn_of_other_plc, warn_of_unknown_fields, would_stop};

/// Backs up ranges. Resumes after a line failure, while each attempt reads at least one more element.
/// Checks ranges and file before the first request.
pub(crate) async fn backup(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &BackupArgs,
    output: &Output,
) -> Result<(), Failure> {
    if args.compare {
        let backup = load(&args.file, &args.ranges)?;
        let station = connect::station(plc, timeout)?;
        args.model.check(&station, backup.ranges()).await?;
        return verify(&station, &args.file, &backup, output).await;
    }
    let taking = TakeBackup::new(args.ranges.iter().copied()).map_err(Failure::usage)?;
    // Before the transfer, which may be long.
    fatek::file::can_save(&args.file)?;
    let reporter = Reporter::new(output);
    let mut taking = taking.on_progress(reporter.callback());
    let station = connect::station(plc, timeout)?;
    args.model.check(&station, args.ranges.iter().copied()).await?;
    let run = async |taking: &mut TakeBackup| taking.run(&station).await;
    let progress = |taking: &TakeBackup, error: &BackupError| {
        is_line_failure(error.call_error()).then(|| taking.partial().value_count())
    };
    let note = |taking: &TakeBackup, error: &BackupError| {
        let cause = error.call_error().map_or_else(|| error.to_string(), ToString::to_string);
        format!("{cause}; {} elements read", taking.partial().value_count())
    };
    let repeated = retry(&mut taking, Direction::Read, &reporter, run, progress, note);
    let ended = reporter.until_end(unless_signalled(repeated)).await?;
    let interrupted = |signal| {
        let partial = taking.partial();
        let (values, all) = (partial.value_count(), partial.element_count());
        Failure::interrupted(format!(" after {values} of {all} elements: nothing was saved"))(signal)
    };
    let backup = ended.map_err(interrupted)?.map_err(|error| match error {
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
    for missing in backup.missing() {
        complain(format_args!("{} is missing: {}", missing.range, missing.reason));
    }
    if values == 0 {
        return Err(Failure::Missing { missing: all, all, file: None });
    }
    backup.save(&args.file)?;
    output.remark(format_args!("{}: {values} elements", shown(&args.file)));
    match all - values {
        0 => Ok(()),
        missing => Err(Failure::Missing { missing, all, file: Some(args.file.clone()) }),
    }
}

/// Compares the PLC with a backup. A refused input counts as different.
async fn verify(station: &Station, file: &Path, backup: &Backup, output: &Output) -> Result<(), Failure> {
    // A comparison writes nothing, and special elements are compared, too.
    let options = RestoreOptions::new().special(SpecialElements::Write);
    let report = compare(station, backup, options, output).await?;
    warn_of_other_plc(file, &report.other_plc);
    print(report.differences.iter().chain(&report.left_out_differences), output)?;
    let refused: usize = report.refused.iter().map(|refused| refused.range.element_count()).sum();
    report_refused(&report);
    let differing = report.differences.len() + report.left_out_differences.len() + refused;
    let all = report.compared + refused;
    if differing > 0 {
        return Err(Failure::Differs { parts: "elements", differing, all });
    }
    output.remark(format_args!("all {all} elements are equal"));
    Ok(())
}

/// Restores a backup. Resumes after a line failure, while less is left each time. Loads and checks the
/// file before the first request.
pub(crate) async fn restore(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &RestoreArgs,
    output: &Output,
) -> Result<(), Failure> {
    let backup = load(&args.file, &args.ranges)?;
    if let (None, Some(element)) = (args.special, first_special(&backup)) {
        return Err(Failure::Usage(format!(
            "{} has the special element {element}: writing it can cause system or I/O errors; give --special write, \
             or --special skip to restore the others",
            shown(&args.file)
        )));
    }
    let Consent { yes, dry_run } = args.consent;
    if !dry_run {
        can_be_confirmed(yes)?;
    }
    let station = connect::station(plc, timeout)?;
    if dry_run || !yes {
        // The differences are shown before the prompt.
        let report = compare(&station, &backup, options(args), output).await?;
        warn_of_other_plc(&args.file, &report.other_plc);
        print(to_be_written(&report), output)?;
        let (written, all, stops_plc) = (count(&report.to_write), report.compared, is_to_stop(&report, args));
        if dry_run {
            let stopped = if stops_plc { would_stop(args.run) } else { "" };
            output.remark(format_args!("{written} of {all} elements would be written{stopped}"));
        }
        // As the restore itself would.
        if !report.other_plc.is_empty() && !args.force {
            return Err(Failure::OtherPlc(report.other_plc));
        }
        if dry_run {
            return Ok(());
        }
        if written == 0 {
            output.remark(format_args!("{report}"));
            return Ok(());
        }
        let (file, stopped) = (shown(&args.file), if stops_plc { stops(args.run) } else { "" });
        let other = other_plc(&report.other_plc);
        confirm(&format!("Write {written} of {all} elements of {file} to {plc}?{stopped}{other}"), false).await?;
    }
    let reporter = Reporter::new(output);
    let mut restore = Restore::new(&backup, options(args)).on_progress(reporter.callback());
    let run = async |restore: &mut Restore| restore.run(&station).await;
    let progress = |_: &Restore, error: &RestoreError| {
        let left = count(&error.report.unwritten) + count(&error.report.in_doubt);
        write_progress(count(&error.report.written), left).filter(|_| is_line_failure(error.source.call_error()))
    };
    // Elements written by all attempts but the last, which the report covers.
    let mut before = 0;
    let note = |_: &Restore, error: &RestoreError| {
        before += count(&error.report.written);
        error.to_string()
    };
    let repeated = retry(&mut restore, Direction::Write, &reporter, run, progress, note);
    let ended = reporter.until_end(unless_signalled(repeated)).await?;
    let before = if before > 0 { format!("{before} written by earlier attempts") } else { String::new() };
    if !matches!(ended, Ok(Ok(_))) && !before.is_empty() {
        complain(format_args!("{before}"));
    }
    let ended = ended.map_err(|signal| Failure::interrupted(format!(": {}", restore.report()))(signal))?;
    let report = ended.or_else(|error| explain(error, output))?;
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
        print(report.remaining.iter(), output)?;
    }
    Err(error.into())
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
            shown(file),
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

fn first_special(backup: &Backup) -> Option<Element> {
    backup.ranges().flat_map(|range| range.elements()).find(|&element| special_range(element).is_some())
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
    let compared = reporter.until_end(restore.compare(station)).await;
    let report = compared.or_else(|error| explain(error, output))?;
    report_skipped(&report, output);
    Ok(report)
}

fn print<'a>(differences: impl Iterator<Item = &'a Difference>, output: &Output) -> Result<(), Failure> {
    let mut rows = Rows::new(["element", "backup", "plc"]);
    for Difference { element, expected, found, .. } in differences {
        rows.push([element.to_string().into(), cell(*expected), found.map(cell).into()]);
    }
    output.rows(&rows)
}

fn cell(value: Value) -> Cell {
    match value {
        Value::Bit(on) => Cell { text: u8::from(on).to_string(), json: on.into() },
        Value::Word(word) => word.into(),
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
    for range in &report.special {
        complain(format_args!("{range} skipped: special elements; to write them give --special write"));
    }
    for range in &report.left_out {
        output.remark(format_args!("{range} skipped: inputs and contacts cannot be restored"));
    }
    for range in &report.forced {
        complain(format_args!("{range} skipped: it differs, but is disabled; to write it give --forced"));
    }
}

fn options(args: &RestoreArgs) -> RestoreOptions {
    // The command line excludes --stop with --require-stopped.
    let options = RestoreOptions::new().stop_first(args.stop).require_stopped(args.require_stopped);
    let options = options.special(match args.special {
        None => SpecialElements::Refuse,
        Some(SpecialArg::Write) => SpecialElements::Write,
        Some(SpecialArg::Skip) => SpecialElements::Skip,
    });
    options.run_again(args.run).write_forced(args.forced).accept_other_plc(args.force).bridge(args.bridge)
}
