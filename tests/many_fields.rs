//! Fields read and written in blocks, compared with a reference that goes character by character.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

use bytes::{BufMut, BytesMut};
use fatek::Element;
use fatek::wire::{
    AsciiReader, AsciiWriter, BinaryReader, BinaryWriter, FieldError, FieldReader, FieldWriter, Framing,
};
use proptest::collection::vec;
use proptest::prelude::*;

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn block_reads_equal_single_reads(data in data(), count in 0_usize..70) {
        for framing in [Framing::Ascii, Framing::Binary] {
            let mut reference = ReferenceReader { framing, data: &data };
            match framing {
                Framing::Ascii => compare(AsciiReader::new(&data), &mut reference, count)?,
                _ => compare(BinaryReader::new(&data), &mut reference, count)?,
            }
        }
    }

    #[test]
    fn block_writes_equal_single_writes(
        bits in vec(any::<bool>(), 0..300),
        words in vec(any::<u16>(), 0..200),
        dwords in vec(any::<u32>(), 0..200),
    ) {
        for framing in [Framing::Ascii, Framing::Binary] {
            let (mut in_blocks, mut expected) = (BytesMut::from("before"), BytesMut::from("before"));
            match framing {
                Framing::Ascii => write(&mut AsciiWriter::new(&mut in_blocks), &bits, &words, &dwords),
                _ => write(&mut BinaryWriter::new(&mut in_blocks), &bits, &words, &dwords),
            }
            write(&mut ReferenceWriter { framing, dst: &mut expected }, &bits, &words, &dwords);
            prop_assert_eq!(&in_blocks, &expected, "{}", framing);
        }
    }
}

#[test]
fn each_wrong_character_is_reported() {
    for wrong in 0..=u8::MAX {
        for place in 0..64 {
            let mut data = [b'1'; 64];
            data[place] = wrong;
            let mut reference = ReferenceReader { framing: Framing::Ascii, data: &data };
            compare(AsciiReader::new(&data), &mut reference, 16).unwrap();
            let data = data.map(|byte| byte ^ b'0');
            let mut reference = ReferenceReader { framing: Framing::Binary, data: &data };
            compare(BinaryReader::new(&data), &mut reference, 64).unwrap();
        }
    }
}

/// Random data: digits, digits of bits, bits of the binary framing, some with a few wrong bytes.
fn data() -> impl Strategy<Value = Vec<u8>> {
    let digits = prop::sample::select(b"0123456789ABCDEFabcdef".to_vec());
    let bits = prop::sample::select(b"01".to_vec());
    prop_oneof![
        vec(digits.clone(), 0..300),
        vec(bits, 0..300),
        vec(0_u8..2, 0..300),
        vec(prop_oneof![99 => digits, 1 => any::<u8>()], 0..300),
        vec(prop_oneof![99 => 0_u8..2, 1 => any::<u8>()], 0..300),
        vec(any::<u8>(), 0..300),
    ]
}

/// Compares the results, and the remaining data after a success.
fn compare<R: FieldReader + Clone>(
    reader: R,
    reference: &mut ReferenceReader<'_>,
    count: usize,
) -> Result<(), TestCaseError> {
    one(&reader, reference, |r| r.code(), |r| r.code())?;
    one(&reader, reference, |r| r.byte(), |r| r.byte())?;
    one(&reader, reference, |r| r.word(), |r| r.word())?;
    one(&reader, reference, |r| r.dword(), |r| r.dword())?;
    one(&reader, reference, |r| r.bit(), |r| r.bit())?;
    one(&reader, reference, |r| many(count, |into| r.bits(into)), |r| many(count, |into| r.bits(into)))?;
    one(&reader, reference, |r| many(count, |into| r.words(into)), |r| many(count, |into| r.words(into)))?;
    one(&reader, reference, |r| many(count, |into| r.dwords(into)), |r| many(count, |into| r.dwords(into)))
}

