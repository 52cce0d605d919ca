//! Gain and offset between raw numbers and engineering values.
//!
//! Invariants:
//! - The value of an integer is the `f64` nearest to the decimal `raw * gain + offset`, if gain and offset
//!   have at most 15 digits and 22 decimals, and are below 1e15, and 128 bits hold the digits of the product:
//!   123 * 0.1 is 12.3, not 12.300000000000001.
//! - The value of an integer encodes to the same integer, also after display and parsing.
//! - Any other value encodes to the nearest integer. If it has at most 15 digits, too, and lies between two, to
//!   the one farther from zero: 21.45 is 215 for a gain of 0.1, although `21.45 / 0.1` is less than 214.5.
//! - The value of an `f32` does, too, unless it is too small beside the offset. NaN stays NaN, and
//!   infinity stays infinity.
//! - A value whose raw number is out of range is refused, never clamped or wrapped.

use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::str::FromStr;

use super::ValueError;
use super::codec::{decimals, has_overflowed};
use super::decimal::{Decimal, POWERS, nearest_float, rounded_quotient};
use super::types::Format;

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
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
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
    #[error("a scale is *GAIN, +OFFSET, -OFFSET or both in this order, such as *0.1-40")]
    Malformed,
    /// A number of a scale in a constant has more than 15 digits, or an exponent beyond 22.
    #[error("a number of a scale in a constant has at most 15 digits, and an exponent from -22 to 22")]
    NotConst,
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
        // NaN and infinity, which have no decimals, are refused.
        Self::checked((gain, decimals(gain)), (offset, decimals(offset)))
    }

    /// Parses a scale as [`FromStr`] does, in constants.
    pub(super) const fn parse_const(text: &str) -> Result<Self, ScaleError> {
        let Some((gain, offset)) = split(text) else {
            return Err(ScaleError::Malformed);
        };
        match (exact_number(gain), exact_number(offset)) {
            (Some(gain), Some(offset)) => Self::checked(gain, offset),
            (None, _) | (_, None) => Err(ScaleError::NotConst),
        }
    }

    /// A scale of two numbers, each with its number of decimals.
    const fn checked(
        (gain, gain_decimals): (f64, u8),
        (offset, offset_decimals): (f64, u8),
    ) -> Result<Self, ScaleError> {
        // False for NaN.
        if !(1e-200 <= gain.abs() && gain.abs() <= 1e200) {
            return Err(ScaleError::Gain { gain });
        }
        if !offset.is_finite() {
            return Err(ScaleError::Offset { offset });
        }
        if offset.abs() > gain.abs() * MAX_GAINS {
            return Err(ScaleError::Coarse { gain, offset });
        }
        // Turns -0 into 0.
        Ok(Self { gain, offset: offset + 0.0, gain_decimals, offset_decimals })
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
        // The quick calculation is exact enough to tell raw numbers apart.
        let is_encoded_alike = |value: f64| format.nearest(self.raw(value)) == Some(bits);
        if !format.is_float()
            && let Some(value) = self.exact_value(raw).filter(|value| is_encoded_alike(*value))
        {
            return value;
        }
        let product = raw * self.gain;
        // Without an offset, a float of -0 stays -0; an integer has no -0.
        let value = if format.is_float() && self.offset == 0.0 { product } else { product + self.offset };
        let decimals = self.gain_decimals.saturating_add(format.decimals(bits)).max(self.offset_decimals);
        let rounded = round(value, product.abs().max(self.offset.abs()), decimals);
        if is_encoded_alike(rounded) { rounded } else { value }
    }

    /// The bits of the raw number, rounded; `None` if it is out of the range of the format.
    pub(super) fn bits(self, format: Format, value: f64) -> Option<u64> {
        if !format.is_float()
            && let Some(raw) = self.exact_raw(value)
        {
            #[allow(clippy::cast_precision_loss, reason = "exact within the range of all formats")]
            return format.nearest(raw as f64);
        }
        let raw = self.raw(value);
        if raw.is_infinite() && value.is_finite() { None } else { format.nearest(raw) }
    }

    /// The raw number of a value, not rounded.
    pub(super) fn raw(self, value: f64) -> f64 {
        (value - self.offset) / self.gain
    }

    /// Gain and offset as multiples of the same power of ten, and its decimals, of which there are at least this
    /// many; `None` if that is not exact.
    fn in_units(self, decimals: u8) -> Option<(i128, i128, u8)> {
        let gain = Decimal::of(self.gain, self.gain_decimals)?;
        let offset = Decimal::of(self.offset, self.offset_decimals)?;
        let decimals = decimals.max(gain.decimals()).max(offset.decimals());
        Some((gain.in_units(decimals)?, offset.in_units(decimals)?, decimals))
    }

    /// The value of an integer, calculated with decimals; `None` if that is not exact.
    fn exact_value(self, raw: f64) -> Option<f64> {
        let (gain, offset, decimals) = self.in_units(0)?;
        #[allow(clippy::cast_possible_truncation, reason = "an integer of at most 32 bits")]
        let product = (raw as i128).checked_mul(gain)?;
        nearest_float(product.checked_add(offset)?, decimals)
    }

    /// The integer nearest to the raw number of a value, calculated with decimals; of two, the one farther from
    /// zero. `None` if that is not exact.
    fn exact_raw(self, value: f64) -> Option<i128> {
        let value = Decimal::of(value, decimals(value))?;
        let (gain, offset, decimals) = self.in_units(value.decimals())?;
        rounded_quotient(value.in_units(decimals)?.checked_sub(offset)?, gain)
    }
}

