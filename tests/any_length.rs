//! Reads and writes of any length: their requests, and the reports when one of these fails.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

use std::time::Duration;

use fatek::command::{Code, Request, WriteDiscretes, WriteMixed, WriteRegisters};
use fatek::endpoint::InStepSettings;
use fatek::sim::fault::Arrival;
use fatek::sim::{self, Bus, Fault, Faults, Model, Plc, Rule};
use fatek::wire::Framing;
use fatek::{
    CallOptions, Discrete, Error, ErrorCode, Link, Register, Register32, Station, Symbol, discrete, register,
    register32,
};

struct Bench {
    plc: Plc,
    faults: Faults,
    station: Station,
}

fn bench(framing: Framing) -> Bench {
    bench_with(framing, InStepSettings::new())
}

fn bench_with(framing: Framing, in_step: InStepSettings) -> Bench {
    let (plc, faults) = (Plc::with_model(Model::largest()), Faults::new(1));
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let link = Link::connector_builder("in memory", framing, sim::connector(bus, framing)).in_step(in_step).build();
    Bench { plc, faults, station: link.station(1).unwrap() }
}

impl Bench {
    fn requests(&self) -> Vec<Request> {
        requests_of(&self.faults)
    }
}

/// All requests that have arrived.
fn requests_of(faults: &Faults) -> Vec<Request> {
    let arrivals = faults.log().entries().into_iter().map(|entry| entry.arrival);
    arrivals
        .map(|arrival| match arrival {
            Arrival::Request { request, .. } => request,
            other => panic!("{other:?}"),
        })
        .collect()
}

/// Returns whether the request is a loop-back with a nonce.
fn is_check(request: &Request) -> bool {
    matches!(request, Request::LoopBack(check) if check.data().len() == 8)
}

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

#[tokio::test(start_paused = true)]
async fn a_thousand_registers_are_read_64_and_63_in_turn() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        for address in 0..1000 {
            bench.plc.write(Register::r(address + 5), address ^ 0x5A5A).unwrap();
        }
        let values = bench.station.read_registers(register!("R5"), 1000).await.unwrap();
        assert!(values.iter().copied().eq((0..1000).map(|address| address ^ 0x5A5A)));
        let requests = bench.requests();
        assert!(is_check(&requests[0]), "{:?}", requests[0]);
        let mut next = 5;
        for (n, request) in requests[1..].iter().enumerate() {
            let Request::ReadRegisters(read) = request else { panic!("{request:?}") };
            let count = if n % 2 == 0 { 64 } else { 63 }.min(1005 - next);
            assert_eq!((read.first(), read.count()), (Register::r(next), count.into()));
            next += count;
        }
        assert_eq!((next, requests.len()), (1005, 17), "the last has a shape of its own, so that no check follows it");
    }
}

/// A check is needed unless the last request has a shape of its own. No nonce is used twice.
#[tokio::test(start_paused = true)]
async fn a_long_read_or_write_of_two_shapes_ends_with_a_check() {
    for framing in FRAMINGS {
        let Bench { station, faults, .. } = bench(framing);
        let log = faults.log();
        let checks = || {
            let requests = requests_of(&faults);
            let checks: Vec<_> = requests.iter().enumerate().filter(|(_, request)| is_check(request)).collect();
            let at = checks.iter().map(|(n, _)| *n).collect::<Vec<_>>();
            assert!(checks.windows(2).all(|pair| pair[0].1 != pair[1].1), "{requests:?}");
            log.clear();
            (at, requests.len())
        };
        station.loop_back("").await.unwrap();
        assert_eq!(checks(), (vec![0], 2));
        station.read_registers(register!("R0"), 64 + 63).await.unwrap();
        assert_eq!(checks(), (vec![], 2), "each has its own shape");
        station.read_registers(register!("R0"), 2 * (64 + 63)).await.unwrap();
        // The read before ended with 63 registers, so this one begins with 64.
        assert_eq!(checks(), (vec![4], 5));
        station.read_discretes(discrete!("M0"), 2 * (256 + 255)).await.unwrap();
        assert_eq!(checks(), (vec![4], 5));
        station.write_registers(register!("R0"), &[1; 2 * (64 + 32)]).await.unwrap();
        assert_eq!(checks(), (vec![4], 5));
    }
}

