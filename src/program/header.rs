use std::fmt;

use super::InvalidProgram;
use crate::command::{PAGE_WORDS, ProgramPage};

/// What page 0 of a program says.
///
/// ```text
/// 0      F
/// 1      B or M
/// 2, 3   a digit each
/// 4, 5   the size of the ladder in words, the high byte first
/// 6..127 FF
/// ```
///
/// Bytes 6 and up are kept as they are, and not looked at. Source: protocol reference, section 6 (manual 000, command 4F).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ProgramHeader {
    kind: ProgramKind,
    digits: [u8; 2],
    ladder_words: u16,
}

impl ProgramHeader {
    /// What this page says, if it is a header.
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

    /// What kind of PLC the program is for.
    #[must_use]
    pub fn kind(&self) -> ProgramKind {
        self.kind
    }

    /// The two digits behind the kind, whose meaning the manual does not tell.
    #[must_use]
    pub fn digits(&self) -> [char; 2] {
        self.digits.map(char::from)
    }

    /// The size of the ladder, in words.
    #[must_use]
    pub fn ladder_words(&self) -> u16 {
        self.ladder_words
    }

    /// How many pages the program has, this one included: 207 for 13184 words.
    #[must_use]
    pub fn page_count(&self) -> u16 {
        page_count(self.ladder_words)
    }
}

/// Pages of a program with so large a ladder: the header, and one for every 64 words.
pub(super) fn page_count(ladder_words: u16) -> u16 {
    usize::from(ladder_words).div_ceil(PAGE_WORDS).saturating_add(1).try_into().unwrap_or(u16::MAX)
}

impl fmt::Display for ProgramHeader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [first, second] = self.digits();
        write!(f, "{}{first}{second}, {} words", self.kind, self.ladder_words)
    }
}

/// The first two bytes of a program: what kind of PLC it is for.
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
