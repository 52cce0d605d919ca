//! Tests of the delivery.

use std::time::Duration;

use futures::FutureExt as _;

use super::super::refusals::{HOLD, MAX_PARKED, SHORTEST};
use super::*;
use crate::batch::Batch;
use crate::buffer::Buffer;
use crate::output::{OutputKind, RefusedPlc};

struct Case {
    buffer: Buffer,
    delivery: Delivery,
    now: Instant,
}

impl Case {
    fn new(batches: u64) -> Self {
        Self::of(&["mixer"], batches)
    }

    /// With batches of PLCs in turn.
    fn of(plcs: &[&str], batches: u64) -> Self {
        let buffer = Buffer::in_memory(1, 64 << 20);
        let delivery = Delivery::new(buffer.cursor(0), Arc::new(Health::new(OutputKind::Mqtt)));
        let case = Self { buffer, delivery, now: Instant::now() };
        (1..=batches).zip(plcs.iter().cycle()).for_each(|(seq, plc)| case.push(plc, seq));
        case
    }

    fn push(&self, plc: &str, seq: u64) {
        self.buffer.push(Batch { plc: plc.into(), revision: 0, seq, ts: seq, samples: 2, data: "{}".into() });
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
        self.delivery.taken(position, self.now);
    }

    fn refused(&mut self, position: u64) {
        self.delivery.refused(position, "not authorized", self.now);
    }

    /// Loses the connection, and not because of a refusal.
    fn lost(&mut self, loss: Loss) {
        self.now += SHORTEST;
        self.delivery.lost(loss, self.now);
    }

    /// Lets the time pass until the next attempt, and returns how long that takes.
    fn wait(&mut self) -> Duration {
        let due = self.delivery.due().expect("it waits");
        self.delivery.resume(due - Duration::from_millis(1));
        assert!(self.delivery.due().is_some(), "too early");
        self.delivery.resume(due);
        due - std::mem::replace(&mut self.now, due)
    }

    /// A round of time in which all batches of `refused` are refused, and all others taken. Returns what was
    /// sent of `refused`.
    fn round(&mut self, refused: &[&str], by: Duration) -> usize {
        self.now += by;
        self.delivery.resume(self.now);
        self.delivery.give_up(self.now);
        let mut attempts = 0;
        loop {
            if self.delivery.needs_batches() {
                let _ = self.delivery.fetch().now_or_never();
            }
            let Some(entry) = self.delivery.take(self.now) else { return attempts };
            if refused.contains(&&*entry.batch.plc) {
                attempts += 1;
                self.refused(entry.position);
            } else {
                self.taken(entry.position);
            }
        }
    }

