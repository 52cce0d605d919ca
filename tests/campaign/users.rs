//! Users of single calls.

use std::time::Duration;

use fatek::{CallOptions, Element, Link, Pool, Register32, Station, Symbol, Value};
use futures::future::join_all;
use tokio::time::{Instant, sleep};

use crate::plant::{
    DISCRETES, Dice, NO_RUN, READABLE, REFUSED, RUN_REFUSED, UNREADABLE, UNWRITABLE, WRITABLE, bit, d, dword, m, r,
    word,
};
use crate::tally::Tally;
use crate::troubles::Trouble;
use crate::world::World;

/// The calls of a user.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Calls {
    All,
    /// Reads and writes of one kind each in turn: mixed ones, and registers.
    ReadsAndWrites,
    /// One register: read or written, and both refused now and then.
    OneShape,
}

/// One call after the other over one link.
pub(crate) async fn single(world: &World, dice: &mut Dice, calls: u64, of: Calls, tally: &mut Tally) {
    let link = world.link();
    for _ in 0..calls {
        pause(world, dice).await;
        let station = link.station(world.any_station(dice)).unwrap();
        call(world, &station, dice, of, tally).await;
    }
    tally.links(&link.stats());
    link.close().await;
}

/// Many callers of one link, and mostly of one station.
pub(crate) async fn many(world: &World, dice: &mut Dice, calls: u64, tally: &mut Tally) {
    let link = world.link();
    let callers = (0..12).map(|_| {
        let (mut dice, link) = (Dice(dice.roll()), link.clone());
        async move {
            let mut tally = Tally::default();
            for _ in 0..calls / 12 {
                let number = if dice.in_hundred(80) { 1 } else { world.any_station(&mut dice) };
                call(world, &link.station(number).unwrap(), &mut dice, Calls::All, &mut tally).await;
            }
            tally
        }
    });
    join_all(callers).await.into_iter().for_each(|of_caller| tally.add(of_caller));
    tally.links(&link.stats());
    link.close().await;
}

/// A link for each call, or for a few: closed, or dropped with its last call.
pub(crate) async fn fresh(world: &World, dice: &mut Dice, calls: u64, tally: &mut Tally) {
    let mut left = calls;
    while left > 0 {
        let link = world.link();
        for _ in 0..(1 + dice.below(3)).min(left) {
            let station = link.station(world.any_station(dice)).unwrap();
            call(world, &station, dice, Calls::All, tally).await;
            left -= 1;
        }
        tally.links(&link.stats());
        if dice.in_hundred(50) {
            link.close().await;
        }
        pause(world, dice).await;
    }
}

/// A link whose connection is closed while nobody uses it.
pub(crate) async fn idle(world: &World, dice: &mut Dice, calls: u64, tally: &mut Tally) {
    let link = world.builder().idle_timeout(Duration::from_millis(30)).build();
    for _ in 0..calls {
        sleep(Duration::from_millis(dice.below(60))).await;
        let station = link.station(world.any_station(dice)).unwrap();
        call(world, &station, dice, Calls::All, tally).await;
    }
    tally.links(&link.stats());
    link.close().await;
}

/// A pool with room for one endpoint, and a device that has two names: each is evicted and asked anew.
pub(crate) async fn pooled(world: &World, dice: &mut Dice, calls: u64, tally: &mut Tally) {
    let (bus, framing) = (world.bus.clone(), world.framing);
    let settings = (world.wire, world.in_step());
    let pool = Pool::builder()
        .max_endpoints(1)
        .connects_per_second(1000)
        .links(move |builder| settings.0.settings(builder, framing, settings.1))
        .connector(move |_| fatek::sim::connector(bus.clone(), framing)())
        .build();
    for _ in 0..calls {
        pause(world, dice).await;
        let name = dice.of(&["plc", "plc", "module"]);
        let endpoint = fatek::Endpoint::tcp(name, 500).with_framing(framing);
        let Ok(station) = pool.station(endpoint, world.any_station(dice)) else { continue };
        call(world, &station, dice, Calls::All, tally).await;
    }
    let stats = pool.stats();
    tally.links(&stats.traffic);
    pool.close().await;
}

