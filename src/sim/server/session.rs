//! I/O of a bus with faults over a stream: moves bytes and times between the [`Session`] and the
//! stream.

use std::future::pending;
use std::io;
use std::pin::pin;

use bytes::{Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::time::{Instant, sleep_until};
use tokio_util::codec::Decoder;

use super::FRAME_TIMEOUT;
use crate::sim::fault::{Output, Session};
use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Received, Side};

/// Serves a session until the stream ends or a fault closes it. Requests that have arrived are
/// executed after that, too.
pub(super) async fn run_session<S>(mut stream: S, mut session: Session, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let result = run_until_end(&mut stream, &mut session, framing).await;
    drop(stream);
    session.disconnect();
    while let Some(due) = session.due() {
        sleep_until(due).await;
        while session.next_output(Instant::now()).is_some() {}
    }
    result
}

async fn run_until_end<S>(stream: &mut S, session: &mut Session, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut reader = FrameReader::new(framing);
    let left_overs = session.left_overs();
    loop {
        // Enabled before the call of `next_output`, so that no change is missed.
        let mut changed = pin!(left_overs.changed().notified());
        changed.as_mut().enable();
        let now = Instant::now();
        match session.next_output(now) {
            Some(Output::Bytes(bytes)) => {
                stream.write_all(&bytes).await?;
                continue;
            }
            Some(Output::Close) => return Ok(()),
            None => {}
        }
        let has_room = session.has_room();
        if !has_room {
            // While the stream is not read, the frame timeout does not run.
            reader.timeout_at = now + FRAME_TIMEOUT;
        } else if let Some((item, bytes)) = reader.next(now)? {
            session.receive(item, bytes, now);
            continue;
        }
        let due = session.due();
        if reader.has_ended && due.is_none() {
            return Ok(());
        }
        let wake_at = due.into_iter().chain(reader.frame_deadline()).min();
        tokio::select! {
            // In this order, so that runs are reproducible.
            biased;
            () = sleep_until_due(wake_at) => {}
            () = changed => {}
            read = stream.read_buf(&mut reader.received), if has_room && !reader.has_ended => {
                reader.bytes_read(read?);
                if reader.has_ended {
                    session.end_input();
                }
            }
        }
    }
}

/// Decodes received bytes, with a timeout for incomplete frames.
struct FrameReader {
    codec: Codec,
    received: BytesMut,
    /// Time at which an incomplete frame is discarded.
    timeout_at: Instant,
    has_ended: bool,
}

impl FrameReader {
    fn new(framing: Framing) -> Self {
        Self {
            codec: Codec::new(framing, Side::Plc),
            received: BytesMut::with_capacity(MAX_FRAME_LEN),
            timeout_at: Instant::now(),
            has_ended: false,
        }
    }

    /// Handles the result of a read; a length of 0 is the end of the stream.
    fn bytes_read(&mut self, len: usize) {
        self.has_ended |= len == 0;
        self.timeout_at = Instant::now() + FRAME_TIMEOUT;
    }

    /// Decodes the next item, and returns it with its bytes.
    fn next(&mut self, now: Instant) -> io::Result<Option<(Received, Bytes)>> {
        if self.received.is_empty() {
            return Ok(None);
        }
        let before = Bytes::copy_from_slice(&self.received);
        let item = if now < self.timeout_at {
            self.codec.decode(&mut self.received)?
        } else {
            self.codec.decode_eof(&mut self.received)?
        };
        Ok(item.map(|item| (item, before.slice(..before.len() - self.received.len()))))
    }

    /// Deadline for the rest of an incomplete frame.
    fn frame_deadline(&self) -> Option<Instant> {
        (!self.received.is_empty() && !self.has_ended).then_some(self.timeout_at)
    }
}

/// Sleeps until a time; for ever without one.
pub(super) async fn sleep_until_due(due: Option<Instant>) {
    match due {
        Some(due) => sleep_until(due).await,
        None => pending().await,
    }
}
