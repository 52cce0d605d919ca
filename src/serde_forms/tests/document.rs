//! The examples of docs/SERDE.md: what the code writes, and reads where it can.

use std::fmt::Debug;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value as Json, json};
use tokio::time::Instant;

use super::{json as text_of, read_json, read_values, tag};
use crate::capabilities::{Capabilities, Support, WordSupport};
use crate::command::Code;
use crate::element::{Symbol, Value};
use crate::endpoint::{DataBits, InStepSettings, Parity, Rts, SerialSettings};
use crate::error::{Error, ErrorCode};
use crate::link::{
    CallOptions, CheckStats, EchoMode, LinkState, LinkStats, RoundTripStats, SpellingStats, StationState, StationStats,
};
use crate::plan::{CostModel, Limits, WordAreas};
use crate::poll::{ClassStats, Counters, PollTag, PollerStats, Quality, Reason, Sample, ScanClass, Stamp, TagId};
use crate::pool::{PoolEndpoint, PoolStats};
use crate::tag::{Assignment, Scale, TagType, TagValue};
use crate::wire::Framing;
use crate::{element, element::Element};

const DOCUMENT: &str = include_str!("../../../docs/SERDE.md");
const MS: Duration = Duration::from_millis(1);

/// An example of the document: the text before it, and its JSON.
#[derive(Debug)]
struct Example {
    label: String,
    json: Json,
}

/// The examples in their order: rows of tables, and blocks of JSON.
fn examples() -> Vec<Example> {
    let (mut examples, mut paragraph, mut block) = (Vec::new(), String::new(), None::<String>);
    for line in DOCUMENT.lines() {
        match (&mut block, line) {
            (None, "```json") => block = Some(String::new()),
            (Some(text), "```") => {
                let label = std::mem::take(&mut paragraph);
                examples.push(Example { label, json: text.parse().unwrap_or_else(|e| panic!("{text}: {e}")) });
                block = None;
            }
            (Some(text), line) => *text += line,
            (None, line) if line.starts_with("| ") && line.ends_with("` |") => {
                let (label, json) = line.trim_matches(['|', ' ']).split_once(" | `").unwrap();
                let json = json.trim_end_matches('`').parse().unwrap_or_else(|e| panic!("{json}: {e}"));
                examples.push(Example { label: label.to_owned(), json });
            }
            (None, "") => {}
            // A paragraph may be followed by a blank line and a block.
            (None, line) if line.starts_with(['`', '#']) => paragraph = line.to_owned(),
            (None, _) => {}
        }
    }
    examples
}

/// The examples that were not compared yet.
struct Remaining(std::vec::IntoIter<Example>);

impl Remaining {
    fn next(&mut self, label: &str) -> Json {
        let example = self.0.next().unwrap_or_else(|| panic!("no example of {label}"));
        assert!(example.label.starts_with(label), "{label} is not the label of {example:?}");
        example.json
    }

    /// Compares the example of a value that is only written.
    fn written<T: Serialize>(&mut self, label: &str, value: T) {
        assert_eq!(serde_json::to_value(value).unwrap(), self.next(label), "{label}");
    }

    /// Compares the example of a value that is written and read.
    fn both<T: Serialize + DeserializeOwned + PartialEq + Debug>(&mut self, label: &str, value: T) {
        let example = self.next(label);
        assert_eq!(serde_json::to_value(&value).unwrap(), example, "{label}");
        assert_eq!(read_json::<T>(&example.to_string()).unwrap(), value, "{label}");
    }

    /// Compares the example of a value that is read by its tag.
    fn value(&mut self, label: &str, of: &str, value: TagValue) {
        let example = self.next(label);
        assert_eq!(text_of(&value), example.to_string(), "{label}");
        let read = read_values(tag(of), &example.to_string()).unwrap();
        assert!(read.len() == 1 && read[0].is_identical(&value), "{label}: {read:?}");
    }
}

#[test]
fn the_document_has_the_forms_of_the_code() {
    let mut examples = Remaining(examples().into_iter());
    texts(&mut examples);
    values(&mut examples);
    samples(&mut examples);
    options(&mut examples);
    stats(&mut examples);
    let error = ErrorCode::IllegalAddress;
    examples.written("`Error`", Error::Plc { station: 1, code: Code::ReadRegisters, error, repeated: false });
    assert!(examples.0.next().is_none(), "{:?}", examples.0);
}

