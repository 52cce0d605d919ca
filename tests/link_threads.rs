//! Many threads at one link: callers that put their requests on the wire themselves, the link's task, and one who closes it all.
#![cfg(feature = "sim")]

use std::time::Duration;

use fatek::sim::{self, Bus, Plc};
use fatek::wire::Framing;
use fatek::{Error, Link, Register};
use tokio::task::JoinSet;
use tokio::time::timeout;

const CALLERS: u16 = 32;
/// Far more than it takes: if this passes, a call was forgotten.
const ALL_OF_IT: Duration = Duration::from_secs(120);

fn link(framing: Framing) -> Link {
    let plc = Plc::new();
    for address in 0..CALLERS {
        plc.write(Register::r(address), 1000 + address).unwrap();
    }
    let bus = Bus::new().with_station(1, plc).unwrap();
    Link::connector_builder("threads", framing, sim::connector(bus, framing)).build()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn every_caller_of_any_thread_gets_its_own_values_and_none_is_forgotten() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let link = link(framing);
        let mut callers = JoinSet::new();
        for address in 0..CALLERS {
            let station = link.station(1).unwrap();
            callers.spawn(async move {
                for n in 0..200 {
                    let call = station.read_registers(Register::r(address), 1);
                    if n % 7 == 0 {
                        // Given up at some point, wherever that is.
                        let _ = timeout(Duration::from_micros(u64::from(address) * 10), call).await;
                    } else {
                        assert_eq!(call.await.unwrap(), [1000 + address]);
                    }
                }
            });
        }
        timeout(ALL_OF_IT, callers.join_all()).await.unwrap();
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
        timeout(ALL_OF_IT, link.close()).await.unwrap();
        timeout(ALL_OF_IT, callers.join_all()).await.unwrap();
    }
}
