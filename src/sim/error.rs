use crate::command::Value;
use crate::element::Element;

/// What cannot be done to a simulated PLC: a mistake of the test that does it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A value that is not as wide as its element.
    #[error("{element} is {}, and the value {value} is for {}", element.width(), value.width())]
    WrongWidth {
        /// The element.
        element: Element,
        /// The value.
        value: Value,
    },
    /// An element that the model does not have.
    #[error("{element} lies beyond the memory of this model")]
    BeyondModel {
        /// The element.
        element: Element,
    },
    /// A page that the program does not have.
    #[error("there is no page {page}: the program has the pages 0 to {last}")]
    BeyondProgram {
        /// The page asked for.
        page: u16,
        /// The last page.
        last: u16,
    },
    /// Not a station number.
    #[error("{station} is not a station: PLCs are 1 to 254")]
    Station {
        /// The number given.
        station: u8,
    },
}
