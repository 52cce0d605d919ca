//! The rule, one statement at a time.

mod owed;

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

/// A station with the settings of its link and the time.
struct TestStation {
    in_step: InStep,
    rule: Rule,
    now: Instant,
    body: u64,
}

impl TestStation {
    /// A station in step, with nothing owed.
    fn with(byte: Duration, copies: u8) -> Self {
        let settings = InStepSettings::default().with_copies(copies).unwrap();
        let prices = Prices { byte, exchange: byte * 16 + Duration::from_millis(5) };
        let rule = Rule { settings, quiet: QUIET, one_request: false, prices, busy: Duration::ZERO };
        let mut in_step = InStep::new();
        in_step.is_in_step();
        Self { in_step, rule, now: Instant::now(), body: 0 }
    }

    fn new() -> Self {
        Self::with(NETWORK, 1)
    }

    fn choose(&mut self, request: &Request) -> Choice {
        self.in_step.choose(request, false, &self.rule, self.now)
    }

    /// The spelling that is sent for a request.
    #[track_caller]
    fn expect_send(&mut self, request: &Request) -> (Code, u16) {
        match self.choose(request) {
            Choice::Send(spelling) => (spelling.code, spelling.count),
            choice => panic!("{choice:?}"),
        }
    }

    fn reply(&mut self, shape: Shape, refused: bool) -> Reply {
        self.body += 1;
        Reply { shape, refused, fingerprint: self.body }
    }

    /// Sends a request and takes its reply. Returns the spelling that was sent.
    #[track_caller]
    fn exchange(&mut self, request: &Request) -> (Code, u16) {
        let (code, count) = self.expect_send(request);
        let spelling = Spelling { code, count, before: false };
        let reply = self.reply(request.shape(spelling), false);
        assert!(self.in_step.proves(request.kind(), &reply));
        self.in_step.taken(request.kind(), &reply, Duration::ZERO, &self.rule, self.now);
        self.in_step.answered(request.run, spelling);
        (code, count)
    }

