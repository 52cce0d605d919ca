//! The link against a scripted PLC: the test decides every byte of the replies.

use std::time::Duration;

use fatek::command::{InvalidRequest, ReadRegisters, WriteRegisters};
use fatek::wire::Framing;
use fatek::{Error, ErrorCode, Link, discrete, register, register32};
use tokio::io::{AsyncReadExt, duplex};
use tokio::time::{Instant, sleep, timeout};

mod peer;

use peer::{Peer, line, once, station};

#[tokio::test(start_paused = true)]
async fn a_read_is_one_request_and_one_reply() {
    let (link, mut peer) = line();
    let plc = tokio::spawn(async move {
        let request = peer.request().await;
        assert_eq!((request.station, request.command, &request.data[..]), (1, 0x46, &b"03R00012"[..]));
        peer.raw(b"\x020146010A57FC4000189\x03").await;
        peer
    });
    assert_eq!(station(&link).read_registers(register!("R12"), 3).await.unwrap(), [0x10A5, 0x7FC4, 1]);
    let mut peer = plc.await.unwrap();
    assert!(peer.hears_nothing().await);
}

#[tokio::test(start_paused = true)]
async fn invalid_arguments_are_errors_and_are_not_sent() {
    let (link, mut peer) = line();
    let station = station(&link);
    let reading = |first: &str, count| {
        let (station, first) = (station.clone(), first.parse().unwrap());
        async move { station.read_registers(first, count).await.unwrap_err().to_string() }
    };
    assert_eq!(
        reading("R0", 0).await,
        "invalid request: read registers (46h): 0 items were asked for, and it takes 1 to 65536"
    );
    assert_eq!(
        reading("R1", usize::MAX).await,
        format!("invalid request: {} elements from R1 on reach past the last address, R65535", usize::MAX)
    );
    assert_eq!(
        reading("R65530", 7).await,
        "invalid request: 7 elements from R65530 on reach past the last address, R65535"
    );
    let error = Error::from(ReadRegisters::new(register!("R0"), 65).unwrap_err());
    assert_eq!(
        error.to_string(),
        "invalid request: read registers (46h): 65 items were asked for, and it takes 1 to 64"
    );
    let error = Error::from(WriteRegisters::new(register32!("DR0"), [0; 33]).unwrap_err());
    assert!(error.to_string().contains("33 items were asked for, and it takes 1 to 32"), "{error}");
    assert!(!error.may_have_executed());
    assert!(station.write_registers32(register32!("DR65500"), &[0; 33]).await.is_err(), "past the end");
    assert!(station.write_discretes(discrete!("M0"), &[]).await.is_err());
    let error = station.loop_back("caf\u{e9}").await.unwrap_err();
    assert!(error.to_string().contains("the byte C3h at position 3 cannot be sent in the ASCII framing"), "{error}");
    assert_eq!(link.station(0).unwrap_err(), InvalidRequest::Station { station: 0 });
    assert!(link.station(255).unwrap_err().to_string().starts_with("255 is not a station"));
    assert!(peer.hears_nothing().await);
}

#[tokio::test(start_paused = true)]
async fn program_pages_are_invalid_in_the_binary_framing() {
    let (client, mut plc) = duplex(64);
    let link = Link::from_stream(client, Framing::Binary);
    let error = station(&link).read_program_page(0).await.unwrap_err();
    assert_eq!(error.to_string(), "invalid request: read program page (4Fh) does not exist in the binary framing");
    drop(link);
    assert_eq!(plc.read(&mut [0; 8]).await.unwrap(), 0);
}

#[tokio::test(start_paused = true)]
async fn a_refusal_is_a_typed_error() {
    let (link, mut peer) = line();
    let station = station(&link);
    let call = tokio::spawn(async move { station.write_registers(register!("R0"), &[1]).await });
    peer.request().await;
    peer.reply(1, 0x47, "A").await;
    let error = call.await.unwrap().unwrap_err();
    assert_eq!(error.error_code(), Some(ErrorCode::IllegalAddress));
    assert_eq!(error.to_string(), "station 1 refused write registers (47h): illegal address (A)");
    assert!(!error.may_have_executed());
}

#[tokio::test(start_paused = true)]
async fn only_an_exact_reply_is_taken_before_the_timeout() {
    let (link, mut peer) = line();
    let station = once(&station(&link));
    let began = Instant::now();
    let call = tokio::spawn(async move { station.read_registers(register!("R0"), 2).await });
    peer.request().await;
    peer.reply(2, 0x46, "000010002").await; // another station
    peer.reply(1, 0x44, "000010002").await; // another command
    peer.reply(1, 0x46, "00001").await; // too short
    peer.reply(1, 0x46, "0000100020003").await; // too long
    peer.reply(1, 0x46, "00001000G").await; // not hexadecimal
    peer.reply(1, 0x46, "A0001").await; // an error with data
    sleep(Duration::from_millis(500)).await;
    peer.reply(1, 0x46, "000030004").await; // the right reply, but after strays
    peer.echo().await;
    peer.request().await;
    peer.reply(1, 0x46, "000030004").await;
    assert_eq!(call.await.unwrap().unwrap(), [3, 4]);
    assert!(began.elapsed() < Duration::from_millis(600));
}

