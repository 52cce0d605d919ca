//! Rules of addresses beyond the table of elements: limits of the framing, and counters of 32 bits.
//!
//! Before: one limit of 9999 for both framings, and counters as pairs of `RC` in runs.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

use std::time::Duration;

use bytes::BytesMut;
use fatek::backup::{Backup, RestoreOptions, TakeBackup};
use fatek::command::{
    ControlDiscrete, DiscreteControl, InvalidRequest, ReadDiscretes, ReadMixed, ReadRegisters, Request, WriteRegisters,
    encode_request,
};
use fatek::poll::{PollTag, Poller, ScanClass};
use fatek::sim::fault::Arrival;
use fatek::sim::{self, Bus, Faults, Model, Plc};
use fatek::tag::Tag;
use fatek::wire::{Frame, Framing};
use fatek::{Discrete, Element, Error, ErrorCode, Link, Register32, Station, discrete, element, register, register32};

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

struct Bench {
    plc: Plc,
    faults: Faults,
    station: Station,
}

fn bench(framing: Framing) -> Bench {
    bench_with(framing, Plc::with_model(Model::largest()))
}

fn bench_with(framing: Framing, plc: Plc) -> Bench {
    let faults = Faults::new(1);
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let link = Link::connector_builder("in memory", framing, sim::connector(bus, framing)).build();
    Bench { plc, faults, station: link.station(1).unwrap() }
}

impl Bench {
    /// Requests for elements that have arrived.
    fn requests(&self) -> Vec<Request> {
        let arrivals = self.faults.log().entries().into_iter().map(|entry| entry.arrival);
        let requests = arrivals.map(|arrival| match arrival {
            Arrival::Request { request, .. } => request,
            other => panic!("{other:?}"),
        });
        requests.filter(|request| !matches!(request, Request::LoopBack(_) | Request::ReadStatus(_))).collect()
    }
}

fn tag(text: &str) -> Tag {
    text.parse().unwrap()
}

fn is_past_ascii(error: &dyn std::fmt::Display) -> bool {
    error.to_string().contains("past the last address of the ascii framing")
}

#[tokio::test(start_paused = true)]
async fn an_address_past_9999_works_on_a_binary_link() {
    let bench = bench(Framing::Binary);
    let station = &bench.station;
    const RELAY: Discrete = discrete!("M10000");
    station.write_discretes(RELAY, &[true, false, true]).await.unwrap();
    assert_eq!(station.read_discretes(discrete!("M9998"), 6).await.unwrap(), [false, false, true, false, true, false]);
    station.write_registers(register!("RT65530"), &[1, 2, 3, 4, 5, 6]).await.unwrap();
    assert_eq!(station.read_registers32(register32!("DRT65534"), 1).await.unwrap(), [0x0006_0005]);
    station.write_registers(register!("WM10008"), &[0x00FF]).await.unwrap();
    assert_eq!(bench.plc.read(element!("DWM10000")), fatek::command::Value::DWord(0xFF05));
    station.call(ControlDiscrete::new(DiscreteControl::Disable, RELAY)).await.unwrap();
    assert_eq!(station.read_disabled(RELAY, 2).await.unwrap(), [true, false]);
    let past = station.read_discretes(discrete!("M65000"), 537).await.unwrap_err();
    assert!(past.to_string().contains("reach past the last address, M65535"), "{past}");
    let small = bench_with(Framing::Binary, Plc::with_model(Model::default().last(element!("M2001"))));
    let refused = small.station.read_discretes(RELAY, 1).await.unwrap_err();
    assert_eq!(refused.error_code(), Some(ErrorCode::IllegalAddress), "the model has fewer");
}

#[tokio::test(start_paused = true)]
async fn an_ascii_link_refuses_it_before_anything_is_sent() {
    let bench = bench(Framing::Ascii);
    let station = &bench.station;
    let errors = [
        station.read_discretes(discrete!("M10000"), 1).await.unwrap_err(),
        station.read_discretes(discrete!("M9999"), 2).await.unwrap_err(),
        station.read_discretes(discrete!("M9000"), 1001).await.unwrap_err(),
        station.read_disabled(discrete!("M9999"), 2).await.unwrap_err(),
        station.write_discretes(discrete!("M9999"), &[true; 2]).await.unwrap_err(),
        station.read_registers(register!("RC9999"), 2).await.unwrap_err(),
        station.read_registers(register!("WM9992"), 1).await.unwrap_err(),
        station.write_registers(register!("RT9990"), &[0; 11]).await.unwrap_err(),
        station.read_registers32(register32!("DRT9999"), 1).await.unwrap_err(),
        station.read_mixed(&[element!("R0"), element!("X10000")]).await.unwrap_err(),
        station.write_mixed(&[(element!("Y10000"), true.into())]).await.unwrap_err(),
        station.call(ControlDiscrete::new(DiscreteControl::Set, discrete!("S10000"))).await.unwrap_err(),
    ];
    for error in errors {
        assert!(is_past_ascii(&error) && !error.may_have_executed(), "{error}");
        assert!(matches!(&error, Error::Invalid(invalid) if invalid.error_code() == ErrorCode::IllegalAddress));
    }
    assert_eq!(bench.faults.log().arrivals(), 0);
}

