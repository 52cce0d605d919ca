//! Field reader that records the fields it reads.
//!
//! The decoders of the commands read through it, so `decode` shows the fields that a PLC reads.

use fatek::Element;
use fatek::command::Code;
use fatek::wire::{FieldError, FieldReader};

use super::field::{DataReading, Field, Part};
use super::text;

#[derive(Clone, Debug)]
pub(super) struct Recorder<'a, R> {
    inner: R,
    data: &'a [u8],
    code: Code,
    part: Part,
    fields: Vec<Field>,
    /// Last element read: the values that follow are those of this element and of its successors.
    element: Option<Element>,
    /// Number of values read after it.
    values: usize,
}

impl<'a, R: FieldReader + Clone> Recorder<'a, R> {
    /// `inner` reads `data`.
    pub(super) fn new(inner: R, data: &'a [u8], code: Code, part: Part) -> Self {
        Self { inner, data, code, part, fields: Vec::new(), element: None, values: 0 }
    }

    /// Recorded fields, with the fault that ended the reading.
    pub(super) fn into_reading(self, fault: Option<String>) -> DataReading {
        let mut fields: Vec<Field> = Vec::with_capacity(self.fields.len());
        // The 64 words of a page are merged into one field.
        for field in self.fields {
            match fields.last_mut() {
                Some(last) if field.name == PAGE && last.name == PAGE => last.bytes.extend(field.bytes),
                _ => fields.push(field),
            }
        }
        DataReading { fields, fault }
    }

    /// Reads a field and records it under this name.
    pub(super) fn named<T>(
        &mut self,
        name: &str,
        read: impl FnOnce(&mut R) -> Result<T, FieldError>,
        meaning: impl FnOnce(&T) -> String,
    ) -> Result<T, FieldError> {
        let begin = self.position();
        let value = read(&mut self.inner)?;
        let bytes = self.data[begin..self.position()].to_vec();
        self.fields.push(Field { part: self.part, name: name.to_owned(), bytes, meaning: meaning(&value) });
        Ok(value)
    }

    /// Records a field without bytes.
    pub(super) fn remark(&mut self, name: &str, meaning: String) {
        self.fields.push(Field { part: self.part, name: name.to_owned(), bytes: Vec::new(), meaning });
    }

    /// Number of bytes read. Invariant: the rest of `inner` is a suffix of `data`.
    fn position(&self) -> usize {
        self.data.len() - self.inner.clone().rest().len()
    }

    /// Name of the next value.
    fn name_of_value(&mut self) -> String {
        let n = self.values;
        self.values += 1;
        // The manuals do not say which addresses a run of counters of 32 bits has.
        let named = self.element.filter(|element| n == 0 || !element.is_counter_of_32_bits());
        match (named.map(|element| element.nth(n)), self.code) {
            (Some(Ok(element)), _) => element.to_string(),
            (_, Code::ReadProgramPage | Code::WriteProgramPage) if self.part == Part::Request && n == 0 => {
                "page".to_owned()
            }
            (_, Code::ReadProgramPage | Code::WriteProgramPage) => PAGE.to_owned(),
            _ => format!("value {}", n + 1),
        }
    }
}

const PAGE: &str = "64 words";

impl<R: FieldReader + Clone> FieldReader for Recorder<'_, R> {
    fn count(&mut self) -> Result<usize, FieldError> {
        self.named("N", R::count, |count| count.to_string())
    }

    fn code(&mut self) -> Result<u8, FieldError> {
        let code = self.code;
        self.named("control", R::code, |control| text::control(code, *control))
    }

    fn byte(&mut self) -> Result<u8, FieldError> {
        self.named("byte", R::byte, |byte| format!("{byte:02X}h"))
    }

    fn word(&mut self) -> Result<u16, FieldError> {
        let name = self.name_of_value();
        let meaning = |word: &u16| if name == PAGE { String::new() } else { text::word(*word) };
        self.named(&name, R::word, meaning)
    }

    fn dword(&mut self) -> Result<u32, FieldError> {
        let name = self.name_of_value();
        self.named(&name, R::dword, |dword| text::dword(*dword))
    }

    fn bit(&mut self) -> Result<bool, FieldError> {
        if self.code == Code::ControlPlc {
            return self.named("control", R::bit, |on| text::control(Code::ControlPlc, u8::from(*on)));
        }
        let name = self.name_of_value();
        let disabled = self.code == Code::ReadDisabled;
        self.named(&name, R::bit, |on| text::state(*on, disabled).to_owned())
    }

    fn layout(&mut self, elements: usize, values: usize) -> Result<(), FieldError> {
        self.inner.layout(elements, values)
    }

    fn element(&mut self) -> Result<Element, FieldError> {
        let element = self.named("element", R::element, |element| format!("{element}, {}", element.width()))?;
        (self.element, self.values) = (Some(element), 0);
        Ok(element)
    }

    fn rest(&mut self) -> &[u8] {
        // Read from a copy, because the caller gets the rest of the reader itself.
        let bytes = self.inner.clone().rest().to_vec();
        let meaning = text::bytes(&bytes);
        self.fields.push(Field { part: self.part, name: "data".to_owned(), bytes, meaning });
        self.inner.rest()
    }

    fn is_empty(&self) -> bool {
        self.inner.is_empty()
    }
}
