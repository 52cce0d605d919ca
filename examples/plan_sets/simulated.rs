//! Plans on the simulated line, in simulated time.

use std::time::Duration;

use fatek::endpoint::SerialSettings;
use fatek::plan::{Limits, Plan};
use fatek::sim::{self, Bus, Faults, Line, Plc};
use fatek::tag::Tag;
use fatek::wire::Framing;
use fatek::{Link, Station};
use tokio::time::Instant;

use super::{Result, lines, milliseconds, sets};

/// The table of the times of a read of some sets, with the checks of the link.
pub(crate) fn table() -> Result<String> {
    let mut table = String::from("| tags | line | without words, ms | `Plan`, ms |\n|---|---|---:|---:|\n");
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build()?;
    for (name, tags) in sets::all()?.into_iter().take(6) {
        for (line, cost) in lines()? {
            let mut times = Vec::new();
            for limits in [Limits::new().words_of_discretes(false), Limits::new()] {
                let plan = Plan::builder(cost).limits(limits).tags(tags.iter().copied()).build()?;
                times.push(runtime.block_on(read(&plan, line, &tags))?);
            }
            let [before, now] = times[..] else { continue };
            table += &format!("| {name} | {line} | {:.0} | {:.0} |\n", milliseconds(before), milliseconds(now));
        }
    }
    Ok(table)
}

/// Returns the time of the second read: the first one opens the connection.
async fn read(plan: &Plan, line: &str, tags: &[Tag]) -> Result<Duration> {
    let latency = Duration::from_millis(5);
    let baud = match line {
        "9600 baud" => 9600,
        "115200 baud" => 115_200,
        // As fast as no line.
        _ => u32::MAX,
    };
    let faults = Faults::new(1).line(Line::new(baud).response_time(latency, latency));
    let bus = Bus::new().with_station(1, Plc::new())?.with_faults(faults);
    let mut builder = Link::connector_builder("a simulated line", Framing::Ascii, sim::connector(bus, Framing::Ascii));
    // The prices of checks and of other spellings depend on the line.
    if baud < u32::MAX {
        builder = builder.serial_line(SerialSettings::new(Framing::Ascii).with_baud(baud)?);
    }
    let station = builder.seed(1).response_timeout(Duration::from_secs(2)).build().station(1)?;
    read_once(plan, &station, tags).await?;
    // Longer than the copy window.
    tokio::time::sleep(Duration::from_secs(1)).await;
    let start = Instant::now();
    read_once(plan, &station, tags).await?;
    Ok(start.elapsed())
}

async fn read_once(plan: &Plan, station: &Station, tags: &[Tag]) -> Result<()> {
    let readings = plan.read(station).await;
    for n in 0..tags.len() {
        readings.tag(n).transpose().map_err(Clone::clone)?;
    }
    Ok(())
}
