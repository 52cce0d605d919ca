//! Plans read from a simulated PLC: values of the tags, and errors of the requests.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use fatek::capabilities::Support;
use fatek::command::{Code, Request, Value};
use fatek::endpoint::{InStepSettings, SerialSettings};
use fatek::plan::{PlanReadings, ReadRequest, Reply};
use fatek::sim::fault::{Arrival, LogEntry};
use fatek::sim::{self, Bus, Fault, Faults, Line, Model, Plc, Rule};
use fatek::tag::{Assignment, Tag, TagValue};
use fatek::wire::Framing;
use fatek::{Capabilities, CostModel, Element, Error, ErrorCode, Limits, Link, Plan, Station, element};

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// Content of the PLC, as tags of every kind.
const CONTENT: [&str; 12] = [
    "R0-R4=1,2,3,4,65535",
    "R8:f32=-500.125",
    "R20-R29:text=\"two words, é\\n\"",
    "R40-R41:text-hi=Hi",
    "R45-R46:i16*0.1-40=21.5,-40.1",
    "DR50:i32=-70000",
    "DR52:u32*0.001=4294967.295",
    "D7:hex=0xBEEF",
    "D100:f32*0.5+3=4.25",
    "M3-M5=1,0,1",
    "WM16=0x8001",
    "RT5=9",
];

struct Bench {
    faults: Faults,
    station: Station,
    tags: Vec<Tag>,
    values: Vec<Vec<TagValue>>,
}

/// Creates a PLC with this content, whose area `D` ends at D3839.
fn bench(framing: Framing) -> Bench {
    bench_with(framing, InStepSettings::new())
}

fn bench_with(framing: Framing, in_step: InStepSettings) -> Bench {
    let (plc, faults) = (Plc::with_model(Model::default().last(element!("D3839"))), Faults::new(1));
    let held = CONTENT.map(|text| text.parse::<Assignment>().unwrap());
    for (element, value) in held.iter().flat_map(|held| held.tag().elements().zip(held.encode())) {
        plc.write(element, value).unwrap();
    }
    let bus = Bus::new().with_station(1, plc).unwrap().with_faults(faults.clone());
    let builder = Link::connector_builder("in memory", framing, sim::connector(bus, framing));
    let link = builder.response_timeout(Duration::from_millis(100)).retries(0).in_step(in_step).build();
    Bench {
        faults,
        station: link.station(1).unwrap(),
        tags: held.iter().map(Assignment::tag).collect(),
        values: held.iter().map(|held| held.values().to_vec()).collect(),
    }
}

fn model(framing: Framing) -> CostModel {
    CostModel::network(framing, Duration::from_millis(5))
}

fn values(readings: &PlanReadings<'_, Error>, number: usize) -> Vec<TagValue> {
    readings.tag(number).unwrap().unwrap()
}

