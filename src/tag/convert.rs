//! Conversions between the values of tags and Rust types.
//!
//! A conversion never changes a number: a type that cannot hold all values of a tag is refused
//! before anything is sent. The one exception is a float written to a tag of fewer bits, or with a
//! gain: the nearest value is written, as for text.

use super::codec::Number;
use super::types::Storage;
use super::{GivenKind, Tag, TagAccessError, TagValue, ValueError};
use crate::command::Value;

/// A Rust type that holds the values of one tag: numbers, `bool`, `String`, [`TagValue`], and `Vec`s
/// and arrays of these.
///
/// A tag fits a type that can hold each of its values: `R5` fits `u16`, `u32`, `i32`, `u64`, `i64`,
/// `f32` and `f64`, but not `i16`. Scaled tags fit `f64`, texts fit `String`. An array has as many
/// items as the tag has values.
///
/// Own types can be read as well:
///
/// ```
/// use fatek::tag::{FromTag, TagValue};
///
/// #[derive(Debug, PartialEq)]
/// struct Bar(f64);
///
/// impl FromTag for Bar {
///     fn type_name() -> String {
///         "Bar".to_owned()
///     }
///
///     fn from_values(values: &[TagValue]) -> Option<Self> {
///         f64::from_values(values).map(Bar)
///     }
/// }
/// # fatek::sim::doctest(|station| async move {
/// assert_eq!(station.read::<Bar, _>("R5:u16*0.01").await?, Bar(0.0));
/// # Ok(()) });
/// ```
pub trait FromTag: Sized {
    /// The name of the type, for errors.
    fn type_name() -> String;

    /// Makes it of the values of a tag; `None` if they do not fit.
    fn from_values(values: &[TagValue]) -> Option<Self>;

    /// Returns whether the values of a tag fit, before they are known. By default it is asked for
    /// values of zero.
    fn fits(tag: &Tag) -> bool {
        Self::from_values(&tag.zeros()).is_some()
    }
}

macro_rules! numbers {
    ($($name:ident: $($variant:ident)* | $($digits:ident)*;)*) => {
        impl ValueKind {
            /// Returns whether floats can be written to tags of this kind.
            pub(super) const fn takes_floats(self) -> bool {
                matches!(self, Self::F32 | Self::F64 | Self::Scaled)
            }

            /// Returns whether a Rust type, by its name, holds all values of this kind.
            pub(super) const fn is_held_by(self, rust_type: &str) -> bool {
                $(
                    if is_equal_in_either_case(rust_type.as_bytes(), stringify!($name).as_bytes()) {
                        return matches!(self, $(Self::$variant)|* $(| Self::$digits)*);
                    }
                )*
                matches!(self, Self::Text) && matches!(rust_type.as_bytes(), b"String")
            }
        }

        $(
            impl $crate::tag::FromTag for $name {
                fn type_name() -> String {
                    stringify!($name).to_owned()
                }

                fn from_values(values: &[TagValue]) -> Option<Self> {
                    match values {
                        [value] => value.try_into().ok(),
                        _ => None,
                    }
                }
            }

            impl TryFrom<&TagValue> for $name {
                type Error = $crate::tag::TagAccessError;

                /// # Errors
                /// `TagAccessError::Conversion` unless the type holds all values of this kind.
                fn try_from(value: &TagValue) -> Result<Self, Self::Error> {
                    match *value {
                        $(TagValue::$variant(value) => Ok(value.into()),)*
                        $(
                            TagValue::$digits(digits) => {
                                let number = from_digits(digits.into()).and_then(|number| number.try_into().ok());
                                number.ok_or_else(|| $crate::tag::TagAccessError::conversion(value, stringify!($name)))
                            }
                        )*
                        _ => Err($crate::tag::TagAccessError::conversion(value, stringify!($name))),
                    }
                }
            }

            impl TryFrom<TagValue> for $name {
                type Error = $crate::tag::TagAccessError;

                fn try_from(value: TagValue) -> Result<Self, Self::Error> {
                    (&value).try_into()
                }
            }
        )*
    };
}

pub(super) use numbers;

impl FromTag for String {
    fn type_name() -> String {
        "String".to_owned()
    }

