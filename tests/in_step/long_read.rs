//! Reads of several requests with a duplicate of one reply.

use std::time::Duration;

use fatek::Link;

use crate::server::{Copy, READS, Setup, Transport, nth};
use crate::{DELAYS, PLC_TIMES, Tally, campaign, framing, r, repeats};

/// Reads R0 to R999 over a new link. Even runs copy the fifth reply, odd runs any but the last.
async fn read(transport: Transport, delay: Duration, plc_time: Duration, run: usize) -> Tally {
    let n = if run.is_multiple_of(2) { 5 } else { 1 + run * 7 % 15 };
    let server = Setup {
        plc_time,
        framing: framing(run / 2),
        copies: nth(n, READS, Copy::after(delay)),
        in_one_segment: run / 4 % 2 == 1,
        ..Setup::new(transport)
    }
    .start();
    let link = Link::new(server.endpoint());
    let mut tally = Tally::default();
    tally.read(0, link.station(1).unwrap().read_registers(r(0), 1000).await);
    link.close().await;
    tally.end_run(server.sent().copies);
    tally
}

async fn reads(name: &str, transport: Transport, repeats: usize) -> Tally {
    let mut combinations = vec![];
    for delay in DELAYS {
        for plc_time in PLC_TIMES {
            let run = move |run| read(transport, delay, plc_time, run);
            combinations.push((format!("copy after {delay:?}, PLC {plc_time:?}"), run));
        }
    }
    let total = campaign(name, repeats, combinations).await;
    assert!(total.copies * 100 >= total.runs * 95, "a copy in each run: {total}");
    total
}

// Before: 676480 wrong values of 3200000, in 2619 of 3200 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_duplicate_reply_does_not_shift_a_long_read_over_tcp() {
    let total = reads("long read, TCP", Transport::Tcp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}

// Before: 693184 wrong values of 3200000, in 2606 of 3200 runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_duplicate_reply_does_not_shift_a_long_read_over_udp() {
    let total = reads("long read, UDP", Transport::Udp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}

// Before: 56064 wrong values of 160000, in 126 of 160 runs.
#[cfg(all(unix, feature = "serial"))]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_duplicate_reply_does_not_shift_a_long_serial_read() {
    let total = reads("long read, 115200 baud", crate::SERIAL, repeats().min(5)).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}
