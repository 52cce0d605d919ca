//! Subcommand `fatek decode HEX`.

mod explain;
mod field;
mod hex;
mod recorder;
mod reply;
mod request;
mod split;
mod text;

use serde_json::{Map, Value, json};

use self::explain::Explanation;
use self::field::Field;
use crate::args::DecodeArgs;
use crate::failure::Failure;
use crate::output::{Format, Output, Rows, complain, print};

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
        for Field { part, name, bytes, meaning } in &explanation.fields {
            rows.push([part.as_str().into(), name.as_str().into(), spaced(bytes).into(), meaning.as_str().into()]);
        }
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
    let mut object = Map::new();
    object.insert("framing".to_owned(), explanation.framing.map_or(Value::Null, |framing| framing.to_string().into()));
    object.insert("length".to_owned(), explanation.length.into());
    object.insert("good".to_owned(), explanation.faults.is_empty().into());
    object.insert("faults".to_owned(), explanation.faults.clone().into());
    object.insert("fields".to_owned(), explanation.fields.iter().map(field).collect());
    object.into()
}

fn rows(explanations: &[Explanation]) -> Rows {
    let mut rows = Rows::new(["frame", "part", "field", "bytes", "meaning"]);
    for (number, explanation) in (1_u32..).zip(explanations) {
        for Field { part, name, bytes, meaning } in &explanation.fields {
            let bytes = spaced(bytes);
            rows.push([
                number.into(),
                part.as_str().into(),
                name.as_str().into(),
                bytes.into(),
                meaning.as_str().into(),
            ]);
        }
    }
    rows
}

fn spaced(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests;
