//! More clients than the bus can serve.

use std::time::Duration;

use fatek::Register;
use fatek::command::ReadRegisters;
use fatek::sim::{Faults, Line};
use fatek::wire::Framing;
use tokio::time::{Instant, timeout};

use crate::bench::{Bench, UNRESTRICTED};

const MS: Duration = Duration::from_millis(1);

/// Each client gives up after 290 ms, closes its connection, and asks anew. The PLC serves 50
/// requests a second.
///
/// Before: with 20 clients hardly a good reply, for the gateway served those that had gone.
#[tokio::test(start_paused = true)]
async fn requests_of_clients_that_hung_up_are_not_sent() {
    for clients in [4_u16, 12, 20, 60] {
        let slow = Faults::new(0).line(Line::new(0).response_time(20 * MS, 20 * MS));
        // As the gateway's help says: less than the timeout of the clients.
        let bench = Bench::with_faults(Framing::Ascii, UNRESTRICTED, slow, 280 * MS);
        let end = Instant::now() + Duration::from_secs(20);
        let tasks = (0..clients).map(|number| {
            let bench = &bench;
            async move {
                let (mut good, mut client) = (0_u32, bench.client(Framing::Ascii));
                let request = ReadRegisters::new(Register::d(number), 1).unwrap();
                while Instant::now() < end {
                    match timeout(290 * MS, client.call(1, &request)).await {
                        Ok(reply) => good += u32::from(reply.is_ok()),
                        Err(_) => client = bench.client(Framing::Ascii),
                    }
                }
                good
            }
        });
        let good: u32 = futures::future::join_all(tasks).await.into_iter().sum();
        let good = f64::from(good) / 20.0;
        println!("{clients} clients: {good:.1} good replies a second");
        assert!(good >= 45.0, "{clients} clients: {good:.1} good replies a second");
    }
}
