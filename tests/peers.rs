//! Regression tests for faults reported by users of other PLC clients, through the public methods
//! and a simulated line.
#![cfg(feature = "sim")]

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fatek::command::Code;
use fatek::endpoint::InStepSettings;
use fatek::sim::{self, Bus, DisconnectAt, Fault, Faults, Line, Plc, Rule};
use fatek::wire::Framing;
use fatek::{CallOptions, Error, ErrorCode, Link, LinkBuilder, Register, Station, StationState, Value};
use tokio::time::{Instant, sleep, timeout};

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(1);
/// Repetitions of each fault.
const TIMES: u16 = 50;

#[tokio::test(start_paused = true)]
async fn after_many_timeouts_replies_still_match_their_requests() {
    for framing in FRAMINGS {
        let (builder, faults) = bus(framing, 1);
        // Equal spellings: the next read has the same shape, and only the check separates the two.
        let link = builder.in_step(without_duplicates()).build();
        let station = without_retries(&link);
        let late = || Rule::new(Fault::Delay { min: RESPONSE_TIMEOUT, max: 2 * RESPONSE_TIMEOUT });
        let late = || late().command(Code::ReadRegisters);

        // The late reply comes while the next read, of the same shape, is in flight.
        for n in 0..TIMES {
            faults.set_rules([late().times(1)]);
            let error = station.read_registers(d(n), 2).await.unwrap_err();
            assert!(matches!(error, Error::Timeout { sent: true, .. }), "{error:?}");
            assert_eq!(station.read_registers(d(1000 + n), 2).await.unwrap(), words(1, 1000 + n), "{framing}, {n}");
        }
        // Late replies only.
        faults.set_rules([late()]);
        for n in 0..TIMES {
            let result = station.read_registers(d(n), 2).await;
            assert!(matches!(result, Err(Error::Timeout { sent: true, .. })), "{framing}, {n}: {result:?}");
        }
        faults.set_rules([]);
        assert_eq!(station.read_registers(d(7), 2).await.unwrap(), words(1, 7));

        let late_replies =
            faults.log().entries().iter().filter(|entry| !entry.faults.is_empty() && entry.answer.is_some()).count();
        assert_eq!(late_replies, usize::from(2 * TIMES));
        let stats = station.stats();
        assert_eq!(
            (stats.late_replies, stats.stray_frames),
            (u64::from(2 * TIMES), 0),
            "each late reply came while another was awaited"
        );
    }
}

#[tokio::test(start_paused = true)]
async fn a_reply_of_wrong_length_is_never_accepted() {
    for (framing, len) in [(Framing::Ascii, 1 + 2 * 4), (Framing::Binary, 1 + 2 * 2)] {
        let (builder, faults) = bus(framing, 1);
        let link = builder.build();
        let shorter = (1..=len).map(|by| Fault::Truncated { by });
        let longer = (1..=len).map(|by| Fault::Extended { by });
        for fault in shorter.chain(longer) {
            faults.set_rules([Rule::new(fault.clone()).command(Code::ReadRegisters).times(2)]);
            let result = without_retries(&link).read_registers(d(1), 2).await;
            assert!(matches!(result, Err(Error::BadReply { .. })), "{framing}, {fault:?}: {result:?}");
            let repeated = link.station(1).unwrap().read_registers(d(2), 2).await;
            assert_eq!(repeated.unwrap(), words(1, 2), "{framing}, {fault:?}");
            assert_eq!(faults.rules()[0].times_applied(), 2);
        }
    }
}

