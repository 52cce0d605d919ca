//! Gateway from many TCP clients to one FATEK bus.
//!
//! The clients use the FATEK protocol, in ASCII or binary framing, as with an Ethernet module. The
//! framing of a client is detected by its first byte. All requests go through one [`Link`]: one
//! request at a time on the bus, in a fair order, with little delay by a station that does not
//! answer. [`proxy`] handles requests, [`server`] handles clients.
//!
//! ```text
//! cargo run --example serial_gateway --features cli                               # with a simulated bus
//! cargo run --example serial_gateway --features cli -- "serial:/dev/ttyUSB0?baud=19200" --listen 0.0.0.0:500
//! cargo run --example serial_gateway --features cli -- tcp://192.168.2.3:500 --read-only --stations 1-8
//! ```
//!
//! To test it: `fatek --link tcp://127.0.0.1:5000 --station 3 read R0-R9`. `RUST_LOG=debug` logs
//! every request.
//!
//! The protocol has no authentication. Any client that can connect to the port can write, unless
//! `--read-only` is given.

mod proxy;
mod server;

use std::error::Error;
use std::future::Future;
use std::io::{self, IsTerminal};
use std::num::NonZeroUsize;
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

/// Gateway from many TCP clients to one FATEK bus.
#[derive(Parser)]
struct Args {
    /// Bus: serial:/dev/ttyUSB0?baud=19200&frame=7E1, tcp://HOST:500 or udp://HOST:500, each with
    /// ?framing=ascii or binary [default: eight simulated PLCs at 9600 baud]
    bus: Option<Endpoint>,
    /// Listening address for clients
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:5000")]
    listen: String,
    /// Read-only mode: writes, RUN, STOP and forcing are refused, and no broadcast is sent
    #[arg(long)]
    read_only: bool,
    /// Stations served, 0 to 254; 0: broadcasts
    #[arg(long, value_name = "FIRST-LAST", default_value = "0-254", value_parser = stations)]
    stations: RangeInclusive<u8>,
    /// Limit of connected clients
    #[arg(long, value_name = "N", default_value = "64")]
    max_clients: NonZeroUsize,
    /// Idle timeout of a client, such as 60s or 2h
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = humantime::parse_duration)]
    idle: Duration,
    /// Idle time after which a client makes room for a new one at the limit of clients
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = humantime::parse_duration)]
    make_room_after: Duration,
    /// Deadline of a request, queueing included, such as 2s
    ///
    /// Use less than the timeout of the clients: a client takes a late reply for that of its next
    /// request.
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = humantime::parse_duration)]
    deadline: Duration,
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
        .call_timeout(args.deadline)
        // Each client has at most one request in the queue.
        .queue_capacity(args.max_clients.get())
        .build();
    // The handlers are installed before clients can connect.
    let stop = signalled()?;
    let listener = TcpListener::bind(&args.listen).await?;
    let bus = args.bus.as_ref().map_or("simulated".to_owned(), ToString::to_string);
    let rules = Rules { stations: args.stations, read_only: args.read_only };
    tracing::info!(%bus, clients = %listener.local_addr()?, ?rules, "Ctrl-C or SIGTERM stops");

    let proxy = Arc::new(Proxy::new(link, rules));
    let reports = tokio::spawn(report(Arc::clone(&proxy)));
    let limits = Limits { clients: args.max_clients.get(), idle: args.idle, make_room_after: args.make_room_after };
    server::serve(listener, Arc::clone(&proxy), limits, stop).await;
    reports.abort();
    if let Some(process) = process {
        process.abort();
    }
    tracing::info!(requests = ?proxy.counts(), "stopped");
    Ok(())
}

/// Installs the handlers of SIGINT and SIGTERM, and waits for the first of them.
///
/// SIGHUP has no handler: it would replace the setting of `nohup`.
#[cfg(unix)]
fn signalled() -> io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};

    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

/// Installs the handler of Ctrl-C, and waits for it.
#[cfg(not(unix))]
fn signalled() -> io::Result<impl Future<Output = ()>> {
    let mut interrupt = tokio::signal::windows::ctrl_c()?;
    Ok(async move {
        interrupt.recv().await;
    })
}

/// Parses `3` or `1-8`.
fn stations(text: &str) -> Result<RangeInclusive<u8>, String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    match (first.parse(), last.parse()) {
        (Ok(first), Ok(last)) if first <= last && last < u8::MAX => Ok(first..=last),
        _ => Err("expected a station or a range from 0 to 254, such as 3 or 1-8".to_owned()),
    }
}

/// Logs the counters every ten seconds if they have changed.
async fn report(proxy: Arc<Proxy>) {
    let mut ticks = interval(Duration::from_secs(10));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut last = proxy.counts();
    loop {
        ticks.tick().await;
        let (now, bus) = (proxy.counts(), proxy.link().stats());
        if now != last {
            let (timeouts, retries) = (bus.stations.timeouts, bus.stations.retries);
            tracing::info!(requests = ?now, timeouts, retries, checksum_errors = bus.checksum_errors, "counters");
            last = now;
        }
    }
}

/// Bus with eight simulated PLCs. `R0` counts seconds, from 100 times the station number on.
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
