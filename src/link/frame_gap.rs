//! The silence between a reply and the next request, in which the RS-485 drivers of a line turn
//! around.
//!
//! The gap is short until the line shows that it must be long: a station that answers does not
//! answer the request after a short gap, and answers again after a long one. Then the gap is long
//! for a number of exchanges, and short again for a trial. The number grows with each trial that
//! fails, so that a line with slow drivers loses few requests.
//!
//! ```text
//! short ──no answer from a station that answered──▶ suspected ──answer──▶ long
//!   ▲ ▲───────────────no answer again, too──────────────┘                  │
//!   └──────────────────────after a number of exchanges─────────────────────┘
//! ```
//!
//! Invariants:
//! - A request that must not be repeated has the long gap before it.
//! - A gap with one length never changes.

use std::time::Duration;

use tokio::time::Instant;

use super::later;

/// The lengths of the gap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct GapLengths {
    pub(crate) short: Duration,
    pub(crate) long: Duration,
}

impl GapLengths {
    /// A gap of one length.
    pub(crate) const fn fixed(gap: Duration) -> Self {
        Self { short: gap, long: gap }
    }
}

#[derive(Debug)]
pub(crate) struct FrameGap {
    lengths: GapLengths,
    state: State,
    /// When the last reply ended.
    replied_at: Option<Instant>,
    /// The number of exchanges for which the next long gap lasts.
    long_for: u32,
    /// The number of exchanges after a short gap, since the last long one.
    good: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Short,
    /// This station did not answer a request after a short gap.
    Suspected {
        station: u8,
        /// Number of replies of others after which the suspicion ends.
        left: u32,
    },
    Long {
        /// Number of exchanges that it still lasts for.
        left: u32,
    },
}

/// The number of exchanges for which the first long gap lasts.
const FIRST: u32 = 256;

/// Growth of that number with each trial that fails.
const GROWTH: u32 = 4;

/// The maximum of that number.
const MOST: u32 = 65_536;

impl FrameGap {
    /// The gap of a line; `None` if its lengths are zero.
    pub(crate) fn new(lengths: GapLengths) -> Option<Self> {
        let gap = Self { lengths, state: State::Short, replied_at: None, long_for: FIRST, good: 0 };
        (lengths != GapLengths::fixed(Duration::ZERO)).then_some(gap)
    }

    /// The end of the gap; `None` before the first reply. `for_write` returns whether the next
    /// request may be one that must not be repeated.
    pub(crate) fn until(&self, for_write: impl FnOnce() -> bool) -> Option<Instant> {
        Some(later(self.replied_at?, self.length(for_write)))
    }

    /// The length of the gap, as for [`until`](Self::until).
    pub(crate) fn length(&self, for_write: impl FnOnce() -> bool) -> Duration {
        let GapLengths { short, long } = self.lengths;
        match self.state {
            State::Short if short == long || !for_write() => short,
            State::Short | State::Suspected { .. } | State::Long { .. } => long,
        }
    }

    /// Notes a reply to a request begun at `began`. Returns whether the gap is long from now on.
    pub(crate) fn replied(&mut self, station: u8, began: Instant, now: Instant) -> bool {
        let was_short = self.is_short_before(began);
        self.replied_at = Some(now);
        match &mut self.state {
            State::Suspected { station: of, .. } if *of == station => {
                if was_short {
                    // It answers after a short gap, too.
                    self.state = State::Short;
                    return false;
                }
                self.state = State::Long { left: self.long_for };
                self.long_for = self.long_for.saturating_mul(GROWTH).min(MOST);
                self.good = 0;
                return true;
            }
            State::Long { left: ..=1 } => self.state = State::Short,
            State::Long { left } => *left = left.saturating_sub(1),
            State::Short if was_short => {
                self.good = self.good.saturating_add(1);
                if self.good >= self.long_for {
                    self.long_for = FIRST;
                }
            }
            State::Suspected { left: ..=1, .. } => self.state = State::Short,
            State::Suspected { left, .. } => *left = left.saturating_sub(1),
            State::Short => {}
        }
        false
    }

    /// Notes that a request begun at `began` had no good reply. `answers`: the one before it to
    /// this station had.
    pub(crate) fn gave_up(&mut self, station: u8, answers: bool, began: Instant) {
        match self.state {
            State::Short if answers && self.is_short_before(began) => {
                self.state = State::Suspected { station, left: FIRST };
            }
            // It does not answer after a long gap either.
            State::Suspected { station: of, .. } if of == station => self.state = State::Short,
            State::Short | State::Suspected { .. } | State::Long { .. } => {}
        }
    }

    /// Forgets the last reply.
    pub(crate) fn runtime_ended(&mut self) {
        self.replied_at = None;
    }

