//! Gain and offset: from a raw number to the quantity that it stands for, and back.
//!
//! # What is promised
//!
//! - The value of an integer is the `f64` nearest to `raw × gain + offset` as decimals, as long as neither the
//!   product nor the offset takes more than 14 digits: 123 × 0.1 is 12.3 and prints so, not 12.3 and a bit.
//! - The value of an integer leads back to it, whatever gain and offset, also by way of its text.
//! - So does that of an `f32`, unless it is too small beside the offset for their sum to tell. NaN stays NaN, and
//!   infinity infinity.
//! - A value that no raw number stands for is refused; nothing is clamped or wrapped.

use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::str::FromStr;

use super::TagValue;
use super::kind::Shape;

/// A gain and an offset: `value = raw × gain + offset`.
///
/// It is written as in a tag: `*0.1`, `+3`, `*0.1-40`, and prints itself so.
///
/// ```
/// use fatek::tag::Scale;
///
/// let celsius: Scale = "*0.1-40".parse()?;
/// assert_eq!(celsius, Scale::new(0.1, -40.0)?);
/// assert_eq!(celsius.to_string(), "*0.1-40");
/// assert!(Scale::new(0.0, 5.0).is_err());
/// # Ok::<(), fatek::tag::ScaleError>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Scale {
    gain: f64,
    /// Never -0.
    offset: f64,
    // How many digits each has behind the point. They follow from the numbers, so comparisons leave them out.
    gain_decimals: u8,
    offset_decimals: u8,
}

/// Why a gain and an offset are no scale.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ScaleError {
    /// A gain of 0, no number at all, or so far from 1 that values would be.
    #[error("the gain is {gain:?}, and it must be from 1e-200 to 1e200, or the same below 0")]
    #[non_exhaustive]
    Gain {
        /// What was given.
        gain: f64,
    },
    /// An offset that is no number.
    #[error("the offset is {offset:?}, and it must be a number")]
    #[non_exhaustive]
    Offset {
        /// What was given.
        offset: f64,
    },
    /// An offset beside which the gain is lost: neighbouring raw numbers would have the same value.
    #[error("the offset {offset:?} is more than 2.8e14 times the gain {gain:?}, so values could not be told apart")]
    #[non_exhaustive]
    Coarse {
        /// The gain given.
        gain: f64,
        /// The offset given.
        offset: f64,
    },
    /// A text that is no scale.
    #[error("`{input}` is not a scale: it must be *GAIN, +OFFSET, -OFFSET or both in this order, such as *0.1-40")]
    #[non_exhaustive]
    Malformed {
        /// The text as given.
        input: String,
    },
}

/// A 32-bit number and so many gains need 49 bits, which leaves an `f64` with 4 for its roundings.
const MAX_GAINS: f64 = (1_u64 << 48) as f64;

impl Scale {
    /// This gain and this offset.
    ///
    /// # Errors
    /// [`ScaleError::Gain`] unless the gain is from 1e-200 to 1e200 in size, [`ScaleError::Offset`] unless the offset is
    /// finite, and [`ScaleError::Coarse`] when it is more than 2⁴⁸ gains.
    pub fn new(gain: f64, offset: f64) -> Result<Self, ScaleError> {
        // NaN is in no range.
        if !(1e-200..=1e200).contains(&gain.abs()) {
            return Err(ScaleError::Gain { gain });
        }
        if !offset.is_finite() {
            return Err(ScaleError::Offset { offset });
        }
        if offset.abs() > gain.abs() * MAX_GAINS {
            return Err(ScaleError::Coarse { gain, offset });
        }
        // -0 + 0 is 0.
        let offset = offset + 0.0;
        Ok(Self { gain, offset, gain_decimals: decimals(gain), offset_decimals: decimals(offset) })
    }

    /// What a raw number is multiplied with.
    #[must_use]
    pub fn gain(self) -> f64 {
        self.gain
    }

    /// What is added to that.
    #[must_use]
    pub fn offset(self) -> f64 {
        self.offset
    }

    /// The value of a raw number of this shape.
    pub(super) fn value(self, shape: Shape, bits: u32) -> f64 {
        let raw = shape.value(bits);
        let raw_decimals = if let TagValue::F32(float) = raw { decimals(float) } else { 0 };
        let product = raw.as_f64().unwrap_or(f64::NAN) * self.gain;
        // A float keeps the sign of its 0 where there is no sum; an integer's 0 has none.
        let value = if shape == Shape::F32 && self.offset == 0.0 { product } else { product + self.offset };
        let decimals = self.gain_decimals.saturating_add(raw_decimals).max(self.offset_decimals);
        let rounded = round(value, product.abs().max(self.offset.abs()), decimals);
        if self.bits(shape, rounded) == Some(bits) { rounded } else { value }
    }

