//! Settings of a line, and the options that state them in a URL. [`endpoint`](crate::endpoint) has
//! the public names.

mod in_step;
mod options;
mod serial;

pub(crate) use self::in_step::URL_OPTIONS;
pub use self::in_step::{DEFAULT_COPIES, DEFAULT_COPY_WINDOW, DEFAULT_QUIET, InStepSettings, MAX_COPIES};
pub(crate) use self::options::{UrlOptions, one_of};
pub(crate) use self::serial::URL_OPTIONS as SERIAL_URL_OPTIONS;
pub use self::serial::{DataBits, MAX_BAUD, MIN_BAUD, Parity, Rts, SerialSettings, StopBits};

/// Invalid settings of an endpoint.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidSettings {
    /// The baud rate is not [`MIN_BAUD`] to [`MAX_BAUD`].
    #[error("the baud rate {baud} is not within {MIN_BAUD} to {MAX_BAUD}")]
    Baud {
        /// The baud rate.
        baud: u32,
    },
    /// The number of copies is more than [`MAX_COPIES`].
    #[error("the number of copies {copies} is not within 0 to {MAX_COPIES}")]
    Copies {
        /// The number.
        copies: u8,
    },
    /// The binary framing needs 8 data bits.
    #[error("the binary framing needs 8 data bits, and {settings} has {}", settings.data_bits())]
    DataBits {
        /// The settings.
        settings: SerialSettings,
    },
    /// The endpoint is not a serial port.
    #[error("{endpoint} is not a serial port")]
    NotSerial {
        /// The endpoint.
        endpoint: String,
    },
}
