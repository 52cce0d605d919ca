//! Subcommand `fatek watch TAG…`.

use std::pin::pin;
use std::time::SystemTime;

use fatek::poll::{Missed, PollTag, Poller, Sample, ScanClass, StationPolling};
use fatek::tag::Tag;
use futures::StreamExt;
use humantime::format_rfc3339_millis;

use crate::args::WatchArgs;
use crate::failure::Failure;
use crate::names::NamedTag;
use crate::output::{Cell, Format, Output, complain, print, stdout_closed};
use crate::signal::Stop;
use crate::targets::Target;

pub(crate) async fn watch(targets: &[Target], args: &WatchArgs, output: &Output) -> Result<(), Failure> {
    let mut stop = Stop::new()?;
    let mut closed = pin!(stdout_closed());
    let mut poller = Poller::new();
    let mut labels = Vec::new();
    for target in targets {
        let named = args.table.load(target.plc.as_ref())?.tags(&args.tags)?;
        let limits = args.model.check(&target.station, named.iter().map(|named| named.tag)).await?;
        let polling = StationPolling::new().limits(limits);
        let polled = poller.handle().station_with(&target.station, polling).map_err(Failure::usage)?;
        // One tag per value, so that each change is reported alone. Of several PLCs, each has its name.
        let plc = if targets.len() > 1 { format!("{}/", target.label) } else { String::new() };
        let labelled = |named: NamedTag| {
            let (singles, plc) = (named.tag.singles().enumerate(), plc.clone());
            singles.map(move |(number, tag)| (format!("{plc}{}", named.label(number, || tag.to_string())), tag))
        };
        let tags: Vec<(String, Tag)> = named.into_iter().flat_map(labelled).collect();
        let class = ScanClass::every(args.interval);
        polled.add(class, tags.iter().map(|(label, tag)| poll_tag(label, *tag, args))).map_err(Failure::usage)?;
        labels.extend(tags.into_iter().map(|(label, _)| label));
    }

    let printer = Printer::new(labels.iter().map(String::as_str), output);
    printer.header()?;
    let mut lines = 0_u64;
    while args.count.is_none_or(|count| lines < count) {
        let sample = tokio::select! {
            biased;
            _ = stop.signalled() => break,
            // Noticed without a line to print: there may be none for a long time.
            closed = &mut closed => return Err(Failure::Output(closed)),
            sample = poller.next() => sample,
        };
        match sample {
            Some(Ok(sample)) => {
                printer.sample(&sample)?;
                lines += 1;
            }
            Some(Err(missed @ Missed { .. })) => complain(format_args!("{missed}")),
            None => break,
        }
    }
    let stats = poller.handle().stats();
    output.remark(format_args!(
        "{} poll cycles, {} skipped, {} without a reply; {lines} lines",
        stats.cycles, stats.overruns, stats.abandoned
    ));
    Ok(())
}

fn poll_tag(label: &str, tag: Tag, args: &WatchArgs) -> PollTag {
    let polled = PollTag::new(label, tag);
    match args.deadband {
        // Only numbers have a deadband.
        Some(deadband) if tag.tag_type().is_number() => polled.deadband(deadband),
        Some(_) => polled.on_change(true),
        None => polled.on_change(args.on_change),
    }
}

/// Prints one line per sample.
struct Printer<'o> {
    output: &'o Output,
    /// Width of the tag column in characters.
    width: usize,
}

const COLUMNS: [&str; 4] = ["time", "tag", "value", "quality"];

impl<'o> Printer<'o> {
    fn new<'t>(labels: impl Iterator<Item = &'t str>, output: &'o Output) -> Self {
        Self { output, width: labels.map(str::len).max().unwrap_or(0).max(3) }
    }

    fn header(&self) -> Result<(), Failure> {
        let width = self.width;
        match self.output.format {
            Format::Table => print(format_args!("{:24}  {:width$}  VALUE", "TIME", "TAG")),
            Format::Json => Ok(()),
            Format::Csv => self.output.csv_line(COLUMNS),
        }
    }

    fn sample(&self, sample: &Sample) -> Result<(), Failure> {
        let width = self.width;
        let time = format_rfc3339_millis(sample.at.time.max(SystemTime::UNIX_EPOCH)).to_string();
        let value = Cell::from(sample.value().cloned());
        match self.output.format {
            Format::Table => {
                let value = match (sample.is_good(), value.text.is_empty()) {
                    (true, _) => value.text,
                    (false, true) => format!("({})", sample.quality),
                    (false, false) => format!("{} ({})", value.text, sample.quality),
                };
                print(format_args!("{time}  {:width$}  {value}", sample.name))
            }
            Format::Json => {
                let cells =
                    [time.into(), sample.name.to_string().into(), value.json, sample.quality.to_string().into()];
                self.output.json_line(&COLUMNS.into_iter().zip(cells).collect())
            }
            Format::Csv => self.output.csv_line([&time, &*sample.name, value.csv(), &sample.quality.to_string()]),
        }
    }
}
