//! Subcommands `fatek program read|write|verify|info FILE`.

use std::time::Duration;

use fatek::Station;
use fatek::file::{FileError, FormatError, can_save, utc};
use fatek::program::{PlcState, Program, ProgramError, ReadProgram, WriteOptions, WriteProgram, WriteProgramError};
use serde_json::Value;

use crate::args::{Plc, ProgramFile, ProgramReadArgs, ProgramVerifyArgs, ProgramWriteArgs};
use crate::confirm::{can_be_confirmed, confirm};
use crate::connect;
use crate::failure::{Failure, interrupted_write};
use crate::output::{Cell, Format, Output, Rows, hex, version};
use crate::retry::{Direction, is_line_failure, retry, write_progress};
use crate::signal::unless_signalled;
use crate::transfer::{Reporter, other_plc, shown, stops, warn_of_other_plc, warn_of_unknown_fields, would_stop};

/// Uploads the program. Resumes after a line failure, while each attempt reads at least one more
/// page. Checks that the file can be saved before the first request.
pub(crate) async fn read(station: &Station, args: &ProgramReadArgs, output: &Output) -> Result<(), Failure> {
    let path = &args.file.file;
    can_save(path)?;
    let reporter = Reporter::new(output);
    let mut read = ReadProgram::new().twice(args.twice).on_progress(reporter.callback());
    let run = async |read: &mut ReadProgram| read.run(station).await;
    let progress =
        |read: &ReadProgram, error: &ProgramError| is_line_failure(error.call_error()).then(|| read.pages_done());
    let note = |read: &ReadProgram, error: &ProgramError| format!("{error}; {} pages read", read.pages_done());
    let repeated = retry(&mut read, Direction::Read, &reporter, run, progress, note);
    let ended = reporter.until_end(unless_signalled(repeated)).await?;
    let interrupted = |signal| {
        let done = format!(" after {} confirmed pages: nothing was saved", read.pages_done());
        Failure::interrupted(done)(signal)
    };
    let program = ended.map_err(interrupted)?.map_err(|error| match read.pages_done() {
        0 => Failure::Program(error),
        1.. => Failure::ProgramPart { error },
    })?;
    if args.file.raw { program.save_raw(path) } else { program.save(path) }?;
    output.remark(format_args!("{}: {}, {} pages", shown(path), program.header(), program.pages().len()));
    if let Some(page) = program.refused_page() {
        let stated = program.header().page_count();
        output.remark(format_args!("the PLC refused page {page}: its memory ends before the {stated} pages it states"));
        if args.file.raw {
            output.remark(format_args!("a raw file without the others cannot be loaded again: save one without --raw"));
        }
    }
    Ok(())
}

/// Downloads the program. Resumes after a line failure, while less is left each time. Loads and checks
/// the file before the first request.
pub(crate) async fn write(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &ProgramWriteArgs,
    output: &Output,
) -> Result<(), Failure> {
    let program = load(&args.file)?;
    let station = connect::station(plc, timeout)?;
    let reporter = Reporter::new(output);
    let mut write = WriteProgram::new(&program, options(args)).on_progress(reporter.callback());
    if args.consent.dry_run {
        let pages = reporter.until_end(write.dry_run(&station)).await?;
        warn_of_other_plc(&args.file.file, &write.state().other_plc);
        print_pages(&pages, output)?;
        let effect = if pages.is_empty() { String::new() } else { effect(write.state().plc, args.run) };
        output.remark(format_args!("{} of {} pages would be written{effect}", pages.len(), program.pages().len()));
        return Ok(());
    }
    ask(&station, plc, &program, args).await?;
    let run = async |write: &mut WriteProgram| write.run(&station).await;
    let progress = |_: &WriteProgram, error: &WriteProgramError| {
        write_progress(error.state.written.len(), error.state.left())
            .filter(|_| is_line_failure(error.source.call_error()))
    };
    let note = |_: &WriteProgram, error: &WriteProgramError| error.to_string();
    let repeated = retry(&mut write, Direction::Write, &reporter, run, progress, note);
    let ended = reporter.until_end(unless_signalled(repeated)).await?;
    let report = ended.map_err(|signal| Failure::interrupted(interrupted_write(&write.state()))(signal))??;
    let state = match (report.was_stopped, report.running) {
        (_, true) => "the PLC runs",
        (true, false) => "the PLC ran before and is now stopped",
        (false, false) => "the PLC is stopped",
    };
    // The sum of all attempts of this command.
    match (report.written.len() + report.written_before.len(), report.pages) {
        (0, all) => output.remark(format_args!("all {all} pages are equal, nothing was written; {state}")),
        (written, all) => output.remark(format_args!("{written} of {all} pages written and compared; {state}")),
    }
    if !output.quiet {
        warn_of_other_plc(&args.file.file, &report.other_plc);
    }
    Ok(())
}

