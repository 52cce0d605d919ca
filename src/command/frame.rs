//! Frames of commands: made from requests and replies, decoded, and as a text.

use std::fmt;

use bytes::{Bytes, BytesMut};

use super::framing::{check_request, decode_reply, write_reply};
use super::text::Data;
use super::{Code, Command, InvalidRequest, ReplyError, Request, with_command};
use crate::error::ErrorCode;
use crate::wire::{AsciiWriter, BinaryWriter, FieldError, FieldWriter, Frame, Framing};

/// Frames of commands, for codecs that are used without a [`Link`](crate::Link).
///
/// [`Request::decode`] is the way back from a frame to a request.
impl Frame {
    /// A request to a station, or a broadcast to station 0.
    ///
    /// ```
    /// use bytes::BytesMut;
    /// use fatek::command::{ReadRegisters, Request};
    /// use fatek::wire::{AsciiCodec, Frame, Framing};
    /// use tokio_util::codec::Encoder;
    ///
    /// let read = ReadRegisters::new(fatek::register!("R12"), 3)?;
    /// let frame = Frame::request(1, &read, Framing::Ascii)?;
    /// assert_eq!(Request::decode(&frame, Framing::Ascii)?, Request::ReadRegisters(read));
    ///
    /// let mut bytes = BytesMut::new();
    /// AsciiCodec::new().encode(&frame, &mut bytes)?; // the bytes of `command::encode_request`
    /// assert_eq!(&bytes[..], b"\x02014603R0001275\x03");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`InvalidRequest`] if the request cannot be sent in this framing, or for station 255.
    pub fn request<C: Command>(station: u8, command: &C, framing: Framing) -> Result<Self, InvalidRequest> {
        check_request(command, framing, station)?;
        let data = match framing {
            Framing::Ascii => ascii(|fields| command.write_request(fields)),
            Framing::Binary => binary(|fields| command.write_request(fields)),
        };
        Ok(Self { station, command: C::CODE.into(), data })
    }

    /// The reply of a station to this command, as a PLC sends it: the values, or an error code.
    ///
    /// ```
    /// use fatek::ErrorCode;
    /// use fatek::command::{ReadRegisters, ReplyError};
    /// use fatek::wire::{Frame, Framing};
    ///
    /// let read = ReadRegisters::new(fatek::register!("R12"), 1)?;
    /// let reply = Frame::reply(1, &read, Ok(&vec![0x10A5]), Framing::Ascii);
    /// assert_eq!(reply.data, "010A5");
    /// assert_eq!(reply.decode_reply(&read, Framing::Ascii), Ok(vec![0x10A5]));
    ///
    /// let refusal = Frame::reply(1, &read, Err(ErrorCode::IllegalAddress), Framing::Ascii);
    /// let result = refusal.decode_reply(&read, Framing::Ascii);
    /// assert_eq!(result, Err(ReplyError::Plc(ErrorCode::IllegalAddress)));
    /// # Ok::<(), fatek::command::InvalidRequest>(())
    /// ```
    ///
    /// The reply must have the shape that its command asks for; this is not checked. A loop-back of
    /// bytes that are not printable makes a frame that the ASCII codec refuses to encode.
    #[must_use]
    pub fn reply<C: Command>(station: u8, command: &C, reply: Result<&C::Reply, ErrorCode>, framing: Framing) -> Self {
        let data = match framing {
            Framing::Ascii => ascii(|fields| write_reply(command, reply, fields)),
            Framing::Binary => binary(|fields| write_reply(command, reply, fields)),
        };
        Self { station, command: C::CODE.into(), data }
    }

    /// The refusal of a request that could not be decoded: an error code for the command code of
    /// that request.
    ///
    /// ```
    /// use fatek::command::Request;
    /// use fatek::wire::{Frame, Framing};
    ///
    /// let received = Frame { station: 1, command: 0x99, data: "".into() };
    /// let error = Request::decode(&received, Framing::Ascii).unwrap_err();
    /// let refusal = Frame::refusal(1, received.command, error.error_code(), Framing::Ascii);
    /// assert_eq!(refusal.to_string(), r#"station 1: command 99h "4""#);
    /// ```
    #[must_use]
    pub fn refusal(station: u8, command: u8, error: ErrorCode, framing: Framing) -> Self {
        let data = match framing {
            Framing::Ascii => ascii(|fields| fields.code(error.into())),
            Framing::Binary => binary(|fields| fields.code(error.into())),
        };
        Self { station, command, data }
    }

    /// Decodes the reply to this command.
    ///
    /// The caller compares the station.
    ///
    /// # Errors
    /// [`ReplyError::Plc`] for a refusal. [`ReplyError::Mismatch`] for data that is no reply to this
    /// command, with [`FieldError::OtherCommand`] for a frame of another one.
    pub fn decode_reply<C: Command>(&self, command: &C, framing: Framing) -> Result<C::Reply, ReplyError> {
        if self.command != u8::from(C::CODE) {
            return Err(FieldError::OtherCommand(self.command).into());
        }
        decode_reply(command, framing, &self.data)
    }
}

impl fmt::Display for Frame {
    /// Station, command and data on one line: `station 1: read registers (46h) "03R00012"`, or
    /// `broadcast: control RUN/STOP (41h) 01`.
    ///
    /// Of long data the first 64 bytes are shown. At most 280 characters, all of them printable.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.station {
            0 => f.write_str("broadcast: ")?,
            station => write!(f, "station {station}: ")?,
        }
        match Code::from_u8(self.command) {
            Some(code) => write!(f, "{code}")?,
            None => write!(f, "command {:02X}h", self.command)?,
        }
        if self.data.is_empty() { Ok(()) } else { write!(f, " {}", Data(&self.data)) }
    }
}

impl Request {
    /// The request as a frame to a station, as [`Frame::request`] makes it.
    ///
    /// # Errors
    /// Those of [`Frame::request`].
    pub fn to_frame(&self, framing: Framing, station: u8) -> Result<Frame, InvalidRequest> {
        with_command!(self, command => Frame::request(station, command, framing))
    }
}

fn ascii(write: impl FnOnce(&mut AsciiWriter<'_>)) -> Bytes {
    let mut data = BytesMut::new();
    write(&mut AsciiWriter::new(&mut data));
    data.freeze()
}

fn binary(write: impl FnOnce(&mut BinaryWriter<'_>)) -> Bytes {
    let mut data = BytesMut::new();
    write(&mut BinaryWriter::new(&mut data));
    data.freeze()
}
