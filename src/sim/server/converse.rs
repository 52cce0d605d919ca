//! A stream to a bus with faults: it moves bytes and time between the [`Conversation`] and the stream, and decides
//! nothing.

use std::io;
use std::pin::pin;

use bytes::{Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::time::{Instant, sleep_until};
use tokio_util::codec::Decoder;

use super::SILENCE;
use crate::sim::fault::{Conversation, Output};
use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Received, Side};

/// Answers what comes from the stream, until one of the two ends it; then what has arrived is still executed.
pub(super) async fn converse<S>(mut stream: S, mut conversation: Conversation, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let result = converse_over(&mut stream, &mut conversation, framing).await;
    drop(stream);
    conversation.hang_up();
    while let Some(due) = conversation.due() {
        sleep_until(due).await;
        while conversation.next(Instant::now()).is_some() {}
    }
    result
}

async fn converse_over<S>(stream: &mut S, conversation: &mut Conversation, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut ear = Ear::new(framing);
    let left_overs = conversation.left_overs();
    loop {
        // Before the conversation is asked, so that no change is missed.
        let mut changed = pin!(left_overs.changed().notified());
        changed.as_mut().enable();
        let now = Instant::now();
        match conversation.next(now) {
            Some(Output::Bytes(bytes)) => {
                stream.write_all(&bytes).await?;
                continue;
            }
            Some(Output::Close) => return Ok(()),
            None => {}
        }
        let has_room = conversation.has_room();
        if !has_room {
            // What is not listened to is not silent.
            ear.silent_at = now + SILENCE;
        } else if let Some((item, bytes)) = ear.next(now)? {
            conversation.hear(item, bytes, now);
            continue;
        }
        let due = conversation.due();
        if ear.has_ended && due.is_none() {
            return Ok(());
        }
        let wake = due.into_iter().chain(ear.patience()).min();
        tokio::select! {
            // In this order, so that a run can be repeated.
            biased;
            () = pause(wake) => {}
            () = changed => {}
            read = stream.read_buf(&mut ear.received), if has_room && !ear.has_ended => {
                ear.hear(read?);
                if ear.has_ended {
                    conversation.end_input();
                }
            }
        }
    }
}

/// What has been received and not been understood yet.
struct Ear {
    codec: Codec,
    received: BytesMut,
    /// When a frame that has begun is given up.
    silent_at: Instant,
    has_ended: bool,
}

impl Ear {
    fn new(framing: Framing) -> Self {
        Self {
            codec: Codec::new(framing, Side::Plc),
            received: BytesMut::with_capacity(MAX_FRAME_LEN),
            silent_at: Instant::now(),
            has_ended: false,
        }
    }

    /// Bytes have come, or the end.
    fn hear(&mut self, len: usize) {
        self.has_ended |= len == 0;
        self.silent_at = Instant::now() + SILENCE;
    }

    /// The next item, with its bytes.
    fn next(&mut self, now: Instant) -> io::Result<Option<(Received, Bytes)>> {
        if self.received.is_empty() {
            return Ok(None);
        }
        let before = Bytes::copy_from_slice(&self.received);
        let item = if now < self.silent_at {
            self.codec.decode(&mut self.received)?
        } else {
            self.codec.decode_eof(&mut self.received)?
        };
        Ok(item.map(|item| (item, before.slice(..before.len() - self.received.len()))))
    }

    /// Until when the rest of a frame is waited for.
    fn patience(&self) -> Option<Instant> {
        (!self.received.is_empty() && !self.has_ended).then_some(self.silent_at)
    }
}

pub(super) async fn pause(until: Option<Instant>) {
    match until {
        Some(until) => sleep_until(until).await,
        None => std::future::pending().await,
    }
}
