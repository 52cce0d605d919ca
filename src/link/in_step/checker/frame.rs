//! Frames of the model.

use std::fmt;

use crate::command::Code;
use crate::link::in_step::Shape;

/// Sizes from here on are nonces.
pub(super) const NONCES: u32 = 1000;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Frame {
    pub(super) code: Code,
    /// Size of a positive reply.
    pub(super) size: u32,
    pub(super) refused: bool,
    pub(super) body: u8,
    /// It answers the request on the wire.
    pub(super) own: bool,
    pub(super) copy: bool,
    /// A duplicate of it will come at any moment of the next exchanges.
    pub(super) roams: bool,
}

impl Frame {
    pub(super) fn of(shape: Shape, body: u8) -> Self {
        Self { code: shape.code, size: shape.size, refused: false, body, own: false, copy: false, roams: false }
    }

    pub(super) fn refusal(code: Code) -> Self {
        Self { refused: true, ..Self::of(Shape { code, size: 0 }, 0) }
    }

    pub(super) fn fits(&self, shape: Shape) -> bool {
        self.code == shape.code && (self.refused || self.size == shape.size)
    }

    /// As [`fingerprint`](crate::wire::fingerprint), but a nonce can be renamed in it.
    pub(super) fn fingerprint(&self) -> u64 {
        u64::from(u8::from(self.code)) << 40
            | u64::from(self.size) << 8
            | u64::from(self.body) << 1
            | u64::from(self.refused)
    }
}

impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let own = if self.own { "" } else { ", another's" };
        let copy = if self.copy { ", a copy" } else { "" };
        match self.refused {
            true => write!(f, "{:X} refused{own}{copy}", u8::from(self.code)),
            false => write!(f, "{:X}/{} {}{own}{copy}", u8::from(self.code), self.size, self.body),
        }
    }
}
