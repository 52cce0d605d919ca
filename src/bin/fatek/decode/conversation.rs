//! Output of conversations: a line per exchange, as soon as it is complete.

use std::collections::BTreeMap;
use std::fmt;
use std::time::{Duration, UNIX_EPOCH};

use humantime::format_rfc3339_micros;
use serde_json::{Value, json};

use super::explain::explain;
use super::print_tables;
use super::row::{Mark, Row, millis};
use super::split::pieces;
use crate::conversation::{Change, Entry, Event, Found, Outcome, Timestamp};
use crate::failure::Failure;
use crate::output::{Format, Output, print};
use crate::printable::excerpt;

/// Prints the entries of a conversation as they come.
#[derive(Debug)]
pub(super) struct Printer<'o> {
    output: &'o Output,
    /// Prints each frame field by field, too.
    shows_fields: bool,
    /// Time of the first event.
    started: Option<Timestamp>,
    /// Ends of the connections that no entry was printed of.
    ends: BTreeMap<u64, String>,
    has_header: bool,
    counts: BTreeMap<Mark, usize>,
    /// Entries with faults, and all.
    bad: usize,
    all: usize,
    round_trips: RoundTrips,
}

#[derive(Debug, Default)]
struct RoundTrips {
    count: u32,
    shortest: Duration,
    longest: Duration,
    sum: Duration,
}

/// Connections whose ends are kept until their first entry.
const MAX_ENDS: usize = 4096;

const COLUMNS: [&str; 12] = [
    "time",
    "since_ms",
    "connection",
    "station",
    "result",
    "attempt",
    "round_trip_ms",
    "request",
    "reply",
    "request_bytes",
    "reply_bytes",
    "faults",
];

impl<'o> Printer<'o> {
    pub(super) fn new(output: &'o Output, shows_fields: bool) -> Self {
        Self {
            output,
            shows_fields,
            started: None,
            ends: BTreeMap::new(),
            has_header: false,
            counts: BTreeMap::new(),
            bad: 0,
            all: 0,
            round_trips: RoundTrips::default(),
        }
    }

    /// Takes an event before its entries.
    pub(super) fn event(&mut self, event: &Event) {
        self.started.get_or_insert(event.at);
        if let Change::Open(ends) = &event.change
            && self.ends.len() < MAX_ENDS
        {
            self.ends.insert(event.connection, ends.clone());
        }
    }

    pub(super) fn entry(&mut self, entry: &Entry) -> Result<(), Failure> {
        let row = Row::new(entry);
        self.all += 1;
        *self.counts.entry(row.mark).or_default() += 1;
        self.bad += usize::from(!row.faults.is_empty());
        if let Some(round_trip) = row.round_trip {
            self.round_trips.add(round_trip);
        }
        self.header()?;
        match self.output.format {
            Format::Table => self.line(&row)?,
            Format::Json => self.output.json_line(&self.json(&row))?,
            Format::Csv => self.csv(&row)?,
        }
        if self.shows_fields { self.fields(entry) } else { Ok(()) }
    }

    fn header(&mut self) -> Result<(), Failure> {
        if std::mem::replace(&mut self.has_header, true) {
            return Ok(());
        }
        match self.output.format {
            Format::Table => {
                let started = utc(self.started.unwrap_or_default());
                let columns = format!("{:>11} {:>9}  {:>2} {:>3}  EXCHANGE", "TIME s", "TRIP ms", "#", "ST");
                print(format_args!("from {started}\n\n{columns}"))
            }
            Format::Json => Ok(()),
            Format::Csv => self.output.csv_line(&COLUMNS),
        }
    }

    fn since(&self, row: &Row) -> Duration {
        row.at.saturating_sub(self.started.unwrap_or(row.at))
    }

    fn line(&mut self, row: &Row) -> Result<(), Failure> {
        if let Some(ends) = self.ends.remove(&row.connection) {
            print(format_args!("connection {}: {}", row.connection, excerpt(&ends)))?;
        }
        let since = self.since(row);
        let trip = row.round_trip.map(millis).unwrap_or_default();
        let station = row.station.map(|station| station.to_string()).unwrap_or_default();
        print(format_args!(
            "{:>4}.{:06} {trip:>9}  {:>2} {station:>3}  {}",
            since.as_secs(),
            since.subsec_micros(),
            row.connection,
            row.text()
        ))?;
        row.faults.iter().try_for_each(|fault| print(format_args!("{:30}{fault}", "")))
    }

