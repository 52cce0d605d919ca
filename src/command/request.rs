use std::fmt;

use bytes::BytesMut;

use super::{Code, Command, ForwardedReply, InvalidRequest, ReplyError, Request, encode_request, limits, with_command};
use crate::ErrorCode;
use crate::element::{ElementError, Width};
use crate::wire::{AsciiReader, BinaryReader, FieldError, FieldReader, Frame, Framing};

impl Request {
    /// Decodes the request in a frame.
    ///
    /// # Errors
    /// [`RequestError`]: the first rule that the frame breaks. A command that the framing does not
    /// have is [`RequestError::UnknownCommand`].
    pub fn decode(frame: &Frame, framing: Framing) -> Result<Self, RequestError> {
        let code = Code::from_u8(frame.command).filter(|code| code.is_in(framing));
        let code = code.ok_or(RequestError::UnknownCommand(frame.command))?;
        let request = match framing {
            Framing::Ascii => Self::read(code, &mut AsciiReader::new(&frame.data)),
            Framing::Binary => Self::read(code, &mut BinaryReader::new(&frame.data)),
        }?;
        // The first element of a run is in the framing; its last may be past the end.
        with_command!(&request, command => limits::addresses_in(command, framing))?;
        Ok(request)
    }

    /// Appends the request as a complete frame, as [`encode_request`] does.
    ///
    /// ```
    /// use bytes::BytesMut;
    /// use fatek::command::Request;
    /// use fatek::wire::{Frame, Framing};
    ///
    /// let ascii = Frame { station: 1, command: 0x46, data: "03R00012".into() };
    /// let request = Request::decode(&ascii, Framing::Ascii)?;
    /// let mut binary = BytesMut::new();
    /// request.encode(Framing::Binary, 1, &mut binary)?;
    /// assert_eq!(&binary[..10], b"\x51\x10\x00\x06\x01\x46\x03R\x00\x0C");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// Those of [`encode_request`]: some requests cannot be sent in both framings.
    pub fn encode(&self, framing: Framing, station: u8, dst: &mut BytesMut) -> Result<(), InvalidRequest> {
        with_command!(self, command => encode_request(command, framing, station, dst))
    }

    /// Decodes the reply to this request, as [`Frame::decode_reply`] does for a single command.
    ///
    /// The caller compares the station.
    ///
    /// ```
    /// use fatek::command::Request;
    /// use fatek::wire::{Frame, Framing};
    ///
    /// let request = Request::decode(&Frame { station: 1, command: 0x46, data: "01R00012".into() }, Framing::Ascii)?;
    /// let reply = Frame { station: 1, command: 0x46, data: "010A5".into() };
    /// let reply = request.decode_reply(&reply, Framing::Ascii)?;
    /// assert_eq!(reply.to_string(), "read registers (46h) R12: 4261");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// Those of [`Frame::decode_reply`].
    pub fn decode_reply(&self, reply: &Frame, framing: Framing) -> Result<ForwardedReply, ReplyError> {
        with_command!(self, command => forwarded(command, reply, framing))
    }

    /// Checks the rules that depend on the framing, as [`Command::check`] does.
    ///
    /// # Errors
    /// Those of [`Command::check`].
    pub fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        with_command!(self, command => command.check(framing))
    }

    /// The code of the command.
    #[must_use]
    pub fn code(&self) -> Code {
        with_command!(self, command => code_of(command))
    }
}

impl fmt::Display for Request {
    /// The command and its fields on one line: `read registers (46h) R12 to R14`.
    ///
    /// Each command has this text, too. Of long lists the first 16 values are shown, of data 64
    /// bytes. At most 600 characters, all of them printable.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        with_command!(self, command => write!(f, "{command}"))
    }
}

/// The error of decoding a request.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RequestError {
    /// A command that the protocol, or the framing, does not have.
    #[error("there is no command {0:02X}")]
    UnknownCommand(u8),
    /// The data does not consist of the fields of this command.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// The fields break a limit of the command.
    #[error(transparent)]
    Invalid(#[from] InvalidRequest),
}

impl RequestError {
    /// The error code with which a PLC refuses such a request: 2 for a value, A for an address, 4
    /// for the rest (protocol reference, section 4).
    #[must_use]
    pub fn error_code(&self) -> ErrorCode {
        match self {
            Self::UnknownCommand(_) => ErrorCode::IllegalFormat,
            Self::Field(error) => match error {
                FieldError::NotHex(_)
                | FieldError::NotDecimal(_)
                | FieldError::NotABit(_)
                | FieldError::UnknownCode(_) => ErrorCode::IllegalValue,
                FieldError::Element(error) => code_of_element(*error),
                FieldError::Truncated
                | FieldError::Trailing
                | FieldError::WrongLength
                | FieldError::Unreadable
                | FieldError::Ambiguous
                | FieldError::NotTheEcho
                | FieldError::OtherCommand(_) => ErrorCode::IllegalFormat,
            },
            Self::Invalid(error) => error.error_code(),
        }
    }
}

