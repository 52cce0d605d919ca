//! Subcommand `fatek plan TAG…`.

use std::time::Duration;

use fatek::endpoint::{InStepSettings, SerialSettings};
use fatek::plant::PlantPlc;
use fatek::wire::Framing;
use fatek::{CostModel, Limits, MemoryMap, Plan};
use serde_json::Value;

use crate::args::{PlanArgs, Plc};
use crate::connect;
use crate::failure::Failure;
use crate::output::{Cell, Format, Output, Rows, print};

/// Time per request besides its bytes, where it is not known.
const DEFAULT_ROUND_TRIP: Duration = Duration::from_millis(5);

pub(crate) fn plan(plc: &Plc, args: &PlanArgs, chosen: Option<&PlantPlc>, output: &Output) -> Result<(), Failure> {
    let known = plc.capabilities.as_deref().map(connect::capabilities).transpose()?.unwrap_or_default();
    let cost = cost(plc.link()?, known.response_time(), args)?;
    let builder = Plan::builder(cost).limits(limits(args)?.within(&known));
    let table = args.table.load(chosen)?;
    table.remark_overlaps(&args.tags, output);
    let tags = table.tags(&args.tags)?;
    let tags = tags.iter().map(|named| named.tag);
    let builder = if args.one_scan { builder.one_scan(tags) } else { builder.tags(tags) };
    let plan = builder.build().map_err(Failure::usage)?;
    match output.format {
        Format::Table => print(format_args!("{}", plan.explain())),
        Format::Json => output.json(&json(&plan)),
        Format::Csv => output.rows(&rows(&plan)),
    }
}

/// Cost model of the link, or of a network, with the settings of the options.
fn cost(link: Option<&str>, response_time: Option<Duration>, args: &PlanArgs) -> Result<CostModel, Failure> {
    let endpoint = link.map(|link| connect::endpoint(Some(link))).transpose()?;
    let link_framing = endpoint.as_ref().map_or(Framing::Ascii, |endpoint| endpoint.framing());
    let framing = args.framing.unwrap_or(link_framing);
    let in_step = endpoint.as_ref().map_or_else(InStepSettings::new, |endpoint| endpoint.in_step());
    let settings = endpoint.and_then(|endpoint| endpoint.transport().serial_settings());
    let settings = match args.baud {
        Some(baud) => {
            let settings = settings.unwrap_or(SerialSettings::new(framing));
            Some(settings.with_baud(baud).map_err(|error| Failure::Usage(format!("--baud {baud}: {error}")))?)
        }
        None => settings,
    };
    let round_trip = args.round_trip.or(response_time).unwrap_or(DEFAULT_ROUND_TRIP);
    let cost = match settings {
        Some(settings) => CostModel::serial(settings, framing).with_response_time(round_trip),
        None => CostModel::network(framing, round_trip),
    };
    Ok(cost.with_in_step(in_step))
}

fn limits(args: &PlanArgs) -> Result<Limits, Failure> {
    let mut limits = args.model.map_or_else(Limits::new, |model| MemoryMap::of(model).limits());
    if let Some(registers) = args.max_registers {
        limits = limits.max_registers(registers).map_err(Failure::usage)?;
    }
    if let Some(points) = args.max_points {
        limits = limits.max_points(points).map_err(Failure::usage)?;
    }
    if let Some(units) = args.max_mixed {
        limits = limits.max_mixed(units).map_err(Failure::usage)?;
    }
    limits = limits.mixed_reads(!args.no_mixed).words_of_discretes(!args.no_words);
    for range in &args.readable {
        if range.is_bits_of_register() {
            return Err(Failure::Usage(format!("--readable {range}: a range has whole registers, or discretes")));
        }
        let last = range.elements().last().unwrap_or(range.first());
        limits = limits.readable(range.first(), last).map_err(Failure::usage)?;
    }
    Ok(limits)
}

fn rows(plan: &Plan) -> Rows {
    let mut tags: Vec<Vec<String>> = vec![Vec::new(); plan.requests().len()];
    for (n, tag) in plan.tags().iter().enumerate() {
        for request in plan.requests_of(n) {
            tags[request].push(tag.to_string());
        }
    }
    let mut rows = Rows::new(["request", "values", "bytes", "time_ms", "reads", "tags"]);
    for ((number, planned), tags) in (1_usize..).zip(plan.requests()).zip(tags) {
        rows.push([
            number.into(),
            planned.value_count().into(),
            planned.bytes().into(),
            planned.time().into(),
            planned.request().to_string().into(),
            Cell { text: tags.join(" "), json: tags.into() },
        ]);
    }
    rows
}

fn json(plan: &Plan) -> Value {
    let values: usize = plan.requests().iter().map(|planned| planned.value_count()).sum();
    let sums = [
        ("requests", rows(plan).json()),
        ("values", values.into()),
        ("bytes", plan.bytes().into()),
        ("proofs_ms", Cell::from(plan.proof_time()).json),
        ("time_ms", Cell::from(plan.time()).json),
    ];
    sums.into_iter().collect()
}
