use std::fmt;

use super::consecutive::{read_consecutive, write_consecutive};
use super::{
    Candidates, Code, Command, Consecutive, ConsecutiveElement, InvalidRequest, RequestError, Run, Spelling, blank,
    limits, sealed, spelling, text,
};
use crate::element::{Register, Register32};
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

/// An element of 46 and 47: [`Register`] with a `u16` value, or [`Register32`] with a `u32` value.
pub trait RegisterElement: ConsecutiveElement + sealed::Sealed {}

impl RegisterElement for Register {}
impl RegisterElement for Register32 {}

read_consecutive! {
    /// 46: reads consecutive registers.
    ///
    /// ```text
    /// request  N · first register
    /// reply    N values, of 16 or 32 bits as the register
    /// ```
    ReadRegisters<E: RegisterElement> of E, count "1 to 64, or 1 to 32 of 32 bits"
}

write_consecutive! {
    /// 47: writes consecutive registers.
    ///
    /// ```text
    /// request  N · first register · N values, of 16 or 32 bits as the register
    /// reply    -
    /// ```
    WriteRegisters<E: RegisterElement> of E, values "The values.", count "1 to 64, or 1 to 32 of 32 bits"
}
