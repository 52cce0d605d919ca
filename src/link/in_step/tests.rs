//! The rule, one sentence at a time.

use std::time::Duration;

use tokio::time::Instant;

use super::checker::Request;
use super::*;
use crate::command::{ControlPlc, ReadProgramPage, ReadRegisters, ReadStatus, WriteRegisters};
use crate::element::Register;
use crate::endpoint::InStepSettings;

const NETWORK: Duration = Duration::ZERO;
const SERIAL_9600: Duration = Duration::from_micros(1042);
const SERIAL_115200: Duration = Duration::from_micros(87);
const WINDOW: Duration = Duration::from_millis(100);
const QUIET: Duration = Duration::from_secs(1);

/// A station, the rule, and the time.
struct Bench {
    known: InStep,
    rule: Rule,
    now: Instant,
    body: u64,
}

impl Bench {
    /// A station in step, with nothing owed.
    fn with(byte: Duration, copies: u8) -> Self {
        let settings = InStepSettings::default().with_copies(copies).unwrap();
        let prices = Prices { byte, exchange: byte * 16 + Duration::from_millis(5) };
        let rule = Rule { settings, quiet: QUIET, one_request: false, prices, busy: Duration::ZERO };
        let mut known = InStep::new();
        known.is_in_step();
        Self { known, rule, now: Instant::now(), body: 0 }
    }

    fn new() -> Self {
        Self::with(NETWORK, 1)
    }

    fn choose(&mut self, request: &Request) -> Choice {
        self.known.choose(request, false, &self.rule, self.now)
    }

    /// The spelling that goes out.
    #[track_caller]
    fn sends(&mut self, request: &Request) -> (Code, u16) {
        match self.choose(request) {
            Choice::Send(spelling) => (spelling.code, spelling.count),
            choice => panic!("{choice:?}"),
        }
    }

    fn reply(&mut self, shape: Shape, refused: bool) -> Reply {
        self.body += 1;
        Reply { shape, refused, fingerprint: self.body }
    }

    /// A request goes out and is answered; says how it was spelt.
    #[track_caller]
    fn asks(&mut self, request: &Request) -> (Code, u16) {
        let (code, count) = self.sends(request);
        let spelling = Spelling { code, count, before: false };
        let reply = self.reply(request.shape(spelling), false);
        assert!(self.known.proves(request.kind(), &reply));
        self.known.taken(request.kind(), &reply, Duration::ZERO, &self.rule, self.now);
        self.known.answered(request.run, spelling);
        (code, count)
    }

    /// A request goes out and is refused; says whether that is proven.
    #[track_caller]
    fn is_refused(&mut self, request: &Request) -> bool {
        let (code, count) = self.sends(request);
        let reply = self.reply(request.shape(Spelling { code, count, before: false }), true);
        let proven = self.known.proves(request.kind(), &reply);
        match proven {
            true => self.known.taken(request.kind(), &reply, Duration::ZERO, &self.rule, self.now),
            false => self.known.unproven(&reply, false, &self.rule, self.now),
        }
        proven
    }

    fn check(&mut self, check: Check, refused: bool) -> bool {
        let shape = match check {
            Check::Nonce => Shape { code: Code::LoopBack, size: 8 },
            Check::Empty => Check::EMPTY,
            Check::Status => Check::STATUS,
            Check::Detail => Check::DETAIL,
        };
        let reply = self.reply(shape, refused);
        self.known.checked(check, (&reply, false), Duration::ZERO, &self.rule, self.now)
    }

    fn stray(&mut self, code: Code) -> Stray {
        self.body += 1;
        self.known.stray(code.into(), self.body, &self.rule, self.now)
    }
}

fn read(first: u16, count: usize, longer: bool) -> Request {
    Request::new(&ReadRegisters::new(Register::r(first), count).unwrap(), longer)
}

fn write(count: usize) -> Request {
    Request::new(&WriteRegisters::new(Register::r(0), vec![0; count]).unwrap(), false)
}

fn page() -> Request {
    Request::new(&ReadProgramPage::new(0), false)
}

fn run() -> Request {
    Request::new(&ControlPlc::Run, false)
}

fn empty_check() -> Choice {
    Choice::Check(Check::Empty, Why::Owed)
}

#[test]
fn a_longer_read_takes_64_and_63_in_turn() {
    let mut bench = Bench::with(SERIAL_9600, 1);
    let part = read(0, 64, true);
    let counts: Vec<_> = (0..4).map(|_| bench.asks(&part)).collect();
    assert_eq!(counts.iter().map(|(_, count)| *count).collect::<Vec<_>>(), [64, 63, 64, 63]);
}

