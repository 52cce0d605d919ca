//! Subcommand `fatek scan [FROM-TO]`: the stations of one line. Of networks: [`network`]; by a
//! broadcast: [`discover`].
//!
//! Reads the status (40) of each station. A loop-back would not do: on a line with echo, the echo
//! looks like its reply.

pub(crate) mod discover;
pub(crate) mod hosts;
pub(crate) mod network;
mod rate_limit;
mod trial;

use std::time::Duration;

use fatek::command::{BriefStatus, DetailedStatus};
use fatek::{CallOptions, Endpoint, Error, Link, LinkStats, Station};

use crate::args::ScanArgs;
use crate::connect;
use crate::failure::Failure;
use crate::output::{Output, Rows, version};
use crate::progress::StatusLine;
use crate::signal::unless_signalled;

/// Response timeout without `--timeout`.
pub(crate) const DEFAULT_TIMEOUT: Duration = Duration::from_millis(200);
/// Shortest connection timeout: the default of the link.
const MIN_CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// Wait after a reply for that of a second station with the same number.
const SECOND_REPLY: Duration = Duration::from_millis(30);

pub(crate) async fn scan(
    endpoint: Endpoint,
    args: &ScanArgs,
    timeout: Option<Duration>,
    output: &Output,
) -> Result<(), Failure> {
    let response = timeout.unwrap_or(DEFAULT_TIMEOUT);
    // 5 s for the connection on the slowest line; each attempt may have a loop-back before it.
    let (numbers, retries) = (args.numbers(1..=254)?, args.retries.unwrap_or(0));
    let call_timeout = Duration::from_secs(5).saturating_add(response.saturating_mul(2 * (retries + 1)));
    let options =
        CallOptions::new().with_response_timeout(response).with_retries(retries).with_call_timeout(call_timeout);
    // A short response timeout must not shorten the connection timeout.
    let link = connect::link(endpoint, options, timeout.filter(|timeout| *timeout > MIN_CONNECT_TIMEOUT));
    let mut found: Vec<Found> = Vec::new();
    let scanned = unless_signalled(scan_all(&link, &numbers, output, &mut found)).await?;
    let scanned = scanned.unwrap_or_else(|signal| Err(Failure::interrupted("")(signal)));
    if scanned.is_ok() {
        // For late and duplicate replies of the last stations.
        tokio::time::sleep(response).await;
    }
    for number in &numbers {
        note_strays(&link.station(*number).map_err(Failure::usage)?, &mut found);
    }
    print(&found, output)?;
    let scanned = scanned?;
    let (bad, answered) = (found.iter().filter(|found| found.verdict.is_bad()).count(), found.len());
    output.remark(format_args!("{scanned} stations scanned, {answered} answered, {bad} with bad replies"));
    match (answered, bad) {
        (0, _) => Err(Failure::NoStation { scanned }),
        (_, 0) => Ok(()),
        (_, bad) => Err(Failure::BadStations { bad }),
    }
}

/// Scans all stations in turn and returns their number. An error of the link ends the scan.
async fn scan_all(link: &Link, numbers: &[u8], output: &Output, found: &mut Vec<Found>) -> Result<usize, Failure> {
    let progress = StatusLine::new(output);
    let last = numbers.last().copied().unwrap_or_default();
    for &number in numbers {
        progress.show(format_args!("station {number} of {} to {last}, {} found", numbers[0], found.len()));
        if let Some(one) = scan_station(link, &link.station(number).map_err(Failure::usage)?).await? {
            progress.event(format_args!("station {number}: {}", one.verdict.as_str()));
            found.push(one);
        }
    }
    Ok(numbers.len())
}

/// Station that has sent at least one frame.
#[derive(Debug)]
struct Found {
    station: u8,
    verdict: Verdict,
    brief: Option<BriefStatus>,
    detailed: Option<DetailedStatus>,
    time: Option<Duration>,
    notes: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
/// Column `answer` of the output.
enum Verdict {
    Ok,
    /// Error code.
    Refused,
    /// No good reply, or unexpected frames or garbage.
    Bad,
    /// Frames after the timeout only.
    Late,
}

impl Verdict {
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

/// Scans one station. Returns `None` if it sends nothing.
async fn scan_station(link: &Link, station: &Station) -> Result<Option<Found>, Failure> {
    let before = garbage(&link.stats());
    let (mut verdict, mut notes) = (Verdict::Ok, Vec::new());
    let brief = reply_or_note(station.read_status().await, &mut verdict, &mut notes)?;
    let time = station.stats().round_trip.map(|times| times.last);
    if brief.is_some() {
        tokio::time::sleep(SECOND_REPLY).await;
    }
    let detailed = match brief {
        // With two stations of one number the check before the next request fails.
        Some(_) if unexpected_frames(station) > 0 => None,
        // Some models have no detailed status.
        Some(_) => match station.read_detailed_status().await {
            Err(Error::Plc { .. }) => None,
            Err(error @ Error::Timeout { .. }) => {
                notes.push(error.to_string());
                None
            }
            detailed => reply_or_note(detailed, &mut verdict, &mut notes)?,
        },
        None => None,
    };
    let garbage = garbage(&link.stats()) - before;
    if garbage > 0 {
        verdict = Verdict::Bad;
        notes.push(format!("garbage: {garbage} bytes"));
    }
    let silent = brief.is_none() && notes.is_empty();
    Ok((!silent).then(|| Found { station: station.number(), verdict, brief, detailed, time, notes }))
}

/// Returns the reply, or notes the reason why there is none. A timeout is not noted.
fn reply_or_note<T>(
    reply: Result<T, Error>,
    verdict: &mut Verdict,
    notes: &mut Vec<String>,
) -> Result<Option<T>, Failure> {
    match reply {
        Ok(reply) => return Ok(Some(reply)),
        Err(Error::Plc { code, error, .. }) => {
            *verdict = Verdict::Refused;
            notes.push(format!("{code}: {error}"));
        }
        Err(Error::BadReply { code, reason, .. }) => {
            *verdict = Verdict::Bad;
            notes.push(format!("{code}: {reason}"));
        }
        Err(Error::Timeout { .. }) => {}
        // Error of the link.
        Err(error) => return Err(error.into()),
    }
    Ok(None)
}

/// Bytes outside frames, and bytes left over from before.
fn garbage(stats: &LinkStats) -> u64 {
    stats.garbage_bytes + stats.stale_bytes
}

/// Good frames of a station that no request was waiting for.
fn unexpected_frames(station: &Station) -> u64 {
    let stats = station.stats();
    stats.stray_frames + stats.duplicates + stats.late_replies
}

/// Notes late frames, and those of a second station with the same number.
fn note_strays(station: &Station, found: &mut Vec<Found>) {
    let strays = unexpected_frames(station);
    if strays == 0 {
        return;
    }
    let number = station.number();
    match found.iter_mut().find(|found| found.station == number) {
        Some(found) => {
            found.verdict = Verdict::Bad;
            found.notes.push(format!("unexpected frames: {strays}; second station with this number?"));
        }
        None => {
            let notes = vec![format!("frames after the timeout: {strays}; increase --timeout")];
            let late =
                Found { station: number, verdict: Verdict::Late, brief: None, detailed: None, time: None, notes };
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
            found.station.into(),
            found.verdict.as_str().into(),
            found.brief.map(|status| status.flags().running()).into(),
            detailed.map(|status| status.main_unit().to_string()).into(),
            detailed.map(|status| version(status.os_version())).into(),
            found.time.into(),
            (!found.notes.is_empty()).then(|| found.notes.join("; ")).into(),
        ]);
    }
    output.rows(&rows)
}