#[tokio::test(start_paused = true)]
async fn dropped_futures_leave_the_stream_in_step() {
    for framing in FRAMINGS {
        let (builder, faults) = bus(framing, 1);
        let scan = Duration::from_millis(20);
        faults.set_line(Line::new(0).response_time(scan, scan));
        let link = builder.build();
        let station = link.station(1).unwrap();
        station.read_status().await.unwrap();
        for n in 0..TIMES {
            assert!(timeout(scan / 4, station.read_registers(d(n), 2)).await.is_err());
            assert!(timeout(scan / 4, station.write_registers(d(3000 + n), &[1])).await.is_err());
            assert_eq!(station.read_registers(d(1000 + n), 2).await.unwrap(), words(1, 1000 + n), "{framing}, {n}");
        }
        let stats = station.stats();
        let times = u64::from(TIMES);
        assert_eq!(
            (stats.requests, stats.replies),
            (2 * times + 1, 2 * times + 1),
            "queued requests of dropped futures are not sent"
        );
        assert_eq!(
            (stats.checks, stats.stray_frames, faults.log().writes()),
            (1, 0, 0),
            "only the check of a new connection"
        );
    }
}

#[tokio::test(start_paused = true)]
async fn a_broadcast_is_executed_once_by_every_station() {
    for framing in FRAMINGS {
        let (builder, faults) = bus(framing, 3);
        let link = builder.build();
        let began = Instant::now();
        for n in 0..TIMES {
            link.broadcast().write_registers(d(3000 + n), &[n]).await.unwrap();
        }
        assert_eq!(began.elapsed(), Duration::ZERO);
        for number in 1..=3 {
            let station = link.station(number).unwrap();
            assert_eq!(station.read_registers(d(3000 + TIMES - 1), 1).await.unwrap(), [TIMES - 1]);
        }
        assert_eq!((faults.log().writes(), faults.log().repeated().len()), (3 * u64::from(TIMES), 0));
        assert_eq!((link.stats().broadcasts, link.stats().stations.timeouts), (TIMES.into(), 0));
    }
}

#[tokio::test(start_paused = true)]
async fn a_dead_station_barely_delays_the_bus_and_recovers() {
    const DEAD: u8 = 3;
    let (builder, faults) = bus(Framing::Ascii, 8);
    faults.set_rules([Rule::new(Fault::Ignore).station(DEAD)]);
    let link = builder.build();
    let end = Instant::now() + Duration::from_secs(60);
    let pollers: Vec<_> = (1..=8)
        .map(|number| {
            let station = link.station(number).unwrap();
            tokio::spawn(async move {
                let (mut good, mut slowest) = (0, Duration::ZERO);
                while Instant::now() < end {
                    let began = Instant::now();
                    if let Ok(values) = station.read_registers(d(number.into()), 2).await {
                        assert_eq!(values, words(number, number.into()));
                        good += 1;
                        slowest = slowest.max(began.elapsed());
                    }
                    sleep(Duration::from_millis(100)).await;
                }
                (number, good, slowest)
            })
        })
        .collect();
    for poller in pollers {
        let (number, good, slowest) = poller.await.unwrap();
        if number == DEAD {
            assert_eq!(good, 0);
        } else {
            assert!(good >= 500, "station {number}: {good} of 600 polls");
            assert!(slowest <= RESPONSE_TIMEOUT + Duration::from_millis(2), "station {number}: {slowest:?}");
        }
    }
    let dead = link.station(DEAD).unwrap();
    let error = dead.read_status().await.unwrap_err();
    assert!(matches!(error, Error::Offline { station: DEAD, sent: false, .. }), "{error:?}");
    faults.set_rules([]);
    dead.watch_state().wait_for(|state| *state == StationState::Online).await.unwrap();
    assert_eq!(dead.read_registers(d(5), 2).await.unwrap(), words(DEAD, 5));
}

