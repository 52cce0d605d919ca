//! The gateway with real ports: clients over TCP, and a bus behind TCP or a serial port.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use fatek::sim::Server;
use fatek::wire::{Framing, Side};
use fatek::{Endpoint, ErrorCode, Link, LinkState, Station, register};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::bench::{UNRESTRICTED, bus, plc, word};
use crate::common::{FRAMINGS, framed};
use crate::proxy::Proxy;
use crate::server::{Limits, serve};

/// Longer than any step takes, even on a busy machine.
const LONG: Duration = Duration::from_secs(10);

/// A gateway on its own TCP port.
struct Gateway {
    address: SocketAddr,
    proxy: Arc<Proxy>,
    stop: oneshot::Sender<()>,
    serving: JoinHandle<()>,
}

impl Gateway {
    async fn new(link: Link, clients: usize) -> Self {
        Self::with_limits(link, Limits { clients, idle: LONG, make_room_after: LONG }).await
    }

    async fn with_limits(link: Link, limits: Limits) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let proxy = Arc::new(Proxy::new(link, UNRESTRICTED));
        let (stop, stopped) = oneshot::channel::<()>();
        let serving = tokio::spawn(serve(listener, Arc::clone(&proxy), limits, async move { drop(stopped.await) }));
        Self { address, proxy, stop, serving }
    }

    fn station(&self, framing: Framing, station: u8) -> Station {
        let endpoint = Endpoint::from(self.address).with_framing(framing);
        let link = Link::builder(endpoint).response_timeout(LONG).fail_fast(true).build();
        link.station(station).unwrap()
    }

    /// Stops the gateway, and returns its link.
    async fn stop(self) -> Link {
        drop(self.stop);
        timeout(LONG, self.serving).await.unwrap().unwrap();
        self.proxy.link().clone()
    }
}

#[tokio::test]
async fn clients_of_both_framings_share_a_bus_behind_a_module() {
    for of_the_bus in FRAMINGS {
        let plcs = [1, 2].map(plc);
        let module = Server::bind("127.0.0.1:0", bus(&plcs), of_the_bus).await.unwrap();
        let endpoint = Endpoint::from(module.local_addr()).with_framing(of_the_bus);
        let gateway = Gateway::new(Link::builder(endpoint).response_timeout(LONG).build(), 8).await;
        for (n, framing) in (0..).zip(FRAMINGS) {
            let station = gateway.station(framing, 2);
            station.write_registers(register!("R0"), &[7 + n]).await.unwrap();
            assert_eq!(plcs[1].read(register!("R0")), (7 + n).into());
            assert_eq!(station.read_registers(register!("D0"), 2).await.unwrap(), [word(2, 0), word(2, 1)]);
            plcs[1].refuse_run(Some(ErrorCode::Syntax));
            assert_eq!(station.run().await.unwrap_err().error_code(), Some(ErrorCode::Syntax));
        }
        gateway.stop().await;
        module.shutdown().await;
    }
}

