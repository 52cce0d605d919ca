//! Checks of connections: several at once, an idle one, and two UDP ports.

use std::time::Duration;

use tokio::time::Instant;

use super::{ATTEMPTS, End, Runner};
use crate::doctor::exchange::Attempt;
use crate::doctor::line::{Connect, Receiver};
use crate::doctor::request::Request;

/// Time for which one of two sockets is read.
const TURN: Duration = Duration::from_millis(20);

impl<C: Connect> Runner<'_, C> {
    /// Opens several connections, the open one included, and then requests the status on each of them.
    ///
    /// Returns the last attempt on each: an answer, a closed connection, or silence at the last attempt.
    pub(super) async fn connections(&mut self, connections: usize) -> Result<Vec<Attempt>, End> {
        self.line().await?;
        let mut lines = vec![self.line.take()];
        for _ in 1..connections {
            let wire = self.connector.open().await.ok();
            lines.push(wire.map(|wire| Receiver::new(wire, self.facts.framing())));
        }
        let mut attempts = Vec::new();
        for line in &mut lines {
            self.line = line.take();
            attempts.push(self.last_status().await?.pop().unwrap_or_default());
            *line = self.line.take();
        }
        self.line = lines.swap_remove(0);
        Ok(attempts)
    }

    /// Requests the status after this time without any request. The first attempt is the time without one.
    pub(super) async fn idle(&mut self, time: Duration) -> Result<Vec<Attempt>, End> {
        self.line().await?;
        let mut idle = Attempt::default();
        self.listen(&mut idle, Instant::now() + time, Instant::now()).await;
        let is_closed = idle.closed;
        let mut attempts = vec![idle];
        if !is_closed {
            attempts.extend(self.last_status().await?);
        }
        Ok(attempts)
    }

    /// Requests the status on the open connection alone: until it is answered or closed, or the attempts are used up.
    ///
    /// One that does not answer is dropped: others may be served. Without a connection the attempt is a closed one.
    async fn last_status(&mut self) -> Result<Vec<Attempt>, End> {
        let request = self.facts.requests.status();
        let bytes = self.facts.requests.encode(&request.frame);
        let mut attempts = Vec::new();
        for _ in 0..ATTEMPTS {
            if self.line.is_none() {
                break;
            }
            let attempt = self.attempt(&request, bytes.clone()).await?;
            let is_answered = attempt.reply(&request, self.facts.framing()).is_some();
            attempts.push(attempt);
            if is_answered {
                // A reply to an earlier attempt may still come.
                if let [_, .., last] = &mut attempts[..] {
                    self.separate(last).await?;
                }
                return Ok(attempts);
            }
        }
        match attempts.last() {
            None => attempts.push(Attempt { closed: true, ..Attempt::default() }),
            Some(_) => self.line = None,
        }
        Ok(attempts)
    }

    /// Sends two requests from two ports. Returns the attempt of each.
    pub(super) async fn two_ports(&mut self, first: &Request, second: &Request) -> Result<Vec<Attempt>, End> {
        let Ok(wire) = self.connector.open().await else { return Ok(Vec::new()) };
        let mut other = Some(Receiver::new(wire, self.facts.framing()));
        let mut attempts = Vec::new();
        for request in [first, second] {
            let bytes = self.facts.requests.encode(&request.frame);
            let mut attempt = Attempt { sent: bytes.clone(), ..Attempt::default() };
            self.next_at = None;
            let sent_at = self.send(&[bytes], &mut attempt).await?;
            attempts.push((attempt, sent_at));
            std::mem::swap(&mut self.line, &mut other);
        }
        let deadline = Instant::now() + self.pace.timeout;
        let frames =
            |attempts: &[(Attempt, _)]| attempts.iter().map(|(attempt, _)| attempt.frames().count()).sum::<usize>();
        while frames(&attempts) < 2 && Instant::now() < deadline {
            for (attempt, sent_at) in &mut attempts {
                if let Some((sent_at, _)) = *sent_at {
                    let had = attempt.arrivals.len();
                    let until = Instant::now() + TURN;
                    self.receive(attempt, sent_at, until, |attempt| attempt.arrivals.len() > had).await;
                }
                std::mem::swap(&mut self.line, &mut other);
            }
        }
        Ok(attempts.into_iter().map(|(attempt, _)| attempt).collect())
    }
}
