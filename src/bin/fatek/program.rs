//! Subcommands `fatek program read|write|verify|info FILE`.

use std::time::Duration;

use fatek::Station;
use fatek::file::{FileError, FormatError, can_save, utc};
use fatek::program::{
    PlcState, Program, ProgramError, ReadProgram, WriteOptions, WriteProgram, WriteProgramError, WriteReport,
};
use serde_json::{Map, Value};

use crate::args::{Plc, ProgramFile, ProgramReadArgs, ProgramVerifyArgs, ProgramWriteArgs};
use crate::confirm::{can_be_confirmed, confirm};
use crate::connect;
use crate::failure::Failure;
use crate::output::{Cell, Format, Output, Rows, hex};
use crate::retry::{Direction, is_line_failure, retry, write_progress};
use crate::signal;
use crate::transfer::{Reporter, warn_of_unknown_fields};

/// Checks that the file can be saved before the first request.
pub(crate) async fn read(station: &Station, args: &ProgramReadArgs, output: &Output) -> Result<(), Failure> {
    can_save(&args.file.file)?;
    let stopped = signal::stopped().map_err(Failure::Runtime)?;
    let reporter = Reporter::new(output);
    let mut read = ReadProgram::new().on_progress(reporter.callback());
    if args.twice {
        read = read.twice();
    }
    let ended = tokio::select! {
        biased;
        _ = stopped => None,
        ended = read_with_retries(&mut read, station, (&reporter, output)) => Some(ended),
    };
    reporter.end_line();
    let Some(program) = ended.transpose()? else {
        return Err(Failure::ReadInterrupted { pages: read.pages_done() });
    };
    let path = &args.file.file;
    if args.file.raw { program.save_raw(path) } else { program.save(path) }?;
    output.remark(format_args!("{}: {}, {} pages", path.display(), program.header(), program.pages().len()));
    Ok(())
}

/// Uploads the program. Resumes after a line failure, while each attempt reads at least one more
/// page.
async fn read_with_retries(
    read: &mut ReadProgram,
    station: &Station,
    display: (&Reporter, &Output),
) -> Result<Program, ProgramError> {
    let run = async |read: &mut ReadProgram| read.run(station).await;
    let progress = |read: &ReadProgram, error: &ProgramError| {
        error.call_error().filter(|error| is_line_failure(error)).map(|_| read.pages_done())
    };
    let note = |read: &ReadProgram, error: &ProgramError| format!("{error}; {} pages read", read.pages_done());
    retry(read, Direction::Read, display, run, progress, note).await
}

/// Loads and checks the file before the first request.
pub(crate) async fn write(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &ProgramWriteArgs,
    output: &Output,
) -> Result<(), Failure> {
    let program = load(&args.file)?;
    let station = connect::station(plc, timeout)?;
    if args.consent.dry_run {
        return dry_run(&station, &program, args, output).await;
    }
    can_be_confirmed(args.consent.yes)?;
    confirm(&question(plc, &program, args), args.consent.yes)?;
    let stopped = signal::stopped().map_err(Failure::Runtime)?;
    let reporter = Reporter::new(output);
    let mut write = WriteProgram::new(&program, options(args)).on_progress(reporter.callback());
    let ended = tokio::select! {
        biased;
        _ = stopped => None,
        ended = write_with_retries(&mut write, &station, (&reporter, output)) => Some(ended),
    };
    reporter.end_line();
    let Some(report) = ended.transpose()? else {
        return Err(Failure::WriteInterrupted(Box::new(write.state())));
    };
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
    Ok(())
}

/// Downloads the program. Resumes after a line failure, while less is left each time.
async fn write_with_retries(
    write: &mut WriteProgram,
    station: &Station,
    display: (&Reporter, &Output),
) -> Result<WriteReport, WriteProgramError> {
    let run = async |write: &mut WriteProgram| write.run(station).await;
    let progress = |_: &WriteProgram, error: &WriteProgramError| {
        let state = &error.state;
        let repeats = error.source.call_error().is_some_and(is_line_failure);
        write_progress(state.written.len(), state.left()).filter(|_| repeats)
    };
    let note = |_: &WriteProgram, error: &WriteProgramError| error.to_string();
    retry(write, Direction::Write, display, run, progress, note).await
}

