//! Forwarded requests of a gateway: in either framing, requests and replies equal those of typed
//! calls. Other rules of calls hold, too.

mod common;

use std::future::Future;
use std::time::Duration;

use bytes::BytesMut;
use common::{AnyExchange, FRAMINGS, for_every_command, frame_content, framed};
use fatek::command::*;
use fatek::wire::{Framing, Side};
use fatek::{Error, ErrorCode, Link, Register, discrete, register};
use proptest::prelude::*;
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::runtime::Builder;
use tokio::time::timeout;

#[test]
fn forwarded_frames_equal_those_of_typed_calls() {
    for_every_command(16, |framing, exchange| {
        let Ok(request) = exchange.encode_request(framing, 7) else {
            return Ok(()); // an ambiguous list
        };
        let reply = exchange.encode_reply(framing, 7, None);
        let (answer, received) = paused(forward(framing, &exchange, reply.clone()));
        prop_assert_eq!(received, request);
        let answer = answer.unwrap();
        for other in FRAMINGS {
            let mut forwarded = BytesMut::new();
            answer.encode(other, 7, &mut forwarded);
            prop_assert_eq!(&forwarded, &exchange.encode_reply(other, 7, None), "{}", other);
            prop_assert_eq!(answer.to_frame(other, 7), exchange.reply_frame(other, 7, None), "{}", other);
        }
        Ok(())
    });
}

#[test]
fn a_forwarded_refusal_keeps_its_code() {
    for_every_command(2, |framing, exchange| {
        // A loop-back of one digit may equal a refusal.
        if exchange.encode_request(framing, 7).is_err() || exchange.code() == Code::LoopBack {
            return Ok(());
        }
        let refusal = exchange.encode_reply(framing, 7, Some(ErrorCode::IllegalAddress));
        let (answer, _) = paused(forward(framing, &exchange, refusal.clone()));
        let error = answer.unwrap_err();
        prop_assert_eq!(error.error_code(), Some(ErrorCode::IllegalAddress));
        let mut forwarded = BytesMut::new();
        encode_refusal(exchange.code().into(), ErrorCode::IllegalAddress, framing, 7, &mut forwarded);
        prop_assert_eq!(forwarded, refusal);
        Ok(())
    });
}

#[tokio::test(start_paused = true)]
async fn a_reply_to_another_request_is_not_forwarded() {
    let (link, mut line) = line(Framing::Ascii);
    let forwarding = tokio::spawn(async move {
        let request = Request::ReadRegisters(ReadRegisters::new(register!("R0"), 3).unwrap());
        link.station(1).unwrap().forward(request).await
    });
    echo(&mut line, Framing::Ascii).await;
    let first = receive(&mut line).await;
    // The last reply matches, but after strays it may belong to another request. It is requested
    // again after a check.
    for data in [&b"0AAAABBBB"[..], b"0AAAABBBBCCCCDDDD", b"0AAAABBBBCCCC"] {
        line.write_all(&framed(Framing::Ascii, Side::Plc, 1, 0x46, data)).await.unwrap();
    }
    echo(&mut line, Framing::Ascii).await;
    assert_eq!(receive(&mut line).await, first);
    line.write_all(&framed(Framing::Ascii, Side::Plc, 1, 0x46, b"0000100020003")).await.unwrap();
    let answer = forwarding.await.unwrap().unwrap();
    let shown = format!("{answer:?}");
    assert!(shown.contains("request: ReadRegisters") && shown.contains("reply: [1, 2, 3]"), "{shown}");
    let mut forwarded = BytesMut::new();
    answer.encode(Framing::Ascii, 1, &mut forwarded);
    assert_eq!(forwarded, framed(Framing::Ascii, Side::Plc, 1, 0x46, b"0000100020003"));
}

#[tokio::test(start_paused = true)]
async fn a_forwarded_read_is_retried_and_a_write_is_not() {
    let read = Request::ReadRegisters(ReadRegisters::new(register!("R0"), 1).unwrap());
    let write = Request::WriteRegisters(WriteRegisters::new(register!("R0"), [7]).unwrap());
    for (request, times) in [(read, 3), (write, 1)] {
        let (link, mut line) = line(Framing::Ascii);
        let code = u8::from(request.code());
        let station = link.station(1).unwrap();
        let forwarding = tokio::spawn(async move { station.forward(request).await });
        let mut received = 0;
        while let Ok(frame) = timeout(Duration::from_secs(30), receive(&mut line)).await {
            let frame = frame_content(Framing::Ascii, &frame);
            if frame.command == 0x4E {
                // The check before each retry is answered, so the station stays online.
                let echo = framed(Framing::Ascii, Side::Plc, 1, 0x4E, &frame.data);
                line.write_all(&echo).await.unwrap();
            }
            received += u32::from(frame.command == code);
        }
        let error = forwarding.await.unwrap().unwrap_err();
        assert!(matches!(error, Error::Timeout { sent: true, .. }), "{error:?}");
        assert_eq!(received, times, "{code:02X}");
    }
}

