//! Run control against a model of a PLC: a line that loses and refuses requests, another client that
//! starts and stops the PLC, and futures dropped at any step. `FATEK_SEEDS=n` runs n seeds,
//! `FATEK_SEED=n` one.

use std::ops::Range;
use std::time::Duration;

use super::*;
use crate::command::{BriefStatus, Code};
use crate::random::Random;

fn status(running: bool) -> Result<Reply, Error> {
    Ok(Reply::Status(BriefStatus::from_raw([running.into(), 0, 0])))
}

fn timeout(sent: bool) -> Error {
    Error::timeout(1, Code::ControlPlc, Duration::ZERO, sent)
}

fn refusal() -> Error {
    Error::Plc { station: 1, code: Code::ControlPlc, error: ErrorCode::IllegalFormat, repeated: false }
}

/// Handles a status and confirms it.
fn seen(control: &mut RunControl, running: bool) -> Option<RunEvent> {
    assert_eq!(control.next(), Some(Request::Status));
    assert!(control.handle(status(running)).is_none());
    assert!(control.must_confirm());
    control.confirmed(Ok(()))
}

/// Handles the result of STOP or RUN.
fn sent(control: &mut RunControl, command: &Request, result: Result<Reply, Error>) -> Option<RunEvent> {
    assert_eq!(control.next().as_ref(), Some(command));
    control.handle(result)
}

#[test]
fn a_stop_without_a_reply_is_decided_by_the_status() {
    let mut control = RunControl::new(3);
    control.saw(true);
    control.stop();
    assert_eq!((control.plc(), control.was_stopped()), (PlcState::Unknown, true));
    assert!(sent(&mut control, &Request::Stop, Err(timeout(true))).is_none());
    assert!(seen(&mut control, true).is_none());
    assert!(!control.was_stopped(), "it did not obey");
    assert_eq!(control.next(), Some(Request::Pause));
    assert!(control.handle(Ok(Reply::Done)).is_none());
    assert!(sent(&mut control, &Request::Stop, Ok(Reply::Done)).is_none());
    assert!(matches!(seen(&mut control, false), Some(RunEvent::Obeyed)));
    assert_eq!((control.plc(), control.next(), control.is_run_due()), (PlcState::Stopped, None, true));
    // A start by another client does not undo this.
    control.look();
    assert!(matches!(seen(&mut control, true), Some(RunEvent::Seen(true))));
    assert!(control.was_stopped() && !control.is_run_due());
    control.begin(true);
    assert!(!control.was_stopped());
}

#[test]
fn a_stop_is_sent_as_often_as_attempts_say() {
    for attempts in 1..=3 {
        let mut control = RunControl::new(attempts);
        control.stop();
        for left in (0..attempts).rev() {
            assert!(sent(&mut control, &Request::Stop, Err(refusal())).is_none());
            let event = seen(&mut control, true);
            if left > 0 {
                assert!(event.is_none());
                assert!(control.handle(Ok(Reply::Done)).is_none(), "a pause");
                continue;
            }
            let Some(RunEvent::Failed(RunFailure { cause, command_error })) = event else { panic!("{event:?}") };
            assert!(matches!(cause, RunCause::NotObeyed(RunCommand::Stop)), "{cause:?}");
            assert!(matches!(command_error, Some((RunCommand::Stop, Error::Plc { .. }))), "{command_error:?}");
        }
        assert!(!control.was_stopped() && control.plc() == PlcState::Running);
    }
}

#[test]
fn only_a_refusal_ends_run_without_a_status() {
    for (error, ends) in [(refusal(), true), (timeout(false), false), (timeout(true), false)] {
        let mut control = RunControl::new(2);
        control.saw(false);
        control.run();
        let event = sent(&mut control, &Request::Run, Err(error.clone()));
        assert_eq!(event.is_some(), ends, "{error}");
        let known = if error.may_have_executed() { PlcState::Unknown } else { PlcState::Stopped };
        assert_eq!(control.plc(), known, "{error}");
        if !ends {
            assert!(matches!(seen(&mut control, true), Some(RunEvent::Obeyed)));
        }
    }
}

