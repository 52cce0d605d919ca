//! Elements as text, and as fields of a request.

use bytes::BytesMut;
use fatek::wire::{AsciiReader, AsciiWriter, BinaryReader, BinaryWriter, FieldReader, FieldWriter, Framing};
use fatek::{Discrete, Element, Register, Register32, Width};

use crate::text::round_trip;

pub fn run(input: &[u8]) {
    from_the_wire(input);
    let text = String::from_utf8_lossy(input);
    let element = round_trip::<Element>(&text);
    // Parsed as an element of one width, the result is the same element or an error.
    let narrow = [
        round_trip::<Discrete>(&text).map(Element::from),
        round_trip::<Register>(&text).map(Element::from),
        round_trip::<Register32>(&text).map(Element::from),
    ];
    let width = element.map(|element| element.width());
    for (narrow, of) in narrow.into_iter().zip([Width::Bit, Width::Word, Width::DWord]) {
        assert_eq!(narrow, element.filter(|_| width == Some(of)));
    }
    let Some(element) = element else { return };
    assert_eq!(format!("{element:#}").parse(), Ok(element), "form of the protocol");
    let symbol = element.symbol();
    assert!(element.address() <= symbol.last_address() && element.address().is_multiple_of(symbol.alignment()));
    let mut field = BytesMut::new();
    AsciiWriter::new(&mut field).element(element);
    assert_eq!(field.len(), symbol.as_str().len() + symbol.digits());
    if element.check_in(Framing::Ascii).is_ok() {
        assert_eq!(field, format!("{element:#}"));
        assert_eq!(AsciiReader::new(&field).element(), Ok(element));
    } else {
        assert!(AsciiReader::new(&field).element().is_err(), "{element} is written as another element");
    }
    field.clear();
    BinaryWriter::new(&mut field).element(element);
    let mut fields = BinaryReader::new(&field);
    fields.layout(1, 0).unwrap();
    assert_eq!(fields.element(), Ok(element));
}

/// Invariant: an element that is read is written as the same bytes, except for the case of letters.
fn from_the_wire(bytes: &[u8]) {
    let mut fields = AsciiReader::new(bytes);
    if let Ok(element) = fields.element() {
        let mut field = BytesMut::new();
        AsciiWriter::new(&mut field).element(element);
        let read = bytes.strip_suffix(fields.rest()).unwrap();
        assert!(field.eq_ignore_ascii_case(read), "{read:?} is read as {element}");
    }
    let count = usize::from(bytes.len().is_multiple_of(2)) + 1;
    let mut fields = BinaryReader::new(bytes);
    if fields.layout(count, 0).is_ok() {
        let mut written = BytesMut::new();
        for _ in 0..count {
            // The layout checks symbols, the read checks addresses.
            let Ok(element) = fields.element() else { return };
            BinaryWriter::new(&mut written).element(element);
        }
        assert_eq!(written, bytes);
        assert_eq!(fields.finish(), Ok(()));
    }
}
