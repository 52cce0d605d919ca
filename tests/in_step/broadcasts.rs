//! PLCs that answer broadcasts: the answer is not the reply to the next request.

use std::time::Duration;

use fatek::{ErrorCode, Link, Symbol};

use crate::server::{Setup, Transport, writes_d};
use crate::{PLC_TIMES, Tally, campaign, framing, register, repeats};

/// Broadcasts STOP and calls RUN, which is refused; broadcasts a write and makes one that is
/// refused.
async fn commands(transport: Transport, number: u8, plc_time: Duration, run: usize) -> Tally {
    let setup = Setup::new(transport);
    let server =
        Setup { plc_time, framing: framing(run), broadcast_reply: Some(number), refuses: writes_d, ..setup }.start();
    server.plc.refuse_run(Some(ErrorCode::Syntax));
    let link = Link::new(server.endpoint());
    let (station, everyone) = (link.station(1).unwrap(), link.broadcast());
    let mut tally = Tally::default();
    for n in 0..4 {
        everyone.stop().await.unwrap();
        tally.command(true, station.run().await);
        everyone.write_registers(register(Symbol::R, n), &[n]).await.unwrap();
        tally.command(true, station.write_registers(register(Symbol::D, n), &[n]).await);
    }
    assert!(!server.plc.is_running());
    link.close().await;
    tally.end_run(0);
    tally
}

async fn campaigns(name: &str, transport: Transport, repeats: usize) -> Tally {
    let mut combinations = vec![];
    for number in [1, 0] {
        for plc_time in PLC_TIMES.into_iter().chain([Duration::from_millis(120)]) {
            let run = move |run| commands(transport, number, plc_time, run);
            combinations.push((format!("answered under {number:02}, PLC {plc_time:?}"), run));
        }
    }
    campaign(name, repeats, combinations).await
}

// Before: 2834 of 8000 refused commands reported as done, in 500 of 1000 runs: all with a PLC that
// answers under 01.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_answered_broadcast_is_not_the_next_reply_over_tcp() {
    let total = campaigns("answered broadcasts, TCP", Transport::Tcp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}

// Before: 2838 of 8000 refused commands reported as done, in 500 of 1000 runs: all with a PLC that
// answers under 01.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_answered_broadcast_is_not_the_next_reply_over_udp() {
    let total = campaigns("answered broadcasts, UDP", Transport::Udp, repeats()).await;
    total.assert_nothing_wrong();
    total.assert_nearly_all_correct();
}

// Before: 25 of 400 refused commands reported as done, in 5 of 50 runs: the PLC took longer than
// the pause of 100 ms.
#[cfg(all(unix, feature = "serial"))]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_answered_broadcast_is_not_the_next_reply_on_a_serial_line() {
    let total = campaigns("answered broadcasts, 115200 baud", crate::SERIAL, repeats().min(5)).await;
    total.assert_nothing_wrong();
}