fn texts(examples: &mut Remaining) {
    examples.both("`Tag`", tag("R100:f32"));
    examples.both("`TagType`", TagType::F32);
    examples.both("`Scale`", Scale::new(0.1, -40.0).unwrap());
    examples.both("`Assignment`", "R0-R2=1,2,3".parse::<Assignment>().unwrap());
    examples.both("`Element`", element!("R12"));
    examples.both("`Discrete`", crate::discrete!("M10"));
    examples.both("`Register`", crate::register!("WM16"));
    examples.both("`Register32`", crate::register32!("DR100"));
    examples.both("`Symbol`", Symbol::DR);
    examples.both("`Framing`", Framing::Ascii);
    examples.both("`EchoMode`", EchoMode::Auto);
    let serial = SerialSettings::new(Framing::Ascii).with_baud(19_200).unwrap();
    let in_step = InStepSettings::new().with_copies(2).unwrap();
    let endpoint = crate::Endpoint::serial("/dev/ttyUSB0").with_serial(serial).unwrap().with_in_step(in_step);
    examples.both("`Endpoint`", endpoint);
}

fn values(examples: &mut Remaining) {
    examples.written("`Value::Bit`", Value::Bit(true));
    examples.written("`Value::Word`", Value::Word(u16::MAX));
    examples.written("`Value::DWord`", Value::DWord(u32::MAX));
    for (label, tag, value) in [
        ("`TagValue::Bool`", "M0", TagValue::Bool(true)),
        ("`TagValue::U16`", "R0", TagValue::U16(7)),
        ("`TagValue::I16`", "R0:i16", TagValue::I16(-7)),
        ("`TagValue::U32`", "DR0", TagValue::U32(u32::MAX)),
        ("`TagValue::I32`", "R0:i32", TagValue::I32(i32::MIN)),
        ("`TagValue::U64`", "R0:u64", TagValue::U64(u64::MAX)),
        ("`TagValue::I64`", "R0:i64", TagValue::I64(i64::MIN)),
        ("`TagValue::F32`", "R0:f32", TagValue::F32(0.1)),
        ("`TagValue::F64`", "R0:f64", TagValue::F64(-2.5)),
        ("`TagValue::Scaled`", "R0:i16*0.1-40", TagValue::Scaled(12.3)),
        ("a float that is not a number", "R0:f32", TagValue::F32(f32::NAN)),
        ("an infinite float", "R0:f64", TagValue::F64(f64::NEG_INFINITY)),
        ("`TagValue::Hex16`", "R0:hex", TagValue::Hex16(0xFF)),
        ("`TagValue::Hex32`", "DR0:hex", TagValue::Hex32(0xBEEF)),
        ("`TagValue::Bcd16`", "R0:bcd16", TagValue::Bcd16(0x1234)),
        ("`TagValue::Bcd32`", "R0:bcd32", TagValue::Bcd32(0x1234_5678)),
        ("decimal digits beyond 9", "R0:bcd16", TagValue::Bcd16(0xFA)),
        ("`TagValue::Text`", "R0-R3:text", TagValue::Text("lemonade".to_owned())),
    ] {
        examples.value(label, tag, value);
    }
}

fn samples(examples: &mut Remaining) {
    let time = SystemTime::UNIX_EPOCH + Duration::from_millis(1_795_331_353_250);
    let at = Stamp { instant: Instant::now(), time };
    let stale_since = Stamp { time: time + 1500 * MS, ..at };
    let sample = |id, name: &str, quality, values: &[TagValue]| Sample {
        id: TagId(id),
        name: name.into(),
        stale_since: matches!(quality, Quality::Stale(_)).then_some(stale_since),
        quality,
        at,
        cycle: 12,
        values: (!values.is_empty()).then(|| values.into()),
    };
    examples.written("`TagId`", TagId(7));
    examples.written("`Quality`", Quality::Stale(Reason::Overdue));
    examples.written("`Reason`", Reason::Refused(ErrorCode::IllegalAddress));
    examples.written("`Stamp`", at);
    examples.written("`Sample`, good", sample(7, "level", Quality::Good, &[TagValue::F32(2.75)]));
    let three = [1, 2, 3].map(TagValue::U16);
    examples.written("`Sample`, stale", sample(8, "R0-R2", Quality::Stale(Reason::Overdue), &three));
    examples.written("`Sample`, bad", sample(9, "R9", Quality::Bad(Reason::NotYetRead), &[]));
}

