//! Streams that block within a write or a flush, as serial ports do: times after a request count
//! from the end of the flush.
#![cfg(feature = "sim")]

mod peer;

use std::future::Future;
use std::io;
use std::pin::{Pin, pin};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;

use fatek::wire::Framing;
use fatek::{CallOptions, Link, register};
use tokio::io::{AsyncRead, AsyncWrite, DuplexStream, ReadBuf, duplex};
use tokio::time::{Instant, advance, sleep};

use peer::{Peer, station, without_duplicates};

/// A stream whose flush takes this time and blocks all tasks.
struct SlowStream {
    stream: DuplexStream,
    flush_time: Duration,
    /// Start of each write and end of each flush.
    log: Arc<Mutex<Vec<(&'static str, Instant)>>>,
}

impl AsyncRead for SlowStream {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, into)
    }
}

impl AsyncWrite for SlowStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.log.lock().unwrap().push(("write", Instant::now()));
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        // Time passes with the first poll; the second would only yield.
        let _ = pin!(advance(self.flush_time)).poll(cx);
        self.log.lock().unwrap().push(("flushed", Instant::now()));
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[tokio::test(start_paused = true)]
async fn the_broadcast_gap_begins_after_the_flush() {
    let (client, plc) = duplex(4096);
    let log = Arc::new(Mutex::new(Vec::new()));
    let slow = SlowStream { stream: client, flush_time: Duration::from_millis(80), log: log.clone() };
    let pause = Duration::from_millis(60);
    let link = Link::stream_builder(slow, Framing::Ascii).broadcast_gap(pause).in_step(without_duplicates()).build();
    tokio::spawn(Peer::new(plc).serve());
    let plc = station(&link);
    plc.read_status().await.unwrap();
    link.broadcast().write_registers(register!("R0"), &[1]).await.unwrap();
    plc.read_status().await.unwrap();
    let log = log.lock().unwrap();
    assert_eq!(log.iter().map(|(what, _)| *what).collect::<Vec<_>>(), ["write", "flushed"].repeat(4));
    // After the check and the first request.
    assert_eq!(log[5].1 - log[4].1, Duration::from_millis(80), "the flush of the broadcast blocks");
    assert!(
        log[6].1 - log[5].1 >= pause,
        "the next request came {:?} after the end of the broadcast",
        log[6].1 - log[5].1
    );
}

#[tokio::test(start_paused = true)]
async fn the_response_timeout_begins_after_the_flush() {
    let (client, plc) = duplex(4096);
    let slow = SlowStream { stream: client, flush_time: Duration::from_millis(120), log: Arc::default() };
    let link = Link::stream_builder(slow, Framing::Ascii).build();
    let mut peer = Peer::new(plc);
    let options = CallOptions::new().with_retries(0).with_response_timeout(Duration::from_millis(100));
    let plc = station(&link).with_options(options);
    let answers = async {
        assert_eq!(peer.request().await.command, 0x47);
        sleep(Duration::from_millis(40)).await;
        peer.reply(1, 0x47, "0").await;
    };
    let values = [1];
    let (written, ()) = tokio::join!(plc.write_registers(register!("R0"), &values), answers);
    written.unwrap();
}
