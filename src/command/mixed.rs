use std::fmt;

use bytes::BytesMut;

use super::{Candidates, Code, Command, InvalidRequest, RequestError, Run, Spelling, limits, sealed, spelling, text};
use crate::element::{Element, ElementError, Value};
use crate::wire::{BinaryReader, BinaryWriter, FieldError, FieldReader, FieldWriter, Framing};

/// 48: reads any elements, in any order.
///
/// ```text
/// request  N · N elements
/// reply    N values in the same order, each of the width of its element
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ReadMixed {
    elements: Vec<Element>,
}

impl ReadMixed {
    /// A read of these elements.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] without an element; [`InvalidRequest::Units`] for more than 64
    /// units.
    pub fn new(elements: impl Into<Vec<Element>>) -> Result<Self, InvalidRequest> {
        let elements = elements.into();
        limits::count(Self::CODE, elements.len(), 1, limits::MAX_MIXED_READ_UNITS)?;
        limits::units(Self::CODE, elements.iter().map(|e| e.width().units()).sum(), limits::MAX_MIXED_READ_UNITS)?;
        Ok(Self { elements })
    }

    /// The elements.
    #[must_use]
    pub fn elements(&self) -> &[Element] {
        &self.elements
    }

    /// The elements of a spelling: the list, repeated up to the number of elements of the spelling.
    fn spelled(&self, spelling: Spelling) -> impl Iterator<Item = Element> {
        self.elements.iter().copied().cycle().take(spelling.count.into())
    }
}

impl sealed::Sealed for ReadMixed {}

impl fmt::Display for ReadMixed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        text::command(f, Self::CODE, text::List(self.elements.iter()))
    }
}

impl Command for ReadMixed {
    type Reply = Vec<Value>;
    const CODE: Code = Code::ReadMixed;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.count(self.elements.len());
        self.elements.iter().for_each(|&element| fields.element(element));
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        let count = fields.count()?;
        limits::count(Self::CODE, count, 1, limits::MAX_MIXED_READ_UNITS)?;
        fields.layout(count, 0)?;
        let elements = (0..count).map(|_| fields.element()).collect::<Result<Vec<_>, FieldError>>()?;
        Ok(Self::new(elements)?)
    }

    fn write_reply<W: FieldWriter>(&self, reply: &Vec<Value>, fields: &mut W) {
        reply.iter().for_each(|&value| fields.value(value));
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Vec<Value>, FieldError> {
        let mut values = Vec::with_capacity(self.elements.len());
        for element in &self.elements {
            values.push(fields.value(element.width())?);
        }
        Ok(values)
    }

    fn fmt_reply(reply: &Vec<Value>, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", text::values(reply))
    }

    fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
        self.elements.iter().for_each(|&first| each(Run { first, count: 1 }));
    }

    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(self, framing)?;
        unambiguous(self, framing, || self.elements.clone())
    }

    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, self.elements.len())
    }

    fn candidates(&self, _longer: bool, framing: Framing) -> Candidates {
        spelling::mixed_read_candidates(&self.elements, framing)
    }

    fn write_spelled<W: FieldWriter>(&self, spelling: Spelling, fields: &mut W) {
        fields.count(spelling.count.into());
        self.spelled(spelling).for_each(|element| fields.element(element));
    }

    fn read_spelled<R: FieldReader>(&self, spelling: Spelling, fields: &mut R) -> Result<Vec<Value>, FieldError> {
        let mut values = Vec::with_capacity(self.elements.len());
        for (n, element) in self.spelled(spelling).enumerate() {
            let value = fields.value(element.width())?;
            if n < self.elements.len() {
                values.push(value);
            }
        }
        Ok(values)
    }

    fn reply_size(&self, spelling: Spelling, framing: Framing) -> u32 {
        self.spelled(spelling).map(|element| spelling::values_len(element.width(), 1, framing)).sum()
    }

    /// The first element, which a spelling reads twice.
    fn run(&self) -> Option<Run> {
        self.elements.first().map(|&first| Run { first, count: 1 })
    }
}

/// 49: writes any elements, in the order given.
///
/// ```text
/// request  N · N times: element · value of its width
/// reply    -
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct WriteMixed {
    items: Vec<(Element, Value)>,
}

