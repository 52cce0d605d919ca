//! Test benches: one simulated PLC with a link to it in memory.

use super::{Bus, Faults, Log, Plc, connector};
use crate::wire::Framing;
use crate::{Error, Link, Station};

/// A test bench: a [`Station`] of a link in memory, with its simulated PLC. Made by [`station`].
///
/// The link ends when the station and all its clones are dropped.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Bench {
    /// The station, for the code under test: number 1, with the default [`CallOptions`].
    ///
    /// [`CallOptions`]: crate::CallOptions
    pub station: Station,
    /// The PLC, to prepare and to inspect its memory.
    pub plc: Plc,
    /// The faults of the line: none until a rule is added.
    pub faults: Faults,
}

impl Bench {
    /// The log of the requests that arrived at the PLC after [`station`] has returned.
    ///
    /// It also has the checks (loop-backs) of the link.
    #[must_use]
    pub fn log(&self) -> Log {
        self.faults.log()
    }
}

/// Connects a new [`Plc`] as station 1 of a [`Link`] in memory, in the ASCII framing.
///
/// Without sockets and, until a fault has a delay, without timers of the PLC: a test is
/// reproducible, also under Tokio's paused clock (`#[tokio::test(start_paused = true)]`).
///
/// ```
/// use fatek::command::Value;
/// use fatek::sim::{self, Change, Fault, Rule};
/// use fatek::{register, Station};
///
/// /// The code under test.
/// async fn fill(station: &Station) -> Result<(), fatek::Error> {
///     let level = station.read_registers(register!("R0"), 1).await?[0];
///     station.write_registers(register!("R1"), &[1000 - level]).await
/// }
///
/// # #[tokio::main(flavor = "current_thread", start_paused = true)]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let bench = sim::station().await;
/// bench.plc.write(register!("R0"), 400_u16)?;
/// fill(&bench.station).await?;
/// assert_eq!(bench.plc.read(register!("R1")), Value::Word(600));
/// assert_eq!(bench.log().changes(1), [Change::value(register!("R1"), 600_u16)]);
///
/// bench.log().clear();
/// bench.faults.add_rule(Rule::new(Fault::Ignore)); // the cable is cut
/// assert!(fill(&bench.station).await.unwrap_err().is_timeout());
/// assert_eq!(bench.log().changes(1), []);
/// # Ok(())
/// # }
/// ```
///
/// For another model, framing or station number, for several stations and for settings of the link,
/// use a [`Bus`] and a [`connector`](super::connector()).
///
/// Cancel-safe: a dropped call ends the link.
///
/// # Panics
/// Outside of a Tokio runtime whose timer is enabled, and in one that shuts down.
#[must_use]
pub async fn station() -> Bench {
    match connected().await {
        Ok(bench) => bench,
        Err(error) => panic!("the simulated PLC cannot be reached: {error}"),
    }
}

async fn connected() -> Result<Bench, Error> {
    let (plc, faults) = (Plc::new(), Faults::new(0));
    let bus = Bus::of_one(plc.clone()).with_faults(faults.clone());
    let connector = connector(bus, Framing::Ascii);
    let station = Link::connector_builder("simulated PLC", Framing::Ascii, connector).build().station(1)?;
    // The connection is open, and its check is not in the log of the test.
    station.loop_back("").await?;
    faults.log().clear();
    Ok(Bench { station, plc, faults })
}

#[cfg(test)]
mod tests;