impl InvalidRequest {
    /// The error code with which a gateway refuses a request that cannot be sent on its line: A for
    /// an address, 4 for a request that the framing cannot carry, 2 for the rest.
    #[must_use]
    pub fn error_code(&self) -> ErrorCode {
        match self {
            Self::Element(error) => code_of_element(*error),
            Self::PastTheEnd { .. } => ErrorCode::IllegalAddress,
            Self::NotInFraming { .. } | Self::Ambiguous { .. } | Self::NotPrintable { .. } => ErrorCode::IllegalFormat,
            Self::Count { .. }
            | Self::Units { .. }
            | Self::OneByOne { .. }
            | Self::ValueTooLong { .. }
            | Self::NoBroadcast { .. }
            | Self::Station { .. } => ErrorCode::IllegalValue,
        }
    }
}

fn code_of_element(error: ElementError) -> ErrorCode {
    match error {
        ElementError::OutOfRange { .. }
        | ElementError::Misaligned { .. }
        | ElementError::PastFraming { .. }
        | ElementError::Counter { .. }
        | ElementError::NotConsecutive { .. } => ErrorCode::IllegalAddress,
        ElementError::UnknownSymbol
        | ElementError::MissingAddress { .. }
        | ElementError::BadAddress { .. }
        | ElementError::WrongWidth { .. } => ErrorCode::IllegalFormat,
    }
}

impl From<ElementError> for RequestError {
    fn from(error: ElementError) -> Self {
        Self::Field(error.into())
    }
}

fn forwarded<C: Command>(command: &C, reply: &Frame, framing: Framing) -> Result<ForwardedReply, ReplyError> {
    reply.decode_reply(command, framing).map(|values| ForwardedReply::new(command.clone(), values))
}

fn code_of<C: Command>(_: &C) -> Code {
    C::CODE
}

/// Reads a request that takes all of the data.
pub(super) fn read_whole<C: Command>(fields: &mut impl FieldReader) -> Result<C, RequestError> {
    let request = C::read_request(fields)?;
    fields.finish()?;
    Ok(request)
}

/// Reads a request for elements of 16 bits, or of 32 bits if its first element is one.
pub(super) fn read_either<N: Command, W: Command, R: FieldReader + Clone>(
    fields: &mut R,
    narrow: impl Fn(N) -> Request,
    wide: impl Fn(W) -> Request,
) -> Result<Request, RequestError> {
    let start = fields.clone();
    match read_whole(fields) {
        Err(error) if is_of_a_dword(&error) => {
            *fields = start;
            read_whole(fields).map(wide)
        }
        request => request.map(narrow),
    }
}

fn is_of_a_dword(error: &RequestError) -> bool {
    let RequestError::Field(FieldError::Element(ElementError::WrongWidth { element, .. })) = error else {
        return false;
    };
    element.width() == Width::DWord
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::element::{Element, Symbol};

    fn decode(code: Code, data: impl AsRef<[u8]>, framing: Framing) -> Result<Request, RequestError> {
        Request::decode(&Frame { station: 1, command: code.into(), data: data.as_ref().to_vec().into() }, framing)
    }

    #[test]
    fn a_request_is_checked_for_the_framing_it_is_sent_in() {
        let read = decode(Code::ReadDiscretes, b"\x01M\xFF\xFF", Framing::Binary).unwrap();
        assert_eq!(read.check(Framing::Binary), Ok(()));
        assert!(matches!(read.check(Framing::Ascii), Err(InvalidRequest::Element(ElementError::PastFraming { .. }))));
    }

    #[test]
    fn a_run_past_the_last_word_or_dword_is_refused() {
        for symbol in [Symbol::R, Symbol::WM, Symbol::DR, Symbol::DWM] {
            let first = Element::new(symbol, symbol.last_address()).unwrap();
            let [high, low] = first.address().to_be_bytes();
            for count in [1_u8, 2, 3] {
                let data = [&[count], symbol.as_str().as_bytes(), &[high, low]].concat();
                let decoded = decode(Code::ReadRegisters, data, Framing::Binary);
                let past = InvalidRequest::PastTheEnd { first, count: count.into() };
                let expected = if count == 1 { None } else { Some(RequestError::Invalid(past)) };
                assert_eq!(decoded.err(), expected, "{count} from {first} on");
            }
        }
    }
}