    /// Returns whether the gap before a request begun at this time was shorter than the long one.
    fn is_short_before(&self, began: Instant) -> bool {
        self.replied_at.is_some_and(|at| began < later(at, self.lengths.long))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHORT: Duration = Duration::from_micros(300);
    const LONG: Duration = Duration::from_millis(2);

    /// A line: exchanges take no time, and each request is sent at the end of the gap.
    struct Line {
        gap: FrameGap,
        now: Instant,
        /// Number of requests after a short gap.
        short: u32,
    }

    impl Line {
        fn new() -> Self {
            let mut gap = FrameGap::new(GapLengths { short: SHORT, long: LONG }).unwrap();
            let now = Instant::now();
            assert!(gap.until(|| false).is_none() && !gap.replied(1, now, now));
            Self { gap, now, short: 0 }
        }

        /// Sends a request; `answers` gets the gap before it. Returns whether it was answered.
        fn ask(&mut self, station: u8, answers: impl FnOnce(Duration) -> bool) -> bool {
            self.now = self.now.max(self.gap.until(|| false).unwrap());
            let before = self.now;
            let gap = before.duration_since(self.gap.replied_at.unwrap());
            self.short += u32::from(gap == SHORT);
            let answered = answers(gap);
            if answered {
                self.gap.replied(station, before, before);
            } else {
                self.gap.gave_up(station, true, before);
                self.now += Duration::from_millis(300);
            }
            answered
        }
    }

    #[test]
    fn a_line_that_answers_has_short_gaps_and_long_ones_before_writes() {
        let mut line = Line::new();
        assert!((0..1000).all(|_| line.ask(1, |gap| gap == SHORT)));
        assert_eq!(line.gap.until(|| false), Some(line.now + SHORT));
        assert_eq!(line.gap.until(|| true), Some(line.now + LONG));
    }

    #[test]
    fn a_line_that_needs_long_gaps_loses_ever_fewer_requests() {
        let mut line = Line::new();
        let mut lost = Vec::new();
        for n in 0..400_000_u32 {
            if !line.ask(1, |gap| gap >= LONG) {
                lost.push(n);
            }
        }
        let phases: Vec<u32> = lost.windows(2).map(|pair| pair[1] - pair[0]).collect();
        // The retry is answered, then the gap is long for 256 exchanges, 1024 and so on.
        assert_eq!(phases, [258, 1026, 4098, 16_386, 65_538, 65_538, 65_538, 65_538, 65_538]);
    }

    #[test]
    fn single_losses_cost_long_gaps_for_a_while_only() {
        let mut line = Line::new();
        for n in 0..100_000_u32 {
            line.ask(1, |_| n % 5000 != 4999);
        }
        assert!(line.short > 90_000, "{} of 100,000 gaps were short", line.short);
        assert_eq!(line.gap.long_for, FIRST, "the trials between them pass");
    }

    #[test]
    fn a_dead_station_is_no_reason_for_long_gaps() {
        let mut line = Line::new();
        // It is lost while others answer; then its probes fail, which is nothing new.
        line.ask(2, |_| false);
        line.ask(2, |_| false);
        for n in 0..1000 {
            assert!(line.ask(1, |gap| gap == SHORT || n == 0));
            let (until, began) = (line.gap.until(|| false).unwrap(), line.now);
            line.now = until;
            line.gap.gave_up(2, false, began);
        }
    }

    #[test]
    fn the_number_of_long_gaps_shrinks_only_after_as_many_good_short_ones() {
        let mut line = Line::new();
        let lose = |line: &mut Line, good: u32| {
            for _ in 0..good {
                assert!(line.ask(1, |gap| gap == SHORT));
            }
            line.ask(1, |_| false);
            line.ask(1, |_| true);
            let State::Long { left } = line.gap.state else { panic!("{:?}", line.gap) };
            (0..left).for_each(|_| assert!(line.ask(1, |gap| gap == LONG)));
            left
        };
        assert_eq!(lose(&mut line, 10), FIRST);
        assert_eq!(lose(&mut line, 10), FIRST * GROWTH, "10 exchanges prove little");
        assert_eq!(lose(&mut line, FIRST * GROWTH * GROWTH), FIRST);
    }

    #[test]
    fn a_silent_station_does_not_clear_the_suspicion_of_another() {
        let mut gap = FrameGap::new(GapLengths { short: SHORT, long: LONG }).unwrap();
        let now = Instant::now();
        gap.replied(1, now, now);
        gap.gave_up(1, true, now + SHORT);
        gap.gave_up(2, false, now + LONG);
        assert!(gap.replied(1, now + 2 * LONG, now + 2 * LONG), "station 1 answers after a long gap");
    }

    /// Its caller may never ask it again.
    #[test]
    fn the_suspicion_of_a_station_that_is_not_asked_again_ends() {
        let mut line = Line::new();
        line.ask(2, |_| false);
        assert!((0..1000).all(|_| line.ask(1, |_| true)));
        assert!(line.short > 700, "{} of 1000 gaps were short", line.short);
    }

    #[test]
    fn a_suspected_station_that_answers_after_a_short_gap_is_no_reason() {
        let mut gap = FrameGap::new(GapLengths { short: SHORT, long: LONG }).unwrap();
        let now = Instant::now();
        gap.replied(1, now, now);
        gap.gave_up(1, true, now + SHORT);
        gap.replied(2, now + LONG, now + LONG);
        // A write that was let through, or a check that was on the wire already.
        assert!(!gap.replied(1, now + LONG + SHORT, now + LONG + SHORT));
        assert_eq!(gap.until(|| false), Some(now + LONG + SHORT + SHORT));
    }

    #[test]
    fn a_fixed_gap_never_changes() {
        let mut gap = FrameGap::new(GapLengths::fixed(LONG)).unwrap();
        let mut now = Instant::now();
        gap.replied(1, now, now);
        for n in 0..1000 {
            let until = gap.until(|| n % 2 == 0).unwrap();
            assert_eq!(until, now + LONG);
            now = until;
            gap.gave_up(1, true, now);
            assert!(!gap.replied(1, now, now), "no request is sent before its end");
        }
    }

    #[test]
    fn lengths_of_zero_are_no_gap() {
        assert!(FrameGap::new(GapLengths::fixed(Duration::ZERO)).is_none());
        assert!(FrameGap::new(GapLengths { short: Duration::ZERO, long: LONG }).is_some());
    }
}
