//! Decimal numbers of floats, for calculations without rounding errors.

/// A decimal number of at most 15 digits: `digits * 10^-decimals`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Decimal {
    digits: i64,
    decimals: u8,
}

impl Decimal {
    /// The decimal number that a float displays with this number of decimals. `None` for more than 22 decimals,
    /// and if there are more than 15 digits.
    pub(super) fn of(number: f64, decimals: u8) -> Option<Self> {
        let digits = (number * POWERS.get(usize::from(decimals))?).round();
        // Of a product below that, the number and the multiplication are off by less than a quarter. False for NaN.
        let is_whole = digits.abs() < 1e15;
        #[allow(clippy::cast_possible_truncation, reason = "below 1e15, and rounded")]
        let digits = digits as i64;
        is_whole.then_some(Self { digits, decimals })
    }

    /// The number as a multiple of `10^-decimals`, which are at least its own; `None` if it is too large.
    pub(super) fn in_units(self, decimals: u8) -> Option<i128> {
        let more = decimals.checked_sub(self.decimals)?;
        i128::from(self.digits).checked_mul(10_i128.checked_pow(more.into())?)
    }

    pub(super) fn decimals(self) -> u8 {
        self.decimals
    }
}

/// The float nearest to `units * 10^-decimals`; `None` for more than 22 decimals.
pub(super) fn nearest_float(units: i128, decimals: u8) -> Option<f64> {
    let power = POWERS.get(usize::from(decimals))?;
    // A division of two exact numbers is rounded once.
    #[allow(clippy::cast_precision_loss, reason = "compared")]
    let is_exact = units.unsigned_abs() <= MAX_EXACT;
    #[allow(clippy::cast_precision_loss, reason = "compared")]
    if is_exact { Some(units as f64 / power) } else { format!("{units}e-{decimals}").parse().ok() }
}

/// The quotient, rounded to the nearest integer; of two, to the one farther from zero. `None` for a divisor of 0.
pub(super) fn rounded_quotient(dividend: i128, divisor: i128) -> Option<i128> {
    let (quotient, rest) = (dividend.checked_div(divisor)?, dividend.checked_rem(divisor)?.unsigned_abs());
    let is_far = rest >= divisor.unsigned_abs() - rest;
    quotient.checked_add(if is_far { dividend.signum() * divisor.signum() } else { 0 })
}

/// The powers of ten that an `f64` has exactly.
pub(super) const POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20,
    1e21, 1e22,
];

/// The largest of the integers that an `f64` has without gaps.
const MAX_EXACT: u128 = 1 << 53;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_decimal_has_the_digits_that_a_float_displays() {
        let of = |number: f64, decimals| Decimal::of(number, decimals).and_then(|decimal| decimal.in_units(decimals));
        assert_eq!((of(0.1, 1), of(-12.25, 2), of(-0.0, 0)), (Some(1), Some(-1225), Some(0)));
        assert_eq!(of(0.055_555_555_555_555_6, 16), Some(555_555_555_555_556));
        assert_eq!((of(999_999_999_999_999.0, 0), of(1e15, 0), of(0.1, 23)), (Some(999_999_999_999_999), None, None));
        assert_eq!([f64::NAN, f64::INFINITY, f64::NEG_INFINITY].map(|number| of(number, 0)), [None; 3]);
        let tenth = Decimal::of(0.1, 1).unwrap();
        assert_eq!((tenth.in_units(0), tenth.in_units(3), tenth.in_units(255)), (None, Some(100), None));
    }

    #[test]
    fn quotients_are_rounded_to_the_nearest_and_halves_away_from_zero() {
        for (dividend, divisor, rounded) in
            [(7, 2, 4), (-7, 2, -4), (7, -2, -4), (-7, -2, 4), (6, 4, 2), (5, 4, 1), (0, 3, 0), (1, 3, 0), (2, 3, 1)]
        {
            assert_eq!(rounded_quotient(dividend, divisor), Some(rounded), "{dividend} / {divisor}");
        }
        assert_eq!((rounded_quotient(1, 0), rounded_quotient(i128::MIN, -1)), (None, None));
        assert_eq!(rounded_quotient(i128::MAX, i128::MAX), Some(1));
    }
}