    /// The raw number of this shape whose value is nearest to this one; `None` if it is not in the shape's range.
    pub(super) fn bits(self, shape: Shape, value: f64) -> Option<u32> {
        let raw = self.raw(value);
        if raw.is_infinite() && value.is_finite() { None } else { shape.nearest(raw) }
    }

    /// What stands for a value before it is rounded to a raw number.
    pub(super) fn raw(self, value: f64) -> f64 {
        (value - self.offset) / self.gain
    }
}

/// The value with so many digits behind the point, when that is exact: what it was made from is no larger than this
/// and has at most 14 digits, so that the roundings on the way are not seen.
fn round(value: f64, largest: f64, decimals: u8) -> f64 {
    const POWERS: [f64; 23] = [
        1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19,
        1e20, 1e21, 1e22,
    ];
    match POWERS.get(usize::from(decimals)) {
        Some(power) if largest * power < 1e14 => (value * power).round() / power,
        _ => value,
    }
}

/// How many digits the shortest decimal of this number has behind the point.
fn decimals(number: impl fmt::Display) -> u8 {
    let text = number.to_string();
    let digits = text.split_once('.').map_or(0, |(_, digits)| digits.len());
    u8::try_from(digits).unwrap_or(u8::MAX)
}

// -0 is gone and NaN never came, so equal bits are equal numbers.

impl PartialEq for Scale {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Scale {}

impl PartialOrd for Scale {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Scale {
    fn cmp(&self, other: &Self) -> Ordering {
        self.gain.total_cmp(&other.gain).then(self.offset.total_cmp(&other.offset))
    }
}

impl Hash for Scale {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (self.gain.to_bits(), self.offset.to_bits()).hash(state);
    }
}

impl FromStr for Scale {
    type Err = ScaleError;

    /// Reads `*GAIN`, `+OFFSET`, `-OFFSET`, or a gain with an offset behind it; a gain can be negative.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let malformed = || ScaleError::Malformed { input: text.to_owned() };
        let (gain, rest) = match text.strip_prefix('*') {
            Some(rest) => {
                let size = rest.strip_prefix('-').unwrap_or(rest);
                let sign = rest.len() - size.len();
                rest.split_at(sign + unsigned(size).ok_or_else(malformed)?)
            }
            None => ("1", text),
        };
        let offset = match rest.strip_prefix(['+', '-']) {
            Some(number) if unsigned(number) == Some(number.len()) => rest,
            None if rest.is_empty() && !text.is_empty() => "0",
            _ => return Err(malformed()),
        };
        Self::new(gain.parse().map_err(|_| malformed())?, offset.parse().map_err(|_| malformed())?)
    }
}

impl fmt::Display for Scale {
    /// The shortest text that parses to the same: a gain of 1 is left out where there is an offset.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.gain != 1.0 || self.offset == 0.0 {
            write!(f, "*{}", Shortest(self.gain))?;
        }
        match self.offset {
            0.0 => Ok(()),
            offset if offset < 0.0 => write!(f, "{}", Shortest(offset)),
            offset => write!(f, "+{}", Shortest(offset)),
        }
    }
}

/// A number with neither an idle `.0` nor a row of zeros.
struct Shortest(f64);

impl fmt::Display for Shortest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = format!("{:?}", self.0);
        f.write_str(text.strip_suffix(".0").unwrap_or(&text))
    }
}

/// How long the decimal number is that the text begins with: digits, with a point and with an exponent if need be.
fn unsigned(text: &str) -> Option<usize> {
    let digits = |from: usize| text.bytes().skip(from).take_while(u8::is_ascii_digit).count();
    let byte = |at: usize| text.as_bytes().get(at).copied();
    let mut end = digits(0);
    let mut any = end;
    if byte(end) == Some(b'.') {
        let behind = digits(end + 1);
        any += behind;
        end += 1 + behind;
    }
    if any == 0 {
        return None;
    }
    if let Some(b'e' | b'E') = byte(end) {
        let sign = usize::from(matches!(byte(end + 1), Some(b'+' | b'-')));
        // `e` without digits is no exponent, and no number goes on so.
        match digits(end + 1 + sign) {
            0 => return None,
            exponent => end += 1 + sign + exponent,
        }
    }
    Some(end)
}
