//! Settings of a link: their effect, and what the handles report.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use fatek::endpoint::InStepSettings;
use fatek::wire::Framing;
use fatek::{CallOptions, Endpoint, Link, LinkState, StationState, register};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf, duplex};
use tokio::time::Instant;

mod peer;

use peer::{Peer, once, station, without_duplicates};

const SHORT: Duration = Duration::from_millis(200);

/// Creates a link with a short response timeout, and the peer.
fn line() -> (Link, Peer) {
    line_with(without_duplicates())
}

fn line_with(in_step: InStepSettings) -> (Link, Peer) {
    let (client, plc) = duplex(4096);
    let mut client = Some(client);
    let builder = Link::connector_builder("a line", Framing::Ascii, move || {
        let client = client.take();
        async move { client.ok_or_else(|| io::ErrorKind::NotFound.into()) }
    });
    (builder.response_timeout(SHORT).in_step(in_step).build(), Peer::new(plc))
}

#[test]
fn a_link_displays_its_endpoint_and_framing() {
    for (url, framing) in
        [("tcp://127.0.0.1:500", Framing::Ascii), ("tcp://127.0.0.1:500?framing=binary", Framing::Binary)]
    {
        let endpoint: Endpoint = url.parse().unwrap();
        let link = Link::builder(endpoint.clone()).build();
        assert_eq!(link.framing(), framing);
        assert_eq!(format!("{link:?}"), format!("Link({endpoint}, {framing})"));
        assert!(matches!(link.state(), LinkState::Idle));
    }
}

#[tokio::test(start_paused = true)]
async fn a_probe_uses_the_response_timeout_of_the_link() {
    let (link, mut peer) = line();
    let station = once(&station(&link));
    let mut states = link.station(1).unwrap().watch_state();
    let failing = tokio::spawn(async move {
        for _ in 0..3 {
            station.read_registers(register!("R1"), 1).await.unwrap_err();
        }
    });
    // Three timeouts, and a probe that is not answered either.
    for _ in 0..4 {
        peer.request().await;
    }
    failing.await.unwrap();
    let began = Instant::now();
    let StationState::Offline { probe_at: before, .. } = *states.borrow_and_update() else { panic!("it is offline") };
    states.changed().await.unwrap();
    let StationState::Offline { probe_at: after, .. } = *states.borrow_and_update() else { panic!("it is offline") };
    assert!(after > before);
    assert_eq!(began.elapsed(), SHORT);
}

#[tokio::test(start_paused = true)]
async fn the_quiet_time_after_a_refused_check_is_configurable() {
    // At least the response timeout: the reply to a request may take that long.
    for (quiet, expected) in [(SHORT * 3, SHORT * 3), (SHORT / 2, SHORT)] {
        let (link, mut peer) = line_with(without_duplicates().with_quiet(quiet));
        let station = once(&station(&link));
        let calls = tokio::spawn(async move {
            station.read_registers(register!("R1"), 1).await.unwrap_err();
            station.read_registers(register!("R1"), 1).await.unwrap()
        });
        peer.request().await;
        assert_eq!(peer.request().await.command, 0x4E);
        peer.reply(1, 0x4E, "4").await;
        let refused = Instant::now();
        assert_eq!(peer.request().await.command, 0x46);
        assert_eq!(refused.elapsed(), expected);
        peer.reply(1, 0x46, "00007").await;
        assert_eq!(calls.await.unwrap(), [7]);
    }
}

#[tokio::test(start_paused = true)]
async fn an_adaptive_timeout_shrinks_to_its_minimum() {
    let shortest = Duration::from_millis(50);
    let (link, mut peer) = line();
    let options = CallOptions::new().with_retries(0).with_adaptive_timeout(shortest);
    let station = station(&link).with_options(options);
    let calls = tokio::spawn(async move {
        let mut times = Vec::new();
        for _ in 0..22 {
            let began = Instant::now();
            let _ = station.read_registers(register!("R1"), 1).await;
            times.push(began.elapsed());
        }
        times
    });
    // The check is not answered, so the next one has no estimate either.
    assert_eq!(peer.any_request().await.unwrap().command, 0x4E);
    for _ in 0..20 {
        peer.request().await;
        peer.reply(1, 0x46, "00001").await;
    }
    peer.request().await;
    let times = calls.await.unwrap();
    assert_eq!(times.first(), Some(&SHORT), "no estimate yet");
    assert_eq!(times.last(), Some(&shortest));
}

/// A stream that never yields data and fails each write.
struct BrokenStream;

impl AsyncRead for BrokenStream {
    fn poll_read(self: Pin<&mut Self>, _: &mut Context<'_>, _: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Poll::Pending
    }
}

impl AsyncWrite for BrokenStream {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, _: &[u8]) -> Poll<io::Result<usize>> {
        Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

/// Creates a link over these connections, one after the other.
fn over(connections: Vec<Box<dyn Stream>>) -> Link {
    let mut connections = connections.into_iter();
    Link::connector_builder("a line", Framing::Ascii, move || {
        let next = connections.next();
        async move { next.ok_or_else(|| io::ErrorKind::NotFound.into()) }
    })
    .build()
}

trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Stream for T {}

#[tokio::test(start_paused = true)]
async fn a_failed_write_reconnects_and_retries_the_read() {
    let (client, plc) = duplex(4096);
    let link = over(vec![Box::new(BrokenStream), Box::new(client)]);
    let serving = tokio::spawn(Peer::new(plc).serve());
    station(&link).read_status().await.unwrap();
    let stats = link.stats();
    assert_eq!((stats.connects, stats.disconnects, stats.stations.retries), (2, 1, 1));
    drop(link);
    serving.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn the_next_call_reconnects_after_the_plc_hangs_up() {
    let ((first, plc), (second, next)) = (duplex(4096), duplex(4096));
    let link = over(vec![Box::new(first), Box::new(second)]);
    let plc = tokio::spawn(async move {
        let mut peer = Peer::new(plc);
        peer.request().await;
        peer.reply(1, 0x40, "0010000").await;
    });
    station(&link).read_status().await.unwrap();
    plc.await.unwrap();
    let serving = tokio::spawn(Peer::new(next).serve());
    station(&link).read_status().await.unwrap();
    assert_eq!((link.stats().connects, link.stats().disconnects), (2, 1));
    drop(link);
    serving.await.unwrap();
}
