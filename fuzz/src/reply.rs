//! Data of requests and replies.
//!
//! Invariants: a decoded request encodes to the same data, and to the same request in the other
//! framing; an accepted reply encodes to the same data.

use bytes::{Bytes, BytesMut};
use fatek::command::{Code, Command, ErrorField, InvalidRequest, ReplyError, Request, decode_reply, encode_reply};
use fatek::wire::{Frame, Framing};

use crate::input::{Flags, Input};
use crate::reference::frame_content;

const STATION: u8 = 1;

/// Bits of the first byte.
const BINARY: u8 = 0;
const ACCEPTED: u8 = 1;

/// Runs an input: flags, command, length of the request data, request data, reply data.
pub fn run(input: &[u8]) {
    let mut input = Input::new(input);
    let flags = Flags(input.byte());
    let framing = if flags.has(BINARY) { Framing::Binary } else { Framing::Ascii };
    let command = match input.byte() {
        any @ 0x80.. => any & 0x7F,
        index => u8::from(Code::ALL[usize::from(index) % Code::ALL.len()]),
    };
    let len = usize::from(input.byte()) << u8::from(flags.has(7));
    let data = Bytes::copy_from_slice(input.take(len));
    let mut reply = input.rest().to_vec();
    if flags.has(ACCEPTED) {
        // Without error, so that the data after the error code is read.
        reply.insert(0, if framing == Framing::Ascii { b'0' } else { 0 });
    }
    let frame = Frame { station: STATION, command, data };
    if let Ok(request) = Request::decode(&frame, framing) {
        check_request(&request, &frame, framing);
        accepts(&request, &reply, framing);
    }
}

fn check_request(request: &Request, frame: &Frame, framing: Framing) {
    assert_eq!(u8::from(request.code()), frame.command);
    for to in [framing, other(framing)] {
        let mut encoded = BytesMut::new();
        match request.encode(to, STATION, &mut encoded) {
            Ok(()) => {
                let again = frame_content(to, &encoded);
                assert_eq!(Request::decode(&again, to).as_ref(), Ok(request), "{frame:?} in {to}");
                assert!(to != framing || same(framing, &again.data, &frame.data), "{frame:?} is encoded as {again:?}");
            }
            Err(InvalidRequest::NotInFraming { .. }) => assert_ne!(to, framing),
            // An address of the binary framing.
            Err(InvalidRequest::Element(_)) => assert_eq!((framing, to), (Framing::Binary, Framing::Ascii)),
            // Data of an 8-bit line, or of the other framing.
            Err(InvalidRequest::NotPrintable { .. }) => {
                assert_eq!((to, request.code()), (Framing::Ascii, Code::LoopBack))
            }
            Err(InvalidRequest::Ambiguous { .. }) => assert_eq!((to, framing), (Framing::Binary, Framing::Ascii)),
            Err(error) => panic!("{frame:?}: {error}"),
        }
        assert!(encoded.len() <= 1024);
    }
}

/// Panics unless the client accepts the data as a reply or a refusal of this request.
pub(crate) fn is_a_reply(request: &Request, data: &[u8], framing: Framing) {
    assert!(accepts(request, data, framing), "{request:?} has the bad reply {data:?}");
}

/// Returns whether the client accepts the data as a reply or a refusal.
fn accepts(request: &Request, data: &[u8], framing: Framing) -> bool {
    macro_rules! each {
        ($($command:ident),*) => {
            match request {
                $(Request::$command(command) => check_reply(command, data, framing),)*
                other => panic!("request not covered by this target: {other:?}"),
            }
        };
    }
    each!(
        ReadStatus,
        ControlPlc,
        ControlDiscrete,
        ReadDisabled,
        ReadDiscretes,
        WriteDiscretes,
        ReadRegisters,
        ReadRegisters32,
        WriteRegisters,
        WriteRegisters32,
        ReadMixed,
        WriteMixed,
        LoopBack,
        ReadProgramPage,
        WriteProgramPage,
        ReadDetailedStatus
    )
}

fn check_reply<C: Command>(request: &C, data: &[u8], framing: Framing) -> bool {
    let reply = decode_reply(request, framing, data);
    let encoded = match &reply {
        Ok(reply) => Ok(reply),
        Err(ReplyError::Plc(error)) => Err(*error),
        Err(ReplyError::Mismatch(_)) => return false,
        Err(error) => panic!("{error}"),
    };
    let mut frame = BytesMut::new();
    encode_reply(request, encoded, framing, STATION, &mut frame);
    let again = frame_content(framing, &frame);
    // Of a program page (4F) there are two forms; the one with the digit is what is sent.
    let digit_missing = C::CODE.error_field() == ErrorField::ByLength && again.data.len() == data.len() + 1;
    let sent = if digit_missing { &again.data[1..] } else { &again.data[..] };
    assert!(same(framing, sent, data), "{request:?}: {reply:?} of {data:?}");
    match (decode_reply(request, framing, &again.data), reply) {
        (Ok(again), Ok(reply)) => assert_eq!(again, reply),
        (Err(ReplyError::Plc(again)), Err(ReplyError::Plc(error))) => assert_eq!(again, error),
        // `d` refuses a loop-back of `D`; encoded in upper case, it is the echo. The protocol is
        // ambiguous here.
        (Ok(_), Err(ReplyError::Plc(_))) if C::CODE.error_field() == ErrorField::Absent && data.len() == 1 => {}
        (again, _) => panic!("{request:?}: {again:?}"),
    }
    true
}

/// Returns whether the bytes are equal; in ASCII without regard to case.
fn same(framing: Framing, one: &[u8], other: &[u8]) -> bool {
    if framing == Framing::Ascii { one.eq_ignore_ascii_case(other) } else { one == other }
}

fn other(framing: Framing) -> Framing {
    if framing == Framing::Ascii { Framing::Binary } else { Framing::Ascii }
}
