//! Subcommand `fatek sim`: simulated PLCs of the options, or of a plant configuration.

mod client_config;
mod place;
mod section;
mod setting;
mod setup;

use std::path::Path;

use fatek::Endpoint;
use fatek::sim::{Bus, FaultRate, Faults, Line};
use futures::future::join_all;

use self::place::{Listening, host_and_port};
pub(crate) use self::place::{Place, PlaceKind};
use self::setup::{Setup, SimPlc};
use crate::args::SimArgs;
use crate::failure::Failure;
use crate::output::{Output, print};
use crate::signal::Stop;
use crate::targets::SimulatedPlant;

/// PLCs on one line, with the places where clients reach them.
struct SimBus {
    /// The names of the PLCs of a plant, and their link.
    of_plant: Option<(String, Endpoint)>,
    bus: Bus,
    /// The faults in the order of the rules of the bus, each with the PLC that it is limited to.
    faults: Vec<(Option<String>, FaultRate)>,
    places: Vec<Place>,
}

pub(crate) async fn sim(args: &SimArgs, plant: Option<&SimulatedPlant>, output: &Output) -> Result<(), Failure> {
    let buses = match plant {
        None => vec![bus_of_options(args)?],
        Some(plant) => buses_of_plant(args, plant)?,
    };
    let copied = client_config(args, plant)?;
    let mut stop = Stop::new()?;
    let (mut listening, mut links, mut summaries) = (Vec::new(), Vec::new(), Vec::new());
    for SimBus { of_plant, bus, faults, places } in buses {
        for place in places {
            let server = place.listen(&bus, args.make_room_after).await?;
            links.extend(of_plant.clone().map(|(names, link)| (names, client_link(&link, &server), link)));
            listening.push(server);
        }
        summaries.push((of_plant, bus, faults));
    }
    if let Some((path, plant)) = copied {
        let new = |old: &Endpoint| links.iter().find(|(_, _, link)| link == old).map(|(_, new, _)| new.clone());
        let copy = client_config::copy(&plant.text, &plant.folder, new);
        let saved = copy.and_then(|copy| client_config::save(path, &copy, &plant.path));
        saved.map_err(|error| Failure::ClientConfig { path: path.to_owned(), error })?;
    }
    if links.is_empty() {
        listening.iter().try_for_each(|server| print(format_args!("listening {}", server.url())))?;
    } else {
        for (names, new, old) in &links {
            print(format_args!("listening {new} for {old}: {names}"))?;
        }
    }
    stop.signalled().await;
    join_all(listening.into_iter().map(Listening::shutdown)).await;
    for (of_plant, bus, faults) in &summaries {
        if let Some(counts) = bus.faults().filter(|_| !faults.is_empty()) {
            summarize(of_plant.as_ref().map(|(names, _)| names.as_str()), counts, faults, output);
        }
    }
    Ok(())
}

/// One bus with one PLC per `--station`.
fn bus_of_options(args: &SimArgs) -> Result<SimBus, Failure> {
    if args.client_config.is_some() {
        return Err(Failure::Usage("--client-config is a copy of a plant: give --config FILE".to_owned()));
    }
    let framing = args.framing.unwrap_or_default();
    let listen = if args.listen.is_empty() { &["tcp://127.0.0.1:0".to_owned()][..] } else { &args.listen };
    let places = listen.iter().map(|url| Place::parse(url, framing)).collect::<Result<_, _>>()?;
    let mut plcs: Vec<SimPlc<'_>> = args.stations.iter().map(|&station| SimPlc::of_station(station)).collect();
    if plcs.is_empty() {
        plcs.push(SimPlc::of_station(setup::station_of_memory(args)?.unwrap_or(1)));
    }
    let setup = Setup::new(args, &plcs, Vec::new())?;
    Ok(SimBus { places, ..assemble(args, &setup, &plcs, 0, None)? })
}