    fn json(&self, row: &Row) -> Value {
        let number = |time: Duration| millis(time).parse::<f64>().map_or(Value::Null, Value::from);
        json!({
            "time": utc(row.at),
            "since_ms": number(self.since(row)),
            "connection": row.connection,
            "station": row.station,
            "result": row.mark.as_str(),
            "attempt": row.attempt,
            "round_trip_ms": row.round_trip.map(number),
            "request": row.request,
            "reply": row.reply,
            "request_bytes": row.request_bytes,
            "reply_bytes": row.reply_bytes,
            "faults": row.faults,
        })
    }

    fn csv(&self, row: &Row) -> Result<(), Failure> {
        let text = |text: &Option<String>| text.clone().unwrap_or_default();
        let cells = [
            utc(row.at),
            millis(self.since(row)),
            row.connection.to_string(),
            row.station.map(|station| station.to_string()).unwrap_or_default(),
            row.mark.as_str().to_owned(),
            row.attempt.map(|attempt| attempt.to_string()).unwrap_or_default(),
            row.round_trip.map(millis).unwrap_or_default(),
            text(&row.request),
            text(&row.reply),
            text(&row.request_bytes),
            text(&row.reply_bytes),
            row.faults.join("; "),
        ];
        self.output.csv_line(&cells.each_ref().map(String::as_str))
    }

    /// Prints the frames of an entry field by field.
    fn fields(&self, entry: &Entry) -> Result<(), Failure> {
        let seen = match &entry.found {
            Found::Exchange(exchange) => {
                let reply = match &exchange.outcome {
                    Outcome::Answered(answer) => Some(&answer.reply),
                    Outcome::Unanswered | Outcome::Retried | Outcome::Broadcast => None,
                };
                [Some(&exchange.request), reply].into_iter().flatten().map(|seen| (&seen.bytes, seen.framing)).collect()
            }
            Found::Stray { reply, .. } => vec![(&reply.bytes, reply.framing)],
            Found::Bad { bytes, framing, .. } => vec![(bytes, *framing)],
            Found::Missing { .. } => vec![],
        };
        for (bytes, framing) in seen {
            let explained: Vec<_> = pieces(bytes, Some(framing)).iter().map(explain).collect();
            print(format_args!(""))?;
            print_tables(&explained)?;
        }
        print(format_args!(""))
    }

    /// Prints the summary to stderr. The status is that of bad frames, if there are any.
    pub(super) fn finish(mut self) -> Result<(), Failure> {
        if self.output.format == Format::Csv {
            self.header()?;
        }
        self.output.remark(format_args!("{}", self.summary()));
        match self.bad {
            0 => Ok(()),
            bad => Err(Failure::BadFrames { bad, all: self.all }),
        }
    }

    fn summary(&self) -> String {
        let exchanges =
            [Mark::Ok, Mark::Refused, Mark::NoReply, Mark::Retried, Mark::Broadcast, Mark::WrongReply, Mark::Ambiguous];
        let count = |mark: &Mark| self.counts.get(mark).copied().unwrap_or_default();
        let requests: usize = exchanges.iter().map(count).sum();
        let marks = self.counts.iter().filter(|&(&mark, _)| mark != Mark::Ok);
        let marks: String = marks.map(|(mark, count)| format!(", {count} {}", mark.as_str())).collect();
        format!("{requests} requests, {} answered{marks}{}", self.round_trips.count, self.round_trips)
    }
}

impl RoundTrips {
    fn add(&mut self, time: Duration) {
        self.shortest = if self.count == 0 { time } else { self.shortest.min(time) };
        self.longest = self.longest.max(time);
        self.sum = self.sum.saturating_add(time);
        self.count = self.count.saturating_add(1);
    }
}

impl fmt::Display for RoundTrips {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(mean) = self.sum.checked_div(self.count) else { return Ok(()) };
        let (shortest, mean, longest) = (millis(self.shortest), millis(mean), millis(self.longest));
        write!(f, "; round trip {shortest} to {longest} ms, mean {mean} ms")
    }
}

/// The last second of 9999, which ends the years of four digits.
const LAST_SECOND: u64 = 253_402_300_799;

fn utc(at: Timestamp) -> String {
    let time = UNIX_EPOCH.checked_add(at.min(Duration::from_secs(LAST_SECOND)));
    format_rfc3339_micros(time.unwrap_or(UNIX_EPOCH)).to_string()
}
