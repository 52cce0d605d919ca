//! Reads tags of a simulated PLC into a struct, writes some of them, and prints the struct as JSON.
//!
//! ```sh
//! cargo run --example tags --features sim,derive,serde
//! ```

use std::error::Error;

use fatek::{Tag, Tags, sim};
use serde::Serialize;

/// A tank, as the program of its controller sees it.
#[derive(Debug, PartialEq, Serialize, Tags)]
struct Tank {
    #[tag("R100:f32")]
    level: f32,
    #[tag("R5:i16*0.1-40")]
    temperature: f64,
    #[tag("M5")]
    pump_runs: bool,
    #[tag("DR20")]
    batches: u32,
    #[tag("R30-R34:text")]
    recipe: String,
    #[tag("Y0-Y3")]
    valves: [bool; 4],
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let sim::Bench { station, .. } = sim::station().await;
    station.write_all((("R100:f32", 2.75), ("R5:i16*0.1-40", 21.5), ("R30-R34:text", "lemonade"))).await?;
    station.write("M5", true).await?;
    let mut tank: Tank = station.read_struct().await?;
    tank.batches += 1;
    tank.valves[1] = true;
    station.write_struct(&tank).await?;

    // A tag and a type that do not fit are found before anything is sent.
    let tag: Tag = "R100:f32".parse()?;
    for error in [station.read::<i16, _>(tag).await.map(drop), station.write("R7", 70_000).await] {
        println!("{}", error.expect_err("they do not fit"));
    }
    println!("{}", serde_json::to_string_pretty(&station.read_struct::<Tank>().await?)?);
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
        assert_eq!(station.read_struct::<Tank>().await.unwrap(), expected);
        assert!(bench.log().arrivals() <= 3, "{:?}", bench.log().entries());
    }
}
