//! `fatek watch --plot TAG`: a chart of a tag on the whole terminal.
//!
//! `series` has the points and scales, without I/O and clocks; `view` draws them. This file polls.

mod series;
mod view;

use std::time::Duration;

use fatek::poll::{PollTag, Poller, ScanClass, StationPolling};
use fatek::tag::{Tag, TagType};
use futures::StreamExt;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

use self::series::{Plot, Series};
use crate::args::WatchArgs;
use crate::failure::Failure;
use crate::names::NamedTag;
use crate::output::Output;
use crate::screen::{self, Input, Key, Screen};
use crate::signal::Stop;
use crate::targets::Target;
use crate::top::theme::Theme;

/// Curves in one chart.
const MAX_SERIES: usize = 6;
/// Shortest time between two frames.
const FRAME: Duration = Duration::from_millis(100);

/// Draws a tag until q, a signal, or the end of `--for`. With several PLCs, each has a curve.
pub(crate) async fn plot(targets: &[Target], text: &str, args: &WatchArgs, output: &Output) -> Result<(), Failure> {
    screen::can_be_drawn("watch --plot", "without --plot it prints lines", output)?;
    let mut stop = Stop::new()?;
    let mut poller = Poller::new();
    let (mut series, mut ids) = (Vec::new(), Vec::new());
    for target in targets {
        let names = args.table.load(target.plc.as_ref())?;
        let named = names.tags(&[text.to_owned()])?;
        named.iter().try_for_each(|named| check(&named.tag))?;
        let limits = args.model.check(&target.station, named.iter().map(|named| named.tag)).await?;
        let polled = poller.handle().station_with(&target.station, StationPolling::new().limits(limits));
        let plc = if targets.len() > 1 { format!("{}/", target.label) } else { String::new() };
        let mut tags = Vec::new();
        for (label, single) in named.iter().flat_map(NamedTag::singles) {
            let unit = single.name().map_or("", |name| names.unit_and_comment(name).0);
            tags.push(PollTag::new(label.as_str(), single.tag));
            series.push(Series::new(&format!("{plc}{label}"), unit));
        }
        ids.extend(polled.map_err(Failure::usage)?.add(ScanClass::every(args.interval), tags).map_err(Failure::usage)?);
    }
    if series.len() > MAX_SERIES {
        return Err(Failure::Usage(format!("a plot has {MAX_SERIES} curves at most, not {}", series.len())));
    }
    let theme = Theme::new(screen::has_colours());
    let mut plot = Plot::new(text, series, args.interval, Instant::now());

    let mut screen = Screen::open()?;
    // The chart moves on while no value comes.
    let mut seconds = interval(Duration::from_secs(1));
    seconds.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let ends_at = args.duration.and_then(|duration| Instant::now().checked_add(duration));
    let mut last_frame = Instant::now();
    let mut due = Some(last_frame);
    loop {
        tokio::select! {
            biased;
            _ = stop.signalled() => return Ok(()),
            () = sleep_until(ends_at.unwrap_or(last_frame)), if ends_at.is_some() => return Ok(()),
            () = sleep_until(due.unwrap_or(last_frame)), if due.is_some() => {
                last_frame = Instant::now();
                due = None;
                plot.advance(last_frame);
                let is_ascii = screen.is_ascii();
                screen.draw(|frame| view::draw(&plot, theme, is_ascii, frame))?;
                continue;
            }
            input = screen.input() => match input?.0 {
                Input::Key(key) => match key {
                    Key::Char('q') | Key::Escape | Key::Control('c') => return Ok(()),
                    Key::Control('l') => screen.clear()?,
                    Key::Char('+' | '=') => plot.zoom(0.5),
                    Key::Char('-') => plot.zoom(2.0),
                    Key::Char(' ' | 'p') => plot.pause(),
                    Key::Char(_) | Key::Control(_) | Key::Enter | Key::Backspace | Key::Tab => {}
                    Key::Up | Key::Down | Key::PageUp | Key::PageDown | Key::Home | Key::End | Key::Other => {}
                },
                Input::Paste(_) | Input::Other => {}
            },
            Some(sample) = poller.next() => match sample {
                Ok(sample) => {
                    if let Some(number) = ids.iter().position(|id| *id == sample.id) {
                        let reason = sample.quality.reason().map(ToString::to_string);
                        plot.take(number, sample.at.instant, sample.value(), reason.as_deref());
                    }
                }
                Err(missed) => plot.miss(missed.count),
            },
            _ = seconds.tick() => {}
        }
        due = due.or(Some(last_frame + FRAME));
    }
}

/// Refuses a tag without numbers.
fn check(tag: &Tag) -> Result<(), Failure> {
    if tag.tag_type().is_number() || tag.tag_type() == TagType::Bool {
        return Ok(());
    }
    Err(Failure::Usage(format!("{tag} has no numbers to plot")))
}