#[tokio::test(start_paused = true)]
async fn only_writes_and_control_are_broadcast() {
    let words = [1, 2];
    for (request, is_sent) in [
        (Request::ControlPlc(ControlPlc::Stop), true),
        (Request::ControlDiscrete(ControlDiscrete::new(DiscreteControl::Set, discrete!("Y0"))), true),
        (Request::WriteDiscretes(WriteDiscretes::new(discrete!("Y0"), [true]).unwrap()), true),
        (Request::WriteRegisters(WriteRegisters::new(register!("R0"), words).unwrap()), true),
        (Request::WriteRegisters32(WriteRegisters::new(fatek::register32!("DR0"), [3]).unwrap()), true),
        (Request::WriteMixed(WriteMixed::new([(Register::r(0).into(), 1_u16.into())]).unwrap()), true),
        (Request::WriteProgramPage(WriteProgramPage::new(1, ProgramPage::new([1; 64]))), true),
        (Request::ReadStatus(ReadStatus), false),
        (Request::LoopBack(LoopBack::new("x").unwrap()), false),
        (Request::ReadRegisters(ReadRegisters::new(register!("R0"), 1).unwrap()), false),
    ] {
        let code = request.code();
        assert_eq!(code.class() != Class::Read, is_sent, "{code}");
        let mut expected = BytesMut::new();
        request.encode(Framing::Ascii, 0, &mut expected).unwrap();
        let (link, mut line) = line(Framing::Ascii);
        let result = link.broadcast().forward(request).await;
        if is_sent {
            result.unwrap();
            assert_eq!(receive(&mut line).await, expected, "{code}");
        } else {
            assert!(matches!(result, Err(Error::Invalid(InvalidRequest::NoBroadcast { .. }))), "{result:?}");
            assert_eq!(link.stats().broadcasts, 0);
        }
    }
}

fn line(framing: Framing) -> (Link, DuplexStream) {
    let (client, plc) = duplex(4096);
    (Link::from_stream(client, framing), plc)
}

/// Forwards a request to station 7, which sends this reply. Returns the result, and the request as
/// received.
async fn forward(
    framing: Framing,
    exchange: &AnyExchange,
    reply: BytesMut,
) -> (Result<ForwardedReply, Error>, BytesMut) {
    let (link, mut line) = line(framing);
    let station = link.station(7).unwrap();
    let plc = async move {
        echo(&mut line, framing).await;
        let mut received = receive(&mut line).await;
        if exchange.code() == Code::LoopBack && frame_content(framing, &received).command == 0x40 {
            // The echo of one character has the shape of a refusal of the check, so a read of the
            // status is sent between.
            let mut status = BytesMut::new();
            encode_reply(&ReadStatus, Ok(&BriefStatus::from_raw([1, 0, 0])), framing, 7, &mut status);
            line.write_all(&status).await.unwrap();
            received = receive(&mut line).await;
        }
        line.write_all(&reply).await.unwrap();
        received
    };
    tokio::join!(station.forward(exchange.request()), plc)
}

/// Receives the bytes that are available.
async fn receive(line: &mut DuplexStream) -> BytesMut {
    let mut received = BytesMut::with_capacity(1024);
    assert_ne!(line.read_buf(&mut received).await.unwrap(), 0, "the link has closed the connection");
    received
}

/// Answers the next request, which must be a check, with its echo.
async fn echo(line: &mut DuplexStream, framing: Framing) {
    let check = frame_content(framing, &receive(line).await);
    assert_eq!((check.command, check.data.len()), (0x4E, 8), "a check");
    line.write_all(&framed(framing, Side::Plc, check.station, 0x4E, &check.data)).await.unwrap();
}

fn paused<T>(test: impl Future<Output = T>) -> T {
    Builder::new_current_thread().enable_all().start_paused(true).build().unwrap().block_on(test)
}
