//! The batches of a session: in flight, stored, sent again. No I/O, and no clock.
//!
//! ```text
//!            ┌── prepared ──┐
//!            │              ▼        an answer is bad            all have an answer
//!        Unprepared ◀─┐    Open ────────────────▶ Failing ───────────────────────▶ Waiting
//!                     └─ no stream ──────────────── time is over ──────────────────────┘ │
//!                           ▲ Open ◀────────────────────────────────── time is over ─────┘
//! ```
//!
//! Invariants:
//! - Answers come in the order of the batches.
//! - A batch is acknowledged in the buffer when the stream has stored it and all before it.
//! - After a bad answer nothing is sent until all answers have come, and then the batches from the bad one on.

use std::collections::VecDeque;
use std::sync::Arc;

use tokio::time::Instant;

use crate::backoff::Backoff;
use crate::buffer::{Cursor, Entry, Fetched};
use crate::output::Health;

/// The batches in flight, at most.
const WINDOW: usize = 512;
/// The bytes in flight, at most; a single batch may be longer.
const MAX_BYTES: usize = 4 << 20;
/// Answers that did not come, after which the connection is given up.
const MAX_TIMEOUTS: u32 = 2;

/// The answer to a batch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    /// The stream has it, now or from an earlier attempt.
    Stored,
    /// The server can never take it.
    Never(String),
    /// No stream captures it.
    NoStream,
    /// The server does not take it now.
    Refused(String),
    /// There was none.
    Timeout,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// The stream is not known yet.
    Unprepared,
    Open,
    /// An answer was bad.
    Failing {
        is_stream_gone: bool,
    },
    /// Sent again at this time.
    Waiting {
        until: Instant,
        is_stream_gone: bool,
    },
}

/// The delivery.
#[derive(Debug)]
pub(super) struct Delivery {
    cursor: Cursor,
    health: Arc<Health>,
    state: State,
    in_flight: VecDeque<InFlight>,
    bytes: usize,
    /// Batches that were read, and not sent.
    queue: VecDeque<Fetched>,
    backoff: Backoff,
    timeouts: u32,
}

#[derive(Debug)]
struct InFlight {
    position: u64,
    samples: u32,
    bytes: usize,
}

impl Delivery {
    pub(super) fn new(cursor: Cursor, health: Arc<Health>) -> Self {
        Self {
            cursor,
            health,
            state: State::Unprepared,
            in_flight: VecDeque::new(),
            bytes: 0,
            queue: VecDeque::new(),
            backoff: Backoff::default(),
            timeouts: 0,
        }
    }

    /// Begins a session: everything that is not acknowledged is sent again.
    pub(super) fn begin(&mut self) {
        self.rewind();
        self.state = State::Unprepared;
        self.timeouts = 0;
    }

    /// Returns whether the stream must be prepared now.
    pub(super) fn needs_stream(&self) -> bool {
        self.state == State::Unprepared
    }

    /// The stream is there, or the attempt to prepare it has failed.
    pub(super) fn prepared(&mut self, result: Result<(), String>, now: Instant) {
        match result {
            Ok(()) => {
                self.health.set_refusal(None);
                self.state = State::Open;
            }
            Err(error) => {
                if self.health.failure().as_ref() != Some(&error) {
                    tracing::warn!("nats: {error}");
                }
                self.health.set_refusal(Some(error));
                let until = now + self.backoff.next_delay();
                self.state = State::Waiting { until, is_stream_gone: true };
            }
        }
    }

    /// Returns whether batches can be read.
    pub(super) fn needs_batches(&self) -> bool {
        self.state == State::Open && self.queue.is_empty() && self.has_room()
    }

    /// Waits for batches. Cancel-safe.
    pub(super) async fn fetch(&mut self) {
        let fetched = self.cursor.fetch(WINDOW).await;
        self.queue.extend(fetched);
    }

    /// The next batch to send, if one may be sent. `len`: of its message.
    pub(super) fn take(&mut self) -> Option<Entry> {
        if self.state != State::Open || !self.has_room() {
            return None;
        }
        let entry = self.cursor.send(self.queue.pop_front()?);
        let (position, samples, bytes) = (entry.position, entry.batch.samples, entry.batch.size());
        self.bytes = self.bytes.saturating_add(bytes);
        self.in_flight.push_back(InFlight { position, samples, bytes });
        Some(entry)
    }

