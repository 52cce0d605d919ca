//! Discretes that a plan reads as bits of words, from a simulated PLC.
#![cfg(feature = "sim")]

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use bytes::BytesMut;
use fatek::command::{Code, Request, encode_refusal};
use fatek::endpoint::{InStepSettings, SerialSettings};
use fatek::sim::{self, Bus, Fault, Faults, Model, Plc, Rule};
use fatek::tag::{Tag, TagValue};
use fatek::wire::{Codec, Framing, Received, Side};
use fatek::{CostModel, Element, Error, ErrorCode, Limits, Link, Plan, Station};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};
use tokio::time::timeout;
use tokio_util::codec::Decoder;

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

struct Bench {
    plc: Plc,
    faults: Faults,
    station: Station,
}

fn bench(framing: Framing, seed: u64) -> Bench {
    let (plc, faults) = (Plc::with_model(Model::largest()), Faults::new(1));
    let mut state = seed;
    for symbol in ["X", "Y", "M", "S"] {
        for address in 0..320 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            plc.write(Element::parse(&format!("{symbol}{address}")).unwrap(), state >> 62 & 1 == 1).unwrap();
        }
    }
    for address in 0..64_u16 {
        plc.write(Element::parse(&format!("R{address}")).unwrap(), address * 257).unwrap();
    }
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let builder = Link::connector_builder("in memory", framing, sim::connector(bus, framing));
    let link = builder.response_timeout(Duration::from_millis(100)).retries(0).build();
    Bench { plc, faults, station: link.station(1).unwrap() }
}

/// The words of discretes are refused, by any command that reads them.
fn refuse_words(bench: &Bench, error: ErrorCode) {
    bench.faults.add_rule(Rule::new(Fault::Error(error)).words_of_discretes());
}

fn tags() -> Vec<Tag> {
    let texts = ["M0-M255", "X5-X90", "Y0", "Y3", "Y9", "S17-S47", "M300", "M302", "WM8", "WM512:i16", "R0-R20", "R40"];
    texts.iter().map(|text| text.parse().unwrap()).collect()
}

/// The values that the PLC holds.
fn held(bench: &Bench, tag: &Tag) -> Vec<TagValue> {
    let raw: Vec<_> = tag.elements().map(|element| bench.plc.read(element)).collect();
    tag.decode(&raw).unwrap()
}

fn plan(framing: Framing, limits: Limits) -> Plan {
    let model = CostModel::network(framing, Duration::from_millis(5));
    Plan::builder(model).limits(limits).tags(tags()).build().unwrap()
}

#[tokio::test(start_paused = true)]
async fn discretes_read_as_words_have_the_values_of_the_plc() {
    for framing in FRAMINGS {
        for seed in 0..20 {
            let bench = bench(framing, seed);
            for limits in [Limits::new(), Limits::new().mixed_reads(false), Limits::new().words_of_discretes(false)] {
                let plan = plan(framing, limits.clone());
                let has_words = plan.requests().iter().any(|request| request.has_words_of_discretes());
                assert_eq!(has_words, limits != Limits::new().words_of_discretes(false));
                let readings = plan.read(&bench.station).await;
                for (tag, values) in readings.iter() {
                    assert_eq!(values.unwrap(), held(&bench, &tag), "{framing}, seed {seed}, {tag}");
                }
            }
        }
    }
}

#[tokio::test(start_paused = true)]
async fn refused_words_are_read_as_discretes_in_the_same_call() {
    let codes = [
        ErrorCode::IllegalAddress,
        ErrorCode::IllegalFormat,
        ErrorCode::IllegalValue,
        ErrorCode::NotSupported,
        ErrorCode::Unknown(0xE),
    ];
    for (framing, code) in FRAMINGS.into_iter().flat_map(|framing| codes.map(|code| (framing, code))) {
        for limits in [Limits::new(), Limits::new().mixed_reads(false)] {
            let bench = bench(framing, 7);
            refuse_words(&bench, code);
            let plan = plan(framing, limits);
            let readings = plan.read(&bench.station).await;
            for (tag, values) in readings.iter() {
                if tag.to_string().starts_with("WM") {
                    assert!(matches!(values, Err(Error::Plc { error, .. }) if *error == code), "{tag}");
                } else {
                    assert_eq!(values.unwrap(), held(&bench, &tag), "{framing}, {code}, {tag}");
                }
            }
            assert!(readings.errors().count() > 0, "the words of the tags");
        }
        let bench = bench(framing, 8);
        refuse_words(&bench, code);
        let values: (Vec<bool>, u16) = bench.station.read(("M0-M255", "R3")).await.unwrap();
        assert_eq!(values.0.len(), 256);
        for (address, value) in values.0.iter().enumerate() {
            let element = Element::parse(&format!("M{address}")).unwrap();
            assert_eq!(bench.plc.read(element), fatek::command::Value::Bit(*value), "M{address}");
        }
    }
}

