use crate::element::{Element, ElementError, Value, Width};

/// Writes fields into the data of a frame, one after the other.
///
/// | field | ASCII | binary |
/// |---|---|---|
/// | count | 2 hex digits | 1 byte |
/// | code, bit | 1 digit | 1 byte |
/// | byte | 2 hex digits | 1 byte |
/// | word | 4 hex digits | 2 bytes, big-endian |
/// | dword | 8 hex digits | 4 bytes, big-endian |
/// | element | letters, decimal address of fixed length | letters, 2 bytes, big-endian |
/// | raw | unchanged | unchanged |
pub trait FieldWriter {
    /// A number of items, 1 to 256, where 256 is sent as 0.
    fn count(&mut self, count: usize);
    /// A control or error code.
    fn code(&mut self, code: u8);
    /// One byte.
    fn byte(&mut self, byte: u8);
    /// 16 bits.
    fn word(&mut self, word: u16);
    /// 32 bits.
    fn dword(&mut self, dword: u32);
    /// An element.
    fn element(&mut self, element: Element);
    /// Bytes, unchanged.
    fn raw(&mut self, bytes: &[u8]);

    /// One discrete, on or off.
    fn bit(&mut self, on: bool) {
        self.code(u8::from(on));
    }

    /// Several [bits](Self::bit).
    fn bits(&mut self, bits: &[bool]) {
        bits.iter().for_each(|&bit| self.bit(bit));
    }

    /// Several [words](Self::word).
    fn words(&mut self, words: &[u16]) {
        words.iter().for_each(|&word| self.word(word));
    }

    /// Several [double words](Self::dword).
    fn dwords(&mut self, dwords: &[u32]) {
        dwords.iter().for_each(|&dword| self.dword(dword));
    }

    /// A value, in its own width.
    fn value(&mut self, value: Value) {
        match value {
            Value::Bit(on) => self.bit(on),
            Value::Word(word) => self.word(word),
            Value::DWord(dword) => self.dword(dword),
        }
    }
}

/// Reads fields from the data of a frame, one after the other.
///
/// After an error the position in the data is unspecified, and so are the values in a slice that
/// was to be filled.
pub trait FieldReader {
    /// A number of items, 1 to 256, where 0 is 256.
    ///
    /// # Errors
    /// [`FieldError`] as for [`byte`](Self::byte).
    fn count(&mut self) -> Result<usize, FieldError>;
    /// A control or error code.
    ///
    /// # Errors
    /// [`FieldError::Truncated`], [`FieldError::NotHex`].
    fn code(&mut self) -> Result<u8, FieldError>;
    /// One byte.
    ///
    /// # Errors
    /// [`FieldError::Truncated`], [`FieldError::NotHex`].
    fn byte(&mut self) -> Result<u8, FieldError>;
    /// 16 bits.
    ///
    /// # Errors
    /// [`FieldError::Truncated`], [`FieldError::NotHex`].
    fn word(&mut self) -> Result<u16, FieldError>;
    /// 32 bits.
    ///
    /// # Errors
    /// [`FieldError::Truncated`], [`FieldError::NotHex`].
    fn dword(&mut self) -> Result<u32, FieldError>;
    /// Announces the rest of the data: `elements` elements, each followed by `values` values of its
    /// own width.
    ///
    /// Must be called before [`element`](Self::element). The binary framing does not send the
    /// length of a symbol, and only the length of all data tells `R` at an address from 5400h from
    /// `RT`.
    ///
    /// # Errors
    /// [`FieldError::Unreadable`] or [`FieldError::Ambiguous`].
    fn layout(&mut self, elements: usize, values: usize) -> Result<(), FieldError>;
    /// An element that [`layout`](Self::layout) has announced.
    ///
    /// # Errors
    /// Any [`FieldError`].
    fn element(&mut self) -> Result<Element, FieldError>;
    /// The rest of the data, unchanged.
    fn rest(&mut self) -> &[u8];
    /// Returns whether the data has no more bytes.
    fn is_empty(&self) -> bool;

    /// One discrete, on or off.
    ///
    /// # Errors
    /// [`FieldError::NotABit`] besides those of [`code`](Self::code).
    fn bit(&mut self) -> Result<bool, FieldError> {
        match self.code()? {
            0 => Ok(false),
            1 => Ok(true),
            other => Err(FieldError::NotABit(other)),
        }
    }

    /// One bit for each place of the slice.
    ///
    /// # Errors
    /// Those of [`bit`](Self::bit).
    fn bits(&mut self, into: &mut [bool]) -> Result<(), FieldError> {
        into.iter_mut().try_for_each(|bit| self.bit().map(|value| *bit = value))
    }

    /// One word for each place of the slice.
    ///
    /// # Errors
    /// Those of [`word`](Self::word).
    fn words(&mut self, into: &mut [u16]) -> Result<(), FieldError> {
        into.iter_mut().try_for_each(|word| self.word().map(|value| *word = value))
    }

    /// One double word for each place of the slice.
    ///
    /// # Errors
    /// Those of [`dword`](Self::dword).
    fn dwords(&mut self, into: &mut [u32]) -> Result<(), FieldError> {
        into.iter_mut().try_for_each(|dword| self.dword().map(|value| *dword = value))
    }

    /// A value of this width.
    ///
    /// # Errors
    /// Those of [`bit`](Self::bit), [`word`](Self::word) and [`dword`](Self::dword).
    fn value(&mut self, width: Width) -> Result<Value, FieldError> {
        Ok(match width {
            Width::Bit => Value::Bit(self.bit()?),
            Width::Word => Value::Word(self.word()?),
            Width::DWord => Value::DWord(self.dword()?),
        })
    }

    /// Checks that the data has no more bytes.
    ///
    /// # Errors
    /// [`FieldError::Trailing`].
    fn finish(&self) -> Result<(), FieldError> {
        if self.is_empty() { Ok(()) } else { Err(FieldError::Trailing) }
    }
}

/// The error of reading the fields of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FieldError {
    /// The data ends within a field.
    #[error("the data is too short")]
    Truncated,
    /// Bytes follow the last field.
    #[error("the data is too long")]
    Trailing,
    /// The length of the data is not one of this reply.
    #[error("the data is shorter or longer than it can be")]
    WrongLength,
    /// A character that is not a hexadecimal digit.
    #[error("{0:02X}h is not a hexadecimal digit")]
    NotHex(u8),
    /// A character of an address that is not a decimal digit.
    #[error("{0:02X}h is not a decimal digit")]
    NotDecimal(u8),
    /// The state of a discrete that is neither 0 nor 1.
    #[error("{0} is not the state of a discrete (0 or 1)")]
    NotABit(u8),
    /// A control code that the command does not have.
    #[error("{0} is not a code of this command")]
    UnknownCode(u8),
    /// The symbol or the address of an element is wrong.
    #[error(transparent)]
    Element(#[from] ElementError),
    /// The data is not a list of elements. Binary framing only.
    #[error("the data is no list of elements that fills it")]
    Unreadable,
    /// The data is a list of elements in more than one way. Binary framing only.
    #[error("the list of elements can be read in more than one way")]
    Ambiguous,
    /// The echo of a loop-back differs from the data that was sent.
    #[error("the echo differs from what was sent")]
    NotTheEcho,
    /// The frame has the code of another command.
    #[error("the frame is one of command {0:02X}h")]
    OtherCommand(u8),
}
