//! Users of single calls.

use std::time::Duration;

use fatek::{CallOptions, Element, Link, Pool, Register32, Station, Symbol, Value};
use futures::future::join_all;
use tokio::time::{Instant, sleep};

use crate::faults::FaultKind;
use crate::layout::{
    DISCRETES, NO_RUN, READABLE, REFUSED, RUN_REFUSED, UNREADABLE, UNWRITABLE, WRITABLE, bit, d, dword, m, r, word,
};
use crate::rng::Rng;
use crate::tally::Tally;
use crate::world::World;

/// Kinds of calls that a user makes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Calls {
    All,
    /// Reads and writes: mixed ones in half of the calls, registers in the others.
    ReadsAndWrites,
    /// Reads and writes of one register, some of them refused.
    OneShape,
}

/// Makes calls one after the other over one link.
pub(crate) async fn single(world: &World, rng: &mut Rng, calls: u64, kind: Calls, tally: &mut Tally) {
    let link = world.link();
    for _ in 0..calls {
        pause(world, rng).await;
        let station = link.station(world.any_station(rng)).unwrap();
        call(world, &station, rng, kind, tally).await;
    }
    tally.links(&link.stats());
    link.close().await;
}

/// Makes concurrent calls over one link, most of them to one station.
pub(crate) async fn many(world: &World, rng: &mut Rng, calls: u64, tally: &mut Tally) {
    let link = world.link();
    let callers = (0..12).map(|_| {
        let (mut rng, link) = (Rng(rng.next()), link.clone());
        async move {
            let mut tally = Tally::default();
            for _ in 0..calls / 12 {
                let number = if rng.percent(80) { 1 } else { world.any_station(&mut rng) };
                call(world, &link.station(number).unwrap(), &mut rng, Calls::All, &mut tally).await;
            }
            tally
        }
    });
    join_all(callers).await.into_iter().for_each(|of_caller| tally.add(of_caller));
    tally.links(&link.stats());
    link.close().await;
}

/// Makes one to three calls over each of many links, which are closed or dropped.
pub(crate) async fn fresh(world: &World, rng: &mut Rng, calls: u64, tally: &mut Tally) {
    let mut left = calls;
    while left > 0 {
        let link = world.link();
        for _ in 0..(1 + rng.below(3)).min(left) {
            let station = link.station(world.any_station(rng)).unwrap();
            call(world, &station, rng, Calls::All, tally).await;
            left -= 1;
        }
        tally.links(&link.stats());
        if rng.percent(50) {
            link.close().await;
        }
        pause(world, rng).await;
    }
}

/// Makes calls over a link whose idle connection is closed between them.
pub(crate) async fn idle(world: &World, rng: &mut Rng, calls: u64, tally: &mut Tally) {
    let link = world.builder().idle_timeout(Duration::from_millis(30)).build();
    for _ in 0..calls {
        sleep(Duration::from_millis(rng.below(60))).await;
        let station = link.station(world.any_station(rng)).unwrap();
        call(world, &station, rng, Calls::All, tally).await;
    }
    tally.links(&link.stats());
    link.close().await;
}

/// Makes calls through a pool with room for one endpoint. The PLC has two names, so each call may
/// evict the other link.
pub(crate) async fn pooled(world: &World, rng: &mut Rng, calls: u64, tally: &mut Tally) {
    let (bus, framing) = (world.bus.clone(), world.framing);
    let settings = (world.line, world.in_step());
    let pool = Pool::builder()
        .max_endpoints(1)
        .connects_per_second(1000)
        .links(move |builder| settings.0.settings(builder, framing, settings.1))
        .connector(move |_| fatek::sim::connector(bus.clone(), framing)())
        .build();
    for _ in 0..calls {
        pause(world, rng).await;
        let name = rng.pick(&["plc", "plc", "module"]);
        let endpoint = fatek::Endpoint::tcp(name, 500).with_framing(framing);
        let Ok(station) = pool.station(endpoint, world.any_station(rng)) else { continue };
        call(world, &station, rng, Calls::All, tally).await;
    }
    let stats = pool.stats();
    tally.links(&stats.traffic);
    pool.close().await;
}