#[tokio::test]
async fn a_client_over_the_limit_is_rejected_until_one_leaves() {
    let module = Server::bind("127.0.0.1:0", bus(&[plc(1)]), Framing::Ascii).await.unwrap();
    let gateway = Gateway::new(Link::builder(module.local_addr().into()).response_timeout(LONG).build(), 2).await;
    let clients = [gateway.station(Framing::Ascii, 1), gateway.station(Framing::Binary, 1)];
    for client in &clients {
        client.read_status().await.unwrap();
    }
    let mut third = TcpStream::connect(gateway.address).await.unwrap();
    assert_eq!(timeout(LONG, third.read(&mut [0])).await.unwrap().unwrap(), 0, "closed");
    for client in &clients {
        client.read_status().await.unwrap();
    }
    let [first, second] = clients;
    first.link().close().await;
    // The gateway notices the closed connection a little later.
    let comes_in = async {
        while gateway.station(Framing::Ascii, 1).read_status().await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    timeout(LONG, comes_in).await.unwrap();
    second.read_status().await.unwrap();
}

/// Before: a new client was disconnected until an idle one had left, after 60 s.
#[tokio::test]
async fn an_idle_client_makes_room_for_a_new_one() {
    let module = Server::bind("127.0.0.1:0", bus(&[plc(1)]), Framing::Ascii).await.unwrap();
    let link = Link::builder(module.local_addr().into()).response_timeout(LONG).build();
    let after = Duration::from_millis(300);
    let gateway = Gateway::with_limits(link, Limits { clients: 2, idle: LONG, make_room_after: after }).await;
    let mut idle = TcpStream::connect(gateway.address).await.unwrap();
    let active = gateway.station(Framing::Ascii, 1);
    active.read_status().await.unwrap();
    let mut early = TcpStream::connect(gateway.address).await.unwrap();
    assert_eq!(timeout(LONG, early.read(&mut [0])).await.unwrap().unwrap(), 0, "no client is idle yet");
    tokio::time::sleep(after).await;
    active.read_status().await.unwrap();

    let new = gateway.station(Framing::Binary, 1);
    new.read_status().await.unwrap();
    assert_eq!(timeout(LONG, idle.read(&mut [0])).await.unwrap().unwrap(), 0, "closed");
    let connections = active.link().stats().connects;
    active.read_status().await.unwrap();
    assert_eq!(active.link().stats().connects, connections, "the active client stays");
}

#[tokio::test]
async fn stopping_answers_the_request_in_flight_and_closes_all() {
    // A bus whose replies the test decides.
    let module = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let link = Link::builder(module.local_addr().unwrap().into()).response_timeout(LONG).build();
    let gateway = Gateway::new(link, 8).await;
    let station = gateway.station(Framing::Ascii, 1);
    let asking = tokio::spawn(async move { station.read_registers(register!("R0"), 1).await });
    let (mut line, _) = module.accept().await.unwrap();
    let mut request = [0; 16];
    // The check of the gateway's connection to the bus, and that of the client.
    for _ in 0..2 {
        line.read_exact(&mut request).await.unwrap();
        assert!(request.starts_with(b"\x02014E"), "{request:?}");
        line.write_all(&request).await.unwrap();
    }
    line.read_exact(&mut request).await.unwrap();
    assert!(request.starts_with(b"\x020146"), "{request:?}");
    let mut idle = TcpStream::connect(gateway.address).await.unwrap();

    let stopping = tokio::spawn(gateway.stop());
    assert_eq!(timeout(LONG, idle.read(&mut [0])).await.unwrap().unwrap(), 0, "this client has no request in flight");
    line.write_all(&framed(Framing::Ascii, Side::Plc, 1, 0x46, b"01234")).await.unwrap();
    assert_eq!(asking.await.unwrap().unwrap(), [0x1234]);
    let link = stopping.await.unwrap();
    assert!(matches!(link.state(), LinkState::Closed));
    assert_eq!(timeout(LONG, line.read(&mut [0])).await.unwrap().unwrap(), 0, "the connection to the bus is closed");
}

/// Linux only: macOS refuses a baud rate for pseudo-terminals.
#[cfg(all(target_os = "linux", feature = "serial"))]
#[tokio::test]
async fn clients_share_a_serial_line_that_echoes() {
    use std::fs::File;

    use fatek::sim::{self, Fault, Faults, Rule};
    use tokio_serial::{SerialPort as _, SerialStream};

    let (line, port) = SerialStream::pair().unwrap();
    let path = port.name().unwrap();
    // A pseudo-terminal needs both sides open.
    let _open = File::open(&path).unwrap();
    let plcs: Vec<_> = (1..=3).map(plc).collect();
    let faults = Faults::new(0).rule(Rule::new(Fault::Echo));
    let on_the_line = bus(&plcs).with_faults(faults.clone());
    let serving = tokio::spawn(async move { drop(sim::serve(line, on_the_line, Framing::Ascii).await) });

    let endpoint: Endpoint = format!("serial:{path}?baud=115200").parse().unwrap();
    let link = Link::builder(endpoint).response_timeout(LONG).build();
    let gateway = Gateway::new(link, 8).await;
    for (framing, number) in FRAMINGS.into_iter().flat_map(|framing| (1..=3).map(move |number| (framing, number))) {
        let station = gateway.station(framing, number);
        // The replies to these calls equal the requests, which the line echoes.
        station.run().await.unwrap();
        station.stop().await.unwrap();
        station.loop_back("ABCDEFG").await.unwrap();
        assert_eq!(station.read_registers(register!("D0"), 2).await.unwrap(), [word(number, 0), word(number, 1)]);
    }
    let link = gateway.stop().await;
    assert_eq!(link.stats().echoes, faults.log().arrivals());
    serving.abort();
}