/// Rounds a value to a number of decimals if that is exact: if `largest`, the larger of its two
/// summands, has at most 14 digits, which hides the rounding errors of the calculation.
fn round(value: f64, largest: f64, decimals: u8) -> f64 {
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
        let (gain, offset) = split(text).ok_or(ScaleError::Malformed)?;
        let number = |text: &str| text.parse().map_err(|_| ScaleError::Malformed);
        Self::new(number(gain)?, number(offset)?)
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

/// Splits a scale into gain and offset, both decimal numbers; `None` if it is malformed.
const fn split(text: &str) -> Option<(&str, &str)> {
    let (gain, rest) = match text.as_bytes() {
        [] => return None,
        [b'*', ..] => {
            let (_, rest) = text.split_at(1);
            let sign = matches!(rest.as_bytes(), [b'-', ..]) as usize;
            let Some(end) = end_of_number(rest.as_bytes(), sign) else { return None };
            rest.split_at(end)
        }
        _ => ("1", text),
    };
    match rest.as_bytes() {
        [] => Some((gain, "0")),
        number @ [b'+' | b'-', ..] => match end_of_number(number, 1) {
            Some(end) if end == number.len() => Some((gain, rest)),
            Some(_) | None => None,
        },
        _ => None,
    }
}

/// The end of the unsigned decimal number that begins here, with decimals and exponent.
const fn end_of_number(text: &[u8], begin: usize) -> Option<usize> {
    let mut end = end_of_digits(text, begin);
    let mut digits = end - begin;
    if is_at(text, end, b'.') {
        let decimals = end + 1;
        end = end_of_digits(text, decimals);
        digits += end - decimals;
    }
    if digits == 0 {
        return None;
    }
    if is_at(text, end, b'e') || is_at(text, end, b'E') {
        let signed = is_at(text, end + 1, b'+') || is_at(text, end + 1, b'-');
        let exponent = end + 1 + signed as usize;
        end = end_of_digits(text, exponent);
        // An `e` without digits makes the number invalid.
        if end == exponent {
            return None;
        }
    }
    Some(end)
}

const fn end_of_digits(text: &[u8], begin: usize) -> usize {
    let mut end = begin;
    while end < text.len() && text[end].is_ascii_digit() {
        end += 1;
    }
    end
}

const fn is_at(text: &[u8], at: usize, byte: u8) -> bool {
    at < text.len() && text[at] == byte
}

/// The number of a decimal text in constants, with the number of decimals of its shortest text.
///
/// `None` beyond 15 digits or 22 decimals: up to there, number and power of ten are exact `f64`s, so
/// product and quotient are the nearest ones.
const fn exact_number(text: &str) -> Option<(f64, u8)> {
    const MAX_DIGITS: u64 = 1_000_000_000_000_000;
    let text = text.as_bytes();
    let is_negative = is_at(text, 0, b'-');
    let mut at = (is_negative || is_at(text, 0, b'+')) as usize;
    let (mut digits, mut exponent, mut is_behind_point) = (0_u64, 0_i32, false);
    while at < text.len() && !matches!(text[at], b'e' | b'E') {
        if text[at] == b'.' {
            is_behind_point = true;
        } else {
            digits = digits * 10 + (text[at] - b'0') as u64;
            exponent -= is_behind_point as i32;
            if digits >= MAX_DIGITS {
                return None;
            }
        }
        at += 1;
    }
    if at < text.len() {
        let is_small = is_at(text, at + 1, b'-');
        at += 1 + (is_small || is_at(text, at + 1, b'+')) as usize;
        let mut given = 0_i32;
        while at < text.len() {
            given = given.saturating_mul(10).saturating_add((text[at] - b'0') as i32);
            at += 1;
        }
        exponent = exponent.saturating_add(if is_small { -given } else { given });
    }
    while digits.is_multiple_of(10) && digits > 0 {
        digits /= 10;
        exponent = exponent.saturating_add(1);
    }
    if digits == 0 {
        return Some((0.0, 0));
    }
    let places = exponent.unsigned_abs();
    if places >= POWERS.len() as u32 {
        return None;
    }
    let power = POWERS[places as usize];
    let number = if exponent < 0 { digits as f64 / power } else { digits as f64 * power };
    // Fewer than 23.
    let decimals = if exponent < 0 { places as u8 } else { 0 };
    Some((if is_negative { -number } else { number }, decimals))
}
