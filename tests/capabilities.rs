//! Capabilities of simulated PLCs: found by a probe, declared, and learned from refusals.
#![cfg(feature = "sim")]

use std::time::Duration;

use bytes::BytesMut;
use fatek::capabilities::{Support, WordSupport};
use fatek::command::{Code, InvalidRequest, Request, Value, encode_refusal, encode_reply};
use fatek::poll::{PollTag, Poller, ScanClass, StationPolling};
use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
use fatek::wire::{Codec, Framing, Received, Side};
use fatek::{Capabilities, Error, ErrorCode, Limits, Link, Plan, Station, Symbol, Tag, discrete, element, register};
use futures::StreamExt as _;
use tokio::io::{AsyncWriteExt as _, DuplexStream};
use tokio_util::codec::Framed;

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

            let refusals = bench.station.stats().refusals;
            bench.plc.write(element!("R63"), 4711_u16).unwrap();
            bench.plc.write(element!("M255"), true).unwrap();
            let (discretes, registers): (Vec<bool>, Vec<u16>) =
                bench.station.read(("M0-M255", "R0-R63")).await.unwrap();
            assert_eq!((discretes[255], registers[63]), (true, 4711));
            assert_eq!(bench.station.read_registers(register!("R0"), 64).await.unwrap()[63], 4711);
            bench.station.write_registers(register!("R100"), &[3; 64]).await.unwrap();
            // A probe does not write, so a mixed write is refused once.
            let refused = if error == ErrorCode::IllegalValue { 0 } else { 1 };
            for _ in 0..3 * refused {
                bench.station.write_all([("R0", 1), ("R100", 2)]).await.unwrap();
            }
            // A refused loop-back shows that all earlier replies have come: it is sent all the same.
            assert_eq!(bench.station.stats().refusals, refusals + refused, "{framing}, {error}");
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

/// 4E is found as unanswered, although the link needs it for each new connection. A probe that fails leaves
/// nothing behind.
#[tokio::test(start_paused = true)]
async fn a_probe_of_a_device_that_does_not_answer_the_loop_back() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::LoopBack));
        let found = bench.station.probe().await.unwrap();
        assert_eq!(found.command(Code::LoopBack), Support::Unanswered);
        assert_eq!((found.command(Code::ReadMixed), found.max_registers()), (Support::Supported, Some(64)));
        assert_eq!(bench.station.read_registers(register!("R0"), 200).await.unwrap().len(), 200);
    }
    let declared = Capabilities::new().with_command(Code::WriteMixed, Support::Refused).with_answers_broadcasts(false);
    let bench = bench(Framing::Ascii);
    bench.faults.add_rule(Rule::new(Fault::Ignore));
    bench.station.set_capabilities(declared.clone());
    assert!(bench.station.probe().await.is_err());
    assert_eq!(bench.station.capabilities(), declared);
    bench.faults.set_rules([]);
    tokio::time::sleep(Duration::from_secs(120)).await;
    let found = bench.station.probe().await.unwrap();
    assert_eq!((found.command(Code::WriteMixed), found.answers_broadcasts()), (Support::Refused, Some(false)));
    assert_eq!(found.command(Code::LoopBack), Support::Supported);
}

/// Holds the first reply that has R0.
async fn hold(address: u16, held: &mut bool) {
    if address == 0 && !std::mem::replace(held, true) {
        tokio::time::sleep(Duration::from_millis(2500)).await;
    }
    tokio::time::sleep(Duration::from_millis(5)).await;
}

/// A device whose register n holds 1000 + n, and that knows 46 and 48 only. It answers one request after the
/// other; the first one of R0 takes 2.5 s. `silent`: it does not answer 4E.
async fn device(stream: DuplexStream, framing: Framing, silent: bool) {
    let mut stream = Framed::new(stream, Codec::new(framing, Side::Plc));
    let mut held = false;
    while let Some(Ok(received)) = stream.next().await {
        let Received::Frame(frame) = received else { continue };
        let mut reply = BytesMut::new();
        let value = |element: fatek::Element| 1000 + element.address();
        match Request::decode(&frame, framing) {
            Ok(Request::ReadRegisters(read)) => {
                hold(read.first().address(), &mut held).await;
                let first = fatek::Element::from(read.first());
                let values = (0..read.count()).map(|n| value(first.nth(n).unwrap())).collect();
                encode_reply(&read, Ok(&values), framing, frame.station, &mut reply);
            }
            Ok(Request::ReadMixed(read)) => {
                hold(read.elements()[0].address(), &mut held).await;
                let values = read.elements().iter().map(|element| Value::Word(value(*element))).collect();
                encode_reply(&read, Ok(&values), framing, frame.station, &mut reply);
            }
            Ok(Request::LoopBack(_)) if silent => {}
            _ => encode_refusal(frame.command, ErrorCode::NotSupported, framing, frame.station, &mut reply),
        }
        if stream.get_mut().write_all(&reply).await.is_err() {
            return;
        }
    }
}

