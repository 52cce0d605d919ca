//! Polls a PLC over TCP and prints the values.
//!
//! ```text
//! cargo run --example poll --features sim                            # an embedded simulated PLC
//! cargo run --example poll --features sim -- tcp://192.168.2.3:500   # a real PLC, station 1 (reads only)
//! ```

use std::error::Error;
use std::time::Duration;

use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use fatek::{Endpoint, Link, Station, discrete, element, register, register32};

const POLLS: u32 = 5;

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    match std::env::args().nth(1) {
        Some(url) => poll(url.parse()?).await,
        None => {
            let plc = Plc::new();
            let server = Server::bind("127.0.0.1:0", Bus::new().with_station(1, plc.clone())?, Framing::Ascii).await?;
            println!("simulated PLC at {}", Endpoint::from(server.local_addr()));
            let machine = tokio::spawn(simulate(plc));
            let polled = poll(server.local_addr().into()).await;
            machine.abort();
            server.shutdown().await;
            polled
        }
    }
}

/// Reads some elements of station 1, [`POLLS`] times.
async fn poll(endpoint: Endpoint) -> Result<(), Box<dyn Error>> {
    let link = Link::builder(endpoint).response_timeout(Duration::from_millis(500)).build();
    let station = link.station(1)?;
    println!("status: {}", station.read_status().await?.flags());
    for round in 1..=POLLS {
        print(&station, round).await?;
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    link.close().await;
    Ok(())
}

async fn print(station: &Station, round: u32) -> Result<(), fatek::Error> {
    let levels = station.read_registers(register!("R0"), 3).await?;
    let counter = station.read_registers32(register32!("DR100"), 1).await?;
    let lamps = station.read_discretes(discrete!("Y0"), 4).await?;
    let mixed = station.read_mixed(&[element!("R0"), element!("Y0"), element!("DR100")]).await?;
    println!("{round}: R0..R2 = {levels:?}  DR100 = {counter:?}");
    println!("   Y0..Y3 = {lamps:?}");
    println!("   R0, Y0, DR100 in one scan = {mixed:?}");
    Ok(())
}

/// Simulates the machine behind the PLC.
async fn simulate(plc: Plc) -> Result<(), fatek::sim::Error> {
    plc.run();
    for tick in 0_u16.. {
        for offset in 0..3 {
            plc.write(register!("R0").nth(usize::from(offset)).unwrap_or(register!("R0")), 100 * offset + tick)?;
        }
        plc.write(register32!("DR100"), 1_000_000 + u32::from(tick))?;
        plc.write(discrete!("Y0"), tick % 2 == 0)?;
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    Ok(())
}
