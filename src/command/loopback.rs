use std::fmt;

use bytes::Bytes;

use super::{Code, Command, InvalidRequest, RequestError, Run, Spelling, limits, sealed, text};
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing, ascii};

/// 4E: sends data that the PLC returns unchanged.
///
/// ```text
/// request  0 to 256 characters (ASCII, printable) or bytes (binary)
/// reply    the same, without an error code
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct LoopBack {
    data: Bytes,
}

impl LoopBack {
    /// A loop-back of this data.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] for more than 256 bytes. In the ASCII framing, sending fails with
    /// [`InvalidRequest::NotPrintable`] unless all bytes are printable.
    pub fn new(data: impl Into<Bytes>) -> Result<Self, InvalidRequest> {
        let data = data.into();
        limits::count(Self::CODE, data.len(), 0, limits::MAX_LOOP_BACK)?;
        Ok(Self { data })
    }

    /// A loop-back of the low 40 bits of a nonce, as 8 digits and upper-case letters.
    pub(crate) fn nonce(nonce: u64) -> Self {
        let digit = |place: u64| {
            let [low, ..] = (nonce >> (5 * place)).to_le_bytes();
            let bits = low & 0x1F;
            if bits < 10 { b'0' + bits } else { b'A' + bits - 10 }
        };
        Self { data: (0..8).rev().map(digit).collect() }
    }

    /// A loop-back without data: the shortest exchange of the protocol.
    pub(crate) fn empty() -> Self {
        Self { data: Bytes::new() }
    }

    /// The data.
    #[must_use]
    pub fn data(&self) -> &Bytes {
        &self.data
    }
}

impl sealed::Sealed for LoopBack {}

impl fmt::Display for LoopBack {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        text::command(f, Self::CODE, text::Data(&self.data))
    }
}

impl Command for LoopBack {
    type Reply = ();
    const CODE: Code = Code::LoopBack;
    const IMPLIED_REPLY: Option<()> = Some(());

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.raw(&self.data);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        Ok(Self::new(Bytes::copy_from_slice(fields.rest()))?)
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), fields: &mut W) {
        fields.raw(&self.data);
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<(), FieldError> {
        if fields.rest() == self.data { Ok(()) } else { Err(FieldError::NotTheEcho) }
    }

    fn fmt_reply((): &(), f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("done")
    }

    fn for_each_run(&self, _each: &mut dyn FnMut(Run)) {}

    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(self, framing)?;
        match framing {
            Framing::Ascii => ascii::find_unprintable(&self.data).map_or(Ok(()), |(position, byte)| {
                Err(InvalidRequest::NotPrintable { code: Self::CODE, byte, position })
            }),
            Framing::Binary => Ok(()),
        }
    }

    fn is_like_a_refusal(&self) -> bool {
        self.data.len() == 1
    }

    /// A hash of the data: an echo fits only a loop-back of the same data.
    fn reply_size(&self, _spelling: Spelling, _framing: Framing) -> u32 {
        self.data.iter().fold(u32::try_from(self.data.len()).unwrap_or(u32::MAX), |hash, &byte| {
            (hash.rotate_left(5) ^ u32::from(byte)).wrapping_mul(0x9E37_79B1)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn a_nonce_is_eight_printable_digits_of_its_low_40_bits() {
        for nonce in [0, 1, 9, 10, 31, 32, 0x1234_5678_9ABC_DEF0, u64::MAX] {
            let digits = LoopBack::nonce(nonce);
            assert_eq!(digits.data().len(), 8);
            assert!(digits.data().iter().all(|digit| digit.is_ascii_digit() || digit.is_ascii_uppercase()));
            let text = str::from_utf8(digits.data()).expect("ASCII");
            assert_eq!(u64::from_str_radix(text, 32), Ok(nonce % (1 << 40)));
        }
    }

    #[test]
    fn loop_backs_of_other_data_have_another_reply() {
        let size = |data: &[u8]| {
            let request = LoopBack::new(data.to_vec()).expect("short");
            request.reply_size(request.plain(), Framing::Ascii)
        };
        let one: HashSet<u32> = (0..=u8::MAX).map(|byte| size(&[byte])).collect();
        let first: HashSet<u32> = (0..=u8::MAX).map(|byte| size(&[byte, b'A'])).collect();
        let last: HashSet<u32> = (0..=u8::MAX).map(|byte| size(&[b'A', byte])).collect();
        assert_eq!((one.len(), first.len(), last.len()), (256, 256, 256));
        assert_ne!(size(b"AB"), size(b"BA"));
    }
}
