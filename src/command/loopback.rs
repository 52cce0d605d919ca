use bytes::Bytes;

use super::{Code, Command, InvalidRequest, Spelling, limits};
use crate::wire::{EncodeError, FieldError, FieldReader, FieldWriter, Framing, ascii};

/// 4E: sends data that the PLC returns as it is.
///
/// ```text
/// request  0 to 256 characters (ASCII, printable) or bytes (binary)
/// reply    the same, with no error code before it
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct LoopBack {
    data: Bytes,
}

impl LoopBack {
    /// Sends this data.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] when it is longer than 256. That it is printable is checked when it is sent in
    /// the ASCII framing.
    pub fn new(data: impl Into<Bytes>) -> Result<Self, InvalidRequest> {
        let data = data.into();
        limits::count(Self::CODE, data.len(), 0, limits::MAX_LOOP_BACK)?;
        Ok(Self { data })
    }

    /// A loop-back with 8 characters of a nonce, digits and upper-case letters: 40 bits, the low ones of `nonce`.
    pub(crate) fn nonce(nonce: u64) -> Self {
        let digit = |place: u64| {
            let bits = u8::try_from(nonce >> (5 * place) & 0x1F).unwrap_or_default();
            if bits < 10 { b'0' + bits } else { b'A' + bits - 10 }
        };
        Self { data: (0..8).rev().map(digit).collect() }
    }

    /// A loop-back without data: the shortest exchange there is.
    pub(crate) fn empty() -> Self {
        Self { data: Bytes::new() }
    }

    /// The data.
    #[must_use]
    pub fn data(&self) -> &Bytes {
        &self.data
    }
}

impl Command for LoopBack {
    type Reply = ();
    const CODE: Code = Code::LoopBack;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.raw(&self.data);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, FieldError> {
        Ok(Self::new(Bytes::copy_from_slice(fields.rest()))?)
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), fields: &mut W) {
        fields.raw(&self.data);
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<(), FieldError> {
        if fields.rest() == self.data { Ok(()) } else { Err(FieldError::NotTheEcho) }
    }

    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(Self::CODE, framing)?;
        match ascii::check_printable(&self.data) {
            Err(EncodeError::NotPrintable { byte, position }) if framing == Framing::Ascii => {
                Err(InvalidRequest::NotPrintable { code: Self::CODE, byte, position })
            }
            _ => Ok(()),
        }
    }

    fn is_like_a_refusal(&self) -> bool {
        self.data.len() == 1
    }

    /// A fingerprint of the data: an echo fits a loop-back of the same data only.
    fn reply_size(&self, _spelling: Spelling, _framing: Framing) -> u32 {
        self.data.iter().fold(u32::try_from(self.data.len()).unwrap_or(u32::MAX), |hash, &byte| {
            (hash.rotate_left(5) ^ u32::from(byte)).wrapping_mul(0x9E37_79B1)
        })
    }
}
