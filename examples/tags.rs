//! Reads tags of a simulated PLC into a struct, and writes some of them.
//!
//! ```sh
//! cargo run --example tags --features sim
//! ```

use std::error::Error;

use fatek::{Station, Tag, sim};

/// A tank, as the program of its controller sees it.
#[derive(Debug, PartialEq)]
struct Tank {
    level: f32,
    temperature: f64,
    pump_runs: bool,
    batches: u32,
    recipe: String,
    valves: [bool; 4],
}

/// Its tags, in the order of the fields.
const TAGS: (&str, &str, &str, &str, &str, &str) = ("R100:f32", "R5:i16*0.1-40", "M5", "DR20", "R30-R34:text", "Y0-Y3");

impl Tank {
    /// Reads the tank by the cheapest requests.
    async fn read(station: &Station) -> Result<Self, fatek::Error> {
        let (level, temperature, pump_runs, batches, recipe, valves) = station.read(TAGS).await?;
        Ok(Self { level, temperature, pump_runs, batches, recipe, valves })
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let sim::Bench { station, .. } = sim::station().await;
    station.write_all((("R100:f32", 2.75), ("R5:i16*0.1-40", 21.5), ("R30-R34:text", "lemonade"))).await?;
    station.write_all([("M5", true), ("Y1", true)]).await?;
    station.write("DR20", 1234).await?;
    println!("{:#?}", Tank::read(&station).await?);

    // A tag and a type that do not fit are found before anything is sent.
    let tag: Tag = "R100:f32".parse()?;
    for error in [station.read::<i16, _>(tag).await.map(drop), station.write("R7", 70_000).await] {
        println!("{}", error.expect_err("they do not fit"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn the_tank_is_read_by_three_requests_at_most() {
        let bench = sim::station().await;
        let (station, plc) = (&bench.station, &bench.plc);
        plc.write(fatek::register!("R5"), 615_u16).unwrap();
        plc.write(fatek::discrete!("Y3"), true).unwrap();
        let expected = Tank {
            level: 0.0,
            temperature: 21.5,
            pump_runs: false,
            batches: 0,
            recipe: String::new(),
            valves: [false, false, false, true],
        };
        assert_eq!(Tank::read(station).await.unwrap(), expected);
        assert!(bench.log().arrivals() <= 3, "{:?}", bench.log().entries());
    }
}