#[tokio::test(start_paused = true)]
async fn backups_and_polls_check_the_framing_first() {
    let ascii = bench(Framing::Ascii);
    let ranges = [tag("R0-R9"), tag("M9990-M10009")];
    assert!(is_past_ascii(&TakeBackup::new(ranges).unwrap().run(&ascii.station).await.unwrap_err()));
    let backup = Backup::of(ranges).unwrap();
    assert!(is_past_ascii(&ascii.station.restore(&backup, RestoreOptions::new()).await.unwrap_err()));
    let poller = Poller::builder().build();
    let polled = poller.station(&ascii.station).unwrap();
    let second = ScanClass::every(Duration::from_secs(1));
    assert!(is_past_ascii(&polled.add(second, [PollTag::from(tag("M9999-M10000"))]).unwrap_err()));
    assert_eq!(ascii.faults.log().arrivals(), 0);

    let binary = bench(Framing::Binary);
    binary.plc.write(element!("M10000"), true).unwrap();
    let backup = binary.station.back_up(ranges).await.unwrap();
    assert_eq!(backup.value(element!("M10000")), Some(Ok(true.into())));
    binary.plc.write(element!("M10000"), false).unwrap();
    binary.station.restore(&backup, RestoreOptions::new()).await.unwrap();
    assert_eq!(binary.plc.read(element!("M10000")), true.into());
}

#[test]
fn a_frame_never_has_the_low_digits_of_a_long_address() {
    let mut frame = BytesMut::new();
    let request = ReadDiscretes::new(discrete!("M9999"), 2).unwrap();
    assert!(is_past_ascii(&encode_request(&request, Framing::Ascii, 1, &mut frame).unwrap_err()));
    assert!(frame.is_empty());
    encode_request(&request, Framing::Binary, 1, &mut frame).unwrap();
    let asked = Frame { station: 1, command: 0x44, data: "02M9999".into() };
    let error = Request::decode(&asked, Framing::Ascii).unwrap_err();
    assert!(is_past_ascii(&error) && error.error_code() == ErrorCode::IllegalAddress, "{error}");
}

/// The spelling of a retry must not read `M10000` behind `M9999`.
#[tokio::test(start_paused = true)]
async fn no_spelling_reads_past_the_framing() {
    for last in [discrete!("M9999"), discrete!("M9998")] {
        let bench = bench(Framing::Ascii);
        bench.plc.write(last, true).unwrap();
        for _ in 0..20 {
            assert!(bench.station.read_discretes(last, 1).await.unwrap()[0]);
        }
    }
}

#[tokio::test(start_paused = true)]
async fn counters_of_32_bits_are_read_and_written_one_by_one() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        let station = &bench.station;
        let values: Vec<u32> = (0..56).map(|n| 0xABCD_0000 + n).collect();
        station.write_registers32(register32!("DRC200"), &values).await.unwrap();
        assert_eq!(station.read_registers32(register32!("DRC200"), 56).await.unwrap(), values);
        station.write_registers32(register32!("DRC255"), &[7]).await.unwrap();
        let elements = ["DRC254", "DRC255", "RC199"].map(|text| text.parse::<Element>().unwrap());
        assert_eq!(station.read_mixed(&elements).await.unwrap(), [0xABCD_0036_u32.into(), 7_u32.into(), 0_u16.into()]);
        for request in bench.requests() {
            match request {
                Request::ReadRegisters32(read) => assert_eq!(read.count(), 1),
                Request::WriteRegisters32(write) => assert_eq!(write.values().len(), 1),
                Request::ReadMixed(_) | Request::WriteMixed(_) => {}
                other => panic!("{other:?}"),
            }
        }
        let past = station.read_registers32(register32!("DRC200"), 57).await.unwrap_err();
        assert!(past.to_string().contains("57 elements from DRC200 on reach past the last address, DRC255"), "{past}");
        let past = station.read_registers32(register32!("DRC0"), 101).await.unwrap_err();
        assert!(past.to_string().contains("101 elements from DRC0 on reach past the last address, DRC198"), "{past}");
    }
}

