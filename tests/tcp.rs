//! The link over TCP: connecting, lost connections, reconnecting.
#![cfg(feature = "sim")]

use std::time::{Duration, Instant};

use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use fatek::{CallOptions, Endpoint, Error, Link, LinkState, register};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;

async fn serve(address: &str, plc: &Plc, framing: Framing) -> Server {
    Server::bind(address, Bus::new().with_station(1, plc.clone()).unwrap(), framing).await.unwrap()
}

#[tokio::test]
async fn the_next_call_reopens_a_lost_connection() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let plc = Plc::new();
        let server = serve("127.0.0.1:0", &plc, framing).await;
        let address = server.local_addr();
        let link = Link::new(Endpoint::from(address).with_framing(framing));
        assert!(matches!(link.state(), LinkState::Idle));
        let station = link.station(1).unwrap();
        station.write_registers(register!("R0"), &[5]).await.unwrap();
        assert!(matches!(link.state(), LinkState::Up));

        let mut state = link.watch_state();
        state.mark_unchanged();
        server.shutdown().await;
        state.changed().await.unwrap();
        assert!(matches!(link.state(), LinkState::Down { .. }), "an idle link notices the loss");

        let _server = serve(&address.to_string(), &plc, framing).await;
        assert_eq!(station.read_registers(register!("R0"), 1).await.unwrap(), [5]);
    }
}

#[tokio::test]
async fn a_closed_port_is_a_connect_error() {
    let free = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let fail_fast = Link::builder(free.into()).fail_fast(true).build();
    let began = Instant::now();
    let error = fail_fast.station(1).unwrap().read_status().await.unwrap_err();
    assert!(matches!(error, Error::Connect { .. }), "{error:?}");
    assert!(error.to_string().starts_with(&format!("cannot connect to tcp://{free}: ")), "{error}");
    assert!(!error.may_have_executed());
    assert!(began.elapsed() < Duration::from_secs(5));

    let short_deadline = Link::builder(free.into()).call_timeout(Duration::from_millis(300)).build();
    let error = short_deadline.station(1).unwrap().read_status().await.unwrap_err();
    assert!(matches!(error, Error::Connect { .. }), "{error:?}");
}

#[tokio::test]
async fn a_call_waits_for_a_server_that_starts_in_time() {
    let address = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let link = Link::new(address.into());
    let station = link.station(1).unwrap();
    let mut state = link.watch_state();
    let call = tokio::spawn(async move { station.read_registers(register!("R0"), 1).await });
    while !matches!(*state.borrow_and_update(), LinkState::Down { .. }) {
        state.changed().await.unwrap();
    }
    let plc = Plc::new();
    let _server = serve(&address.to_string(), &plc, Framing::Ascii).await;
    assert_eq!(call.await.unwrap().unwrap(), [0]);
}

/// Length of the first check of a connection, and of its echo.
const CHECK_LEN: usize = 16;

#[tokio::test]
async fn a_connection_closed_without_reply_fails_a_write_at_once() {
    for checked in [true, false] {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let link = Link::new(listener.local_addr().unwrap().into());
        // With retries, a check that was not answered is repeated over another connection.
        let station = link.station(1).unwrap().with_options(CallOptions::new().with_retries(0));
        let call = tokio::spawn(async move { station.write_registers(register!("R0"), &[1]).await });
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut check = [0; CHECK_LEN];
        stream.read_exact(&mut check).await.unwrap();
        if checked {
            stream.write_all(&check).await.unwrap();
            assert_ne!(stream.read(&mut [0; 64]).await.unwrap(), 0);
        }
        drop(stream);
        let error = call.await.unwrap().unwrap_err();
        assert!(matches!(error, Error::Disconnected { sent, .. } if sent == checked), "{error:?}");
        assert_eq!(error.may_have_executed(), checked);
    }
}

#[tokio::test]
async fn dropping_the_last_handle_closes_the_connection() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let link = Link::new(listener.local_addr().unwrap().into());
    let station =
        link.station(1).unwrap().with_options(CallOptions::new().with_call_timeout(Duration::from_millis(50)));
    drop(link);
    let call = tokio::spawn(async move { station.loop_back("xy").await });
    let (mut stream, _) = listener.accept().await.unwrap();
    let mut check = [0; CHECK_LEN];
    stream.read_exact(&mut check).await.unwrap();
    stream.write_all(&check).await.unwrap();
    let mut received = Vec::new();
    stream.read_to_end(&mut received).await.unwrap();
    assert!(call.await.unwrap().is_err());
    assert_eq!(received, b"\x02014ExyCD\x03");
}

#[tokio::test]
async fn an_endpoint_opens_as_a_stream_of_bytes() {
    let server = serve("127.0.0.1:0", &Plc::new(), Framing::Ascii).await;
    let mut stream = server.endpoint().open().await.unwrap();
    // Half of a request, and the rest.
    for part in [&b"\x02014"[..], b"601R0001273\x03"] {
        stream.write_all(part).await.unwrap();
    }
    let mut reply = [0; 13];
    stream.read_exact(&mut reply).await.unwrap();
    assert_eq!(&reply, b"\x02014600000BD\x03");
    server.shutdown().await;
    assert_eq!(stream.read(&mut reply).await.unwrap(), 0, "the end of the connection is the end of the stream");
    let refused = Endpoint::tcp("127.0.0.1", 1).open().await.unwrap_err();
    assert_eq!(refused.kind(), std::io::ErrorKind::ConnectionRefused);
}
