//! The demo: simulated PLCs in this process, whose values move, and the configuration that polls them.
//!
//! The configuration is `examples/demo.toml`. Its section `sim` has the values and movements of the PLCs. Their
//! servers listen on free ports of the loopback interface, which take the place of those in the file.

use std::io;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::Path;
use std::time::Duration;

use fatek::endpoint::Endpoint;
use fatek::plant::{Plant, PlantPlc};
use fatek::sim::{Bus, Fault, Faults, Line, Movement, Plc, Rule, Server};
use fatek::tag::{Assignment, Tag};
use tokio::task::JoinHandle;
use tokio::time::sleep;
use toml::{Table, Value};

use crate::config::{Config, ConfigError, Environment};

/// The configuration of the demo, as it is in the examples.
pub const CONFIG: &str = include_str!("../examples/demo.toml");

/// The PLC that falls silent from time to time.
pub const SILENT_PLC: &str = "pump4";
/// The time before it is silent for the first time.
const FIRST_SILENCE_AFTER: Duration = Duration::from_secs(6);
/// The time for which it is silent, and for which it answers after that.
const SILENCE: Duration = Duration::from_secs(10);
const ANSWERS: Duration = Duration::from_secs(30);

/// The name of the configuration in messages.
const NAME: &str = "demo.toml";

/// A demo that cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// A fault of the configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A fault of the simulated values.
    #[error("{NAME}: sim.{plc}.set.{tag}: {rule}")]
    Value {
        /// The name of the PLC.
        plc: String,
        /// The name of the tag.
        tag: String,
        /// The rule that is broken.
        rule: String,
    },
    /// A server cannot listen.
    #[error("cannot listen on the loopback interface: {0}")]
    Listen(#[from] io::Error),
}

/// The simulated PLCs; they end when this is dropped.
#[derive(Debug)]
pub struct Demo {
    /// The configuration that polls them.
    pub config: Config,
    _servers: Vec<Server>,
    silence: JoinHandle<()>,
}

impl Demo {
    /// Starts the simulated PLCs. `http`: the address of the page; without it that of the file, or a free port
    /// if that one is taken.
    ///
    /// # Errors
    /// [`DemoError`] if a server cannot listen.
    pub async fn start(http: Option<SocketAddr>) -> Result<Self, DemoError> {
        let plant = Config::from_text(Path::new(NAME), CONFIG, &Environment::default())?.plant;
        let values: Table = CONFIG.parse().unwrap_or_default();
        let mut text = CONFIG.to_owned();
        let (mut servers, mut silent) = (Vec::new(), None);
        for (number, endpoint) in endpoints(&plant).into_iter().enumerate() {
            let faults = Faults::new(number as u64).line(line(&plant, endpoint));
            let mut bus = Bus::new();
            for plc in plant.plcs().filter(|plc| plc.endpoint() == endpoint) {
                let simulated = simulated(plc, &values)?;
                let station = plc.station();
                bus = bus.with_station(station, simulated).map_err(io::Error::other)?;
                if plc.name() == SILENT_PLC {
                    silent = Some((faults.clone(), station));
                }
            }
            let bus = bus.with_faults(faults);
            let server = Server::bind((Ipv4Addr::LOCALHOST, 0), bus, endpoint.framing()).await?;
            // With the character behind it: a port can be the beginning of another one.
            for end in ['"', '?'] {
                let link = format!("tcp://{}{end}", server.local_addr());
                text = text.replace(&format!("{}{end}", address(endpoint)), &link);
            }
            servers.push(server);
        }
        let mut config = Config::from_text(Path::new(NAME), &text, &Environment::default())?;
        config.bridge.http = match http {
            // Known now, so that it can be shown.
            Some(http) if http.port() == 0 => free(http)?,
            Some(http) => http,
            None => free(config.bridge.http)?,
        };
        let silence = tokio::spawn(fall_silent(silent));
        Ok(Self { config, _servers: servers, silence })
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        self.silence.abort();
    }
}

/// The endpoints of a plant, each once.
fn endpoints(plant: &Plant) -> Vec<&Endpoint> {
    let mut endpoints: Vec<&Endpoint> = Vec::new();
    for plc in plant.plcs() {
        if !endpoints.contains(&plc.endpoint()) {
            endpoints.push(plc.endpoint());
        }
    }
    endpoints
}

/// The times of a link: those of a serial line for a bus, else those of a network.
fn line(plant: &Plant, endpoint: &Endpoint) -> Line {
    let is_bus = plant.plcs().any(|plc| plc.endpoint() == endpoint && plc.bus().is_some());
    let baud = if is_bus { 19_200 } else { 10_000_000 };
    Line::new(baud).response_time(Duration::from_millis(2), Duration::from_millis(7))
}

