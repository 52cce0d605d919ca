//! Capabilities of simulated PLCs: found by a probe, declared, and learned from refusals.
#![cfg(feature = "sim")]

use std::time::Duration;

use fatek::capabilities::{Support, WordSupport};
use fatek::command::Code;
use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
use fatek::wire::Framing;
use fatek::{Capabilities, Error, ErrorCode, Limits, Link, Plan, Station, Symbol, Tag, element, register};

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// Commands that a well-known server does not know.
const LACKING: [Code; 4] = [Code::LoopBack, Code::ReadMixed, Code::WriteMixed, Code::ReadDetailedStatus];

struct Bench {
    plc: Plc,
    faults: Faults,
    station: Station,
}

fn bench(framing: Framing) -> Bench {
    let (plc, faults) = (Plc::new(), Faults::new(1));
    for (counter, value) in [(element!("DRC200"), 7), (element!("DRC201"), 8), (element!("DRC202"), 9)] {
        plc.write(counter, 100_000_u32 + value).unwrap();
    }
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let builder = Link::connector_builder("in memory", framing, sim::connector(bus, framing));
    let link = builder.response_timeout(Duration::from_millis(100)).retries(0).build();
    Bench { plc, faults, station: link.station(1).unwrap() }
}

/// A PLC that refuses some commands, and requests that are longer than these.
fn limited(framing: Framing, error: ErrorCode) -> Bench {
    let bench = bench(framing);
    for code in LACKING {
        bench.faults.add_rule(Rule::new(Fault::Error(error)).command(code));
    }
    bench.faults.add_rule(Rule::new(Fault::Error(error)).command(Code::ReadRegisters).longer_than(21));
    bench.faults.add_rule(Rule::new(Fault::Error(error)).command(Code::ReadDiscretes).longer_than(100));
    bench.faults.add_rule(Rule::new(Fault::Error(error)).words_of_discretes());
    bench
}

#[tokio::test(start_paused = true)]
async fn a_probe_finds_what_a_plc_supports() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        let found = bench.station.probe().await.unwrap();
        for code in [
            Code::ReadStatus,
            Code::ReadDisabled,
            Code::ReadDiscretes,
            Code::ReadRegisters,
            Code::ReadMixed,
            Code::LoopBack,
            Code::ReadDetailedStatus,
        ] {
            assert_eq!(found.command(code), Support::Supported, "{code}");
        }
        // A probe only reads.
        for code in [Code::ControlPlc, Code::ControlDiscrete, Code::WriteDiscretes, Code::WriteRegisters] {
            assert_eq!(found.command(code), Support::Unknown, "{code}");
        }
        assert!(bench.faults.log().changes(1).is_empty(), "{framing}");
        assert_eq!((found.max_registers(), found.max_points(), found.max_mixed()), (Some(64), Some(256), Some(64)));
        for symbol in [Symbol::X, Symbol::Y, Symbol::M, Symbol::S] {
            assert_eq!(found.words_of(symbol), WordSupport::MultiplesOf8, "{symbol}");
        }
        // A simulated PLC refuses several of these counters in one request.
        assert_eq!(found.counter_step(), None);
        assert_eq!(found.answers_broadcasts(), None);
        assert_eq!(bench.station.capabilities(), found);
    }
}

#[tokio::test(start_paused = true)]
async fn a_probe_finds_what_a_plc_refuses_and_everything_keeps_to_it() {
    for error in [ErrorCode::IllegalFormat, ErrorCode::NotSupported, ErrorCode::IllegalValue] {
        for framing in FRAMINGS {
            let bench = limited(framing, error);
            let found = bench.station.probe().await.unwrap();
            for code in [Code::LoopBack, Code::ReadMixed, Code::ReadDetailedStatus] {
                assert_eq!(found.command(code), Support::Refused, "{code}");
            }
            assert_eq!((found.max_registers(), found.max_points(), found.max_mixed()), (Some(21), Some(100), None));
            assert_eq!(found.words_of(Symbol::M), WordSupport::Refused);

            let (refusals, checks) = {
                let stats = bench.station.stats();
                (stats.refusals, stats.refused_checks)
            };
            bench.plc.write(element!("R63"), 4711_u16).unwrap();
            bench.plc.write(element!("M255"), true).unwrap();
            let (discretes, registers): (Vec<bool>, Vec<u16>) =
                bench.station.read(("M0-M255", "R0-R63")).await.unwrap();
            assert_eq!((discretes[255], registers[63]), (true, 4711));
            assert_eq!(bench.station.read_registers(register!("R0"), 64).await.unwrap()[63], 4711);
            bench.station.write_registers(register!("R100"), &[3; 64]).await.unwrap();
            let stats = bench.station.stats();
            assert_eq!((stats.refusals, stats.refused_checks), (refusals, checks), "{framing}, {error}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_probe_fails_if_nothing_is_answered_and_declares_nothing() {
    let bench = bench(Framing::Ascii);
    bench.faults.add_rule(Rule::new(Fault::Ignore));
    assert!(matches!(bench.station.probe().await, Err(Error::Timeout { .. })));
    assert_eq!(bench.station.capabilities(), Capabilities::new());
}

/// A missing answer is none of a station that is off: R0 is answered behind it.
#[tokio::test(start_paused = true)]
async fn a_command_without_an_answer_is_found() {
    let bench = bench(Framing::Ascii);
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::ReadDetailedStatus));
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::ReadRegisters).longer_than(40));
    let found = bench.station.probe().await.unwrap();
    assert_eq!(found.command(Code::ReadDetailedStatus), Support::Unanswered);
    assert_eq!(found.max_registers(), Some(40));
}

