use super::{Candidates, Code, Command, ReadDiscretes, ReadRegisters, Run, Spelling, sealed};
use crate::element::Register;
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

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
        self.read_spelled(self.plain(), fields)
    }

    fn plain(&self) -> Spelling {
        self.0.plain()
    }

    fn candidates(&self, longer: bool, framing: Framing) -> Candidates {
        self.0.candidates(longer, framing)
    }

    fn write_spelled<W: FieldWriter>(&self, spelling: Spelling, fields: &mut W) {
        self.0.write_spelled(spelling, fields);
    }

    fn read_spelled<R: FieldReader>(&self, spelling: Spelling, fields: &mut R) -> Result<Self::Reply, FieldError> {
        let (named, asked) = (usize::from(spelling.count), spelling.count_behind());
        let mut reply = Few { len: asked.min(self.0.len()), values: [C::Value::default(); N] };
        let values = reply.values.get_mut(..named).ok_or(FieldError::WrongLength)?;
        C::take(values, fields)?;
        values.rotate_left(named - asked);
        Ok(reply)
    }

    fn reply_size(&self, spelling: Spelling, framing: Framing) -> u32 {
        self.0.reply_size(spelling, framing)
    }

    fn run(&self) -> Option<Run> {
        self.0.run()
    }
}

#[cfg(test)]
mod tests {
    use bytes::BytesMut;

    use super::*;
    use crate::command::{ReplyError, decode_reply, encode_reply, encode_request};
    use crate::element::{Discrete, Symbol};
    use crate::wire::{Framing, ascii};

    /// Request and reply are those of the plain read.
    fn is_the_same<C: Consecutive<Reply = Vec<T>, Value = T>, T: Copy + Default>(read: C, values: Vec<T>) {
        let few = InPlace::<C, 8>(read);
        let mut reply = Few { len: values.len(), values: [T::default(); 8] };
        reply.values[..values.len()].copy_from_slice(&values);
        for framing in [Framing::Ascii, Framing::Binary] {
            let (mut plain, mut in_place) = (BytesMut::new(), BytesMut::new());
            encode_request(&read, framing, 1, &mut plain).unwrap();
            encode_request(&few, framing, 1, &mut in_place).unwrap();
            encode_reply(&read, Ok(&values), framing, 1, &mut plain);
            encode_reply(&few, Ok(&reply), framing, 1, &mut in_place);
            assert_eq!(plain, in_place, "{framing}");
        }
        assert_eq!(reply.as_slice().len(), values.len());
    }

    #[test]
    fn a_read_in_place_is_the_plain_one_on_the_wire() {
        is_the_same(ReadRegisters::new(Register::r(5), 3).unwrap(), vec![1, 0xABCD, 3]);
        is_the_same(
            ReadDiscretes::new(Discrete::new(Symbol::M, 7).unwrap(), 4).unwrap(),
            vec![true, false, true, true],
        );
    }

    #[test]
    fn more_values_than_there_is_room_for_are_refused() {
        let read = ReadRegisters::new(Register::r(0), 3).unwrap();
        let mut frame = BytesMut::new();
        encode_reply(&read, Ok(&vec![1, 2, 3]), Framing::Ascii, 1, &mut frame);
        let data = &frame[5..frame.len() + 5 - ascii::OVERHEAD];
        assert!(decode_reply(&InPlace::<_, 3>(read), Framing::Ascii, data).is_ok());
        let refused = decode_reply(&InPlace::<_, 2>(read), Framing::Ascii, data);
        assert_eq!(refused.unwrap_err(), ReplyError::Mismatch(FieldError::WrongLength));
    }
}
