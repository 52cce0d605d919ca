//! Sends recorded requests to a PLC, each once and as it is.

use std::io;
use std::time::Duration;

use bytes::BytesMut;
use fatek::Endpoint;
use fatek::endpoint::EndpointStream;
use fatek::link::defaults;
use fatek::wire::{Codec, Frame, Framing, Received, Side};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::time::{self, Instant};
use tokio_util::codec::Decoder;

use super::script::ScriptedRequest;
use crate::args::TimingArg;
use crate::connect;
use crate::conversation::Timestamp;
use crate::failure::Failure;
use crate::traffic::TrafficFailure;

/// Time for all stations to carry out a broadcast, which none of them answers.
const AFTER_BROADCAST: Duration = Duration::from_millis(100);

/// Time beyond that of the last reply in which the reply behind a copy of it comes.
const COPY_MARGIN: Duration = Duration::from_millis(20);

/// Longest wait for the silence of a serial line, in response timeouts.
const MAX_SILENCE_WAITS: u32 = 10;

/// A conversation that is repeated.
///
/// Invariants, so that no late or doubled reply passes for the reply to the next request:
/// - A connection has at most one open request. After a reply that did not come, it is closed, and a
///   serial line is opened again when it is silent.
/// - Bytes that have come before a request are discarded.
/// - Frames that are no reply to the request are ignored. A copy of the last reply is the reply only if
///   no other frame comes.
#[derive(Debug)]
pub(super) struct Replay {
    endpoint: Endpoint,
    connect_timeout: Option<Duration>,
    response_timeout: Duration,
    timing: TimingArg,
    stream: Option<EndpointStream>,
    /// Time of the first request: recorded, and here.
    began: Option<(Timestamp, Instant)>,
    last: Option<LastReply>,
}

#[derive(Debug)]
struct LastReply {
    request: Frame,
    reply: Frame,
    round_trip: Duration,
}

impl Replay {
    pub(super) fn new(endpoint: Endpoint, timeout: Option<Duration>, timing: TimingArg) -> Self {
        let is_serial = endpoint.transport().serial_settings().is_some();
        let default = if is_serial { defaults::SERIAL_RESPONSE_TIMEOUT } else { defaults::RESPONSE_TIMEOUT };
        let response_timeout = timeout.unwrap_or(default);
        Self { endpoint, connect_timeout: timeout, response_timeout, timing, stream: None, began: None, last: None }
    }

    /// Sends a request at its time, and returns its reply.
    pub(super) async fn step(&mut self, step: &ScriptedRequest) -> Result<Option<Frame>, Failure> {
        let (first, began) = *self.began.get_or_insert((step.at, Instant::now()));
        if self.timing == TimingArg::Recorded {
            // Pauses are bounded before. A time that no clock has is no pause.
            if let Some(time) = began.checked_add(step.at.saturating_sub(first)) {
                time::sleep_until(time).await;
            }
        }
        // A connection that the PLC has closed meanwhile is opened once more, but nothing is written twice.
        for is_last in [self.stream.is_none() || step.may_write(), true] {
            match self.exchange(step).await {
                Ok(reply) => return Ok(reply),
                Err(error) => {
                    self.stream = None;
                    if is_last {
                        return Err(TrafficFailure::NotConnected { url: self.endpoint.to_string(), error }.into());
                    }
                }
            }
        }
        Ok(None)
    }

    async fn exchange(&mut self, step: &ScriptedRequest) -> io::Result<Option<Frame>> {
        let stream = match &mut self.stream {
            Some(stream) => stream,
            None => self.stream.insert(connect::open(&self.endpoint, self.connect_timeout).await?),
        };
        drain(stream).await?;
        stream.write_all(&step.request().bytes).await?;
        if step.is_broadcast() {
            time::sleep(AFTER_BROADCAST).await;
            return Ok(None);
        }
        let sent = Instant::now();
        let mut exchange = Exchange {
            stream,
            codec: Codec::new(self.endpoint.framing(), Side::Client),
            received: BytesMut::new(),
            step,
            framing: self.endpoint.framing(),
        };
        let deadline = sent + self.response_timeout;
        let Some(reply) = exchange.reply(deadline).await? else {
            if self.endpoint.transport().serial_settings().is_some() {
                self.wait_for_silence().await;
            }
            self.stream = None;
            return Ok(None);
        };
        let request = &step.request().frame;
        let mut reply = reply;
        // A copy of the last reply is known as one when the reply itself comes, after about as long.
        if let Some(last) = &self.last
            && last.reply == reply
            && last.request != *request
        {
            let deadline = deadline.min(sent + last.round_trip.saturating_mul(2) + COPY_MARGIN);
            reply = exchange.reply(deadline).await?.unwrap_or(reply);
        }
        self.last = Some(LastReply { request: request.clone(), reply: reply.clone(), round_trip: sent.elapsed() });
        Ok(Some(reply))
    }

    /// Waits until nothing comes for the time of a reply.
    async fn wait_for_silence(&mut self) {
        let Some(stream) = &mut self.stream else { return };
        let end = Instant::now() + self.response_timeout.saturating_mul(MAX_SILENCE_WAITS);
        let mut discarded = BytesMut::new();
        while Instant::now() < end {
            let read = time::timeout(self.response_timeout, stream.read_buf(&mut discarded)).await;
            if !matches!(read, Ok(Ok(1..))) {
                return;
            }
            discarded.clear();
        }
    }
}

/// Discards the bytes that have come.
async fn drain(stream: &mut EndpointStream) -> io::Result<()> {
    let mut discarded = BytesMut::new();
    // Lets the runtime see what has come.
    tokio::task::yield_now().await;
    while let Ok(read) = time::timeout(Duration::ZERO, stream.read_buf(&mut discarded)).await {
        if read? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        discarded.clear();
    }
    Ok(())
}

/// A request that is sent.
struct Exchange<'e> {
    stream: &'e mut EndpointStream,
    codec: Codec,
    received: BytesMut,
    step: &'e ScriptedRequest,
    framing: Framing,
}

impl Exchange<'_> {
    /// Reads up to the next frame that is a reply to the request. `None` if none comes before this time.
    async fn reply(&mut self, deadline: Instant) -> io::Result<Option<Frame>> {
        time::timeout_at(deadline, self.next_reply()).await.ok().transpose()
    }

    async fn next_reply(&mut self) -> io::Result<Frame> {
        loop {
            while let Some(item) = self.codec.decode(&mut self.received)? {
                if let Received::Frame(frame) = item
                    && self.step.is_reply(&frame, self.framing)
                {
                    return Ok(frame);
                }
            }
            if self.stream.read_buf(&mut self.received).await? == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
        }
    }
}
