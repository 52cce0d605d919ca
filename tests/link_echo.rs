//! Lines that echo requests, and frames that must not be taken for replies there.

use std::time::Duration;

use bytes::BytesMut;
use fatek::wire::{Frame, Framing};
use fatek::{CallOptions, EchoMode, Error, Link, Register, Station, register};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::io::{DuplexStream, duplex, split};
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::time::sleep;

mod peer;

use peer::{Peer, once, station, without_duplicates};

/// Echo of the n-th request, counted from 1, if any.
type EchoFn = fn(u32, BytesMut) -> Option<BytesMut>;

fn faithful(_: u32, request: BytesMut) -> Option<BytesMut> {
    Some(request)
}

fn none(_: u32, _: BytesMut) -> Option<BytesMut> {
    None
}

/// Returns whether the PLC answers the n-th request, counted from 1, of this command.
type AnswersFn = fn(u32, u8) -> bool;

/// Creates a PLC on a line with this echo. The channel yields its requests. Checks are answered
/// only as `answers` decides.
fn on_line(mode: EchoMode, echo: EchoFn, answers: AnswersFn) -> (Station, UnboundedReceiver<String>) {
    let (client, plc) = duplex(4096);
    let (requests_sender, requests) = unbounded_channel();
    let mut peer = Peer::new(plc);
    tokio::spawn(async move {
        let mut number = 0;
        while let Some(request) = peer.any_request().await {
            number += 1;
            let data = String::from_utf8(request.data.to_vec()).unwrap();
            let _ = requests_sender.send(format!("{:02X}{data}", request.command));
            let mut bytes = BytesMut::new();
            peer.encode(request.station, request.command, request.data.clone(), &mut bytes);
            if let Some(echo) = echo(number, bytes) {
                peer.raw(&echo).await;
                sleep(Duration::from_millis(10)).await;
            }
            if answers(number, request.command) {
                answer(&mut peer, &request, &data).await;
            }
        }
    });
    // Requests have one spelling, so that they can be counted.
    let link = Link::stream_builder(client, Framing::Ascii).echo(mode).in_step(without_duplicates()).build();
    (station(&link), requests)
}

async fn answer(peer: &mut Peer, request: &Frame, data: &str) {
    match request.command {
        0x40 => peer.reply(1, 0x40, "0000000").await,
        0x41 => peer.reply(1, 0x41, "0").await,
        0x46 => peer.reply(1, 0x46, "00007").await,
        command => peer.reply(1, command, data).await,
    }
}

fn all(_: u32, _: u8) -> bool {
    true
}

fn drain(mut requests: UnboundedReceiver<String>) -> Vec<String> {
    std::iter::from_fn(|| requests.try_recv().ok()).collect()
}

