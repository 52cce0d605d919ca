//! Calls of four tasks that share a link and a station, with duplicate replies.

use std::time::Duration;

use fatek::Link;

use crate::server::{Copies, Copy, READS, Setup, Transport, at_random, every};
use crate::{DELAYS, PLC_TIMES, Tally, campaign, framing, r, repeats};

const TASKS: u16 = 4;
const CALLS: u16 = 12;
/// Registers of each call.
const COUNT: u16 = 3;

async fn read(transport: Transport, copies: Copies, plc_time: Duration, run: usize) -> Tally {
    let server =
        Setup { plc_time, framing: framing(run), copies, in_one_segment: run / 2 % 2 == 1, ..Setup::new(transport) }
            .start();
    let link = Link::new(server.endpoint());
    let mut tasks = tokio::task::JoinSet::new();
    for task in 0..TASKS {
        let station = link.station(1).unwrap();
        tasks.spawn(async move {
            let mut tally = Tally::default();
            for call in 0..CALLS {
                // No two calls read the same registers.
                let first = (task * CALLS + call) * COUNT;
                tally.read(first, station.read_registers(r(first), COUNT.into()).await);
            }
            tally
        });
    }
    let mut total = Tally::default();
    tasks.join_all().await.into_iter().for_each(|tally| total.add(tally));
    link.close().await;
    total.end_run(server.sent().copies);
    total
}

async fn reads(name: &str, transport: Transport, repeats: usize) -> Tally {
    type Run = Box<dyn Fn(usize) -> std::pin::Pin<Box<dyn Future<Output = Tally> + Send>> + Send + Sync>;
    let mut combinations: Vec<(String, Run)> = vec![];
    for plc_time in PLC_TIMES {
        let copies = DELAYS.map(Copy::after).into_iter().chain([Copy::before_next()]);
        for copy in copies {
            // The refusal: a PLC that executes the request again while it cannot answer.
            for copy in [copy, copy.refused()] {
                let label = format!("copy {:?}, refused {}, PLC {plc_time:?}", copy.after, copy.refused);
                combinations.push((
                    label,
                    Box::new(move |run| Box::pin(read(transport, every(7 + run % 5, READS, copy), plc_time, run))),
                ));
            }
        }
        combinations.push((
            format!("copies at random, PLC {plc_time:?}"),
            Box::new(move |run| {
                let copies = at_random(run as u64, 4, 2 * plc_time + Duration::from_millis(2));
                Box::pin(read(transport, copies, plc_time, run))
            }),
        ));
    }
    campaign(name, repeats, combinations).await
}

// Before: 301653 wrong values of 1049115, and 15095 of 364800 reads reported as refused, in 6961 of
// 7600 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn duplicate_replies_do_not_shift_calls_of_four_tasks_over_tcp() {
    let total = reads("calls of four tasks, TCP", Transport::Tcp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}

// Before: 310212 wrong values of 1049079, and 15107 of 364800 reads reported as refused, in 7062 of
// 7600 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn duplicate_replies_do_not_shift_calls_of_four_tasks_over_udp() {
    let total = reads("calls of four tasks, UDP", Transport::Udp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}