#[test]
fn a_run_of_counters_of_32_bits_is_no_request() {
    let one_by_one = |error| matches!(error, InvalidRequest::OneByOne { count: 2, .. });
    let error = ReadRegisters::new(register32!("DRC200"), 2).unwrap_err();
    assert_eq!(
        error.to_string(),
        "read registers (46h): DRC200 is a counter of 32 bits, and these are read and written one by one, not 2 at once"
    );
    assert!(one_by_one(error) && one_by_one(WriteRegisters::new(register32!("DRC254"), [1, 2]).unwrap_err()));
    assert!(ReadRegisters::new(register32!("DRC255"), 1).is_ok());
    assert!(ReadRegisters::new(register32!("DRC198"), 1).is_ok() && ReadRegisters::new(register!("RC199"), 2).is_err());
    let counters = ["DRC200", "DRC201"].map(|text| text.parse().unwrap());
    assert!(ReadMixed::new(counters).is_ok());
}

#[test]
fn a_range_of_counters_steps_by_one() {
    let names = |text: &str| tag(text).elements().map(|e| e.to_string()).collect::<Vec<_>>().join(" ");
    assert_eq!(names("DRC200-DRC205"), "DRC200 DRC201 DRC202 DRC203 DRC204 DRC205");
    assert_eq!(names("DRC194-DRC198"), "DRC194 DRC196 DRC198");
    assert_eq!(tag("DRC200-205:i32").to_string(), "DRC200-DRC205:i32");
    assert_eq!(
        "RC200".parse::<Tag>().unwrap_err().to_string(),
        "`RC200` is not a tag: RC200 does not exist: DRC200 to \
        DRC255 are counters of 32 bits, with one address each"
    );
}

#[tokio::test(start_paused = true)]
async fn counters_of_32_bits_are_backed_up_and_restored() {
    let bench = bench(Framing::Ascii);
    let counter = |address| Register32::new(fatek::Symbol::DRC, address).unwrap();
    (200..=255).for_each(|address| bench.plc.write(counter(address), u32::from(address) << 16).unwrap());
    let backup = bench.station.back_up([tag("RC0-RC199"), tag("DRC200-DRC255")]).await.unwrap();
    assert!(backup.is_complete() && Backup::from_file(backup.to_file().as_bytes()).unwrap() == backup);
    (200..=255).step_by(2).for_each(|address| bench.plc.write(counter(address), 1_u32).unwrap());
    let report = bench.station.restore(&backup, RestoreOptions::new()).await.unwrap();
    assert_eq!(report.written.len(), 28, "{:?}", report.written);
    for address in 200..=255 {
        assert_eq!(bench.plc.read(counter(address)), (u32::from(address) << 16).into());
    }
}

/// The manuals are silent on both requests, so the gateway leaves them to the PLC.
#[tokio::test(start_paused = true)]
async fn a_gateway_forwards_requests_for_counters_unchanged() {
    for data in ["03DRC0200", "02RC0200", "01RC0255", "02DRC0199"] {
        let bench = bench(Framing::Ascii);
        let asked = Frame { station: 1, command: 0x46, data: data.into() };
        let request = Request::decode(&asked, Framing::Ascii).unwrap();
        for _ in 0..3 {
            let refused = bench.station.forward(request.clone()).await.unwrap_err();
            assert_eq!(
                refused.error_code(),
                Some(ErrorCode::IllegalAddress),
                "{data}: the simulated PLC has no such run"
            );
        }
        let forwarded = bench.requests();
        assert!(
            forwarded.iter().all(|forwarded| *forwarded == request) && forwarded.len() == 3,
            "{data}: {forwarded:?}"
        );
    }
}

#[tokio::test(start_paused = true)]
async fn a_gateway_refuses_a_long_address_on_an_ascii_line() {
    let bench = bench(Framing::Ascii);
    let asked = Frame { station: 1, command: 0x44, data: b"\x01M\x27\x10"[..].into() };
    let request = Request::decode(&asked, Framing::Binary).unwrap();
    let Err(Error::Invalid(fault)) = bench.station.forward(request).await else { panic!() };
    assert_eq!(fault.error_code(), ErrorCode::IllegalAddress);
    assert_eq!(bench.faults.log().arrivals(), 0);
}