#[tokio::test(start_paused = true)]
async fn a_wrong_reply_is_a_bad_reply_and_silence_is_a_timeout() {
    let (link, mut peer) = line();
    let station = once(&station(&link));
    let call = {
        let station = station.clone();
        tokio::spawn(async move { station.read_registers(register!("R0"), 1).await })
    };
    peer.request().await;
    peer.reply(1, 0x46, "000010002").await;
    let error = call.await.unwrap().unwrap_err();
    assert!(matches!(error, Error::BadReply { station: 1, .. }), "{error:?}");
    assert!(error.to_string().ends_with("the data is too long"), "{error}");

    let call = tokio::spawn(async move { station.write_registers(register!("R0"), &[1]).await });
    peer.echo().await;
    peer.request().await;
    let error = call.await.unwrap().unwrap_err();
    assert!(matches!(error, Error::Timeout { station: 1, sent: true, .. }), "{error:?}");
    assert!(error.may_have_executed());
}

#[tokio::test(start_paused = true)]
async fn a_late_reply_is_not_given_to_the_next_read() {
    let (link, mut peer) = line();
    let station = once(&station(&link));
    let read = |first: &'static str| {
        let station = station.clone();
        tokio::spawn(async move { station.read_registers(first.parse().unwrap(), 1).await })
    };
    let first = read("R1");
    peer.request().await;
    assert!(matches!(first.await.unwrap(), Err(Error::Timeout { .. })));

    let second = read("R2");
    let check = peer.request().await;
    assert_eq!(check.command, 0x4E);
    peer.reply(1, 0x46, "01111").await; // R1, late: the PLC answers in order
    peer.reply(1, 0x4E, std::str::from_utf8(&check.data).unwrap()).await;
    assert_eq!(&peer.request().await.data[..], b"01R00002");
    peer.reply(1, 0x46, "02222").await;
    assert_eq!(second.await.unwrap().unwrap(), [0x2222]);
}

#[tokio::test(start_paused = true)]
async fn the_echo_of_an_old_nonce_passes_no_check() {
    let (link, mut peer) = line();
    let station = station(&link);
    let call = tokio::spawn(async move { station.read_registers(register!("R1"), 1).await });
    peer.request().await; // unanswered: the station is suspect
    let first = peer.request().await;
    assert_eq!(first.command, 0x4E); // unanswered too
    let second = peer.request().await;
    assert_eq!(second.command, 0x4E);
    assert_ne!(first.data, second.data, "a nonce is never used again");
    peer.reply(1, 0x4E, std::str::from_utf8(&first.data).unwrap()).await;
    assert!(timeout(Duration::from_millis(500), peer.request()).await.is_err());
    peer.reply(1, 0x4E, std::str::from_utf8(&second.data).unwrap()).await;
    assert_eq!(peer.request().await.command, 0x46);
    peer.reply(1, 0x46, "00007").await;
    assert_eq!(call.await.unwrap().unwrap(), [7]);
}

#[tokio::test(start_paused = true)]
async fn an_unsolicited_frame_makes_the_station_suspect() {
    let (link, mut peer) = line();
    let station = station(&link);
    for unsolicited in [false, true] {
        let station = station.clone();
        let call = tokio::spawn(async move { station.read_registers(register!("R1"), 1).await });
        if unsolicited {
            peer.echo().await;
        }
        peer.request().await;
        peer.reply(1, 0x46, "00001").await;
        assert_eq!(call.await.unwrap().unwrap(), [1]);
        peer.reply(1, 0x46, "00002").await; // not a copy of the last reply
        sleep(Duration::from_millis(1)).await;
    }
}

