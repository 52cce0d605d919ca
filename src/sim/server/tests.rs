use tokio::net::{TcpStream, UdpSocket};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::*;
use crate::command::Value;
use crate::register;
use crate::sim::{Change, Line, Plc};

mod faults;
mod left_overs;
mod udp;

const RUN: &[u8] = b"\x0201411F9\x03";
const DONE: &[u8] = b"\x0201410F8\x03";
const STOP_BINARY: &[u8] = b"\x51\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA";
const DONE_BINARY: &[u8] = b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA";

#[tokio::test]
async fn a_stream_is_served_until_its_end() {
    let plc = Plc::new();
    let (mut client, serving) = start(&plc, Framing::Ascii);
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    assert!(plc.is_running());
    drop(client);
    serving.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_plc_is_served_over_tcp_until_its_server_is_dropped() {
    let plc = Plc::new();
    let server = plc.serve("127.0.0.1:0").await.unwrap();
    assert_eq!(server.endpoint().to_string(), format!("tcp://{}", server.local_addr()));
    let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    assert!(plc.is_running());
    let log = server.faults().unwrap().log();
    assert_eq!((log.changes(1), log.arrivals()), (vec![Change::Run], 1));
    drop(server);
    assert_eq!(client.read(&mut [0]).await.unwrap(), 0, "the connection is closed");
}

#[tokio::test]
async fn the_endpoint_of_a_server_is_one_for_clients() {
    for (address, host) in [("0.0.0.0:0", "127.0.0.1"), ("[::]:0", "[::1]"), ("127.0.0.1:0", "127.0.0.1")] {
        // A machine may have no IPv6.
        let Ok(server) = Server::bind(address, Bus::new(), Framing::Binary).await else { continue };
        let port = server.local_addr().port();
        assert_eq!(server.endpoint().to_string(), format!("tcp://{host}:{port}?framing=binary"));
        assert!(server.faults().is_none());
    }
}

#[tokio::test]
async fn pipelined_requests_are_answered_in_order() {
    let plc = Plc::new();
    let (mut client, _serving) = start(&plc, Framing::Ascii);
    send(&mut client, b"\x02014701R0000012343B\x03\x02014601R0000070\x03").await;
    expect(&mut client, b"\x0201470FE\x03\x02014601234C7\x03").await;
    assert_eq!(plc.read(register!("R0")), Value::Word(0x1234));
}

#[tokio::test]
async fn a_request_that_comes_byte_by_byte_is_answered_once() {
    let plc = Plc::new();
    plc.run();
    let (mut client, serving) = start(&plc, Framing::Binary);
    for &byte in STOP_BINARY {
        send(&mut client, &[byte]).await;
        tokio::task::yield_now().await;
    }
    expect(&mut client, DONE_BINARY).await;
    assert!(!plc.is_running());
    assert_ends(client, serving).await;
}

#[tokio::test(start_paused = true)]
async fn an_incomplete_frame_does_not_hide_the_next() {
    // The header announces 256 bytes; 3 of them follow.
    let beginning = b"\x51\x10\x01\x00\x01\x47\x02";
    let (mut client, serving) = start(&Plc::new(), Framing::Binary);
    send(&mut client, beginning).await;
    time::sleep(2 * FRAME_TIMEOUT).await;
    send(&mut client, STOP_BINARY).await;
    expect(&mut client, DONE_BINARY).await;
    // The same without a pause: the next frame looks like the rest.
    send(&mut client, beginning).await;
    send(&mut client, STOP_BINARY).await;
    expect(&mut client, DONE_BINARY).await;
    assert_ends(client, serving).await;
}

#[tokio::test(start_paused = true)]
async fn an_incomplete_frame_is_discarded_after_the_timeout() {
    let plc = Plc::new();
    let (mut client, serving) = start(&plc, Framing::Ascii);
    send(&mut client, &RUN[..4]).await;
    time::sleep(2 * FRAME_TIMEOUT).await;
    send(&mut client, &RUN[4..]).await;
    assert_ends(client, serving).await;
    assert!(!plc.is_running());
}

#[tokio::test]
async fn endless_garbage_is_discarded() {
    let (mut client, serving) = start(&Plc::new(), Framing::Ascii);
    for _ in 0..100 {
        send(&mut client, &[b'7'; 1000]).await;
        send(&mut client, b"\x02").await;
    }
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    assert_ends(client, serving).await;
}

#[tokio::test]
async fn a_server_answers_several_connections_over_tcp() {
    let plc = Plc::new();
    let server = bind_tcp(&plc).await;
    let mut clients = Vec::new();
    for _ in 0..8 {
        clients.push(TcpStream::connect(server.local_addr()).await.unwrap());
    }
    for client in &mut clients {
        plc.stop();
        send(client, RUN).await;
        expect(client, DONE).await;
        assert!(plc.is_running());
    }
    server.shutdown().await;
}

#[tokio::test]
async fn connections_above_the_limit_wait() {
    let server = bind_tcp(&Plc::new()).await;
    let mut clients = Vec::new();
    for _ in 0..MAX_CONNECTIONS {
        let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
        send(&mut client, RUN).await;
        expect(&mut client, DONE).await;
        clients.push(client);
    }
    let mut next = TcpStream::connect(server.local_addr()).await.unwrap();
    send(&mut next, RUN).await;
    let waiting = time::timeout(FRAME_TIMEOUT, next.read_u8()).await;
    assert!(waiting.is_err(), "{waiting:?}");
    drop(clients.pop());
    expect(&mut next, DONE).await;
}

/// Before: a new connection waited for ever behind 64 idle ones.
#[tokio::test]
async fn the_connection_idle_longest_makes_room() {
    let server = bind_tcp(&Plc::new()).await;
    server.make_room_after(Duration::from_millis(200));
    let mut clients = Vec::new();
    for _ in 0..MAX_CONNECTIONS {
        clients.push(TcpStream::connect(server.local_addr()).await.unwrap());
    }
    // The others are in use.
    let mut idle = clients.remove(3);
    for client in &mut clients {
        send(client, RUN).await;
        expect(client, DONE).await;
    }
    let mut next = TcpStream::connect(server.local_addr()).await.unwrap();
    send(&mut next, RUN).await;
    expect(&mut next, DONE).await;
    assert_eq!(idle.read(&mut [0]).await.unwrap(), 0, "closed");
    for client in &mut clients {
        send(client, RUN).await;
        expect(client, DONE).await;
    }
}

/// Before: the connection was closed before the reply, which a fault delays by 300 ms.
#[tokio::test]
async fn shutdown_answers_requests_that_have_arrived() {
    let slow = Line::new(0).response_time(Duration::from_millis(300), Duration::from_millis(300));
    let bus = bus(&Plc::new()).with_faults(Faults::new(0).line(slow));
    let server = Server::bind("127.0.0.1:0", bus.clone(), Framing::Ascii).await.unwrap();
    let udp_server = UdpServer::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
    send(&mut client, RUN).await;
    let udp_client = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    udp_client.send_to(RUN, udp_server.local_addr()).await.unwrap();
    time::sleep(Duration::from_millis(50)).await;

    let begun = Instant::now();
    tokio::join!(server.shutdown(), udp_server.shutdown());
    assert!(begun.elapsed() < SHUTDOWN_TIMEOUT, "{:?}", begun.elapsed());
    expect(&mut client, DONE).await;
    assert_eq!(client.read(&mut [0]).await.unwrap(), 0);
    let mut reply = [0; 64];
    let len = time::timeout(FRAME_TIMEOUT, udp_client.recv(&mut reply)).await.expect("a reply").unwrap();
    assert_eq!(&reply[..len], DONE);
}

#[tokio::test]
async fn shutdown_closes_connections_and_port() {
    let server = bind_tcp(&Plc::new()).await;
    let address = server.local_addr();
    let mut client = TcpStream::connect(address).await.unwrap();
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    server.shutdown().await;
    assert_eq!(client.read(&mut [0]).await.unwrap(), 0);
    assert!(TcpStream::connect(address).await.is_err());
    // The port is free again.
    Server::bind(address, Bus::new(), Framing::Ascii).await.unwrap().shutdown().await;
}

#[tokio::test]
async fn dropping_the_server_closes_its_connections() {
    let server = bind_tcp(&Plc::new()).await;
    let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    drop(server);
    assert_eq!(client.read(&mut [0]).await.unwrap(), 0);
}

fn start(plc: &Plc, framing: Framing) -> (DuplexStream, JoinHandle<io::Result<()>>) {
    let (client, line) = duplex(64);
    (client, tokio::spawn(serve(line, bus(plc), framing)))
}

async fn bind_tcp(plc: &Plc) -> Server {
    Server::bind("127.0.0.1:0", bus(plc), Framing::Ascii).await.unwrap()
}

fn bus(plc: &Plc) -> Bus {
    Bus::new().with_station(1, plc.clone()).unwrap()
}

async fn send(client: &mut (impl AsyncWrite + Unpin), bytes: &[u8]) {
    client.write_all(bytes).await.unwrap();
}

async fn expect(client: &mut (impl AsyncRead + Unpin), bytes: &[u8]) {
    let mut reply = vec![0; bytes.len()];
    client.read_exact(&mut reply).await.unwrap();
    assert_eq!(reply.escape_ascii().to_string(), bytes.escape_ascii().to_string());
}

/// Checks that no more replies come before the end of the stream.
async fn assert_ends(mut client: DuplexStream, serving: JoinHandle<io::Result<()>>) {
    client.shutdown().await.unwrap();
    let mut rest = Vec::new();
    client.read_to_end(&mut rest).await.unwrap();
    assert!(rest.is_empty(), "{}", rest.escape_ascii());
    serving.await.unwrap().unwrap();
}
