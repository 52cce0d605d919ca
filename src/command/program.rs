use std::fmt;

use super::{Code, Command, RequestError, Run, sealed, text};
use crate::wire::{FieldError, FieldReader, FieldWriter};

/// The words of a program page.
pub const PAGE_WORDS: usize = 64;

/// A page of a program: 64 words. Page 0 is the header, the other pages are the ladder.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct ProgramPage {
    words: [u16; PAGE_WORDS],
}

impl ProgramPage {
    /// A page of these words.
    #[must_use]
    pub fn new(words: [u16; PAGE_WORDS]) -> Self {
        Self { words }
    }

    /// The words.
    #[must_use]
    pub fn words(&self) -> &[u16; PAGE_WORDS] {
        &self.words
    }

    /// The words as 128 bytes, the high byte of each word first.
    #[must_use]
    pub fn to_bytes(&self) -> [u8; 2 * PAGE_WORDS] {
        let mut bytes = [0; 2 * PAGE_WORDS];
        for (pair, word) in bytes.chunks_exact_mut(2).zip(self.words) {
            pair.copy_from_slice(&word.to_be_bytes());
        }
        bytes
    }

    /// A page of these bytes, the high byte of each word first.
    #[must_use]
    pub fn from_bytes(bytes: &[u8; 2 * PAGE_WORDS]) -> Self {
        let mut words = [0; PAGE_WORDS];
        for (word, pair) in words.iter_mut().zip(bytes.chunks_exact(2)) {
            *word = u16::from_be_bytes([pair[0], pair[1]]);
        }
        Self { words }
    }
}

impl fmt::Debug for ProgramPage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ProgramPage(")?;
        self.words.iter().try_for_each(|word| write!(f, "{word:04X}"))?;
        f.write_str(")")
    }
}

impl fmt::Display for ProgramPage {
    /// The first 16 words in hexadecimal, and their number: `FB00, FB01, ... (64 in all)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", text::List(self.words.iter().map(|word| format!("{word:04X}"))))
    }
}

/// 4F: reads one page of the program. ASCII framing only.
///
/// ```text
/// request  page, 4 hex digits
/// reply    64 words
/// ```
///
/// The reply may have an error digit before the words or not: text and figure of the manual differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ReadProgramPage {
    /// The number of the page; 0 is the header.
    pub page: u16,
}

impl ReadProgramPage {
    /// A read of this page.
    #[must_use]
    pub fn new(page: u16) -> Self {
        Self { page }
    }
}

impl sealed::Sealed for ReadProgramPage {}

impl fmt::Display for ReadProgramPage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        text::command(f, Self::CODE, self.page)
    }
}

impl Command for ReadProgramPage {
    type Reply = ProgramPage;
    const CODE: Code = Code::ReadProgramPage;

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.word(self.page);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        Ok(Self { page: fields.word()? })
    }

    fn write_reply<W: FieldWriter>(&self, reply: &ProgramPage, fields: &mut W) {
        write_page(reply, fields);
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<ProgramPage, FieldError> {
        read_page(fields)
    }

    fn fmt_reply(reply: &ProgramPage, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{reply}")
    }

    fn for_each_run(&self, _each: &mut dyn FnMut(Run)) {}
}

/// 50: writes one page of the program. ASCII framing only.
///
/// ```text
/// request  page, 4 hex digits · 64 words
/// reply    -
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct WriteProgramPage {
    /// The number of the page; 0 is the header.
    pub page: u16,
    /// The new content.
    pub content: ProgramPage,
}

impl WriteProgramPage {
    /// A write of this page.
    #[must_use]
    pub fn new(page: u16, content: ProgramPage) -> Self {
        Self { page, content }
    }
}

impl sealed::Sealed for WriteProgramPage {}

impl fmt::Display for WriteProgramPage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { page, content } = self;
        text::command(f, Self::CODE, format_args!("{page} = {content}"))
    }
}

impl Command for WriteProgramPage {
    type Reply = ();
    const CODE: Code = Code::WriteProgramPage;
    const IMPLIED_REPLY: Option<()> = Some(());

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.word(self.page);
        write_page(&self.content, fields);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        Ok(Self { page: fields.word()?, content: read_page(fields)? })
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), _fields: &mut W) {}

    fn read_reply<R: FieldReader>(&self, _fields: &mut R) -> Result<(), FieldError> {
        Ok(())
    }

    fn fmt_reply((): &(), f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("done")
    }

    fn for_each_run(&self, _each: &mut dyn FnMut(Run)) {}
}

fn write_page(page: &ProgramPage, fields: &mut impl FieldWriter) {
    fields.words(&page.words);
}

fn read_page(fields: &mut impl FieldReader) -> Result<ProgramPage, FieldError> {
    let mut words = [0; PAGE_WORDS];
    fields.words(&mut words)?;
    Ok(ProgramPage { words })
}
