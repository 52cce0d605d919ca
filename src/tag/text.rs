//! Texts in registers, and their quoted form.
//!
//! A register holds two characters of 8 bits. They are Latin-1, so that all contents of registers
//! are valid texts, without loss. `text` has the low byte of each register first, consistent with
//! 32-bit values, whose low word is first. The manuals do not specify this and operator panels
//! differ, so there is also `text-hi`, with the high byte first.

use std::fmt::{self, Write};

use super::ValueError;

/// Order of the two characters of a register.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum ByteOrder {
    LowFirst,
    HighFirst,
}

impl ByteOrder {
    fn bytes(self, word: u16) -> [u8; 2] {
        match self {
            Self::LowFirst => word.to_le_bytes(),
            Self::HighFirst => word.to_be_bytes(),
        }
    }

    fn word(self, bytes: [u8; 2]) -> u16 {
        match self {
            Self::LowFirst => u16::from_le_bytes(bytes),
            Self::HighFirst => u16::from_be_bytes(bytes),
        }
    }
}

/// Decodes a text, without the NULs at its end.
pub(super) fn decode(words: impl Iterator<Item = u16>, order: ByteOrder) -> String {
    let mut text: String = words.flat_map(|word| order.bytes(word)).map(char::from).collect();
    text.truncate(text.trim_end_matches('\0').len());
    text
}

/// Encodes a text, padded with NULs to a number of words.
pub(super) fn encode(text: &str, words: usize, order: ByteOrder) -> Result<Vec<u16>, ValueError> {
    // A tag has at most 65536 elements.
    let max = words * 2;
    let mut bytes = Vec::with_capacity(max);
    for character in text.chars() {
        let byte = u8::try_from(character);
        bytes.push(byte.map_err(|_| ValueError::NotLatin1 { text: text.to_owned(), character })?);
    }
    if bytes.len() > max {
        return Err(ValueError::TooLong { text: text.to_owned(), characters: bytes.len(), max });
    }
    bytes.resize(max, 0);
    Ok(bytes.as_chunks().0.iter().map(|pair| order.word(*pair)).collect())
}

/// Displays a text in double quotes, with escapes for quotes, backslashes and invisible characters.
pub(super) struct Quoted<'t>(pub(super) &'t str);

impl fmt::Display for Quoted<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_char('"')?;
        for character in self.0.chars() {
            match character {
                '"' | '\\' => write!(f, "\\{character}")?,
                '\n' => f.write_str("\\n")?,
                '\r' => f.write_str("\\r")?,
                '\t' => f.write_str("\\t")?,
                '\0' => f.write_str("\\0")?,
                // Control characters, the no-break space and the soft hyphen.
                '\u{1}'..='\u{1F}' | '\u{7F}'..='\u{A0}' | '\u{AD}' => write!(f, "\\x{:02X}", u32::from(character))?,
                _ => f.write_char(character)?,
            }
        }
        f.write_char('"')
    }
}

/// Parses a text in double quotes, or a plain one.
pub(super) fn parse(input: &str) -> Result<String, ValueError> {
    let Some(quoted) = input.strip_prefix('"') else {
        let plain = !input.is_empty() && !input.contains(|c: char| matches!(c, '"' | '\\' | ',') || c.is_control());
        return if plain { Ok(input.to_owned()) } else { Err(ValueError::NotQuoted) };
    };
    let mut text = String::new();
    let mut characters = quoted.chars();
    loop {
        match characters.next().ok_or(ValueError::BadQuotes)? {
            '"' if characters.as_str().is_empty() => return Ok(text),
            '"' => return Err(ValueError::BadQuotes),
            '\\' => text.push(escaped(&mut characters).ok_or(ValueError::BadEscape)?),
            character => text.push(character),
        }
    }
}

/// Parses the rest of an escape, behind the backslash.
fn escaped(characters: &mut std::str::Chars<'_>) -> Option<char> {
    Some(match characters.next()? {
        character @ ('"' | '\\') => character,
        'n' => '\n',
        'r' => '\r',
        't' => '\t',
        '0' => '\0',
        'x' => {
            let (high, low) = (characters.next()?.to_digit(16)?, characters.next()?.to_digit(16)?);
            char::from_u32(high << 4 | low)?
        }
        _ => return None,
    })
}
