//! The poller that runs beside the callers: it reads what they write, and its samples are compared, too.

use std::sync::Arc;
use std::time::Duration;

use fatek::poll::{Missed, PollTag, PolledStation, Poller, PollerHandle, Quality, Sample, ScanClass};
use fatek::tag::{Tag, TagType, TagValue};
use fatek::{CallOptions, Register};
use futures::StreamExt;
use tokio::task::JoinHandle;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use crate::Result;
use crate::dice::Dice;
use crate::layout::{self, DOUBLES, Kind, Place};
use crate::line::{self, Line};
use crate::tally::count;

/// Polls all lines until it is stopped.
pub(crate) async fn run(lines: Vec<Arc<Line>>, mut dice: Dice, stop: CancellationToken) -> Result<()> {
    let poller = Poller::builder().seed(dice.roll()).build();
    let handle = poller.handle();
    let consumer: JoinHandle<Result<()>> = tokio::spawn(consume(poller, lines.clone()));
    let mut polled = Vec::new();
    for line in &lines {
        for n in 0..line.stations.len() {
            polled.push((line.clone(), n, begin(&handle, line, n)?));
        }
    }
    // Stations come and go.
    loop {
        tokio::select! {
            () = stop.cancelled() => break,
            () = sleep(dice.millis(500, 3_000)) => {}
        }
        let which = dice.below(polled.len());
        let (line, n, old) = &mut polled[which];
        old.stop();
        *old = begin(&handle, line, *n)?;
    }
    handle.close().await;
    consumer.await?
}

const PERIOD: Duration = Duration::from_secs(2);

/// How many constants are polled.
const CONSTANTS: u16 = 16;

fn begin(poller: &PollerHandle, line: &Line, n: usize) -> Result<PolledStation> {
    let options = CallOptions::new().response_timeout(line::RESPONSE_TIMEOUT).call_timeout(PERIOD);
    let station = line.link.station(line.stations[n])?.with_options(options);
    let polled = poller.station(&station)?;
    let doubles = usize::from(DOUBLES) * line.callers;
    let tags = [
        (CONSTANTS_NAME, Tag::new(Register::r(0), TagType::U16, CONSTANTS.into())?),
        (DOUBLES_NAME, Tag::new(layout::double(0, 0)?, TagType::U32, doubles)?),
    ];
    let name = |what| format!("{}/{n}/{what}", line.number);
    polled.add(ScanClass::every(PERIOD), tags.map(|(what, tag)| PollTag::new(name(what), tag)))?;
    Ok(polled)
}

const CONSTANTS_NAME: &str = "constants";
const DOUBLES_NAME: &str = "doubles";

async fn consume(mut poller: Poller, lines: Vec<Arc<Line>>) -> Result<()> {
    while let Some(sample) = poller.next().await {
        match sample {
            Ok(sample) => look(&sample, &lines)?,
            Err(missed @ Missed { .. }) => return Err(missed.to_string().into()),
        }
    }
    Ok(())
}

/// How long before its reply came a request may have been sent. Its timeout is far shorter, but counts from when the
/// machine found the time.
const MOST: Duration = Duration::from_secs(10);

fn look(sample: &Sample, lines: &[Arc<Line>]) -> Result<()> {
    let mut name = sample.name.split('/');
    let mut next = || name.next().ok_or("a name has three parts");
    let (line, n, what) = (&lines[next()?.parse::<usize>()?], next()?.parse::<usize>()?, next()?);
    if !matches!(sample.quality, Quality::Good) {
        count(&line.tally.not_good, 1);
        return Ok(());
    }
    count(&line.tally.samples, 1);
    count(&line.tally.values, sample.values().len());
    if what == CONSTANTS_NAME {
        let right = (0..CONSTANTS).map(|address| TagValue::U16(layout::constant(line.number, n, address)));
        if !sample.values().iter().cloned().eq(right) {
            line.wrong(n, &format!("a sample of constants cannot be {:?}", sample.values()));
        }
        return Ok(());
    }
    let began = sample.at.instant.checked_sub(MOST).unwrap_or(sample.at.instant);
    for (i, value) in sample.values().iter().enumerate() {
        let TagValue::U32(value) = *value else { return Err("the tag is of another type".into()) };
        let per_owner = usize::from(DOUBLES);
        let place = Place { station: n, owner: i / per_owner, kind: Kind::Double((i % per_owner) as u16) };
        let checked = line.shadow().check(place, value, began);
        if let Err(wrong) = checked {
            line.wrong(n, &format!("a sample: {wrong}"));
        }
    }
    Ok(())
}
