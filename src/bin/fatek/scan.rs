//! `fatek scan [FROM-TO]`
//!
//! Stations are asked for their status (40), because its reply cannot equal its request: on a line that echoes, each
//! loop-back would be answered.

use std::time::Duration;

use fatek::command::{BriefStatus, DetailedStatus};
use fatek::{CallOptions, Endpoint, Error, Link, LinkStats, Station};

use crate::args::ScanArgs;
use crate::connect;
use crate::failure::Failure;
use crate::output::{Output, Rows};
use crate::progress::Progress;

/// How long a station has for its answer, unless `--timeout` says otherwise.
const TIMEOUT: Duration = Duration::from_millis(200);
/// How long opening the connection may take, at the least; this is the link's default.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// How long a second station with the same number has for its own, once the first one has answered.
const SETTLE: Duration = Duration::from_millis(30);

pub(crate) async fn scan(
    endpoint: Endpoint,
    args: &ScanArgs,
    timeout: Option<Duration>,
    output: &Output,
) -> Result<(), Failure> {
    let response = timeout.unwrap_or(TIMEOUT);
    // Long enough for the connection and the slowest line, and for each attempt with a loop-back before it.
    let whole = Duration::from_secs(5).saturating_add(response.saturating_mul(2 * (args.retries + 1)));
    let options = CallOptions::new().response_timeout(response).retries(args.retries).call_timeout(whole);
    // A time that is short for a station is not meant for the connection.
    let link = connect::link(endpoint, options, timeout.filter(|timeout| *timeout > CONNECT_TIMEOUT));
    let mut found: Vec<Found> = Vec::new();
    let asked = ask_all(&link, args, output, &mut found).await;
    if asked.is_ok() {
        // Whoever answers late, or twice, does so now.
        tokio::time::sleep(response).await;
    }
    for number in args.stations.first..=args.stations.last {
        note_strays(&link.station(number).map_err(Failure::usage)?, &mut found);
    }
    print(&found, output)?;
    let asked = asked?;
    let (bad, answered) = (found.iter().filter(|found| found.answer.is_bad()).count(), found.len());
    output.remark(format_args!("{asked} asked, {answered} answered, {bad} of them badly"));
    match (answered, bad) {
        (0, _) => Err(Failure::Nobody { asked }),
        (_, 0) => Ok(()),
        (_, bad) => Err(Failure::BadStations { bad }),
    }
}

/// Asks one station after the other, and gives their number; an error that is not a station's own ends it.
async fn ask_all(link: &Link, args: &ScanArgs, output: &Output, found: &mut Vec<Found>) -> Result<usize, Failure> {
    let (first, last) = (args.stations.first, args.stations.last);
    let progress = Progress::new(output);
    for number in first..=last {
        progress.stand(format_args!("station {number} of {first} to {last}, {} found", found.len()));
        if let Some(one) = ask(link, &link.station(number).map_err(Failure::usage)?).await? {
            progress.event(format_args!("station {number}: {}", one.answer.as_str()));
            found.push(one);
        }
    }
    Ok(usize::from(last - first) + 1)
}

/// A station that has sent something.
#[derive(Debug)]
struct Found {
    station: u8,
    answer: Answer,
    brief: Option<BriefStatus>,
    detailed: Option<DetailedStatus>,
    time: Option<Duration>,
    notes: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answer {
    Ok,
    /// An error code.
    Refused,
    /// No good reply, or something besides.
    Bad,
    /// Something came when nobody waited for it.
    Late,
}

impl Answer {
    fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Refused => "refused",
            Self::Bad => "bad",
            Self::Late => "late",
        }
    }

    fn is_bad(self) -> bool {
        matches!(self, Self::Bad | Self::Late)
    }
}

/// What a station answers; nothing if it does not.
async fn ask(link: &Link, station: &Station) -> Result<Option<Found>, Failure> {
    let before = garbage(&link.stats());
    let (mut answer, mut notes) = (Answer::Ok, Vec::new());
    let brief = taken(station.read_status().await, &mut answer, &mut notes)?;
    let time = station.stats().round_trip.map(|times| times.last);
    if brief.is_some() {
        tokio::time::sleep(SETTLE).await;
    }
    let detailed = match brief {
        // Where everything is answered twice, no loop-back would be believed before the next request.
        Some(_) if unasked(station) > 0 => None,
        // Not every model has it, so a refusal says nothing.
        Some(_) => match station.read_detailed_status().await {
            Err(Error::Plc { .. }) => None,
            Err(error @ Error::Timeout { .. }) => {
                notes.push(error.to_string());
                None
            }
            detailed => taken(detailed, &mut answer, &mut notes)?,
        },
        None => None,
    };
    let garbage = garbage(&link.stats()) - before;
    if garbage > 0 {
        answer = Answer::Bad;
        notes.push(format!("{garbage} bytes of garbage"));
    }
    let silent = brief.is_none() && notes.is_empty();
    Ok((!silent).then(|| Found { station: station.number(), answer, brief, detailed, time, notes }))
}

/// A reply, or what is to be said of the station that gave none; silence says nothing unless it has answered before.
fn taken<T>(reply: Result<T, Error>, answer: &mut Answer, notes: &mut Vec<String>) -> Result<Option<T>, Failure> {
    match reply {
        Ok(reply) => return Ok(Some(reply)),
        Err(Error::Plc { code, error, .. }) => {
            *answer = Answer::Refused;
            notes.push(format!("{code}: {error}"));
        }
        Err(Error::BadReply { code, reason, .. }) => {
            *answer = Answer::Bad;
            notes.push(format!("{code}: {reason}"));
        }
        Err(Error::Timeout { .. }) => {}
        // It is not this station that is at fault.
        Err(error) => return Err(error.into()),
    }
    Ok(None)
}

/// Bytes that were no part of a frame, or that nobody read.
fn garbage(stats: &LinkStats) -> u64 {
    stats.garbage_bytes + stats.stale_bytes
}

/// Good frames of a station that were no reply to what was asked then.
fn unasked(station: &Station) -> u64 {
    let stats = station.stats();
    stats.stray_frames + stats.duplicates + stats.late_replies
}

/// Notes frames that were not asked for: late ones, or those of a second station with that number.
fn note_strays(station: &Station, found: &mut Vec<Found>) {
    let strays = unasked(station);
    if strays == 0 {
        return;
    }
    let number = station.number();
    match found.iter_mut().find(|found| found.station == number) {
        Some(found) => {
            found.answer = Answer::Bad;
            found.notes.push(format!("{strays} frames more than asked for: another station with this number?"));
        }
        None => {
            let notes = vec![format!("{strays} frames when nobody waited for them: a longer --timeout may help")];
            let late = Found { station: number, answer: Answer::Late, brief: None, detailed: None, time: None, notes };
            let at = found.partition_point(|found| found.station < number);
            found.insert(at, late);
        }
    }
}

fn print(found: &[Found], output: &Output) -> Result<(), Failure> {
    let mut rows = Rows::new(["station", "answer", "running", "main_unit", "os_version", "time_ms", "note"]);
    for found in found {
        let detailed = found.detailed.as_ref();
        rows.push([
            u32::from(found.station).into(),
            found.answer.as_str().into(),
            found.brief.map(|status| status.flags().running()).into(),
            detailed.map(|status| status.main_unit().to_string()).into(),
            detailed.map(|status| status.os_version()).map(|(major, minor)| format!("{major}.{minor}")).into(),
            found.time.into(),
            (!found.notes.is_empty()).then(|| found.notes.join("; ")).into(),
        ]);
    }
    output.rows(&rows)
}