#[tokio::test(start_paused = true)]
async fn a_full_request_is_one_and_one_item_more_makes_two() {
    for framing in FRAMINGS {
        // Without duplicates no check separates equal requests, so only the requests are counted.
        let Bench { station, faults, .. } = bench_with(framing, InStepSettings::new().with_copies(0).unwrap());
        let log = faults.log();
        station.loop_back("").await.unwrap();
        log.clear();
        let requests = || {
            let arrivals = log.arrivals();
            log.clear();
            arrivals
        };
        for (more, sent) in [(0, 1), (1, 2)] {
            assert_eq!(station.read_registers(register!("R0"), 64 + more).await.unwrap().len(), 64 + more);
            assert_eq!(requests(), sent);
            assert_eq!(station.read_registers32(register32!("DR1"), 32 + more).await.unwrap().len(), 32 + more);
            assert_eq!(requests(), sent);
            assert_eq!(station.read_discretes(discrete!("M3"), 256 + more).await.unwrap().len(), 256 + more);
            assert_eq!(requests(), sent);
            assert_eq!(station.read_disabled(discrete!("X3"), 256 + more).await.unwrap().len(), 256 + more);
            assert_eq!(requests(), sent);
            station.write_registers(register!("R0"), &vec![1; 64 + more]).await.unwrap();
            assert_eq!(requests(), sent);
            station.write_registers32(register32!("DR0"), &vec![1; 32 + more]).await.unwrap();
            assert_eq!(requests(), sent);
            station.write_discretes(discrete!("M0"), &vec![true; 256 + more]).await.unwrap();
            assert_eq!(requests(), sent);
        }
    }
}

#[tokio::test(start_paused = true)]
async fn long_writes_are_read_back_and_applied_once() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        let station = &bench.station;
        let words: Vec<u16> = (0..3000).map(|i| i * 7 + 1).collect();
        station.write_registers(register!("D10"), &words).await.unwrap();
        assert_eq!(station.read_registers(register!("D10"), 3000).await.unwrap(), words);

        // From an odd address on. A split value would show at the boundary of two requests.
        let doubles: Vec<u32> = (0..77).map(|i| i * 0x0001_0003 + 0x8000_0000).collect();
        station.write_registers32(register32!("DR101"), &doubles).await.unwrap();
        assert_eq!(station.read_registers32(register32!("DR101"), 77).await.unwrap(), doubles);
        for (n, &double) in doubles.iter().enumerate() {
            let element = Register32::new(Symbol::DR, 101).unwrap().nth(n).unwrap();
            assert_eq!(bench.plc.read(element), double.into());
        }

        // Addresses of word discretes step by 16.
        let relays: Vec<bool> = (0..1600).map(|i| i % 3 == 0).collect();
        station.write_discretes(discrete!("M16"), &relays).await.unwrap();
        assert_eq!(station.read_discretes(discrete!("M16"), 1600).await.unwrap(), relays);
        let as_words = station.read_registers(register!("WM16"), 100).await.unwrap();
        for (n, on) in relays.into_iter().enumerate() {
            assert_eq!(as_words[n / 16] >> (n % 16) & 1 == 1, on, "M{}", 16 + n);
        }

        let log = bench.faults.log();
        // Alternately 64 and 32 registers, 32 and 16 double words, 256 and 32 discretes.
        assert_eq!(log.writes(), 63 + 3 + 11);
        assert!(log.repeated().is_empty());
        let part = WriteMixed::new(
            (64..96).map(|i| (Register::d(10 + i).into(), words[usize::from(i)].into())).collect::<Vec<_>>(),
        );
        assert_eq!(log.applied(1, &Request::WriteMixed(part.unwrap())), 1);
        let part = WriteRegisters::new(register!("D106"), &words[96..160]).unwrap();
        assert_eq!(log.applied(1, &Request::WriteRegisters(part)), 1);
        let part = WriteDiscretes::new(discrete!("M304"), (288..544).map(|i| i % 3 == 0).collect::<Vec<_>>());
        assert_eq!(log.applied(1, &Request::WriteDiscretes(part.unwrap())), 1);
    }
}

