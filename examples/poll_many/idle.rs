//! What links cost that are there and are not used: in memory, before anything is polled.

use std::net::SocketAddr;
use std::time::Duration;

use fatek::{CallOptions, Pool, Station};
use futures::StreamExt;
use tokio::time::sleep;

use crate::options::Options;
use crate::{Result, plc, process};

/// The resident memory a link, in bytes. `None` where the system does not tell.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Idle {
    /// Made, and never used.
    pub(crate) unused: Option<u64>,
    /// Connected; each has made one call.
    pub(crate) connected: Option<u64>,
}

/// Makes all links, lets each of them connect and make one call, and weighs them before and after.
pub(crate) async fn measure(
    pool: &Pool,
    addresses: impl Iterator<Item = SocketAddr>,
    options: &Options,
    memory_before: Option<u64>,
) -> Result<Idle> {
    let a_link = || {
        let grown = process::memory().zip(memory_before).map(|(now, before)| now.saturating_sub(before));
        grown.map(|grown| grown / u64::from(options.plcs))
    };
    let patience = CallOptions::new().call_timeout(options.longest_start());
    let stations: Vec<Station> =
        addresses.map(|address| Ok(pool.station(address, 1)?.with_options(patience))).collect::<Result<_>>()?;
    let unused = a_link();
    let mut reads = futures::stream::iter(&stations)
        .map(|station| async move { station.read_registers(plc::FIRST, plc::COUNT).await })
        .buffer_unordered(64);
    while let Some(read) = reads.next().await {
        read?;
    }
    // What the last calls have woken comes to rest.
    sleep(Duration::from_secs(2)).await;
    Ok(Idle { unused, connected: a_link() })
}
