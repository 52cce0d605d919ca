//! Subcommand `fatek status`.

use fatek::command::{BriefStatus, DetailedStatus};
use fatek::{Error, Station};
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::output::{Cell, Format, Output, Rows, hex, version};

pub(crate) async fn status(station: &Station, output: &Output) -> Result<(), Failure> {
    let brief = station.read_status().await?;
    let detailed = station.read_detailed_status().await;
    print(&brief_fields(&brief), detailed.as_ref().ok().map(detailed_fields).as_deref(), output)?;
    match detailed {
        Ok(_) => Ok(()),
        // Some models have no detailed status.
        Err(error @ Error::Plc { .. }) => {
            output.remark(format_args!("no detailed status: {error}"));
            Ok(())
        }
        Err(error) => Err(error.into()),
    }
}

type Field = (&'static str, Cell);

fn brief_fields(status: &BriefStatus) -> Vec<Field> {
    let flags = status.flags();
    vec![
        ("running", flags.running().into()),
        ("battery_low", flags.battery_low().into()),
        ("ladder_checksum_error", flags.ladder_checksum_error().into()),
        ("memory_card", flags.memory_card().into()),
        ("watchdog_timeout", flags.watchdog_timeout().into()),
        ("id_set", flags.id_set().into()),
        ("emergency_stop", flags.emergency_stop().into()),
        ("program_capacity", status.capacity().to_string().into()),
        ("raw", hex(&status.raw()).into()),
    ]
}

fn detailed_fields(status: &DetailedStatus) -> Vec<Field> {
    vec![
        ("main_unit", status.main_unit().to_string().into()),
        ("io_points_code", status.io_points_code().into()),
        ("os_version", version(status.os_version()).into()),
        ("ladder_words", status.ladder_words().into()),
        ("discrete_inputs", status.discrete_inputs().into()),
        ("discrete_outputs", status.discrete_outputs().into()),
        ("analog_inputs", status.analog_inputs().into()),
        ("analog_outputs", status.analog_outputs().into()),
        ("m_relays", status.m_relays().into()),
        ("s_relays", status.s_relays().into()),
        ("l_relays", status.l_relays().into()),
        ("r_registers", status.r_registers().into()),
        ("d_registers", status.d_registers().into()),
        ("timers", status.timers().into()),
        ("counters", status.counters().into()),
        ("raw", hex(status.raw()).into()),
    ]
}

/// Prints JSON as an object with `brief` and `detailed`, which is null if the PLC has none. Other
/// formats are rows.
fn print(brief: &[Field], detailed: Option<&[Field]>, output: &Output) -> Result<(), Failure> {
    if output.format == Format::Json {
        return output.json(&json!({ "brief": object(brief), "detailed": detailed.map(object) }));
    }
    let mut rows = Rows::new(["status", "field", "value"]);
    let fields = brief.iter().map(|field| ("brief", field));
    let fields = fields.chain(detailed.unwrap_or_default().iter().map(|field| ("detailed", field)));
    for (status, (name, cell)) in fields {
        rows.push([status.into(), (*name).into(), cell.clone()]);
    }
    output.rows(&rows)
}

fn object(fields: &[Field]) -> Value {
    fields.iter().map(|(name, cell)| (*name, cell.json.clone())).collect()
}
