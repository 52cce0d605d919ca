//! Serial lines: timing, and ports that are unplugged and replugged.

#[cfg(all(target_os = "linux", feature = "serial", feature = "sim"))]
mod ports;

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::BytesMut;
use fatek::endpoint::SerialSettings;
use fatek::wire::{Codec, Frame, Framing, Side};
use fatek::{CallOptions, EchoMode, Error, Link, LinkBuilder, register};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufStream, DuplexStream, ReadBuf, duplex};
use tokio::time::{Instant, sleep_until};
use tokio_util::codec::{Decoder, Encoder};

/// A scripted PLC at the other end of the line.
struct Peer {
    stream: DuplexStream,
    received: BytesMut,
}

impl Peer {
    /// Receives the next request. Also returns when it was written, and when its last bit arrives.
    async fn request(&mut self) -> (Frame, Instant, Instant) {
        let mut codec = Codec::new(Framing::Ascii, Side::Plc);
        loop {
            let buffered = self.received.len();
            if let Some(frame) = codec.decode(&mut self.received).unwrap().and_then(|item| item.frame()) {
                // A duplex stream has no speed: the bytes were written just now.
                let written = Instant::now();
                let arrived = written + CHARACTER * u32::try_from(buffered - self.received.len()).unwrap();
                sleep_until(arrived).await;
                return (frame, written, arrived);
            }
            assert_ne!(self.stream.read_buf(&mut self.received).await.unwrap(), 0, "the client has closed the line");
        }
    }

    async fn reply(&mut self, request: &Frame, data: impl Into<bytes::Bytes>) {
        let mut bytes = BytesMut::new();
        let frame = Frame { data: data.into(), ..request.clone() };
        Codec::new(Framing::Ascii, Side::Plc).encode(frame, &mut bytes).unwrap();
        self.stream.write_all(&bytes).await.unwrap();
    }

    /// Answers the first check of a connection with its echo.
    async fn echo(&mut self) {
        let (request, ..) = self.request().await;
        assert_eq!(request.command, 0x4E);
        let data = request.data.clone();
        self.reply(&request, data).await;
    }
}

const BAUD: u32 = 1200;

/// Time of a character at 1200 baud and 7E1, ten bits, rounded up.
const CHARACTER: Duration = Duration::from_nanos(8_333_334);

/// Asserts a time within the resolution of the timers that make up a pause.
fn assert_about(took: Duration, expected: Duration) {
    let least = expected.saturating_sub(Duration::from_millis(1));
    let most = expected + Duration::from_millis(3);
    assert!((least..=most).contains(&took), "{took:?}, not {expected:?}");
}

fn line() -> (LinkBuilder, Peer) {
    let (client, plc) = duplex(4096);
    let settings = SerialSettings::new(Framing::Ascii).with_baud(BAUD).unwrap();
    let builder = Link::stream_builder(Unflushable(client), Framing::Ascii).serial_line(settings).echo(EchoMode::Off);
    (builder, Peer { stream: plc, received: BytesMut::new() })
}

/// A stream like a serial port: a flush would block the runtime.
struct Unflushable(DuplexStream);

impl AsyncRead for Unflushable {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.0).poll_read(cx, buf)
    }
}

impl AsyncWrite for Unflushable {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.0).poll_write(cx, buf)
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        panic!("a serial port must not be flushed");
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        panic!("shutting a serial port down flushes it");
    }
}

#[tokio::test(start_paused = true)]
async fn the_response_timeout_begins_after_the_last_bit() {
    let (builder, mut peer) = line();
    let station = builder.build().station(1).unwrap();
    let call = tokio::spawn(async move {
        let result = station.write_registers(register!("R0"), &[0; 64]).await;
        (result, Instant::now())
    });
    peer.echo().await;
    let (.., arrived) = peer.request().await;
    let (result, ended) = call.await.unwrap();
    assert!(matches!(result, Err(Error::Timeout { sent: true, .. })), "{result:?}");
    assert_about(ended - arrived, Duration::from_millis(300));
}

#[tokio::test(start_paused = true)]
async fn the_frame_gap_follows_each_reply() {
    for (gap, expected) in [(None, CHARACTER * 7 / 2), (Some(Duration::from_millis(50)), Duration::from_millis(50))] {
        let (builder, mut peer) = line();
        let builder = if let Some(gap) = gap { builder.frame_gap(gap) } else { builder };
        let station = builder.build().station(1).unwrap();
        tokio::spawn(async move { while station.read_registers(register!("R0"), 1).await.is_ok() {} });
        peer.echo().await;
        for _ in 0..3 {
            let (request, ..) = peer.request().await;
            peer.reply(&request, "00001").await;
            let answered = Instant::now();
            let (request, sent, _) = peer.request().await;
            assert_about(sent - answered, expected);
            peer.reply(&request, "00001").await;
        }
    }
}

#[tokio::test(start_paused = true)]
async fn the_broadcast_gap_follows_each_broadcast() {
    let (builder, mut peer) = line();
    let everyone = builder.build().broadcast();
    let calls = tokio::spawn(async move {
        everyone.stop().await.unwrap();
        everyone.run().await.unwrap();
    });
    let (.., arrived) = peer.request().await;
    let (_, next, _) = peer.request().await;
    calls.await.unwrap();
    assert_about(next - arrived, Duration::from_millis(100));
}

#[tokio::test(start_paused = true)]
async fn closing_completes_a_broadcast() {
    let (builder, mut peer) = line();
    let link = builder.build();
    link.broadcast().write_registers(register!("R0"), &[0; 64]).await.unwrap();
    let closing = tokio::spawn(async move {
        link.close().await;
        Instant::now()
    });
    let (_, written, arrived) = peer.request().await;
    // Compared with the write: if closing were too early, the difference to the last bit would be
    // zero.
    assert_about(closing.await.unwrap() - written, arrived - written);
    assert_eq!(peer.stream.read(&mut [0; 1]).await.unwrap(), 0, "the port is closed");
}

#[tokio::test(start_paused = true)]
async fn a_stream_other_than_a_serial_line_is_flushed() {
    let (client, plc) = duplex(4096);
    let link = Link::from_stream(BufStream::new(client), Framing::Ascii);
    let station = link.station(1).unwrap().with_options(CallOptions::new().with_retries(0));
    let call = tokio::spawn(async move { station.read_registers(register!("R0"), 1).await });
    let mut peer = Peer { stream: plc, received: BytesMut::new() };
    peer.echo().await;
    let (request, ..) = peer.request().await;
    peer.reply(&request, "00007").await;
    assert_eq!(call.await.unwrap().unwrap(), [7]);
}

#[cfg(not(feature = "serial"))]
#[tokio::test]
async fn without_the_feature_a_serial_port_is_unsupported() {
    let link = Link::builder("serial:/dev/ttyUSB0".parse().unwrap()).fail_fast(true).build();
    let error = link.station(1).unwrap().read_status().await.unwrap_err();
    let Error::Connect { source, .. } = &error else { panic!("{error:?}") };
    assert_eq!(source.kind(), std::io::ErrorKind::Unsupported);
    assert!(error.to_string().contains("feature `serial`"), "{error}");
}
