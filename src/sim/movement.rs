//! Movements: values of a simulated PLC that change with time.

mod text;

use std::f64::consts::TAU;
use std::fmt;
use std::time::Duration;

pub use self::text::ParseMovementError;
use crate::random::Random;
use crate::tag::Tag;

/// A value as a function of the time since its start, for [`Plc::set_movement`].
///
/// It is parsed from text, and displays as text that parses to the same, without the seed:
///
/// | text | value |
/// |---|---|
/// | `ramp(0..100,10s)` | from 0 to 100 in 10 s, and again from 0 |
/// | `triangle(0..100,10s)` | from 0 to 100 in 5 s, and back in 5 s |
/// | `sine(0..100,10s)` | 50 at first, 100 after 2.5 s, 0 after 7.5 s |
/// | `square(0..1,1s)`, `square(1s)` | 0 for half a second, 1 for half a second |
/// | `step(0..100,10s)`, `step(10s)` | 0 for 10 s, then 100 for good; 0, then 1 |
/// | `random(0..100,500ms)`, `random(0..100)` | another one every 500 ms, or every second |
/// | `counter(0..9,1s)`, `counter(1s)` | 0, 1 … 9, and again 0; from 0 to 2^n - 1, the largest such number of the tag |
///
/// The first number may be the larger one. A period is more than 0, at most a day. No clock and no state:
/// equal times give equal values.
///
/// ```
/// use std::time::Duration;
/// use fatek::sim::{Movement, Shape};
///
/// let ramp: Movement = "ramp(0..100,10s)".parse()?;
/// assert_eq!(ramp, Movement::new(Shape::Ramp, 0.0, 100.0, Duration::from_secs(10))?);
/// assert_eq!(ramp.value(Duration::from_millis(2500)), 25.0);
/// assert_eq!(ramp.value(Duration::from_millis(12_500)), 25.0);
///
/// let error = "ramp(0..100)".parse::<Movement>().unwrap_err();
/// assert_eq!(error.to_string(), "`ramp(0..100)` is not a movement: it needs a period, as in `ramp(0..100,10s)`");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// [`Plc::set_movement`]: super::Plc::set_movement
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Movement {
    shape: Shape,
    from: f64,
    /// `None`: the largest number of the tag, for a counter.
    to: Option<f64>,
    period: Duration,
    seed: u64,
    /// `true` if random numbers are integers, all of them equally likely.
    is_integral: bool,
}

/// The shape of a [`Movement`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Shape {
    /// From the first number to the second in one period, and again from the first.
    Ramp,
    /// From the first number to the second in half a period, and back in the other half.
    Triangle,
    /// A sine around the middle of the numbers, upwards at first.
    Sine,
    /// The first number for half a period, the second for the other half.
    Square,
    /// The first number for one period, then the second for good.
    Step,
    /// Another number in each period, both ends included. Of integers and states, all are equally likely.
    Random,
    /// One more, or one less, in each period, from the first number to the second, and again.
    Counter,
}

impl Shape {
    /// All shapes.
    pub const ALL: &'static [Self] =
        &[Self::Ramp, Self::Triangle, Self::Sine, Self::Square, Self::Step, Self::Random, Self::Counter];

    /// Its name in the text of a movement.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Ramp => "ramp",
            Self::Triangle => "triangle",
            Self::Sine => "sine",
            Self::Square => "square",
            Self::Step => "step",
            Self::Random => "random",
            Self::Counter => "counter",
        }
    }
}

impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// Reason why numbers and a period are not a movement, or why a tag cannot have it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MovementError {
    /// A number is infinite, or not a number.
    #[error("{number} is not possible: numbers are finite")]
    #[non_exhaustive]
    NotFinite {
        /// The number.
        number: f64,
    },
    /// The period is 0, or more than a day.
    #[error("a period is more than 0, and at most 24h")]
    Period,
    /// The tag is a text, or bits of a register.
    #[error("{tag} cannot move: numbers and discretes can")]
    #[non_exhaustive]
    WrongTag {
        /// The tag.
        tag: Tag,
    },
    /// The tag cannot hold a number of the movement.
    #[error("{tag} cannot hold {number:?}")]
    #[non_exhaustive]
    OutOfRange {
        /// The tag.
        tag: Tag,
        /// The number.
        number: f64,
    },
    /// An element is beyond the memory of the model: [`Error::BeyondModel`](super::Error::BeyondModel).
    #[error(transparent)]
    Plc(#[from] super::Error),
}

const DAY: Duration = Duration::from_secs(24 * 3600);

impl Movement {
    /// A movement between two numbers.
    ///
    /// # Errors
    /// [`MovementError::NotFinite`] and [`MovementError::Period`].
    pub fn new(shape: Shape, from: f64, to: f64, period: Duration) -> Result<Self, MovementError> {
        if let Some(&number) = [from, to].iter().find(|number| !number.is_finite()) {
            return Err(MovementError::NotFinite { number });
        }
        Self::checked(shape, from, Some(to), period)
    }

    /// A counter from 0 to the largest number 2^n - 1 that its tag can hold.
    ///
    /// # Errors
    /// [`MovementError::Period`].
    pub fn counter(period: Duration) -> Result<Self, MovementError> {
        Self::checked(Shape::Counter, 0.0, None, period)
    }