#[tokio::test(start_paused = true)]
async fn an_echo_is_never_taken_for_the_reply() {
    let lines: [(EchoMode, EchoFn); 4] =
        [(EchoMode::Auto, faithful), (EchoMode::Auto, none), (EchoMode::On, faithful), (EchoMode::Off, none)];
    for (mode, echo) in lines {
        let (plc, requests) = on_line(mode, echo, all);
        plc.stop().await.unwrap();
        plc.loop_back("ABC").await.unwrap();
        assert_eq!(plc.read_registers(register!("R0"), 1).await.unwrap(), [7]);
        let mut requests = drain(requests);
        let check = requests.iter_mut().find(|request| request.starts_with("4E")).unwrap();
        assert_eq!(check.split_off(2).len(), 8, "a nonce");
        let expected = ["40", "4E", "410", "4EABC", "4601R00000"];
        let expected = if mode == EchoMode::Auto { &expected[..] } else { &expected[1..] };
        assert_eq!(requests, expected, "{mode:?}: learned once, with a status request");
        let echoes = if echo(1, BytesMut::new()).is_some() { requests.len() as u64 } else { 0 };
        assert_eq!(plc.link().stats().echoes, echoes, "{mode:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_dead_plc_on_an_echoing_line_times_out() {
    // Dead from the start, or after the check.
    let dead: [(EchoMode, AnswersFn, bool); 4] = [
        (EchoMode::Auto, |_, _| false, false),
        (EchoMode::On, |_, _| false, false),
        (EchoMode::Auto, |number, _| number <= 2, true),
        (EchoMode::On, |number, _| number <= 1, true),
    ];
    for (mode, answers, checked) in dead {
        let (plc, _requests) = on_line(mode, faithful, answers);
        let result = plc.stop().await;
        assert!(matches!(result, Err(Error::Timeout { sent, .. }) if sent == checked), "{mode:?}: {result:?}");
        let result = plc.loop_back("ABC").await;
        assert!(matches!(result, Err(Error::Timeout { .. } | Error::Offline { .. })), "{mode:?}: {result:?}");
        assert_eq!(plc.stats().replies, 0, "{mode:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_corrupt_echo_is_not_learned() {
    let corrupt_first: EchoFn = |number, mut request| {
        if number == 1 {
            request[3] ^= 1;
        }
        Some(request)
    };
    let truncate_first: EchoFn =
        |number, request| Some(if number == 1 { BytesMut::from(&request[1..]) } else { request });
    for echo in [corrupt_first, truncate_first] {
        // STOP and 4E get nothing but their own echo.
        let (plc, _requests) = on_line(EchoMode::Auto, echo, |_, command| [0x40, 0x46].contains(&command));
        let error = plc.stop().await.unwrap_err();
        assert!(matches!(error, Error::Timeout { .. }), "{error:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_line_that_begins_to_echo_is_detected_by_the_next_read() {
    let later: EchoFn = |number, request| (number > 3).then_some(request);
    for mode in [EchoMode::Auto, EchoMode::Off] {
        let (plc, _requests) = on_line(mode, later, |_, command| command != 0x41);
        for _ in 0..3 {
            assert_eq!(plc.read_registers(register!("R0"), 1).await.unwrap(), [7]);
        }
        let error = plc.stop().await.unwrap_err();
        assert!(matches!(error, Error::Timeout { sent: true, .. }), "{mode:?}: {error:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_line_that_stops_echoing_is_detected_by_the_next_check() {
    let at_first: EchoFn = |number, request| (number <= 4).then_some(request);
    let (plc, _requests) = on_line(EchoMode::Auto, at_first, all);
    assert_eq!(plc.read_registers(register!("R0"), 1).await.unwrap(), [7]);
    // The reply is taken for the echo once. Then the link learns that there is no echo.
    let result = plc.stop().await;
    assert!(result.is_ok(), "still echoed: {result:?}");
    assert!(plc.stop().await.unwrap_err().may_have_executed());
    let many_retries = plc.with_options(CallOptions::new().with_retries(5));
    assert_eq!(many_retries.read_registers(register!("R0"), 1).await.unwrap(), [7]);
    plc.stop().await.unwrap();
}

/// A PLC that answers in order, 1.5 s for the second request, behind an adapter that echoes.
async fn slow_once(plc: DuplexStream) {
    let (mut incoming, mut outgoing) = split(plc);
    let (jobs, mut queue) = unbounded_channel::<Vec<u8>>();
    let (bytes, mut to_send) = unbounded_channel::<Vec<u8>>();
    let replies = bytes.clone();
    tokio::spawn(async move {
        while let Some(bytes) = to_send.recv().await {
            outgoing.write_all(&bytes).await.unwrap();
        }
    });
    tokio::spawn(async move {
        let mut number = 0;
        while let Some(request) = queue.recv().await {
            number += 1;
            sleep(Duration::from_millis(if number == 2 { 1500 } else { 10 })).await;
            let body = std::str::from_utf8(&request[1..request.len() - 3]).unwrap();
            // Each register holds its own address in decimal digits.
            let reply = if &body[2..4] == "4E" { body.to_owned() } else { format!("{}0{}", &body[..4], &body[8..]) };
            let sum = reply.bytes().fold(2_u8, u8::wrapping_add);
            replies.send(format!("\x02{reply}{sum:02X}\x03").into_bytes()).unwrap();
        }
    });
    let mut buffer = [0; 256];
    while let Ok(len @ 1..) = incoming.read(&mut buffer).await {
        bytes.send(buffer[..len].to_vec()).unwrap();
        jobs.send(buffer[..len].to_vec()).unwrap();
    }
}

#[tokio::test(start_paused = true)]
async fn on_an_unexpected_echo_no_late_reply_reaches_another_read() {
    let (client, plc) = duplex(4096);
    tokio::spawn(slow_once(plc));
    let plc = once(&station(&Link::from_stream(client, Framing::Ascii)));
    let mut failures = 0;
    for address in [1111, 1111, 1111, 2222, 3333, 4444] {
        match plc.read_registers(Register::r(address), 1).await {
            Ok(values) => assert_eq!(format!("{:04X}", values[0]), address.to_string()),
            Err(_) => failures += 1,
        }
    }
    assert_eq!(failures, 1, "the one that took too long");
}
