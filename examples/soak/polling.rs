//! Poller that runs beside the callers. It reads the cells they write, and its samples are checked.

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
use crate::counters::count;
use crate::layout::{self, DWORDS, Kind, Place};
use crate::line::{self, Line};
use crate::rng::Rng;

/// Polls all lines until `stop`.
pub(crate) async fn run(lines: Vec<Arc<Line>>, mut rng: Rng, stop: CancellationToken) -> Result<()> {
    let poller = Poller::builder().seed(rng.next_u64()).build();
    let handle = poller.handle();
    let consumer: JoinHandle<Result<()>> = tokio::spawn(consume(poller, lines.clone()));
    let mut polled = Vec::new();
    for line in &lines {
        for n in 0..line.stations.len() {
            polled.push((line.clone(), n, start(&handle, line, n)?));
        }
    }
    // Stations are removed and added again at random.
    loop {
        tokio::select! {
            () = stop.cancelled() => break,
            () = sleep(rng.millis(500, 3_000)) => {}
        }
        let which = rng.below(polled.len());
        let (line, n, old) = &mut polled[which];
        old.stop();
        *old = start(&handle, line, *n)?;
    }
    handle.close().await;
    consumer.await?
}

const POLL_INTERVAL: Duration = Duration::from_secs(2);

/// Number of polled constants.
const CONSTANTS: u16 = 16;

fn start(poller: &PollerHandle, line: &Line, n: usize) -> Result<PolledStation> {
    let options = CallOptions::new().with_response_timeout(line::RESPONSE_TIMEOUT).with_call_timeout(POLL_INTERVAL);
    let station = line.link.station(line.stations[n])?.with_options(options);
    let polled = poller.station(&station)?;
    let dwords = usize::from(DWORDS) * line.callers;
    let tags = [
        (CONSTANTS_NAME, Tag::new(Register::r(0), TagType::U16, CONSTANTS.into())?),
        (DWORDS_NAME, Tag::new(layout::dword(0, 0)?, TagType::U32, dwords)?),
    ];
    let name = |part| format!("{}/{n}/{part}", line.number);
    polled.add(ScanClass::every(POLL_INTERVAL), tags.map(|(part, tag)| PollTag::new(name(part), tag)))?;
    Ok(polled)
}

const CONSTANTS_NAME: &str = "constants";
const DWORDS_NAME: &str = "dwords";

async fn consume(mut poller: Poller, lines: Vec<Arc<Line>>) -> Result<()> {
    while let Some(sample) = poller.next().await {
        match sample {
            Ok(sample) => check_sample(&sample, &lines)?,
            Err(missed @ Missed { .. }) => return Err(missed.to_string().into()),
        }
    }
    Ok(())
}

/// Longest time from request to reply. Larger than the timeout, for a busy machine.
const MAX_ROUND_TRIP: Duration = Duration::from_secs(10);

fn check_sample(sample: &Sample, lines: &[Arc<Line>]) -> Result<()> {
    let mut name = sample.name.split('/');
    let mut next = || name.next().ok_or("bad name of a tag");
    let (line, n, part) = (&lines[next()?.parse::<usize>()?], next()?.parse::<usize>()?, next()?);
    if !matches!(sample.quality, Quality::Good) {
        count(&line.counters.not_good, 1);
        return Ok(());
    }
    count(&line.counters.samples, 1);
    count(&line.counters.values, sample.values().len());
    if part == CONSTANTS_NAME {
        let right = (0..CONSTANTS).map(|address| TagValue::U16(layout::constant(line.number, n, address)));
        if !sample.values().iter().cloned().eq(right) {
            line.wrong(n, &format!("sample with wrong constants {:?}", sample.values()));
        }
        return Ok(());
    }
    let began = sample.at.instant.checked_sub(MAX_ROUND_TRIP).unwrap_or(sample.at.instant);
    for (i, value) in sample.values().iter().enumerate() {
        let TagValue::U32(value) = *value else { return Err("sample of another type".into()) };
        let per_owner = usize::from(DWORDS);
        let place = Place { station: n, owner: i / per_owner, kind: Kind::DWord((i % per_owner) as u16) };
        let checked = line.expected().check(place, value, began);
        if let Err(error) = checked {
            line.wrong(n, &format!("sample: {error}"));
        }
    }
    Ok(())
}
