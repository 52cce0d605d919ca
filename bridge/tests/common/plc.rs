//! Simulated PLCs over TCP, for tests.

use std::net::SocketAddr;

use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;

/// A simulated PLC, as station 1 of a TCP port.
#[derive(Debug)]
pub struct SimPlc {
    /// The PLC.
    pub plc: Plc,
    address: SocketAddr,
    server: Option<Server>,
}

impl SimPlc {
    /// Starts a PLC whose tags move: `("R5:i16*0.1", "sine(20..80,10s)")`.
    pub async fn start(movements: &[(&str, &str)]) -> Self {
        let plc = Plc::new();
        for (tag, movement) in movements {
            plc.set_movement(tag.parse().unwrap(), movement.parse().unwrap()).unwrap();
        }
        let mut sim = Self { plc, address: SocketAddr::from(([127, 0, 0, 1], 0)), server: None };
        sim.resume().await;
        sim
    }

    /// The link of a configuration to it.
    pub fn link(&self) -> String {
        format!("tcp://{}", self.address)
    }

    /// Closes its port and all connections: it does not answer any more.
    pub async fn stop(&mut self) {
        if let Some(server) = self.server.take() {
            server.shutdown().await;
        }
    }

    /// Listens on its port again, with the memory it had.
    pub async fn resume(&mut self) {
        let bus = Bus::new().with_station(1, self.plc.clone()).unwrap();
        let server = Server::bind(self.address, bus, Framing::Ascii).await.unwrap();
        self.address = server.local_addr();
        self.server = Some(server);
    }
}