    fn has_room(&self) -> bool {
        self.in_flight.len() < WINDOW && self.bytes < MAX_BYTES
    }

    /// Takes the answer to the oldest batch in flight. An error: the connection is to be given up.
    pub(super) fn answered(&mut self, answer: Answer, now: Instant) -> Result<(), String> {
        let Some(InFlight { position, samples, bytes }) = self.in_flight.pop_front() else { return Ok(()) };
        self.bytes = self.bytes.saturating_sub(bytes);
        self.timeouts = if answer == Answer::Timeout { self.timeouts.saturating_add(1) } else { 0 };
        if self.state == State::Open {
            match answer {
                Answer::Stored => {
                    self.health.count(samples);
                    self.cursor.acknowledge(position);
                    self.backoff.reset();
                    self.clear_refusal();
                }
                Answer::Never(why) => {
                    tracing::warn!("nats: a batch is given up: {why}");
                    self.health.count_skipped();
                    self.cursor.acknowledge(position);
                }
                Answer::NoStream => self.fail("no stream takes the batches".to_owned(), true),
                Answer::Refused(why) => {
                    self.health.count_refused();
                    self.fail(format!("the server refuses batches: {why}"), false);
                }
                Answer::Timeout => self.fail("the server does not acknowledge batches".to_owned(), false),
            }
        }
        match self.state {
            State::Failing { .. } if self.timeouts >= MAX_TIMEOUTS && self.in_flight.is_empty() => {
                Err("the server does not acknowledge batches".to_owned())
            }
            State::Failing { is_stream_gone } if self.in_flight.is_empty() => {
                self.rewind();
                self.state = State::Waiting { until: now + self.backoff.next_delay(), is_stream_gone };
                Ok(())
            }
            State::Unprepared | State::Open | State::Failing { .. } | State::Waiting { .. } => Ok(()),
        }
    }

    fn fail(&mut self, why: String, is_stream_gone: bool) {
        tracing::warn!("nats: {why}: they are kept, and sent again");
        self.health.set_refusal(Some(why));
        self.state = State::Failing { is_stream_gone };
    }

    fn clear_refusal(&self) {
        if self.health.failure().is_some() {
            self.health.set_refusal(None);
        }
    }

    /// The time of the next attempt.
    pub(super) fn due(&self) -> Option<Instant> {
        match self.state {
            State::Waiting { until, .. } => Some(until),
            State::Unprepared | State::Open | State::Failing { .. } => None,
        }
    }

    /// Begins the next attempt, if it is time.
    pub(super) fn resume(&mut self, now: Instant) {
        if let State::Waiting { until, is_stream_gone } = self.state
            && until <= now
        {
            self.state = if is_stream_gone { State::Unprepared } else { State::Open };
        }
    }

