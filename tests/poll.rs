//! The poller on links to simulated PLCs, as a whole. Its parts have unit tests.
#![cfg(feature = "sim")]

mod roaming;

use std::time::Duration;

use fatek::plan::Limits;
use fatek::poll::{Missed, PollError, PollTag, Poller, Quality, Reason, Sample, ScanClass, StationPolling};
use fatek::sim::fault::DisconnectAt;
use fatek::sim::{self, Bus, Fault, Faults, Model, Plc, Rule};
use fatek::tag::TagValue;
use fatek::wire::Framing;
use fatek::{CallOptions, Link, Station, discrete, element, register};
use futures::{FutureExt, StreamExt};
use tokio::time::{Instant, sleep, timeout};

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds))
}

fn tag(text: &str) -> PollTag {
    PollTag::from(text.parse::<fatek::tag::Tag>().unwrap())
}

fn station(plc: &Plc, faults: &Faults) -> Station {
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let link = Link::connector_builder("in memory", Framing::Ascii, sim::connector(bus, Framing::Ascii)).build();
    let options = CallOptions::new().with_response_timeout(ms(100)).with_retries(0);
    link.station(1).unwrap().with_options(options)
}

async fn next(poller: &mut Poller) -> Sample {
    let sample = timeout(Duration::from_secs(60), poller.next()).await.expect("a sample within a minute");
    sample.expect("the poller is not closed").expect("no sample was missed")
}

/// Takes all samples that are available now.
fn drain(poller: &mut Poller) -> Vec<Sample> {
    std::iter::from_fn(|| poller.next().now_or_never().flatten()).map(|sample| sample.unwrap()).collect()
}

#[tokio::test(start_paused = true)]
async fn samples_have_name_value_time_and_quality() {
    let plc = Plc::new();
    plc.write(register!("R0"), 0xFFFF_u16).unwrap();
    plc.write(register!("R100"), 0x1000_u16).unwrap();
    plc.write(register!("R101"), 0xC3FA_u16).unwrap();
    plc.write(register!("R10"), 0x6946_u16).unwrap();
    plc.write(register!("R11"), 0x6C6C_u16).unwrap();
    plc.write(register!("R20"), 523_u16).unwrap();
    plc.write(discrete!("M7"), true).unwrap();
    let mut poller = Poller::builder().seed(1).build();
    let polled = poller.station(&station(&plc, &Faults::new(1))).unwrap();
    let tags = ["R0:i16", "R100:f32", "R10-R11:text", "R20:u16*0.1-40", "M7", "WM0:hex"];
    let names = ["valve", "speed", "recipe", "temperature", "alarm", "bits"];
    let polled_tags = names.into_iter().zip(tags).map(|(name, tag)| PollTag::new(name, tag.parse().unwrap()));
    let ids = polled.add(every(1000), polled_tags).unwrap();
    let mut samples = Vec::new();
    for _ in tags {
        samples.push(next(&mut poller).await);
    }
    samples.sort_by_key(|sample| sample.id);
    let got: Vec<_> = samples.iter().map(|sample| (&*sample.name, sample.value().unwrap().to_string())).collect();
    let values = ["-1", "-500.125", "\"Fill\"", "12.3", "1", "0x0080"];
    assert_eq!(got, names.into_iter().zip(values.map(str::to_owned)).collect::<Vec<_>>());
    for (sample, id) in samples.iter().zip(ids) {
        assert_eq!(sample.id, id);
        assert!(sample.is_good());
        assert!(sample.at.instant <= Instant::now());
        assert_eq!(polled.latest(id).unwrap().values(), sample.values());
    }
    poller.close().await;
    assert!(poller.next().await.is_none(), "the stream ends");
}

