//! The commands. The error of each is that of a write to stdout.

use std::io;
use std::process::ExitCode;

use fatek_bridge::check::{Report, Severity, TOKEN_RULE};
use fatek_bridge::config::{self, Config, Name};
use fatek_bridge::demo::{self, Demo, SILENT_PLC};
use fatek_bridge::fleet::FleetError;
use fatek_bridge::import::{self, Target};
use fatek_bridge::run::RunError;
use tokio::runtime::Runtime;

use super::args::{CheckArgs, DemoArgs, FileArgs, Format, ImportArgs};
use super::{STATUS_FAILED, STATUS_STORE, STATUS_USAGE, complain, print};
use crate::printable::excerpt;

pub(super) fn run(file: &FileArgs) -> io::Result<ExitCode> {
    let config = match Config::read(&file.config, &file.environment()) {
        Ok(config) => config,
        Err(error) => return Ok(complain(&error.to_string(), STATUS_USAGE)),
    };
    // A token that cannot be read is no reason to stop, since nothing uses it.
    if !matches!(config.bridge.token(), Ok(None)) {
        tracing::warn!("bridge.token_file: {TOKEN_RULE}");
    }
    let runtime = Runtime::new()?;
    let result = runtime.block_on(fatek_bridge::run::run(config));
    Ok(end(runtime, result))
}

/// Ends the runtime, and returns the status of the bridge.
fn end(runtime: Runtime, result: Result<(), RunError>) -> ExitCode {
    // Without a limit, a write to a pipe that is not read would hold up the end.
    runtime.shutdown_timeout(std::time::Duration::from_millis(100));
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => complain(&error.to_string(), status_of(&error)),
    }
}

fn status_of(error: &RunError) -> u8 {
    if matches!(error, RunError::Fleet(FleetError::Store(_))) { STATUS_STORE } else { STATUS_FAILED }
}

pub(super) fn check(args: &CheckArgs) -> io::Result<ExitCode> {
    let report = Report::of(&args.file.config, &args.file.environment(), args.round_trip);
    match args.format {
        Format::Table => print(&report.to_string())?,
        Format::Json => print(&format!("{:#}", report.to_json()))?,
    }
    let status = match (report.count(Severity::Fault), report.count(Severity::Warning)) {
        (1.., _) => STATUS_USAGE,
        (0, 1..) if args.strict => STATUS_FAILED,
        (0, _) => 0,
    };
    Ok(ExitCode::from(status))
}

pub(super) fn demo(args: &DemoArgs) -> io::Result<ExitCode> {
    if args.print_config {
        return print(demo::CONFIG).map(|()| ExitCode::SUCCESS);
    }
    let runtime = Runtime::new()?;
    let result = runtime.block_on(async {
        let demo = match Demo::start(args.http).await {
            Ok(demo) => demo,
            Err(error) => return Err(complain(&error.to_string(), STATUS_FAILED)),
        };
        let mut config = demo.config.clone();
        if args.quiet {
            config.stdout = None;
        }
        let names: Vec<&str> = config.plant.plcs().map(|plc| plc.name()).collect();
        eprintln!("Simulated PLCs: {} ({SILENT_PLC} falls silent from time to time)", names.join(", "));
        eprintln!("Page: http://{}", config.bridge.http);
        eprintln!("Ctrl-C ends the demo.");
        if let Some(duration) = args.duration {
            tokio::spawn(async move {
                tokio::time::sleep(duration).await;
                // Ends as the service manager ends it.
                let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::TERM);
            });
        }
        Ok(fatek_bridge::run::run(config).await)
    });
    match result {
        Ok(result) => Ok(end(runtime, result)),
        Err(status) => Ok(status),
    }
}

pub(super) fn print_config(file: &FileArgs) -> io::Result<ExitCode> {
    match config::print(&file.config, &file.environment()) {
        Ok(text) => print(&text).map(|()| ExitCode::SUCCESS),
        Err(error) => Ok(complain(&error.to_string(), STATUS_USAGE)),
    }
}

pub(super) fn import(args: &ImportArgs) -> io::Result<ExitCode> {
    let target = match target(args) {
        Ok(target) => target,
        Err(error) => return Ok(complain(&error, STATUS_USAGE)),
    };
    let imported = match import::import(&args.tables, &target, &args.classes) {
        Ok(imported) => imported,
        Err(error) => return Ok(complain(&error.to_string(), STATUS_USAGE)),
    };
    print(&imported.text)?;
    if !imported.assumed_classes.is_empty() {
        let (classes, period) = (imported.assumed_classes.join(", "), import::DEFAULT_PERIOD);
        eprintln!("note: every {period:?} for the classes {classes}: --class NAME=TIME sets another period");
    }
    Ok(ExitCode::SUCCESS)
}

/// The section that takes the tags. The error is the rule that the arguments break.
fn target(args: &ImportArgs) -> Result<Target, String> {
    if let Some(name) = args.template.clone() {
        return Ok(Target::Template { name });
    }
    let link = args.link.clone().ok_or("--link is missing")?;
    let of_table = || {
        let stem = args.tables.first().and_then(|table| table.file_stem()).unwrap_or_default().to_string_lossy();
        Name::parse(&stem).ok_or_else(|| format!("`{}` is no name of a PLC: give --plc", excerpt(&stem)))
    };
    let name = args.plc.clone().map_or_else(of_table, Ok)?;
    Ok(Target::Plc { name, link, station: args.station })
}

pub(super) fn schema() -> io::Result<ExitCode> {
    print(&format!("{:#}", config::schema())).map(|()| ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use fatek_bridge::fleet::StoreFault;

    use super::*;

    #[test]
    fn a_store_that_was_set_back_has_a_status_of_its_own() {
        let store = StoreFault::Recreated { before: 1, now: 2 };
        assert_eq!(status_of(&RunError::Fleet(store.into())), 3);
        assert_eq!(status_of(&RunError::Fleet(FleetError::NoStore("x".to_owned()))), 1);
        assert_eq!(status_of(&RunError::Panicked("x")), 1);
    }
}
