use super::{
    Code, Command, ControlDiscrete, ControlPlc, LoopBack, ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadMixed,
    ReadProgramPage, ReadRegisters, ReadStatus, WriteDiscretes, WriteMixed, WriteProgramPage, WriteRegisters,
};
use crate::element::{ElementError, Register, Register32, Width};
use crate::wire::{AsciiReader, BinaryReader, FieldError, FieldReader, Frame, Framing};

/// Any request, as a PLC receives it.
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

fn whole<C: Command>(mut fields: impl FieldReader) -> Result<C, FieldError> {
    let request = C::read_request(&mut fields)?;
    fields.finish()?;
    Ok(request)
}

fn is_double(error: &FieldError) -> bool {
    matches!(error, FieldError::Element(ElementError::WrongWidth { symbol, .. }) if symbol.width() == Width::Double)
}