impl WriteMixed {
    /// A write of these values to these elements.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] without an element; [`InvalidRequest::Units`] for more than 32
    /// units; [`ElementError::WrongWidth`] in [`InvalidRequest::Element`] for a value of another width
    /// than its element.
    pub fn new(items: impl Into<Vec<(Element, Value)>>) -> Result<Self, InvalidRequest> {
        let items = items.into();
        limits::count(Self::CODE, items.len(), 1, limits::MAX_MIXED_WRITE_UNITS)?;
        if let Some(&(element, value)) = items.iter().find(|(element, value)| element.width() != value.width()) {
            return Err(ElementError::WrongWidth { element, expected: value.width() }.into());
        }
        limits::units(Self::CODE, items.iter().map(|(e, _)| e.width().units()).sum(), limits::MAX_MIXED_WRITE_UNITS)?;
        Ok(Self { items })
    }

    /// The elements and their values.
    #[must_use]
    pub fn items(&self) -> &[(Element, Value)] {
        &self.items
    }
}

impl sealed::Sealed for WriteMixed {}

impl fmt::Display for WriteMixed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let items = self.items.iter().map(|(element, value)| format!("{element} = {value}"));
        text::command(f, Self::CODE, text::List(items))
    }
}

impl Command for WriteMixed {
    type Reply = ();
    const CODE: Code = Code::WriteMixed;
    const IMPLIED_REPLY: Option<()> = Some(());

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.count(self.items.len());
        for &(element, value) in &self.items {
            fields.element(element);
            fields.value(value);
        }
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        let count = fields.count()?;
        limits::count(Self::CODE, count, 1, limits::MAX_MIXED_WRITE_UNITS)?;
        fields.layout(count, 1)?;
        let mut items = Vec::with_capacity(count);
        for _ in 0..count {
            let element = fields.element()?;
            items.push((element, fields.value(element.width())?));
        }
        Ok(Self::new(items)?)
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), _fields: &mut W) {}

    fn read_reply<R: FieldReader>(&self, _fields: &mut R) -> Result<(), FieldError> {
        Ok(())
    }

    fn fmt_reply((): &(), f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("done")
    }

    fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
        self.items.iter().for_each(|&(first, _)| each(Run { first, count: 1 }));
    }

    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(self, framing)?;
        unambiguous(self, framing, || self.items.iter().map(|&(element, _)| element).collect())
    }

    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, self.items.len())
    }
}

/// Checks that the PLC can decode the list of elements in one way only.
///
/// In the binary framing some lists are ambiguous. The PLC could read or write a wrong register.
fn unambiguous<C: Command>(
    request: &C,
    framing: Framing,
    elements: impl Fn() -> Vec<Element>,
) -> Result<(), InvalidRequest> {
    if framing == Framing::Ascii {
        return Ok(());
    }
    let mut data = BytesMut::new();
    request.write_request(&mut BinaryWriter::new(&mut data));
    match C::read_request(&mut BinaryReader::new(&data)) {
        Ok(_) => Ok(()),
        Err(_) => Err(InvalidRequest::Ambiguous { code: C::CODE, elements: elements() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::{decode_reply, encode_reply};
    use crate::element::{Discrete, Register, Register32, Symbol};
    use crate::wire::{AsciiReader, ascii};

    #[test]
    fn a_mixed_reply_has_a_value_of_the_width_of_each_element() {
        let elements: [Element; 3] = [
            Register::r(5).into(),
            Discrete::new(Symbol::M, 9).unwrap().into(),
            Register32::new(Symbol::DR, 100).unwrap().into(),
        ];
        let values = vec![Value::Word(0x1234), Value::Bit(true), Value::DWord(0x89AB_CDEF)];
        let read = ReadMixed::new(elements).unwrap();
        let mut frame = BytesMut::new();
        encode_reply(&read, Ok(&values), Framing::Ascii, 1, &mut frame);
        let data = &frame[5..frame.len() + 5 - ascii::OVERHEAD];
        assert_eq!(data, b"01234189ABCDEF");
        assert_eq!(decode_reply(&read, Framing::Ascii, data).unwrap(), values);
        assert_eq!(read.read_reply(&mut AsciiReader::new(&data[1..])).unwrap(), values);
    }
}