/// The effect of a download on a PLC in this state. `run`: it is started again if it runs.
fn effect(plc: PlcState, run: bool) -> String {
    match plc {
        PlcState::Running => would_stop(run).to_owned(),
        PlcState::Stopped => "; the PLC is stopped, and would stay stopped".to_owned(),
        PlcState::Unknown | _ => format!("; {plc}"),
    }
}

pub(crate) async fn verify(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &ProgramVerifyArgs,
    output: &Output,
) -> Result<(), Failure> {
    let program = load(&args.file)?;
    let station = connect::station(plc, timeout)?;
    let reporter = Reporter::new(output);
    let mut write = WriteProgram::new(&program, WriteOptions::new()).on_progress(reporter.callback());
    // Nothing was to be written, so the state of the PLC is of no interest.
    let pages = reporter.until_end(write.compare(&station)).await.map_err(|error| *error.source)?;
    print_pages(&pages, output)?;
    if pages.is_empty() {
        output.remark(format_args!("all {} pages are equal", program.pages().len()));
        Ok(())
    } else {
        Err(Failure::Differs { parts: "pages", differing: pages.len(), all: program.pages().len() })
    }
}

pub(crate) fn info(file: &ProgramFile, output: &Output) -> Result<(), Failure> {
    let fields = fields(&load(file)?);
    if output.format == Format::Json {
        return output.json(&fields.into_iter().map(|(name, cell)| (name, cell.json)).collect());
    }
    let mut rows = Rows::new(["field", "value"]);
    fields.into_iter().for_each(|(name, cell)| rows.push([name.into(), cell]));
    output.rows(&rows)
}

fn fields(program: &Program) -> Vec<(&'static str, Cell)> {
    let header = program.header();
    let unknown = || Cell { text: "unknown".to_owned(), json: Value::Null };
    let none = || Cell { text: "none".to_owned(), json: Value::Null };
    let known = |text: Option<String>| text.map_or_else(unknown, Cell::from);
    let status = program.status();
    vec![
        ("kind", header.kind().to_string().into()),
        ("digits", header.digits().into_iter().collect::<String>().into()),
        ("ladder_words", header.ladder_words().into()),
        ("pages", program.pages().len().into()),
        ("refused_page", program.refused_page().map_or_else(none, Cell::from)),
        ("read_at", known(program.read_at().map(utc))),
        ("program_capacity", known(program.brief_status().map(|status| status.capacity().to_string()))),
        ("main_unit", known(status.map(|status| status.main_unit().to_string()))),
        ("os_version", known(status.map(|status| version(status.os_version())))),
        ("ran", status.map_or_else(unknown, |status| status.flags().running().into())),
        ("status", known(status.map(|status| hex(status.raw())))),
    ]
}

fn load(file: &ProgramFile) -> Result<Program, Failure> {
    let loaded = if file.raw { Program::load_raw(&file.file) } else { Program::load(&file.file) };
    let program = loaded.map_err(|error| {
        let foreign = matches!(error, FileError::Format { source: FormatError::Foreign, .. });
        if foreign { Failure::NotRaw(error) } else { error.into() }
    })?;
    warn_of_unknown_fields(&file.file, program.unknown_fields());
    Ok(program)
}

fn print_pages(pages: &[u16], output: &Output) -> Result<(), Failure> {
    let mut rows = Rows::new(["page"]);
    pages.iter().for_each(|&page| rows.push([page.into()]));
    output.rows(&rows)
}

fn options(args: &ProgramWriteArgs) -> WriteOptions {
    let options = WriteOptions::new()
        .stop_first(args.stop)
        .run_again(args.run)
        .all_pages(args.all)
        .verify_all(args.verify)
        .accept_other_plc(args.force);
    args.page_timeout.map_or(options, |timeout| options.page_timeout(timeout))
}

/// Prompts for confirmation, unless `--yes` was given. The prompt says whether the program is of
/// another PLC.
async fn ask(station: &Station, plc: &Plc, program: &Program, args: &ProgramWriteArgs) -> Result<(), Failure> {
    can_be_confirmed(args.consent.yes)?;
    if args.consent.yes {
        return Ok(());
    }
    let differences = match program.status() {
        Some(_) => program.plc_differences(&station.read_detailed_status().await?),
        None => Vec::new(),
    };
    if !differences.is_empty() && !args.force {
        return Err(Failure::OtherPlc(differences));
    }
    let (file, other) = (shown(&args.file.file), other_plc(&differences));
    let stopped = if args.stop { stops(args.run) } else { "" };
    confirm(&format!("Write {file} ({}) to {plc}?{stopped}{other}", program.header()), false).await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_state_is_not_reported_as_stopped() {
        // Before: `; the PLC is stopped, and would stay stopped`.
        assert_eq!(effect(PlcState::Unknown, false), "; whether the PLC runs is not known");
        assert_eq!(effect(PlcState::Stopped, true), "; the PLC is stopped, and would stay stopped");
        assert_eq!(effect(PlcState::Running, false), "; the PLC runs, and would be stopped");
        assert_eq!(effect(PlcState::Running, true), "; the PLC runs, and would be stopped and started again");
    }
}
