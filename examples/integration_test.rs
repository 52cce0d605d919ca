//! Tests of code that uses a PLC, without a PLC.
//!
//! ```text
//! cargo test --example integration_test --features sim   # the tests, at the end of this file
//! cargo run --example integration_test --features sim    # prints the events of the last test
//! ```
//!
//! The code under test is a controller that keeps the level of a tank between two marks. It has a
//! [`Station`], and no code for the line: in the plant a link to `tcp://192.168.2.3:500`, here a
//! link to a simulated PLC in memory. The clock is Tokio's paused clock: an hour of the plant takes
//! milliseconds, and each run gives the same result.

use std::error::Error;
use std::time::Duration;

use fatek::command::Code;
use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
use fatek::wire::Framing;
use fatek::{Discrete, Link, Register, Station, Value, discrete, register};
use tokio::time::{Instant, sleep};

// ---- The code under test.

/// Elements of the PLC: level and marks in millimetres, contact of the closed lid, and the pump
/// that fills the tank.
const LEVEL: Register = register!("R0");
const LOW_MARK: Register = register!("R1");
const HIGH_MARK: Register = register!("R2");
const LID_CLOSED: Discrete = discrete!("X0");
const PUMP: Discrete = discrete!("Y0");

struct TankController {
    station: Station,
}

/// Result of a cycle.
#[derive(Debug, PartialEq, Eq)]
enum Action {
    Nothing,
    SwitchedOn,
    SwitchedOff,
}

/// Error of a cycle.
#[derive(Debug, thiserror::Error)]
enum CycleError {
    #[error("the PLC is stopped")]
    Stopped,
    #[error(transparent)]
    Plc(#[from] fatek::Error),
}

impl TankController {
    /// Reads the inputs once, and switches the pump if necessary.
    ///
    /// Keeps no state. A command whose reply was lost may have been executed or not
    /// ([`fatek::Error::may_have_executed`]). The next cycle reads the actual state, so no command
    /// is repeated blindly.
    async fn cycle(&self) -> Result<Action, CycleError> {
        if !self.station.read_status().await?.flags().running() {
            return Err(CycleError::Stopped);
        }
        // One request for all values, so that they come from one scan cycle of the PLC.
        let elements = [LEVEL.into(), LOW_MARK.into(), HIGH_MARK.into(), LID_CLOSED.into(), PUMP.into()];
        let values = self.station.read_mixed(&elements).await?;
        let [Value::Word(level), Value::Word(low), Value::Word(high), Value::Bit(lid_closed), Value::Bit(is_on)] =
            values[..]
        else {
            unreachable!("a reply has the shape of its request");
        };
        let should_be_on = lid_closed && (level < low || is_on && level < high);
        match (is_on, should_be_on) {
            (false, true) => self.station.set(PUMP).await.map(|()| Action::SwitchedOn),
            (true, false) => self.station.reset(PUMP).await.map(|()| Action::SwitchedOff),
            (true, true) | (false, false) => Ok(Action::Nothing),
        }
        .map_err(CycleError::from)
    }
}

// ---- The test bench: simulated PLC, faults of the line, and controller.

struct Bench {
    plc: Plc,
    faults: Faults,
    controller: TankController,
}

impl Bench {
    /// Bench with a half full tank and no faults.
    fn new() -> Result<Self, Box<dyn Error>> {
        let plc = Plc::new();
        plc.run();
        for (register, value) in [(LEVEL, 500_u16), (LOW_MARK, 400), (HIGH_MARK, 600)] {
            plc.write(register, value)?;
        }
        plc.write(LID_CLOSED, true)?;
        let faults = Faults::new(1); // seed: equal seeds give equal faults
        let bus = Bus::new().with_station(1, plc.clone())?.with_faults(faults.clone());
        let link = Link::connector_builder("the plant", Framing::Ascii, sim::connector(bus, Framing::Ascii))
            .response_timeout(Duration::from_millis(200))
            .build();
        Ok(Self { plc, faults, controller: TankController { station: link.station(1)? } })
    }

    fn level(&self) -> u16 {
        match self.plc.read(LEVEL) {
            Value::Word(level) => level,
            other @ (Value::Bit(_) | Value::DWord(_)) => unreachable!("a register of 16 bits holds {other}"),
        }
    }

