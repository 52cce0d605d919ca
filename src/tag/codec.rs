//! Codecs: the bits and the text of values.

use std::fmt;
use std::marker::PhantomData;
use std::str::FromStr;

use super::{TagType, ValueError};

/// The bits and the text of the values of one format.
///
/// Every bit pattern has a value, so decoding cannot fail.
pub(super) trait Codec {
    /// The Rust type of a value.
    type Value: Primitive;

    /// Number of bits of a value, at most 64.
    const BITS: u32 = <Self::Value as Primitive>::BITS;

    /// `true` if values can have a fraction and a sign of 0.
    const IS_FLOAT: bool = false;

    /// Decodes a value from its bits, which are zero above [`BITS`](Self::BITS).
    fn decode(bits: u64) -> Self::Value {
        Self::Value::from_raw(bits)
    }

    /// Encodes a value.
    fn encode(value: Self::Value) -> u64 {
        value.into_raw()
    }

    /// The value as a number; `None` if it is not a number.
    fn number(value: Self::Value) -> Option<f64> {
        Some(value.to_f64())
    }

    /// The value nearest to a number; `None` if it is out of range, or the type is not scalable.
    fn nearest(number: f64) -> Option<Self::Value>;

    /// The value of a number to be written; `None` if there is none.
    fn take(number: Number) -> Option<Self::Value>;

    /// Number of decimals of the shortest text of a value.
    fn decimals(_value: Self::Value) -> u8 {
        0
    }

    /// Displays a value as text that parses to it.
    fn display(value: Self::Value, f: &mut fmt::Formatter<'_>) -> fmt::Result;

    /// Parses a value that does not begin with `0x`.
    fn parse_plain(text: &str, tag_type: TagType) -> Result<Self::Value, ValueError>;

    /// Parses the digits behind `0x`: the bits of a value.
    fn parse_bits(digits: &str, _tag_type: TagType) -> Result<u64, ValueError> {
        parse_hex(digits, Self::BITS / 4)
    }

    /// Parses a value.
    fn parse(text: &str, tag_type: TagType) -> Result<Self::Value, ValueError> {
        match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
            Some(digits) => Ok(Self::decode(Self::parse_bits(digits, tag_type)?)),
            None => Self::parse_plain(text, tag_type),
        }
    }
}

fn parse_hex(digits: &str, max: u32) -> Result<u64, ValueError> {
    let is_hex = (1..=max as usize).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_hexdigit());
    u64::from_str_radix(digits, 16).ok().filter(|_| is_hex).ok_or(ValueError::BadHex { max })
}

/// The state of a discrete: one bit.
pub(super) struct Bit;

impl Codec for Bit {
    type Value = bool;

    fn number(_on: bool) -> Option<f64> {
        None
    }

    fn nearest(_number: f64) -> Option<bool> {
        None
    }

    fn take(_number: Number) -> Option<bool> {
        None
    }

    fn display(on: bool, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&u8::from(on), f)
    }

    fn parse_plain(text: &str, tag_type: TagType) -> Result<bool, ValueError> {
        match text.to_ascii_lowercase().as_str() {
            "0" | "false" | "off" => Ok(false),
            "1" | "true" | "on" => Ok(true),
            _ => Err(ValueError::Malformed { tag_type }),
        }
    }

    fn parse_bits(digits: &str, tag_type: TagType) -> Result<u64, ValueError> {
        match digits {
            "0" => Ok(0),
            "1" => Ok(1),
            _ => Err(ValueError::Malformed { tag_type }),
        }
    }
}

/// An integer, as decimal text.
pub(super) struct Integer<T>(PhantomData<T>);

impl<T: Primitive + fmt::Display + TryFrom<i128>> Codec for Integer<T> {
    type Value = T;

    #[allow(clippy::cast_possible_truncation, reason = "within i128, and rounded")]
    fn nearest(number: f64) -> Option<T> {
        let rounded = number.round();
        // False for NaN.
        let fits = rounded.abs() < 1e36;
        T::try_from(rounded as i128).ok().filter(|_| fits)
    }