fn one<'a, R: FieldReader + Clone, T: PartialEq + std::fmt::Debug>(
    reader: &R,
    reference: &ReferenceReader<'a>,
    read: impl Fn(&mut R) -> Result<T, FieldError>,
    read_reference: impl Fn(&mut ReferenceReader<'a>) -> Result<T, FieldError>,
) -> Result<(), TestCaseError> {
    let (mut reader, mut reference) = (reader.clone(), reference.clone());
    let (result, expected) = (read(&mut reader), read_reference(&mut reference));
    prop_assert_eq!(&result, &expected, "{}", reference.framing);
    if result.is_ok() {
        prop_assert_eq!(reader.rest(), reference.data, "{}", reference.framing);
    }
    Ok(())
}

fn many<T: Clone + Default>(
    count: usize,
    read: impl FnOnce(&mut [T]) -> Result<(), FieldError>,
) -> Result<Vec<T>, FieldError> {
    let mut values = vec![T::default(); count];
    read(&mut values).map(|()| values)
}

fn write(fields: &mut impl FieldWriter, bits: &[bool], words: &[u16], dwords: &[u32]) {
    fields.words(words);
    fields.bits(bits);
    fields.dwords(dwords);
    bits.iter().for_each(|&bit| fields.bit(bit));
    words.iter().for_each(|&word| fields.word(word));
    dwords.iter().for_each(|&dword| fields.dword(dword));
    words.iter().for_each(|&word| fields.byte(word.to_be_bytes()[0]));
}

/// Reference reader: character by character, byte by byte.
#[derive(Clone)]
struct ReferenceReader<'a> {
    framing: Framing,
    data: &'a [u8],
}

impl ReferenceReader<'_> {
    fn number(&mut self, bytes: usize) -> Result<u32, FieldError> {
        (0..bytes).try_fold(0, |number, _| Ok(number << 8 | u32::from(self.byte()?)))
    }

    fn next(&mut self) -> Result<u8, FieldError> {
        let (&first, rest) = self.data.split_first().ok_or(FieldError::Truncated)?;
        self.data = rest;
        Ok(first)
    }
}

impl FieldReader for ReferenceReader<'_> {
    fn count(&mut self) -> Result<usize, FieldError> {
        unreachable!("not compared")
    }

    fn code(&mut self) -> Result<u8, FieldError> {
        let next = self.next()?;
        match self.framing {
            Framing::Ascii => char::from(next).to_digit(16).map(|digit| digit as u8).ok_or(FieldError::NotHex(next)),
            _ => Ok(next),
        }
    }

    fn byte(&mut self) -> Result<u8, FieldError> {
        match self.framing {
            Framing::Ascii => Ok(self.code()? << 4 | self.code()?),
            _ => self.next(),
        }
    }

    fn word(&mut self) -> Result<u16, FieldError> {
        self.number(2).map(|word| word as u16)
    }

    fn dword(&mut self) -> Result<u32, FieldError> {
        self.number(4)
    }

    fn layout(&mut self, _elements: usize, _values: usize) -> Result<(), FieldError> {
        unreachable!("not compared")
    }

    fn element(&mut self) -> Result<Element, FieldError> {
        unreachable!("not compared")
    }

    fn rest(&mut self) -> &[u8] {
        std::mem::take(&mut self.data)
    }

    fn is_empty(&self) -> bool {
        self.data.is_empty()
    }
}

/// Reference writer, based on the standard library's formatting.
struct ReferenceWriter<'a> {
    framing: Framing,
    dst: &'a mut BytesMut,
}

impl ReferenceWriter<'_> {
    fn put(&mut self, digits: String, bytes: &[u8]) {
        self.dst.put_slice(if self.framing == Framing::Ascii { digits.as_bytes() } else { bytes });
    }
}

impl FieldWriter for ReferenceWriter<'_> {
    fn count(&mut self, _count: usize) {
        unreachable!("not compared")
    }

    fn code(&mut self, code: u8) {
        self.put(format!("{code:X}"), &[code]);
    }

    fn byte(&mut self, byte: u8) {
        self.put(format!("{byte:02X}"), &[byte]);
    }

    fn word(&mut self, word: u16) {
        self.put(format!("{word:04X}"), &word.to_be_bytes());
    }

    fn dword(&mut self, dword: u32) {
        self.put(format!("{dword:08X}"), &dword.to_be_bytes());
    }

    fn element(&mut self, _element: Element) {
        unreachable!("not compared")
    }

    fn raw(&mut self, _bytes: &[u8]) {
        unreachable!("not compared")
    }
}