#[tokio::test(start_paused = true)]
async fn a_lost_connection_is_reopened_without_failed_reads() {
    for framing in FRAMINGS {
        let (builder, faults) = bus(framing, 1);
        // Equal spellings: each read has the command of the rule.
        let link = builder.in_step(without_duplicates()).build();
        let station = link.station(1).unwrap();
        assert_eq!(station.read_registers(d(0), 2).await.unwrap(), words(1, 0));
        let mut losses = 0;
        for moment in [
            DisconnectAt::BeforeExecution,
            DisconnectAt::BeforeReply,
            DisconnectAt::WithinReply,
            DisconnectAt::AfterReply,
        ] {
            for n in 0..5 {
                let disconnect = Rule::new(Fault::Disconnect(moment)).command(Code::ReadRegisters).times(1);
                let refuse = Rule::new(Fault::Refuse).times(2);
                faults.set_rules([disconnect, refuse]);
                assert_eq!(station.read_registers(d(n), 2).await.unwrap(), words(1, n), "{framing}, {moment:?}");
                assert_eq!(station.read_registers(d(9), 2).await.unwrap(), words(1, 9), "{framing}, {moment:?}");
                losses += 1;
            }
        }
        let stats = link.stats();
        assert_eq!((stats.disconnects, stats.connect_failures, stats.connects), (losses, 2 * losses, losses + 1));
    }
}

#[tokio::test(start_paused = true)]
async fn every_failure_is_one_error_type() {
    /// One `?` covers every failure.
    async fn sum(station: &Station, first: Register, count: usize) -> Result<u16, Error> {
        Ok(station.read_registers(first, count).await?.iter().sum())
    }
    let (builder, faults) = bus(Framing::Ascii, 1);
    let link = builder.fail_fast(true).build();
    let station = without_retries(&link);
    let [first, second] = words(1, 5);
    assert_eq!(sum(&station, d(5), 2).await.unwrap(), first + second);
    assert!(matches!(sum(&station, d(5), 0).await, Err(Error::Invalid(_))));
    for (fault, expected) in [
        (Fault::Error(ErrorCode::IllegalAddress), "refused"),
        (Fault::Ignore, "did not answer"),
        (Fault::BadChecksum, "gave no usable reply"),
        (Fault::Disconnect(DisconnectAt::BeforeReply), "was lost"),
        (Fault::Refuse, "cannot connect"),
    ] {
        faults.set_rules([Rule::new(fault)]);
        let error: Error = sum(&station, d(5), 2).await.unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
        faults.set_rules([]);
        sleep(Duration::from_secs(1)).await;
        if expected != "was lost" {
            assert_eq!(sum(&station, d(5), 2).await.unwrap(), first + second, "after: {error}");
        }
    }
    link.close().await;
    assert!(matches!(sum(&station, d(5), 2).await, Err(Error::Closed { .. })));
}

/// Public types that cannot grow without a breaking change, with the reason why they need not.
const TYPES_THAT_CANNOT_GROW: &[(&str, &str)] = &[
    ("ControlDiscrete", "the fields of 42"),
    ("ControlPlc", "the two codes of 41"),
    ("DiscreteControl", "the four codes of 42"),
    ("Element", "the protocol's three widths"),
    ("Frame", "what a frame carries in both framings; tools build it"),
    ("ReadDetailedStatus", "53 has no fields"),
    ("ReadProgramPage", "the field of 4F"),
    ("ReadStatus", "40 has no fields"),
    ("Readme", "it exists in documentation tests only"),
    ("Side", "a line has two ends"),
    ("StatusFlags", "STATUS1 is one byte"),
    ("Value", "the protocol's three widths"),
    ("Width", "the protocol's three widths"),
    ("WriteProgramPage", "the fields of 50"),
];

#[test]
fn public_types_that_may_grow_are_non_exhaustive() {
    let mut open = Vec::new();
    for file in sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src")) {
        open.extend(open_types(&fs::read_to_string(&file).unwrap()));
    }
    open.sort();
    let complete: Vec<_> = TYPES_THAT_CANNOT_GROW.iter().map(|&(name, _)| name.to_owned()).collect();
    assert_eq!(open, complete, "left: types without #[non_exhaustive]; right: the list in this file");
}

