//! Subcommand `fatek watch TAG…`.

mod lines;
mod log;
mod printer;
mod time_format;
mod wide;

use std::collections::HashMap;
use std::pin::pin;
use std::time::Duration;

use fatek::element::{Element, Width};
use fatek::poll::{Missed, PollTag, PolledStation, Poller, Sample, ScanClass, StationPolling, TagId};
use fatek::tag::Tag;
use futures::{FutureExt, StreamExt};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

use self::printer::{Place, Printer};
use crate::args::WatchArgs;
use crate::failure::Failure;
use crate::names::NamedTag;
use crate::output::{Output, complain, counted, stdout_closed};
use crate::plot;
use crate::signal::Stop;
use crate::targets::Target;

pub(crate) async fn watch(targets: &[Target], args: &WatchArgs, output: &Output) -> Result<(), Failure> {
    if let Some(tag) = &args.plot {
        return plot::plot(targets, tag, args, output).await;
    }
    let mut stop = Stop::new()?;
    let mut closed = pin!(stdout_closed());
    let mut poller = Poller::new();
    let polled = add(targets, args, &poller).await?;
    let mut printer = Printer::new(&polled.places, targets, args, output)?;
    printer.header()?;
    let ends_at = args.duration.and_then(|duration| Instant::now().checked_add(duration));
    let mut ended = pin!(async {
        match ends_at {
            Some(at) => sleep_until(at).await,
            None => std::future::pending().await,
        }
    });
    // Readings without a line to print are noticed by time.
    let mut check = interval(args.interval.clamp(MIN_CHECK, MAX_CHECK));
    check.set_missed_tick_behavior(MissedTickBehavior::Delay);
    while !polled.is_done(args.count) {
        tokio::select! {
            biased;
            _ = stop.signalled() => break,
            // Noticed without a line to print: there may be none for a long time.
            closed = &mut closed => return Err(Failure::Output(closed)),
            () = &mut ended => break,
            sample = poller.next() => match sample {
                Some(sample) => {
                    take(sample, args, &mut printer)?;
                    // The number of readings is compared once for the samples that are there.
                    for _ in 1..MAX_SAMPLES {
                        let Some(Some(sample)) = poller.next().now_or_never() else { break };
                        take(sample, args, &mut printer)?;
                    }
                }
                None => break,
            },
            _ = check.tick(), if args.count.is_some() => {}
        }
    }
    // The samples of the last readings.
    while let Some(Some(sample)) = poller.next().now_or_never() {
        take(sample, args, &mut printer)?;
    }
    printer.finish(&polled.ended())?;
    let stats = poller.handle().stats();
    let (cycles, lines) = (counted(stats.cycles, "poll cycle"), counted(printer.count(), "line"));
    output.remark(format_args!("{cycles}, {} skipped, {} without a reply; {lines}", stats.overruns, stats.abandoned));
    Ok(())
}

/// Age of a value without a reply and without a failure.
const STALE_AFTER: Duration = Duration::from_secs(30);
const BAD_AFTER: Duration = Duration::from_secs(120);
/// Samples that are taken together.
const MAX_SAMPLES: usize = 1024;
const MIN_CHECK: Duration = Duration::from_millis(10);
const MAX_CHECK: Duration = Duration::from_millis(100);

/// The stations that are polled, and the place of each tag.
#[derive(Debug, Default)]
struct Polled {
    stations: Vec<PolledStation>,
    places: HashMap<TagId, Place>,
}

impl Polled {
    /// Returns whether each PLC was read this often; the samples are in the queue then.
    fn is_done(&self, count: Option<u64>) -> bool {
        let is_done = |station: &PolledStation, count| station.classes().iter().all(|class| class.completed >= count);
        count.is_some_and(|count| self.stations.iter().all(|station| is_done(station, count)))
    }

    /// The readings of each PLC that have ended.
    fn ended(&self) -> Vec<u64> {
        let ended = |station: &PolledStation| station.classes().iter().map(|class| class.completed).min().unwrap_or(0);
        self.stations.iter().map(ended).collect()
    }
}

/// Adds the tags of all targets to the poller.
async fn add(targets: &[Target], args: &WatchArgs, poller: &Poller) -> Result<Polled, Failure> {
    let mut polled = Polled::default();
    for (plc, target) in targets.iter().enumerate() {
        let named = args.table.load(target.plc.as_ref())?.tags(&args.tags)?;
        let limits = args.model.check(&target.station, named.iter().map(|named| named.tag)).await?;
        let polling = StationPolling::new().limits(limits);
        let station = poller.handle().station_with(&target.station, polling).map_err(Failure::usage)?;
        // One tag per value, so that each change is reported alone.
        let singles = named.iter().flat_map(NamedTag::singles);
        let tags: Vec<(String, Tag)> = singles.map(|(label, single)| (label, single.tag)).collect();
        // Of several PLCs, each has its name.
        let full = |label: &str| match targets {
            [_] => label.to_owned(),
            _ => format!("{}/{label}", target.label),
        };
        // A reading that takes longer than its interval must not make the values stale.
        let class = ScanClass::every(args.interval)
            .stale_after(STALE_AFTER.max(args.interval * 3))
            .bad_after(BAD_AFTER.max(args.interval * 10));
        let ids = station.add(class, tags.iter().map(|(label, tag)| poll_tag(&full(label), *tag, args)));
        let places = tags.iter().map(|(label, tag)| Place { plc, label: label.clone(), bits: bits(*tag) });
        polled.places.extend(ids.map_err(Failure::usage)?.into_iter().zip(places));
        polled.stations.push(station);
    }
    Ok(polled)
}

/// Bits of the elements of a tag.
fn bits(tag: Tag) -> usize {
    let of_element = |element: Element| match element.width() {
        Width::Bit => 1,
        Width::Word => 16,
        Width::DWord => 32,
    };
    tag.elements().map(of_element).sum()
}

fn poll_tag(label: &str, tag: Tag, args: &WatchArgs) -> PollTag {
    let polled = PollTag::new(label, tag);
    match args.deadband {
        // Only numbers have a deadband.
        Some(deadband) if tag.tag_type().is_number() => polled.deadband(deadband),
        Some(_) => polled.on_change(true),
        // A line with all values needs all values: it is compared as a whole.
        None => polled.on_change(args.on_change && !args.wide),
    }
}

/// Prints a sample, unless it is of a reading after the last one.
fn take(sample: Result<Sample, Missed>, args: &WatchArgs, printer: &mut Printer<'_>) -> Result<(), Failure> {
    match sample {
        Ok(sample) if args.count.is_none_or(|count| sample.cycle <= count) => printer.sample(sample),
        Ok(_) => Ok(()),
        Err(missed @ Missed { .. }) => {
            complain(format_args!("{missed}"));
            Ok(())
        }
    }
}
