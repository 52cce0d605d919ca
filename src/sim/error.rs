use crate::element::{Element, ElementError};

/// A wrong use of a simulated PLC by a test.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The value has another width than the element: [`ElementError::WrongWidth`].
    #[error(transparent)]
    Element(#[from] ElementError),
    /// The element is beyond the memory of the model.
    #[error("{element} is beyond the memory of this model")]
    BeyondModel {
        /// The element.
        element: Element,
    },
    /// The page is beyond the program.
    #[error("page {page} does not exist: the program has pages 0 to {last}")]
    BeyondProgram {
        /// The page.
        page: u16,
        /// The last page of the program.
        last: u16,
    },
    /// The number is not a station number.
    #[error("{station} is not a station number: stations are 1 to 254")]
    Station {
        /// The number.
        station: u8,
    },
}