#[test]
fn an_unconfirmed_status_is_read_again_or_fails() {
    let mut control = RunControl::new(1);
    control.saw(false);
    control.look();
    assert!(control.handle(status(true)).is_none());
    assert_eq!(control.plc(), PlcState::Stopped, "it is not used before");
    control.rewind();
    assert!(!control.must_confirm() && control.next() == Some(Request::Status));
    assert!(control.handle(status(true)).is_none());
    let event = control.confirmed(Err(timeout(true)));
    let Some(RunEvent::Failed(RunFailure { cause: RunCause::NotConfirmed(_), .. })) = event else {
        panic!("{event:?}")
    };
    assert_eq!((control.plc(), control.next()), (PlcState::Unknown, None));
}

#[test]
fn securing_never_fails_and_keeps_whether_run_is_due() {
    // No status: the state is not known.
    let mut control = RunControl::new(2);
    control.saw(false);
    control.secure(false);
    assert!(matches!(control.handle(Err(timeout(true))), Some(RunEvent::Secured)));
    assert_eq!(control.plc(), PlcState::Unknown);
    // Stopped already.
    control.secure(false);
    assert!(matches!(seen(&mut control, false), Some(RunEvent::Secured)));
    // It runs, and does not obey: all attempts are made.
    control.secure(false);
    assert!(seen(&mut control, true).is_none());
    assert!(sent(&mut control, &Request::Stop, Err(refusal())).is_none());
    assert!(seen(&mut control, true).is_none());
    assert!(control.handle(Ok(Reply::Done)).is_none());
    assert!(sent(&mut control, &Request::Stop, Ok(Reply::Done)).is_none());
    assert!(matches!(seen(&mut control, true), Some(RunEvent::Secured)));
    assert_eq!((control.plc(), control.was_stopped()), (PlcState::Running, false));
    // It is known to run: STOP comes first.
    control.secure(true);
    assert!(sent(&mut control, &Request::Stop, Ok(Reply::Done)).is_none());
    assert!(matches!(control.handle(Err(timeout(true))), Some(RunEvent::Secured)));
    assert_eq!((control.plc(), control.was_stopped()), (PlcState::Unknown, false));
}

#[test]
fn a_halt_sends_stop_only_if_the_plc_runs() {
    let mut control = RunControl::new(1);
    control.halt();
    assert!(matches!(seen(&mut control, false), Some(RunEvent::Seen(false))));
    assert!(!control.was_stopped());
    control.halt();
    assert!(seen(&mut control, true).is_none());
    assert_eq!((control.plc(), control.was_stopped()), (PlcState::Unknown, true));
    assert!(sent(&mut control, &Request::Stop, Ok(Reply::Done)).is_none());
    assert!(matches!(seen(&mut control, false), Some(RunEvent::Obeyed)));
    assert!(control.is_run_due());
    // The next look stops nothing.
    control.look();
    assert!(matches!(seen(&mut control, true), Some(RunEvent::Seen(true))));
}

#[test]
fn a_plc_left_to_others_is_not_due_until_it_is_stopped_again() {
    let mut control = RunControl::new(1);
    control.stop();
    assert!(sent(&mut control, &Request::Stop, Ok(Reply::Done)).is_none());
    assert!(matches!(seen(&mut control, false), Some(RunEvent::Obeyed)));
    control.leave_to_others();
    control.begin(false);
    control.look();
    assert!(matches!(seen(&mut control, false), Some(RunEvent::Seen(false))));
    assert!(control.was_stopped() && !control.is_run_due());
    control.stop();
    assert!(sent(&mut control, &Request::Stop, Ok(Reply::Done)).is_none());
    assert!(matches!(seen(&mut control, false), Some(RunEvent::Obeyed)));
    assert!(control.is_run_due());
}

fn seeds(count: u64) -> Range<u64> {
    let number = |name| std::env::var(name).ok().and_then(|number| number.parse().ok());
    match number("FATEK_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FATEK_SEEDS").unwrap_or(count),
    }
}

