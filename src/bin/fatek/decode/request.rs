//! A frame's data as a request.

use fatek::command::{
    Code, Command, ControlDiscrete, ControlPlc, LoopBack, ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadMixed,
    ReadProgramPage, ReadRegisters, ReadStatus, WriteDiscretes, WriteMixed, WriteProgramPage, WriteRegisters,
};
use fatek::element::{ElementError, Width};
use fatek::wire::{AsciiReader, BinaryReader, FieldError, FieldReader, Framing};
use fatek::{Register, Register32};

use super::explain::{Part, Reading};
use super::recorder::Recorder;

pub(super) fn read(code: Code, framing: Framing, data: &[u8]) -> Reading {
    match framing {
        Framing::Binary => read_fields(code, &Recorder::new(BinaryReader::new(data), data, code, Part::Request)),
        _ => read_fields(code, &Recorder::new(AsciiReader::new(data), data, code, Part::Request)),
    }
}

fn read_fields<R: FieldReader + Clone>(code: Code, fields: &Recorder<'_, R>) -> Reading {
    match code {
        Code::ReadStatus => whole::<ReadStatus, _>(fields),
        Code::ControlPlc => whole::<ControlPlc, _>(fields),
        Code::ControlDiscrete => whole::<ControlDiscrete, _>(fields),
        Code::ReadDisabled => whole::<ReadDisabled, _>(fields),
        Code::ReadDiscretes => whole::<ReadDiscretes, _>(fields),
        Code::WriteDiscretes => whole::<WriteDiscretes, _>(fields),
        Code::ReadRegisters => either::<ReadRegisters<Register>, ReadRegisters<Register32>, _>(fields),
        Code::WriteRegisters => either::<WriteRegisters<Register>, WriteRegisters<Register32>, _>(fields),
        Code::ReadMixed => whole::<ReadMixed, _>(fields),
        Code::WriteMixed => whole::<WriteMixed, _>(fields),
        Code::LoopBack => whole::<LoopBack, _>(fields),
        Code::ReadProgramPage => whole::<ReadProgramPage, _>(fields),
        Code::WriteProgramPage => whole::<WriteProgramPage, _>(fields),
        Code::ReadDetailedStatus => whole::<ReadDetailedStatus, _>(fields),
        other => Reading { fields: Vec::new(), fault: Some(format!("{other} is not known here")) },
    }
}

fn whole<C: Command, R: FieldReader + Clone>(fields: &Recorder<'_, R>) -> Reading {
    let (fields, result) = record::<C, R>(fields);
    fields.reading(result)
}

/// As the first, or as the second if the element turns out to have 32 bits.
fn either<C: Command, D: Command, R: FieldReader + Clone>(fields: &Recorder<'_, R>) -> Reading {
    let (recorder, result) = record::<C, R>(fields);
    match result {
        Err(FieldError::Element(ElementError::WrongWidth { symbol, .. })) if symbol.width() == Width::Double => {
            whole::<D, R>(fields)
        }
        result => recorder.reading(result),
    }
}

fn record<'a, C: Command, R: FieldReader + Clone>(
    fields: &Recorder<'a, R>,
) -> (Recorder<'a, R>, Result<(), FieldError>) {
    let mut fields = fields.clone();
    let result = C::read_request(&mut fields).and_then(|_| fields.finish());
    (fields, result)
}
