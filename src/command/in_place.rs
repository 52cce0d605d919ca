use super::{Code, Command, ReadDiscretes, ReadRegisters, sealed};
use crate::element::Register;
use crate::wire::{FieldError, FieldReader, FieldWriter};

/// A read of consecutive elements whose reply has its place in itself, so that it takes no memory from the heap: for values
/// that are copied to where the caller wants them. `N` is how many values there can be.
#[derive(Clone, Copy, Debug)]
pub(crate) struct InPlace<C, const N: usize>(pub(crate) C);

/// At most `N` values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Few<T, const N: usize> {
    len: usize,
    values: [T; N],
}

impl<T, const N: usize> Few<T, N> {
    pub(crate) fn as_slice(&self) -> &[T] {
        self.values.get(..self.len).unwrap_or_default()
    }
}

/// A read of consecutive elements.
pub(crate) trait Consecutive: Command + Copy {
    /// What each of them holds.
    type Value: Copy + Default + std::fmt::Debug + PartialEq + Send + Sync + 'static;

    /// How many values are read.
    fn len(&self) -> usize;

    /// Puts the values of a reply behind the fields.
    fn put<W: FieldWriter>(values: &[Self::Value], fields: &mut W);

    /// Takes the values of a reply, as many as there is room for.
    fn take<R: FieldReader>(into: &mut [Self::Value], fields: &mut R) -> Result<(), FieldError>;
}

impl Consecutive for ReadRegisters<Register> {
    type Value = u16;

    fn len(&self) -> usize {
        self.count()
    }

    fn put<W: FieldWriter>(values: &[u16], fields: &mut W) {
        fields.words(values);
    }

    fn take<R: FieldReader>(into: &mut [u16], fields: &mut R) -> Result<(), FieldError> {
        fields.words(into)
    }
}

impl Consecutive for ReadDiscretes {
    type Value = bool;

    fn len(&self) -> usize {
        self.count()
    }

    fn put<W: FieldWriter>(values: &[bool], fields: &mut W) {
        fields.bits(values);
    }

    fn take<R: FieldReader>(into: &mut [bool], fields: &mut R) -> Result<(), FieldError> {
        fields.bits(into)
    }
}

impl<C: Consecutive, const N: usize> sealed::Sealed for InPlace<C, N> {}

impl<C: Consecutive, const N: usize> Command for InPlace<C, N> {
    type Reply = Few<C::Value, N>;
    const CODE: Code = C::CODE;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        self.0.write_request(fields);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, FieldError> {
        C::read_request(fields).map(Self)
    }

    fn write_reply<W: FieldWriter>(&self, reply: &Self::Reply, fields: &mut W) {
        C::put(reply.as_slice(), fields);
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Self::Reply, FieldError> {
        let mut reply = Few { len: self.0.len(), values: [C::Value::default(); N] };
        let values = reply.values.get_mut(..reply.len).ok_or(FieldError::WrongLength)?;
        C::take(values, fields)?;
        Ok(reply)
    }
}
