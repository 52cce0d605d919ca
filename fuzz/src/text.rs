//! Round trip of texts. Invariants: a parsed value prints a text of the same value; an error names
//! the text.

use std::fmt::{Debug, Display};
use std::str::FromStr;

/// Parses, prints and parses again. Returns the parsed value.
pub(crate) fn round_trip<T>(text: &str) -> Option<T>
where
    T: FromStr + Display + Debug + PartialEq,
    T::Err: Display + Debug,
{
    match text.parse::<T>() {
        Ok(value) => {
            let printed = value.to_string();
            match printed.parse::<T>() {
                Ok(again) => assert_eq!(again, value, "`{text}` prints as `{printed}`"),
                Err(error) => panic!("`{text}` prints as `{printed}`, which does not parse: {error}"),
            }
            assert_eq!(printed, printed.parse::<T>().unwrap().to_string(), "the printed form is not stable");
            Some(value)
        }
        Err(error) => {
            let error = error.to_string();
            assert!(!error.is_empty() && error.len() <= 2048 + 16 * text.len(), "an error of {} bytes", error.len());
            None
        }
    }
}