/// Makes the checks of a download and prints the pages that it would write.
async fn dry_run(
    station: &Station,
    program: &Program,
    args: &ProgramWriteArgs,
    output: &Output,
) -> Result<(), Failure> {
    let reporter = Reporter::new(output);
    let mut write = WriteProgram::new(program, options(args)).on_progress(reporter.callback());
    let pages = write.dry_run(station).await;
    reporter.end_line();
    let pages = pages?;
    print_pages(&pages, output)?;
    let stopped = match (args.run, write.state().plc) {
        _ if pages.is_empty() => "",
        (true, PlcState::Running) => "; the PLC runs, and would be stopped and started again",
        (false, PlcState::Running) => "; the PLC runs, and would be stopped",
        _ => "; the PLC is stopped, and would stay stopped",
    };
    output.remark(format_args!("{} of {} pages would be written{stopped}", pages.len(), program.pages().len()));
    Ok(())
}

pub(crate) async fn verify(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &ProgramVerifyArgs,
    output: &Output,
) -> Result<(), Failure> {
    let program = load(&args.file)?;
    let pages = differing(&connect::station(plc, timeout)?, &program, output).await?;
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
        let object = fields.into_iter().map(|(name, cell)| (name.to_owned(), cell.json)).collect::<Map<_, _>>();
        return output.json(&Value::Object(object));
    }
    let mut rows = Rows::new(["field", "value"]);
    fields.into_iter().for_each(|(name, cell)| rows.push([name.into(), cell]));
    output.rows(&rows)
}

fn fields(program: &Program) -> Vec<(&'static str, Cell)> {
    let header = program.header();
    let unknown = || Cell { text: "unknown".to_owned(), json: Value::Null };
    let known = |text: Option<String>| text.map_or_else(unknown, Cell::from);
    let status = program.status();
    let version = status.map(|status| {
        let (major, minor) = status.os_version();
        format!("{major}.{minor}")
    });
    vec![
        ("kind", header.kind().to_string().into()),
        ("digits", header.digits().into_iter().collect::<String>().into()),
        ("ladder_words", u32::from(header.ladder_words()).into()),
        ("pages", u32::from(header.page_count()).into()),
        ("read_at", known(program.read_at().map(utc))),
        ("program_capacity", known(program.brief_status().map(|status| status.capacity().to_string()))),
        ("main_unit", known(status.map(|status| status.main_unit().to_string()))),
        ("os_version", known(version)),
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

async fn differing(station: &Station, program: &Program, output: &Output) -> Result<Vec<u16>, Failure> {
    let reporter = Reporter::new(output);
    let mut compare = WriteProgram::new(program, WriteOptions::new()).on_progress(reporter.callback());
    let result = compare.compare(station).await;
    reporter.end_line();
    Ok(result.map_err(|error| *error.source)?)
}

fn print_pages(pages: &[u16], output: &Output) -> Result<(), Failure> {
    let mut rows = Rows::new(["page"]);
    pages.iter().for_each(|&page| rows.push([u32::from(page).into()]));
    output.rows(&rows)
}

fn options(args: &ProgramWriteArgs) -> WriteOptions {
    let choose =
        |chosen, choice: fn(WriteOptions) -> WriteOptions, options| if chosen { choice(options) } else { options };
    let mut options = WriteOptions::new();
    options = choose(args.stop, WriteOptions::stop_first, options);
    options = choose(args.run, WriteOptions::run_again, options);
    options = choose(args.all, WriteOptions::all_pages, options);
    options = choose(args.verify, WriteOptions::verify_all, options);
    args.page_timeout.map_or(options, |timeout| options.page_timeout(timeout))
}

fn question(plc: &Plc, program: &Program, args: &ProgramWriteArgs) -> String {
    let stopped = match (args.stop, args.run) {
        (true, true) => " The PLC is stopped first and started again afterwards.",
        (true, false) => " The PLC is stopped first and stays stopped.",
        (false, _) => "",
    };
    let (file, header) = (args.file.file.display(), program.header());
    let (station, link) = (plc.station.as_deref().unwrap_or_default(), plc.link.as_deref().unwrap_or_default());
    format!("Write {file} ({header}) to station {station} on {link}?{stopped}")
}