#[tokio::test(start_paused = true)]
async fn the_time_of_a_sample_is_that_of_its_reply() {
    // The reply takes 40 ms, and the consumer reads the sample much later.
    let (plc, faults) = (Plc::new(), Faults::new(1).rule(Rule::new(Fault::Delay { min: ms(40), max: ms(40) })));
    let mut poller = Poller::new();
    let class = every(1000).phase(Duration::ZERO);
    let begin = Instant::now();
    poller.station(&station(&plc, &faults)).unwrap().add(class, [tag("R0")]).unwrap();
    sleep(ms(500)).await;
    let sample = next(&mut poller).await;
    let after = sample.at.instant - begin;
    // The check of the new connection takes 40 ms, too.
    assert!(after >= ms(80) && after < ms(90), "{after:?}");
}

#[tokio::test(start_paused = true)]
async fn a_silent_plc_makes_samples_stale_then_bad_then_good() {
    let (plc, faults) = (Plc::new(), Faults::new(1));
    plc.write(register!("R0"), 7_u16).unwrap();
    let mut poller = Poller::builder().seed(3).build();
    let polled = poller.station(&station(&plc, &faults)).unwrap();
    let ids =
        polled.add(every(1000).bad_after(ms(5000)), [tag("R0").on_change(true), tag("M0").on_change(true)]).unwrap();
    for _ in &ids {
        assert!(next(&mut poller).await.is_good());
    }
    faults.add_rule(Rule::new(Fault::DropReply));
    sleep(ms(3000)).await;
    for sample in drain(&mut poller) {
        assert!(matches!(sample.quality, Quality::Stale(Reason::Failed(_))), "{}", sample.quality);
        assert_eq!(sample.values().len(), 1, "a stale sample keeps the last value");
    }
    sleep(ms(4000)).await;
    let bad = drain(&mut poller);
    assert!(bad.iter().any(|sample| matches!(sample.quality, Quality::Bad(_))));
    for id in &ids {
        assert_eq!(polled.latest(*id).unwrap().values(), [], "an error has no value");
    }
    faults.set_rules([]);
    sleep(ms(10_000)).await;
    assert_eq!(polled.latest(ids[0]).unwrap().value(), Some(&TagValue::U16(7)));
    assert!(drain(&mut poller).iter().filter(|sample| sample.is_good()).count() >= 2);
}

#[tokio::test(start_paused = true)]
async fn a_slow_consumer_loses_the_oldest_samples_and_is_told() {
    let plc = Plc::new();
    let mut poller = Poller::builder().capacity(10).seed(1).build();
    let polled = poller.station(&station(&plc, &Faults::new(1))).unwrap();
    let class = every(100).phase(Duration::ZERO);
    polled.add(class, [tag("R0")]).unwrap();
    for n in 0..50_u16 {
        plc.write(register!("R0"), n).unwrap();
        sleep(ms(100)).await;
    }
    let Some(Err(missed @ Missed { count, .. })) = poller.next().await else { panic!("no report of missed samples") };
    assert!((39..=42).contains(&count), "{missed}");
    let values: Vec<_> = drain(&mut poller).iter().map(|s| s.value().unwrap().to_string()).collect();
    assert_eq!(values.len(), 10);
    assert_eq!(
        values.last().unwrap(),
        &polled.snapshot()[0].value().unwrap().to_string(),
        "the newest samples are kept"
    );
    let stats = poller.handle().stats();
    assert_eq!((stats.samples, stats.missed), (count + 10, count));
    sleep(ms(100)).await;
    assert!(poller.next().await.unwrap().is_ok(), "reported once");
}

#[tokio::test(start_paused = true)]
async fn refused_addresses_do_not_spoil_their_neighbours() {
    let plc = Plc::with_model(Model::default().last(element!("R49")));
    let faults = Faults::new(1);
    let poller = Poller::builder().seed(1).build();
    let polled = poller.station(&station(&plc, &faults)).unwrap();
    let tags: Vec<PollTag> = (40..60).map(|n| tag(&format!("R{n}"))).collect();
    let ids = polled.add(every(1000), tags).unwrap();
    sleep(ms(3000)).await;
    for (n, id) in ids.iter().enumerate() {
        let sample = polled.latest(*id).unwrap();
        match n {
            0..10 => assert!(sample.is_good(), "R{}: {}", 40 + n, sample.quality),
            _ => assert!(matches!(sample.quality, Quality::Bad(Reason::Refused(_))), "R{}: {}", 40 + n, sample.quality),
        }
    }
    let stats = &polled.classes()[0];
    assert_eq!((stats.tags, stats.refused_tags, stats.requests_per_cycle), (20, 10, 1));
}