/// The echo of one character has the shape of a refusal, such as one of the check before it.
#[tokio::test(start_paused = true)]
async fn a_loop_back_of_one_character_is_sent_after_a_check() {
    let (client, plc) = duplex(4096);
    let link = Link::from_stream(client, Framing::Ascii);
    let mut peer = Peer::new(plc);
    let station = station(&link);
    let call = tokio::spawn(async move { station.loop_back("x").await });
    let mut before = 0;
    loop {
        let request = peer.any_request().await.unwrap();
        let data = String::from_utf8(request.data.to_vec()).unwrap();
        peer.reply(1, request.command, if request.command == 0x40 { "0000000" } else { &data }).await;
        if data == "x" {
            break;
        }
        before += 1;
        assert!(before <= 2, "{before} requests before it, the last one {:02X} {data}", request.command);
    }
    call.await.unwrap().unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_plc_without_loop_back_gets_a_quiet_time() {
    let (link, mut peer) = line();
    let station = once(&station(&link));
    let read = || {
        let station = station.clone();
        tokio::spawn(async move { station.read_registers(register!("R1"), 1).await })
    };
    let first = read();
    peer.request().await;
    assert!(first.await.unwrap().is_err());
    let second = read();
    assert_eq!(peer.request().await.command, 0x4E);
    peer.reply(1, 0x4E, "4").await;
    let began = Instant::now();
    assert_eq!(peer.request().await.command, 0x46);
    assert!(began.elapsed() >= Duration::from_secs(1), "{:?}", began.elapsed());
    peer.reply(1, 0x46, "00009").await;
    assert_eq!(second.await.unwrap().unwrap(), [9]);
}

#[tokio::test(start_paused = true)]
async fn reads_are_retried_and_writes_are_not() {
    let (link, mut peer) = line();
    let station = station(&link);
    let read = {
        let station = station.clone();
        tokio::spawn(async move { station.read_registers(register!("R1"), 1).await })
    };
    peer.request().await;
    peer.echo().await;
    assert_eq!(peer.request().await.command, 0x46);
    peer.reply(1, 0x46, "00001").await;
    assert_eq!(read.await.unwrap().unwrap(), [1]);

    let write = tokio::spawn(async move { station.write_registers(register!("R1"), &[5]).await });
    peer.request().await;
    assert!(write.await.unwrap().unwrap_err().may_have_executed());
    assert!(peer.hears_nothing().await);
}

#[tokio::test(start_paused = true)]
async fn a_corrupt_reply_is_retried_before_the_timeout() {
    let (link, mut peer) = line();
    let station = station(&link);
    let began = Instant::now();
    let read = tokio::spawn(async move { station.read_registers(register!("R1"), 1).await });
    peer.request().await;
    peer.raw(b"\x0201460000199\x03").await;
    peer.echo().await;
    peer.request().await;
    peer.reply(1, 0x46, "00001").await;
    assert_eq!(read.await.unwrap().unwrap(), [1]);
    assert!(began.elapsed() < Duration::from_millis(200), "{:?}", began.elapsed());
}

#[tokio::test(start_paused = true)]
async fn dropped_calls_are_cancel_safe() {
    let (link, mut peer) = line();
    let station = station(&link);
    let sent = {
        let station = station.clone();
        tokio::spawn(async move { station.read_registers(register!("R1"), 1).await })
    };
    peer.request().await;
    let queued = {
        let station = station.clone();
        tokio::spawn(async move { station.read_registers(register!("R2"), 1).await })
    };
    tokio::task::yield_now().await;
    let live = tokio::spawn(async move { station.read_registers(register!("R3"), 1).await });
    tokio::task::yield_now().await;
    sent.abort();
    queued.abort();
    peer.reply(1, 0x46, "01111").await;
    assert_eq!(&peer.request().await.data[..], b"01R00003", "R2 was not sent yet and is dropped");
    peer.reply(1, 0x46, "03333").await;
    assert_eq!(live.await.unwrap().unwrap(), [0x3333]);
}

#[tokio::test(start_paused = true)]
async fn a_broadcast_does_not_wait_for_a_reply() {
    let (link, mut peer) = line();
    let began = Instant::now();
    link.broadcast().write_registers(register!("R0"), &[7]).await.unwrap();
    link.broadcast().stop().await.unwrap();
    assert!(began.elapsed() < Duration::from_millis(1));
    assert_eq!((peer.request().await.station, peer.request().await.command), (0, 0x41));
}

#[tokio::test(start_paused = true)]
async fn a_silent_station_goes_offline_fails_fast_and_comes_back() {
    let (link, mut peer) = line();
    let station = station(&link);
    let call = {
        let station = station.clone();
        tokio::spawn(async move { station.read_status().await })
    };
    let mut commands = vec![peer.request().await.command];
    let error = call.await.unwrap().unwrap_err();
    assert!(matches!(error, Error::Timeout { sent: true, .. }), "{error:?}");
    let began = Instant::now();
    let error = station.read_status().await.unwrap_err();
    assert!(matches!(error, Error::Offline { station: 1, sent: false, .. }), "{error:?}");
    assert!(began.elapsed() < Duration::from_millis(1));
    while commands.len() < 4 {
        commands.push(peer.request().await.command);
    }
    assert_eq!(commands, [0x40, 0x4E, 0x4E, 0x4E], "one request, two checks, and then the probe");
    peer.echo().await;
    sleep(Duration::from_millis(1)).await;
    let call = tokio::spawn(async move { station.set(discrete!("Y0")).await });
    peer.request().await;
    peer.reply(1, 0x42, "0").await;
    call.await.unwrap().unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_write_is_not_sent_if_the_check_is_not_answered() {
    let (link, mut peer) = line();
    let error = station(&link).write_registers(register!("R0"), &[1]).await.unwrap_err();
    assert!(matches!(error, Error::Timeout { sent: false, .. }) && !error.may_have_executed(), "{error:?}");
    // The check is retried as a read is.
    for _ in 0..3 {
        assert_eq!(peer.any_request().await.unwrap().command, 0x4E);
    }
    assert!(peer.hears_nothing().await);
}

/// A duplicate is dropped and counted. No check follows, because the next request has another
/// spelling.
#[tokio::test(start_paused = true)]
async fn a_copy_of_a_reply_does_not_answer_the_next_request() {
    let (client, plc) = duplex(4096);
    let link = Link::from_stream(client, Framing::Ascii);
    let mut peer = Peer::new(plc);
    let plc = station(&link);
    let first = {
        let plc = plc.clone();
        tokio::spawn(async move { plc.read_registers(register!("R1"), 1).await })
    };
    let request = peer.request().await;
    assert_eq!(&request.data[..], b"01R00001");
    let second = tokio::spawn(async move { plc.read_registers(register!("R2"), 1).await });
    tokio::task::yield_now().await;
    // Over 1024 bytes of noise, so that one read of the client does not return both copies.
    peer.reply(1, 0x46, "01111").await;
    peer.raw(&[0; 1010]).await;
    peer.reply(1, 0x46, "01111").await;
    assert_eq!(first.await.unwrap().unwrap(), [0x1111]);
    let request = peer.request().await;
    assert_eq!((request.command, &request.data[..]), (0x48, &b"01R00002"[..]));
    peer.reply(1, 0x46, "01111").await;
    peer.reply(1, 0x48, "02222").await;
    assert_eq!(second.await.unwrap().unwrap(), [0x2222]);
    let stats = link.stats().stations;
    assert_eq!((stats.duplicates, stats.stray_frames, stats.checks), (2, 0, 1), "the check of a new connection");
}

#[tokio::test(start_paused = true)]
async fn a_stray_after_the_echo_causes_another_check() {
    let (link, mut peer) = line();
    let plc = once(&station(&link));
    let unanswered = {
        let plc = plc.clone();
        tokio::spawn(async move { plc.read_registers(register!("R1"), 1).await })
    };
    peer.request().await;
    assert!(unanswered.await.unwrap().is_err());
    let call = tokio::spawn(async move { plc.read_registers(register!("R2"), 1).await });
    let check = peer.request().await;
    let mut bytes = bytes::BytesMut::new();
    for (command, data) in [(0x4E, check.data.clone()), (0x46, "01111".into())] {
        peer.encode(1, command, data, &mut bytes);
    }
    peer.raw(&bytes).await;
    peer.echo().await;
    assert_eq!(&peer.request().await.data[..], b"01R00002");
    peer.reply(1, 0x46, "02222").await;
    assert_eq!(call.await.unwrap().unwrap(), [0x2222]);
}

#[tokio::test(start_paused = true)]
async fn noise_before_the_reply_does_not_fail_a_write() {
    let (link, mut peer) = line();
    let plc = station(&link);
    let call = tokio::spawn(async move { plc.write_registers(register!("R0"), &[1]).await });
    peer.request().await;
    peer.raw(b"\x02\x03\x06").await;
    sleep(Duration::from_millis(100)).await;
    peer.reply(1, 0x47, "0").await;
    call.await.unwrap().unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_check_is_tried_again_after_a_refused_one() {
    let (link, mut peer) = line();
    let plc = once(&station(&link));
    let read = |first: &'static str| {
        let plc = plc.clone();
        tokio::spawn(async move { plc.read_registers(first.parse().unwrap(), 1).await })
    };
    for refused in [true, false] {
        let unanswered = read("R1");
        peer.request().await;
        assert!(unanswered.await.unwrap().is_err());
        let call = read("R2");
        let check = peer.request().await;
        assert_eq!(check.command, 0x4E);
        let echo = std::str::from_utf8(&check.data).unwrap();
        peer.reply(1, 0x4E, if refused { "4" } else { echo }).await;
        assert_eq!(&peer.request().await.data[..], b"01R00002");
        peer.reply(1, 0x46, "02222").await;
        assert_eq!(call.await.unwrap().unwrap(), [0x2222]);
    }
}
