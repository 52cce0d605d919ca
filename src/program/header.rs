use std::fmt;

use super::InvalidProgram;
use crate::command::{PAGE_WORDS, ProgramPage};

/// Page 0 of a program.
///
/// ```text
/// 0      F
/// 1      B or M
/// 2, 3   one digit each
/// 4, 5   the size of the ladder in words, the high byte first
/// 6..127 FF
/// ```
///
/// Bytes from 6 on are kept and not interpreted. Source: protocol reference, section 6 (manual 000,
/// command 4F).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ProgramHeader {
    kind: ProgramKind,
    digits: [u8; 2],
    ladder_words: u16,
}

impl ProgramHeader {
    /// Parses a page.
    ///
    /// # Errors
    /// [`InvalidProgram::Mark`] and [`InvalidProgram::Digits`].
    pub fn parse(page: &ProgramPage) -> Result<Self, InvalidProgram> {
        let [mark, digits, ladder_words, ..] = page.words();
        let kind = match &mark.to_be_bytes() {
            b"FB" => ProgramKind::Fb,
            b"FM" => ProgramKind::Fm,
            &found => return Err(InvalidProgram::Mark { found }),
        };
        let digits = digits.to_be_bytes();
        if digits.iter().all(u8::is_ascii_digit) {
            Ok(Self { kind, digits, ladder_words: *ladder_words })
        } else {
            Err(InvalidProgram::Digits { found: digits })
        }
    }

    /// The kind of PLC that the program is for.
    #[must_use]
    pub fn kind(&self) -> ProgramKind {
        self.kind
    }

    /// The two digits after the kind. The manual does not explain them.
    #[must_use]
    pub fn digits(&self) -> [char; 2] {
        self.digits.map(char::from)
    }

    /// Size of the ladder in words.
    #[must_use]
    pub fn ladder_words(&self) -> u16 {
        self.ladder_words
    }

    /// Number of pages of the program, this one included: 207 for 13184 words.
    #[must_use]
    pub fn page_count(&self) -> u16 {
        page_count(self.ladder_words)
    }
}

/// Pages of a program with a ladder of this size: the header, and one for every 64 words.
pub(super) fn page_count(ladder_words: u16) -> u16 {
    // At most 1024 of 64 words each, and the header.
    ladder_words.div_ceil(PAGE_WORDS as u16).saturating_add(1)
}

impl fmt::Display for ProgramHeader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [first, second] = self.digits();
        write!(f, "{}{first}{second}, {} words", self.kind, self.ladder_words)
    }
}

/// The kind of PLC that a program is for: its first two bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ProgramKind {
    /// `FB`.
    Fb,
    /// `FM`.
    Fm,
}

impl fmt::Display for ProgramKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Fb => "FB",
            Self::Fm => "FM",
        })
    }
}
