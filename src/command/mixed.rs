use std::fmt;

use bytes::BytesMut;

use super::{Candidates, Code, Command, InvalidRequest, Run, Spelling, limits, spelling};
use crate::element::{Element, Width};
use crate::wire::{BinaryReader, BinaryWriter, FieldError, FieldReader, FieldWriter, Framing};

/// What an element of any width holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Value {
    /// The state of a discrete: `true` is on.
    Bit(bool),
    /// 16 bits.
    Word(u16),
    /// 32 bits.
    Double(u32),
}

impl Value {
    /// How wide it is.
    #[must_use]
    pub fn width(self) -> Width {
        match self {
            Self::Bit(_) => Width::Bit,
            Self::Word(_) => Width::Word,
            Self::Double(_) => Width::Double,
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bit(on) => u8::from(*on).fmt(f),
            Self::Word(word) => word.fmt(f),
            Self::Double(double) => double.fmt(f),
        }
    }
}

impl From<bool> for Value {
    fn from(on: bool) -> Self {
        Self::Bit(on)
    }
}

impl From<u16> for Value {
    fn from(word: u16) -> Self {
        Self::Word(word)
    }
}

impl From<u32> for Value {
    fn from(double: u32) -> Self {
        Self::Double(double)
    }
}

/// 48: reads any elements, in any order.
///
/// ```text
/// request  N · N elements
/// reply    N values, in the same order, each as wide as its element
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ReadMixed {
    elements: Vec<Element>,
}

impl ReadMixed {
    /// Reads these elements.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] when there are none; [`InvalidRequest::Units`] when they count more than 64.
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

    /// The elements of a spelling: the list, and from its beginning as many more as the spelling has.
    fn spelled(&self, spelling: Spelling) -> impl Iterator<Item = Element> {
        self.elements.iter().copied().cycle().take(spelling.count.into())
    }
}

impl Command for ReadMixed {
    type Reply = Vec<Value>;
    const CODE: Code = Code::ReadMixed;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.count(self.elements.len());
        self.elements.iter().for_each(|&element| fields.element(element));
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, FieldError> {
        let count = fields.count()?;
        limits::count(Self::CODE, count, 1, limits::MAX_MIXED_READ_UNITS)?;
        fields.layout(count, 0)?;
        let elements = (0..count).map(|_| fields.element()).collect::<Result<Vec<_>, _>>()?;
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

    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(Self::CODE, framing)?;
        one_reading(self, framing, || self.elements.clone())
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

    /// Its first element: the one that may be read twice.
    fn run(&self) -> Option<Run> {
        self.elements.first().map(|&first| Run { first, count: 1 })
    }
}

/// 49: writes any elements, in the order given.
///
/// ```text
/// request  N · N times: element · value, as wide as the element
/// reply    -
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct WriteMixed {
    items: Vec<(Element, Value)>,
}

impl WriteMixed {
    /// Writes these values to these elements.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] when there are none; [`InvalidRequest::Units`] when they count more than 32;
    /// [`InvalidRequest::WrongWidth`] for a value that is not as wide as its element.
    pub fn new(items: impl Into<Vec<(Element, Value)>>) -> Result<Self, InvalidRequest> {
        let items = items.into();
        limits::count(Self::CODE, items.len(), 1, limits::MAX_MIXED_WRITE_UNITS)?;
        if let Some(&(element, value)) = items.iter().find(|(element, value)| element.width() != value.width()) {
            return Err(InvalidRequest::WrongWidth { element, value });
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

impl Command for WriteMixed {
    type Reply = ();
    const CODE: Code = Code::WriteMixed;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.count(self.items.len());
        for &(element, value) in &self.items {
            fields.element(element);
            fields.value(value);
        }
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, FieldError> {
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

    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(Self::CODE, framing)?;
        one_reading(self, framing, || self.items.iter().map(|&(element, _)| element).collect())
    }

    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, self.items.len())
    }
}

/// What the PLC reads must be what was written. In the binary framing a list of elements may have two readings, and
/// then a wrong register could be read, or written.
fn one_reading<C: Command>(
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
