//! Users of reads, writes and plans that take several requests.

use std::time::Duration;

use fatek::tag::{Tag, TagValue};
use fatek::{CostModel, Link, Plan, Register32, Station, Symbol};
use tokio::time::Instant;

use crate::faults::FaultKind;
use crate::layout::{DISCRETES, READABLE, REFUSED, UNWRITABLE, WRITABLE, bit, d, dword, m, r, word};
use crate::rng::Rng;
use crate::tally::Tally;
use crate::users::broadcast;
use crate::world::World;

/// Reads 1 to 2000 elements at a time: 16-bit, 32-bit, or discretes.
pub(crate) async fn long_reads(world: &World, link: &Link, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let requests = link.stats().stations.requests + requests;
    while link.stats().stations.requests < requests {
        broadcast(world, link, rng, tally).await;
        let station = link.station(world.any_station(rng)).unwrap();
        long_read(world, &station, rng, tally).await;
    }
}

async fn long_read(world: &World, station: &Station, rng: &mut Rng, tally: &mut Tally) {
    let number = station.number();
    let began = Instant::now();
    let most = rng.pick(&[130, 2000]);
    // With a roaming duplicate only jobs are safe, so each read takes several requests.
    let least = |in_one_request: u16| if world.has(FaultKind::RoamingOnce) { in_one_request + 1 } else { 1 };
    match rng.below(10) {
        0..=4 => {
            let count = rng.between(least(64), most);
            let first = rng.between(0, READABLE - count);
            let result = station.read_registers(r(first), count.into()).await;
            let expected = (first..first + count).map(|address| word(number, address));
            let what = format!("station {number}, R{first}, {count} of them");
            let _ = tally.call(what, (false, world.injected()), result, |got| got.iter().copied().eq(expected));
        }
        5 | 6 => {
            let count = rng.between(least(32), most / 2);
            let first = rng.between(0, READABLE - 2 * count);
            let result = station.read_registers32(Register32::new(Symbol::DR, first).unwrap(), count.into()).await;
            let expected = (0..count).map(|n| dword(number, first + 2 * n));
            let what = format!("station {number}, DR{first}, {count} of them");
            let _ = tally.call(what, (false, world.injected()), result, |got| got.iter().copied().eq(expected));
        }
        7 | 8 => {
            let count = rng.between(least(256), DISCRETES);
            let first = rng.between(0, DISCRETES - count);
            let result = station.read_discretes(m(first), count.into()).await;
            let expected = (first..first + count).map(|address| bit(number, address));
            let what = format!("station {number}, M{first}, {count} of them");
            let _ = tally.call(what, (false, &[]), result, |got| got.iter().copied().eq(expected));
        }
        _ => {
            // Runs into registers that cannot be read.
            let before = rng.between(least(64), most / 2);
            let first = READABLE - before;
            let result = station.read_registers(r(first), usize::from(before) + 20).await;
            let what = format!("station {number}, R{first} and beyond R2999");
            let right = [&[REFUSED], world.injected()].concat();
            let _ = tally.call(what, (true, &right), result, |_| false);
        }
    }
    world.check_deadline(began, usize::from(most) / 63 + 2, tally);
}

/// Writes 1 to 1000 registers at a time: 16-bit or 32-bit.
pub(crate) async fn long_writes(world: &World, link: &Link, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let requests = link.stats().stations.requests + requests;
    while link.stats().stations.requests < requests {
        broadcast(world, link, rng, tally).await;
        let station = link.station(world.any_station(rng)).unwrap();
        let number = station.number();
        let began = Instant::now();
        let most = rng.pick(&[140, 1000]);
        let least = if world.has(FaultKind::RoamingOnce) { 33 } else { 1 };
        let count = rng.between(least, most / 2) * 2;
        let serial = world.serial();
        let refused = rng.percent(15);
        let (first, count) = match refused {
            // Runs into registers that cannot be written.
            true => (WRITABLE - rng.between(0, most), count + UNWRITABLE / 2),
            false => (rng.between(0, WRITABLE - count), count),
        };
        let refused = refused && first + count > WRITABLE;
        let mut words = 1;
        let result = if rng.percent(70) {
            station.write_registers(d(first), &vec![serial; count.into()]).await
        } else {
            let values = vec![u32::from(serial) << 16 | u32::from(serial); usize::from(count) / 2];
            words = 2;
            station.write_registers32(Register32::new(Symbol::DD, first).unwrap(), &values).await
        };
        world.record_write_of(number, (first, count), serial, words, &result);
        let what = format!("station {number}, write to D{first}, {count} of them");
        let right = if refused { [&[REFUSED], world.injected()].concat() } else { world.injected().to_vec() };
        let _ = tally.call(what, (refused, &right), result, |()| true);
        world.check_deadline(began, usize::from(count) / 31 + 2, tally);
    }
}

/// Reads plans of tags of several kinds.
pub(crate) async fn plans(world: &World, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let link = world.link();
    while link.stats().stations.requests < requests {
        broadcast(world, &link, rng, tally).await;
        let station = link.station(world.any_station(rng)).unwrap();
        let number = station.number();
        let tags: Vec<(Tag, Option<Vec<TagValue>>)> = (0..rng.between(2, 40)).map(|_| tag(number, rng)).collect();
        let plan = Plan::builder(CostModel::network(world.framing, Duration::from_millis(5)))
            .tags(tags.iter().map(|&(tag, _)| tag))
            .build()
            .unwrap();
        let began = Instant::now();
        let readings = plan.read(&station).await;
        world.check_deadline(began, plan.requests().len(), tally);
        // A tag that shares a request with a refused tag is refused, too.
        let refused: &[_] = if tags.iter().any(|(_, values)| values.is_none()) { &[REFUSED] } else { &[] };
        let right = [refused, world.injected(), world.mixed()].concat();
        for (nth, (tag, expected)) in tags.iter().enumerate() {
            let result = readings.tag(nth).expect("a tag of the plan").map_err(Clone::clone);
            let is_right = |values: &Vec<TagValue>| expected.as_ref().is_some_and(|expected| values == expected);
            let _ = tally.call(format!("station {number}, {tag}"), (expected.is_none(), &right), result, is_right);
        }
    }
    tally.links(&link.stats());
    link.close().await;
}

/// A random tag, with its values if it can be read.
pub(crate) fn tag(station: u8, rng: &mut Rng) -> (Tag, Option<Vec<TagValue>>) {
    let count = if rng.percent(60) { 1 } else { rng.between(1, 100) };
    let first = rng.between(0, DISCRETES - 2 * count);
    let last = first + count - 1;
    let (text, values): (String, Option<Vec<TagValue>>) = match rng.below(40) {
        0 => (format!("R{}", READABLE + first % 100), None),
        1..=20 => {
            (format!("R{first}-R{last}:u16"), Some((first..=last).map(|n| TagValue::U16(word(station, n))).collect()))
        }
        21..=30 => (format!("DR{first}:u32"), Some(vec![TagValue::U32(dword(station, first))])),
        _ => (format!("M{first}-M{last}"), Some((first..=last).map(|n| TagValue::Bool(bit(station, n))).collect())),
    };
    (text.parse().unwrap(), values)
}