#[test]
fn reads_take_46_and_48_in_turn() {
    let mut bench = Bench::new();
    let codes: Vec<_> = (0..4).map(|n| bench.asks(&read(10 * n, 1, false)).0).collect();
    assert_eq!(codes, [Code::ReadRegisters, Code::ReadMixed, Code::ReadRegisters, Code::ReadMixed]);
}

#[test]
fn writes_take_47_and_49_in_turn() {
    let mut bench = Bench::new();
    let codes: Vec<_> = (0..3).map(|_| bench.asks(&write(2)).0).collect();
    assert_eq!(codes, [Code::WriteRegisters, Code::WriteMixed, Code::WriteRegisters]);
}

#[test]
fn one_element_more_is_read_only_if_answered_before() {
    let mut bench = Bench::with(SERIAL_9600, 1);
    bench.asks(&read(100, 16, false));
    assert_eq!(bench.choose(&read(0, 16, false)), empty_check());
    bench.known.is_in_step();
    bench.asks(&read(16, 1, false));
    bench.known.is_in_step();
    bench.asks(&read(0, 16, false));
    assert_eq!(bench.asks(&read(0, 16, false)), (Code::ReadRegisters, 17));
    // A refusal of it is remembered.
    let plain = Spelling::new(Code::ReadRegisters, 16);
    bench.known.spelling_refused(plain, Spelling { count: 17, ..plain }, read(0, 16, false).run, false);
    bench.known.is_in_step();
    bench.known.answered(read(0, 16, false).run, plain);
    let reply = bench.reply(read(0, 16, false).shape(plain), false);
    bench.known.taken(Kind::Read, &reply, Duration::ZERO, &bench.rule, bench.now);
    assert_eq!(bench.choose(&read(0, 16, false)), empty_check());
}

#[test]
fn the_price_decides_between_48_and_an_empty_4e() {
    for (byte, count, mixed) in [
        (NETWORK, 64, true),
        (SERIAL_115200, 8, true),
        (SERIAL_115200, 64, false),
        (SERIAL_9600, 16, false),
        (SERIAL_9600, 2, true),
    ] {
        let mut bench = Bench::with(byte, 1);
        bench.asks(&read(0, count, false));
        let choice = bench.choose(&read(100, count, false));
        let spelling = Spelling::new(Code::ReadMixed, count);
        assert_eq!(choice, if mixed { Choice::Send(spelling) } else { empty_check() }, "{byte:?} {count}");
    }
}

#[test]
fn a_spelling_that_the_device_lacks_is_not_used() {
    let mut bench = Bench::new();
    bench.asks(&read(0, 1, false));
    let plain = Spelling::new(Code::ReadRegisters, 1);
    bench.known.spelling_refused(plain, Spelling::new(Code::ReadMixed, 1), None, true);
    assert_eq!(bench.choose(&read(0, 1, false)), empty_check());
}

#[test]
fn a_request_of_one_spelling_goes_behind_an_empty_4e() {
    let mut bench = Bench::new();
    bench.asks(&run());
    assert_eq!(bench.choose(&run()), empty_check());
    assert!(bench.check(Check::Empty, false));
    assert_eq!(bench.asks(&run()).0, Code::ControlPlc);
}

#[test]
fn a_nonce_separates_where_an_empty_4e_is_owed() {
    let mut bench = Bench::new();
    assert!(bench.check(Check::Empty, false));
    let choice = bench.known.separate(Why::Owed, Check::Empty, &bench.rule, bench.now);
    assert_eq!(choice, Choice::Check(Check::Nonce, Why::Owed));
}

#[test]
fn the_status_separates_where_4e_is_refused() {
    let mut bench = Bench::new();
    bench.known.refused = true;
    bench.asks(&run());
    assert_eq!(bench.choose(&run()), Choice::Check(Check::Status, Why::Owed));
    assert!(bench.check(Check::Status, false));
    bench.known.refused = true;
    assert_eq!(bench.choose(&Request::new(&ReadStatus, false)), Choice::Check(Check::Detail, Why::Owed));
}