    fn pump_is_on(&self) -> bool {
        self.plc.read(PUMP) == Value::Bit(true)
    }

    /// Number of switching operations of the pump.
    fn switched(&self) -> u64 {
        self.faults.log().writes()
    }

    /// Simulates one second: the pump adds 8 mm, the consumers take 3 mm.
    async fn second(&self) -> Result<(), sim::Error> {
        sleep(Duration::from_secs(1)).await;
        let inflow = if self.pump_is_on() { 8 } else { 0 };
        self.plc.write(LEVEL, (self.level() + inflow).saturating_sub(3))
    }
}

/// Applies the event of this second, if any, and returns its description.
fn apply_event(bench: &Bench, second: u32) -> Result<Option<&'static str>, sim::Error> {
    Ok(Some(match second {
        60 => {
            bench.faults.set_rules([Rule::new(Fault::GarbageInside { max_len: 4 }).per_mille(150)]);
            "- noise on the line"
        }
        120 => {
            bench.faults.set_rules([Rule::new(Fault::DropReply).command(Code::ControlDiscrete).times(1)]);
            "- no more noise; the next reply to a command will be lost"
        }
        160 => {
            bench.plc.write(LID_CLOSED, false)?;
            "- the lid is opened"
        }
        180 => {
            bench.plc.write(LID_CLOSED, true)?;
            "- the lid is closed"
        }
        300 => {
            bench.faults.set_rules([Rule::new(Fault::Ignore)]);
            "- the cable is cut"
        }
        330 => {
            bench.faults.set_rules([]);
            "- the cable is repaired"
        }
        450 => {
            bench.plc.stop();
            "- the PLC is stopped"
        }
        470 => {
            bench.plc.run();
            "- the PLC is started"
        }
        _ => return Ok(None),
    }))
}

/// Runs ten minutes with faults, one cycle per second. Returns the lowest and the highest level.
async fn ten_minutes_with_faults(bench: &Bench) -> Result<(u16, u16), Box<dyn Error>> {
    let (mut lowest, mut highest) = (u16::MAX, 0);
    let mut last = String::new();
    for second in 0..600 {
        if let Some(event) = apply_event(bench, second)? {
            println!("{second:4} s           {event}");
        }
        let result = match bench.controller.cycle().await {
            Ok(action) => format!("{action:?}"),
            // The full message contains a time, which differs in each cycle.
            Err(CycleError::Plc(fatek::Error::Offline { .. })) => "the station is offline".to_owned(),
            Err(error) => error.to_string(),
        };
        if result != last {
            println!("{second:4} s  {:4} mm  {result}", bench.level());
            last = result;
        }
        bench.second().await?;
        (lowest, highest) = (lowest.min(bench.level()), highest.max(bench.level()));
    }
    Ok((lowest, highest))
}