/// Before, no call was ever answered: the check of the new connection was repeated without end.
#[tokio::test(start_paused = true)]
async fn a_device_that_does_not_answer_the_loop_back_is_used_if_declared() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::LoopBack));
        assert!(bench.station.read_registers(register!("R0"), 1).await.is_err());
        let declared = Capabilities::new().with_command(Code::LoopBack, Support::Unanswered);
        bench.station.set_capabilities(declared);
        for n in 0..5_u16 {
            bench.plc.write(element!("R0"), n).unwrap();
            let value = loop {
                // The station was offline after three timeouts, until its next probe.
                match bench.station.read_registers(register!("R0"), 1).await {
                    Ok(values) => break values[0],
                    Err(Error::Offline { .. }) => tokio::time::sleep(Duration::from_millis(500)).await,
                    Err(error) => panic!("{error}"),
                }
            };
            assert_eq!(value, n);
        }
        // It is probed by another command than 4E.
        bench.faults.add_rule(Rule::new(Fault::Ignore));
        while !matches!(bench.station.read_status().await, Err(Error::Offline { .. })) {}
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::LoopBack)]);
        tokio::time::sleep(Duration::from_secs(120)).await;
        bench.station.read_status().await.unwrap();
    }
}

/// Before, each call was refused first, and a read of scattered registers failed.
#[tokio::test(start_paused = true)]
async fn refusals_are_learned_by_use_for_ten_minutes() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        bench.faults.add_rule(Rule::new(Fault::Error(ErrorCode::IllegalFormat)).command(Code::ReadMixed));
        bench.faults.add_rule(Rule::new(Fault::Error(ErrorCode::IllegalFormat)).words_of_discretes());
        bench.plc.write(element!("R700"), 7_u16).unwrap();
        let scattered = ["R0", "R300", "R700", "D5"];
        let read = async || {
            let values: [u16; 4] = bench.station.read(scattered).await.unwrap();
            assert_eq!(values, [0, 0, 7, 0]);
            let discretes: Vec<bool> = bench.station.read("M0-M255").await.unwrap();
            assert_eq!(discretes, [false; 256]);
            bench.station.stats().refusals
        };
        read().await;
        let refusals = read().await;
        assert!(refusals > 0);
        assert_eq!(read().await, refusals, "{framing}: learned");
        let known = bench.station.capabilities();
        assert_eq!(known.words_of(Symbol::M), WordSupport::Refused);
        assert_eq!(known.command(Code::ReadMixed), Support::Refused);
        // Other handles of the link, and plans for the station, know it, too.
        let tags = scattered.map(|tag| tag.parse::<Tag>().unwrap());
        let other = bench.station.link().station(1).unwrap();
        let plan = Plan::builder_for(&other).tags(tags).build().unwrap();
        assert_eq!(plan.read(&other).await.errors().count(), 0);
        assert_eq!(bench.station.stats().refusals, refusals);
        tokio::time::sleep(Duration::from_secs(600)).await;
        assert_eq!(bench.station.capabilities().command(Code::ReadMixed), Support::Unknown);
        assert!(read().await > refusals, "tried again");
    }
}

#[test]
fn limits_keep_to_the_known_capabilities() {
    let known = Capabilities::new().with_max_points(10).unwrap().with_max_mixed(5).unwrap();
    assert_eq!(Limits::new().within(&known), Limits::new().max_points(10).unwrap().max_mixed(5).unwrap());
    // Lower limits stay.
    let lower = Limits::new().max_points(3).unwrap().max_mixed(2).unwrap();
    assert_eq!(lower.clone().within(&known), lower);
    let words = |support| Capabilities::new().with_words_of(Symbol::M, support).unwrap();
    assert_eq!(Limits::new().within(&words(WordSupport::MultiplesOf16)), Limits::new().words_at_multiples_of_16(true));
    assert_eq!(Limits::new().within(&Capabilities::new()), Limits::new());
    let error = Capabilities::new().with_words_of(Symbol::T, WordSupport::Refused).unwrap_err();
    assert_eq!(error.to_string(), "T has no words of discretes that plans read: only X, Y, M and S have");
    assert_eq!(
        Capabilities::new().with_max_registers(65).unwrap_err().to_string(),
        "max_registers is 65, and must be 2 to 64"
    );
    assert!(Capabilities::new().with_counter_step(3).is_err());
}
