use crate::ErrorCode;
use crate::command::{InvalidRequest, Value};
use crate::element::{Element, ElementError, Width};

/// Puts fields into the data of a frame, one after the other.
///
/// | field | ASCII | binary |
/// |---|---|---|
/// | count | 2 hex digits | 1 byte |
/// | code, bit | 1 digit | 1 byte |
/// | byte | 2 hex digits | 1 byte |
/// | word | 4 hex digits | 2 bytes, big-endian |
/// | double | 8 hex digits | 4 bytes, big-endian |
/// | element | letters, decimal address of fixed length | letters, 2 bytes, big-endian |
/// | raw | as they are | as they are |
pub trait FieldWriter {
    /// A number of items, 1 to 256; 256 is sent as 0.
    fn count(&mut self, count: usize);
    /// A control or error code.
    fn code(&mut self, code: u8);
    /// One byte.
    fn byte(&mut self, byte: u8);
    /// 16 bits.
    fn word(&mut self, word: u16);
    /// 32 bits.
    fn double(&mut self, double: u32);
    /// An element.
    fn element(&mut self, element: Element);
    /// Bytes as they are.
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

    /// Several [doubles](Self::double).
    fn doubles(&mut self, doubles: &[u32]) {
        doubles.iter().for_each(|&double| self.double(double));
    }

    /// A value, as wide as it is.
    fn value(&mut self, value: Value) {
        match value {
            Value::Bit(on) => self.bit(on),
            Value::Word(word) => self.word(word),
            Value::Double(double) => self.double(double),
        }
    }
}

/// Takes fields out of the data of a frame, in the order they stand.
///
/// Every method fails rather than guess; after a failure the position is unspecified, and so is what several values were
/// read into.
pub trait FieldReader {
    /// A number of items: 1 to 255, and 0 which means 256.
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
    fn double(&mut self) -> Result<u32, FieldError>;
    /// Says what lies ahead: `elements` elements, each followed by `values` values of its own width, and then the
    /// end of the data.
    ///
    /// The binary framing needs it before [`element`](Self::element): it does not say how long a symbol is, and only
    /// the length of the whole tells `R` at address `54xxh` from `RT`.
    ///
    /// # Errors
    /// [`FieldError::Unreadable`] or [`FieldError::Ambiguous`].
    fn layout(&mut self, elements: usize, values: usize) -> Result<(), FieldError>;
    /// An element; [`layout`](Self::layout) must have announced it.
    ///
    /// # Errors
    /// Any [`FieldError`].
    fn element(&mut self) -> Result<Element, FieldError>;
    /// All that is left, as it is.
    fn rest(&mut self) -> &[u8];
    /// Whether nothing is left.
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

    /// As many bits as there is room for.
    ///
    /// # Errors
    /// Those of [`bit`](Self::bit).
    fn bits(&mut self, into: &mut [bool]) -> Result<(), FieldError> {
        into.iter_mut().try_for_each(|bit| self.bit().map(|value| *bit = value))
    }

    /// As many words as there is room for.
    ///
    /// # Errors
    /// Those of [`word`](Self::word).
    fn words(&mut self, into: &mut [u16]) -> Result<(), FieldError> {
        into.iter_mut().try_for_each(|word| self.word().map(|value| *word = value))
    }

    /// As many doubles as there is room for.
    ///
    /// # Errors
    /// Those of [`double`](Self::double).
    fn doubles(&mut self, into: &mut [u32]) -> Result<(), FieldError> {
        into.iter_mut().try_for_each(|double| self.double().map(|value| *double = value))
    }

    /// A value of this width.
    ///
    /// # Errors
    /// Those of [`bit`](Self::bit), [`word`](Self::word) and [`double`](Self::double).
    fn value(&mut self, width: Width) -> Result<Value, FieldError> {
        Ok(match width {
            Width::Bit => Value::Bit(self.bit()?),
            Width::Word => Value::Word(self.word()?),
            Width::Double => Value::Double(self.double()?),
        })
    }

    /// Nothing may be left.
    ///
    /// # Errors
    /// [`FieldError::Trailing`].
    fn finish(&self) -> Result<(), FieldError> {
        if self.is_empty() { Ok(()) } else { Err(FieldError::Trailing) }
    }
}

/// Why the data of a frame is not what the command says it is.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FieldError {
    /// The data ends before the field does.
    #[error("the data is too short")]
    Truncated,
    /// Something follows the last field.
    #[error("the data is too long")]
    Trailing,
    /// The data is not as long as this reply can be.
    #[error("the data is shorter or longer than it can be")]
    WrongLength,
    /// A character that is no hexadecimal digit.
    #[error("{0:02X}h is not a hexadecimal digit")]
    NotHex(u8),
    /// A character that is no decimal digit, in an address.
    #[error("{0:02X}h is not a decimal digit")]
    NotDecimal(u8),
    /// The state of a discrete that is neither 0 nor 1.
    #[error("{0} is not the state of a discrete (0 or 1)")]
    NotABit(u8),
    /// A command that the protocol, or the framing, does not have.
    #[error("there is no command {0:02X}")]
    UnknownCommand(u8),
    /// A code that the command does not have.
    #[error("{0} is not a code of this command")]
    UnknownCode(u8),
    /// The element is not one.
    #[error(transparent)]
    Element(#[from] ElementError),
    /// The fields are well-formed, and break one of the command's limits.
    #[error(transparent)]
    Invalid(#[from] InvalidRequest),
    /// The elements and values cannot be told apart in any way.
    #[error("the data is no list of elements that fills it")]
    Unreadable,
    /// The elements and values can be told apart in more than one way. Binary framing only.
    #[error("the list of elements can be read in more than one way")]
    Ambiguous,
    /// The echo of a loop-back is not what was sent.
    #[error("the echo differs from what was sent")]
    NotTheEcho,
}

impl FieldError {
    /// What a PLC answers to a request with this fault: 2 for a value, A for an address, 4 for the rest
    /// (protocol reference, section 4).
    #[must_use]
    pub fn error_code(&self) -> ErrorCode {
        match self {
            Self::NotHex(_) | Self::NotDecimal(_) | Self::NotABit(_) | Self::UnknownCode(_) => ErrorCode::IllegalValue,
            Self::Element(ElementError::OutOfRange { .. } | ElementError::Misaligned { .. }) => {
                ErrorCode::IllegalAddress
            }
            Self::Invalid(InvalidRequest::PastTheEnd { .. } | InvalidRequest::Element(_)) => ErrorCode::IllegalAddress,
            Self::Invalid(_) => ErrorCode::IllegalValue,
            _ => ErrorCode::IllegalFormat,
        }
    }
}
