//! Delivery of batches: which ones may be sent, and which ones are acknowledged in the buffer. No I/O besides
//! the buffer, and no clock.
//!
//! ```text
//! Open ──a batch is refused──▶ Stopping ──none in flight, rewound──▶ Waiting ──time──▶ Probing
//!  ▲                                                                   ▲   a refusal     │
//!  │                                                                   └─────────────────┤
//!  └────────────────────────────── enough batches are taken ─────────────────────────────┘
//! ```
//!
//! Invariants:
//! - a batch is acknowledged in the buffer only when the broker has taken it and all before it, or when it was
//!   given up and counted;
//! - batches are sent in the order of the buffer, and again in that order after a loss or a refusal;
//! - while the broker refuses batches, one at a time is sent, with growing delays;
//! - a batch that ends the connections is found, and one that the broker names as the reason is given up.

use std::collections::VecDeque;
use std::sync::Arc;

use tokio::time::Instant;

use super::window::Prefix;
use crate::backoff::Backoff;
use crate::buffer::{Cursor, Entry, Fetched};
use crate::output::Health;

/// The batches that are read from the buffer at once.
const MAX_BATCHES: usize = 64;
/// The batches in flight with which all is well again.
const ENOUGH: usize = 64;

/// The batches of a cursor, on all connections of an output.
#[derive(Debug)]
pub(super) struct Delivery {
    cursor: Cursor,
    health: Arc<Health>,
    /// Read, and not sent yet.
    queue: VecDeque<Fetched>,
    prefix: Prefix,
    in_flight: usize,
    /// `true` if a batch was taken since the last loss of a connection.
    has_progress: bool,
    state: State,
    backoff: Backoff,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Batches are sent.
    Open,
    /// A batch was refused: no more are sent until those in flight have an answer.
    Stopping,
    /// Nothing is sent until then.
    Waiting(Instant),
    /// As many batches as this are in flight at once: one at first, and twice as many with each that is taken.
    Probing(usize),
}

/// Why a connection was lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Loss {
    /// Because of one of the batches in flight: the next ones are sent one at a time.
    Suspect,
    /// Because of the batch at this position, which was alone in flight: it is given up.
    Guilty(u64),
    /// For another reason.
    Other,
}

impl Delivery {
    pub(super) fn new(cursor: Cursor, health: Arc<Health>) -> Self {
        Self {
            cursor,
            health,
            queue: VecDeque::new(),
            prefix: Prefix::default(),
            in_flight: 0,
            has_progress: true,
            state: State::Open,
            backoff: Backoff::default(),
        }
    }

    /// Returns whether [`fetch`](Self::fetch) has something to do.
    pub(super) fn needs_batches(&self) -> bool {
        let is_sending = matches!(self.state, State::Open | State::Probing(_));
        is_sending && self.queue.is_empty()
    }

    /// Waits for batches of the buffer. Cancel-safe.
    pub(super) async fn fetch(&mut self) {
        let fetched = self.cursor.fetch(MAX_BATCHES).await;
        self.queue.extend(fetched);
    }

    /// The batch that is sent now.
    pub(super) fn take(&mut self, now: Instant) -> Option<Entry> {
        match self.state {
            State::Open => {}
            State::Probing(limit) if self.in_flight < limit => {}
            State::Probing(_) | State::Stopping | State::Waiting(_) => return None,
        }
        let entry = self.cursor.send(self.queue.pop_front()?);
        self.prefix.push(entry.position, now);
        self.in_flight = self.in_flight.saturating_add(1);
        Some(entry)
    }

    /// When the next attempt after a refusal is due.
    pub(super) fn due(&self) -> Option<Instant> {
        match self.state {
            State::Waiting(until) => Some(until),
            State::Open | State::Stopping | State::Probing(_) => None,
        }
    }

    /// Begins the next attempt, if it is due.
    pub(super) fn resume(&mut self, now: Instant) {
        if self.due().is_some_and(|until| until <= now) {
            self.state = State::Probing(1);
        }
    }

    /// Notes that the broker has taken a batch.
    pub(super) fn taken(&mut self, position: u64, samples: u32, now: Instant) {
        self.health.count(samples);
        self.has_progress = true;
        self.settle(position);
        if let State::Probing(limit) = self.state {
            self.state = if limit < ENOUGH { State::Probing(limit.saturating_mul(2)) } else { State::Open };
            self.backoff.reset();
            self.health.set_refusal(None);
        }
        self.answered(now);
    }