    /// Sends a request and refuses it. Returns whether the refusal is proven.
    #[track_caller]
    fn exchange_refused(&mut self, request: &Request) -> bool {
        let (code, count) = self.expect_send(request);
        let reply = self.reply(request.shape(Spelling { code, count, before: false }), true);
        let proven = self.in_step.proves(request.kind(), &reply);
        match proven {
            true => self.in_step.taken(request.kind(), &reply, Duration::ZERO, &self.rule, self.now),
            false => self.in_step.unproven(&reply, false, &self.rule, self.now),
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
        self.in_step.checked(check, (&reply, false), Duration::ZERO, &self.rule, self.now)
    }

    fn stray(&mut self, code: Code) -> Stray {
        self.body += 1;
        self.in_step.stray(code.into(), self.body, &self.rule, self.now)
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
    let mut station = TestStation::with(SERIAL_9600, 1);
    let part = read(0, 64, true);
    let counts: Vec<_> = (0..4).map(|_| station.exchange(&part)).collect();
    assert_eq!(counts.iter().map(|(_, count)| *count).collect::<Vec<_>>(), [64, 63, 64, 63]);
}

#[test]
fn reads_take_46_and_48_in_turn() {
    let mut station = TestStation::new();
    let codes: Vec<_> = (0..4).map(|n| station.exchange(&read(10 * n, 1, false)).0).collect();
    assert_eq!(codes, [Code::ReadRegisters, Code::ReadMixed, Code::ReadRegisters, Code::ReadMixed]);
}

#[test]
fn writes_take_47_and_49_in_turn() {
    let mut station = TestStation::new();
    let codes: Vec<_> = (0..3).map(|_| station.exchange(&write(2)).0).collect();
    assert_eq!(codes, [Code::WriteRegisters, Code::WriteMixed, Code::WriteRegisters]);
}

#[test]
fn one_element_more_is_read_only_if_answered_before() {
    let mut station = TestStation::with(SERIAL_9600, 1);
    station.exchange(&read(100, 16, false));
    assert_eq!(station.choose(&read(0, 16, false)), empty_check());
    station.in_step.is_in_step();
    station.exchange(&read(16, 1, false));
    station.in_step.is_in_step();
    station.exchange(&read(0, 16, false));
    assert_eq!(station.exchange(&read(0, 16, false)), (Code::ReadRegisters, 17));
    // A refused spelling is not used again.
    let plain = Spelling::new(Code::ReadRegisters, 16);
    station.in_step.spelling_refused(plain, Spelling { count: 17, ..plain }, read(0, 16, false).run, false);
    station.in_step.is_in_step();
    station.in_step.answered(read(0, 16, false).run, plain);
    let reply = station.reply(read(0, 16, false).shape(plain), false);
    station.in_step.taken(Kind::Read, &reply, Duration::ZERO, &station.rule, station.now);
    assert_eq!(station.choose(&read(0, 16, false)), empty_check());
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
        let mut station = TestStation::with(byte, 1);
        station.exchange(&read(0, count, false));
        let choice = station.choose(&read(100, count, false));
        let spelling = Spelling::new(Code::ReadMixed, count);
        assert_eq!(choice, if mixed { Choice::Send(spelling) } else { empty_check() }, "{byte:?} {count}");
    }
}

#[test]
fn a_spelling_that_the_device_lacks_is_not_used() {
    let mut station = TestStation::new();
    station.exchange(&read(0, 1, false));
    let plain = Spelling::new(Code::ReadRegisters, 1);
    station.in_step.spelling_refused(plain, Spelling::new(Code::ReadMixed, 1), None, true);
    assert_eq!(station.choose(&read(0, 1, false)), empty_check());
}

#[test]
fn a_request_of_one_spelling_goes_behind_an_empty_4e() {
    let mut station = TestStation::new();
    station.exchange(&run());
    assert_eq!(station.choose(&run()), empty_check());
    assert!(station.check(Check::Empty, false));
    assert_eq!(station.exchange(&run()).0, Code::ControlPlc);
}

#[test]
fn a_nonce_separates_where_an_empty_4e_is_owed() {
    let mut station = TestStation::new();
    assert!(station.check(Check::Empty, false));
    let choice = station.in_step.separate(Why::Owed, Check::Empty, &station.rule, station.now);
    assert_eq!(choice, Choice::Check(Check::Nonce, Why::Owed));
}

#[test]
fn the_status_separates_where_4e_is_refused() {
    let mut station = TestStation::new();
    station.in_step.refused = true;
    station.exchange(&run());
    assert_eq!(station.choose(&run()), Choice::Check(Check::Status, Why::Owed));
    assert!(station.check(Check::Status, false));
    station.in_step.refused = true;
    assert_eq!(station.choose(&Request::new(&ReadStatus, false)), Choice::Check(Check::Detail, Why::Owed));
}

#[test]
fn a_refusal_that_may_be_owed_proves_nothing() {
    let mut station = TestStation::with(SERIAL_9600, 1);
    let part = read(0, 64, true);
    station.exchange(&part);
    assert!(!station.exchange_refused(&part), "it may be a second answer to the first request");
    assert_eq!(station.choose(&part), Choice::Check(Check::Nonce, Why::Unproven));
    assert!(station.check(Check::Nonce, false));
    assert!(station.exchange_refused(&part));
}

#[test]
fn a_write_is_not_sent_while_its_refusal_is_owed() {
    let mut station = TestStation::new();
    assert!(station.exchange_refused(&run()));
    assert_eq!(station.choose(&run()), empty_check());
}

#[test]
fn a_page_is_proven_only_if_it_differs_from_the_last() {
    let mut station = TestStation::new();
    let shape = page().shape(page().plain());
    let reply = |fingerprint, refused| Reply { shape, refused, fingerprint };
    station.in_step.taken(Kind::Page, &reply(1, false), Duration::ZERO, &station.rule, station.now);
    assert!(station.in_step.proves(Kind::Page, &reply(2, false)));
    assert!(!station.in_step.proves(Kind::Page, &reply(1, false)));
    assert!(!station.in_step.proves(Kind::Page, &reply(2, true)));
    station.in_step.taken(Kind::Page, &reply(2, true), Duration::ZERO, &station.rule, station.now);
    assert!(!station.in_step.proves(Kind::Page, &reply(3, false)), "the duplicate may be any page");
}

#[test]
fn after_two_equal_pages_a_check_goes_first() {
    let mut station = TestStation::new();
    let reply = Reply { shape: page().shape(page().plain()), refused: false, fingerprint: 7 };
    station.in_step.taken(Kind::Page, &reply, Duration::ZERO, &station.rule, station.now);
    station.expect_send(&page());
    station.in_step.taken(Kind::Page, &reply, Duration::ZERO, &station.rule, station.now);
    assert_eq!(station.choose(&page()), empty_check());
}

#[test]
fn a_taken_reply_lapses_after_the_window_of_silence() {
    let mut station = TestStation::new();
    station.exchange(&run());
    station.now += WINDOW / 2;
    assert_eq!(station.in_step.last, Some(station.body));
    assert_eq!(station.in_step.stray(0x41, station.body, &station.rule, station.now), Stray::Duplicate);
    station.now += WINDOW - Duration::from_millis(1);
    assert_eq!(station.choose(&run()), empty_check(), "the line was not silent");
    let proofs = station.in_step.proof().proofs;
    station.now += Duration::from_millis(1);
    station.expect_send(&run());
    assert_eq!(station.in_step.proof().proofs, proofs, "a pause proves nothing to a job");
}

#[test]
fn a_slow_exchange_lapses_after_twice_its_time() {
    let mut station = TestStation::new();
    let reply = station.reply(run().shape(run().plain()), false);
    station.in_step.taken(Kind::Once, &reply, WINDOW, &station.rule, station.now);
    station.now += WINDOW * 2 - Duration::from_millis(1);
    assert_eq!(station.choose(&run()), empty_check());
    station.now += Duration::from_millis(1);
    station.expect_send(&run());
}

#[test]
fn a_line_without_copies_owes_nothing() {
    let mut station = TestStation::with(NETWORK, 0);
    station.exchange(&run());
    station.exchange(&run());
    assert_eq!(station.in_step.confirm(&station.rule, station.now), None);
}

#[test]
fn three_copies_keep_three_replies_owed() {
    let mut station = TestStation::with(NETWORK, 3);
    station.exchange(&run());
    station.exchange(&read(0, 1, false));
    assert!(station.check(Check::Nonce, false));
    assert_ne!(station.in_step.threat(run().shape(run().plain())), Threat::None, "the echo proves no roaming copy");
    station.exchange(&page());
    station.expect_send(&run());
}

#[test]
fn a_broadcast_is_owed_until_the_next_reply() {
    let mut station = TestStation::new();
    station.in_step.broadcast(Code::ControlPlc, station.now);
    assert_eq!(station.choose(&run()), empty_check());
    station.now += 2 * WINDOW;
    assert_eq!(station.choose(&run()), empty_check(), "what a broadcast owes does not lapse");
    station.exchange(&read(0, 1, false));
    station.expect_send(&run());
}

#[test]
fn strays_are_classified_and_unexpected_ones_are_doubts() {
    let mut station = TestStation::new();
    station.exchange(&run());
    let before = station.in_step.proof();
    assert_eq!(station.in_step.stray(0x41, station.body, &station.rule, station.now), Stray::Duplicate);
    assert!(!station.in_step.is_suspect());
    station.in_step.broadcast(Code::WriteRegisters, station.now);
    assert_eq!(station.stray(Code::WriteRegisters), Stray::Broadcast);
    assert!(station.in_step.is_suspect());
    station.in_step.timed_out(Code::ReadRegisters);
    assert_eq!(station.stray(Code::ReadRegisters), Stray::Late);
    assert_eq!(station.in_step.proof(), before);
    assert_eq!(station.stray(Code::ReadStatus), Stray::Unexpected);
    assert_eq!(station.in_step.proof().doubts, before.doubts + 1);
    assert!(station.check(Check::Nonce, false));
    assert_eq!(station.in_step.proof().proofs, before.proofs + 1);
    assert_eq!(station.stray(Code::ReadRegisters), Stray::Unexpected);
}

#[test]
fn a_refused_4e_of_a_suspect_station_needs_silence() {
    let mut station = TestStation::new();
    station.in_step.connected();
    assert_eq!(station.choose(&run()), Choice::Check(Check::Nonce, Why::Connected));
    assert!(!station.check(Check::Nonce, true));
    assert_eq!(station.choose(&run()), Choice::Silence(station.now + QUIET));
    station.now += QUIET / 2;
    station.stray(Code::ReadStatus);
    station.now += QUIET / 2;
    assert_eq!(station.choose(&run()), Choice::Silence(station.now + QUIET / 2), "a frame restarts the silence");
    station.now += QUIET / 2;
    station.expect_send(&run());
}

/// Before, the silence was not restarted, and the answer to the broadcast was taken for the reply
/// to the STOP after it.
#[test]
fn a_broadcast_restarts_the_silence() {
    let mut station = TestStation::new();
    station.in_step.connected();
    assert_eq!(station.choose(&run()), Choice::Check(Check::Nonce, Why::Connected));
    assert!(!station.check(Check::Nonce, true));
    let until = station.now + QUIET;
    assert_eq!(station.choose(&run()), Choice::Silence(until));
    station.now = until - QUIET / 100;
    station.in_step.broadcast(Code::ControlPlc, station.now);
    let restarted = station.now + QUIET;
    station.now = until;
    assert_eq!(station.choose(&run()), Choice::Silence(restarted));
    station.now = restarted;
    station.expect_send(&run());
}

/// Before, the silence before the status request that learns the echo of a line proved what came after its
/// reply: a RUN was sent at once, and a late reply could answer the next status request.
#[test]
fn a_reply_without_proof_restarts_the_silence() {
    let mut station = TestStation::new();
    station.in_step.connected();
    assert_eq!(station.choose(&run()), Choice::Check(Check::Nonce, Why::Connected));
    assert!(!station.check(Check::Nonce, true));
    let until = station.now + QUIET;
    assert_eq!(station.choose(&run()), Choice::Silence(until));
    station.now = until;
    let reply = station.reply(Check::STATUS, false);
    station.in_step.unproven(&reply, false, &station.rule, station.now);
    assert_eq!(station.choose(&run()), Choice::Silence(until + QUIET));
    station.now = until + QUIET;
    station.expect_send(&run());
}

#[test]
fn one_request_a_connection_replaces_checks_by_silence() {
    let mut station = TestStation::new();
    station.rule.one_request = true;
    station.in_step.connected();
    assert_eq!(station.choose(&run()), Choice::Silence(station.now + QUIET));
    station.now += QUIET;
    station.exchange(&run());
    let until = station.now + QUIET;
    assert_eq!(station.in_step.confirm(&station.rule, station.now), Some(Choice::Silence(until)));
    station.now = until;
    assert_eq!(station.in_step.confirm(&station.rule, station.now), None);
}

#[test]
fn owed_replies_are_confirmed_by_a_nonce() {
    let mut station = TestStation::new();
    station.exchange(&read(0, 1, false));
    let nonce = Choice::Check(Check::Nonce, Why::Confirm);
    assert_eq!(station.in_step.confirm(&station.rule, station.now), Some(nonce));
    station.in_step.timed_out(Code::LoopBack);
    let nonce = Choice::Check(Check::Nonce, Why::TimedOut);
    assert_eq!(station.in_step.confirm(&station.rule, station.now), Some(nonce));
    let mut other = TestStation::with(NETWORK, 0);
    other.exchange(&read(0, 1, false));
    assert_eq!(other.in_step.confirm(&other.rule, other.now), None, "the line never doubles a reply");
}

#[test]
fn a_fast_exchange_behind_slow_ones_has_their_window() {
    let mut station = TestStation::new();
    let slow = station.reply(run().shape(run().plain()), false);
    station.in_step.taken(Kind::Once, &slow, 4 * WINDOW, &station.rule, station.now);
    let fast = station.reply(run().shape(run().plain()), false);
    station.in_step.taken(Kind::Once, &fast, Duration::ZERO, &station.rule, station.now);
    station.now += 6 * WINDOW;
    assert_eq!(station.choose(&run()), empty_check(), "the fast reply may have been a duplicate");
    station.now += 2 * WINDOW;
    station.expect_send(&run());
}
