//! Subcommand `fatek top [TAG…]`: a dashboard on the terminal.
//!
//! - `model`, `update`: the state, and events for it. Without I/O and clocks.
//! - `order`, `list`, `history`, `dialog`, `layout`: parts of the state.
//! - `view`, `theme`: drawing.
//! - `feed`: events from the library. This file: the loop that joins them.

mod dialog;
mod feed;
pub(crate) mod history;
mod layout;
mod list;
mod model;
mod order;
#[cfg(test)]
mod tests;
pub(crate) mod theme;
mod update;
pub(crate) mod view;

use std::collections::HashMap;
use std::time::Duration;

use fatek::poll::{Missed, PollTag, Poller, Sample, ScanClass, StationPolling, TagId};
use futures::{FutureExt, StreamExt};
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

use self::model::{Effect, Event, Model, PlcInfo, Settings, TagInfo};
use self::theme::Theme;
use crate::args::TopArgs;
use crate::failure::Failure;
use crate::names::NamedTag;
use crate::output::{Output, complain};
use crate::screen::{self, Input, Screen};
use crate::signal::Stop;
use crate::targets::Target;

/// Shortest time between two frames for new values.
const FRAME: Duration = Duration::from_millis(100);
/// Shortest time between two frames for keys.
const KEY_FRAME: Duration = Duration::from_millis(25);
/// Shortest interval for the status of PLCs whose tags are polled.
const STATUS_INTERVAL: Duration = Duration::from_secs(5);
/// Events that wait for the display.
const QUEUED_EVENTS: usize = 64;
/// Samples that are taken together.
const MAX_SAMPLES: usize = 1024;

pub(crate) async fn top(targets: &[Target], args: &TopArgs, output: &Output) -> Result<(), Failure> {
    screen::can_be_drawn("top", "`read` and `watch` print values", output)?;
    let stop = Stop::new()?;
    let poller = Poller::new();
    let (plcs, tags, tags_by_id) = polled(targets, args, &poller).await?;
    let (sender, events) = mpsc::channel(QUEUED_EVENTS);
    for (plc, target) in targets.iter().enumerate() {
        let every = if tags.is_empty() { args.interval } else { args.interval.max(STATUS_INTERVAL) };
        tokio::spawn(feed::poll_status(plc, target.station.clone(), every, sender.clone()));
    }
    let settings = Settings { interval: args.interval, special: args.special, read_only: args.read_only };
    let mut model = Model::new(settings, plcs, tags, Instant::now());
    let theme = Theme::new(screen::has_colours());
    let mut sources = Sources { stop, poller, tags_by_id, sender, events };

    let mut screen = Screen::open()?;
    let ended = run(&mut model, targets, &mut sources, theme, &mut screen).await;
    drop(screen);
    // Also after an error.
    model.unseen().for_each(|text| complain(format_args!("{text}")));
    ended
}

/// Sources of events, other than the terminal.
struct Sources {
    stop: Stop,
    poller: Poller,
    tags_by_id: HashMap<TagId, usize>,
    /// Senders and receiver of status and results of writes.
    sender: mpsc::Sender<Event>,
    events: mpsc::Receiver<Event>,
}