    fn from_values(values: &[TagValue]) -> Option<Self> {
        match values {
            [TagValue::Text(text)] => Some(text.clone()),
            _ => None,
        }
    }
}

impl TryFrom<&TagValue> for String {
    type Error = TagAccessError;

    /// # Errors
    /// [`TagAccessError::Conversion`] unless the value is a text.
    fn try_from(value: &TagValue) -> Result<Self, Self::Error> {
        if let TagValue::Text(text) = value {
            Ok(text.clone())
        } else {
            Err(TagAccessError::conversion(value, "String"))
        }
    }
}

impl TryFrom<TagValue> for String {
    type Error = TagAccessError;

    fn try_from(value: TagValue) -> Result<Self, Self::Error> {
        if let TagValue::Text(text) = value { Ok(text) } else { Err(TagAccessError::conversion(&value, "String")) }
    }
}

impl FromTag for TagValue {
    fn type_name() -> String {
        "TagValue".to_owned()
    }

    fn from_values(values: &[TagValue]) -> Option<Self> {
        match values {
            [value] => Some(value.clone()),
            _ => None,
        }
    }
}

impl<T: FromTag> FromTag for Vec<T> {
    fn type_name() -> String {
        format!("Vec<{}>", T::type_name())
    }

    fn from_values(values: &[TagValue]) -> Option<Self> {
        values.iter().map(|value| T::from_values(std::slice::from_ref(value))).collect()
    }

    fn fits(tag: &Tag) -> bool {
        tag.first_value().is_some_and(|tag| T::fits(&tag))
    }
}

impl<T: FromTag, const N: usize> FromTag for [T; N] {
    fn type_name() -> String {
        format!("[{}; {N}]", T::type_name())
    }

    fn from_values(values: &[TagValue]) -> Option<Self> {
        <Vec<T> as FromTag>::from_values(values)?.try_into().ok()
    }

    fn fits(tag: &Tag) -> bool {
        tag.value_count() == N && Vec::<T>::fits(tag)
    }
}

macro_rules! tag_values {
    ($($name:ty => $variant:ident, $doc:literal;)*) => {
        $(
            impl From<$name> for TagValue {
                #[doc = $doc]
                fn from(value: $name) -> Self {
                    Self::$variant(value.into())
                }
            }
        )*
    };
}

pub(super) use tag_values;

/// A Rust value, or several, that can be written to a tag.
///
/// - `bool` for a discrete.
/// - Integers for tags of integers and decimal digits whose range has them, for `hex`, and for `f32`
///   and `f64` if these have the number exactly.
/// - `f32` and `f64` for tags `f32` and `f64`, which get the nearest value. An integer tag refuses
///   them.
/// - All numbers for tags with gain or offset.
/// - `&str` and `String` for texts.
/// - [`TagValue`] for tags of its type.
/// - `Vec`s, slices and arrays of these for tags with as many values.
///
/// Own types can be written as well:
///
/// ```
/// use fatek::tag::{IntoTagValues, Tag, TagAccessError, TagValue};
///
/// struct Bar(f64);
///
/// impl IntoTagValues for Bar {
///     fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
///         self.0.into_values(tag)
///     }
/// }
/// # fatek::sim::doctest(|station| async move {
/// station.write("R5:u16*0.01", Bar(2.5)).await?;
/// # assert_eq!(station.read::<u16, _>("R5").await?, 250);
/// # Ok(()) });
/// ```
pub trait IntoTagValues {
    /// The values for this tag.
    ///
    /// # Errors
    /// [`TagAccessError::Misfit`] names the tag and the value that does not fit.
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError>;
}

impl Tag {
    /// The value of a number.
    pub(super) fn value_of_number(&self, number: Number) -> Result<TagValue, ValueError> {
        let tag_type = self.tag_type();
        match (self.storage, self.scale) {
            (Storage::Bits(..), Some(_)) => Ok(TagValue::Scaled(number.as_f64())),
            (Storage::Bits(format, _), None) => format.take(number).ok_or(match number {
                Number::Integer(_) if format.is_float() && format.nearest(number.as_f64()).is_some() => {
                    ValueError::Inexact { tag_type }
                }
                Number::Integer(_) if tag_type.is_number() => ValueError::OutOfRange { tag_type },
                Number::Single(_) | Number::Double(_) if format.is_float() => ValueError::OutOfRange { tag_type },
                Number::Single(_) | Number::Double(_) if tag_type.is_number() => {
                    ValueError::Kind { tag_type, kind: GivenKind::Float }
                }
                Number::Integer(_) | Number::Single(_) | Number::Double(_) => {
                    ValueError::Kind { tag_type, kind: GivenKind::Number }
                }
            }),
            (Storage::Text(_) | Storage::BitsOf(_), _) => Err(ValueError::Kind { tag_type, kind: GivenKind::Number }),
        }
    }
}

