//! The two framings: frames and their fields as bytes. Commands are not known here.
//!
//! - [`Frame`] is the content of a frame in either framing: station, command, data.
//! - [`AsciiCodec`] and [`BinaryCodec`] are `tokio_util::codec` pairs for both sides of the line,
//!   usable without the rest of this crate. [`Codec`] is either of them, chosen at run time.
//! - [`FieldWriter`] and [`FieldReader`] write the fields of a command into the data of a frame and
//!   read them. Each has one implementation for ASCII and one for binary.
//!
//! **No input can cause a panic or unbounded memory use.** Noise is decoded as
//! [`Received::Discarded`]. It is no error, because `Framed` ends its stream after one.
#![cfg_attr(not(test), deny(clippy::as_conversions))]

pub mod ascii;
pub mod binary;
mod bulk;
mod codec;
#[allow(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    reason = "indexes of its own words; a test compares all lengths up to 1500"
)]
mod crc16;
mod element_list;
mod field;
mod frame;
mod framing;
mod length;

pub use ascii::{AsciiCodec, AsciiReader, AsciiWriter};
pub use binary::{BinaryCodec, BinaryReader, BinaryWriter};
pub use codec::Codec;
pub use field::{FieldError, FieldReader, FieldWriter};
pub use frame::{Discard, EncodeError, Frame, MAX_FRAME_LEN, Received, Side};
pub(crate) use frame::{Found, FoundFrame, fingerprint};
pub use framing::{Framing, ParseFramingError};
pub(crate) use length::LONGEST_FRAME;
