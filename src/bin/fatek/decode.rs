//! Subcommand `fatek decode`: frames of a text or of bytes field by field, conversations exchange by
//! exchange.

mod conversation;
mod dump;
mod explain;
mod field;
mod hex;
mod recorder;
mod reply;
mod row;
mod shapes;
mod split;
mod text;

use serde_json::{Value, json};

use self::conversation::Printer;
use self::explain::Explanation;
use self::field::Field;
use self::split::Piece;
use crate::args::DecodeArgs;
use crate::conversation::Analysis;
use crate::failure::Failure;
use crate::output::{Cell, Format, Output, Rows, complain, print};
use crate::printable::excerpt;
use crate::signal::Stop;
use crate::traffic::{Source, SourceKind, is_log, is_text, payload, stdin_is_piped};

pub(crate) fn decode(args: &DecodeArgs, output: &Output) -> Result<(), Failure> {
    if args.fields && output.is_for_programs() {
        return Err(Failure::Usage(
            "--fields is for tables: the other formats have the bytes of each frame".to_owned(),
        ));
    }
    let mut source = match (&args.file, &args.hex[..]) {
        (Some(file), _) => Source::open(file)?,
        (None, [dash]) if dash == "-" => Source::stdin(),
        (None, []) if stdin_is_piped() => Source::stdin(),
        (None, []) => {
            return Err(Failure::Usage("no bytes: give HEX, --file FILE, or - for the standard input".to_owned()));
        }
        (None, hex) => return text(&shapes::join(hex), args, output),
    };
    let kind = source.kind()?;
    if kind != SourceKind::Other {
        return conversation(&mut source, kind, args, output);
    }
    let content = source.read_all()?;
    if !is_text(&content) {
        return frames(&[content], args, output);
    }
    text(&String::from_utf8_lossy(&content), args, output)
}

fn text(text: &str, args: &DecodeArgs, output: &Output) -> Result<(), Failure> {
    if is_log(text) {
        let mut source = Source::of_bytes("the log", text.as_bytes().to_vec());
        return conversation(&mut source, SourceKind::Log, args, output);
    }
    frames(&shapes::parse(text).map_err(Failure::usage)?, args, output)
}

/// Prints the entries of a conversation as soon as they are complete. After a damaged part of the
/// source, those before it are printed, too.
fn conversation(source: &mut Source, kind: SourceKind, args: &DecodeArgs, output: &Output) -> Result<(), Failure> {
    // At Ctrl-C the program that writes to the standard input ends, too, and the rest is printed.
    if source.is_stdin() {
        Stop::new()?;
    }
    let mut analysis = Analysis::new(args.framing.or(kind.framing()));
    let mut printer = Printer::new(output, args.fields);
    let mut entries = Vec::new();
    let read = source.read(kind, &args.ports, &mut |event| {
        printer.event(&event);
        analysis.push(event, &mut entries);
        entries.drain(..).try_for_each(|entry| printer.entry(&entry))
    });
    let read = match read {
        Err(failure @ Failure::Output(_)) => return Err(failure),
        read => read,
    };
    analysis.finish(&mut entries);
    entries.iter().try_for_each(|entry| printer.entry(entry))?;
    for remark in read.iter().flatten() {
        complain(format_args!("warning: {}: {}", source.name, excerpt(remark)));
    }
    let decoded = printer.finish();
    read.and(decoded)
}

/// Explains the frames of strings of bytes field by field. Of a whole packet, which begins with no
/// frame, it takes the payload.
fn frames(strings: &[Vec<u8>], args: &DecodeArgs, output: &Output) -> Result<(), Failure> {
    let begins_with_frame = |bytes: &[u8]| !matches!(split::pieces(bytes, args.framing)[..], [Piece::Noise(_), ..]);
    let mut headers = 0;
    let mut pieces = Vec::new();
    for bytes in strings {
        let is_payload = |payload: &&[u8]| {
            // Of several packets, some acknowledge only.
            let is_good = if payload.is_empty() { strings.len() > 1 } else { begins_with_frame(payload) };
            is_good && !begins_with_frame(bytes)
        };
        let payload = payload(bytes).filter(is_payload).unwrap_or(bytes);
        headers += bytes.len() - payload.len();
        pieces.extend(split::pieces(payload, args.framing));
    }
    if headers > 0 {
        let packets = if strings.len() > 1 { "packets around their payloads" } else { "a packet around its payload" };
        output.remark(format_args!("{headers} bytes of {packets} are left out"));
    }
    let explanations: Vec<Explanation> = pieces.iter().map(explain::explain).collect();
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
