//! The commands for consecutive elements, 43 to 47: two macros, for reads and for writes.

use std::fmt;

use crate::element::{Discrete, Element, ElementError, Register, Register32, Value};
use crate::wire::{FieldError, FieldReader, FieldWriter};

/// An element of 43 to 47: [`Discrete`] with a `bool` value, [`Register`] with a `u16` value, or
/// [`Register32`] with a `u32` value.
pub trait ConsecutiveElement:
    Copy
    + fmt::Debug
    + fmt::Display
    + PartialEq
    + Into<Element>
    + TryFrom<Element, Error = ElementError>
    + Send
    + Sync
    + super::sealed::Sealed
    + 'static
{
    /// The type of its value.
    type Value: Copy + Default + fmt::Debug + PartialEq + Eq + std::hash::Hash + Into<Value> + Send + Sync + 'static;

    /// Writes values.
    fn write<W: FieldWriter>(values: &[Self::Value], fields: &mut W);

    /// Reads one value for each place of the slice.
    ///
    /// # Errors
    /// [`FieldError::Truncated`], [`FieldError::NotHex`], [`FieldError::NotABit`].
    fn read<R: FieldReader>(fields: &mut R, into: &mut [Self::Value]) -> Result<(), FieldError>;
}

elements! {
    Discrete    bool  bits;
    Register    u16   words;
    Register32  u32   dwords;
}

macro_rules! elements {
    ($($element:ident $value:ident $fields:ident;)*) => {
        $(
            impl super::sealed::Sealed for $element {}

            impl ConsecutiveElement for $element {
                type Value = $value;

                fn write<W: FieldWriter>(values: &[$value], fields: &mut W) {
                    fields.$fields(values);
                }

                fn read<R: FieldReader>(fields: &mut R, into: &mut [$value]) -> Result<(), FieldError> {
                    fields.$fields(into)
                }
            }
        )*
    };
}
use elements;

