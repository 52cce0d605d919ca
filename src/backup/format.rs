//! The format of a backup in a file: see [`Backup::to_file`].
//!
//! A backup has one form: the parsed backup is written again and compared.

use std::fmt::Write;

use super::block::part;
use super::{Backup, Missing};
use crate::command::Value;
use crate::element::{Element, Width};
use crate::error::ErrorCode;
use crate::file::{Content, FormatError, Kind, Lines, Origin, frame, optional_field, unframe};
use crate::hex;
use crate::tag::Tag;

const BACKUP: Kind = Kind("backup");

const RANGE: &str = "range";
const MISSING: &str = "missing";
const NOT_READ: &str = "not-read";
const REFUSED: &str = "refused ";

pub(super) fn write(backup: &Backup) -> String {
    frame(BACKUP, &form(backup))
}

pub(super) fn read(file: &[u8]) -> Result<Backup, FormatError> {
    parse(unframe(BACKUP, file)?)
}

fn form(backup: &Backup) -> String {
    let Backup { station, origin, blocks, .. } = backup;
    let mut lines = format!("station {}\n", optional_field(station.map(|station| station.to_string())));
    lines += &origin.lines(about(origin));
    for block in blocks {
        lines += &format!("{RANGE} {}\n", block.range);
        let mut start = 0_usize;
        // One line for missing elements of one reason; values by the line, whose multiples no line
        // crosses.
        let per_line = per_line(block.range.first().width());
        let kind = |cell: &Result<Value, Missing>| cell.err();
        for same in block.cells.chunk_by(|one, next| kind(one) == kind(next)) {
            let end = start.saturating_add(same.len());
            if let Some(&Err(reason)) = same.first() {
                let reason = match reason {
                    Missing::NotRead => NOT_READ.to_owned(),
                    Missing::Refused(error) => format!("{REFUSED}{:X}", u8::from(error)),
                };
                lines += &format!("{MISSING} {} {reason}\n", part(block.range, &(start..end)));
                start = end;
                continue;
            }
            let mut values = same;
            while !values.is_empty() {
                let room = per_line.saturating_sub(start.checked_rem(per_line).unwrap_or(0));
                let (line, rest) = values.split_at(room.min(values.len()));
                lines += &value_line(block.range.first().nth(start).unwrap_or(block.range.first()), line);
                start = start.saturating_add(line.len());
                values = rest;
            }
        }
    }
    lines
}

/// For people: the model and state of the PLC.
fn about(origin: &Origin) -> Option<String> {
    let flags = origin.brief.map(|status| status.flags().to_string());
    let unit = origin.detailed.as_ref().map(|status| {
        let (major, minor) = status.os_version();
        format!("main unit {}, OS {major}.{minor}", status.main_unit())
    });
    let known: Vec<String> = unit.into_iter().chain(flags).collect();
    (!known.is_empty()).then(|| known.join(", "))
}

fn value_line(first: Element, cells: &[Result<Value, Missing>]) -> String {
    let mut line = first.to_string();
    for (place, value) in cells.iter().flatten().enumerate() {
        // Writing to a string does not fail.
        let _ = match value {
            Value::Bit(on) if place.is_multiple_of(8) => write!(line, " {}", u8::from(*on)),
            Value::Bit(on) => write!(line, "{}", u8::from(*on)),
            Value::Word(word) => write!(line, " {word:04X}"),
            Value::DWord(double) => write!(line, " {double:08X}"),
        };
    }
    line + "\n"
}

fn per_line(width: Width) -> usize {
    if width == Width::Bit { 64 } else { 8 }
}

/// Returns whether this version has such a field. Names of elements have upper-case letters, and
/// names of fields do not.
fn is_known(name: &str) -> bool {
    let is_field = matches!(name, "station" | RANGE | MISSING);
    is_field || Origin::FIELDS.contains(&name) || name.starts_with(|first: char| first.is_ascii_uppercase())
}