#[tokio::test(start_paused = true)]
async fn other_calls_take_precedence_over_polls() {
    let (plc, faults) = (Plc::new(), Faults::new(1).rule(Rule::new(Fault::Delay { min: ms(20), max: ms(20) })));
    let poller = Poller::builder().seed(1).build();
    let station = station(&plc, &faults);
    let limits = Limits::new().mixed_reads(false);
    let polled = poller.handle().station_with(&station, StationPolling::new().limits(limits)).unwrap();
    let tags: Vec<PollTag> = (0..40).map(|n| tag(&format!("R{}", n * 100))).collect();
    polled.add(every(100), tags).unwrap();
    sleep(ms(1000)).await;
    for _ in 0..20 {
        let begin = Instant::now();
        station.write_registers(register!("R9"), &[1]).await.unwrap();
        assert!(begin.elapsed() <= ms(45), "one poll in flight, and the write: {:?}", begin.elapsed());
        sleep(ms(7)).await;
    }
}

#[tokio::test(start_paused = true)]
async fn closing_a_poller_of_many_stations_leaves_no_task() {
    let alive = || tokio::runtime::Handle::current().metrics().num_alive_tasks();
    let before = alive();
    let mut stations = Vec::new();
    let mut poller = Poller::builder().seed(9).build();
    for n in 0..200_u16 {
        let plc = Plc::new();
        plc.write(register!("R0"), n).unwrap();
        let station = station(&plc, &Faults::new(1));
        let polled = poller.station(&station).unwrap();
        polled.add(every(500), [PollTag::new(format!("{n}"), "R0".parse().unwrap())]).unwrap();
        stations.push((station, polled));
    }
    sleep(ms(1600)).await;
    let samples = drain(&mut poller);
    assert!(samples.len() >= 600, "{}", samples.len());
    for sample in samples {
        assert_eq!(sample.value().unwrap().to_string(), *sample.name, "a value of another station");
    }
    assert_eq!(poller.handle().stats().stations, 200);
    // One station is stopped, the others go on.
    let requests = poller.handle().stats().requests;
    stations[0].1.stop();
    assert!(matches!(stations[0].1.add(every(500), [tag("R1")]), Err(PollError::Closed)));
    assert_eq!(poller.handle().stats().stations, 199);
    assert!(poller.handle().stats().requests >= requests, "counters keep stopped stations");
    sleep(ms(600)).await;
    assert!(drain(&mut poller).iter().all(|sample| &*sample.name != "0"));
    poller.close().await;
    assert!(matches!(poller.station(&stations[1].0), Err(PollError::Closed)));
    for (station, _) in &stations {
        station.link().close().await;
    }
    drop(stations);
    drop(poller);
    tokio::task::yield_now().await;
    sleep(ms(10)).await;
    assert_eq!(alive(), before);
}

#[tokio::test(start_paused = true)]
async fn dropping_the_poller_ends_its_tasks() {
    let alive = || tokio::runtime::Handle::current().metrics().num_alive_tasks();
    let plc = Plc::new();
    let station = station(&plc, &Faults::new(1));
    station.read_status().await.unwrap();
    let before = alive();
    let poller = Poller::new();
    let polled = poller.station(&station).unwrap();
    polled.add(every(10), [tag("R0")]).unwrap();
    sleep(ms(100)).await;
    assert_eq!(alive(), before + 1);
    drop(poller);
    sleep(ms(100)).await;
    assert_eq!(alive(), before);
}

