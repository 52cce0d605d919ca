//! What is parsed prints itself so that it is parsed as the same; what is not parsed is named by the error.

use std::fmt::{Debug, Display};
use std::str::FromStr;

/// Parses, prints and parses again. Gives what was parsed.
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
                Err(error) => panic!("`{text}` prints as `{printed}`, and that is not parsed: {error}"),
            }
            assert_eq!(printed, printed.parse::<T>().unwrap().to_string(), "one value has one form");
            Some(value)
        }
        Err(error) => {
            let error = error.to_string();
            assert!(!error.is_empty() && error.len() <= 2048 + 16 * text.len(), "an error of {} bytes", error.len());
            None
        }
    }
}