/// Pauses before some calls, mostly for less than the copy window.
async fn pause(world: &World, rng: &mut Rng) {
    if rng.percent(30) {
        let longest = if rng.percent(20) { 2 * world.times.response_timeout } else { world.times.copies };
        sleep(Duration::from_micros(rng.below(longest.as_micros() as u64))).await;
    }
}

/// Sends a broadcast before some calls, if broadcasts are answered.
pub(crate) async fn broadcast(world: &World, link: &Link, rng: &mut Rng, tally: &mut Tally) {
    if !world.has(FaultKind::AnsweredBroadcast) || rng.percent(75) {
        return;
    }
    let everyone = link.broadcast();
    if rng.percent(50) {
        let run = rng.percent(50);
        let result = if run { everyone.run().await } else { everyone.stop().await };
        let _ = tally.call("broadcast", (false, &[]), result, |()| true);
    } else {
        // F0 has the shape of a single call that may follow.
        let serial = world.serial();
        let result = everyone.write_registers(fatek::register!("F0"), &[serial]).await;
        if tally.call("broadcast", (false, &[]), result, |()| true).is_ok() {
            world.record_broadcast(serial);
        }
    }
}

/// Makes a random call and checks its result.
pub(crate) async fn call(world: &World, station: &Station, rng: &mut Rng, kind: Calls, tally: &mut Tally) {
    let shortest = world.times.response_timeout;
    let retries = rng.below(3) as u32;
    let options = CallOptions::new()
        .with_response_timeout(shortest)
        .with_call_timeout(world.times.call_timeout)
        .with_retries(retries);
    let station = station.with_options(options.with_background(rng.percent(20)));
    broadcast(world, station.link(), rng, tally).await;
    let began = Instant::now();
    match kind {
        Calls::All => any(world, &station, rng, tally).await,
        Calls::ReadsAndWrites if rng.percent(50) => mixed(world, &station, rng, tally).await,
        Calls::ReadsAndWrites => registers(world, &station, rng, tally).await,
        Calls::OneShape => match rng.below(10) {
            0..5 => read(world, &station, rng, 1, tally).await,
            5 => read_refused(&station, rng, tally).await,
            6..9 => write(world, &station, rng, 1, tally).await,
            _ => write_refused(world, &station, rng, tally).await,
        },
    }
    world.check_deadline(began, 1, tally);
}

async fn any(world: &World, station: &Station, rng: &mut Rng, tally: &mut Tally) {
    let number = station.number();
    match rng.below(20) {
        0..=7 => registers(world, station, rng, tally).await,
        8 => {
            // One request reads 32 double words at most.
            let count = small(rng).min(32);
            let first = rng.between(0, READABLE - 2 * count);
            let result = station.read_registers32(Register32::new(Symbol::DR, first).unwrap(), count.into()).await;
            let expected = (0..count).map(|n| dword(number, first + 2 * n));
            let what = format!("station {number}, DR{first}, {count} of them");
            let _ = tally.call(what, (false, world.injected()), result, |got| got.iter().copied().eq(expected));
        }
        9 | 10 => {
            let count = small(rng);
            let first = rng.between(0, DISCRETES - count);
            let result = station.read_discretes(m(first), count.into()).await;
            let expected = (first..first + count).map(|address| bit(number, address));
            let what = format!("station {number}, M{first}, {count} of them");
            let _ = tally.call(what, (false, &[]), result, |got| got.iter().copied().eq(expected));
        }
        11 | 12 => mixed(world, station, rng, tally).await,
        13 => read_refused(station, rng, tally).await,
        14 => write_refused(world, station, rng, tally).await,
        15 | 16 => {
            let run = rng.percent(50);
            let refused = run && number == NO_RUN;
            let result = if run { station.run().await } else { station.stop().await };
            world.record_control(number, run, result.is_ok());
            let right: &[_] = if refused { &[RUN_REFUSED] } else { &[] };
            let _ = tally.call(format!("station {number}, run {run}"), (refused, right), result, |()| true);
        }
        17 | 18 => {
            let result = station.loop_back(format!("{:04X}", rng.below(0x10000))).await;
            let _ = tally.call(format!("station {number}, 4E"), (false, world.loop_back()), result, |()| true);
        }
        _ => {
            let result = station.read_detailed_status().await;
            let _ = tally.call(format!("station {number}, 53"), (false, &[]), result, |_| true);
        }
    }
}

