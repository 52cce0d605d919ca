use bytes::BytesMut;

use super::{
    Code, Command, ControlDiscrete, ControlPlc, InvalidRequest, LoopBack, ReadDetailedStatus, ReadDisabled,
    ReadDiscretes, ReadMixed, ReadProgramPage, ReadRegisters, ReadStatus, WriteDiscretes, WriteMixed, WriteProgramPage,
    WriteRegisters, encode_request,
};
use crate::element::{ElementError, Register, Register32, Width};
use crate::wire::{AsciiReader, BinaryReader, FieldError, FieldReader, Frame, Framing};

/// Any request, as a PLC receives it, or a gateway that [passes it on](crate::Station::forward).
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Request {
    /// 40.
    ReadStatus(ReadStatus),
    /// 41.
    ControlPlc(ControlPlc),
    /// 42.
    ControlDiscrete(ControlDiscrete),
    /// 43.
    ReadDisabled(ReadDisabled),
    /// 44.
    ReadDiscretes(ReadDiscretes),
    /// 45.
    WriteDiscretes(WriteDiscretes),
    /// 46, of 16 bits.
    ReadRegisters(ReadRegisters<Register>),
    /// 46, of 32 bits.
    ReadRegisters32(ReadRegisters<Register32>),
    /// 47, of 16 bits.
    WriteRegisters(WriteRegisters<Register>),
    /// 47, of 32 bits.
    WriteRegisters32(WriteRegisters<Register32>),
    /// 48.
    ReadMixed(ReadMixed),
    /// 49.
    WriteMixed(WriteMixed),
    /// 4E.
    LoopBack(LoopBack),
    /// 4F.
    ReadProgramPage(ReadProgramPage),
    /// 50.
    WriteProgramPage(WriteProgramPage),
    /// 53.
    ReadDetailedStatus(ReadDetailedStatus),
}

impl Request {
    /// Reads a request from a frame.
    ///
    /// # Errors
    /// [`FieldError`]: the first rule that the frame breaks. A code that the framing does not have is
    /// [`FieldError::UnknownCommand`].
    pub fn decode(frame: &Frame, framing: Framing) -> Result<Self, FieldError> {
        let code = Code::from_u8(frame.command).filter(|code| code.is_in(framing));
        let code = code.ok_or(FieldError::UnknownCommand(frame.command))?;
        match framing {
            Framing::Ascii => Self::read(code, || AsciiReader::new(&frame.data)),
            Framing::Binary => Self::read(code, || BinaryReader::new(&frame.data)),
        }
    }

    /// Appends it as a whole frame, as [`encode_request`] does: the counterpart of [`decode`](Self::decode).
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
    /// Those of [`encode_request`]: not every request can be sent in both framings.
    pub fn encode(&self, framing: Framing, station: u8, dst: &mut BytesMut) -> Result<(), InvalidRequest> {
        with_command!(self, command => encode_request(command, framing, station, dst))
    }

    /// Which command it is.
    #[must_use]
    pub fn code(&self) -> Code {
        with_command!(self, command => code_of(command))
    }

    fn read<R: FieldReader>(code: Code, fields: impl Fn() -> R) -> Result<Self, FieldError> {
        Ok(match code {
            Code::ReadStatus => Self::ReadStatus(whole(fields())?),
            Code::ControlPlc => Self::ControlPlc(whole(fields())?),
            Code::ControlDiscrete => Self::ControlDiscrete(whole(fields())?),
            Code::ReadDisabled => Self::ReadDisabled(whole(fields())?),
            Code::ReadDiscretes => Self::ReadDiscretes(whole(fields())?),
            Code::WriteDiscretes => Self::WriteDiscretes(whole(fields())?),
            Code::ReadRegisters => match whole(fields()) {
                Err(error) if is_double(&error) => Self::ReadRegisters32(whole(fields())?),
                request => Self::ReadRegisters(request?),
            },
            Code::WriteRegisters => match whole(fields()) {
                Err(error) if is_double(&error) => Self::WriteRegisters32(whole(fields())?),
                request => Self::WriteRegisters(request?),
            },
            Code::ReadMixed => Self::ReadMixed(whole(fields())?),
            Code::WriteMixed => Self::WriteMixed(whole(fields())?),
            Code::LoopBack => Self::LoopBack(whole(fields())?),
            Code::ReadProgramPage => Self::ReadProgramPage(whole(fields())?),
            Code::WriteProgramPage => Self::WriteProgramPage(whole(fields())?),
            Code::ReadDetailedStatus => Self::ReadDetailedStatus(whole(fields())?),
        })
    }
}

fn code_of<C: Command>(_: &C) -> Code {
    C::CODE
}

fn whole<C: Command>(mut fields: impl FieldReader) -> Result<C, FieldError> {
    let request = C::read_request(&mut fields)?;
    fields.finish()?;
    Ok(request)
}

fn is_double(error: &FieldError) -> bool {
    matches!(error, FieldError::Element(ElementError::WrongWidth { symbol, .. }) if symbol.width() == Width::Double)
}

/// Does the same with the command of a [`Request`], whichever it is.
macro_rules! with_command {
    ($request:expr, $command:ident => $do:expr) => {
        match $request {
            $crate::command::Request::ReadStatus($command) => $do,
            $crate::command::Request::ControlPlc($command) => $do,
            $crate::command::Request::ControlDiscrete($command) => $do,
            $crate::command::Request::ReadDisabled($command) => $do,
            $crate::command::Request::ReadDiscretes($command) => $do,
            $crate::command::Request::WriteDiscretes($command) => $do,
            $crate::command::Request::ReadRegisters($command) => $do,
            $crate::command::Request::ReadRegisters32($command) => $do,
            $crate::command::Request::WriteRegisters($command) => $do,
            $crate::command::Request::WriteRegisters32($command) => $do,
            $crate::command::Request::ReadMixed($command) => $do,
            $crate::command::Request::WriteMixed($command) => $do,
            $crate::command::Request::LoopBack($command) => $do,
            $crate::command::Request::ReadProgramPage($command) => $do,
            $crate::command::Request::WriteProgramPage($command) => $do,
            $crate::command::Request::ReadDetailedStatus($command) => $do,
        }
    };
}
pub(crate) use with_command;