/// The value of a single one, checked by encoding it: also its raw number must fit.
fn single(
    tag: &Tag,
    value: Result<TagValue, ValueError>,
    given: impl FnOnce() -> String,
) -> Result<Vec<TagValue>, TagAccessError> {
    if tag.is_bits_of_register() {
        return Err(TagAccessError::BitsOfRegister(ValueError::BitsOfRegister { tag: *tag }));
    }
    let checked = value.and_then(|value| {
        let values = vec![value];
        tag.encode(&values).map(|_| values)
    });
    checked.map_err(|error| {
        // The text has both kinds already.
        let reason = Some(error).filter(|error| !matches!(error, ValueError::WrongType { .. })).map(Box::new);
        TagAccessError::Misfit { tag: *tag, given: given(), reason }
    })
}

macro_rules! written_numbers {
    ($($name:ident $variant:ident $form:literal;)*) => {
        $(
            impl IntoTagValues for $name {
                fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
                    single(tag, tag.value_of_number(Number::$variant(self.into())), || format!($form, self))
                }
            }
        )*
    };
}

// Debug shows that 1.0 is a float, and uses an exponent where Display would write up to 309 digits.
written_numbers! {
    u8 Integer "{}"; i8 Integer "{}"; u16 Integer "{}"; i16 Integer "{}"; u32 Integer "{}"; i32 Integer "{}";
    u64 Integer "{}"; i64 Integer "{}"; f32 Single "{:?}"; f64 Double "{:?}";
}

impl IntoTagValues for bool {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        single(tag, Ok(TagValue::Bool(self)), || self.to_string())
    }
}

impl IntoTagValues for &str {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        let text = TagValue::Text(self.to_owned());
        single(tag, Ok(text.clone()), || text.to_string())
    }
}

impl IntoTagValues for String {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        self.as_str().into_values(tag)
    }
}

impl IntoTagValues for TagValue {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        let given = self.clone();
        single(tag, Ok(self), || format!("{given} ({})", given.description()))
    }
}

impl<T: IntoTagValues> IntoTagValues for Vec<T> {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        let given = self.len();
        if given != tag.value_count() {
            return Err(TagAccessError::misfit_of(tag, given));
        }
        let singles = tag.singles().zip(self).map(|(tag, value)| value.into_values(&tag));
        // A text is one value.
        Ok(singles.collect::<Result<Vec<_>, _>>()?.concat())
    }
}

impl<T: IntoTagValues + Clone> IntoTagValues for &[T] {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        self.to_vec().into_values(tag)
    }
}

impl<T: IntoTagValues + Clone> IntoTagValues for &Vec<T> {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        self.clone().into_values(tag)
    }
}

impl<T: IntoTagValues + Clone, const N: usize> IntoTagValues for &[T; N] {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        self.to_vec().into_values(tag)
    }
}

impl IntoTagValues for &String {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        self.as_str().into_values(tag)
    }
}

impl<T: IntoTagValues, const N: usize> IntoTagValues for [T; N] {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        Vec::from(self).into_values(tag)
    }
}

macro_rules! raw_values {
    ($($name:ty => $variant:ident;)*) => {
        $(
            impl TryFrom<Value> for $name {
                type Error = TagAccessError;

                /// # Errors
                /// [`TagAccessError::Width`] for a value of another width.
                fn try_from(value: Value) -> Result<Self, Self::Error> {
                    if let Value::$variant(value) = value {
                        Ok(value)
                    } else {
                        Err(TagAccessError::Width { found: value.width(), rust_type: stringify!($name) })
                    }
                }
            }
        )*
    };
}

raw_values! {
    bool => Bit;
    u16 => Word;
    u32 => DWord;
}