#[tokio::test(start_paused = true)]
async fn tags_of_every_kind_are_read_by_runs_and_by_mixed_reads() {
    for framing in FRAMINGS {
        for limits in [Limits::new(), Limits::new().mixed_reads(false), Limits::new().max_registers(4).unwrap()] {
            // Without duplicates no check separates equal requests, so only the requests are
            // counted.
            let bench = bench_with(framing, InStepSettings::new().with_copies(0).unwrap());
            let plan = Plan::builder(model(framing)).limits(limits).tags(bench.tags.clone()).build().unwrap();
            let readings = plan.read(&bench.station).await;
            for (n, held) in bench.values.iter().enumerate() {
                assert_eq!(values(&readings, n), *held, "{framing}, {}", bench.tags[n]);
            }
            let sent = bench.faults.log().entries();
            let check = sent[0].request().map(Request::code);
            assert_eq!(check, Some(Code::LoopBack), "of the new connection");
            assert_eq!(sent.len() - 1, plan.requests().len(), "one request each, and nothing besides");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_refused_request_fails_only_its_own_tags() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        let missing = ["D3840-D3841:text", "D3843:i16*0.1"].map(|tag| tag.parse().unwrap());
        let limits = Limits::new().mixed_reads(false);
        let builder = Plan::builder(model(framing)).limits(limits).tags(bench.tags.clone());
        let plan = builder.tags(missing).build().unwrap();
        let readings = plan.read(&bench.station).await;
        for (n, held) in bench.values.iter().enumerate() {
            assert_eq!(values(&readings, n), *held, "{framing}, {}", bench.tags[n]);
        }
        for n in [bench.tags.len(), bench.tags.len() + 1] {
            let error = readings.tag(n).unwrap().unwrap_err();
            assert!(matches!(error, Error::Plc { error: ErrorCode::IllegalAddress, .. }), "{error}");
        }
        let failed: Vec<_> = readings.errors().map(|(n, _)| plan.requests()[n].request().to_string()).collect();
        assert_eq!(failed, ["46 D3840-D3843"]);
        assert_eq!(readings.iter().filter(|(_, values)| values.is_err()).count(), 2);
    }
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_request_fails_only_its_own_tags() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        bench.faults.add_rule(Rule::new(Fault::Ignore).elements(element!("R20"), 1));
        let limits = Limits::new().mixed_reads(false).max_registers(16).unwrap();
        let plan = Plan::builder(model(framing)).limits(limits).tags(bench.tags.clone()).build().unwrap();
        let readings = plan.read(&bench.station).await;
        let failed: Vec<usize> = readings.errors().map(|(n, _)| n).collect();
        let [failed] = failed[..] else { panic!("{failed:?}") };
        assert_eq!(plan.requests()[failed].request().to_string(), "46 R20-R29");
        for (n, held) in bench.values.iter().enumerate() {
            match readings.tag(n).unwrap() {
                Ok(values) => assert_eq!(values, *held, "{framing}, {}", bench.tags[n]),
                Err(error) => {
                    assert_eq!(bench.tags[n].to_string(), "R20-R29:text");
                    assert!(matches!(error, Error::Timeout { code: Code::ReadRegisters, .. }), "{error}");
                }
            }
        }
        assert!(readings.tag(2).unwrap().is_err());
    }
}

/// The registers of a text change between two requests. A text from both would mix two values.
#[tokio::test(start_paused = true)]
async fn a_text_tag_comes_from_a_single_reply() {
    for framing in FRAMINGS {
        let bench = bench(framing);
        let tags: Vec<Tag> = ["R0-R39", "R30-R79:text", "R60-R119"].map(|tag| tag.parse().unwrap()).into();
        let plan = Plan::builder(model(framing)).tags(tags.clone()).build().unwrap();
        plan.read(&bench.station).await;
        let whole = |entry: &LogEntry| match &entry.arrival {
            Arrival::Request { request: Request::ReadRegisters(read), .. } => {
                let first = usize::from(read.first().address());
                first <= 30 && first + read.count() >= 80
            }
            _ => false,
        };
        assert!(plan.requests().len() > 1 && bench.faults.log().entries().iter().any(whole), "{}", plan.explain());
        // Each request is answered with its own letter, so the text must be of one letter.
        let answer = |n: u16, request: &ReadRequest| {
            let word = 0x4141 + n * 0x0101;
            let value = |element: &Element| match element {
                Element::Register32(_) => Value::DWord(u32::from(word) << 16 | u32::from(word)),
                _ => Value::Word(word),
            };
            match request {
                ReadRequest::Registers(read) => Reply::Words(vec![word; read.count()]),
                ReadRequest::Mixed(read) => Reply::Mixed(read.elements().iter().map(value).collect()),
                other => panic!("{other}"),
            }
        };
        let replies = (0..).zip(plan.requests()).map(|(n, planned)| Ok::<_, Error>(answer(n, planned.request())));
        let readings = plan.scatter(replies).unwrap();
        let text = values(&readings, 1);
        let [TagValue::Text(text)] = &text[..] else { panic!("{text:?}") };
        assert!(text.len() == 100 && text.chars().all(|c| text.starts_with(c)), "{text}");
    }
}

