//! Elements as people write them, and as they stand in a request.

use bytes::BytesMut;
use fatek::wire::{AsciiReader, AsciiWriter, BinaryReader, BinaryWriter, FieldReader, FieldWriter};
use fatek::{Discrete, Element, Register, Register32, Width};

use crate::text::round_trip;

pub fn run(input: &[u8]) {
    from_the_wire(input);
    let text = String::from_utf8_lossy(input);
    let element = round_trip::<Element>(&text);
    // As an element of one width it is the same, or none.
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
    assert_eq!(format!("{element:#}").parse(), Ok(element), "as the protocol writes it");
    let symbol = element.symbol();
    assert!(element.address() <= symbol.last_address() && element.address().is_multiple_of(symbol.alignment()));
    let mut field = BytesMut::new();
    AsciiWriter::new(&mut field).element(element);
    assert_eq!(field, format!("{element:#}"));
    assert_eq!(AsciiReader::new(&field).element(), Ok(element));
    field.clear();
    BinaryWriter::new(&mut field).element(element);
    let mut fields = BinaryReader::new(&field);
    fields.layout(1, 0).unwrap();
    assert_eq!(fields.element(), Ok(element));
}

/// What is read as an element is written as the same bytes, but for the case of letters.
fn from_the_wire(bytes: &[u8]) {
    let mut fields = AsciiReader::new(bytes);
    if let Ok(element) = fields.element() {
        let mut field = BytesMut::new();
        AsciiWriter::new(&mut field).element(element);
        let came = bytes.strip_suffix(fields.rest()).unwrap();
        assert!(field.eq_ignore_ascii_case(came), "{came:?} is read as {element}");
    }
    let count = usize::from(bytes.len().is_multiple_of(2)) + 1;
    let mut fields = BinaryReader::new(bytes);
    if fields.layout(count, 0).is_ok() {
        let mut written = BytesMut::new();
        for _ in 0..count {
            // The layout knows symbols; an address past the last one is found when it is read.
            let Ok(element) = fields.element() else { return };
            BinaryWriter::new(&mut written).element(element);
        }
        assert_eq!(written, bytes);
        assert_eq!(fields.finish(), Ok(()));
    }
}
