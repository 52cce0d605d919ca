use std::future::Future;

use tokio::runtime::Builder;

use super::{Bus, Plc, serve};
use crate::{Clock, Link, Station, wire::Framing};

/// Runs an example of the documentation against a simulated PLC with station number 1.
pub fn doctest<F, Fut>(example: F)
where
    F: FnOnce(Station) -> Fut,
    Fut: Future<Output = Result<(), Box<dyn std::error::Error>>>,
{
    let run = async {
        let plc = Plc::new();
        plc.set_clock(Clock::from_seconds_since_2000(0, 0));
        let bus = Bus::new().with_station(1, plc)?;
        let (client, plc) = tokio::io::duplex(4096);
        tokio::spawn(serve(plc, bus, Framing::Ascii));
        let station = Link::from_stream(client, Framing::Ascii).station(1)?;
        example(station).await
    };
    let runtime = Builder::new_current_thread().enable_all().build();
    match runtime.map(|runtime| runtime.block_on(run)) {
        Ok(Ok(())) => {}
        Ok(Err(error)) => panic!("the example failed: {error}"),
        Err(error) => panic!("no runtime: {error}"),
    }
}