fn parse(content: Content<'_>) -> Result<Backup, FormatError> {
    let mut lines = Lines::new(content, is_known);
    let station = lines.optional("station", "a number from 1 to 254", |text| {
        text.parse().ok().filter(|number| (1..=254).contains(number))
    })?;
    let origin = Origin::parse(&mut lines)?;
    let mut backup = Backup { station, origin, ..empty(content)? };
    for block in &mut backup.blocks {
        let range = lines.field(RANGE)?;
        if range != block.range.to_string() {
            return Err(lines.error(format!("`{RANGE} {}` was expected", block.range)));
        }
        let mut index = 0_usize;
        while let Ok(next) = block.range.first().nth(index)
            && index < block.cells.len()
        {
            let ended = format!("the range {} is not whole: {next} was expected", block.range);
            let Some((name, text)) = lines.any_field()? else { return Err(lines.error(ended)) };
            let cells = match name {
                MISSING => missing(text, next, block.range)
                    .ok_or_else(|| format!("elements from {next} on, and why they are missing, were expected")),
                RANGE => Err(ended),
                _ if name == next.to_string() => values(text, next.width()).ok_or_else(|| {
                    "values as wide as the element, in the digits that backups have, were expected".to_owned()
                }),
                _ => Err(format!("`{next}` was expected, or `{MISSING} {next}`")),
            };
            let cells = cells.map_err(|rule| lines.error(rule))?;
            if !cells.len().is_multiple_of(block.range.elements_per_value()) {
                return Err(lines.error("a value of several registers would be cut in two here"));
            }
            let end = index.saturating_add(cells.len());
            let Some(known) = block.cells.get_mut(index..end) else {
                return Err(lines.error(format!("these are more elements than the range {} has", block.range)));
            };
            known.copy_from_slice(&cells);
            index = end;
        }
    }
    lines.end()?;
    backup.unknown_fields = lines.in_form(content, &form(&backup))?;
    Ok(backup)
}

/// A backup of the ranges in the content, without values. Ranges that do not overlap have a bounded
/// number of elements, so this is checked before memory is allocated for them.
fn empty(content: Content<'_>) -> Result<Backup, FormatError> {
    let (mut ranges, mut lines): (Vec<Tag>, _) = (Vec::new(), Lines::new(content, is_known));
    while let Some((name, text)) = lines.any_field()? {
        if name == RANGE {
            ranges.push(text.parse().map_err(|error| lines.error(format!("{error}")))?);
        }
    }
    Backup::of(ranges).map_err(|error| lines.error(format!("{error}")))
}

/// Cells of the missing elements from `next` on.
fn missing(text: &str, next: Element, range: Tag) -> Option<Vec<Result<Value, Missing>>> {
    let (elements, reason) = text.split_once(' ')?;
    let elements: Tag = elements.parse().ok()?;
    let reason = match reason.strip_prefix(REFUSED) {
        Some(code) => Missing::Refused(ErrorCode::from_u8(u8::from_str_radix(code, 16).ok()?)?),
        None if reason == NOT_READ => Missing::NotRead,
        None => return None,
    };
    let within = elements.first() == next && elements.element_count() <= range.element_count();
    within.then(|| vec![Err(reason); elements.element_count()])
}

fn values(text: &str, width: Width) -> Option<Vec<Result<Value, Missing>>> {
    if width == Width::Bit {
        let bits = text.bytes().filter(|&byte| byte != b' ').map(|byte| match byte {
            b'0' => Some(Ok(Value::Bit(false))),
            b'1' => Some(Ok(Value::Bit(true))),
            _ => None,
        });
        return bits.collect::<Option<Vec<_>>>().filter(|bits| !bits.is_empty());
    }
    let value = |digits: &str| {
        let bytes = hex::decode(digits)?;
        Some(Ok(match width {
            Width::DWord => Value::DWord(u32::from_be_bytes(bytes.try_into().ok()?)),
            Width::Word | Width::Bit => Value::Word(u16::from_be_bytes(bytes.try_into().ok()?)),
        }))
    };
    text.split(' ').map(value).collect()
}
