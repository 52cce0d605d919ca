//! Many TCP clients in front of one FATEK bus.
//!
//! The clients speak the FATEK protocol, in ASCII or in binary, as they would to an Ethernet module; their first byte tells
//! which. The gateway gives their requests to one [`Link`], so that one is on the bus at a time, in a fair order, and a
//! station that does not answer costs the others little. [`proxy`] says what becomes of each request, [`server`] what a
//! client may do.
//!
//! ```text
//! cargo run --example serial_gateway --features cli                               # a simulated bus, to try it
//! cargo run --example serial_gateway --features cli -- "serial:/dev/ttyUSB0?baud=19200" --listen 0.0.0.0:500
//! cargo run --example serial_gateway --features cli -- tcp://192.168.2.3:500 --read-only --stations 1-8
//! ```
//!
//! and then, for instance, `fatek --link tcp://127.0.0.1:5000 --station 3 read R0-R9`. `RUST_LOG=debug` logs every request.
//!
//! There are no passwords in the protocol, and none here: whoever reaches the port can write, unless it is `--read-only`.

mod proxy;
mod server;

use std::error::Error;
use std::future::Future;
use std::io::IsTerminal;
use std::num::{NonZeroU32, NonZeroUsize};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser;
use fatek::sim::{self, Bus, Faults, Line, Plc};
use fatek::wire::Framing;
use fatek::{Endpoint, Link, LinkBuilder, register};
use tokio::net::TcpListener;
use tokio::time::{MissedTickBehavior, interval};
use tracing_subscriber::EnvFilter;

use crate::proxy::{Proxy, Rules};
use crate::server::Limits;

/// Many TCP clients in front of one FATEK bus.
#[derive(Parser)]
struct Args {
    /// The bus: serial:/dev/ttyUSB0?baud=19200&frame=7E1, tcp://HOST:500 or udp://HOST:500, each with ?framing=ascii or
    /// binary. Without it: eight simulated PLCs at 9600 baud.
    bus: Option<Endpoint>,
    /// Where clients connect.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:5000")]
    listen: String,
    /// Answer writes, RUN, STOP and forcing with an error, and keep them and all broadcasts from the bus.
    #[arg(long)]
    read_only: bool,
    /// The stations that are served; broadcasts are if 0 is among them.
    #[arg(long, value_name = "FIRST-LAST", default_value = "0-254", value_parser = stations)]
    stations: RangeInclusive<u8>,
    /// How many clients there may be at a time.
    #[arg(long, value_name = "COUNT", default_value = "64")]
    max_clients: NonZeroUsize,
    /// After how long without a request a client is sent away.
    #[arg(long, value_name = "SECONDS", default_value = "60")]
    idle: NonZeroU32,
    /// How long a request may take, its turn included, before it is left unanswered. Make it less than the clients' own
    /// timeouts: an answer that comes later looks to them like the one to their next request.
    #[arg(long, value_name = "MILLISECONDS", default_value = "2000")]
    patience: NonZeroU32,
}

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let args = Args::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    log.with_ansi(std::io::stderr().is_terminal()).init();

    let (builder, process) = match &args.bus {
        Some(endpoint) => (Link::builder(endpoint.clone()), None),
        None => {
            let (builder, process) = simulated_bus()?;
            (builder, Some(tokio::spawn(process)))
        }
    };
    let link = builder
        .call_timeout(Duration::from_millis(args.patience.get().into()))
        // A client has one request under way.
        .queue_capacity(args.max_clients.get())
        .build();
    let listener = TcpListener::bind(&args.listen).await?;
    let bus = args.bus.as_ref().map_or("simulated".to_owned(), ToString::to_string);
    let rules = Rules { stations: args.stations, read_only: args.read_only };
    tracing::info!(%bus, clients = %listener.local_addr()?, ?rules, "Ctrl-C stops");

    let proxy = Arc::new(Proxy::new(link, rules));
    let reports = tokio::spawn(report(Arc::clone(&proxy)));
    let limits = Limits { clients: args.max_clients.get(), idle: Duration::from_secs(args.idle.get().into()) };
    server::serve(listener, Arc::clone(&proxy), limits, interrupted()).await;
    reports.abort();
    if let Some(process) = process {
        process.abort();
    }
    tracing::info!(requests = ?proxy.counts(), "stopped");
    Ok(())
}

async fn interrupted() {
    if let Err(error) = tokio::signal::ctrl_c().await {
        tracing::error!(%error, "cannot wait for Ctrl-C");
    }
}

/// `3` or `1-8`.
fn stations(text: &str) -> Result<RangeInclusive<u8>, String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    match (first.parse(), last.parse()) {
        (Ok(first), Ok(last)) if first <= last && last < u8::MAX => Ok(first..=last),
        _ => Err("it must be a number from 0 to 254, or two, as in `1-8`".to_owned()),
    }
}

/// Says every ten seconds what has happened, if anything has.
async fn report(proxy: Arc<Proxy>) {
    let mut ticks = interval(Duration::from_secs(10));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut last = proxy.counts();
    loop {
        ticks.tick().await;
        let (now, bus) = (proxy.counts(), proxy.link().stats());
        if now != last {
            let (timeouts, retries) = (bus.stations.timeouts, bus.stations.retries);
            tracing::info!(requests = ?now, timeouts, retries, checksum_errors = bus.checksum_errors, "so far");
            last = now;
        }
    }
}

/// Eight PLCs on a line, and what goes on in them: `R0` counts seconds, from a hundred times the station's number on.
fn simulated_bus() -> Result<(LinkBuilder, impl Future<Output = ()>), Box<dyn Error>> {
    let plcs: Vec<_> = (1..=8).map(|station| (station, Plc::new())).collect();
    let line = Line::new(9600).response_time(Duration::from_millis(1), Duration::from_millis(10));
    let mut bus = Bus::new().with_faults(Faults::new(0).line(line));
    for (station, plc) in &plcs {
        plc.run();
        bus = bus.with_station(*station, plc.clone())?;
    }
    let connector = sim::connector(bus, Framing::Ascii);
    let builder =
        Link::connector_builder("a simulated bus", Framing::Ascii, connector).response_timeout(Duration::from_secs(1));
    let process = async move {
        let mut seconds = interval(Duration::from_secs(1));
        for second in 0_u16.. {
            seconds.tick().await;
            for (station, plc) in &plcs {
                let _ = plc.write(register!("R0"), u16::from(*station) * 100 + second);
            }
        }
    };
    Ok((builder, process))
}