#[tokio::test(start_paused = true)]
async fn requests_past_the_last_address_are_not_sent() {
    let bench = bench(Framing::Ascii);
    let station = &bench.station;
    assert_eq!(station.read_discretes(discrete!("M9000"), 1000).await.map(|states| states.len()).ok(), Some(1000));
    bench.faults.log().clear();
    let past = [
        station.read_discretes(discrete!("M9000"), 1001).await.unwrap_err(),
        station.read_disabled(discrete!("M9000"), 1001).await.unwrap_err(),
        station.read_registers(register!("R65000"), 600).await.unwrap_err(),
        station.read_registers32(register32!("DR65000"), 269).await.unwrap_err(),
        station.write_discretes(discrete!("M9000"), &[true; 1001]).await.unwrap_err(),
        station.write_registers(register!("R65000"), &[1; 600]).await.unwrap_err(),
        station.write_registers32(register32!("DR65000"), &[1; 269]).await.unwrap_err(),
        station.read_registers(register!("R0"), usize::MAX).await.unwrap_err(),
    ];
    for error in past {
        assert!(error.to_string().contains("past the last address"), "{error}");
        assert!(!error.may_have_executed());
    }
    let none = [
        station.read_discretes(discrete!("M9990"), 0).await.unwrap_err(),
        station.read_registers32(register32!("DR65530"), 0).await.unwrap_err(),
        station.write_registers(register!("R65535"), &[]).await.unwrap_err(),
    ];
    let takes = ["it takes 1 to 10", "it takes 1 to 3", "it takes 1 to 1"];
    for (error, takes) in none.into_iter().zip(takes) {
        assert!(error.to_string().contains("0 items were asked for") && error.to_string().ends_with(takes), "{error}");
    }
    assert_eq!(bench.faults.log().arrivals(), 0);
}

#[tokio::test(start_paused = true)]
async fn a_write_that_fails_midway_reports_what_is_written() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        let refused = Rule::new(Fault::Error(ErrorCode::IllegalAddress)).command(Code::WriteRegisters);
        bench.faults.add_rule(refused.element(register!("R128")));
        let values: Vec<u16> = (1..=200).collect();
        let error = bench.station.write_registers(register!("R0"), &values).await.unwrap_err();
        let Error::PartlyWritten { written, count, source, .. } = &error else { panic!("{error:?}") };
        // The third request has R128, after 64 registers in a write and 32 in a mixed write.
        assert_eq!((*written, *count), (96, 200));
        assert!(!source.may_have_executed(), "refused");
        assert!(error.may_have_executed());
        assert_eq!(error.error_code(), Some(ErrorCode::IllegalAddress));
        assert_eq!(
            error.to_string(),
            "96 of 200 values were written, and then: station 1 refused write registers (47h): illegal address (A)"
        );
        assert_eq!(bench.plc.read(register!("R95")), 96_u16.into());
        assert_eq!(bench.plc.read(register!("R96")), 0_u16.into());
        assert_eq!(bench.plc.read(register!("R160")), 0_u16.into(), "the rest is not sent");
        let requests: Vec<_> = bench.requests().iter().map(Request::code).collect();
        let (write, mixed) = (Code::WriteRegisters, Code::WriteMixed);
        assert_eq!(requests, [Code::LoopBack, write, mixed, write, Code::LoopBack], "between two checks");

        // If the first request fails, nothing is in doubt.
        let error = bench.station.write_registers(register!("R128"), &[1; 65]).await.unwrap_err();
        assert!(matches!(error, Error::Plc { .. }) && !error.may_have_executed(), "{error:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_part_of_a_write_is_in_doubt_and_not_retried() {
    let bench = bench(Framing::Ascii);
    bench.faults.add_rule(Rule::new(Fault::DropReply).command(Code::WriteDiscretes).skip(1).times(1));
    let error = bench.station.write_discretes(discrete!("M0"), &[true; 600]).await.unwrap_err();
    // After 256 discretes in one request and 32 in a mixed write.
    let Error::PartlyWritten { written: 288, count: 600, source, .. } = error else { panic!("{error:?}") };
    assert!(matches!(*source, Error::Timeout { .. }) && source.may_have_executed(), "{source:?}");
    assert_eq!(bench.plc.read(discrete!("M543")), true.into(), "it has been written");
    assert_eq!(bench.plc.read(discrete!("M544")), false.into());
    assert_eq!(bench.faults.log().writes(), 3);
}