/// Takes events and draws frames until `q`, a signal or an error.
async fn run(
    model: &mut Model,
    targets: &[Target],
    sources: &mut Sources,
    theme: Theme,
    screen: &mut Screen,
) -> Result<(), Failure> {
    let Sources { stop, poller, tags_by_id, sender, events } = sources;
    // Ages grow while no value comes.
    let mut seconds = interval(Duration::from_secs(1));
    seconds.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut last_frame = Instant::now();
    // The next frame, if anything has changed.
    let mut due = Some(last_frame);
    loop {
        let effect = tokio::select! {
            biased;
            _ = stop.signalled() => return Ok(()),
            () = sleep_until(due.unwrap_or(last_frame)), if due.is_some() => {
                last_frame = Instant::now();
                due = None;
                draw(model, targets, theme, screen)?;
                None
            }
            input = screen.input() => {
                due = Some(last_frame + KEY_FRAME);
                match input? {
                    (Input::Key(key), at) => model.update(Event::Key(key, at)),
                    (Input::Paste(text), _) => model.update(Event::Paste(text)),
                    // The next frame has the size.
                    (Input::Other, _) => None,
                }
            }
            Some(event) = events.recv() => {
                due = due.or(Some(last_frame + FRAME));
                model.update(event)
            }
            Some(sample) = poller.next() => {
                due = due.or(Some(last_frame + FRAME));
                let more = std::iter::from_fn(|| poller.next().now_or_never().flatten());
                for sample in std::iter::once(sample).chain(more.take(MAX_SAMPLES)) {
                    take_sample(model, tags_by_id, sample);
                }
                None
            }
            _ = seconds.tick() => {
                due = due.or(Some(last_frame + FRAME));
                None
            }
        };
        match effect {
            None => {}
            Some(Effect::Quit) => return Ok(()),
            Some(Effect::Redraw) => screen.clear()?,
            Some(Effect::Write { plc, write }) => {
                let (station, sender) = (targets[plc].station.clone(), sender.clone());
                tokio::spawn(async move {
                    let written = write.send(&station).await.map_err(|failure| failure.to_string());
                    // An error: the receiver is closed.
                    let _ = sender.send(Event::Written(written)).await;
                });
            }
        }
    }
}

/// The PLCs and tags, which the poller polls from now on. Several values of a tag are a row each.
async fn polled(
    targets: &[Target],
    args: &TopArgs,
    poller: &Poller,
) -> Result<(Vec<PlcInfo>, Vec<TagInfo>, HashMap<TagId, usize>), Failure> {
    let (mut plcs, mut tags, mut tags_by_id) = (Vec::new(), Vec::<TagInfo>::new(), HashMap::new());
    for (plc, target) in targets.iter().enumerate() {
        let names = args.table.load(target.plc.as_ref())?;
        let named = if args.tags.is_empty() { names.all() } else { names.tags(&args.tags)? };
        let limits = args.model.check(&target.station, named.iter().map(|named| named.tag)).await?;
        let polled = poller.handle().station_with(&target.station, StationPolling::new().limits(limits));
        let polled = polled.map_err(Failure::usage)?;
        let address = format!("{} station {}", target.url, target.station.number());
        let info = PlcInfo::new(&target.label, &address, names);
        let rows =
            named.iter().flat_map(NamedTag::singles).map(|(label, single)| TagInfo::new(plc, &info, &label, single));
        let first = tags.len();
        tags.extend(rows);
        let poll_tags = tags[first..].iter().map(|row| PollTag::new(row.label.as_str(), row.named.tag));
        let ids = polled.add(ScanClass::every(args.interval), poll_tags).map_err(Failure::usage)?;
        tags_by_id.extend(ids.into_iter().zip(first..));
        plcs.push(info);
    }
    Ok((plcs, tags, tags_by_id))
}

fn take_sample(model: &mut Model, tags_by_id: &HashMap<TagId, usize>, sample: Result<Sample, Missed>) {
    match sample {
        Ok(sample) => {
            if let Some(&tag) = tags_by_id.get(&sample.id) {
                model.update(Event::Reading(feed::reading(tag, &sample)));
            }
        }
        Err(missed) => drop(model.update(Event::Missed(missed.count))),
    }
}

fn draw(model: &mut Model, targets: &[Target], theme: Theme, screen: &mut Screen) -> Result<(), Failure> {
    for (plc, target) in targets.iter().enumerate() {
        model.update(Event::Health { plc, health: feed::health(&target.station) });
    }
    model.update(Event::Resize(screen.resized()?));
    model.frame(Instant::now());
    screen.draw(|frame| view::draw(model, theme, frame))?;
    model.drawn(Instant::now());
    Ok(())
}