/// Now and then, and mostly for less than a copy may come.
async fn pause(world: &World, dice: &mut Dice) {
    if dice.in_hundred(30) {
        let longest = if dice.in_hundred(20) { 2 * world.times.response_timeout } else { world.times.copies };
        sleep(Duration::from_micros(dice.below(longest.as_micros() as u64))).await;
    }
}

/// Sends a broadcast now and then, if broadcasts are answered.
pub(crate) async fn broadcast(world: &World, link: &Link, dice: &mut Dice, tally: &mut Tally) {
    if !world.has(Trouble::AnsweredBroadcast) || dice.in_hundred(75) {
        return;
    }
    let everyone = link.broadcast();
    if dice.in_hundred(50) {
        let run = dice.in_hundred(50);
        let result = if run { everyone.run().await } else { everyone.stop().await };
        let _ = tally.call("broadcast", (false, &[]), result, |()| true);
    } else {
        // As one of the single calls that may follow.
        let serial = world.serial();
        let result = everyone.write_registers(fatek::register!("F0"), &[serial]).await;
        if tally.call("broadcast", (false, &[]), result, |()| true).is_ok() {
            world.broadcast(serial);
        }
    }
}

/// Does something at random, and checks what it gets.
pub(crate) async fn call(world: &World, station: &Station, dice: &mut Dice, of: Calls, tally: &mut Tally) {
    let shortest = world.times.response_timeout;
    let retries = dice.below(3) as u32;
    let options = CallOptions::new().response_timeout(shortest).call_timeout(world.times.call_timeout).retries(retries);
    let station = station.with_options(options.background(dice.in_hundred(20)));
    broadcast(world, station.link(), dice, tally).await;
    let began = Instant::now();
    match of {
        Calls::All => any(world, &station, dice, tally).await,
        Calls::ReadsAndWrites if dice.in_hundred(50) => mixed(world, &station, dice, tally).await,
        Calls::ReadsAndWrites => registers(world, &station, dice, tally).await,
        Calls::OneShape => match dice.below(10) {
            0..5 => read(world, &station, dice, 1, tally).await,
            5 => read_refused(&station, dice, tally).await,
            6..9 => write(world, &station, dice, 1, tally).await,
            _ => write_refused(world, &station, dice, tally).await,
        },
    }
    world.in_time(began, 1, tally);
}

async fn any(world: &World, station: &Station, dice: &mut Dice, tally: &mut Tally) {
    let number = station.number();
    match dice.below(20) {
        0..=7 => registers(world, station, dice, tally).await,
        8 => {
            // One request has 32 at most.
            let count = small(dice).min(32);
            let first = dice.between(0, READABLE - 2 * count);
            let result = station.read_registers32(Register32::new(Symbol::DR, first).unwrap(), count.into()).await;
            let expected = (0..count).map(|n| dword(number, first + 2 * n));
            let what = format!("station {number}, DR{first}, {count} of them");
            let _ = tally.call(what, (false, world.injected()), result, |got| got.iter().copied().eq(expected));
        }
        9 | 10 => {
            let count = small(dice);
            let first = dice.between(0, DISCRETES - count);
            let result = station.read_discretes(m(first), count.into()).await;
            let expected = (first..first + count).map(|address| bit(number, address));
            let what = format!("station {number}, M{first}, {count} of them");
            let _ = tally.call(what, (false, &[]), result, |got| got.iter().copied().eq(expected));
        }
        11 | 12 => mixed(world, station, dice, tally).await,
        13 => read_refused(station, dice, tally).await,
        14 => write_refused(world, station, dice, tally).await,
        15 | 16 => {
            let run = dice.in_hundred(50);
            let refused = run && number == NO_RUN;
            let result = if run { station.run().await } else { station.stop().await };
            world.controlled(number, run, result.is_ok());
            let right: &[_] = if refused { &[RUN_REFUSED] } else { &[] };
            let _ = tally.call(format!("station {number}, run {run}"), (refused, right), result, |()| true);
        }
        17 | 18 => {
            let result = station.loop_back(format!("{:04X}", dice.below(0x10000))).await;
            let _ = tally.call(format!("station {number}, 4E"), (false, world.loop_back()), result, |()| true);
        }
        _ => {
            let result = station.read_detailed_status().await;
            let _ = tally.call(format!("station {number}, 53"), (false, &[]), result, |_| true);
        }
    }
}

