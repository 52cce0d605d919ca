//! The same over UDP and sockets, in real time: each request goes out from the next of several sockets, and the network
//! may reorder.

use std::sync::Arc;
use std::time::Duration;

use fatek::endpoint::InStepSettings;
use fatek::sim::{Server, UdpServer};
use fatek::wire::Framing;
use fatek::{Endpoint, Link, LinkBuilder};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use crate::plant::Dice;
use crate::tally::Tally;
use crate::troubles::Trouble::{self, *};
use crate::users::{self, Calls};
use crate::wire::Wire;
use crate::world::World;

/// What goes wrong over UDP, where copies may come at any time.
const TROUBLES: [&[Trouble]; 10] = [
    &[],
    &[CopyAfter],
    &[CopyWithNext],
    &[CopyBeforeNext],
    &[SecondAnswer],
    &[SecondRefusal],
    &[Late],
    &[AnsweredBroadcast],
    &[CopyWithNext, NoMixed, Lost],
    &[Roams],
];

/// Runs at a time: they mostly wait.
const AT_ONCE: usize = 8;
/// A busy machine wakes a caller late.
const GRACE: Duration = Duration::from_secs(2);

async fn run(seed: u64, udp: bool, size: u64) -> Tally {
    let mut dice = Dice(seed);
    let framing = if dice.in_hundred(50) { Framing::Ascii } else { Framing::Binary };
    let troubles: Vec<_> = TROUBLES[seed as usize % TROUBLES.len()].to_vec();
    // Without sockets of its own to tell requests apart, TCP has no way to know a copy that keeps no order.
    let troubles = if udp { troubles } else { troubles.into_iter().filter(|&it| it != Roams).collect() };
    let mut world = World::new(seed, framing, Wire::Sockets, troubles, InStepSettings::new(), &mut dice);
    world.grace = GRACE;
    let mut tally = Tally { runs: 1, ..Tally::default() };
    let local = "127.0.0.1:0";
    if udp {
        let server = UdpServer::bind(local, world.bus.clone(), framing).await.unwrap();
        let address = server.local_addr();
        let endpoint = Endpoint::udp(address.ip().to_string(), address.port());
        users(&world, endpoint, &mut dice, size, &mut tally).await;
        server.shutdown().await;
    } else {
        let server = Server::bind(local, world.bus.clone(), framing).await.unwrap();
        let address = server.local_addr();
        let endpoint = Endpoint::tcp(address.ip().to_string(), address.port());
        users(&world, endpoint, &mut dice, size, &mut tally).await;
        server.shutdown().await;
    }
    world.audit(&mut tally);
    let setup = format!("seed {seed}, udp {udp}, {framing}, {:?}", world.troubles);
    tally.wrong.iter_mut().for_each(|wrong| *wrong = format!("{setup}: {wrong}"));
    tally
}

/// Calls over one link, or over links of their own, and then long reads.
async fn users(world: &World, endpoint: Endpoint, dice: &mut Dice, size: u64, tally: &mut Tally) {
    let builder = || -> LinkBuilder { world.settings(Link::builder(endpoint.clone().with_framing(world.framing))) };
    match dice.below(3) {
        0 => {
            for _ in 0..size / 2 {
                let link = builder().build();
                for _ in 0..2 {
                    let station = link.station(world.any_station(dice)).unwrap();
                    users::call(world, &station, dice, Calls::All, tally).await;
                }
                tally.links(&link.stats());
                link.close().await;
            }
        }
        1 => {
            let link = builder().build();
            for _ in 0..size {
                let station = link.station(world.any_station(dice)).unwrap();
                users::call(world, &station, dice, Calls::OneShape, tally).await;
            }
            tally.links(&link.stats());
            link.close().await;
        }
        _ => {
            let link = builder().build();
            crate::jobs::long_reads(world, &link, dice, size, tally).await;
            crate::jobs::long_writes(world, &link, dice, size, tally).await;
            tally.links(&link.stats());
            link.close().await;
        }
    }
}

async fn runs(udp: bool, count: u64, size: u64) -> Tally {
    let permits = Arc::new(Semaphore::new(AT_ONCE));
    let mut set = JoinSet::new();
    for seed in 0..count {
        let permits = permits.clone();
        set.spawn(async move {
            let _permit = permits.acquire().await.unwrap();
            run(seed, udp, size).await
        });
    }
    let mut total = Tally::default();
    set.join_all().await.into_iter().for_each(|tally| total.add(tally));
    println!("{}: {total}\n{:#?}", if udp { "UDP" } else { "TCP" }, total.struck);
    total
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_ever_one_behind_over_sockets() {
    let count = crate::setting("FATEK_CAMPAIGN").map_or(30, |requests| (requests / 1000).clamp(30, 600));
    let (udp, tcp) = tokio::join!(runs(true, count, 40), runs(false, count, 40));
    for total in [udp, tcp] {
        assert!(total.is_sound(), "{} late, {:#?}", total.late, total.wrong);
        let never: Vec<_> = total.struck.iter().filter(|&(_, &count)| count == 0).collect();
        assert!(never.is_empty(), "every fault has struck: {never:?}");
        total.assert_right(80);
    }
}