/// Before: an attempt to connect for each of the four requests.
#[tokio::test(start_paused = true)]
async fn a_plan_without_a_connection_tries_one_request() {
    let attempts = Arc::new(AtomicU32::new(0));
    let counted = attempts.clone();
    let refused = move || {
        counted.fetch_add(1, Ordering::Relaxed);
        std::future::ready(Err::<tokio::io::Empty, _>(io::Error::from(io::ErrorKind::ConnectionRefused)))
    };
    let link = Link::connector_builder("nowhere", Framing::Ascii, refused).fail_fast(true).retries(0).build();
    let tags = ["R0-R63", "R1000-R1063", "D0-D63", "M0-M255"].map(|text| text.parse::<Tag>().unwrap());
    let plan = Plan::builder(model(Framing::Ascii)).tags(tags).build().unwrap();
    assert_eq!(plan.requests().len(), 4);
    let station = link.station(1).unwrap();
    let readings = plan.read(&station).await;
    assert!(readings.iter().all(|(_, values)| values.is_err_and(Error::is_connect)));
    assert_eq!(attempts.load(Ordering::Relaxed), 1);
}

/// Replies of one shape in a row: the link sends checks and other spellings, which the plan has counted.
#[tokio::test(start_paused = true)]
async fn the_time_of_a_plan_has_the_checks_of_the_link() {
    let sets: [(&[&str], Limits); 6] = [
        (&["R0", "R500", "R1000"], Limits::new().mixed_reads(false)),
        (&["R0-R1", "R500-R501", "R1000-R1001", "D0-D1"], Limits::new().max_mixed(2).unwrap()),
        (&["X0-X255", "Y0-Y255", "M0-M255", "S0-S255"], Limits::new().words_of_discretes(false)),
        (&["R0-R299"], Limits::new()),
        (&["R0-R299", "D0-D199"], Limits::new().mixed_reads(false)),
        (&["R0-R63", "D0-D63", "R500-R563", "D500-D563"], Limits::new()),
    ];
    let mut with_proofs = 0;
    for (baud, framing) in [(9600, Framing::Ascii), (19_200, Framing::Binary)] {
        let settings = SerialSettings::new(framing).with_baud(baud).unwrap();
        for (texts, limits) in &sets {
            let tags = texts.iter().map(|text| text.parse().unwrap());
            let plan = Plan::builder(CostModel::serial(settings, framing)).limits(limits.clone()).tags(tags).build();
            let plan = plan.unwrap();
            let response = Duration::from_millis(5);
            let faults = Faults::new(1).line(Line::new(baud).response_time(response, response));
            let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_faults(faults);
            let builder = Link::connector_builder("in memory", framing, sim::connector(bus, framing));
            let link = builder.serial_line(settings).response_timeout(Duration::from_secs(2)).build();
            let station = link.station(1).unwrap();
            if limits.clone().mixed_reads(false) == *limits {
                station.set_capabilities(Capabilities::new().with_command(Code::ReadMixed, Support::Refused));
            } else if limits.clone().max_mixed(2).unwrap() == *limits {
                station.set_capabilities(Capabilities::new().with_max_mixed(2).unwrap());
            }
            // The first one opens the connection. The copy window passes before the second one.
            assert_eq!(plan.read(&station).await.errors().count(), 0);
            tokio::time::sleep(Duration::from_secs(1)).await;
            let start = tokio::time::Instant::now();
            assert_eq!(plan.read(&station).await.errors().count(), 0);
            let took = start.elapsed();
            // Timers have whole milliseconds, and nothing waits for the last frame gap.
            let exchanges = u64::try_from(2 * plan.requests().len()).unwrap();
            let allowed = plan.time() / 200 + Duration::from_millis(4 + exchanges);
            assert!(took.abs_diff(plan.time()) <= allowed, "{took:?}: {}", plan.explain());
            with_proofs += usize::from(!plan.proof_time().is_zero());
        }
    }
    assert_eq!(with_proofs, 6, "half of the plans have requests of one shape");
}
