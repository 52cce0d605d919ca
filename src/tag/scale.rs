//! Gain and offset between raw numbers and engineering values.
//!
//! Invariants:
//! - The value of an integer is the `f64` nearest to the decimal `raw * gain + offset`, if neither
//!   product nor offset has more than 14 digits: 123 * 0.1 is 12.3, not 12.300000000000001.
//! - The value of an integer encodes to the same integer, also after display and parsing.
//! - The value of an `f32` does, too, unless it is too small beside the offset. NaN stays NaN, and
//!   infinity stays infinity.
//! - A value whose raw number is out of range is refused, never clamped or wrapped.

use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::str::FromStr;

use super::ValueError;
use super::codec::{decimals, has_overflowed};
use super::types::Format;
use crate::printable::excerpt;

/// A gain and an offset: `value = raw × gain + offset`.
///
/// Parsed and displayed as in a tag: `*0.1`, `+3`, `*0.1-40`.
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
    // Decimals of each. They follow from the numbers, so comparisons ignore them.
    gain_decimals: u8,
    offset_decimals: u8,
}

/// Why a gain and an offset are not a valid scale.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ScaleError {
    /// The gain is 0, not a number, too small or too large.
    #[error("the gain is {gain:?}, and it must be from 1e-200 to 1e200, or from -1e200 to -1e-200")]
    #[non_exhaustive]
    Gain {
        /// The gain.
        gain: f64,
    },
    /// The offset is not a finite number.
    #[error("the offset is {offset:?}, and it must be a finite number")]
    #[non_exhaustive]
    Offset {
        /// The offset.
        offset: f64,
    },
    /// The offset is so large beside the gain that adjacent raw numbers would have the same value.
    #[error("the offset {offset:?} is more than 2.8e14 times the gain {gain:?}, so values could not be told apart")]
    #[non_exhaustive]
    Coarse {
        /// The gain.
        gain: f64,
        /// The offset.
        offset: f64,
    },
    /// The text is not a scale.
    #[error(
        "`{}` is not a scale: it must be *GAIN, +OFFSET, -OFFSET or both in this order, such as *0.1-40",
        excerpt(input)
    )]
    #[non_exhaustive]
    Malformed {
        /// The text.
        input: String,
    },
}

/// Largest ratio of offset and gain. A sum of such an offset and a 32-bit number has 49 bits, which
/// leaves 4 bits of an `f64` for rounding.
const MAX_GAINS: f64 = (1_u64 << 48) as f64;

impl Scale {
    /// A scale with this gain and offset.
    ///
    /// # Errors
    /// - [`ScaleError::Gain`] unless the absolute value of the gain is from 1e-200 to 1e200
    /// - [`ScaleError::Offset`] unless the offset is finite
    /// - [`ScaleError::Coarse`] if the offset is more than 2^48 times the gain
    pub fn new(gain: f64, offset: f64) -> Result<Self, ScaleError> {
        // False for NaN.
        if !(1e-200..=1e200).contains(&gain.abs()) {
            return Err(ScaleError::Gain { gain });
        }
        if !offset.is_finite() {
            return Err(ScaleError::Offset { offset });
        }
        if offset.abs() > gain.abs() * MAX_GAINS {
            return Err(ScaleError::Coarse { gain, offset });
        }
        // Turns -0 into 0.
        let offset = offset + 0.0;
        Ok(Self { gain, offset, gain_decimals: decimals(gain), offset_decimals: decimals(offset) })
    }

    /// The factor of the raw number.
    #[must_use]
    pub fn gain(self) -> f64 {
        self.gain
    }

    /// The number added to the product.
    #[must_use]
    pub fn offset(self) -> f64 {
        self.offset
    }

    /// The value of a raw number of this format, from its bits.
    pub(super) fn value(self, format: Format, bits: u64) -> f64 {
        let raw = format.value(bits).as_f64().unwrap_or(f64::NAN);
        let product = raw * self.gain;
        // Without an offset, a float of -0 stays -0; an integer has no -0.
        let value = if format.is_float() && self.offset == 0.0 { product } else { product + self.offset };
        let decimals = self.gain_decimals.saturating_add(format.decimals(bits)).max(self.offset_decimals);
        let rounded = round(value, product.abs().max(self.offset.abs()), decimals);
        if self.bits(format, rounded) == Some(bits) { rounded } else { value }
    }

    /// The bits of the raw number, rounded; `None` if it is out of the range of the format.
    pub(super) fn bits(self, format: Format, value: f64) -> Option<u64> {
        let raw = self.raw(value);
        if raw.is_infinite() && value.is_finite() { None } else { format.nearest(raw) }
    }

    /// The raw number of a value, not rounded.
    pub(super) fn raw(self, value: f64) -> f64 {
        (value - self.offset) / self.gain
    }
}

/// Rounds a value to a number of decimals if that is exact: if `largest`, the larger of its two
/// summands, has at most 14 digits, which hides the rounding errors of the calculation.
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

/// Parses a scaled value.
pub(super) fn parse_scaled(text: &str) -> Result<f64, ValueError> {
    let number = text.parse().map_err(|_| ValueError::NotDecimal)?;
    if has_overflowed(number, text) { Err(ValueError::NotDecimal) } else { Ok(number) }
}

// Gain and offset are neither NaN nor -0, so equal bits are equal numbers.

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

    /// Parses `*GAIN`, `+OFFSET`, `-OFFSET`, or `*GAIN` and an offset. A gain can be negative.
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
    /// The shortest text that parses to the same scale: without a gain of 1 if there is an offset.
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

/// Displays a number in its shortest form, with an exponent and without `.0`.
struct Shortest(f64);

impl fmt::Display for Shortest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = format!("{:?}", self.0);
        f.write_str(text.strip_suffix(".0").unwrap_or(&text))
    }
}

/// Length of the unsigned decimal number at the beginning of a text, with decimals and exponent.
fn unsigned(text: &str) -> Option<usize> {
    let digits = |from: usize| text.bytes().skip(from).take_while(u8::is_ascii_digit).count();
    let byte = |at: usize| text.as_bytes().get(at).copied();
    let mut end = digits(0);
    let mut digit_count = end;
    if byte(end) == Some(b'.') {
        let decimals = digits(end + 1);
        digit_count += decimals;
        end += 1 + decimals;
    }
    if digit_count == 0 {
        return None;
    }
    if let Some(b'e' | b'E') = byte(end) {
        let sign = usize::from(matches!(byte(end + 1), Some(b'+' | b'-')));
        // An `e` without digits makes the number invalid.
        match digits(end + 1 + sign) {
            0 => return None,
            exponent => end += 1 + sign + exponent,
        }
    }
    Some(end)
}
