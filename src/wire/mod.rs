//! The wire: how frames and their fields look in the two framings. No command is named here.
//!
//! - [`Frame`] is what both framings carry: station, command, data.
//! - [`AsciiCodec`] and [`BinaryCodec`] are `tokio_util::codec` pairs, for either side of the line, usable
//!   without the rest of this crate.
//! - [`FieldWriter`] and [`FieldReader`] put the fields of a command into a frame's data and take them out again;
//!   there is one of each for ASCII and for binary, and nothing else in this crate knows the difference.
//!
//! **Nothing in this module panics or allocates without bound, whatever the bytes.** Noise is an item that is
//! counted, never an error that ends a stream: a noisy line is not the end of a link.
#![cfg_attr(
    not(test),
    deny(
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::indexing_slicing,
        clippy::as_conversions,
        clippy::arithmetic_side_effects
    )
)]

pub mod ascii;
pub mod binary;
mod bulk;
mod codec;
mod field;
mod frame;
mod hex;
mod readings;

pub use ascii::{AsciiCodec, AsciiReader, AsciiWriter};
pub use binary::{BinaryCodec, BinaryReader, BinaryWriter};
pub use codec::Codec;
pub use field::{FieldError, FieldReader, FieldWriter};
pub use frame::{Discard, EncodeError, Frame, Framing, MAX_FRAME_LEN, ParseFramingError, Received, Side};