#[test]
fn a_refusal_that_may_be_owed_proves_nothing() {
    let mut bench = Bench::with(SERIAL_9600, 1);
    let part = read(0, 64, true);
    bench.asks(&part);
    assert!(!bench.is_refused(&part), "that may be a second answer to the first");
    assert_eq!(bench.choose(&part), Choice::Check(Check::Nonce, Why::Unproven));
    assert!(bench.check(Check::Nonce, false));
    assert!(bench.is_refused(&part));
}

#[test]
fn a_write_is_not_sent_while_its_refusal_is_owed() {
    let mut bench = Bench::new();
    assert!(bench.is_refused(&run()));
    assert_eq!(bench.choose(&run()), empty_check());
}

#[test]
fn a_page_is_proven_only_if_it_differs_from_the_last() {
    let mut bench = Bench::new();
    let shape = page().shape(page().plain());
    let reply = |fingerprint, refused| Reply { shape, refused, fingerprint };
    bench.known.taken(Kind::Page, &reply(1, false), Duration::ZERO, &bench.rule, bench.now);
    assert!(bench.known.proves(Kind::Page, &reply(2, false)));
    assert!(!bench.known.proves(Kind::Page, &reply(1, false)));
    assert!(!bench.known.proves(Kind::Page, &reply(2, true)));
    bench.known.taken(Kind::Page, &reply(2, true), Duration::ZERO, &bench.rule, bench.now);
    assert!(!bench.known.proves(Kind::Page, &reply(3, false)), "the copy may be any page");
}

#[test]
fn after_two_equal_pages_a_check_goes_first() {
    let mut bench = Bench::new();
    let reply = Reply { shape: page().shape(page().plain()), refused: false, fingerprint: 7 };
    bench.known.taken(Kind::Page, &reply, Duration::ZERO, &bench.rule, bench.now);
    bench.sends(&page());
    bench.known.taken(Kind::Page, &reply, Duration::ZERO, &bench.rule, bench.now);
    assert_eq!(bench.choose(&page()), empty_check());
}

#[test]
fn a_taken_reply_lapses_after_the_window_of_silence() {
    let mut bench = Bench::new();
    bench.asks(&run());
    bench.now += WINDOW / 2;
    assert_eq!(bench.known.last, Some(bench.body));
    assert_eq!(bench.known.stray(0x41, bench.body, &bench.rule, bench.now), Stray::Duplicate);
    bench.now += WINDOW - Duration::from_millis(1);
    assert_eq!(bench.choose(&run()), empty_check(), "the line was not silent");
    let proofs = bench.known.proof().proofs;
    bench.now += Duration::from_millis(1);
    bench.sends(&run());
    assert_eq!(bench.known.proof().proofs, proofs, "a pause proves nothing to a job");
}

#[test]
fn a_slow_exchange_lapses_after_twice_its_time() {
    let mut bench = Bench::new();
    let reply = bench.reply(run().shape(run().plain()), false);
    bench.known.taken(Kind::Once, &reply, WINDOW, &bench.rule, bench.now);
    bench.now += WINDOW * 2 - Duration::from_millis(1);
    assert_eq!(bench.choose(&run()), empty_check());
    bench.now += Duration::from_millis(1);
    bench.sends(&run());
}

#[test]
fn a_line_without_copies_owes_nothing() {
    let mut bench = Bench::with(NETWORK, 0);
    bench.asks(&run());
    bench.asks(&run());
    assert_eq!(bench.known.confirm(&bench.rule, bench.now), None);
}

#[test]
fn three_copies_keep_three_replies_owed() {
    let mut bench = Bench::with(NETWORK, 3);
    bench.asks(&run());
    bench.asks(&read(0, 1, false));
    assert!(bench.check(Check::Nonce, false));
    assert_ne!(bench.known.threat(run().shape(run().plain())), Threat::None, "the echo proves no roaming copy");
    bench.asks(&page());
    bench.sends(&run());
}

#[test]
fn a_broadcast_is_owed_until_the_next_reply() {
    let mut bench = Bench::new();
    bench.known.broadcast(Code::ControlPlc, bench.now);
    assert_eq!(bench.choose(&run()), empty_check());
    bench.now += 2 * WINDOW;
    assert_eq!(bench.choose(&run()), empty_check(), "it does not lapse");
    bench.asks(&read(0, 1, false));
    bench.sends(&run());
}

