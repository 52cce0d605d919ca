//! Memory of idle links, measured before the poll begins.

use std::net::SocketAddr;
use std::time::Duration;

use fatek::{CallOptions, Pool, Station};
use futures::StreamExt;
use tokio::time::sleep;

use crate::options::Options;
use crate::{Result, plc, process};

/// Resident memory per link, in bytes. `None` on systems without `/proc`.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Idle {
    /// Built, not yet connected.
    pub(crate) unused: Option<u64>,
    /// Connected, after one call per link.
    pub(crate) connected: Option<u64>,
}

/// Builds all links, makes one call on each, and measures the memory before and after.
pub(crate) async fn measure(
    pool: &Pool,
    addresses: impl Iterator<Item = SocketAddr>,
    options: &Options,
    memory_before: Option<u64>,
) -> Result<Idle> {
    let per_link = || {
        let grown = process::memory().zip(memory_before).map(|(now, before)| now.saturating_sub(before));
        grown.map(|grown| grown / u64::from(options.plcs))
    };
    let call_options = CallOptions::new().with_call_timeout(options.start_timeout());
    let stations: Vec<Station> =
        addresses.map(|address| Ok(pool.station(address, 1)?.with_options(call_options))).collect::<Result<_>>()?;
    let unused = per_link();
    let mut reads = futures::stream::iter(&stations)
        .map(|station| async move { station.read_registers(plc::FIRST, plc::COUNT).await })
        .buffer_unordered(64);
    while let Some(read) = reads.next().await {
        read?;
    }
    // For the tasks woken by the last calls.
    sleep(Duration::from_secs(2)).await;
    Ok(Idle { unused, connected: per_link() })
}