    /// Notes that a batch is given up: the broker can never take it.
    pub(super) fn skip(&mut self, position: u64, now: Instant) {
        self.health.count_skipped();
        self.settle(position);
        self.answered(now);
    }

    /// Notes that a batch was refused. It is sent again. Returns whether that is news: none before it was refused.
    pub(super) fn refused(&mut self, now: Instant) -> bool {
        let is_first = matches!(self.state, State::Open | State::Probing(2..));
        self.state = State::Stopping;
        self.answered(now);
        is_first
    }

    /// Asks for the present values of all tags.
    pub(super) fn want_present_values(&self) {
        self.cursor.want_present_values();
    }

    /// When the first batch was sent that has no acknowledgement.
    pub(super) fn oldest(&self) -> Option<Instant> {
        self.prefix.oldest()
    }

    /// Returns whether batches are sent one at a time.
    pub(super) fn is_probing(&self) -> bool {
        self.state == State::Probing(1)
    }

    /// Returns whether such a batch is in flight: nothing else is sent then, so that it alone is the reason if
    /// the broker ends the connection.
    pub(super) fn is_probing_in_flight(&self) -> bool {
        self.is_probing() && self.in_flight > 0
    }

    /// Notes that the connection was lost: all that is not acknowledged is sent again.
    pub(super) fn lost(&mut self, loss: Loss) {
        if let Loss::Guilty(position) = loss {
            self.health.count_skipped();
            self.settle(position);
        }
        // Twice without progress, although batches were sent: perhaps because of one of them.
        let is_fruitless = self.in_flight > 0 && !std::mem::replace(&mut self.has_progress, false);
        if loss != Loss::Other || self.state != State::Open || is_fruitless {
            self.state = State::Probing(1);
        }
        self.rewind();
        self.in_flight = 0;
    }

    /// Settles a batch, and acknowledges those at the front in the buffer.
    fn settle(&mut self, position: u64) {
        if let Some(last) = self.prefix.settle(position) {
            self.cursor.acknowledge(last);
        }
    }

    fn answered(&mut self, now: Instant) {
        self.in_flight = self.in_flight.saturating_sub(1);
        if self.state == State::Stopping && self.in_flight == 0 {
            self.rewind();
            self.state = State::Waiting(now + self.backoff.next_delay());
        }
    }

    fn rewind(&mut self) {
        self.prefix.clear();
        self.queue.clear();
        self.cursor.rewind();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

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
            let buffer = Buffer::in_memory(1, 1 << 20);
            for seq in 1..=batches {
                buffer.push(Batch { plc: "mixer".into(), seq, ts: seq, samples: 2, data: "{}".into() });
            }
            let delivery = Delivery::new(buffer.cursor(0), Arc::new(Health::new(OutputKind::Mqtt)));
            Self { buffer, delivery, now: Instant::now() }
        }

        /// Sends all that may be sent.
        fn send(&mut self) -> Vec<u64> {
            if self.delivery.needs_batches() {
                let _ = self.delivery.fetch().now_or_never();
            }
            std::iter::from_fn(|| self.delivery.take(self.now)).map(|entry| entry.position).collect()
        }

        /// Sends one batch, and tells whether it is a replay.
        fn send_one(&mut self) -> (u64, bool) {
            if self.delivery.needs_batches() {
                let _ = self.delivery.fetch().now_or_never();
            }
            self.delivery.take(self.now).map(|entry| (entry.position, entry.replay)).expect("one may be sent")
        }

        fn lag(&self) -> u64 {
            self.buffer.stats()[0].lag
        }

        fn taken(&mut self, position: u64) {
            self.delivery.taken(position, 2, self.now);
        }

