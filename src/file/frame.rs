use crc::{CRC_32_ISO_HDLC, Crc};

use super::FormatError;
use crate::hex;

/// The kind of content of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Kind(pub(crate) &'static str);

/// The content of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Content<'a> {
    pub(crate) text: &'a str,
    /// The minor version of the file. A newer one may have unknown fields, an older one lacks those of
    /// [`ADDED`] that are newer.
    pub(crate) minor: usize,
}

const MAGIC: &str = "fatek file ";
/// The version of files that are written: see [the module](super#versions).
const MAJOR: u32 = 1;
pub(crate) const MINOR: usize = newest(ADDED);

/// A field that was added to a content, and the minor version that has it first.
pub(crate) type AddedField = (&'static str, usize);

/// The fields added since version 1.0, read by [`Lines::optional`](super::Lines::optional): their value
/// is not known in an older file. A row here is a new minor version.
pub(crate) const ADDED: &[AddedField] = &[];

const fn newest(added: &[AddedField]) -> usize {
    match added.split_last() {
        Some(((_, minor), rest)) if *minor > newest(rest) => *minor,
        Some((_, rest)) => newest(rest),
        None => 0,
    }
}

const LENGTH: &str = "length";
const CHECKSUM: &str = "crc32";
/// `crc32 1A2B3C4D` and a line feed.
const LAST_LINE: usize = CHECKSUM.len() + 1 + 8 + 1;
/// More digits than the length of any file, or its version, has.
const MAX_DIGITS: usize = 9;

/// A file with this content, which consists of lines.
pub(crate) fn frame(kind: Kind, content: &str) -> String {
    let mut file = format!("{MAGIC}{}: {}\n{LENGTH} {}\n{content}", version(), kind.0, content.len());
    let checksum = crc32(file.as_bytes());
    file += &format!("{CHECKSUM} {checksum:08X}\n");
    file
}

fn version() -> String {
    if MINOR == 0 { MAJOR.to_string() } else { format!("{MAJOR}.{MINOR}") }
}

/// Major and minor version; a minor version of 0 is not written.
fn parse_version(text: &str) -> Option<(usize, usize)> {
    match text.split_once('.') {
        None => Some((decimal(text)?, 0)),
        Some((major, minor)) => Some((decimal(major)?, decimal(minor).filter(|&minor| minor > 0)?)),
    }
}

/// The content of a file of this kind.
pub(crate) fn unframe(kind: Kind, file: &[u8]) -> Result<Content<'_>, FormatError> {
    let rest = file.strip_prefix(MAGIC.as_bytes()).ok_or(FormatError::Foreign)?;
    let (first, rest) = line(rest).ok_or_else(|| cut_off_at_least(file))?;
    if first.ends_with('\r') {
        let rule = "lines end with CR LF instead of a line feed: the file was converted";
        return Err(FormatError::line(1, rule));
    }
    let unframed = || FormatError::line(1, format!("`{MAGIC}VERSION: KIND` was expected"));
    let (version, found) = first.split_once(": ").ok_or_else(unframed)?;
    let (major, minor) = parse_version(version).ok_or_else(unframed)?;
    if !u32::try_from(major).is_ok_and(|major| major == MAJOR) {
        return Err(FormatError::Version { found: version.to_owned(), known: MAJOR });
    }
    if found != kind.0 {
        return Err(FormatError::Kind { found: found.to_owned(), expected: kind.0 });
    }
    let (second, rest) = line(rest).ok_or_else(|| cut_off_at_least(file))?;
    let unmeasured = || FormatError::line(2, format!("`{LENGTH}` and a number were expected"));
    let length =
        second.strip_prefix(LENGTH).and_then(|value| decimal(value.strip_prefix(' ')?)).ok_or_else(unmeasured)?;
    // The rest is a part of the file, and the length has at most nine digits.
    let head = file.len().saturating_sub(rest.len());
    let expected = length.saturating_add(head).saturating_add(LAST_LINE);
    let (expected_len, found_len) = (wide(expected), wide(file.len()));
    if file.len() < expected {
        return Err(FormatError::CutOff { expected: expected_len, found: found_len });
    }
    if file.len() > expected {
        return Err(FormatError::TooLong { expected: expected_len, found: found_len });
    }
    let (sealed, seal) = file.split_at(file.len().saturating_sub(LAST_LINE));
    let last = |content: &[u8]| content.iter().filter(|&&byte| byte == b'\n').count().saturating_add(1);
    let stated = checksum(seal).ok_or_else(|| {
        FormatError::line(last(sealed), format!("`{CHECKSUM}` and eight hexadecimal digits were expected"))
    })?;
    let computed = crc32(sealed);
    if stated != computed {
        return Err(FormatError::Checksum { stated, computed });
    }
    let (content, _) = rest.split_at_checked(length).unwrap_or((rest, &[]));
    let text = std::str::from_utf8(content).map_err(|_| FormatError::line(3, "the content is not UTF-8"))?;
    Ok(Content { text, minor })
}

/// The first line, without its line feed, and what follows.
fn line(bytes: &[u8]) -> Option<(&str, &[u8])> {
    let end = bytes.iter().position(|&byte| byte == b'\n')?;
    let (line, rest) = bytes.split_at_checked(end)?;
    Some((std::str::from_utf8(line).ok()?, rest.strip_prefix(b"\n")?))
}

/// The file ends, or is damaged, before it states its length.
fn cut_off_at_least(file: &[u8]) -> FormatError {
    let lines = file.iter().filter(|&&byte| byte == b'\n').count();
    FormatError::line(lines.min(1).saturating_add(1), "the file is cut off or damaged here")
}

fn decimal(text: &str) -> Option<usize> {
    let plain = (1..=MAX_DIGITS).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_digit());
    // A number has one form.
    (plain && (text == "0" || !text.starts_with('0'))).then(|| text.parse().ok()).flatten()
}

fn checksum(seal: &[u8]) -> Option<u32> {
    let digits = seal.strip_prefix(CHECKSUM.as_bytes())?.strip_prefix(b" ")?.strip_suffix(b"\n")?;
    // Upper case only: a checksum has one form.
    let bytes = hex::decode(std::str::from_utf8(digits).ok()?)?;
    Some(u32::from_be_bytes(bytes.try_into().ok()?))
}

fn crc32(bytes: &[u8]) -> u32 {
    Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(bytes)
}

fn wide(len: usize) -> u64 {
    u64::try_from(len).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests;