fn options(examples: &mut Remaining) {
    let options = CallOptions::new().with_response_timeout(300 * MS).with_background(true);
    examples.both("`CallOptions`", options);
    let class = ScanClass::every(500 * MS).phase(250 * MS).stale_after(5000 * MS);
    examples.both("`ScanClass`", class);
    let level = PollTag::new("level", tag("R100:f32")).deadband(0.5).heartbeat(60_000 * MS);
    examples.both("`PollTag`", level);
    examples.both("`InStepSettings`", InStepSettings::new().with_copies(2).unwrap().with_window(250 * MS));
    let serial = SerialSettings::new(Framing::Ascii).with_baud(19_200).unwrap();
    let serial = serial.with_data_bits(DataBits::Eight).with_parity(Parity::None);
    examples.both("`SerialSettings`", serial.with_dtr(true).with_rts(Rts::OnWhileSending));
    let range = |limits: Limits, first: Element, last: Element| limits.readable(first, last).unwrap();
    let limits = range(Limits::new(), element!("R5000"), element!("R5998"));
    let limits = range(limits, element!("R0"), element!("R3839")).max_registers(32).unwrap().max_mixed(16).unwrap();
    let limits = limits.avoid(element!("R4"), element!("R4")).unwrap();
    let limits = limits.without_words(WordAreas::of(Symbol::Y).and(WordAreas::of(Symbol::S)));
    examples.both("`Limits`", limits.avoid(element!("DRC200"), element!("DRC255")).unwrap());
    let known = Capabilities::new()
        .with_command(Code::ReadDiscretes, Support::Supported)
        .with_command(Code::ReadMixed, Support::Refused)
        .with_command(Code::LoopBack, Support::Unanswered)
        .with_answers_broadcasts(false)
        .with_response_time(5 * MS);
    let known = known.with_max_registers(64).unwrap().with_max_points(256).unwrap().with_counter_step(1).unwrap();
    let known = [
        (Symbol::X, WordSupport::MultiplesOf16),
        (Symbol::Y, WordSupport::Refused),
        (Symbol::M, WordSupport::MultiplesOf8),
    ]
    .into_iter()
    .fold(known, |known, (symbol, support)| known.with_words_of(symbol, support).unwrap());
    examples.both("`Capabilities`", known);
    examples.both("`CostModel`", CostModel::network(Framing::Ascii, 12 * MS).with_overhead(MS));
}

fn stats(examples: &mut Remaining) {
    examples.written("`LinkState`", LinkState::Down { error: Arc::new(std::io::ErrorKind::ConnectionReset.into()) });
    examples.written("`StationState`", StationState::Online);
    let traffic = link_stats();
    examples.written("`LinkStats`", traffic);
    let shortened = |value: &dyn Fn() -> Json| {
        let mut form = value();
        assert_eq!(form["traffic"], json!(traffic));
        form["traffic"] = Json::Null;
        form
    };
    let pool = PoolStats {
        endpoints: 1,
        links: 2,
        idle: 3,
        waiting: 4,
        connecting: 5,
        up: 6,
        down: 7,
        closed: 8,
        evicted: 9,
        traffic,
    };
    examples.written("`PoolStats`", shortened(&|| json!(pool)));
    let down = LinkState::Down { error: Arc::new(std::io::ErrorKind::ConnectionReset.into()) };
    let endpoint = crate::Endpoint::tcp("192.168.2.3", 500);
    let endpoint = PoolEndpoint { endpoint, links: vec![LinkState::Up, down], traffic };
    examples.written("`PoolEndpoint`", shortened(&|| json!(endpoint)));
    let counters = Counters {
        cycles: 1,
        completed: 1,
        overruns: 2,
        abandoned: 3,
        requests: 4,
        refusals: 5,
        failures: 6,
        last_cycle: 250 * MS,
    };
    let poller = PollerStats { stations: 1, tags: 2, refused_tags: 3, samples: 4, missed: 5, counters };
    examples.written("`PollerStats`", poller);
    let class = ScanClass::every(1000 * MS);
    examples.written("`ClassStats`", ClassStats { class, tags: 1, refused_tags: 2, requests_per_cycle: 3, counters });
}

