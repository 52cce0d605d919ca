//! Subcommand `fatek decode HEX`.

mod explain;
mod field;
mod hex;
mod recorder;
mod reply;
mod split;
mod text;

use serde_json::{Value, json};

use self::explain::Explanation;
use self::field::Field;
use crate::args::DecodeArgs;
use crate::failure::Failure;
use crate::output::{Cell, Format, Output, Rows, complain, print};

pub(crate) fn decode(args: &DecodeArgs, output: &Output) -> Result<(), Failure> {
    let bytes = hex::parse(&args.hex.join(" ")).map_err(Failure::usage)?;
    let explanations: Vec<Explanation> =
        split::pieces(&bytes, args.framing).into_iter().map(|piece| explain::explain(&piece)).collect();
    match output.format {
        Format::Table => print_tables(&explanations)?,
        Format::Json => output.json(&explanations.iter().map(json).collect())?,
        Format::Csv => output.rows(&rows(&explanations))?,
    }
    let bad: Vec<&Explanation> = explanations.iter().filter(|explanation| !explanation.faults.is_empty()).collect();
    for fault in bad.iter().flat_map(|explanation| &explanation.faults) {
        complain(format_args!("fault: {fault}"));
    }
    match bad.len() {
        0 => Ok(()),
        bad => Err(Failure::BadFrames { bad, all: explanations.len() }),
    }
}

fn print_tables(explanations: &[Explanation]) -> Result<(), Failure> {
    for (i, explanation) in explanations.iter().enumerate() {
        let mut rows = Rows::new(["part", "field", "bytes", "meaning"]);
        explanation.fields.iter().for_each(|field| rows.push(cells(field)));
        let gap = if i > 0 { "\n" } else { "" };
        print(format_args!("{gap}{}\n\n{}", explanation.title(), rows.table()))?;
    }
    Ok(())
}

fn json(explanation: &Explanation) -> Value {
    let field = |Field { part, name, bytes, meaning }: &Field| {
        let bytes = spaced(bytes);
        json!({ "part": part.as_str(), "field": name, "bytes": bytes, "meaning": meaning })
    };
    let Explanation { framing, length, fields, faults } = explanation;
    json!({
        "framing": framing.map(|framing| framing.to_string()),
        "length": length,
        "good": faults.is_empty(),
        "faults": faults,
        "fields": fields.iter().map(field).collect::<Value>(),
    })
}

fn rows(explanations: &[Explanation]) -> Rows {
    let mut rows = Rows::new(["frame", "part", "field", "bytes", "meaning"]);
    for (number, explanation) in (1_u32..).zip(explanations) {
        for field in &explanation.fields {
            let [part, name, bytes, meaning] = cells(field);
            rows.push([number.into(), part, name, bytes, meaning]);
        }
    }
    rows
}

fn cells(Field { part, name, bytes, meaning }: &Field) -> [Cell; 4] {
    [part.as_str().into(), name.as_str().into(), spaced(bytes).into(), meaning.as_str().into()]
}

fn spaced(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests;