/// Runs operations in random order against a PLC. Returns how many ended with an event.
fn model(seed: u64) -> usize {
    let mut random = Random::new(seed);
    let mut chance = |of: u64| random.next().is_multiple_of(of);
    let attempts = 1 + u32::from(chance(2)) + u32::from(chance(2));
    let mut control = RunControl::new(attempts);
    let (mut running, mut others) = (chance(2), false);
    // The last status that was confirmed, since STOP or RUN may have taken effect.
    let mut known = None;
    let mut ended = 0;
    for _ in 0..20 {
        let (mut sends, mut dropped) = (0, false);
        let operation = if chance(5) { 4 } else { (u8::from(chance(2)) << 1) + u8::from(chance(2)) };
        match operation {
            0 => control.look(),
            1 => control.stop(),
            2 => control.run(),
            3 => control.secure(known == Some(true)),
            _ => control.halt(),
        }
        let event = loop {
            let Some(request) = control.next() else { panic!("seed {seed}: idle without an event") };
            if control.must_confirm() {
                // `None`: a duplicate.
                match (chance(10), chance(10)) {
                    (true, _) => control.rewind(),
                    (false, fails) => {
                        let status = control.unconfirmed;
                        known = if fails { None } else { status };
                        let result = if fails { Err(timeout(true)) } else { Ok(()) };
                        if let Some(event) = control.confirmed(result) {
                            break Some(event);
                        }
                    }
                }
                continue;
            }
            if chance(30) {
                (running, others) = (!running, true);
            }
            let (arrives, replies, refuses) = (!chance(8), !chance(8), chance(8));
            let executes = arrives && !refuses;
            let result = match request {
                Request::Status => status(running),
                Request::Stop | Request::Run => {
                    sends += 1;
                    if executes {
                        running = request == Request::Run;
                    }
                    Ok(Reply::Done)
                }
                Request::Pause => Ok(Reply::Done),
                request => panic!("seed {seed}: {request:?}"),
            };
            // The future is dropped with the request on its way.
            if chance(40) {
                dropped = true;
                break None;
            }
            let result = match (request == Request::Pause, arrives, refuses, replies) {
                (true, ..) | (false, true, false, true) => result,
                (false, true, true, true) => Err(refusal()),
                (false, false, ..) => Err(timeout(chance(2))),
                (false, true, _, false) => Err(timeout(true)),
            };
            if matches!(request, Request::Stop | Request::Run)
                && result.as_ref().err().is_none_or(Error::may_have_executed)
            {
                known = None;
            }
            if let Some(event) = control.handle(result) {
                break Some(event);
            }
        };
        assert!(sends <= attempts, "seed {seed}: {sends} of {attempts}");
        if dropped {
            // As in a transfer: the next run begins.
            assert!(
                !matches!(control.next(), Some(Request::Stop | Request::Run)) || control.plc() == PlcState::Unknown
            );
            control.begin(false);
            known = None;
        }
        match control.plc() {
            PlcState::Running => assert!(known == Some(true), "seed {seed}: {control:?}"),
            PlcState::Stopped => assert!(known == Some(false), "seed {seed}: {control:?}"),
            PlcState::Unknown => {}
        }
        if !others && known.is_some() {
            assert_eq!(known, Some(running), "seed {seed}");
        }
        match (operation, &event) {
            (1 | 4, Some(RunEvent::Obeyed)) | (4, Some(RunEvent::Seen(false))) => {
                assert_eq!(known, Some(false), "seed {seed}")
            }
            (2, Some(RunEvent::Obeyed)) => assert_eq!(known, Some(true), "seed {seed}"),
            (0, Some(RunEvent::Seen(seen))) => assert_eq!(known, Some(*seen), "seed {seed}"),
            (0..=2 | 4, Some(RunEvent::Failed(_))) | (3, Some(RunEvent::Secured)) | (_, None) => {}
            (operation, event) => panic!("seed {seed}: {event:?} of {operation}"),
        }
        ended += usize::from(event.is_some());
    }
    ended
}

#[test]
fn every_operation_ends_with_a_state_that_is_true() {
    let ended: usize = seeds(4000).map(model).sum();
    assert!(ended > 10_000 || seeds(4000).count() < 4000, "{ended}");
}
