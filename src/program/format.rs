//! A program in a file.
//!
//! ```text
//! read 2026-11-22T07:09:13Z      when, or `-` if that is not known
//! about FB00, 13184 words, …     for people; it follows from the rest
//! brief 005400                   the bytes of 40, or `-`
//! status 00010231 …              the bytes of 53, or `-`
//! pages 207
//! page 0 4642 …                  256 digits each, in ascending order
//! ```
//!
//! One program has one form. What has been read is written again and compared, so that nothing is taken that was written
//! otherwise.

use std::fmt::Write;

use super::{Origin, PAGE_BYTES, Program};
use crate::command::{BriefStatus, DetailedStatus, ProgramPage};
use crate::file::{FormatError, Kind, Lines, frame, in_form, parse_utc, unframe, utc};
use crate::hex;

const PROGRAM: Kind = Kind("program");
/// What stands for a value that is not known.
const UNKNOWN: &str = "-";

pub(super) fn write(program: &Program) -> String {
    frame(PROGRAM, &content(program))
}

pub(super) fn read(file: &[u8]) -> Result<Program, FormatError> {
    let text = unframe(PROGRAM, file)?;
    let program = parse(text)?;
    in_form(text, &content(&program))?;
    Ok(program)
}

fn content(program: &Program) -> String {
    let origin = program.origin.as_ref();
    let field = |value: Option<String>| value.unwrap_or_else(|| UNKNOWN.to_owned());
    let mut content = String::new();
    push(&mut content, "read", &field(origin.map(|origin| utc(origin.read_at))));
    push(&mut content, "about", &about(program));
    push(&mut content, "brief", &field(origin.map(|origin| hex::encode(&origin.brief.raw()))));
    push(&mut content, "status", &field(origin.map(|origin| hex::encode(origin.status.raw()))));
    push(&mut content, "pages", &program.pages.len().to_string());
    for (number, page) in program.pages.iter().enumerate() {
        push(&mut content, "page", &format!("{number} {}", hex::encode(&page.to_bytes())));
    }
    content
}

fn parse(content: &str) -> Result<Program, FormatError> {
    let mut lines = Lines::new(content);
    let origin = read_origin(&mut lines)?;
    let count: usize = lines.field("pages")?.parse().map_err(|_| lines.error("a number of pages was expected"))?;
    let mut pages = Vec::new();
    for expected in 0..count {
        let (number, digits) = lines.field("page")?.split_once(' ').unwrap_or_default();
        if number != expected.to_string() {
            return Err(lines.error(format!("page {expected} was expected")));
        }
        let bytes: Option<[u8; PAGE_BYTES]> = hex::decode(digits).and_then(|bytes| bytes.try_into().ok());
        let bytes = bytes.ok_or_else(|| lines.error(format!("{} hexadecimal digits were expected", 2 * PAGE_BYTES)))?;
        pages.push(ProgramPage::from_bytes(&bytes));
    }
    lines.end()?;
    let program = Program::from_pages(pages).map_err(|error| FormatError::Content { rule: error.to_string() })?;
    Ok(Program { origin, ..program })
}

/// All of it is known, or none.
fn read_origin(lines: &mut Lines<'_>) -> Result<Option<Origin>, FormatError> {
    let read_at = known(lines.field("read")?);
    let read_at = read_at.map(|text| parse_utc(text).ok_or_else(|| lines.error("a time was expected"))).transpose()?;
    // It follows from the others, so it is compared in the end.
    lines.field("about")?;
    let brief = known(lines.field("brief")?);
    let brief =
        brief.map(|text| parse_brief(text).ok_or_else(|| lines.error("three bytes were expected"))).transpose()?;
    let status = known(lines.field("status")?);
    let parse = |text| hex::decode(text).and_then(DetailedStatus::from_raw);
    let status =
        status.map(|text| parse(text).ok_or_else(|| lines.error("28 to 249 bytes were expected"))).transpose()?;
    match (read_at, brief, status) {
        (Some(read_at), Some(brief), Some(status)) => Ok(Some(Origin { brief, status, read_at })),
        (None, None, None) => Ok(None),
        _ => Err(lines.error("`read`, `brief` and `status` must be known together")),
    }
}

fn parse_brief(text: &str) -> Option<BriefStatus> {
    hex::decode(text)?.try_into().ok().map(BriefStatus::from_raw)
}

fn known(value: &str) -> Option<&str> {
    (value != UNKNOWN).then_some(value)
}

fn push(content: &mut String, name: &str, value: &str) {
    // Writing to a string does not fail.
    let _ = writeln!(content, "{name} {value}");
}

/// What a person wants to know: the program, and the model of the PLC.
fn about(program: &Program) -> String {
    let header = program.header;
    program.origin.as_ref().map_or_else(
        || header.to_string(),
        |Origin { brief, status, .. }| {
            let (major, minor) = status.os_version();
            format!("{header}, from {}, main unit {}, OS {major}.{minor}", brief.capacity(), status.main_unit())
        },
    )
}