fn link_stats() -> LinkStats {
    let round_trip = RoundTripStats {
        last: 12 * MS,
        shortest: Duration::from_micros(10_500),
        longest: 1500 * MS,
        smoothed: 11 * MS,
    };
    let stations = StationStats {
        requests: 1,
        replies: 2,
        refusals: 3,
        timeouts: 4,
        bad_replies: 5,
        retries: 6,
        checks: 7,
        checks_for: CheckStats { connected: 1, timed_out: 2, stray: 3, unproven: 4, owed: 5, confirm: 6 },
        refused_checks: 8,
        silences: 9,
        spellings: SpellingStats { plain: 1, one_more: 2, fewer: 3, mixed: 4 },
        refused_spellings: 10,
        unproven_replies: 11,
        duplicates: 12,
        late_replies: 13,
        broadcast_answers: 14,
        repeated_jobs: 15,
        stray_frames: 16,
        round_trip: Some(round_trip),
    };
    LinkStats {
        stations,
        bus_time: 90_500 * MS,
        broadcasts: 17,
        checksum_errors: 18,
        garbage_bytes: 19,
        stale_bytes: 20,
        late_datagrams: 21,
        echoes: 22,
        connects: 23,
        disconnects: 24,
        idle_closes: 25,
        mute_connections: 26,
        long_gaps: 27,
        connect_failures: 28,
        withheld: 29,
        one_request: true,
    }
}

#[test]
fn states_and_kinds_of_errors_have_names() {
    let states = [LinkState::Idle, LinkState::Waiting, LinkState::Connecting, LinkState::Up, LinkState::Closed];
    assert_eq!(text_of(&states.as_slice()), r#"["idle","waiting","connecting","up","closed"]"#);
    let states = [StationState::Unknown, StationState::Offline { probe_at: Instant::now() }];
    assert_eq!(text_of(&states), r#"["unknown","offline"]"#);
    assert_eq!(text_of(&[Quality::Good, Quality::Bad(Reason::Overdue)].as_slice()), r#"["good","bad"]"#);

    let io = || Arc::new(std::io::Error::from(std::io::ErrorKind::ConnectionReset));
    let timeout = Error::timeout(1, Code::ReadStatus, 5 * MS, true);
    let (code, after) = (Code::ReadStatus, 5 * MS);
    let endpoint = "tcp://a:500".to_owned();
    for (error, kind, transient, executed) in [
        (Error::OutOfStep { station: 1, code, after, sent: false }, "out_of_step", true, false),
        (Error::Duplicates { station: 1, sent: true }, "duplicates", true, true),
        (Error::Offline { station: 1, probe_in: after, sent: false }, "offline", true, false),
        (Error::QueueFull { station: 1, limit: 9 }, "queue_full", true, false),
        (Error::GateClosed { station: 1, code, sent: false }, "gate_closed", true, false),
        (Error::Connect { endpoint: endpoint.clone(), source: io(), sent: false }, "connect", true, false),
        (Error::Disconnected { endpoint, source: io(), sent: true }, "disconnected", true, true),
        (
            Error::PartlyWritten { written: 1, count: 2, source: Box::new(timeout.clone()) },
            "partly_written",
            true,
            true,
        ),
        (timeout, "timeout", true, true),
        (Error::Closed { sent: false }, "closed", false, false),
        (Error::Tag(Box::new(crate::tag::TagAccessError::Number { tags: 2, items: 3 })), "tag", false, false),
    ] {
        let form = serde_json::to_value(&error).unwrap();
        let expected = json!({
            "kind": kind, "message": error.to_string(), "is_transient": transient, "may_have_executed": executed,
        });
        assert_eq!(form, expected);
    }
}

#[test]
fn times_beyond_the_years_of_four_digits_are_their_ends() {
    let stamp = |time| text_of(&Stamp { instant: Instant::now(), time });
    let (epoch, second) = (SystemTime::UNIX_EPOCH, Duration::from_secs(1));
    assert_eq!(stamp(epoch - second), r#""1970-01-01T00:00:00.000Z""#);
    // Before: the formatter of the time panicked.
    assert_eq!(stamp(epoch + second * u32::MAX * 60), r#""9999-12-31T23:59:59.000Z""#);
}
