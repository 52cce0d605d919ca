//! Data of a frame, read as a request.

use fatek::command::{Code, Request};
use fatek::wire::{AsciiReader, BinaryReader, FieldReader, Framing};

use super::field::{DataReading, Part};
use super::recorder::Recorder;

pub(super) fn read(code: Code, framing: Framing, data: &[u8]) -> DataReading {
    match framing {
        Framing::Binary => read_fields(code, Recorder::new(BinaryReader::new(data), data, code, Part::Request)),
        Framing::Ascii | _ => read_fields(code, Recorder::new(AsciiReader::new(data), data, code, Part::Request)),
    }
}

fn read_fields<R: FieldReader + Clone>(code: Code, mut fields: Recorder<'_, R>) -> DataReading {
    let result = Request::read(code, &mut fields);
    fields.into_reading(result.map(drop))
}
