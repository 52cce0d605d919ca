//! Discretes of the command line: one, or a range with both ends included.

use std::fmt;
use std::str::FromStr;

use fatek::tag::{Tag, TagType};
use fatek::{Discrete, Element};

/// Consecutive discretes, such as `M0-M7`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct DiscreteRange {
    first: Discrete,
    len: usize,
}

impl DiscreteRange {
    /// The discretes from `first` to `last`, of the same symbol; `None` if there are none.
    pub(crate) fn new(first: Discrete, last: Discrete) -> Option<Self> {
        let others = last.address().checked_sub(first.address()).filter(|_| first.symbol() == last.symbol())?;
        Some(Self { first, len: usize::from(others) + 1 })
    }

    pub(crate) fn first(&self) -> Discrete {
        self.first
    }

    pub(crate) fn len(&self) -> usize {
        self.len
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = Discrete> + use<> {
        let first = self.first;
        (0..self.len).map_while(move |n| first.nth(n).ok())
    }
}

impl FromStr for DiscreteRange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let tag: Tag = text.parse().map_err(|error: fatek::tag::ParseTagError| error.to_string())?;
        match tag.first() {
            Element::Discrete(first) if tag.tag_type() == TagType::Bool => Ok(Self { first, len: tag.element_count() }),
            first @ (Element::Discrete(_) | Element::Register(_) | Element::Register32(_)) => {
                Err(format!("{first} is {}, and only discretes can be forced: X Y M S T C", first.width()))
            }
        }
    }
}

impl fmt::Display for DiscreteRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.iter().last() {
            Some(last) if last != self.first => write!(f, "{}-{last}", self.first),
            Some(_) | None => write!(f, "{}", self.first),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_has_both_ends_and_is_of_discretes() {
        let range: DiscreteRange = "m0-M7".parse().unwrap();
        assert_eq!((range.to_string().as_str(), range.len(), range.iter().count()), ("M0-M7", 8, 8));
        assert_eq!("Y3".parse::<DiscreteRange>().unwrap().to_string(), "Y3");
        let first = range.first();
        assert_eq!(DiscreteRange::new(first, first.nth(7).unwrap()), Some(range));
        assert_eq!(DiscreteRange::new(first.nth(1).unwrap(), first), None);
        let reason = "R5 is a 16-bit register, and only discretes can be forced: X Y M S T C";
        for (text, reason) in [("R5", reason), ("R5.3", reason), ("M7-M0", "backwards"), ("M0-Y7", "one symbol")] {
            let error = text.parse::<DiscreteRange>().unwrap_err();
            assert!(error.contains(reason), "{text}: {error}");
        }
    }
}
