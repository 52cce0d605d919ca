//! Frames made from commands: the codecs encode them to the bytes of `encode_request` and
//! `encode_reply`, and they decode to the same requests and replies. Texts of all of them.

mod common;

use bytes::BytesMut;
use common::{FRAMINGS, for_every_command, frame_content};
use fatek::ErrorCode;
use fatek::command::*;
use fatek::wire::{Codec, EncodeError, FieldError, Frame, Framing, Side};
use proptest::prelude::*;
use tokio_util::codec::Encoder;

const CASES: u32 = 64;

/// The codec encodes a request frame to the bytes of `encode_request`.
#[test]
fn a_request_frame_has_the_bytes_of_encode_request() {
    for_every_command(CASES, |framing, exchange| {
        let frame = exchange.request_frame(framing, 7);
        prop_assert_eq!(&exchange.request().to_frame(framing, 7), &frame, "typed and any request");
        let bytes = exchange.encode_request(framing, 7);
        match (frame, bytes) {
            (Ok(frame), Ok(bytes)) => {
                prop_assert_eq!(encoded(framing, Side::Client, &frame), bytes);
                prop_assert_eq!(Request::decode(&frame, framing), Ok(exchange.request()));
            }
            (frame, bytes) => prop_assert_eq!(frame.unwrap_err(), bytes.unwrap_err()),
        }
        Ok(())
    });
}

/// The codec encodes a reply frame to the bytes of `encode_reply`, of a refusal as well.
#[test]
fn a_reply_frame_has_the_bytes_of_encode_reply() {
    for_every_command(CASES, |framing, exchange| {
        for refusal in [None, Some(ErrorCode::IllegalAddress), Some(ErrorCode::Unknown(0xFF))] {
            let frame = exchange.reply_frame(framing, 254, refusal);
            let bytes = exchange.encode_reply(framing, 254, refusal);
            prop_assert_eq!(encoded(framing, Side::Plc, &frame), &bytes);
            prop_assert_eq!(&frame, &frame_content(framing, &bytes));
            if let Some(error) = refusal {
                prop_assert_eq!(&Frame::refusal(254, exchange.code().into(), error, framing), &frame);
            } else {
                prop_assert_eq!(exchange.decode_reply_frame(framing, &frame), Ok(true));
            }
            // As any request, it decodes to a reply with the same frame, and to the same refusal.
            match (exchange.request().decode_reply(&frame, framing), refusal) {
                (Ok(reply), None) => prop_assert_eq!(&reply.to_frame(framing, 254), &frame),
                // The ASCII framing has one digit of the code.
                (Err(ReplyError::Plc(_)), Some(_)) => {}
                (reply, refusal) => prop_assert!(false, "{:?} of {:?}", reply, refusal),
            }
            let code = u8::from(exchange.code()) ^ 1;
            let other = exchange.decode_reply_frame(framing, &Frame { command: code, ..frame });
            prop_assert_eq!(other, Err(ReplyError::Mismatch(FieldError::OtherCommand(code))));
        }
        Ok(())
    });
}

#[test]
fn a_reply_frame_decodes_as_its_data() {
    let read = ReadRegisters::new(fatek::register!("R0"), 1).unwrap();
    for (data, result) in [
        ("00007", Ok(vec![7])),
        ("A", Err(ReplyError::Plc(ErrorCode::IllegalAddress))),
        ("0000", Err(ReplyError::Mismatch(FieldError::Truncated))),
    ] {
        let frame = Frame { station: 1, command: 0x46, data: data.into() };
        assert_eq!(frame.decode_reply(&read, Framing::Ascii), result);
    }
    let other = Frame { station: 1, command: 0x44, data: "00007".into() };
    let error = other.decode_reply(&read, Framing::Ascii).unwrap_err();
    assert_eq!(error.to_string(), "not a reply to this request: the frame is one of command 44h");
}

#[test]
fn no_frame_is_made_of_a_request_that_cannot_be_sent() {
    let read = ReadProgramPage::new(0);
    let error = InvalidRequest::NotInFraming { code: Code::ReadProgramPage, framing: Framing::Binary };
    assert_eq!(Frame::request(1, &read, Framing::Binary), Err(error));
    for framing in FRAMINGS {
        assert_eq!(Frame::request(255, &ReadStatus, framing), Err(InvalidRequest::Station { station: 255 }));
        assert!(Frame::request(0, &ControlPlc::Stop, framing).is_ok(), "a broadcast");
    }
    let unprintable = LoopBack::new("\n").unwrap();
    let not_printable = InvalidRequest::NotPrintable { code: Code::LoopBack, byte: b'\n', position: 0 };
    assert_eq!(Frame::request(1, &unprintable, Framing::Ascii), Err(not_printable));
    // A reply is not checked, and the codec refuses it.
    let reply = Frame::reply(1, &unprintable, Ok(&()), Framing::Ascii);
    let result = Codec::new(Framing::Ascii, Side::Plc).encode(&reply, &mut BytesMut::new());
    assert!(matches!(result, Err(EncodeError::NotPrintable { byte: b'\n', position: 0 })), "{result:?}");
}

#[test]
fn every_text_is_short_and_printable() {
    for_every_command(CASES, |framing, exchange| {
        let [request, reply] = exchange.texts();
        prop_assert_eq!(&exchange.request().to_string(), &request);
        prop_assert!(request.starts_with(&exchange.code().to_string()), "{}", request);
        let reply_frame = exchange.reply_frame(framing, 255, None).to_string();
        let request_frame = exchange.request_frame(framing, 254).map_or(String::new(), |frame| frame.to_string());
        let forwarded = format!("{request}: {reply}");
        for (text, limit) in [(request, 600), (forwarded, 800), (reply_frame, 280), (request_frame, 280)] {
            prop_assert!(text.len() <= limit, "{} bytes: {}", text.len(), text);
            prop_assert!(text.bytes().all(|byte| (0x20..=0x7E).contains(&byte)), "{:?}", text);
        }
        Ok(())
    });
}

fn encoded(framing: Framing, sender: Side, frame: &Frame) -> BytesMut {
    let mut bytes = BytesMut::new();
    Codec::new(framing, sender).encode(frame, &mut bytes).unwrap();
    bytes
}
