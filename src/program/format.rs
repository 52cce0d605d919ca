//! The format of a program in a file.
//!
//! ```text
//! read 2026-11-22T07:09:13Z      time, or `-` if it is not known
//! about FB00, 13184 words, …     for people; it follows from the other fields
//! brief 005400                   bytes of 40, or `-`
//! status 00010231 …              bytes of 53, or `-`
//! pages 207                      or `321 of 513`, where the PLC refused page 321
//! page 0 4642 …                  256 digits each, in ascending order
//! ```
//!
//! A program has one form: the parsed program is written again and compared.

use super::{PAGE_BYTES, Program};
use crate::command::ProgramPage;
use crate::file::{Content, FormatError, Kind, Lines, Origin, frame, unframe};
use crate::hex;

const PROGRAM: Kind = Kind("program");

pub(super) fn write(program: &Program) -> String {
    frame(PROGRAM, &form(program))
}

pub(super) fn read(file: &[u8]) -> Result<Program, FormatError> {
    parse(unframe(PROGRAM, file)?)
}

fn form(program: &Program) -> String {
    let mut form = program.origin.lines(Some(about(program)));
    form += &match program.refused_page() {
        None => format!("pages {}\n", program.pages.len()),
        Some(_) => format!("pages {} of {}\n", program.pages.len(), program.header.page_count()),
    };
    for (number, page) in program.pages.iter().enumerate() {
        form += &format!("page {number} {}\n", hex::encode(&page.to_bytes()));
    }
    form
}

/// For people: the program, and the model of the PLC.
fn about(program: &Program) -> String {
    let Program { header, origin, .. } = program;
    let Some((brief, status)) = origin.brief.zip(origin.detailed.as_ref()) else { return header.to_string() };
    let (major, minor) = status.os_version();
    format!("{header}, from {}, main unit {}, OS {major}.{minor}", brief.capacity(), status.main_unit())
}

fn parse(content: Content<'_>) -> Result<Program, FormatError> {
    let is_known = |name: &str| Origin::FIELDS.contains(&name) || matches!(name, "pages" | "page");
    let mut lines = Lines::new(content, is_known);
    let origin = Origin::parse(&mut lines)?;
    let known = origin.read_at.is_some();
    if origin.brief.is_some() != known || origin.detailed.is_some() != known {
        return Err(lines.error("`read`, `brief` and `status` must be known together"));
    }
    let count = lines.field("pages")?;
    // The number of all pages follows from the header; the form is compared below.
    let (count, is_cut) = count.split_once(" of ").map_or((count, false), |(count, _)| (count, true));
    let count: usize = count.parse().map_err(|_| lines.error("a number of pages was expected"))?;
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
    let program = if is_cut { Program::from_plc(pages) } else { Program::from_pages(pages) };
    let program = Program { origin, ..program.map_err(FormatError::content)? };
    let unknown_fields = lines.in_form(content, &form(&program))?;
    Ok(Program { unknown_fields, ..program })
}