#[tokio::test(start_paused = true)]
async fn after_close_no_tag_is_polled() {
    let poller = Poller::new();
    let polled = poller.station(&station(&Plc::new(), &Faults::new(1))).unwrap();
    let ids = polled.add(every(100), [tag("R0")]).unwrap();
    sleep(ms(1000)).await;
    assert!(polled.latest(ids[0]).is_some_and(|sample| sample.is_good()));
    let requests = poller.handle().stats().requests;
    poller.close().await;
    assert!(polled.latest(ids[0]).is_none() && polled.snapshot().is_empty());
    assert!(poller.handle().snapshot().is_empty());
    assert!(matches!(polled.add(every(100), [tag("R1")]), Err(PollError::Closed)));
    assert!(!polled.remove(ids[0]));
    assert_eq!(poller.handle().stats().requests, requests, "counters survive closing");
}

#[tokio::test(start_paused = true)]
async fn latest_and_snapshot_report_overdue_samples() {
    let (plc, faults) = (Plc::new(), Faults::new(1));
    let poller = Poller::builder().seed(2).build();
    let link_station =
        station(&plc, &faults).with_options(CallOptions::new().with_response_timeout(Duration::from_secs(9)));
    let polled = poller.station(&link_station).unwrap();
    let ids = polled.add(every(100).stale_after(ms(500)).bad_after(ms(2000)), [tag("R0")]).unwrap();
    sleep(ms(1000)).await;
    faults.add_rule(Rule::new(Fault::DropReply));
    sleep(ms(700)).await;
    assert!(matches!(polled.latest(ids[0]).unwrap().quality, Quality::Stale(Reason::Overdue)));
    sleep(ms(1500)).await;
    assert!(matches!(polled.snapshot()[0].quality, Quality::Bad(Reason::Overdue)));
}

/// Four threads add and remove tags, stop stations and close the poller during polling.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn tags_can_be_added_and_removed_from_many_threads() {
    let mut poller = Poller::builder().seed(4).build();
    let mut tasks = Vec::new();
    for n in 0..8_u16 {
        let plc = Plc::new();
        plc.write(register!("R0"), n).unwrap();
        let polled = poller.station(&station(&plc, &Faults::new(1))).unwrap();
        tasks.push(tokio::spawn(async move {
            for round in 0..100 {
                let name = format!("{n}");
                let ids = polled.add(every(1), [PollTag::new(name, "R0".parse().unwrap()), tag("M0")]).unwrap();
                tokio::task::yield_now().await;
                if round % 3 > 0 {
                    assert!(ids.iter().all(|id| polled.remove(*id)));
                    assert!(ids.iter().all(|id| polled.latest(*id).is_none()));
                }
            }
            if n % 2 == 0 {
                polled.stop();
            }
            polled
        }));
    }
    let handle = poller.handle();
    let mut values = 0;
    let mut handles = Vec::new();
    let end = std::time::Instant::now() + Duration::from_secs(20);
    while values < 2000 && std::time::Instant::now() < end {
        // On a busy machine some samples may be missed.
        let Some(Ok(sample)) = poller.next().await else { continue };
        if let (Ok(n), Some(TagValue::U16(value))) = (sample.name.parse::<u16>(), sample.value()) {
            assert_eq!(*value, n, "a value of another station");
            values += 1;
        }
    }
    for task in tasks {
        handles.push(task.await.unwrap());
    }
    assert_eq!(values, 2000);
    assert_eq!(handle.stats().stations, 4);
    handle.close().await;
    assert_eq!(handle.stats().stations, 0);
    // Samples that were queued can still be taken; then the stream ends.
    while poller.next().await.is_some() {}
}

#[test]
fn without_a_runtime_polling_is_an_error() {
    let link = Link::new("tcp://127.0.0.1:1".parse().unwrap());
    let error = Poller::new().station(&link.station(1).unwrap()).unwrap_err();
    assert!(matches!(error, PollError::NoRuntime), "{error}");
}

