//! Requests and replies as frames: command code and error code around the fields of a command.

use std::fmt;

use bytes::BytesMut;

use super::{Command, ErrorField, InvalidRequest, Spelling};
use crate::error::ErrorCode;
use crate::wire::{AsciiReader, BinaryReader, FieldError, FieldReader, FieldWriter, Framing, Side, ascii, binary};

/// Appends a request as a complete frame.
///
/// ```
/// use bytes::BytesMut;
/// use fatek::command::{ReadRegisters, encode_request};
/// use fatek::wire::Framing;
///
/// let mut frame = BytesMut::new();
/// encode_request(&ReadRegisters::new(fatek::register!("R12"), 3)?, Framing::Ascii, 1, &mut frame)?;
/// assert_eq!(&frame[..], b"\x02014603R0001275\x03");
/// # Ok::<(), fatek::command::InvalidRequest>(())
/// ```
///
/// # Errors
/// [`InvalidRequest`] if the request cannot be sent in this framing, or for station 255. Nothing is
/// appended then.
pub fn encode_request<C: Command>(
    request: &C,
    framing: Framing,
    station: u8,
    dst: &mut BytesMut,
) -> Result<(), InvalidRequest> {
    check_request(request, framing, station)?;
    encode_spelled(request, request.plain(), framing, station, dst);
    Ok(())
}

/// Checks that a request can be sent in a framing to a station, or as a broadcast.
pub(super) fn check_request<C: Command>(request: &C, framing: Framing, station: u8) -> Result<(), InvalidRequest> {
    request.check(framing)?;
    if station == u8::MAX { Err(InvalidRequest::Station { station }) } else { Ok(()) }
}

/// Appends a request in one of its spellings. The caller has called [`Command::check`] for this
/// framing.
pub(crate) fn encode_spelled<C: Command>(
    request: &C,
    spelling: Spelling,
    framing: Framing,
    station: u8,
    dst: &mut BytesMut,
) {
    let code = spelling.code.into();
    match framing {
        Framing::Ascii => ascii::emit(dst, station, code, |fields| request.write_spelled(spelling, fields)),
        Framing::Binary => {
            binary::emit(dst, Side::Client, station, code, |fields| request.write_spelled(spelling, fields));
        }
    }
}

/// Appends the reply to a request as a complete frame, as a PLC sends it.
pub fn encode_reply<C: Command>(
    request: &C,
    reply: Result<&C::Reply, ErrorCode>,
    framing: Framing,
    station: u8,
    dst: &mut BytesMut,
) {
    let code = C::CODE.into();
    match framing {
        Framing::Ascii => ascii::emit(dst, station, code, |fields| write_reply(request, reply, fields)),
        Framing::Binary => binary::emit(dst, Side::Plc, station, code, |fields| write_reply(request, reply, fields)),
    }
}

/// Decodes the data of a reply to this request.
///
/// The caller compares station and command.
///
/// # Errors
/// [`ReplyError::Plc`] for a refusal, [`ReplyError::Mismatch`] for data that is no reply to this
/// request.
pub fn decode_reply<C: Command>(request: &C, framing: Framing, data: &[u8]) -> Result<C::Reply, ReplyError> {
    decode_spelled(request, request.plain(), framing, data)
}

/// Decodes the data of a reply to a spelling of this request.
pub(crate) fn decode_spelled<C: Command>(
    request: &C,
    spelling: Spelling,
    framing: Framing,
    data: &[u8],
) -> Result<C::Reply, ReplyError> {
    match framing {
        Framing::Ascii => {
            read_reply(spelling, || AsciiReader::new(data), |fields| request.read_spelled(spelling, fields))
        }
        Framing::Binary => {
            read_reply(spelling, || BinaryReader::new(data), |fields| request.read_spelled(spelling, fields))
        }
    }
}

/// As [`decode_spelled`], with a place for the reply. It holds a reply only if this returns `Ok`.
pub(crate) fn decode_spelled_into<C: Command>(
    request: &C,
    spelling: Spelling,
    framing: Framing,
    data: &[u8],
    reply: &mut Option<C::Reply>,
) -> Result<(), ReplyError> {
    match framing {
        Framing::Ascii => {
            let read = |fields: &mut _| request.read_spelled_into(spelling, fields, reply);
            read_reply(spelling, || AsciiReader::new(data), read)
        }
        Framing::Binary => {
            let read = |fields: &mut _| request.read_spelled_into(spelling, fields, reply);
            read_reply(spelling, || BinaryReader::new(data), read)
        }
    }
}