#[tokio::main(flavor = "current_thread", start_paused = true)]
async fn main() -> Result<(), Box<dyn Error>> {
    let bench = Bench::new()?;
    let began = Instant::now();
    let (lowest, highest) = ten_minutes_with_faults(&bench).await?;
    let link = bench.controller.station.link().stats();
    println!("\nafter {:.0?}: the level was between {lowest} and {highest} mm", began.elapsed());
    println!("the pump was switched {} times, never twice for one command", bench.switched());
    println!("the link had {} retries and {} timeouts", link.stations.retries, link.stations.timeouts);
    println!("\nlast requests to the PLC:");
    let entries = bench.faults.log().entries();
    for entry in entries.iter().rev().take(4).rev() {
        let at = entry.at.duration_since(began);
        println!("{at:8.1?}  {entry}");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn pump_switches_at_the_low_and_the_high_mark() {
        let bench = Bench::new().unwrap();
        for (level, action) in [
            (400_u16, Action::Nothing),
            (399, Action::SwitchedOn),
            (400, Action::Nothing),
            (599, Action::Nothing),
            (600, Action::SwitchedOff),
            (401, Action::Nothing),
        ] {
            bench.plc.write(LEVEL, level).unwrap();
            assert_eq!(bench.controller.cycle().await.unwrap(), action, "{level} mm");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn open_lid_stops_the_pump_at_any_level() {
        let bench = Bench::new().unwrap();
        bench.plc.write(LEVEL, 100_u16).unwrap();
        bench.controller.cycle().await.unwrap();
        assert!(bench.pump_is_on());
        bench.plc.write(LID_CLOSED, false).unwrap();
        assert_eq!(bench.controller.cycle().await.unwrap(), Action::SwitchedOff);
        assert_eq!(bench.controller.cycle().await.unwrap(), Action::Nothing);
        assert!(!bench.pump_is_on());
    }

    /// The log records all requests to the PLC.
    #[tokio::test(start_paused = true)]
    async fn nothing_is_written_between_the_marks() {
        let bench = Bench::new().unwrap();
        for _ in 0..100 {
            bench.controller.cycle().await.unwrap();
        }
        // Two requests per cycle, and the check at the start of the connection.
        assert_eq!((bench.faults.log().arrivals(), bench.switched()), (201, 0));
    }

    #[tokio::test(start_paused = true)]
    async fn stopped_plc_is_not_controlled() {
        let bench = Bench::new().unwrap();
        bench.plc.write(LEVEL, 100_u16).unwrap();
        bench.plc.stop();
        assert!(matches!(bench.controller.cycle().await, Err(CycleError::Stopped)));
        assert_eq!(bench.switched(), 0);
    }

    /// The PLC switches the pump, but its reply is lost: the next cycle reads the actual state.
    #[tokio::test(start_paused = true)]
    async fn lost_reply_does_not_switch_the_pump_twice() {
        let bench = Bench::new().unwrap();
        bench.plc.write(LEVEL, 100_u16).unwrap();
        bench.faults.add_rule(Rule::new(Fault::DropReply).command(Code::ControlDiscrete).times(1));
        let Err(CycleError::Plc(error)) = bench.controller.cycle().await else { panic!("the reply was not lost") };
        assert!(error.may_have_executed(), "{error}");
        assert_eq!(bench.controller.cycle().await.unwrap(), Action::Nothing);
        assert_eq!(bench.switched(), 1);
    }

    /// The link returns correct values or errors, so the controller needs no checks of its own.
    #[tokio::test(start_paused = true)]
    async fn wrong_replies_never_switch_the_pump() {
        let bench = Bench::new().unwrap();
        let wrong = [
            Fault::GarbageInside { max_len: 4 },
            Fault::BadChecksum,
            Fault::WrongStation,
            Fault::WrongCommand,
            Fault::Truncated { by: 1 },
            Fault::Extended { by: 4 },
        ];
        bench.faults.set_rules(wrong.map(|fault| Rule::new(fault).per_mille(50)));
        let mut good_cycles = 0;
        for _ in 0..500 {
            match bench.controller.cycle().await {
                Ok(action) => assert_eq!(action, Action::Nothing),
                Err(_) => continue,
            }
            good_cycles += 1;
        }
        assert!(bench.faults.rules().iter().all(|rule| rule.times_applied() > 0));
        assert!(good_cycles > 250, "reads are retried: {good_cycles}");
        assert_eq!(bench.switched(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn dead_plc_is_detected_and_recovers() {
        let bench = Bench::new().unwrap();
        bench.controller.cycle().await.unwrap();
        bench.faults.set_rules([Rule::new(Fault::Ignore)]);
        let began = Instant::now();
        assert!(matches!(bench.controller.cycle().await, Err(CycleError::Plc(fatek::Error::Timeout { .. }))));
        assert!(began.elapsed() < Duration::from_secs(1), "three attempts of 200 ms: {:?}", began.elapsed());
        let began = Instant::now();
        assert!(matches!(bench.controller.cycle().await, Err(CycleError::Plc(fatek::Error::Offline { .. }))));
        assert_eq!(began.elapsed(), Duration::ZERO, "calls to an offline station fail at once");

        bench.faults.set_rules([]);
        sleep(Duration::from_secs(10)).await; // a probe succeeds within this time
        assert_eq!(bench.controller.cycle().await.unwrap(), Action::Nothing);
    }

    #[tokio::test(start_paused = true)]
    async fn level_stays_within_limits_despite_faults() {
        let (lowest, highest) = ten_minutes_with_faults(&Bench::new().unwrap()).await.unwrap();
        assert!(lowest > 300 && highest < 800, "{lowest} to {highest} mm");
    }
}