/// Random faults on a bus of eight stations: every good sample has the value of its PLC.
#[tokio::test(start_paused = true)]
async fn good_samples_are_right_under_random_faults() {
    for seed in 0..8 {
        let faults = Faults::new(seed)
            .rule(Rule::new(Fault::DropReply).one_in(9))
            .rule(Rule::new(Fault::BadChecksum).one_in(11))
            .rule(Rule::new(Fault::Delay { min: ms(150), max: ms(150) }).one_in(13))
            .rule(Rule::new(Fault::Disconnect(DisconnectAt::BeforeReply)).one_in(101));
        let mut bus = Bus::new().with_faults(faults.clone());
        let plcs: Vec<Plc> = (1..=8).map(|_| Plc::new()).collect();
        for (number, plc) in (1..).zip(&plcs) {
            bus = bus.with_station(number, plc.clone()).unwrap();
            for n in 0..50 {
                let value = u16::from(number) * 1000 + u16::try_from(n).unwrap();
                plc.write(register!("R0").nth(n).unwrap(), value).unwrap();
            }
        }
        let link = Link::connector_builder("bus", Framing::Ascii, sim::connector(bus, Framing::Ascii))
            .response_timeout(ms(100))
            .seed(seed)
            .build();
        let mut poller = Poller::builder().seed(seed).build();
        for number in 1..=8 {
            let polled = poller.station(&link.station(number).unwrap()).unwrap();
            let tags =
                (0..50).step_by(3).map(|n| PollTag::new(format!("{number} {n}"), format!("R{n}").parse().unwrap()));
            polled.add(every(250), tags).unwrap();
        }
        let end = Instant::now() + Duration::from_secs(120);
        let (mut good, mut stale) = (0_u32, 0_u32);
        while Instant::now() < end {
            let sample = next(&mut poller).await;
            let (number, n) = sample.name.split_once(' ').unwrap();
            let expected = number.parse::<u16>().unwrap() * 1000 + n.parse::<u16>().unwrap();
            match sample.value() {
                Some(value) => assert_eq!(*value, TagValue::U16(expected), "seed {seed}: {sample:?}"),
                None => assert!(matches!(sample.quality, Quality::Bad(_))),
            }
            if sample.is_good() { good += 1 } else { stale += 1 }
        }
        assert!(good > 20_000 && stale > 100, "seed {seed}: {good} good and {stale} other samples: too few");
        link.close().await;
    }
}

/// One duplicate comes out of order, two or three exchanges late, after each request of four cycles
/// in turn. Without jobs this gave 40 wrong samples, one for each copy; with only the check at the
/// end of a cycle removed (`Job::must_confirm`), 4.
#[tokio::test(start_paused = true)]
async fn no_sample_is_a_roaming_duplicate() {
    let (mut copies, mut wrong, mut good) = (0, 0, 0);
    for from in 1..=40 {
        let plc = Plc::new();
        for n in 0..10 {
            plc.write(register!("R0").nth(100 * n).unwrap(), 1000 + u16::try_from(n).unwrap()).unwrap();
        }
        let line = roaming::RoamingLine::new(Bus::new().with_station(1, plc).unwrap(), from);
        let mut poller = Poller::builder().seed(1).build();
        let polling = StationPolling::new().limits(Limits::new().mixed_reads(false));
        let polled = poller.handle().station_with(&line.station, polling).unwrap();
        let tags = (0..10).map(|n| PollTag::new(format!("{}", 1000 + n), format!("R{}", 100 * n).parse().unwrap()));
        polled.add(every(1000), tags).unwrap();
        sleep(ms(5500)).await;
        for sample in drain(&mut poller) {
            assert!(sample.is_good(), "{sample:?}");
            good += 1;
            wrong += usize::from(sample.value().unwrap().to_string() != *sample.name);
        }
        copies += line.copies();
    }
    assert_eq!((copies, wrong), (40, 0), "of {good} samples");
    assert!(good >= 40 * 50, "{good}");
}