/// A frame with the right station and command that brings no reply.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ReplyError {
    /// The PLC refused the request.
    Plc(ErrorCode),
    /// The data is no reply to this request.
    Mismatch(FieldError),
}

/// The error code of a reply, if it is a refusal.
pub(crate) fn refusal_in<T>(reply: Result<T, ReplyError>) -> Result<Option<ErrorCode>, FieldError> {
    match reply {
        Ok(_) => Ok(None),
        Err(ReplyError::Plc(refusal)) => Ok(Some(refusal)),
        Err(ReplyError::Mismatch(mismatch)) => Err(mismatch),
    }
}

impl fmt::Display for ReplyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Plc(error) => error.fmt(f),
            Self::Mismatch(mismatch) => write!(f, "not a reply to this request: {mismatch}"),
        }
    }
}

impl std::error::Error for ReplyError {
    /// The cause behind the one that the text has.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Plc(error) => error.source(),
            Self::Mismatch(mismatch) => mismatch.source(),
        }
    }
}

impl From<ErrorCode> for ReplyError {
    fn from(error: ErrorCode) -> Self {
        Self::Plc(error)
    }
}

impl From<FieldError> for ReplyError {
    fn from(mismatch: FieldError) -> Self {
        Self::Mismatch(mismatch)
    }
}

pub(super) fn write_reply<C: Command, W: FieldWriter>(
    request: &C,
    reply: Result<&C::Reply, ErrorCode>,
    fields: &mut W,
) {
    match reply {
        Err(error) => fields.code(error.into()),
        Ok(reply) => {
            if C::CODE.error_field() != ErrorField::Absent {
                fields.code(0);
            }
            request.write_reply(reply, fields);
        }
    }
}

/// Reads a reply, of which `read` reads the fields behind the error code.
fn read_reply<R: FieldReader, T>(
    spelling: Spelling,
    fields: impl Fn() -> R,
    mut read: impl FnMut(&mut R) -> Result<T, FieldError>,
) -> Result<T, ReplyError> {
    match spelling.code.error_field() {
        ErrorField::Leading => read_with_error(&mut fields(), &mut read),
        // The echo first. A PLC may refuse a loop-back with an error digit, and the digit may also
        // be the echo.
        ErrorField::Absent => match read_without_error(&mut fields(), &mut read) {
            Err(ReplyError::Mismatch(mismatch)) => refused(&mut fields(), mismatch),
            result => result,
        },
        ErrorField::ByLength => match read_with_error(&mut fields(), &mut read) {
            Err(ReplyError::Mismatch(_)) => read_without_error(&mut fields(), &mut read),
            result => result,
        },
    }
}

fn read_with_error<R: FieldReader, T>(
    fields: &mut R,
    read: &mut impl FnMut(&mut R) -> Result<T, FieldError>,
) -> Result<T, ReplyError> {
    match ErrorCode::from_u8(fields.code().map_err(ReplyError::Mismatch)?) {
        None => read_without_error(fields, read),
        Some(error) => {
            // No data follows an error code.
            fields.finish()?;
            Err(error.into())
        }
    }
}

fn read_without_error<R: FieldReader, T>(
    fields: &mut R,
    read: &mut impl FnMut(&mut R) -> Result<T, FieldError>,
) -> Result<T, ReplyError> {
    let reply = read(fields)?;
    fields.finish()?;
    Ok(reply)
}

fn refused<T>(fields: &mut impl FieldReader, mismatch: FieldError) -> Result<T, ReplyError> {
    match (fields.code().map(ErrorCode::from_u8), fields.finish()) {
        (Ok(Some(error)), Ok(())) => Err(error.into()),
        (Ok(Some(_) | None) | Err(_), _) => Err(mismatch.into()),
    }
}

/// Appends a refusal of a request that could not be decoded, as a complete frame.
pub fn encode_refusal(code: u8, error: ErrorCode, framing: Framing, station: u8, dst: &mut BytesMut) {
    match framing {
        Framing::Ascii => ascii::emit(dst, station, code, |fields| fields.code(error.into())),
        Framing::Binary => binary::emit(dst, Side::Plc, station, code, |fields| fields.code(error.into())),
    }
}