#[tokio::test(start_paused = true)]
async fn a_part_of_a_read_is_retried_alone_or_fails_the_read() {
    let bench = bench(Framing::Binary);
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::ReadRegisters).skip(1).times(1));
    assert_eq!(bench.station.read_registers(register!("R0"), 150).await.unwrap().len(), 150);
    let reads = bench.requests().into_iter().filter(|request| matches!(request, Request::ReadRegisters(_)));
    assert_eq!(reads.count(), 4, "three, and one again");

    bench.faults.set_rules([Rule::new(Fault::Error(ErrorCode::IllegalAddress)).element(register!("R64"))]);
    let error = bench.station.read_registers(register!("R0"), 150).await.unwrap_err();
    assert!(matches!(error, Error::Plc { .. }), "{error:?}");
}

#[tokio::test(start_paused = true)]
async fn each_request_of_a_long_read_has_its_own_deadline() {
    let bench = bench(Framing::Ascii);
    let slow = Duration::from_millis(80);
    bench.faults.add_rule(Rule::new(Fault::Delay { min: slow, max: slow }));
    let station = bench.station.with_options(CallOptions::new().with_call_timeout(slow * 5 / 2));
    let states = station.read_discretes(Discrete::new(Symbol::S, 0).unwrap(), 1000).await.unwrap();
    // The check of the new connection belongs to the first call. Each request has its own deadline.
    assert_eq!((states.len(), bench.faults.log().arrivals()), (1000, 5));
}

#[tokio::test(start_paused = true)]
async fn a_read_into_a_buffer_puts_each_value_in_its_place() {
    for framing in FRAMINGS {
        let Bench { plc, faults, station } = bench(framing);
        for address in 0..300 {
            plc.write(Register::r(address), address + 1).unwrap();
            plc.write(Discrete::new(Symbol::M, address).unwrap(), address % 3 == 0).unwrap();
        }
        for count in [1, 63, 64, 65, 128, 200] {
            let mut values = vec![0xAAAA; count];
            station.read_registers_into(register!("R0"), &mut values).await.unwrap();
            assert!(values.iter().copied().eq(1..=count as u16), "{framing}, {count}");
        }
        let mut states = [true; 300];
        station.read_discretes_into(discrete!("M0"), &mut states).await.unwrap();
        assert!(states.into_iter().eq((0..300).map(|n| n % 3 == 0)), "{framing}");

        // The third request is refused. The buffer is unspecified then, but has no value of another
        // register.
        let in_place = |values: &[u16]| (1..).zip(values).all(|(own, &value)| value == own || value == 0xAAAA);
        faults.set_rules([Rule::new(Fault::Error(ErrorCode::IllegalAddress)).element(register!("R128"))]);
        let mut values = [0xAAAA; 200];
        let error = station.read_registers_into(register!("R0"), &mut values).await.unwrap_err();
        assert!(matches!(error, Error::Plc { .. }), "{error:?}");
        assert!(in_place(&values) && values[127..] == [0xAAAA; 73], "{framing}: {values:?}");

        // The same after the future is dropped.
        faults.set_rules([Rule::new(Fault::Ignore).element(register!("R64"))]);
        let mut values = [0xAAAA; 100];
        let dropped =
            tokio::time::timeout(Duration::from_millis(100), station.read_registers_into(register!("R0"), &mut values));
        assert!(dropped.await.is_err());
        assert!(in_place(&values) && values[64..] == [0xAAAA; 36], "{framing}: {values:?}");

        faults.set_rules([]);
        faults.log().clear();
        assert!(matches!(station.read_registers_into(register!("R0"), &mut []).await, Err(Error::Invalid(_))));
        assert!(matches!(station.read_registers_into(register!("R65535"), &mut [0; 2]).await, Err(Error::Invalid(_))));
        assert_eq!(faults.log().arrivals(), 0, "nothing is sent");
    }
}