/// A command that reads consecutive elements: its type, of an element or generic over it.
macro_rules! read_consecutive {
    ($(#[$doc:meta])* $name:ident $(<$generic:ident: $bound:ident>)? of $element:ident, count $counts:literal) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub struct $name $(<$generic>)? {
            first: $element,
            count: usize,
        }

        impl $(<$generic: $bound>)? $name $(<$generic>)? {
            /// A read of `count` elements from `first` on.
            ///
            /// # Errors
            #[doc = concat!("[`InvalidRequest::Count`] unless `count` is ", $counts, ";")]
            /// [`InvalidRequest::PastTheEnd`]; [`InvalidRequest::OneByOne`].
            pub fn new(first: $element, count: usize) -> Result<Self, InvalidRequest> {
                limits::consecutive(Self::CODE, first.into(), count)?;
                Ok(Self { first, count })
            }

            /// The first element.
            #[must_use]
            pub fn first(&self) -> $element {
                self.first
            }

            /// The number of elements.
            #[must_use]
            pub fn count(&self) -> usize {
                self.count
            }

            fn elements(&self) -> Run {
                Run { first: self.first.into(), count: self.count }
            }
        }

        impl $(<$generic: $bound>)? sealed::Sealed for $name $(<$generic>)? {}

        impl $(<$generic: $bound>)? fmt::Display for $name $(<$generic>)? {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                text::command(f, Self::CODE, text::Elements(self.elements()))
            }
        }

        impl $(<$generic: $bound>)? Command for $name $(<$generic>)? {
            type Reply = Vec<<$element as ConsecutiveElement>::Value>;
            const CODE: Code = Code::$name;

            fn write_request<W: FieldWriter>(&self, fields: &mut W) {
                fields.count(self.count);
                fields.element(self.first.into());
            }

            fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
                let count = fields.count()?;
                fields.layout(1, 0)?;
                let first = fields.element()?.try_into()?;
                let request = Self { first, count };
                limits::received(Self::CODE, request.elements())?;
                Ok(request)
            }

            fn write_reply<W: FieldWriter>(&self, reply: &Self::Reply, fields: &mut W) {
                <$element as ConsecutiveElement>::write(reply, fields);
            }

            fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Self::Reply, FieldError> {
                let mut values = blank(self.count);
                <$element as ConsecutiveElement>::read(fields, &mut values)?;
                Ok(values)
            }

            fn fmt_reply(reply: &Self::Reply, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{}", text::values(reply))
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

            fn read_spelled<R: FieldReader>(
                &self,
                spelling: Spelling,
                fields: &mut R,
            ) -> Result<Self::Reply, FieldError> {
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

        impl $(<$generic: $bound>)? Consecutive for $name $(<$generic>)? {
            type Element = $element;

            fn len(&self) -> usize {
                self.count
            }
        }
    };
}
pub(super) use read_consecutive;

/// A command that writes consecutive elements: its type, of an element or generic over it.
macro_rules! write_consecutive {
    ($(#[$doc:meta])* $name:ident $(<$generic:ident: $bound:ident>)? of $element:ident,
        $values:ident $meaning:literal, count $counts:literal) => {
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Eq, Hash)]
        pub struct $name $(<$generic: $bound>)? {
            first: $element,
            $values: Vec<<$element as ConsecutiveElement>::Value>,
        }

        impl $(<$generic: $bound>)? $name $(<$generic>)? {
            #[doc = concat!("A write of these ", stringify!($values), " to `first` and the elements after it.")]
            ///
            /// # Errors
            #[doc = concat!("[`InvalidRequest::Count`] unless there are ", $counts, ";")]
            /// [`InvalidRequest::PastTheEnd`]; [`InvalidRequest::OneByOne`].
            pub fn new(
                first: $element,
                $values: impl Into<Vec<<$element as ConsecutiveElement>::Value>>,
            ) -> Result<Self, InvalidRequest> {
                let $values = $values.into();
                limits::consecutive(Self::CODE, first.into(), $values.len())?;
                Ok(Self { first, $values })
            }

            /// The first element.
            #[must_use]
            pub fn first(&self) -> $element {
                self.first
            }

            #[doc = $meaning]
            #[must_use]
            pub fn $values(&self) -> &[<$element as ConsecutiveElement>::Value] {
                &self.$values
            }

            fn elements(&self) -> Run {
                Run { first: self.first.into(), count: self.$values.len() }
            }
        }

        impl $(<$generic: $bound>)? sealed::Sealed for $name $(<$generic>)? {}

        impl $(<$generic: $bound>)? fmt::Display for $name $(<$generic>)? {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                let (elements, values) = (text::Elements(self.elements()), text::values(&self.$values));
                text::command(f, Self::CODE, format_args!("{elements} = {values}"))
            }
        }

        impl $(<$generic: $bound>)? Command for $name $(<$generic>)? {
            type Reply = ();
            const CODE: Code = Code::$name;
            const IMPLIED_REPLY: Option<()> = Some(());

            fn write_request<W: FieldWriter>(&self, fields: &mut W) {
                fields.count(self.$values.len());
                fields.element(self.first.into());
                <$element as ConsecutiveElement>::write(&self.$values, fields);
            }

            fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
                let count = fields.count()?;
                fields.layout(1, count)?;
                let first = fields.element()?.try_into()?;
                let mut $values = blank(count);
                <$element as ConsecutiveElement>::read(fields, &mut $values)?;
                let request = Self { first, $values };
                limits::received(Self::CODE, request.elements())?;
                Ok(request)
            }

            fn write_reply<W: FieldWriter>(&self, (): &(), _fields: &mut W) {}

            fn read_reply<R: FieldReader>(&self, _fields: &mut R) -> Result<(), FieldError> {
                Ok(())
            }

            fn fmt_reply((): &(), f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("done")
            }

            fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
                each(self.elements());
            }

            fn plain(&self) -> Spelling {
                Spelling::new(Self::CODE, self.$values.len())
            }

            fn candidates(&self, longer: bool, framing: Framing) -> Candidates {
                self.elements().write_candidates(longer, framing, &self.$values)
            }

            fn write_spelled<W: FieldWriter>(&self, spelling: Spelling, fields: &mut W) {
                spelling::write_fields(self, self.first.into(), &self.$values, spelling, fields);
            }

            fn run(&self) -> Option<Run> {
                Some(self.elements())
            }
        }
    };
}
pub(super) use write_consecutive;