    fn rewind(&mut self) {
        self.in_flight.clear();
        self.queue.clear();
        self.bytes = 0;
        self.cursor.rewind();
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;

    use super::*;
    use crate::batch::Batch;
    use crate::buffer::Buffer;
    use crate::output::OutputKind;

    struct Case {
        buffer: Buffer,
        delivery: Delivery,
        now: Instant,
    }

    impl Case {
        fn new(batches: u64) -> Self {
            let buffer = Buffer::in_memory(1, 64 << 20);
            for seq in 1..=batches {
                buffer.push(Batch { plc: "mixer".into(), revision: 0, seq, ts: seq, samples: 2, data: "{}".into() });
            }
            let mut delivery = Delivery::new(buffer.cursor(0), Arc::new(Health::new(OutputKind::Nats)));
            delivery.begin();
            let now = Instant::now();
            delivery.prepared(Ok(()), now);
            Self { buffer, delivery, now }
        }

        /// Sends all that may be sent.
        fn send(&mut self) -> Vec<u64> {
            self.send_entries().into_iter().map(|entry| entry.position).collect()
        }

        fn send_entries(&mut self) -> Vec<Entry> {
            let mut sent = Vec::new();
            while self.delivery.needs_batches() && self.delivery.fetch().now_or_never().is_some() {
                sent.extend(std::iter::from_fn(|| self.delivery.take()));
            }
            sent
        }

        fn answer(&mut self, answers: &[Answer]) -> Result<(), String> {
            answers.iter().try_for_each(|answer| self.delivery.answered(answer.clone(), self.now))
        }

        fn wait(&mut self) {
            self.now = self.delivery.due().expect("it waits");
            self.delivery.resume(self.now);
        }

        fn lag(&self) -> u64 {
            self.buffer.stats()[0].lag
        }
    }

    #[test]
    fn the_window_bounds_the_batches_in_flight() {
        let mut case = Case::new(2000);
        assert_eq!(case.send().len(), WINDOW);
        assert_eq!(case.send(), [0_u64; 0]);
        case.answer(&[Answer::Stored, Answer::Stored]).unwrap();
        assert_eq!(case.send(), [513, 514]);
        assert_eq!(case.lag(), 1998);
    }

    #[test]
    fn a_batch_that_was_only_fetched_is_no_replay_in_the_next_session() {
        let mut case = Case::new(2000);
        case.send();
        // Batches are read for the place of one, and 511 of them wait.
        case.answer(&[Answer::Stored]).unwrap();
        assert_eq!(case.send(), [513]);
        assert_eq!(case.delivery.queue.len(), WINDOW - 1);
        case.delivery.begin();
        case.delivery.prepared(Ok(()), case.now);
        let sent = case.send_entries();
        assert_eq!((sent[0].position, sent.len()), (2, WINDOW));
        case.answer(&vec![Answer::Stored; WINDOW]).unwrap();
        let later = case.send_entries();
        let is_right = |entry: &Entry| entry.replay == (entry.position <= 513);
        assert!(sent.iter().chain(&later).all(is_right) && later.len() == WINDOW);
    }

    #[test]
    fn after_a_bad_answer_batches_are_sent_again_from_it_on() {
        for (bad, prepares) in
            [(Answer::Timeout, false), (Answer::Refused("full".into()), false), (Answer::NoStream, true)]
        {
            let mut case = Case::new(4);
            assert_eq!(case.send(), [1, 2, 3, 4]);
            case.answer(&[Answer::Stored, bad.clone()]).unwrap();
            assert_eq!((case.send(), case.delivery.due()), (vec![], None), "two have no answer yet");
            case.answer(&[Answer::Stored, Answer::Stored]).unwrap();
            assert_eq!(case.lag(), 3);
            assert!(case.delivery.health.failure().is_some());
            case.wait();
            assert_eq!(case.delivery.needs_stream(), prepares, "{bad:?}");
            if prepares {
                case.delivery.prepared(Ok(()), case.now);
            }
            assert_eq!(case.send(), [2, 3, 4]);
            case.answer(&[Answer::Stored, Answer::Stored, Answer::Stored]).unwrap();
            assert_eq!((case.lag(), case.delivery.health.failure()), (0, None));
        }
    }

    #[test]
    fn a_batch_that_is_never_taken_holds_up_no_other() {
        let mut case = Case::new(3);
        case.send();
        case.answer(&[Answer::Stored, Answer::Never("too large".into()), Answer::Stored]).unwrap();
        assert_eq!((case.lag(), case.delivery.health.skipped(), case.delivery.health.delivered()), (0, 1, (2, 4)));
    }

    #[test]
    fn a_server_that_does_not_acknowledge_is_given_up() {
        let mut case = Case::new(2);
        case.send();
        assert!(case.answer(&[Answer::Timeout, Answer::Timeout]).is_err());
        case.delivery.begin();
        case.delivery.prepared(Ok(()), case.now);
        assert_eq!(case.send(), [1, 2]);
    }

    #[test]
    fn a_stream_that_cannot_be_prepared_is_tried_again() {
        let mut case = Case::new(1);
        case.delivery.begin();
        for _ in 0..3 {
            assert!(case.delivery.needs_stream());
            case.delivery.prepared(Err("no permission".into()), case.now);
            assert_eq!(case.send(), [0_u64; 0]);
            assert_eq!(case.delivery.health.failure().as_deref(), Some("no permission"));
            case.wait();
        }
        case.delivery.prepared(Ok(()), case.now);
        assert_eq!((case.send(), case.delivery.health.failure()), (vec![1], None));
    }
}
