use std::fmt;

use super::Width;

/// The value of an element of any width.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Value {
    /// The state of a discrete: `true` is on.
    Bit(bool),
    /// 16 bits.
    Word(u16),
    /// 32 bits.
    DWord(u32),
}

impl Value {
    /// The width of the elements that it is for.
    #[must_use]
    pub fn width(self) -> Width {
        match self {
            Self::Bit(_) => Width::Bit,
            Self::Word(_) => Width::Word,
            Self::DWord(_) => Width::DWord,
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bit(on) => u8::from(*on).fmt(f),
            Self::Word(word) => word.fmt(f),
            Self::DWord(dword) => dword.fmt(f),
        }
    }
}

impl From<bool> for Value {
    fn from(on: bool) -> Self {
        Self::Bit(on)
    }
}

impl From<u16> for Value {
    fn from(word: u16) -> Self {
        Self::Word(word)
    }
}

impl From<u32> for Value {
    fn from(dword: u32) -> Self {
        Self::DWord(dword)
    }
}