/// The reply to a read that was given up comes after the quiet time, and before the reply to anything asked
/// later. Without a command that is answered before the silence, it was the value of the next read: R500 was
/// 1000.
#[tokio::test(start_paused = true)]
async fn no_late_reply_is_the_value_of_another_read() {
    for (silent, support) in [(false, Support::Refused), (true, Support::Unanswered)] {
        for framing in FRAMINGS {
            let (ours, theirs) = tokio::io::duplex(4096);
            tokio::spawn(device(theirs, framing, silent));
            let link = Link::stream_builder(ours, framing).response_timeout(Duration::from_secs(1)).retries(0).build();
            let station = link.station(1).unwrap();
            station.set_capabilities(Capabilities::new().with_command(Code::LoopBack, support));
            let read = async |n: u16| {
                let first = format!("R{n}").parse::<fatek::Register>().unwrap();
                station.read_registers(first, 1).await.map(|values| values[0])
            };
            assert!(matches!(read(0).await, Err(Error::Timeout { .. })));
            let mut values = 0;
            for _ in 0..20 {
                match read(500).await {
                    Ok(value) => {
                        assert_eq!(value, 1500, "{framing}, {support}");
                        values += 1;
                    }
                    Err(Error::Timeout { .. } | Error::OutOfStep { .. } | Error::Offline { .. }) => {
                        tokio::time::sleep(Duration::from_millis(100)).await;
                    }
                    Err(error) => panic!("{error}"),
                }
            }
            assert!(values > 10, "{framing}, {support}: {values}");
        }
    }
}

/// No request has a part of a value. Before, a value was torn, and a debug assertion failed.
#[tokio::test(start_paused = true)]
async fn values_of_several_registers_are_written_whole() {
    for framing in FRAMINGS {
        for most in [2, 3, 5, 21, 63] {
            let bench = bench(framing);
            bench.station.set_capabilities(Capabilities::new().with_max_registers(most).unwrap());
            for code in [Code::WriteRegisters, Code::WriteMixed] {
                let refusal = Rule::new(Fault::Error(ErrorCode::IllegalAddress)).command(code);
                bench.faults.add_rule(refusal.skip(1));
            }
            let values: Vec<f32> = (0..64_u8).map(f32::from).collect();
            let error = bench.station.write("R0-R127:f32", values.as_slice()).await.unwrap_err();
            let Error::PartlyWritten { written, count: 64, .. } = error else { panic!("{error}") };
            assert!(written > 0 && written < 64, "{most}");
            bench.faults.set_rules([]);
            let doubles: Vec<f64> = (0..16_u8).map(f64::from).collect();
            let written = bench.station.write("DR200-DR262:f64", doubles.as_slice()).await;
            if most < 4 {
                // A value takes four registers. Before, it was sent whole.
                let is_refused = matches!(written, Err(Error::Invalid(InvalidRequest::ValueTooLong { count: 2, .. })));
                assert!(is_refused, "{most}: {written:?}");
            } else {
                written.unwrap();
                let read: Vec<f64> = bench.station.read("DR200-DR262:f64").await.unwrap();
                assert_eq!(read, doubles);
            }
            for entry in bench.faults.log().entries() {
                if let Some(fatek::command::Request::WriteRegisters(write)) = entry.request() {
                    assert!(write.values().len() <= most && write.values().len().is_multiple_of(2), "{most}");
                }
                if let Some(fatek::command::Request::WriteRegisters32(write)) = entry.request() {
                    assert!(write.values().len().is_multiple_of(2), "{most}");
                }
            }
        }
    }
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

/// Before, a spelling that was longer than the PLC accepts was refused, and cost a check.
#[tokio::test(start_paused = true)]
async fn no_spelling_is_longer_than_declared() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        for (code, most) in [(Code::ReadRegisters, 8), (Code::ReadDiscretes, 20), (Code::ReadMixed, 4)] {
            bench.faults.add_rule(Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(code).longer_than(most));
        }
        let declared = Capabilities::new().with_max_registers(8).unwrap().with_max_points(20).unwrap();
        bench.station.set_capabilities(declared.with_max_mixed(4).unwrap());
        for _ in 0..3 {
            // Each element behind and before has been answered.
            for first in [register!("R0"), register!("R8"), register!("R16"), register!("R8")] {
                bench.station.read_registers(first, 8).await.unwrap();
                bench.station.read_registers(first, 3).await.unwrap();
            }
            for first in [discrete!("M0"), discrete!("M20"), discrete!("M40"), discrete!("M20")] {
                bench.station.read_discretes(first, 20).await.unwrap();
            }
            bench.station.read_registers(register!("R0"), 3).await.unwrap();
            bench.station.read_registers(register!("R500"), 3).await.unwrap();
        }
        assert!(bench.faults.rules().iter().all(|rule| rule.times_applied() == 0), "{framing}");
        let spellings = bench.station.stats().spellings;
        assert!(spellings.mixed + spellings.one_more > 0, "{framing}: {spellings:?}");
    }
}

