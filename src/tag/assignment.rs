use std::fmt;
use std::str::FromStr;

use super::{ParseAssignmentError, Tag, TagValue, ValueError};
use crate::command::Value;

/// A tag with its values: `R5=7`, `R0-R2=1,2,3`, `R100:f32=-1.5`, `R0-R9:text="a, b"`.
#[derive(Clone, Debug, PartialEq)]
pub struct Assignment {
    tag: Tag,
    values: Vec<TagValue>,
    raw: Vec<Value>,
}

impl Assignment {
    /// An assignment of these values to this tag.
    ///
    /// # Errors
    /// Those of [`Tag::encode`].
    pub fn new(tag: Tag, values: impl Into<Vec<TagValue>>) -> Result<Self, ValueError> {
        let values = values.into();
        let raw = tag.encode(&values)?;
        Ok(Self { tag, values, raw })
    }

    /// The tag.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    /// The values, [`Tag::value_count`] of them, all of the tag's type.
    #[must_use]
    pub fn values(&self) -> &[TagValue] {
        &self.values
    }

    /// The values to write to the tag's [`elements`](Tag::elements), in their order.
    #[must_use]
    pub fn encode(&self) -> Vec<Value> {
        self.raw.clone()
    }
}

impl FromStr for Assignment {
    type Err = ParseAssignmentError;

    /// Parses `TAG=VALUE`, or `TAG=VALUE,VALUE...` for several values; see [`Tag::parse_values`].
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let Some((tag, values)) = text.split_once('=') else {
            return Err(ParseAssignmentError::NoValue { input: text.to_owned() });
        };
        let tag: Tag = tag.parse()?;
        let (values, raw) = tag.parse_and_encode(values)?;
        Ok(Self { tag, values, raw })
    }
}

impl fmt::Display for Assignment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.tag)?;
        let mut separator = '=';
        for value in &self.values {
            write!(f, "{separator}{value}")?;
            separator = ',';
        }
        Ok(())
    }
}
