//! `fatek program read|write|verify|info FILE`

use std::time::Duration;

use fatek::file::utc;
use fatek::program::{Program, ProgramError, ReadProgram, WriteOptions, WriteProgram};
use fatek::{Error, Station};
use serde_json::{Map, Value};

use crate::args::{Plc, ProgramFile, ProgramReadArgs, ProgramVerifyArgs, ProgramWriteArgs};
use crate::confirm::{can_be_confirmed, confirm};
use crate::connect;
use crate::failure::Failure;
use crate::output::{Cell, Format, Output, Rows};
use crate::transfer::{GoingOn, Reporter};

pub(crate) async fn read(station: &Station, args: &ProgramReadArgs, output: &Output) -> Result<(), Failure> {
    let reporter = Reporter::new(output);
    let mut read = ReadProgram::new().on_progress(reporter.callback());
    if args.twice {
        read = read.twice();
    }
    let mut before = 0;
    let result = loop {
        let result = read.run(station).await;
        reporter.end_line();
        match result {
            Err(error) if may_go_on(&error) && read.pages_done() > before => {
                before = read.pages_done();
                output.remark(format_args!("{error}; {before} pages are there, going on"));
            }
            result => break result,
        }
    };
    let program = result?;
    let path = &args.file.file;
    if args.file.raw { program.save_raw(path) } else { program.save(path) }?;
    output.remark(format_args!("{}: {}, {} pages", path.display(), program.header(), program.pages().len()));
    Ok(())
}

/// The file is looked at before the station: nothing is sent for one that is no good.
pub(crate) async fn write(
    plc: &Plc,
    timeout: Option<Duration>,
    args: &ProgramWriteArgs,
    output: &Output,
) -> Result<(), Failure> {
    let program = load(&args.file)?;
    let station = connect::station(plc, timeout)?;
    if args.consent.dry_run {
        let pages = differing(&station, &program, output).await?;
        print_pages(&pages, output)?;
        output.remark(format_args!("{} of {} pages would be written", pages.len(), program.pages().len()));
        return Ok(());
    }
    can_be_confirmed(args.consent.yes)?;
    confirm(&question(plc, &program, args), args.consent.yes)?;
    let reporter = Reporter::new(output);
    let mut write = WriteProgram::new(&program, options(args)).on_progress(reporter.callback());
    let mut going_on = GoingOn::new();
    let report = loop {
        let result = write.run(&station).await;
        reporter.end_line();
        match result {
            Ok(report) => break report,
            Err(error)
                if may_go_on(&error.source) && !error.written.is_empty() && going_on.may(error.unwritten.len()) =>
            {
                output.remark(format_args!("{error}; going on"));
                GoingOn::pause().await;
            }
            Err(error) => return Err(error.into()),
        }
    };
    let state = match (report.was_stopped, report.running) {
        (_, true) => "the PLC runs",
        (true, false) => "the PLC ran before and is stopped now",
        (false, false) => "the PLC is stopped",
    };
    output.remark(format_args!("{} of {} pages written and compared; {state}", report.written.len(), report.pages));
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
        output.remark(format_args!("the PLC holds this program: all {} pages are the same", program.pages().len()));
        Ok(())
    } else {
        Err(Failure::Differs { what: "pages", differing: pages.len(), all: program.pages().len() })
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
    let unknown = || Cell { text: "not known".to_owned(), json: Value::Null };
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
        ("status", known(status.map(|status| status.raw().iter().map(|byte| format!("{byte:02X}")).collect()))),
    ]
}

fn load(file: &ProgramFile) -> Result<Program, Failure> {
    Ok(if file.raw { Program::load_raw(&file.file) } else { Program::load(&file.file) }?)
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
        (true, true) => " It is stopped for that, and runs again afterwards.",
        (true, false) => " It is stopped for that, and stays so.",
        (false, _) => "",
    };
    let (file, header) = (args.file.file.display(), program.header());
    let (station, link) = (plc.station.as_deref().unwrap_or_default(), plc.link.as_deref().unwrap_or_default());
    format!("Write {file} ({header}) to station {station} on {link}?{stopped}")
}

/// Whether it was the line that failed, and not the PLC that refused.
fn may_go_on(error: &ProgramError) -> bool {
    matches!(
        error.call_error(),
        Some(Error::Timeout { .. } | Error::BadReply { .. } | Error::Disconnected { .. } | Error::Connect { .. })
    )
}