/// A bus for each link of the PLCs that were chosen.
fn buses_of_plant(args: &SimArgs, plant: &SimulatedPlant) -> Result<Vec<SimBus>, Failure> {
    if !args.stations.is_empty() || args.framing.is_some() {
        return Err(Failure::Usage(
            "stations and framings are those of the plant: leave out --station and --framing".to_owned(),
        ));
    }
    let sections = section::sections(&plant.path, &plant.text, |name| plant.names.iter().any(|known| known == name))?;
    let plcs: Vec<SimPlc<'_>> = plant.plcs.iter().map(SimPlc::of_plant).collect();
    let setup = Setup::new(args, &plcs, sections)?;
    let (host, first_port) = host_and_port(&args.listen)?;
    let mut buses: Vec<SimBus> = Vec::new();
    let mut rest = plcs;
    while let Some(link) = rest.first().and_then(|plc| plc.tags).map(|plc| plc.endpoint().clone()) {
        let is_of_link = |plc: &SimPlc<'_>| plc.tags.is_some_and(|plc| *plc.endpoint() == link);
        let (of_link, others): (Vec<_>, Vec<_>) = rest.into_iter().partition(is_of_link);
        rest = others;
        let nth = u16::try_from(buses.len()).ok().filter(|_| first_port > 0);
        let port = if first_port == 0 { Some(0) } else { nth.and_then(|nth| first_port.checked_add(nth)) };
        let port = port.ok_or_else(|| Failure::Usage(format!("from port {first_port} on there are too few ports")))?;
        let names: Vec<&str> = of_link.iter().map(|plc| plc.label.as_str()).collect();
        let of_plant = Some((names.join(", "), link.clone()));
        let places = vec![Place::for_link(&link, &host, port)];
        let nth = u64::try_from(buses.len()).unwrap_or(u64::MAX);
        let baud = link.transport().serial_settings().map(|settings| settings.baud());
        buses.push(SimBus { of_plant, places, ..assemble(args, &setup, &of_link, nth, baud)? });
    }
    Ok(buses)
}

/// The bus of these PLCs, with its faults and its speed. `nth`: the number of the bus.
fn assemble(
    args: &SimArgs,
    setup: &Setup<'_>,
    plcs: &[SimPlc<'_>],
    nth: u64,
    baud: Option<u32>,
) -> Result<SimBus, Failure> {
    let seed = args.seed.wrapping_add(nth << 32);
    let mut bus = Bus::new();
    for plc in plcs {
        let seed = seed.wrapping_add(plc.station.into());
        bus = bus.with_station(plc.station, setup.plc(plc, seed)?).map_err(Failure::usage)?;
    }
    let faults = setup.faults(plcs)?;
    let baud = args.baud.or(baud);
    if !faults.is_empty() || baud.is_some() || args.response_time.is_some() {
        let mut line = Line::new(baud.unwrap_or(0)).half_duplex(true);
        if let Some(time) = args.response_time {
            line = line.response_time(time.min, time.max);
        }
        // Only the counts are printed.
        let rules = Faults::new(seed).log_capacity(0).journal_capacity(0).line(line);
        for (station, _, rate) in &faults {
            let rule = rate.rule();
            rules.add_rule(station.map_or(rule.clone(), |station| rule.station(station)));
        }
        bus = bus.with_faults(rules);
    }
    let faults = faults.into_iter().map(|(_, plc, rate)| (plc, rate)).collect();
    Ok(SimBus { of_plant: None, bus, faults, places: Vec::new() })
}

/// The endpoint of clients on this machine, in place of a link of a plant.
fn client_link(link: &Endpoint, server: &Listening) -> Endpoint {
    let url = server.url();
    // Always an address in a network: that is all a place for a link can be.
    let Some(address) = server.local_addr() else { return link.clone() };
    let ip = match address.ip() {
        ip if !ip.is_unspecified() => ip,
        std::net::IpAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
        std::net::IpAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
    };
    let (host, port) = (ip.to_string(), address.port());
    let endpoint = if url.starts_with("udp://") { Endpoint::udp(host, port) } else { Endpoint::tcp(host, port) };
    endpoint.with_framing(link.framing()).with_in_step(link.in_step())
}

/// Path of `--client-config`, with the original.
type Copied<'a> = (&'a Path, &'a SimulatedPlant);

/// Checks `--client-config`, before anything listens.
fn client_config<'a>(args: &'a SimArgs, plant: Option<&'a SimulatedPlant>) -> Result<Option<Copied<'a>>, Failure> {
    let (Some(path), Some(plant)) = (&args.client_config, plant) else { return Ok(None) };
    if plant.plcs.len() < plant.names.len() {
        return Err(Failure::Usage(
            "--client-config takes all PLCs of the plant: clients would reach the others themselves".to_owned(),
        ));
    }
    client_config::check(path).map_err(|error| Failure::ClientConfig { path: path.clone(), error })?;
    Ok(Some((path, plant)))
}

/// Prints how often each fault was drawn. One that is drawn has no effect if the request has no reply.
/// `plcs`: the names of the PLCs of the bus, if they are of a plant.
fn summarize(plcs: Option<&str>, counts: &Faults, faults: &[(Option<String>, FaultRate)], output: &Output) {
    let of_rule = |((plc, rate), drawn): (&(Option<String>, FaultRate), u64)| match plc {
        Some(plc) => format!("{plc}/{rate} {drawn}"),
        None => format!("{rate} {drawn}"),
    };
    let drawn = counts.rules().into_iter().map(|rule| rule.times_applied());
    let drawn: Vec<String> = faults.iter().zip(drawn).map(of_rule).collect();
    let plcs = plcs.map_or_else(String::new, |plcs| format!("{plcs}: "));
    output.remark(format_args!("{plcs}{} requests; faults drawn: {}", counts.log().arrivals(), drawn.join(", ")));
}
