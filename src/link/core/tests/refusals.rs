//! Requests whose spelling the device refuses, and replies without proof.

use super::test_link::{TIMEOUT, TestLink, read, result};
use crate::command::{Code, ReadRegisters, WriteRegisters};
use crate::element::Register;
use crate::error::Error;
use crate::link::call::CallFuture;
use crate::link::core::Action;
use crate::wire::Framing;

fn write(value: u16) -> WriteRegisters<Register> {
    WriteRegisters::new(Register::r(0), [value]).unwrap()
}

/// A second write of one register, in its other spelling (49), which the device refuses.
fn refused_write(link: &mut TestLink, code: &[u8]) -> CallFuture<WriteRegisters<Register>> {
    let mut first = link.call(1, write(1));
    assert_eq!(link.expect_send(), Code::WriteRegisters);
    link.receive_frame(1, 0x47, b"0");
    assert!(result(&mut first).unwrap().is_ok());
    let mut second = link.call(1, write(2));
    assert_eq!(link.expect_send(), Code::WriteMixed);
    link.receive_frame(1, 0x49, code);
    assert!(result(&mut second).is_none(), "only the spelling is refused");
    second
}

#[test]
fn a_write_refused_in_another_spelling_is_sent_plain_behind_a_check() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut second = refused_write(&mut link, b"4");
    assert_eq!(link.expect_send(), Code::LoopBack, "the refusal may be that of another request");
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::WriteRegisters);
    link.receive_frame(1, 0x47, b"0");
    assert!(result(&mut second).unwrap().is_ok());
}

/// The refusal belonged to another request: the true reply comes during the check.
#[test]
fn a_write_whose_other_spelling_was_perhaps_executed_is_not_sent_again() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut second = refused_write(&mut link, b"4");
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_frame(1, 0x49, b"0");
    link.receive_echo();
    for _ in 0..3 {
        let action = link.next_action();
        if result_is_out_of_step(&mut second) {
            assert!(matches!(action, Action::Wait(_)), "nothing is sent for it");
            return;
        }
        // The stray asks for another check.
        assert_eq!(link.expect_send(), Code::LoopBack);
        link.receive_echo();
    }
    panic!("the write is neither sent nor failed");
}

fn result_is_out_of_step(call: &mut CallFuture<WriteRegisters<Register>>) -> bool {
    match result(call) {
        None => false,
        Some(Err(Error::OutOfStep { sent: true, .. })) => true,
        Some(other) => panic!("{other:?}"),
    }
}

/// A refusal of the elements says nothing about the command: it is tried again.
#[test]
fn a_spelling_is_given_up_only_if_its_command_is_refused() {
    for (code, next) in
        [(&b"4"[..], Code::LoopBack), (b"9", Code::LoopBack), (b"A", Code::ReadMixed), (b"2", Code::ReadMixed)]
    {
        let mut link = TestLink::new(Framing::Ascii);
        let mut calls = Vec::new();
        for sent in [Code::ReadRegisters, Code::ReadMixed] {
            calls.push(link.call(1, read(1)));
            assert_eq!(link.expect_send(), sent);
            if sent == Code::ReadMixed {
                link.receive_frame(1, 0x48, code);
                assert_eq!(link.expect_send(), Code::ReadRegisters);
            }
            link.receive_frame(1, 0x46, b"00001");
        }
        calls.push(link.call(1, read(1)));
        assert_eq!(link.expect_send(), next, "after the refusal {code:?}");
    }
}

/// One element more than asked for is read only if the PLC has answered it before.
#[test]
fn elements_of_a_refused_read_are_not_read_unasked() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut ask = |first: u16, count: usize, reply: &[u8]| {
        let call = link.call(1, ReadRegisters::new(Register::r(first), count).unwrap());
        let mut sent = link.expect_send();
        if sent == Code::ReadMixed {
            link.receive_frame(1, 0x48, b"4");
            sent = link.expect_send();
        }
        let bytes = link.sent.clone();
        match sent {
            Code::LoopBack => link.receive_echo(),
            _ => link.receive_frame(1, 0x46, reply),
        }
        drop(call);
        (sent, bytes[5..7].to_vec())
    };
    ask(0, 1, b"00001");
    ask(0, 1, b"00001");
    // The device lacks 48 from here on.
    assert_eq!(ask(10, 2, b"000010002"), (Code::ReadRegisters, b"02".to_vec()));
    assert_eq!(ask(10, 1, b"00001"), (Code::ReadRegisters, b"01".to_vec()));
    assert_eq!(ask(10, 1, b"000010002"), (Code::ReadRegisters, b"02".to_vec()), "R11 was answered before");
    assert_eq!(ask(20, 3, b"A"), (Code::ReadRegisters, b"03".to_vec()));
    assert_eq!(ask(20, 1, b"").0, Code::LoopBack, "a duplicate of the refusal may come");
    assert_eq!(ask(20, 1, b"00001"), (Code::ReadRegisters, b"01".to_vec()));
    assert_eq!(ask(20, 1, b"").0, Code::LoopBack, "R21 was refused");
}

/// A duplicate may have answered the read: it is asked once more, and then given up.
#[test]
fn a_reply_without_proof_is_asked_for_once_more() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call_with(1, read(1), crate::CallOptions::new().with_retries(0));
    link.expect_send();
    for last in [false, true] {
        // A stray of the station during the exchange, and then a reply that fits.
        link.receive_frame(1, 0x40, b"0000000");
        link.receive_frame(1, 0x46, b"00001");
        if last {
            break;
        }
        assert!(result(&mut call).is_none());
        assert_eq!(link.expect_send(), Code::LoopBack);
        link.receive_echo();
        assert_eq!(link.expect_send(), Code::ReadRegisters);
    }
    assert!(matches!(result(&mut call), Some(Err(Error::OutOfStep { sent: true, .. }))));
    assert_eq!(link.station_stats(1).unproven_replies, 2);
}

#[test]
fn nothing_is_asked_again_for_a_caller_that_has_gone_or_a_link_that_closes() {
    for closing in [false, true] {
        let mut link = TestLink::new(Framing::Ascii);
        let call = link.call(1, read(1));
        link.expect_send();
        if closing {
            link.core.close();
        } else {
            drop(call);
        }
        link.receive_frame(1, 0x40, b"0000000");
        link.receive_frame(1, 0x46, b"00001");
        let action = link.next_action();
        assert!(matches!(action, Action::Wait(_)), "closing: {closing}: {action:?}");
    }
}

/// Counted only for the loop-back: other checks are refused for other reasons.
#[test]
fn refused_checks_are_counted() {
    let mut link = TestLink::new(Framing::Ascii);
    link.core.connected(link.now);
    let _call = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_frame(1, 0x4E, b"4");
    assert_eq!(link.station_stats(1).refused_checks, 1);
    assert!(matches!(link.next_action(), Action::Wait(Some(_))));
    link.advance(TIMEOUT * 2);
    assert_eq!(link.expect_send(), Code::ReadRegisters, "silence has replaced the check");
    link.receive_frame(1, 0x46, b"00001");
    assert_eq!(link.station_stats(1).refused_checks, 1);
}
