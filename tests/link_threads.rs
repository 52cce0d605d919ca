//! Many threads share a link: callers that write their requests themselves, the link's task, and a
//! close.
#![cfg(feature = "sim")]

use std::time::Duration;

use fatek::sim::{self, Bus, Plc};
use fatek::wire::Framing;
use fatek::{Error, Link, Register};
use tokio::task::JoinSet;
use tokio::time::timeout;

const CALLERS: u16 = 32;
/// Limit for a whole test: if it passes, a call was lost.
const LIMIT: Duration = Duration::from_secs(120);

fn link(framing: Framing) -> Link {
    let plc = Plc::new();
    for address in 0..CALLERS {
        plc.write(Register::r(address), 1000 + address).unwrap();
    }
    let bus = Bus::new().with_station(1, plc).unwrap();
    Link::connector_builder("threads", framing, sim::connector(bus, framing)).build()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn callers_of_all_threads_get_their_own_values() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let link = link(framing);
        let mut callers = JoinSet::new();
        for address in 0..CALLERS {
            let station = link.station(1).unwrap();
            callers.spawn(async move {
                for n in 0..200 {
                    let call = station.read_registers(Register::r(address), 1);
                    if n % 7 == 0 {
                        // Cancelled at some point.
                        let _ = timeout(Duration::from_micros(u64::from(address) * 10), call).await;
                    } else {
                        assert_eq!(call.await.unwrap(), [1000 + address]);
                    }
                }
            });
        }
        timeout(LIMIT, callers.join_all()).await.unwrap();
        assert_eq!(link.stats().disconnects, 0, "{framing}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn closing_ends_the_calls_of_all_threads() {
    for n in 0..50 {
        let link = link(Framing::Binary);
        let mut callers = JoinSet::new();
        for address in 0..CALLERS {
            let station = link.station(1).unwrap();
            callers.spawn(async move {
                loop {
                    match station.read_registers(Register::r(address), 1).await {
                        Ok(values) => assert_eq!(values, [1000 + address]),
                        Err(error) => return assert!(matches!(error, Error::Closed { .. }), "{error}"),
                    }
                }
            });
        }
        tokio::time::sleep(Duration::from_micros(n * 100)).await;
        timeout(LIMIT, link.close()).await.unwrap();
        timeout(LIMIT, callers.join_all()).await.unwrap();
    }
}