        /// Lets the time pass until the next attempt.
        fn wait(&mut self) {
            let due = self.delivery.due().expect("it waits");
            self.delivery.resume(due - Duration::from_millis(1));
            assert!(self.delivery.due().is_some(), "too early");
            self.delivery.resume(due);
        }
    }

    #[test]
    fn batches_are_acknowledged_in_order_alone() {
        let mut case = Case::new(3);
        assert_eq!(case.send(), [1, 2, 3]);
        case.taken(3);
        case.taken(2);
        assert_eq!(case.lag(), 3);
        case.taken(1);
        assert_eq!(case.lag(), 0);
        assert_eq!(case.delivery.health.delivered(), (3, 6));
    }

    #[test]
    fn after_a_loss_the_unacknowledged_batches_come_again() {
        let mut case = Case::new(4);
        case.send();
        case.taken(1);
        case.taken(3);
        case.delivery.lost(Loss::Other);
        // The third as well: batches are acknowledged as a prefix.
        assert_eq!(case.send(), [2, 3, 4]);
        assert_eq!(case.delivery.health.skipped(), 0);
    }

    #[test]
    fn a_batch_that_was_only_fetched_is_no_replay_after_a_loss() {
        let mut case = Case::new(3);
        assert_eq!([case.send_one(), case.send_one()], [(1, false), (2, false)]);
        case.delivery.lost(Loss::Other);
        assert_eq!([case.send_one(), case.send_one(), case.send_one()], [(1, true), (2, true), (3, false)]);
    }

    #[test]
    fn a_refused_batch_is_tried_again_with_growing_delays() {
        let mut case = Case::new(3);
        assert_eq!(case.send(), [1, 2, 3]);
        case.taken(1);
        case.delivery.refused(case.now);
        assert_eq!((case.send(), case.delivery.due()), (vec![], None), "the third has no answer yet");
        case.taken(3);
        let mut delays = Vec::new();
        for _ in 0..8 {
            delays.push(case.delivery.due().unwrap() - case.now);
            case.wait();
            assert_eq!(case.send(), [2], "one at a time");
            assert_eq!(case.send(), [0u64; 0]);
            case.delivery.refused(case.now);
        }
        assert!(delays[0] <= Duration::from_millis(250) && delays[7] >= Duration::from_secs(5), "{delays:?}");
        assert_eq!(case.lag(), 2);
        case.wait();
        assert_eq!(case.send(), [2]);
        case.taken(2);
        assert_eq!(case.send(), [3]);
        case.taken(3);
        assert_eq!(case.lag(), 0);
    }

    #[test]
    fn a_batch_that_ends_the_connection_is_found_and_given_up() {
        let mut case = Case::new(4);
        assert_eq!(case.send(), [1, 2, 3, 4]);
        case.taken(1);
        // The second or the third.
        case.delivery.lost(Loss::Suspect);
        assert_eq!((case.lag(), case.delivery.health.skipped()), (3, 0));
        assert_eq!(case.send(), [2], "one at a time");
        assert!(case.delivery.is_probing_in_flight());
        case.delivery.lost(Loss::Guilty(2));
        assert_eq!((case.lag(), case.delivery.health.skipped()), (2, 1));
        assert_eq!(case.send(), [3]);
        case.taken(3);
        assert_eq!(case.send(), [4]);
    }

    #[test]
    fn twice_as_many_batches_are_sent_with_each_that_is_taken() {
        let mut case = Case::new(1000);
        case.send();
        case.delivery.lost(Loss::Suspect);
        let mut limits = Vec::new();
        while let State::Probing(limit) = case.delivery.state {
            let sent = case.send();
            assert!(!sent.is_empty() && case.delivery.in_flight <= limit);
            limits.push(limit);
            case.taken(sent[0]);
        }
        assert_eq!((limits, case.delivery.state), (vec![1, 2, 4, 8, 16, 32, 64], State::Open));
    }

    #[test]
    fn after_losses_without_progress_one_batch_is_sent_at_a_time() {
        let mut case = Case::new(3);
        assert_eq!(case.send(), [1, 2, 3]);
        case.delivery.lost(Loss::Other);
        assert_eq!(case.send(), [1, 2, 3], "once is no pattern");
        case.delivery.lost(Loss::Other);
        assert_eq!(case.send(), [1]);
        case.taken(1);
        assert_eq!(case.send(), [2, 3]);
        case.delivery.lost(Loss::Other);
        assert_eq!((case.send(), case.delivery.health.skipped()), (vec![2], 0));
    }

    #[test]
    fn a_batch_that_is_given_up_holds_up_no_other() {
        let mut case = Case::new(3);
        case.send();
        case.delivery.skip(2, case.now);
        case.taken(1);
        assert_eq!(case.lag(), 1);
        assert_eq!((case.delivery.health.skipped(), case.delivery.health.delivered()), (1, (1, 2)));
        case.taken(3);
        assert_eq!(case.lag(), 0);
    }
}
