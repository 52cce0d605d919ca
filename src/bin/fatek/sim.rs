//! Subcommand `fatek sim`.

use fatek::sim::{Bus, Model, Plc, Server};

use crate::args::SimArgs;
use crate::failure::Failure;
use crate::output::print;
use crate::printable::excerpt;
use crate::signal;

pub(crate) async fn sim(args: &SimArgs) -> Result<(), Failure> {
    let bus = bus(args)?;
    let address = address(&args.listen)?;
    let stopped = signal::stopped().map_err(Failure::Runtime)?;
    let listen = |error| Failure::Listen { url: args.listen.clone(), error };
    let server = Server::bind(address, bus, args.framing).await.map_err(listen)?;
    print(format_args!("listening tcp://{}", server.local_addr()))?;
    stopped.await.map_err(Failure::Runtime)?;
    server.shutdown().await;
    Ok(())
}

/// Bus with one PLC per `--station`, each with the values of `--set`.
fn bus(args: &SimArgs) -> Result<Bus, Failure> {
    let mut bus = Bus::new();
    for &station in &args.stations {
        let plc = Plc::with_model(model(args));
        for assignment in &args.assignments {
            for (element, value) in assignment.tag().elements().zip(assignment.encode()) {
                plc.write(element, value)
                    .map_err(|error| Failure::Usage(format!("--set {}: {error}", excerpt(&assignment.to_string()))))?;
            }
        }
        bus = bus.with_station(station, plc).map_err(Failure::usage)?;
    }
    Ok(bus)
}

fn model(args: &SimArgs) -> Model {
    let model = args.last.iter().fold(Model::default(), |model, &element| model.last(element));
    match args.ladder_words {
        Some(words) => model.ladder_words(words),
        None => model,
    }
}

/// Returns `HOST:PORT` of `tcp://HOST:PORT`.
fn address(url: &str) -> Result<&str, Failure> {
    let rule = |rule: &str| Failure::Usage(format!("cannot listen on `{}`: {rule}", excerpt(url)));
    let address = url.strip_prefix("tcp://").ok_or_else(|| rule("it must begin with `tcp://`"))?;
    if address.contains('?') {
        return Err(rule("it takes no options; for the framing give --framing"));
    }
    let address = address.strip_suffix('/').unwrap_or(address);
    match address.rsplit_once(':') {
        Some((host, port)) if !host.is_empty() && port.parse::<u16>().is_ok() => Ok(address),
        _ => Err(rule("it must have a host and a port from 0 to 65535, as in `tcp://127.0.0.1:0`")),
    }
}