    fn take(number: Number) -> Option<T> {
        number.integer()?.try_into().ok()
    }

    fn display(value: T, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        value.fmt(f)
    }

    fn parse_plain(text: &str, tag_type: TagType) -> Result<T, ValueError> {
        let digits = text.strip_prefix(['-', '+']).unwrap_or(text);
        if digits.is_empty() || !digits.bytes().all(|b| b.is_ascii_digit()) {
            return Err(ValueError::Malformed { tag_type });
        }
        // These are digits, so the only error is that an i128 is too small.
        let number: i128 = text.parse().map_err(|_| ValueError::OutOfRange { tag_type })?;
        T::try_from(number).map_err(|_| ValueError::OutOfRange { tag_type })
    }
}

/// A floating-point number, as decimal text.
pub(super) struct Float<T>(PhantomData<T>);

impl<T: Real> Codec for Float<T> {
    type Value = T;
    const IS_FLOAT: bool = true;

    fn nearest(number: f64) -> Option<T> {
        let float = T::nearest(number);
        let rounded = float.to_f64();
        (rounded.is_finite() || !number.is_finite()).then_some(float)
    }

    fn take(number: Number) -> Option<T> {
        match number {
            Number::Single(float) => Some(T::of_single(float)),
            Number::Double(float) => Self::nearest(float),
            // An integer is not rounded.
            Number::Integer(integer) => {
                #[allow(clippy::cast_possible_truncation, reason = "compared with the integer")]
                let is_exact = |&float: &T| float.to_f64() as i128 == integer;
                Self::nearest(number.as_f64()).filter(is_exact)
            }
        }
    }

    fn decimals(value: T) -> u8 {
        decimals(value)
    }

    fn display(value: T, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Debug uses an exponent where Display would write up to 309 digits.
        write!(f, "{value:?}")
    }

    fn parse_plain(text: &str, tag_type: TagType) -> Result<T, ValueError> {
        let number: T = text.parse().map_err(|_| ValueError::Malformed { tag_type })?;
        if has_overflowed(number.to_f64(), text) { Err(ValueError::OutOfRange { tag_type }) } else { Ok(number) }
    }

    fn parse_bits(digits: &str, tag_type: TagType) -> Result<u64, ValueError> {
        let bits = parse_hex(digits, Self::BITS / 4)?;
        let all = Self::BITS / 4;
        // Fewer digits would be a tiny number, which is hardly meant.
        if digits.len() < all as usize { Err(ValueError::PartialBits { tag_type, digits: all }) } else { Ok(bits) }
    }
}

/// A decimal number with a digit in each four bits. The value has the bits: those of a digit beyond
/// 9 are no number, and are displayed as hexadecimal digits.
pub(super) struct Bcd<T>(PhantomData<T>);

/// The number of these decimal digits; `None` if one is beyond 9.
pub(super) fn from_digits(bits: u32) -> Option<u32> {
    let digits = (0..8).rev().map(|n| bits >> (4 * n) & 0xF);
    digits.into_iter().try_fold(0, |number, digit| (digit <= 9).then_some(number * 10 + digit))
}

/// The decimal digits of a number below 10^8.
fn to_digits(number: u32) -> u32 {
    (0..8).fold(0, |bits, n| bits | (number / 10_u32.pow(n) % 10) << (4 * n))
}

impl<T: Primitive + TryFrom<u32>> Codec for Bcd<T> {
    type Value = T;

    fn number(value: T) -> Option<f64> {
        from_digits(u32::try_from(value.into_raw()).ok()?).map(f64::from)
    }

    fn nearest(_number: f64) -> Option<T> {
        None
    }

    fn take(number: Number) -> Option<T> {
        let number = u32::try_from(number.integer()?).ok().filter(|&number| number < 100_000_000)?;
        to_digits(number).try_into().ok()
    }

    fn display(value: T, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match u32::try_from(value.into_raw()).ok().and_then(from_digits) {
            Some(number) => fmt::Display::fmt(&number, f),
            None => Hex::<T>::show(value, f),
        }
    }

