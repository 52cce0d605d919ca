//! Writes of which the PLC refuses some, while replies come twice.

use std::time::Duration;

use fatek::{Link, Symbol, Value};

use crate::server::{Copies, Copy, READS_AND_WRITES, Setup, Wire, at_random, every, writes_d};
use crate::{DELAYS, PLC_TIMES, Tally, campaign, framing, register, repeats};

const CALLS: u16 = 24;

/// Writes to one register each: those of R are accepted, those of D refused.
async fn write(wire: Wire, copies: Copies, plc_time: Duration, run: usize) -> Tally {
    let server = Setup {
        plc_time,
        framing: framing(run),
        copies,
        glued: run / 2 % 2 == 1,
        refuses: writes_d,
        ..Setup::new(wire)
    }
    .start();
    let link = Link::new(server.endpoint());
    let station = link.station(1).unwrap();
    let mut tally = Tally::default();
    for n in 0..CALLS {
        let refused = (u32::from(n) * 5 + run as u32).is_multiple_of(3);
        let target = register(if refused { Symbol::D } else { Symbol::R }, n);
        let result = station.write_registers(target, &[n + 1000]).await;
        // A write that is reported as done has been executed by then.
        let unexecuted = !refused && result.is_ok() && server.plc.read(target) != Value::Word(n + 1000);
        tally.command(refused || unexecuted, result);
    }
    link.close().await;
    tally.end_run(server.sent().copies);
    tally
}

async fn writes(name: &str, wire: Wire, repeats: usize) -> Tally {
    type Run = Box<dyn Fn(usize) -> std::pin::Pin<Box<dyn Future<Output = Tally> + Send>> + Send + Sync>;
    let mut combinations: Vec<(String, Run)> = vec![];
    for plc_time in PLC_TIMES {
        for copy in DELAYS.map(Copy::after).into_iter().chain([Copy::before_next()]) {
            for copy in [copy, copy.refused()] {
                let label = format!("copy {:?}, refused {}, PLC {plc_time:?}", copy.after, copy.refused);
                combinations.push((
                    label,
                    Box::new(move |run| {
                        Box::pin(write(wire, every(4 + run % 5, READS_AND_WRITES, copy), plc_time, run))
                    }),
                ));
            }
        }
        combinations.push((
            format!("copies at random, PLC {plc_time:?}"),
            Box::new(move |run| {
                let copies = at_random(run as u64, 4, 2 * plc_time + Duration::from_millis(2));
                Box::pin(write(wire, copies, plc_time, run))
            }),
        ));
    }
    campaign(name, repeats, combinations).await
}

// Before: of 182400 writes 29098 wrongly said to be done and 21369 wrongly said to be refused, in 6673 of 7600 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn doubled_replies_do_not_mix_up_writes_over_tcp() {
    let total = writes("mixed writes, TCP", Wire::Tcp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}

// Before: of 182400 writes 30864 wrongly said to be done and 22361 wrongly said to be refused, in 6824 of 7600 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn doubled_replies_do_not_mix_up_writes_over_udp() {
    let total = writes("mixed writes, UDP", Wire::Udp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}
