//! Sends recorded requests to a PLC, each once and as it is.

use std::io;
use std::time::Duration;

use bytes::BytesMut;
use fatek::Endpoint;
use fatek::endpoint::EndpointStream;
use fatek::link::defaults;
use fatek::wire::{Codec, Frame, Received, Side};
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

/// A conversation that is repeated.
///
/// Invariant: a connection has at most one open request. After a reply that did not come, it is closed,
/// so that a late one does not pass for the reply to the next request.
#[derive(Debug)]
pub(super) struct Replay {
    endpoint: Endpoint,
    connect_timeout: Option<Duration>,
    response_timeout: Duration,
    timing: TimingArg,
    stream: Option<EndpointStream>,
    /// Time of the first request: recorded, and here.
    began: Option<(Timestamp, Instant)>,
}

impl Replay {
    pub(super) fn new(endpoint: Endpoint, timeout: Option<Duration>, timing: TimingArg) -> Self {
        let is_serial = endpoint.transport().serial_settings().is_some();
        let default = if is_serial { defaults::SERIAL_RESPONSE_TIMEOUT } else { defaults::RESPONSE_TIMEOUT };
        let response_timeout = timeout.unwrap_or(default);
        Self { endpoint, connect_timeout: timeout, response_timeout, timing, stream: None, began: None }
    }

    /// Sends a request at its time, and returns its reply.
    pub(super) async fn step(&mut self, step: &ScriptedRequest) -> Result<Option<Frame>, Failure> {
        let (first, began) = *self.began.get_or_insert((step.at, Instant::now()));
        if self.timing == TimingArg::Recorded {
            time::sleep_until(began + step.at.saturating_sub(first)).await;
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
        stream.write_all(&step.request().bytes).await?;
        if step.is_broadcast() {
            time::sleep(AFTER_BROADCAST).await;
            return Ok(None);
        }
        let mut codec = Codec::new(self.endpoint.framing(), Side::Client);
        let reply = time::timeout(self.response_timeout, reply(stream, &mut codec, &step.request().frame)).await;
        match reply {
            Ok(reply) => reply.map(Some),
            Err(_) => {
                self.stream = None;
                Ok(None)
            }
        }
    }
}

/// Reads up to the first frame of the station and command. Others are ignored.
async fn reply(stream: &mut EndpointStream, codec: &mut Codec, request: &Frame) -> io::Result<Frame> {
    let mut received = BytesMut::new();
    loop {
        while let Some(item) = codec.decode(&mut received)? {
            if let Received::Frame(frame) = item
                && (frame.station, frame.command) == (request.station, request.command)
            {
                return Ok(frame);
            }
        }
        if stream.read_buf(&mut received).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
    }
}