/// Reads or writes registers.
async fn registers(world: &World, station: &Station, rng: &mut Rng, tally: &mut Tally) {
    let count = small(rng);
    match rng.percent(60) {
        true => read(world, station, rng, count, tally).await,
        false => write(world, station, rng, count, tally).await,
    }
}

async fn read(world: &World, station: &Station, rng: &mut Rng, count: u16, tally: &mut Tally) {
    let number = station.number();
    let first = rng.between(0, READABLE - count);
    let result = station.read_registers(r(first), count.into()).await;
    let expected = (first..first + count).map(|address| word(number, address));
    let what = format!("station {number}, R{first}, {count} of them");
    let _ = tally.call(what, (false, world.injected()), result, |got| got.iter().copied().eq(expected));
}

async fn write(world: &World, station: &Station, rng: &mut Rng, count: u16, tally: &mut Tally) {
    let number = station.number();
    let first = rng.between(0, WRITABLE - count);
    let serial = world.serial();
    let result = station.write_registers(d(first), &vec![serial; count.into()]).await;
    world.record_write(number, first, count, serial, &result);
    let what = format!("station {number}, write to D{first}, {count} of them");
    let _ = tally.call(what, (false, world.injected()), result, |()| true);
}

async fn read_refused(station: &Station, rng: &mut Rng, tally: &mut Tally) {
    let number = station.number();
    let first = READABLE + rng.between(0, UNREADABLE - 1);
    let result = station.read_registers(r(first), 1).await;
    let _ = tally.call(format!("station {number}, R{first}"), (true, &[REFUSED]), result, |_| false);
}

async fn write_refused(world: &World, station: &Station, rng: &mut Rng, tally: &mut Tally) {
    let number = station.number();
    let first = WRITABLE + rng.between(0, UNWRITABLE - 1);
    let serial = world.serial();
    let result = station.write_registers(d(first), &[serial]).await;
    world.record_write(number, first, 1, serial, &result);
    let _ = tally.call(format!("station {number}, write to D{first}"), (true, &[REFUSED]), result, |()| false);
}

/// Makes a mixed read or write.
async fn mixed(world: &World, station: &Station, rng: &mut Rng, tally: &mut Tally) {
    let number = station.number();
    if rng.percent(60) {
        let elements: Vec<Element> = (0..rng.between(1, 20))
            .map(|_| match rng.percent(60) {
                true => r(rng.between(0, READABLE - 1)).into(),
                false => m(rng.between(0, DISCRETES - 1)).into(),
            })
            .collect();
        let result = station.read_mixed(&elements).await;
        let expected = elements.iter().map(|element| match element.symbol() {
            Symbol::R => Value::Word(word(number, element.address())),
            _ => Value::Bit(bit(number, element.address())),
        });
        let what = format!("station {number}, {elements:?}");
        let _ = tally.call(what, (false, world.mixed()), result, |got| got.iter().copied().eq(expected));
    } else {
        let serial = world.serial();
        // Consecutive registers, so that the audit sees one write.
        let first = rng.between(0, WRITABLE - 20);
        let count = rng.between(1, 20);
        let items: Vec<_> =
            (first..first + count).map(|address| (Element::from(d(address)), Value::Word(serial))).collect();
        let result = station.write_mixed(&items).await;
        world.record_write(number, first, count, serial, &result);
        let what = format!("station {number}, mixed write to D{first}, {count} of them");
        let _ = tally.call(what, (false, world.mixed()), result, |()| true);
    }
}

/// A small count, mostly 1: replies of equal shape can be mistaken for each other.
fn small(rng: &mut Rng) -> u16 {
    match rng.below(100) {
        0..70 => 1,
        70..80 => 3,
        80..95 => rng.between(1, 16),
        _ => rng.between(1, 64),
    }
}
