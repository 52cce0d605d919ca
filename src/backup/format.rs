//! How a backup stands in a file: see [`Backup::to_file`].
//!
//! One backup has one form. What has been read is written again and compared, so that nothing is taken that was written
//! otherwise.

use std::fmt::Write;

use super::block::part;
use super::{Backup, Missing, Origin};
use crate::command::{BriefStatus, DetailedStatus, Value};
use crate::element::{Element, Width};
use crate::error::ErrorCode;
use crate::file::{FormatError, Kind, Lines, frame, in_form, parse_utc, unframe, utc};
use crate::hex;
use crate::tag::Tag;

const BACKUP: Kind = Kind("backup");

/// What stands for a value that is not known.
const UNKNOWN: &str = "-";
const RANGE: &str = "range";
const MISSING: &str = "missing";
const NOT_READ: &str = "not-read";
const REFUSED: &str = "refused ";

pub(super) fn write(backup: &Backup) -> String {
    frame(BACKUP, &content(backup))
}

pub(super) fn read(file: &[u8]) -> Result<Backup, FormatError> {
    let text = unframe(BACKUP, file)?;
    let backup = parse(text)?;
    in_form(text, &content(&backup))?;
    Ok(backup)
}

fn content(backup: &Backup) -> String {
    let Backup { origin, blocks } = backup;
    let field = |value: Option<String>| value.unwrap_or_else(|| UNKNOWN.to_owned());
    let mut lines = format!(
        "station {}\nread {}\nabout {}\nbrief {}\nstatus {}\n",
        field(origin.station.map(|station| station.to_string())),
        field(origin.read_at.map(utc)),
        field(about(origin)),
        field(origin.brief.map(|status| hex::encode(&status.raw()))),
        field(origin.detailed.as_ref().map(|status| hex::encode(status.raw()))),
    );
    for block in blocks {
        lines += &format!("{RANGE} {}\n", block.range);
        let mut start = 0_usize;
        // What is of one kind, and there of as much as goes into a line: no line crosses a multiple of that.
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

/// What the bytes of the statuses mean, for people.
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
        // Into a String nothing can fail.
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

fn parse(content: &str) -> Result<Backup, FormatError> {
    let mut lines = Lines::new(content);
    let station = field(&mut lines, "station", "a number from 1 to 254", |text| {
        text.parse().ok().filter(|number| (1..=254).contains(number))
    })?;
    let read_at = field(&mut lines, "read", "a time such as 2026-11-22T07:09:13Z", parse_utc)?;
    // It follows from the others, so it is compared in the end.
    lines.field("about")?;
    let brief = field(&mut lines, "brief", "three bytes in hexadecimal digits", |text| {
        Some(BriefStatus::from_raw(hex::decode(text)?.try_into().ok()?))
    })?;
    let detailed = field(&mut lines, "status", "28 to 249 bytes in hexadecimal digits", |text| {
        DetailedStatus::from_raw(hex::decode(text)?)
    })?;
    let origin = Origin { station, read_at, brief, detailed };
    let mut backup = Backup { blocks: empty(content)?.blocks, origin };
    for block in &mut backup.blocks {
        let range = lines.field(RANGE)?;
        if range != block.range.to_string() {
            return Err(lines.error(format!("`{RANGE} {}` was expected", block.range)));
        }
        let mut place = 0_usize;
        while let Ok(next) = block.range.first().nth(place)
            && place < block.cells.len()
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
                return Err(lines.error("a value of two registers would be cut in two here"));
            }
            let end = place.saturating_add(cells.len());
            let Some(places) = block.cells.get_mut(place..end) else {
                return Err(lines.error(format!("these are more elements than the range {} has", block.range)));
            };
            places.copy_from_slice(&cells);
            place = end;
        }
    }
    lines.end()?;
    Ok(backup)
}

/// A backup of all the ranges that the content names, before anything is kept for their elements: that they do not overlap is
/// what bounds their number.
fn empty(content: &str) -> Result<Backup, FormatError> {
    let (mut ranges, mut lines): (Vec<Tag>, _) = (Vec::new(), Lines::new(content));
    while let Some((name, text)) = lines.any_field()? {
        if name == RANGE {
            ranges.push(text.parse().map_err(|error| lines.error(format!("{error}")))?);
        }
    }
    Backup::of(ranges).map_err(|error| lines.error(format!("{error}")))
}

fn field<T>(
    lines: &mut Lines<'_>,
    name: &str,
    rule: &str,
    parse: impl FnOnce(&str) -> Option<T>,
) -> Result<Option<T>, FormatError> {
    let text = lines.field(name)?;
    if text == UNKNOWN {
        return Ok(None);
    }
    parse(text).map(Some).ok_or_else(|| lines.error(format!("`{name}`: {rule} was expected, or `{UNKNOWN}`")))
}

/// As many cells as the elements from `next` on that this names.
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
            _ => Value::Word(u16::from_be_bytes(bytes.try_into().ok()?)),
        }))
    };
    text.split(' ').map(value).collect()
}
