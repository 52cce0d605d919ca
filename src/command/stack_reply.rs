use std::fmt;

use super::{Candidates, Code, Command, ConsecutiveElement, RequestError, Run, Spelling, sealed, text};
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

/// A read of at most `N` consecutive elements whose reply is an array: no memory of the heap is
/// used. For values that are copied into memory of the caller.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StackReply<C, const N: usize>(pub(crate) C);

/// A vector of at most `N` values, kept in an array.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ArrayVec<T, const N: usize> {
    len: usize,
    values: [T; N],
}

/// Places behind the values may have those of an earlier reply.
impl<T: PartialEq, const N: usize> PartialEq for ArrayVec<T, N> {
    fn eq(&self, other: &Self) -> bool {
        self.as_slice() == other.as_slice()
    }
}

impl<T: Copy + Default, const N: usize> ArrayVec<T, N> {
    fn empty() -> Self {
        Self { len: 0, values: [T::default(); N] }
    }
}

impl<T, const N: usize> ArrayVec<T, N> {
    pub(crate) fn as_slice(&self) -> &[T] {
        let values = self.values.get(..self.len);
        debug_assert!(values.is_some(), "`len` is at most `N`");
        values.unwrap_or_default()
    }
}

/// A read of consecutive elements.
pub(crate) trait Consecutive: Command + Copy {
    type Element: ConsecutiveElement;

    /// The number of elements.
    fn len(&self) -> usize;
}

/// The value of an element that a read reads.
pub(crate) type ValueOf<C> = <<C as Consecutive>::Element as ConsecutiveElement>::Value;

impl<C: Consecutive, const N: usize> sealed::Sealed for StackReply<C, N> {}

impl<C: Consecutive, const N: usize> fmt::Display for StackReply<C, N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl<C: Consecutive, const N: usize> Command for StackReply<C, N> {
    type Reply = ArrayVec<ValueOf<C>, N>;
    const CODE: Code = C::CODE;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        self.0.write_request(fields);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        C::read_request(fields).map(Self)
    }

    fn write_reply<W: FieldWriter>(&self, reply: &Self::Reply, fields: &mut W) {
        C::Element::write(reply.as_slice(), fields);
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Self::Reply, FieldError> {
        self.read_spelled(self.plain(), fields)
    }

    fn fmt_reply(reply: &Self::Reply, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", text::values(reply.as_slice()))
    }

    fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
        self.0.for_each_run(each);
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
        let mut reply = ArrayVec::empty();
        self.fill(&mut reply, spelling, fields)?;
        Ok(reply)
    }

    fn read_spelled_into<R: FieldReader>(
        &self,
        spelling: Spelling,
        fields: &mut R,
        reply: &mut Option<Self::Reply>,
    ) -> Result<(), FieldError> {
        self.fill(reply.get_or_insert_with(ArrayVec::empty), spelling, fields)
    }

    fn reply_size(&self, spelling: Spelling, framing: Framing) -> u32 {
        self.0.reply_size(spelling, framing)
    }

    fn run(&self) -> Option<Run> {
        self.0.run()
    }
}

impl<C: Consecutive, const N: usize> StackReply<C, N> {
    /// Replaces the values of a reply. After an error it has none.
    fn fill<R: FieldReader>(
        &self,
        reply: &mut ArrayVec<ValueOf<C>, N>,
        spelling: Spelling,
        fields: &mut R,
    ) -> Result<(), FieldError> {
        reply.len = 0;
        let (named, asked) = (usize::from(spelling.count), spelling.count_behind());
        let values = reply.values.get_mut(..named).ok_or(FieldError::WrongLength)?;
        C::Element::read(fields, values)?;
        if named > asked {
            values.rotate_left(named - asked);
        }
        reply.len = asked.min(self.0.len());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use bytes::BytesMut;

    use super::*;
    use crate::command::{ReadDiscretes, ReadRegisters, ReplyError, decode_reply, encode_reply, encode_request};
    use crate::element::{Discrete, Register, Symbol};
    use crate::wire::{AsciiWriter, Framing, ascii};

    /// Compares request and reply with those of the plain read.
    fn assert_same<C: Consecutive<Reply = Vec<ValueOf<C>>>>(read: C, values: Vec<ValueOf<C>>) {
        let on_the_stack = StackReply::<C, 8>(read);
        let mut reply = ArrayVec { len: values.len(), values: [ValueOf::<C>::default(); 8] };
        reply.values[..values.len()].copy_from_slice(&values);
        for framing in [Framing::Ascii, Framing::Binary] {
            let (mut plain, mut stack) = (BytesMut::new(), BytesMut::new());
            encode_request(&read, framing, 1, &mut plain).unwrap();
            encode_request(&on_the_stack, framing, 1, &mut stack).unwrap();
            encode_reply(&read, Ok(&values), framing, 1, &mut plain);
            encode_reply(&on_the_stack, Ok(&reply), framing, 1, &mut stack);
            assert_eq!(plain, stack, "{framing}");
        }
        assert_eq!(reply.as_slice().len(), values.len());

        let (mut plain, mut stack) = (BytesMut::new(), BytesMut::new());
        read.write_request(&mut AsciiWriter::new(&mut plain));
        on_the_stack.write_request(&mut AsciiWriter::new(&mut stack));
        assert_eq!(plain, stack);
        let mut runs = [Vec::new(), Vec::new()];
        read.for_each_run(&mut |run| runs[0].push(run));
        on_the_stack.for_each_run(&mut |run| runs[1].push(run));
        assert_eq!(runs[0], runs[1]);
        assert_eq!((on_the_stack.run(), read.run().is_some()), (read.run(), true));
    }

    #[test]
    fn a_stack_reply_has_the_frames_of_the_plain_read() {
        assert_same(ReadRegisters::new(Register::r(5), 3).unwrap(), vec![1, 0xABCD, 3]);
        assert_same(
            ReadDiscretes::new(Discrete::new(Symbol::M, 7).unwrap(), 4).unwrap(),
            vec![true, false, true, true],
        );
    }

    #[test]
    fn more_values_than_the_array_holds_are_a_mismatch() {
        let read = ReadRegisters::new(Register::r(0), 3).unwrap();
        let mut frame = BytesMut::new();
        encode_reply(&read, Ok(&vec![1, 2, 3]), Framing::Ascii, 1, &mut frame);
        let data = &frame[5..frame.len() + 5 - ascii::OVERHEAD];
        assert!(decode_reply(&StackReply::<_, 3>(read), Framing::Ascii, data).is_ok());
        let refused = decode_reply(&StackReply::<_, 2>(read), Framing::Ascii, data);
        assert_eq!(refused.unwrap_err(), ReplyError::Mismatch(FieldError::WrongLength));
    }
}
