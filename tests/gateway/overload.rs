//! More clients than the bus can serve.

use std::time::Duration;

use bytes::BytesMut;
use fatek::command::{ReadRegisters, WriteRegisters, encode_request};
use fatek::sim::{Faults, Line};
use fatek::wire::Framing;
use fatek::{Register, Value};
use tokio::time::{Instant, sleep, timeout};

use crate::bench::{Bench, CALL_TIMEOUT, UNRESTRICTED};

const MS: Duration = Duration::from_millis(1);

/// Each client gives up after 290 ms, closes its connection, and asks anew. The PLC serves 50
/// requests a second.
///
/// With calls sent that come too late: 20 clients had 32 good replies a second.
#[tokio::test(start_paused = true)]
async fn goodput_stays_at_the_capacity_at_any_number_of_clients() {
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

/// Before, the write was executed 50 ms after its client had gone.
#[tokio::test(start_paused = true)]
async fn a_queued_request_of_a_client_that_hung_up_is_not_sent() {
    let slow = Faults::new(0).line(Line::new(0).response_time(50 * MS, 50 * MS));
    let bench = Bench::with_faults(Framing::Ascii, UNRESTRICTED, slow, CALL_TIMEOUT);
    let (mut first, mut second) = (bench.client(Framing::Ascii), bench.client(Framing::Ascii));
    let read = ReadRegisters::new(Register::d(0), 1).unwrap();
    let write = WriteRegisters::new(Register::r(5), [7]).unwrap();
    let reading = tokio::spawn(async move { first.call(1, &read).await.is_ok() });
    sleep(10 * MS).await;
    let mut bytes = BytesMut::new();
    encode_request(&write, Framing::Ascii, 1, &mut bytes).unwrap();
    second.send(&bytes).await;
    sleep(10 * MS).await;
    drop(second);
    assert!(reading.await.unwrap());
    sleep(CALL_TIMEOUT).await;
    assert_eq!(bench.plcs[0].read(Register::r(5)), Value::Word(0));
}
