use std::fmt;

use super::{Candidates, Code, Command, InvalidRequest, RequestError, Run, Spelling, blank, limits, sealed, spelling};
use crate::element::{Element, ElementError, Register, Register32, Value};
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

/// An element of 46 and 47: [`Register`] with a `u16` value, or [`Register32`] with a `u32` value.
pub trait RegisterElement:
    Copy
    + fmt::Debug
    + fmt::Display
    + PartialEq
    + Into<Element>
    + TryFrom<Element, Error = ElementError>
    + Send
    + Sync
    + sealed::Sealed
    + 'static
{
    /// The type of its value.
    type Value: Copy + Default + fmt::Debug + PartialEq + Eq + std::hash::Hash + Into<Value> + Send + Sync + 'static;

    /// Writes values.
    fn write<W: FieldWriter>(values: &[Self::Value], fields: &mut W);

    /// Reads one value for each place of the slice.
    ///
    /// # Errors
    /// [`FieldError::Truncated`], [`FieldError::NotHex`].
    fn read<R: FieldReader>(fields: &mut R, into: &mut [Self::Value]) -> Result<(), FieldError>;
}

impl sealed::Sealed for Register {}

impl RegisterElement for Register {
    type Value = u16;

    fn write<W: FieldWriter>(values: &[u16], fields: &mut W) {
        fields.words(values);
    }

    fn read<R: FieldReader>(fields: &mut R, into: &mut [u16]) -> Result<(), FieldError> {
        fields.words(into)
    }
}

impl sealed::Sealed for Register32 {}

impl RegisterElement for Register32 {
    type Value = u32;

    fn write<W: FieldWriter>(values: &[u32], fields: &mut W) {
        fields.dwords(values);
    }

    fn read<R: FieldReader>(fields: &mut R, into: &mut [u32]) -> Result<(), FieldError> {
        fields.dwords(into)
    }
}

/// 46: reads consecutive registers.
///
/// ```text
/// request  N · first register
/// reply    N values, of 16 or 32 bits as the register
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ReadRegisters<E> {
    first: E,
    count: usize,
}

impl<E: RegisterElement> ReadRegisters<E> {
    /// A read of `count` registers from `first` on.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] unless `count` is 1 to 64, or 1 to 32 of 32 bits;
    /// [`InvalidRequest::PastTheEnd`].
    pub fn new(first: E, count: usize) -> Result<Self, InvalidRequest> {
        limits::consecutive(Self::CODE, first.into(), count)?;
        Ok(Self { first, count })
    }

    /// The first register.
    #[must_use]
    pub fn first(&self) -> E {
        self.first
    }

    /// The number of registers.
    #[must_use]
    pub fn count(&self) -> usize {
        self.count
    }

    fn elements(&self) -> Run {
        Run { first: self.first.into(), count: self.count }
    }
}

impl<E: RegisterElement> sealed::Sealed for ReadRegisters<E> {}

impl<E: RegisterElement> Command for ReadRegisters<E> {
    type Reply = Vec<E::Value>;
    const CODE: Code = Code::ReadRegisters;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.count(self.count);
        fields.element(self.first.into());
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        let count = fields.count()?;
        fields.layout(1, 0)?;
        let first = fields.element()?.try_into()?;
        Ok(Self::new(first, count)?)
    }

    fn write_reply<W: FieldWriter>(&self, reply: &Vec<E::Value>, fields: &mut W) {
        E::write(reply, fields);
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Vec<E::Value>, FieldError> {
        let mut values = blank(self.count);
        E::read(fields, &mut values)?;
        Ok(values)
    }

    fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
        each(self.elements());
    }

    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, self.count)
    }

    fn candidates(&self, longer: bool, framing: Framing) -> Candidates {
        self.elements().read_candidates(Self::CODE, longer, framing)
    }

    fn write_spelled<W: FieldWriter>(&self, spelling: Spelling, fields: &mut W) {
        spelling::read_fields(self.first.into(), spelling, fields);
    }

    fn read_spelled<R: FieldReader>(&self, spelling: Spelling, fields: &mut R) -> Result<Self::Reply, FieldError> {
        let mut values = Self { count: spelling.count.into(), ..*self }.read_reply(fields)?;
        spelling::keep_asked(&mut values, spelling, self.count);
        Ok(values)
    }

    fn reply_size(&self, spelling: Spelling, framing: Framing) -> u32 {
        spelling::values_len(self.elements().first.width(), spelling.count.into(), framing)
    }

    fn run(&self) -> Option<Run> {
        Some(self.elements())
    }
}

/// 47: writes consecutive registers.
///
/// ```text
/// request  N · first register · N values, of 16 or 32 bits as the register
/// reply    -
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct WriteRegisters<E: RegisterElement> {
    first: E,
    values: Vec<E::Value>,
}

impl<E: RegisterElement> WriteRegisters<E> {
    /// A write of these values to `first` and the registers after it.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] unless there are 1 to 64, or 1 to 32 of 32 bits;
    /// [`InvalidRequest::PastTheEnd`].
    pub fn new(first: E, values: impl Into<Vec<E::Value>>) -> Result<Self, InvalidRequest> {
        let values = values.into();
        limits::consecutive(Self::CODE, first.into(), values.len())?;
        Ok(Self { first, values })
    }

    /// The first register.
    #[must_use]
    pub fn first(&self) -> E {
        self.first
    }

    /// The values.
    #[must_use]
    pub fn values(&self) -> &[E::Value] {
        &self.values
    }

    fn elements(&self) -> Run {
        Run { first: self.first.into(), count: self.values.len() }
    }
}

impl<E: RegisterElement> sealed::Sealed for WriteRegisters<E> {}

impl<E: RegisterElement> Command for WriteRegisters<E> {
    type Reply = ();
    const CODE: Code = Code::WriteRegisters;
    const BROADCAST_REPLY: Option<()> = Some(());

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.count(self.values.len());
        fields.element(self.first.into());
        E::write(&self.values, fields);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        let count = fields.count()?;
        fields.layout(1, count)?;
        let first = fields.element()?.try_into()?;
        let mut values = blank(count);
        E::read(fields, &mut values)?;
        Ok(Self::new(first, values)?)
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), _fields: &mut W) {}

    fn read_reply<R: FieldReader>(&self, _fields: &mut R) -> Result<(), FieldError> {
        Ok(())
    }

    fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
        each(self.elements());
    }

    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, self.values.len())
    }

    fn candidates(&self, longer: bool, framing: Framing) -> Candidates {
        self.elements().write_candidates(longer, framing, &self.values)
    }

    fn write_spelled<W: FieldWriter>(&self, spelling: Spelling, fields: &mut W) {
        spelling::write_fields(self, self.first.into(), &self.values, spelling, fields);
    }

    fn run(&self) -> Option<Run> {
        Some(self.elements())
    }
}
