use std::fmt;

use super::consecutive::{read_consecutive, write_consecutive};
use super::{
    Candidates, Code, Command, Consecutive, ConsecutiveElement, InvalidRequest, RequestError, Run, Spelling, blank,
    limits, sealed, spelling, text,
};
use crate::element::Discrete;
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

read_consecutive! {
    /// 43: reads which of consecutive discretes are disabled.
    ///
    /// ```text
    /// request  N (256 as 00) · first discrete
    /// reply    N states: 1 disabled, 0 enabled
    /// ```
    ReadDisabled of Discrete, count "1 to 256"
}

read_consecutive! {
    /// 44: reads the states of consecutive discretes.
    ///
    /// ```text
    /// request  N (256 as 00) · first discrete
    /// reply    N states: 1 on, 0 off
    /// ```
    ReadDiscretes of Discrete, count "1 to 256"
}

write_consecutive! {
    /// 45: writes the states of consecutive discretes.
    ///
    /// ```text
    /// request  N (256 as 00) · first discrete · N states: 1 on, 0 off
    /// reply    -
    /// ```
    WriteDiscretes of Discrete, states "The states: `true` is on.", count "1 to 256"
}
