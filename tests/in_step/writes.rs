//! Writes, some of which the PLC refuses, with duplicate replies.

use std::time::Duration;

use fatek::{Link, Symbol, Value};

use crate::server::{Copies, Copy, READS_AND_WRITES, Setup, Transport, at_random, every, writes_d};
use crate::{DELAYS, PLC_TIMES, Tally, campaign, framing, register, repeats};

const CALLS: u16 = 24;

/// Writes to one register each. The PLC refuses those to D.
async fn write(transport: Transport, copies: Copies, plc_time: Duration, run: usize) -> Tally {
    let server = Setup {
        plc_time,
        framing: framing(run),
        copies,
        in_one_segment: run / 2 % 2 == 1,
        refuses: writes_d,
        ..Setup::new(transport)
    }
    .start();
    let link = Link::new(server.endpoint());
    let station = link.station(1).unwrap();
    let mut tally = Tally::default();
    for n in 0..CALLS {
        let refused = (u32::from(n) * 5 + run as u32).is_multiple_of(3);
        let target = register(if refused { Symbol::D } else { Symbol::R }, n);
        let result = station.write_registers(target, &[n + 1000]).await;
        // A write that is reported as done must have been executed.
        let unexecuted = !refused && result.is_ok() && server.plc.read(target) != Value::Word(n + 1000);
        tally.command(refused || unexecuted, result);
    }
    link.close().await;
    tally.end_run(server.sent().copies);
    tally
}

async fn writes(name: &str, transport: Transport, repeats: usize) -> Tally {
    type Run = Box<dyn Fn(usize) -> std::pin::Pin<Box<dyn Future<Output = Tally> + Send>> + Send + Sync>;
    let mut combinations: Vec<(String, Run)> = vec![];
    for plc_time in PLC_TIMES {
        for copy in DELAYS.map(Copy::after).into_iter().chain([Copy::before_next()]) {
            for copy in [copy, copy.refused()] {
                let label = format!("copy {:?}, refused {}, PLC {plc_time:?}", copy.after, copy.refused);
                combinations.push((
                    label,
                    Box::new(move |run| {
                        Box::pin(write(transport, every(4 + run % 5, READS_AND_WRITES, copy), plc_time, run))
                    }),
                ));
            }
        }
        combinations.push((
            format!("copies at random, PLC {plc_time:?}"),
            Box::new(move |run| {
                let copies = at_random(run as u64, 4, 2 * plc_time + Duration::from_millis(2));
                Box::pin(write(transport, copies, plc_time, run))
            }),
        ));
    }
    campaign(name, repeats, combinations).await
}

// Before: of 182400 writes 29098 wrongly reported as done and 21369 wrongly reported as refused, in
// 6673 of 7600 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn duplicate_replies_do_not_mix_up_writes_over_tcp() {
    let total = writes("mixed writes, TCP", Transport::Tcp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}

// Before: of 182400 writes 30864 wrongly reported as done and 22361 wrongly reported as refused, in
// 6824 of 7600 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn duplicate_replies_do_not_mix_up_writes_over_udp() {
    let total = writes("mixed writes, UDP", Transport::Udp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}