    fn parse_plain(text: &str, tag_type: TagType) -> Result<T, ValueError> {
        let number = Integer::<u32>::parse_plain(text, tag_type)?;
        Self::take(Number::Integer(number.into())).ok_or(ValueError::OutOfRange { tag_type })
    }
}

/// Bits as hexadecimal digits.
pub(super) struct Hex<T>(PhantomData<T>);

impl<T: Primitive> Hex<T> {
    fn show(value: T, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:0digits$X}", value.into_raw(), digits = T::BITS as usize / 4)
    }
}

impl<T: Primitive + TryFrom<i128>> Codec for Hex<T> {
    type Value = T;

    fn nearest(_number: f64) -> Option<T> {
        None
    }

    fn take(number: Number) -> Option<T> {
        number.integer()?.try_into().ok()
    }

    fn display(value: T, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Self::show(value, f)
    }

    fn parse_plain(_text: &str, _tag_type: TagType) -> Result<T, ValueError> {
        Err(ValueError::NotMarked { bits: T::BITS })
    }
}

/// A number to be written.
#[derive(Clone, Copy)]
pub(super) enum Number {
    Integer(i128),
    /// Apart from `Double`, since a conversion of a signalling NaN changes its bits.
    Single(f32),
    Double(f64),
}

impl Number {
    /// The integer, or `None` for a float. A float is not written to an integer.
    fn integer(self) -> Option<i128> {
        if let Self::Integer(integer) = self { Some(integer) } else { None }
    }

    /// The `f64` nearest to it.
    #[allow(clippy::cast_precision_loss, reason = "the nearest f64 is wanted")]
    pub(super) fn as_f64(self) -> f64 {
        match self {
            Self::Integer(integer) => integer as f64,
            Self::Single(float) => float.into(),
            Self::Double(float) => float,
        }
    }
}

/// A number, or a state, of a fixed number of bits.
pub(super) trait Primitive: Copy {
    const BITS: u32;

    /// The nearest `f64`.
    fn to_f64(self) -> f64;

    fn from_raw(bits: u64) -> Self;

    fn into_raw(self) -> u64;
}

impl Primitive for bool {
    const BITS: u32 = 1;

    fn to_f64(self) -> f64 {
        self.into()
    }

    fn from_raw(bits: u64) -> Self {
        bits != 0
    }

    fn into_raw(self) -> u64 {
        self.into()
    }
}

/// A floating-point number.
pub(super) trait Real: Primitive + fmt::Debug + fmt::Display + FromStr {
    /// The float nearest to a number.
    fn nearest(number: f64) -> Self;

    /// The float that equals this one.
    fn of_single(number: f32) -> Self;
}

macro_rules! primitives {
    ($($primitive:ty),*) => {
        $(
            impl Primitive for $primitive {
                const BITS: u32 = 8 * size_of::<Self>() as u32;

                #[allow(clippy::cast_precision_loss, clippy::cast_lossless, reason = "the nearest f64 is wanted")]
                fn to_f64(self) -> f64 {
                    self as f64
                }

                fn from_raw(bits: u64) -> Self {
                    let mut bytes = [0; size_of::<Self>()];
                    bytes.iter_mut().zip(bits.to_le_bytes()).for_each(|(byte, bits)| *byte = bits);
                    Self::from_le_bytes(bytes)
                }

                fn into_raw(self) -> u64 {
                    let mut bytes = [0; 8];
                    bytes.iter_mut().zip(self.to_le_bytes()).for_each(|(byte, bits)| *byte = bits);
                    u64::from_le_bytes(bytes)
                }
            }
        )*
    };
}
pub(super) use primitives;

/// Number of decimals of the shortest text of a number.
pub(super) fn decimals(number: impl fmt::Display) -> u8 {
    let text = number.to_string();
    let digits = text.split_once('.').map_or(0, |(_, digits)| digits.len());
    u8::try_from(digits).unwrap_or(u8::MAX)
}

/// Returns whether a text such as `1e39` was parsed to infinity; `inf` itself is valid.
pub(super) fn has_overflowed(number: f64, text: &str) -> bool {
    number.is_infinite() && text.bytes().any(|b| b.is_ascii_digit())
}
