use bytes::Bytes;

use super::{Code, Command, InvalidRequest, limits};
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

    /// A loop-back whose data nobody else sends: 16 characters, legal in both framings.
    pub(crate) fn nonce(nonce: u64) -> Self {
        Self { data: format!("{nonce:016X}").into() }
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
}