/// A discrete that the PLC refuses as such has its own error, and the others have their values.
#[tokio::test(start_paused = true)]
async fn a_refused_discrete_has_its_own_error() {
    for framing in FRAMINGS {
        let bench = bench(framing, 9);
        refuse_words(&bench, ErrorCode::IllegalAddress);
        let rule = Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(Code::ReadDiscretes);
        bench.faults.add_rule(rule.elements(Element::parse("M300").unwrap(), 1));
        let tags: Vec<Tag> = ["M0-M255", "M300-M310"].map(|text| text.parse().unwrap()).into();
        let limits = Limits::new().mixed_reads(false);
        let model = CostModel::network(framing, Duration::from_millis(5));
        let plan = Plan::builder(model).limits(limits).tags(tags.clone()).build().unwrap();
        assert_eq!(plan.requests().len(), 1, "{}", plan.explain());
        let readings = plan.read(&bench.station).await;
        assert_eq!(readings.tag(0).unwrap().unwrap(), held(&bench, &tags[0]));
        let error = readings.tag(1).unwrap().unwrap_err();
        assert!(matches!(error, Error::Plc { error: ErrorCode::IllegalValue, .. }), "{error}");
        assert_eq!(readings.errors().map(|(n, _)| n).collect::<Vec<_>>(), [0]);
    }
}

/// Silence says nothing about words: the request is not replaced by others.
#[tokio::test(start_paused = true)]
async fn silence_is_not_a_refusal() {
    let bench = bench(Framing::Ascii, 10);
    bench.faults.add_rule(Rule::new(Fault::Ignore).elements(Element::parse("WM0").unwrap(), 16));
    let model = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let plan = Plan::builder(model).tag("M0-M1023".parse::<Tag>().unwrap()).build().unwrap();
    let readings = plan.read(&bench.station).await;
    assert!(matches!(readings.tag(0).unwrap(), Err(Error::Timeout { .. })));
    let reads = bench.faults.log().entries();
    assert!(
        reads.iter().filter_map(|entry| entry.request().map(Request::code)).all(|code| code != Code::ReadDiscretes)
    );
}

/// A PLC that refuses words of discretes and M256, and sends an unexpected frame behind each reply to a read
/// from M512 on, as late as the next reply.
async fn stray_behind_reads_of_m512(mut line: DuplexStream, reads: Arc<AtomicU32>) {
    let bus = Bus::new().with_station(1, Plc::with_model(Model::largest())).unwrap();
    let (mut codec, mut received, mut stray) = (Codec::new(Framing::Ascii, Side::Plc), BytesMut::new(), false);
    while line.read_buf(&mut received).await.is_ok_and(|count| count > 0) {
        while let Some(item) = codec.decode(&mut received).unwrap() {
            let mut replies = BytesMut::new();
            let Received::Frame(frame) = &item else { panic!("{item:?}") };
            let reads_from = |element: &[u8]| frame.data.ends_with(element);
            if std::mem::replace(&mut stray, reads_from(b"M0512")) {
                reads.fetch_add(1, Ordering::Relaxed);
                replies.extend_from_slice(b"\x0201470FE\x03");
            }
            if frame.data.contains(&b'W') || reads_from(b"M0256") {
                encode_refusal(frame.command, ErrorCode::IllegalAddress, Framing::Ascii, 1, &mut replies);
            } else {
                bus.answer(&item, Framing::Ascii, &mut replies);
            }
            if line.write_all(&replies).await.is_err() {
                return;
            }
        }
    }
}

/// Before: the requests in place of the refused one were repeated without end. They have one mark of the
/// job, and each proof between them allowed as many repetitions again.
#[tokio::test(start_paused = true)]
async fn unexpected_frames_end_a_read_of_refused_words() {
    let (line, plc) = tokio::io::duplex(4096);
    let reads = Arc::new(AtomicU32::new(0));
    tokio::spawn(stray_behind_reads_of_m512(plc, reads.clone()));
    // With duplicates that roam, a proof stands between any two reads.
    let in_step = InStepSettings::default().with_copies(2).unwrap();
    let builder = Link::stream_builder(line, Framing::Ascii).in_step(in_step);
    let link = builder.response_timeout(Duration::from_millis(100)).build();
    // Without proofs, each request is as long as it can be, and one of them begins with M512.
    let model = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii).with_proofs(false);
    let plan = Plan::builder(model).tag("M0-M1023".parse::<Tag>().unwrap()).build().unwrap();
    assert!(plan.requests()[0].has_words_of_discretes());
    let station = link.station(1).unwrap();
    let readings = timeout(Duration::from_secs(60), plan.read(&station)).await.expect("it ends");
    let error = readings.iter().next().unwrap().1.unwrap_err();
    assert!(matches!(error, Error::Duplicates { station: 1, sent: true, .. }), "{error:?}");
    assert_eq!(reads.load(Ordering::Relaxed), 1 + station.options().retries(), "a read and its repetitions");
}