#[test]
fn strays_are_told_apart_and_the_unexpected_are_doubts() {
    let mut bench = Bench::new();
    bench.asks(&run());
    let before = bench.known.proof();
    assert_eq!(bench.known.stray(0x41, bench.body, &bench.rule, bench.now), Stray::Duplicate);
    assert!(!bench.known.is_suspect());
    bench.known.broadcast(Code::WriteRegisters, bench.now);
    assert_eq!(bench.stray(Code::WriteRegisters), Stray::Broadcast);
    assert!(bench.known.is_suspect());
    bench.known.timed_out(Code::ReadRegisters);
    assert_eq!(bench.stray(Code::ReadRegisters), Stray::Late);
    assert_eq!(bench.known.proof(), before);
    assert_eq!(bench.stray(Code::ReadStatus), Stray::Unexpected);
    assert_eq!(bench.known.proof().doubts, before.doubts + 1);
    assert!(bench.check(Check::Nonce, false));
    assert_eq!(bench.known.proof().proofs, before.proofs + 1);
    assert_eq!(bench.stray(Code::ReadRegisters), Stray::Unexpected);
}

#[test]
fn a_refused_4e_of_a_suspect_station_needs_silence() {
    let mut bench = Bench::new();
    bench.known.connected();
    assert_eq!(bench.choose(&run()), Choice::Check(Check::Nonce, Why::Connected));
    assert!(!bench.check(Check::Nonce, true));
    assert_eq!(bench.choose(&run()), Choice::Silence(bench.now + QUIET));
    bench.now += QUIET / 2;
    bench.stray(Code::ReadStatus);
    bench.now += QUIET / 2;
    assert_eq!(bench.choose(&run()), Choice::Silence(bench.now + QUIET / 2), "a frame restarts it");
    bench.now += QUIET / 2;
    bench.sends(&run());
}

/// Before, the silence ended at its time, and the answer to the broadcast was the reply to the STOP that followed.
#[test]
fn a_broadcast_restarts_the_silence() {
    let mut bench = Bench::new();
    bench.known.connected();
    assert_eq!(bench.choose(&run()), Choice::Check(Check::Nonce, Why::Connected));
    assert!(!bench.check(Check::Nonce, true));
    let until = bench.now + QUIET;
    assert_eq!(bench.choose(&run()), Choice::Silence(until));
    bench.now = until - QUIET / 100;
    bench.known.broadcast(Code::ControlPlc, bench.now);
    let restarted = bench.now + QUIET;
    bench.now = until;
    assert_eq!(bench.choose(&run()), Choice::Silence(restarted));
    bench.now = restarted;
    bench.sends(&run());
}

#[test]
fn one_request_a_connection_replaces_checks_by_silence() {
    let mut bench = Bench::new();
    bench.rule.one_request = true;
    bench.known.connected();
    assert_eq!(bench.choose(&run()), Choice::Silence(bench.now + QUIET));
    bench.now += QUIET;
    bench.asks(&run());
    let until = bench.now + QUIET;
    assert_eq!(bench.known.confirm(&bench.rule, bench.now), Some(Choice::Silence(until)));
    bench.now = until;
    assert_eq!(bench.known.confirm(&bench.rule, bench.now), None);
}

#[test]
fn what_is_owed_is_confirmed_by_a_nonce() {
    let mut bench = Bench::new();
    bench.asks(&read(0, 1, false));
    let nonce = Choice::Check(Check::Nonce, Why::Confirm);
    assert_eq!(bench.known.confirm(&bench.rule, bench.now), Some(nonce));
    bench.known.timed_out(Code::LoopBack);
    let nonce = Choice::Check(Check::Nonce, Why::TimedOut);
    assert_eq!(bench.known.confirm(&bench.rule, bench.now), Some(nonce));
    let mut undoubled = Bench::with(NETWORK, 0);
    undoubled.asks(&read(0, 1, false));
    assert_eq!(undoubled.known.confirm(&undoubled.rule, undoubled.now), None, "the line never doubles a reply");
}

#[test]
fn a_fast_exchange_behind_slow_ones_has_their_window() {
    let mut bench = Bench::new();
    let slow = bench.reply(run().shape(run().plain()), false);
    bench.known.taken(Kind::Once, &slow, 4 * WINDOW, &bench.rule, bench.now);
    let fast = bench.reply(run().shape(run().plain()), false);
    bench.known.taken(Kind::Once, &fast, Duration::ZERO, &bench.rule, bench.now);
    bench.now += 6 * WINDOW;
    assert_eq!(bench.choose(&run()), empty_check(), "the fast one may have been a copy");
    bench.now += 2 * WINDOW;
    bench.sends(&run());
}