/// The scheme, host and port of a link of the file.
fn address(endpoint: &Endpoint) -> String {
    let text = endpoint.to_string();
    // Without options, which the link keeps.
    text.split('?').next().unwrap_or_default().to_owned()
}

/// A simulated PLC with the values of its section.
fn simulated(plc: &PlantPlc, values: &Table) -> Result<Plc, DemoError> {
    let simulated = Plc::new();
    simulated.run();
    let set = values.get("sim").and_then(|sim| sim.get(plc.name())?.get("set")?.as_table());
    for (number, (name, value)) in set.into_iter().flatten().enumerate() {
        let fault = |rule: String| DemoError::Value { plc: plc.name().to_owned(), tag: name.clone(), rule };
        let tag = plc.tag(name).ok_or_else(|| fault("there is no such tag".to_owned()))?.tag();
        let text = match value {
            Value::String(text) => text.clone(),
            Value::Integer(_) | Value::Float(_) | Value::Boolean(_) => value.to_string(),
            Value::Datetime(_) | Value::Array(_) | Value::Table(_) => {
                return Err(fault("a text or a number is expected".to_owned()));
            }
        };
        set_value(&simulated, tag, &text, number as u64).map_err(fault)?;
    }
    Ok(simulated)
}

/// Sets a movement, such as `sine(0..100,10s)`, or values.
fn set_value(plc: &Plc, tag: Tag, text: &str, seed: u64) -> Result<(), String> {
    if text.contains('(') && !tag.tag_type().is_text() {
        let movement: Movement = text.parse().map_err(|error| format!("{error}"))?;
        return plc.set_movement(tag, movement.with_seed(seed)).map_err(|error| error.to_string());
    }
    let values = tag.parse_values(text).map_err(|error| error.to_string())?;
    let assignment = Assignment::new(tag, values).map_err(|error| error.to_string())?;
    let mut elements = tag.elements().zip(assignment.encode());
    elements.try_for_each(|(element, value)| plc.write(element, value)).map_err(|error| error.to_string())
}

/// The address, or another port of the same host if it is taken. Port 0 is any free one.
fn free(wanted: SocketAddr) -> io::Result<SocketAddr> {
    match TcpListener::bind(wanted) {
        Ok(listener) => listener.local_addr(),
        Err(_) => TcpListener::bind((wanted.ip(), 0))?.local_addr(),
    }
}

/// Lets a station be silent from time to time.
async fn fall_silent(silent: Option<(Faults, u8)>) {
    let Some((faults, station)) = silent else { return };
    sleep(FIRST_SILENCE_AFTER).await;
    loop {
        faults.set_rules([Rule::new(Fault::Ignore).station(station)]);
        sleep(SILENCE).await;
        faults.set_rules([]);
        sleep(ANSWERS).await;
    }
}

#[cfg(test)]
mod tests {
    use fatek::link::Link;

    use super::*;

    #[tokio::test]
    async fn the_values_of_the_demo_are_set() {
        let demo = Demo::start(None).await.unwrap();
        let plc = demo.config.plant.plc("mixer").unwrap();
        let station = Link::new(plc.endpoint().clone()).station(plc.station()).unwrap();
        let setpoint: f32 = station.read(plc.tag("setpoint").unwrap().tag()).await.unwrap();
        assert_eq!(setpoint, 42.0);
        let level: f64 = station.read(plc.tag("level").unwrap().tag()).await.unwrap();
        assert!((15.0..=85.0).contains(&level), "{level}");
    }

    #[test]
    fn a_taken_port_gives_way_to_a_free_one() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let wanted = taken.local_addr().unwrap();
        let other = free(wanted).unwrap();
        assert!(other != wanted && other.ip() == wanted.ip(), "{other}");
        drop(taken);
        assert_eq!(free(wanted).unwrap(), wanted);
    }

    #[tokio::test(start_paused = true)]
    async fn a_station_is_silent_from_time_to_time() {
        let faults = Faults::new(0);
        let task = tokio::spawn(fall_silent(Some((faults.clone(), 4))));
        let mut silent = Vec::new();
        for _ in 0..100 {
            sleep(Duration::from_secs(1)).await;
            silent.push(!faults.rules().is_empty());
        }
        task.abort();
        let changes = silent.windows(2).filter(|pair| pair[0] != pair[1]).count();
        assert!(!silent[0] && changes >= 4, "{silent:?}");
    }
}
