//! The driver on a stream of the crate's own, which wakes its reader whenever it has data, and on
//! one of a user's, which may not.

use std::time::Duration;

use futures::future::join_all;
use tokio::task::yield_now;
use tokio::time::Instant;

use super::MAX_BYTES_AT_ONCE;
use crate::link::buffer;
use crate::link::test_line::Line;
use crate::{CallOptions, Error, register};

#[tokio::test(start_paused = true)]
async fn a_reply_repeated_during_broadcasts_is_not_the_next_reads() {
    let line = Line::default();
    line.plc().value = 1;
    let link = line.builder(true).build();
    let station = link.station(1).expect("a station");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [1]);
    // All of them wait for the first read, and are then sent in one go.
    let (all, first) = (link.broadcast(), station.read_registers(register!("R0"), 1));
    let casts = join_all((0..20).map(|_| all.write_registers(register!("R0"), &[2])));
    let (first, casts, second) = tokio::join!(first, casts, station.read_registers(register!("R0"), 1));
    assert_eq!(first.expect("it answers"), [1]);
    assert!(casts.iter().all(Result::is_ok) && line.plc().broadcasts == 20);
    assert_eq!(second.expect("it answers"), [2]);
    assert_eq!(line.plc().unread, 0, "received data were read before the next request");
    assert_eq!(station.stats().duplicates, 1);
}

#[tokio::test(start_paused = true)]
async fn an_unwritable_request_costs_the_connection_at_its_timeout() {
    let line = Line::default();
    let link = line.builder(true).build();
    let timeout = Duration::from_millis(700);
    let options = CallOptions::new().with_retries(0).with_response_timeout(timeout);
    let station = link.station(1).expect("a station").with_options(options);
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    line.plc().stuck = true;
    let began = Instant::now();
    let error = station.read_registers(register!("R0"), 1).await.expect_err("it does not get there");
    assert!(matches!(error, Error::Disconnected { sent: true, .. }), "{error:?}");
    assert!(error.to_string().ends_with(": the request was not written in time"), "{error}");
    assert!(std::error::Error::source(&error).is_none(), "the text has the cause already");
    let took = began.elapsed();
    assert!((timeout..timeout * 2).contains(&took), "{took:?}");
    line.plc().stuck = false;
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("over the next one"), [0]);
    assert_eq!((link.stats().connects, link.stats().disconnects), (2, 1));
}

#[tokio::test(start_paused = true)]
async fn a_stream_that_does_not_wake_its_reader_is_read_before_each_request() {
    let line = Line::default();
    let link = line.builder(false).build();
    let station = link.station(1).expect("a station");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    {
        let plc = &mut *line.plc();
        plc.received.extend(&plc.answered);
        plc.value = 2;
    }
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [2]);
    assert_eq!((line.plc().unread, station.stats().duplicates), (0, 1));
}

#[tokio::test(start_paused = true)]
async fn a_flood_of_bytes_is_read_to_its_end() {
    let line = Line::default();
    let link = line.builder(true).build();
    let station = link.station(1).expect("a station");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    line.plc().send(&vec![0xFF; 3 * MAX_BYTES_AT_ONCE]);
    for _ in 0..20 {
        yield_now().await;
    }
    assert_eq!(line.plc().received.len(), 0, "it is read in turns with other tasks");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    assert_eq!(usize::try_from(link.stats().garbage_bytes), Ok(3 * MAX_BYTES_AT_ONCE));
}

/// A frame that begins at the end of a read. Before: each later read of the flood took one byte, the room
/// that was left behind the bytes before it.
#[tokio::test(start_paused = true)]
async fn each_read_of_a_flood_has_room_for_a_frame() {
    let line = Line::default();
    let link = line.builder(true).build();
    let station = link.station(1).expect("a station");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    let mut flood = vec![0xFF; MAX_BYTES_AT_ONCE];
    flood.iter_mut().skip(buffer::LEN - 1).step_by(buffer::LEN).for_each(|byte| *byte = 0x02);
    line.plc().send(&flood);
    line.plc().reads = 0;
    for _ in 0..20 {
        yield_now().await;
    }
    assert_eq!(line.plc().received.len(), 0);
    let reads = line.plc().reads;
    assert!(reads <= 2 * MAX_BYTES_AT_ONCE / buffer::LEN, "{reads} reads");
}