/// A read or a write of registers.
async fn registers(world: &World, station: &Station, dice: &mut Dice, tally: &mut Tally) {
    let count = small(dice);
    match dice.in_hundred(60) {
        true => read(world, station, dice, count, tally).await,
        false => write(world, station, dice, count, tally).await,
    }
}

async fn read(world: &World, station: &Station, dice: &mut Dice, count: u16, tally: &mut Tally) {
    let number = station.number();
    let first = dice.between(0, READABLE - count);
    let result = station.read_registers(r(first), count.into()).await;
    let expected = (first..first + count).map(|address| word(number, address));
    let what = format!("station {number}, R{first}, {count} of them");
    let _ = tally.call(what, (false, world.injected()), result, |got| got.iter().copied().eq(expected));
}

async fn write(world: &World, station: &Station, dice: &mut Dice, count: u16, tally: &mut Tally) {
    let number = station.number();
    let first = dice.between(0, WRITABLE - count);
    let serial = world.serial();
    let result = station.write_registers(d(first), &vec![serial; count.into()]).await;
    world.wrote(number, first, count, serial, &result);
    let what = format!("station {number}, write to D{first}, {count} of them");
    let _ = tally.call(what, (false, world.injected()), result, |()| true);
}

async fn read_refused(station: &Station, dice: &mut Dice, tally: &mut Tally) {
    let number = station.number();
    let first = READABLE + dice.between(0, UNREADABLE - 1);
    let result = station.read_registers(r(first), 1).await;
    let _ = tally.call(format!("station {number}, R{first}"), (true, &[REFUSED]), result, |_| false);
}

async fn write_refused(world: &World, station: &Station, dice: &mut Dice, tally: &mut Tally) {
    let number = station.number();
    let first = WRITABLE + dice.between(0, UNWRITABLE - 1);
    let serial = world.serial();
    let result = station.write_registers(d(first), &[serial]).await;
    world.wrote(number, first, 1, serial, &result);
    let _ = tally.call(format!("station {number}, write to D{first}"), (true, &[REFUSED]), result, |()| false);
}

/// A mixed read or write.
async fn mixed(world: &World, station: &Station, dice: &mut Dice, tally: &mut Tally) {
    let number = station.number();
    if dice.in_hundred(60) {
        let elements: Vec<Element> = (0..dice.between(1, 20))
            .map(|_| match dice.in_hundred(60) {
                true => r(dice.between(0, READABLE - 1)).into(),
                false => m(dice.between(0, DISCRETES - 1)).into(),
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
        // Neighbours, so that it is one write to the audit.
        let first = dice.between(0, WRITABLE - 20);
        let count = dice.between(1, 20);
        let items: Vec<_> =
            (first..first + count).map(|address| (Element::from(d(address)), Value::Word(serial))).collect();
        let result = station.write_mixed(&items).await;
        world.wrote(number, first, count, serial, &result);
        let what = format!("station {number}, mixed write to D{first}, {count} of them");
        let _ = tally.call(what, (false, world.mixed()), result, |()| true);
    }
}

/// Mostly of the same shape, so that a reply could be taken for another.
fn small(dice: &mut Dice) -> u16 {
    match dice.below(100) {
        0..70 => 1,
        70..80 => 3,
        80..95 => dice.between(1, 16),
        _ => dice.between(1, 64),
    }
}