/// Polls until the poller has learned the lengths of a PLC that has no mixed reads.
async fn learn_by_polling(bench: &Bench) {
    let refusal = || Rule::new(Fault::Error(ErrorCode::IllegalValue));
    bench.faults.add_rule(refusal().command(Code::ReadRegisters).longer_than(21));
    bench.faults.add_rule(refusal().command(Code::ReadDiscretes).longer_than(100));
    bench.faults.add_rule(refusal().command(Code::ReadMixed));
    let mut poller = Poller::builder().build();
    let polling = StationPolling::new().limits(Limits::new().words_of_discretes(false));
    let polled = poller.handle().station_with(&bench.station, polling).unwrap();
    let tag = |text: &str| PollTag::from(text.parse::<Tag>().unwrap());
    // Of different classes, so that each is planned alone.
    polled.add(ScanClass::every(Duration::from_secs(1)), [tag("R0-R199")]).unwrap();
    polled.add(ScanClass::every(Duration::from_secs(2)), [tag("M0-M255")]).unwrap();
    let scattered = (0..40).map(|n| tag(&format!("D{}", n * 90)));
    polled.add(ScanClass::every(Duration::from_secs(3)), scattered).unwrap();
    let learned = async {
        tokio::time::sleep(Duration::from_secs(60)).await;
    };
    tokio::select! {
        () = learned => {}
        () = async { while poller.next().await.is_some() {} } => panic!("the poller ended"),
    }
    poller.close().await;
    tokio::time::sleep(Duration::from_secs(1)).await;
}

/// Before, only the poller itself knew the lengths that it had learned.
#[tokio::test(start_paused = true)]
async fn what_a_poller_learns_is_known_of_the_station() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        learn_by_polling(&bench).await;
        let known = bench.station.capabilities();
        assert!(known.max_registers().is_some_and(|max| (11..=21).contains(&max)), "{framing}: {known:?}");
        assert!(known.max_points().is_some_and(|max| (50..=100).contains(&max)), "{framing}: {known:?}");
        assert_eq!(known.command(Code::ReadMixed), Support::Refused, "{framing}");
        // A plan for the station keeps to them from its first request on.
        let refusals = bench.station.stats().refusals;
        let tags = ["R500-R599", "M500-M755"].map(|tag| tag.parse::<Tag>().unwrap());
        let plan = Plan::builder_for(&bench.station).tags(tags).build().unwrap();
        assert_eq!(plan.read(&bench.station).await.errors().count(), 0);
        assert_eq!(bench.station.stats().refusals, refusals, "{framing}");
        tokio::time::sleep(Duration::from_secs(600)).await;
        assert_eq!(bench.station.capabilities().max_registers(), None, "tried again after ten minutes");
    }
}

/// A refused read may be one of its place, and says nothing of writes. Before, the length that a poller had
/// learned divided the writes and long reads of all users: a write of 64 registers was sent as requests of 16,
/// and so was a read, and a write of 256 discretes as four requests.
#[tokio::test(start_paused = true)]
async fn a_learned_length_divides_no_write_and_no_read_of_one_request() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        learn_by_polling(&bench).await;
        bench.faults.set_rules([]);
        bench.faults.log().clear();
        bench.station.write_registers(register!("R100"), &[3; 64]).await.unwrap();
        bench.station.write_discretes(discrete!("M100"), &[true; 256]).await.unwrap();
        assert_eq!(bench.station.read_registers(register!("R300"), 64).await.unwrap(), [0; 64]);
        let entries = bench.faults.log().entries();
        let lengths: Vec<usize> = entries
            .iter()
            .filter_map(|entry| {
                let request = entry.request()?;
                if let Request::WriteRegisters(write) = request {
                    Some(write.values().len())
                } else if let Request::WriteDiscretes(write) = request {
                    Some(write.states().len())
                } else if let Request::ReadRegisters(read) = request {
                    Some(read.count())
                } else {
                    None
                }
            })
            .collect();
        assert_eq!(lengths, [64, 256, 64], "{framing}");
    }
}

/// Before, `Station::read` of a text failed for ten minutes after a poller had met refusals, and so did a
/// plan of tags of one scan: "no single request can read that".
#[tokio::test(start_paused = true)]
async fn no_read_fails_for_what_a_poller_has_learned() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        learn_by_polling(&bench).await;
        bench.faults.set_rules([]);
        bench.station.write("R100-R129:text", "a text of thirty registers").await.unwrap();
        let text: String = bench.station.read("R100-R129:text").await.unwrap();
        assert_eq!(text, "a text of thirty registers", "{framing}");
        let tags = ["R100", "D700", "M3"].map(|tag| tag.parse::<Tag>().unwrap());
        let plan = Plan::builder_for(&bench.station).one_scan(tags).build().unwrap();
        assert_eq!(plan.requests().len(), 1);
        assert_eq!(plan.read(&bench.station).await.errors().count(), 0, "{framing}");
        // The caller's own limits stay.
        let plan = Plan::builder_for(&bench.station).limits(Limits::new().mixed_reads(false)).one_scan(tags).build();
        assert!(plan.is_err());
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
