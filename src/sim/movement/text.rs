//! Movements as text: `SHAPE(FROM..TO,PERIOD)`.

use std::str::FromStr;
use std::time::Duration;

use super::{Movement, MovementError, Shape};
use crate::printable::excerpt;

/// A text that is not a [`Movement`], with the rule that it breaks.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`{}` is not a movement: {rule}", excerpt(input))]
pub struct ParseMovementError {
    input: String,
    rule: String,
}

impl ParseMovementError {
    /// The text.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The rule that it breaks.
    #[must_use]
    pub fn rule(&self) -> &str {
        &self.rule
    }
}

impl FromStr for Movement {
    type Err = ParseMovementError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse(text).map_err(|rule| ParseMovementError { input: text.to_owned(), rule })
    }
}

/// The period of shapes that can do without one.
const DEFAULT_PERIOD: Duration = Duration::from_secs(1);

fn parse(text: &str) -> Result<Movement, String> {
    let (name, arguments) = match text.trim().split_once('(') {
        Some((name, rest)) => (name.trim(), Some(rest)),
        None => (text.trim(), None),
    };
    let Some(&shape) = Shape::ALL.iter().find(|shape| shape.as_str() == name) else {
        return Err(format!(
            "it must be {}",
            Shape::ALL.iter().map(|shape| example(*shape)).collect::<Vec<_>>().join(", ")
        ));
    };
    // Without brackets, all arguments are left out.
    let Some(arguments) = arguments.map_or(Some(""), |rest| rest.strip_suffix(')')) else {
        return Err(format!("it must end with `)`, as in `{}`", example(shape)));
    };
    let mut parts = arguments.split(',').map(str::trim).filter(|part| !part.is_empty()).peekable();
    let range = parts.next_if(|part| part.contains("..")).map(range).transpose()?;
    let period = match (parts.next(), shape) {
        (Some(period), _) => period_of(period, shape)?,
        (None, Shape::Random | Shape::Counter) => DEFAULT_PERIOD,
        (None, Shape::Ramp | Shape::Triangle | Shape::Sine | Shape::Square | Shape::Step) => {
            return Err(format!("it needs a period, as in `{}`", example(shape)));
        }
    };
    if let Some(other) = parts.next() {
        return Err(format!("`{}` is too much: it must be as `{}`", excerpt(other), example(shape)));
    }
    let movement = match (range, shape) {
        (Some((from, to)), _) => Movement::new(shape, from, to, period),
        (None, Shape::Counter) => Movement::counter(period),
        (None, Shape::Square | Shape::Step | Shape::Random) => Movement::new(shape, 0.0, 1.0, period),
        (None, Shape::Ramp | Shape::Triangle | Shape::Sine) => {
            return Err(format!("it needs two numbers, as in `{}`", example(shape)));
        }
    };
    movement.map_err(|error: MovementError| error.to_string())
}

/// The two numbers of `FROM..TO`.
fn range(text: &str) -> Result<(f64, f64), String> {
    let number = |text: &str| text.trim().parse::<f64>().ok().filter(|number| number.is_finite());
    let numbers = text.split_once("..").and_then(|(from, to)| number(from).zip(number(to)));
    numbers.ok_or_else(|| format!("`{}` must be two decimal numbers, as in `0..100`", excerpt(text)))
}

fn period_of(text: &str, shape: Shape) -> Result<Duration, String> {
    let rule = || {
        format!(
            "`{}` must be a period of more than 0, at most 24h, such as 500ms, 1.5s or 10m, as in `{}`",
            excerpt(text),
            example(shape)
        )
    };
    humantime::parse_duration(text).ok().filter(|period| !period.is_zero() && *period <= super::DAY).ok_or_else(rule)
}

/// A movement of this shape.
fn example(shape: Shape) -> &'static str {
    match shape {
        Shape::Ramp => "ramp(0..100,10s)",
        Shape::Triangle => "triangle(0..100,10s)",
        Shape::Sine => "sine(0..100,10s)",
        Shape::Square => "square(0..1,1s)",
        Shape::Step => "step(0..1,10s)",
        Shape::Random => "random(0..100,1s)",
        Shape::Counter => "counter(0..9,1s)",
    }
}
