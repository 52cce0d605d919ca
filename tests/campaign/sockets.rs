//! The campaign over UDP and TCP sockets, in real time. Over UDP each request leaves from another
//! socket, and the network may reorder.

use std::sync::Arc;
use std::time::Duration;

use fatek::endpoint::InStepSettings;
use fatek::sim::{Server, UdpServer};
use fatek::wire::Framing;
use fatek::{Endpoint, Link, LinkBuilder};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use crate::faults::FaultKind::{self, *};
use crate::line::LineKind;
use crate::rng::Rng;
use crate::tally::Tally;
use crate::users::{self, Calls};
use crate::world::World;

/// Faults of the runs over UDP, where copies may arrive at any time.
const FAULT_SETS: [&[FaultKind]; 10] = [
    &[],
    &[CopyAfter],
    &[CopyWithNext],
    &[CopyBeforeNext],
    &[SecondAnswer],
    &[SecondRefusal],
    &[Late],
    &[AnsweredBroadcast],
    &[CopyWithNext, NoMixed, Lost],
    &[RoamingUdp],
];

/// Number of concurrent runs: they mostly wait.
const AT_ONCE: usize = 8;
/// Allowance for late wake-ups on a busy machine.
const GRACE: Duration = Duration::from_secs(2);

async fn run(seed: u64, udp: bool, size: u64) -> Tally {
    let mut rng = Rng(seed);
    let framing = if rng.percent(50) { Framing::Ascii } else { Framing::Binary };
    let faults: Vec<_> = FAULT_SETS[seed as usize % FAULT_SETS.len()].to_vec();
    // Over TCP, requests have no sockets of their own: roaming duplicates cannot be recognised.
    let faults = if udp { faults } else { faults.into_iter().filter(|&kind| kind != RoamingUdp).collect() };
    let mut world = World::new(seed, framing, LineKind::Sockets, faults, InStepSettings::new(), &mut rng);
    world.grace = GRACE;
    let mut tally = Tally { runs: 1, ..Tally::default() };
    let local = "127.0.0.1:0";
    if udp {
        let server = UdpServer::bind(local, world.bus.clone(), framing).await.unwrap();
        let address = server.local_addr();
        let endpoint = Endpoint::udp(address.ip().to_string(), address.port());
        users(&world, endpoint, &mut rng, size, &mut tally).await;
        server.shutdown().await;
    } else {
        let server = Server::bind(local, world.bus.clone(), framing).await.unwrap();
        let address = server.local_addr();
        let endpoint = Endpoint::tcp(address.ip().to_string(), address.port());
        users(&world, endpoint, &mut rng, size, &mut tally).await;
        server.shutdown().await;
    }
    world.audit(&mut tally);
    let setup = format!("seed {seed}, udp {udp}, {framing}, {:?}", world.fault_kinds);
    tally.wrong.iter_mut().for_each(|wrong| *wrong = format!("{setup}: {wrong}"));
    tally
}

/// Runs calls over new links, calls over one link, or long reads and writes.
async fn users(world: &World, endpoint: Endpoint, rng: &mut Rng, size: u64, tally: &mut Tally) {
    let builder = || -> LinkBuilder { world.settings(Link::builder(endpoint.clone().with_framing(world.framing))) };
    match rng.below(3) {
        0 => {
            for _ in 0..size / 2 {
                let link = builder().build();
                for _ in 0..2 {
                    let station = link.station(world.any_station(rng)).unwrap();
                    users::call(world, &station, rng, Calls::All, tally).await;
                }
                tally.links(&link.stats());
                link.close().await;
            }
        }
        1 => {
            let link = builder().build();
            for _ in 0..size {
                let station = link.station(world.any_station(rng)).unwrap();
                users::call(world, &station, rng, Calls::OneShape, tally).await;
            }
            tally.links(&link.stats());
            link.close().await;
        }
        _ => {
            let link = builder().build();
            crate::jobs::long_reads(world, &link, rng, size, tally).await;
            crate::jobs::long_writes(world, &link, rng, size, tally).await;
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
    println!("{}: {total}\n{:#?}", if udp { "UDP" } else { "TCP" }, total.fault_counts);
    total
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_result_belongs_to_another_request_over_sockets() {
    let count = crate::setting("FATEK_CAMPAIGN").map_or(30, |requests| (requests / 1000).clamp(30, 600));
    let (udp, tcp) = tokio::join!(runs(true, count, 40), runs(false, count, 40));
    for total in [udp, tcp] {
        assert!(total.is_sound(), "{} late, {:#?}", total.late, total.wrong);
        let never: Vec<_> = total.fault_counts.iter().filter(|&(_, &count)| count == 0).collect();
        assert!(never.is_empty(), "faults that were never injected: {never:?}");
        total.assert_right(80);
    }
}