    fn checked(shape: Shape, from: f64, to: Option<f64>, period: Duration) -> Result<Self, MovementError> {
        if period.is_zero() || period > DAY {
            return Err(MovementError::Period);
        }
        Ok(Self { shape, from, to, period, seed: 0, is_integral: false })
    }

    /// Sets the seed of [`Shape::Random`]. Default: 0. Values of different elements differ with equal seeds, too.
    #[must_use]
    pub fn with_seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// The shape.
    #[must_use]
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// The period.
    #[must_use]
    pub fn period(&self) -> Duration {
        self.period
    }

    /// The value at this time after the start, not rounded. A counter without an end counts to 2^32 - 1.
    #[must_use]
    pub fn value(&self, elapsed: Duration) -> f64 {
        let (from, to) = (self.from, self.to.unwrap_or(LARGEST_COUNT));
        let periods = elapsed.as_nanos() / self.period.as_nanos();
        // Of the second number; the sum of both parts cannot overflow.
        let mix = |share: f64| from * (1.0 - share) + to * share;
        match self.shape {
            Shape::Ramp => mix(self.phase(elapsed)),
            Shape::Triangle => {
                let phase = self.phase(elapsed);
                mix(if phase < 0.5 { 2.0 * phase } else { 2.0 - 2.0 * phase })
            }
            Shape::Sine => mix(0.5 + (self.phase(elapsed) * TAU).sin() / 2.0),
            Shape::Square => mix(if self.phase(elapsed) < 0.5 { 0.0 } else { 1.0 }),
            Shape::Step => mix(if periods == 0 { 0.0 } else { 1.0 }),
            Shape::Random if self.is_integral => random_integer(from, to, self.share(periods)),
            Shape::Random => mix(self.share(periods)),
            Shape::Counter => counted(from, to, periods),
        }
    }

    /// The movement of one value of a tag, whose end is known and whose random numbers are its own.
    pub(super) fn of(self, tag: &Tag) -> Result<Self, MovementError> {
        let takes = |number: f64| tag.encode_nearest(number, &mut Vec::new());
        if !takes(tag_zero(tag)) {
            return Err(MovementError::WrongTag { tag: *tag });
        }
        let open_end = || (1..=32).rev().map(|bits| f64::from(bits).exp2() - 1.0).find(|&number| takes(number));
        let Some(to) = self.to.or_else(open_end) else {
            return Err(MovementError::OutOfRange { tag: *tag, number: 1.0 });
        };
        if let Some(&number) = [self.from, to].iter().find(|&&number| !takes(number)) {
            return Err(MovementError::OutOfRange { tag: *tag, number });
        }
        let first = tag.first();
        let stream = u64::from(first.address()) << 8 | first.symbol() as u64;
        let seed = self.seed ^ Random::new(stream).next();
        Ok(Self { to: Some(to), seed, is_integral: tag.is_integral(), ..self })
    }

    /// The part of the current period that is over: 0, and less than 1.
    #[allow(clippy::cast_precision_loss, reason = "a period has less than 2^47 ns")]
    fn phase(&self, elapsed: Duration) -> f64 {
        let period = self.period.as_nanos();
        (elapsed.as_nanos() % period) as f64 / period as f64
    }

    /// A random number of a period, from 0 to 1.
    #[allow(clippy::cast_precision_loss, reason = "the number has 53 bits")]
    fn share(&self, nth: u128) -> f64 {
        // Beyond 2^64 periods, which no run has, they repeat.
        let nth = u64::try_from(nth).unwrap_or(u64::MAX);
        let bits = Random::new(Random::new(self.seed).next().wrapping_add(nth)).next() >> 11;
        bits as f64 / ((1_u64 << 53) - 1) as f64
    }
}

/// The largest number of a counter without an end.
const LARGEST_COUNT: f64 = u32::MAX as f64;

/// A number that the tag can hold if it can hold any: 0, or the value of the raw number 0.
fn tag_zero(tag: &Tag) -> f64 {
    tag.scale().map_or(0.0, |scale| scale.offset())
}

/// The integer of a share from 0 to 1. Rounded, the ends would have half the chance of the others.
fn random_integer(from: f64, to: f64, share: f64) -> f64 {
    let (low, high) = (from.min(to).round(), from.max(to).round());
    (low + (share * (high - low + 1.0)).floor()).min(high)
}

/// The number of a counter after this many counts.
#[allow(clippy::cast_precision_loss, reason = "beyond 2^53 the nearest number is as good")]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the cast saturates, and is not negative")]
fn counted(from: f64, to: f64, counts: u128) -> f64 {
    let steps = (to - from).abs().floor() as u128;
    let nth = (counts % steps.saturating_add(1)) as f64;
    if to < from { from - nth } else { from + nth }
}

impl fmt::Display for Movement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}(", self.shape)?;
        if let Some(to) = self.to {
            write!(f, "{:?}..{to:?},", self.from)?;
        }
        write!(f, "{})", humantime::format_duration(self.period))
    }
}

#[cfg(test)]
mod tests;
