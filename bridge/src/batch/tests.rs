use std::time::Duration;

use fatek::poll::{Poller, ScanClass};
use fatek::sim::{self, Fault, Rule};
use futures::StreamExt;

use super::*;

fn place(tag: &str, index: usize) -> Place {
    Place { plc: "mixer".into(), tag: tag.into(), index, revision: 0, gate: crate::fleet::Gate::always_open() }
}

fn json(batch: &Batch) -> serde_json::Value {
    serde_json::from_slice(&batch.message(false)).unwrap()
}

async fn samples(tags: &[&str], count: usize) -> Vec<Sample> {
    let bench = sim::station().await;
    let poller = Poller::new();
    let polled = poller.station(&bench.station).unwrap();
    let class = ScanClass::every(Duration::from_millis(100)).stale_after(Duration::from_millis(300));
    polled.add(class, tags.iter().map(|tag| fatek::poll::PollTag::new(*tag, tag.parse().unwrap()))).unwrap();
    let mut poller = poller;
    let mut samples = Vec::new();
    while samples.len() < count {
        samples.push(poller.next().await.unwrap().unwrap());
        if samples.len() == tags.len() {
            bench.faults.add_rule(Rule::new(Fault::Ignore));
        }
    }
    samples
}

#[tokio::test(start_paused = true)]
async fn samples_of_one_time_make_one_batch_and_a_repeated_tag_ends_it() {
    let mut samples = samples(&["R5:i16", "M7", "R10-R11:i16"], 3).await;
    // Requests of one cycle have different times.
    let at = samples[0].at;
    samples.iter_mut().for_each(|sample| sample.at = at);
    let mut batcher = Batcher::new("mixer".into(), 7);
    assert!(batcher.end().is_none());
    for (index, sample) in samples.iter().enumerate() {
        assert!(batcher.push(&place(["level", "alarm", "pair"][index], index), sample).is_none());
    }
    let first = batcher.push(&place("level", 0), &samples[0]).unwrap();
    assert_eq!((first.seq, first.samples), (7, 3));
    let ts = milliseconds(at.time);
    let data = json!({ "level": 0, "alarm": false, "pair": [0, 0] });
    assert_eq!(json(&first), json!({ "seq": 7, "ts": ts, "d": data }));
    let second = batcher.end().unwrap();
    assert_eq!(json(&second), json!({ "seq": 8, "ts": ts, "d": { "level": 0 } }));
    assert!(batcher.end().is_none());
    let replay: serde_json::Value = serde_json::from_slice(&second.message(true)).unwrap();
    assert_eq!(replay["hist"], true);
}

/// With the time of the last value as the time of the batch, the batch of a later time had that of the first. With the
/// time of the collector, it had another time each time that the tag was reported.
#[tokio::test(start_paused = true)]
async fn a_stale_sample_has_no_value_and_two_times() {
    let mut samples = samples(&["R5:i16"], 2).await;
    // The time of the system does not pass with the time of the test.
    samples[1].stale_since.as_mut().unwrap().time += Duration::from_millis(300);
    let (good, stale) = (&samples[0], &samples[1]);
    assert!(matches!(stale.quality, Quality::Stale(_)), "{stale:?}");
    let mut batcher = Batcher::new("mixer".into(), 1);
    batcher.push(&place("level", 0), good);
    let (then, since) = (milliseconds(good.at.time), milliseconds(stale.stale_since.unwrap().time));
    assert!(since >= then + 300, "{then} {since}");
    let first = batcher.push(&place("level", 0), stale).unwrap();
    assert_eq!(first.ts, then);
    // It is reported again.
    let second = batcher.push(&place("level", 0), stale).unwrap();
    assert_eq!((second.ts, batcher.end().unwrap().ts), (since, since));
    let level = &json(&second)["d"]["level"];
    assert_eq!((&level["q"], &level["ts"]), (&json!("stale"), &json!(then)), "{level}");
    assert!(level["why"].is_string() && level.as_object().unwrap().len() == 3, "{level}");
}

#[tokio::test(start_paused = true)]
async fn another_ownership_begins_another_batch_with_its_token() {
    let samples = samples(&["R5:i16", "M7"], 2).await;
    let of = |revision| Place { revision, ..place("level", 0) };
    let at = |millis: u64| {
        let mut sample = samples[0].clone();
        sample.at.time = SystemTime::UNIX_EPOCH + Duration::from_millis(millis);
        sample
    };
    let mut batcher = Batcher::new("mixer".into(), 7);
    batcher.push(&of(0), &at(1000));
    let first = batcher.push(&of(41), &at(2000)).unwrap();
    assert_eq!((first.revision, first.seq, json(&first).get("rev")), (0, 7, None));
    let second = batcher.push(&of(44), &at(2001)).unwrap();
    assert_eq!((second.revision, second.seq), (41, 2_000_000));
    assert_eq!(json(&second)["rev"], 41);
    let third = batcher.end().unwrap();
    assert_eq!((third.revision, third.seq), (44, 2_001_000));
    // A clock that was set back: the number grows all the same.
    batcher.push(&of(46), &at(5));
    assert_eq!(batcher.end().unwrap().seq, 2_001_001);
}