#[test]
fn the_scan_for_open_types_finds_them() {
    let found = |source: &str| open_types(source).concat();
    assert_eq!(found("#[derive(Debug)]\npub enum A {\n    B,\n}"), "A");
    assert_eq!(found("/// x\n#[non_exhaustive]\n#[derive(Debug)]\npub enum A {\n    B,\n}"), "");
    assert_eq!(found("#[non_exhaustive]\npub enum A {\n}\n\npub enum B {\n}"), "B");
    assert_eq!(found("pub struct A<T> {\n    /// x\n    pub b: T,\n}"), "A");
    assert_eq!(found("pub struct A {\n    pub b: u8,\n    c: u8,\n}"), "");
    assert_eq!(found("pub struct A {\n    pub(crate) b: u8,\n}"), "");
    assert_eq!(found("pub struct A(pub u8, pub u8);\npub struct B(pub u8, u8);\npub struct C;"), "AC");
}

/// Source files of the library, without those of the command line.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let (folders, files): (Vec<_>, Vec<_>) = entries.partition(|path| path.is_dir());
    let files = files.into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "rs"));
    let folders = folders.into_iter().filter(|folder| !folder.ends_with("bin"));
    files.chain(folders.flat_map(|folder| sources(&folder))).collect()
}

/// Names of public enums and of structs with public fields only that lack `#[non_exhaustive]`.
fn open_types(source: &str) -> Vec<String> {
    let lines: Vec<&str> = source.lines().map(str::trim).collect();
    let mut open = Vec::new();
    for (at, line) in lines.iter().enumerate() {
        let Some((kind, rest)) = line.strip_prefix("pub ").and_then(|rest| rest.split_once(' ')) else { continue };
        let is_open = match kind {
            "enum" => true,
            "struct" if rest.ends_with(';') => {
                let fields = rest.split_once('(').map_or("", |(_, fields)| fields.trim_end_matches([')', ';']));
                fields.split(", ").all(|field| field.is_empty() || field.starts_with("pub "))
            }
            "struct" => {
                let body = lines[at + 1..].iter().take_while(|line| !line.starts_with('}'));
                let mut fields =
                    body.filter(|line| !line.is_empty() && !line.starts_with("//") && !line.starts_with('#'));
                fields.all(|field| field.starts_with("pub "))
            }
            _ => continue,
        };
        let above = lines[..at].iter().rev().take_while(|line| line.starts_with("//") || line.starts_with('#'));
        if is_open && !above.into_iter().any(|line| line.contains("non_exhaustive")) {
            open.push(rest.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default().to_owned());
        }
    }
    open
}

/// A bus of stations 1 to `stations`. Each register D holds a word of its station and address.
fn bus(framing: Framing, stations: u8) -> (LinkBuilder, Faults) {
    let faults = Faults::new(1);
    let mut bus = Bus::new().with_faults(faults.clone());
    for station in 1..=stations {
        let plc = Plc::new();
        for address in (0..=TIMES).chain(1000..=1000 + TIMES) {
            plc.write(d(address), Value::Word(word(station, address))).unwrap();
        }
        bus = bus.with_station(station, plc).unwrap();
    }
    let builder = Link::connector_builder("a simulated bus", framing, sim::connector(bus, framing));
    (builder.response_timeout(RESPONSE_TIMEOUT), faults)
}

/// Settings of a line that never duplicates a reply: equal requests keep one spelling.
fn without_duplicates() -> InStepSettings {
    InStepSettings::new().with_copies(0).unwrap()
}

fn without_retries(link: &Link) -> Station {
    link.station(1).unwrap().with_options(CallOptions::new().with_response_timeout(RESPONSE_TIMEOUT).with_retries(0))
}

fn d(address: u16) -> Register {
    Register::d(address)
}

fn word(station: u8, address: u16) -> u16 {
    5000 * u16::from(station) + address
}

/// Content of two consecutive registers.
fn words(station: u8, first: u16) -> [u16; 2] {
    [word(station, first), word(station, first + 1)]
}
