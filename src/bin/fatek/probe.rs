//! Subcommand `fatek probe`.

use std::io;

use fatek::capabilities::Capabilities;
use fatek::command::Code;
use fatek::{Station, Symbol};

use crate::failure::Failure;
use crate::output::{Cell, Format, Output, Rows};
use crate::signal::unless_signalled;

pub(crate) async fn probe(station: &Station, output: &Output) -> Result<(), Failure> {
    let found = unless_signalled(station.probe()).await?.map_err(Failure::interrupted(""))??;
    if output.format == Format::Json {
        let json = serde_json::to_value(&found).map_err(|error| Failure::Output(io::Error::other(error)))?;
        return output.json(&json);
    }
    output.rows(&rows(&found))
}

fn rows(found: &Capabilities) -> Rows {
    let mut rows = Rows::new(["capability", "value"]);
    for &code in Code::ALL {
        let name = format!("{:02X} {}", u8::from(code), code.name());
        rows.push([name.into(), found.command(code).to_string().into()]);
    }
    for symbol in [Symbol::X, Symbol::Y, Symbol::M, Symbol::S] {
        let name = format!("words of {symbol}");
        rows.push([name.into(), found.words_of(symbol).to_string().replace('_', " ").into()]);
    }
    let mut push = |name: &str, value: Option<String>| {
        rows.push([name.into(), Cell::from(value.unwrap_or_else(|| "unknown".to_owned()))]);
    };
    let count = |count: Option<usize>| count.map(|count| count.to_string());
    push("registers in one request", count(found.max_registers()));
    push("discretes in one request", count(found.max_points()));
    push("units in a mixed read", count(found.max_mixed()));
    push("step of DRC in a run", found.counter_step().map(|step| step.to_string()));
    let answer = |answers: bool| if answers { "yes" } else { "no" }.to_owned();
    push("answers broadcasts", found.answers_broadcasts().map(answer));
    let time = |time: std::time::Duration| format!("{:.1} ms", time.as_secs_f64() * 1000.0);
    push("response time", found.response_time().map(time));
    rows
}