    fn dropped(&self, plc: &str) -> u64 {
        self.delivery.health.refused_plcs().get(plc).map_or(0, |plc| plc.dropped)
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
    case.lost(Loss::Other);
    // The third as well: batches are acknowledged as a prefix.
    assert_eq!(case.send(), [2, 3, 4]);
    assert_eq!(case.delivery.health.skipped(), 0);
}

#[test]
fn a_batch_that_was_only_fetched_is_no_replay_after_a_loss() {
    let mut case = Case::new(3);
    assert_eq!([case.send_one(), case.send_one()], [(1, false), (2, false)]);
    case.lost(Loss::Other);
    assert_eq!([case.send_one(), case.send_one(), case.send_one()], [(1, true), (2, true), (3, false)]);
}

/// With one state for all PLCs, the batches of the boiler waited for those of the mixer, for ever.
#[test]
fn a_refused_plc_holds_up_no_other_and_is_tried_with_growing_delays() {
    let mut case = Case::of(&["mixer", "boiler"], 8);
    assert_eq!(case.send(), [1, 2, 3, 4, 5, 6, 7, 8]);
    [1, 3, 5].into_iter().for_each(|position| case.refused(position));
    [2, 4, 6, 8, 7].into_iter().for_each(|position| case.taken(position));
    // The seventh was taken nevertheless, so the PLC is taken again: the others follow in their order.
    assert_eq!(case.delivery.health.failure(), None);
    assert_eq!(case.send(), [1, 3, 5]);
    [1, 3, 5].into_iter().for_each(|position| case.refused(position));
    let failure = case.delivery.health.failure().unwrap();
    assert_eq!(failure, "batches of mixer: not authorized");
    (9..=12).zip(["mixer", "boiler"].into_iter().cycle()).for_each(|(seq, plc)| case.push(plc, seq));
    assert_eq!(case.send(), [10, 12], "the batches of the mixer wait behind the first");
    [10, 12].into_iter().for_each(|position| case.taken(position));
    let mut delays = Vec::new();
    for _ in 0..8 {
        delays.push(case.wait());
        assert_eq!(case.send(), [1], "one at a time");
        assert_eq!((case.send(), case.delivery.due()), (vec![], None), "it has no answer yet");
        case.refused(1);
    }
    assert!(delays[0] <= Duration::from_millis(250) && delays[7] >= Duration::from_secs(5), "{delays:?}");
    assert_eq!((case.lag(), case.delivery.health.delivered()), (12, (7, 14)));
    case.wait();
    assert_eq!(case.send_one(), (1, true));
    case.taken(1);
    assert_eq!(case.send(), [3, 5, 9, 11]);
    [3, 5, 9, 11].into_iter().for_each(|position| case.taken(position));
    assert_eq!((case.lag(), case.delivery.health.failure()), (0, None));
    assert_eq!(case.delivery.health.refused_plcs()["mixer"], RefusedPlc::default());
}

#[test]
fn a_plc_that_is_refused_for_long_is_dropped_and_comes_back() {
    let mut case = Case::of(&["mixer", "boiler"], 2);
    let second = Duration::from_secs(1);
    let (mut seq, mut rounds) = (2, 0);
    let mut push = |case: &Case| {
        seq += 1;
        ["mixer", "boiler"].into_iter().for_each(|plc| case.push(plc, seq));
    };
    while case.dropped("mixer") == 0 {
        case.round(&["mixer"], second);
        push(&case);
        rounds += 1;
        assert!(rounds <= HOLD.as_secs() + 2, "it is never given up");
    }
    assert!(rounds >= HOLD.as_secs(), "{rounds} s");
    assert_eq!(case.delivery.health.delivered().0, rounds, "the boiler lacks nothing");
    // Nothing is held any more, and one batch in 10 s is an attempt.
    let mut attempts = 0;
    for _ in 0..100 {
        attempts += case.round(&["mixer"], second);
        push(&case);
    }
    assert!((9..=21).contains(&attempts), "{attempts}");
    assert!(case.lag() <= 3, "{}", case.lag());
    let dropped = case.dropped("mixer");
    assert_eq!(case.delivery.health.skipped(), dropped);
    let (mut until_back, taken) = (0, case.delivery.health.delivered().0);
    while case.delivery.health.refused_plcs()["mixer"].is_refused {
        case.round(&[], second);
        push(&case);
        until_back += 1;
    }
    assert!(until_back <= 11, "{until_back} s");
    assert!(case.buffer.present_values_wanted().now_or_never().is_some(), "its values are missing");
    case.round(&[], second);
    case.round(&[], second);
    assert_eq!(case.lag(), 0);
    let lost = case.dropped("mixer") - dropped;
    assert_eq!(case.delivery.health.delivered().0 - taken + lost, 2 * until_back + 2, "nothing else is missing");
}

#[test]
fn nothing_is_dropped_while_the_broker_refuses_all() {
    let mut case = Case::of(&["mixer", "boiler"], 40_000);
    let both = ["mixer", "boiler"];
    for _ in 0..3000 {
        case.round(&both, Duration::from_secs(1));
    }
    assert_eq!((case.lag(), case.delivery.health.skipped()), (40_000, 0));
    assert!(!case.delivery.needs_batches() && case.delivery.prefix.len() <= MAX_PARKED + MAX_BATCHES);
    // The broker is well again. The second PLC must not be given up before its next attempt.
    for _ in 0..30 {
        case.round(&[], Duration::from_secs(1));
    }
    assert_eq!((case.lag(), case.delivery.health.skipped()), (0, 0));
    // A single PLC has no others.
    let mut case = Case::new(40_000);
    for _ in 0..3000 {
        case.round(&["mixer"], Duration::from_secs(1));
    }
    assert_eq!((case.lag(), case.delivery.health.skipped()), (40_000, 0));
}

#[test]
fn a_refused_plc_with_too_many_batches_makes_room() {
    let mut case = Case::of(&["mixer", "mixer", "mixer", "boiler"], 60_000);
    let mut rounds = 0;
    while case.lag() > 0 {
        case.round(&["mixer"], Duration::from_secs(1));
        rounds += 1;
        assert!(rounds < 10, "{} are left", case.lag());
    }
    assert_eq!(case.delivery.health.delivered().0, 15_000);
    assert!(case.dropped("mixer") >= 44_990, "{}", case.dropped("mixer"));
}

#[test]
fn the_next_connection_tries_a_refused_plc_at_once() {
    let mut case = Case::of(&["mixer", "boiler"], 4);
    assert_eq!(case.send(), [1, 2, 3, 4]);
    case.refused(1);
    case.taken(2);
    case.lost(Loss::Other);
    // The second was taken.
    assert_eq!((case.send(), case.delivery.due()), (vec![4, 1], None));
    case.taken(1);
    assert_eq!(case.send(), [3]);
    [3, 4].into_iter().for_each(|position| case.taken(position));
    assert_eq!(case.lag(), 0);
}

#[test]
fn a_batch_that_ends_the_connection_is_found_and_given_up() {
    let mut case = Case::new(4);
    assert_eq!(case.send(), [1, 2, 3, 4]);
    case.taken(1);
    // The second or the third.
    case.lost(Loss::Suspect);
    assert_eq!((case.lag(), case.delivery.health.skipped()), (3, 0));
    assert_eq!(case.send(), [2], "one at a time");
    assert!(case.delivery.is_probing_in_flight());
    case.lost(Loss::Guilty(2));
    assert_eq!((case.lag(), case.delivery.health.skipped()), (2, 1));
    assert_eq!(case.send(), [3]);
    case.taken(3);
    assert_eq!(case.send(), [4]);
}

#[test]
fn twice_as_many_batches_are_sent_with_each_that_is_taken() {
    let mut case = Case::new(1000);
    case.send();
    case.lost(Loss::Suspect);
    let mut limits = Vec::new();
    while let State::Probing(limit) = case.delivery.state {
        let sent = case.send();
        assert!(!sent.is_empty() && case.delivery.in_flight.len() <= limit);
        limits.push(limit);
        case.taken(sent[0]);
    }
    assert_eq!((limits, case.delivery.state), (vec![1, 2, 4, 8, 16, 32, 64], State::Open));
}

#[test]
fn after_losses_without_progress_one_batch_is_sent_at_a_time() {
    let mut case = Case::new(3);
    assert_eq!(case.send(), [1, 2, 3]);
    case.lost(Loss::Other);
    assert_eq!(case.send(), [1, 2, 3], "once is no pattern");
    case.lost(Loss::Other);
    assert_eq!(case.send(), [1]);
    case.taken(1);
    assert_eq!(case.send(), [2, 3]);
    case.lost(Loss::Other);
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

/// Without the positions that stay settled, 2 was sent on each new connection, and ended it: the output delivered
/// nothing more.
#[test]
fn a_batch_that_ends_the_connection_is_given_up_behind_a_refused_one() {
    let mut case = Case::of(&["mixer", "boiler"], 4);
    assert_eq!(case.send(), [1, 2, 3, 4]);
    case.refused(1);
    case.lost(Loss::Suspect);
    assert_eq!(case.send(), [2]);
    case.lost(Loss::Guilty(2));
    assert_eq!(case.send(), [4]);
    case.taken(4);
    assert_eq!(case.send(), [1]);
    case.refused(1);
    // Nor is one sent again that was taken.
    case.lost(Loss::Other);
    assert_eq!(case.send(), [1]);
    case.taken(1);
    assert_eq!(case.send(), [3]);
    case.taken(3);
    assert_eq!((case.lag(), case.delivery.health.skipped()), (0, 1));
}

/// Without it, the PLC was given up at once by the time before the new connection, and its batches were dropped.
#[test]
fn the_time_of_a_refused_plc_begins_anew_with_a_connection() {
    let mut case = Case::of(&["mixer", "boiler"], 2);
    case.round(&["mixer"], Duration::ZERO);
    case.push("boiler", 3);
    case.round(&["mixer"], Duration::from_secs(120));
    case.lost(Loss::Other);
    // The broker is away, and then takes those of the boiler.
    case.push("boiler", 4);
    case.round(&["mixer"], HOLD - Duration::from_secs(60));
    case.push("boiler", 5);
    case.round(&["mixer"], Duration::from_secs(60));
    case.push("boiler", 6);
    case.round(&["mixer"], HOLD - Duration::from_secs(61));
    assert_eq!(case.dropped("mixer"), 0);
    case.round(&["mixer"], Duration::from_secs(1));
    assert_eq!(case.dropped("mixer"), 1);
}

/// Without it, the present values of the boiler waited until the mixer was taken or given up: for up to 10 minutes.
#[test]
fn present_values_wait_for_no_refused_plc() {
    let mut case = Case::of(&["mixer", "boiler"], 4);
    assert_eq!(case.send(), [1, 2, 3, 4]);
    [1, 3].into_iter().for_each(|position| case.refused(position));
    // An outage.
    case.lost(Loss::Other);
    assert_eq!(case.send(), [2, 1, 4], "the first is an attempt");
    case.taken(2);
    let wanted = |case: &Case| case.buffer.present_values_wanted().now_or_never().is_some();
    assert!(!wanted(&case), "the fourth has no answer");
    case.taken(4);
    assert!(wanted(&case), "the others are refused, or attempts");
    case.refused(1);
    for seq in 5..10 {
        case.push("boiler", seq);
        let sent = case.send();
        sent.into_iter().for_each(|position| case.taken(position));
        case.wait();
        assert_eq!(case.send(), [1]);
        case.refused(1);
    }
    assert!(!wanted(&case), "once");
    // The last one of the next outage is of the refused PLC.
    case.lost(Loss::Other);
    assert_eq!(case.send(), [1]);
    case.refused(1);
    assert!(wanted(&case));
    // As soon as it is taken, its batches come as replays, and then its present values.
    case.wait();
    assert_eq!(case.send(), [1]);
    case.taken(1);
    assert!(wanted(&case));
    assert_eq!(case.send(), [3]);
    case.taken(3);
    assert_eq!((case.lag(), wanted(&case)), (0, false));
}

/// Without it, the failure of the output named the PLC for ever: no batch of it came that the broker could take.
#[test]
fn a_removed_plc_is_no_failure_any_more() {
    let mut case = Case::of(&["mixer", "boiler", "silo"], 3);
    case.round(&["mixer", "silo"], Duration::ZERO);
    let failure = |case: &Case| case.delivery.health.failure();
    let is_refused = |case: &Case| case.delivery.health.refused_plcs()["mixer"].is_refused;
    let all = |case: &mut Case, plcs: &[&str]| case.delivery.configured(|plc| plcs.contains(&plc));
    all(&mut case, &["boiler", "mixer", "silo"]);
    assert_eq!(failure(&case).unwrap(), "batches of mixer and 1 more PLCs: not authorized");
    all(&mut case, &["boiler", "silo"]);
    assert_eq!(failure(&case).unwrap(), "batches of silo: not authorized");
    assert!(!is_refused(&case));
    all(&mut case, &["boiler"]);
    assert_eq!((failure(&case), case.lag()), (None, 3), "the batches are kept");
    // A further refusal does not bring it back, but a reload does.
    assert_eq!(case.round(&["mixer", "silo"], Duration::from_secs(1)), 2);
    all(&mut case, &["boiler"]);
    assert_eq!(failure(&case), None);
    all(&mut case, &["boiler", "mixer"]);
    assert_eq!(failure(&case).unwrap(), "batches of mixer: not authorized");
    assert!(is_refused(&case));
    all(&mut case, &["boiler"]);
    // It is given up as others, and forgotten.
    for seq in 4.. {
        case.push("boiler", seq);
        case.round(&["mixer", "silo"], Duration::from_secs(60));
        all(&mut case, &["boiler"]);
        if case.lag() == 0 {
            break;
        }
        assert!(seq < 20, "it is never given up");
    }
    assert_eq!((case.dropped("mixer"), failure(&case)), (1, None));
    assert!(!case.delivery.has_refused());
}

/// mosquitto 2.0 with `max_queued_messages 0`. Without the delays, each connection ended with its first attempt, four
/// of them a second, and without the time that goes on nothing was ever given up.
#[test]
fn refusals_that_end_the_connection_hold_up_no_other_plc() {
    let mut case = Case::of(&["mixer", "boiler", "silo"], 3);
    let refused = ["mixer", "silo"];
    let second = Duration::from_secs(1);
    let (mut losses, mut tried, mut seq) = (0_u64, [0_u64; 2], 3);
    // Sends until a batch is refused, which ends the connection.
    let mut round = |case: &mut Case, refused: &[&str]| {
        case.now += second;
        case.delivery.resume(case.now);
        case.delivery.give_up(case.now);
        loop {
            if case.delivery.needs_batches() {
                let _ = case.delivery.fetch().now_or_never();
            }
            let Some(entry) = case.delivery.take(case.now) else { return };
            if let Some(plc) = refused.iter().position(|plc| **plc == *entry.batch.plc) {
                losses += 1;
                tried[plc] += 1;
                case.refused(entry.position);
                case.delivery.lost(Loss::Other, case.now);
                return;
            }
            case.taken(entry.position);
        }
    };
    for time in 1..HOLD.as_secs() + 30 {
        round(&mut case, &refused);
        seq += 1;
        ["mixer", "boiler", "silo"].into_iter().for_each(|plc| case.push(plc, seq));
        if time == 60 {
            assert_eq!((case.dropped("mixer"), case.delivery.health.skipped()), (0, 0));
            assert!(case.delivery.health.delivered().0 >= 50, "{:?}", case.delivery.health);
        }
    }
    assert!(case.dropped("mixer") > 0 && case.dropped("silo") > 0, "they are given up");
    assert!(case.lag() <= 100, "{}", case.lag());
    // The silo is taken, and the mixer after it.
    while case.delivery.health.refused_plcs()["silo"].is_refused {
        assert!(seq < 700, "it is never tried");
        round(&mut case, &refused[..1]);
        seq += 1;
        ["mixer", "silo"].into_iter().for_each(|plc| case.push(plc, seq));
    }
    while case.delivery.health.refused_plcs()["mixer"].is_refused {
        assert!(seq < 800, "it is never tried");
        round(&mut case, &[]);
        seq += 1;
        case.push("mixer", seq);
    }
    (0..3).for_each(|_| round(&mut case, &[]));
    assert_eq!(case.lag(), 0);
    println!("{losses} losses; attempts of each: {tried:?}");
    assert!(losses <= HOLD.as_secs() / 4 && tried[0].abs_diff(tried[1]) < losses / 4, "{losses} {tried:?}");
}
