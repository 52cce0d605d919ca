//! Texts of requests and replies for logs: one line of bounded length, without control characters.

use std::fmt;

use super::{Code, Run, Value};

/// Number of elements or values that are shown of a list.
const LIST_ITEMS: usize = 16;
/// Number of data bytes that are shown.
const DATA_BYTES: usize = 64;

/// Writes the name of a command, its code and what it is for: `read registers (46h) R12`.
pub(super) fn command(f: &mut fmt::Formatter<'_>, code: Code, operand: impl fmt::Display) -> fmt::Result {
    write!(f, "{code} {operand}")
}

/// Displays consecutive elements: `R12`, or `R12 to R14`.
pub(super) struct Elements(pub(super) Run);

impl fmt::Display for Elements {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Run { first, count } = self.0;
        match first.nth(count.saturating_sub(1)) {
            Ok(last) if last == first => write!(f, "{first}"),
            Ok(last) => write!(f, "{first} to {last}"),
            // A received run that ends in a counter of 32 bits: a PLC refuses it.
            Err(_) => write!(f, "{count} elements from {first}"),
        }
    }
}

/// Displays the first 16 items of a list, and the number of all if there are more.
#[derive(Clone, Copy)]
pub(super) struct List<I>(pub(super) I);

impl<I> fmt::Display for List<I>
where
    I: ExactSizeIterator<Item: fmt::Display> + Clone,
{
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, item) in self.0.clone().take(LIST_ITEMS).enumerate() {
            let separator = if i > 0 { ", " } else { "" };
            write!(f, "{separator}{item}")?;
        }
        let count = self.0.len();
        if count > LIST_ITEMS { write!(f, " ... ({count} in all)") } else { Ok(()) }
    }
}

/// Displays values of consecutive elements, as [`List`].
pub(super) fn values<V: Copy + Into<Value>>(values: &[V]) -> impl fmt::Display {
    List(values.iter().map(|&value| value.into()))
}

/// Displays the first 64 bytes of data: `"03R00012"` if all of them are printable ASCII, else
/// `03 52 00 0C`. Behind them the number of all bytes if there are more.
pub(crate) struct Data<'a>(pub(crate) &'a [u8]);

impl fmt::Display for Data<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(data) = self;
        let shown = data.get(..DATA_BYTES).unwrap_or(data);
        if shown.iter().all(|byte| (0x20..=0x7E).contains(byte)) {
            write!(f, "\"{}\"", shown.escape_ascii())?;
        } else {
            for (i, byte) in shown.iter().enumerate() {
                let separator = if i > 0 { " " } else { "" };
                write!(f, "{separator}{byte:02X}")?;
            }
        }
        if data.len() > DATA_BYTES { write!(f, " ... ({} bytes)", data.len()) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests;
