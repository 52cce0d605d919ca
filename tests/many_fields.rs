//! Many fields at once are the same as one after the other, and those are the same as by the book: what the codecs read
//! and write in blocks is compared with a reader and a writer that go character by character.
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
    fn what_is_read_at_once_is_what_is_read_by_the_book(data in data(), count in 0_usize..70) {
        for framing in [Framing::Ascii, Framing::Binary] {
            let mut book = Book { framing, data: &data };
            match framing {
                Framing::Ascii => compare(AsciiReader::new(&data), &mut book, count)?,
                _ => compare(BinaryReader::new(&data), &mut book, count)?,
            }
        }
    }

    #[test]
    fn what_is_written_at_once_is_what_is_written_by_the_book(
        bits in vec(any::<bool>(), 0..300),
        words in vec(any::<u16>(), 0..200),
        dwords in vec(any::<u32>(), 0..200),
    ) {
        for framing in [Framing::Ascii, Framing::Binary] {
            let (mut at_once, mut by_the_book) = (BytesMut::from("before"), BytesMut::from("before"));
            match framing {
                Framing::Ascii => write(&mut AsciiWriter::new(&mut at_once), &bits, &words, &dwords),
                _ => write(&mut BinaryWriter::new(&mut at_once), &bits, &words, &dwords),
            }
            write(&mut Scribe { framing, dst: &mut by_the_book }, &bits, &words, &dwords);
            prop_assert_eq!(&at_once, &by_the_book, "{}", framing);
        }
    }
}

#[test]
fn each_wrong_character_at_each_place_is_named() {
    for wrong in 0..=u8::MAX {
        for place in 0..64 {
            let mut data = [b'1'; 64];
            data[place] = wrong;
            let mut book = Book { framing: Framing::Ascii, data: &data };
            compare(AsciiReader::new(&data), &mut book, 16).unwrap();
            let data = data.map(|byte| byte ^ b'0');
            let mut book = Book { framing: Framing::Binary, data: &data };
            compare(BinaryReader::new(&data), &mut book, 64).unwrap();
        }
    }
}

/// Digits, mostly those of bits, with something else now and then, and bits of the binary framing.
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

/// The same results, and the same rest after those that are good.
fn compare<R: FieldReader + Clone>(reader: R, book: &mut Book<'_>, count: usize) -> Result<(), TestCaseError> {
    one(&reader, book, |r| r.code(), |r| r.code())?;
    one(&reader, book, |r| r.byte(), |r| r.byte())?;
    one(&reader, book, |r| r.word(), |r| r.word())?;
    one(&reader, book, |r| r.dword(), |r| r.dword())?;
    one(&reader, book, |r| r.bit(), |r| r.bit())?;
    one(&reader, book, |r| many(count, |into| r.bits(into)), |r| many(count, |into| r.bits(into)))?;
    one(&reader, book, |r| many(count, |into| r.words(into)), |r| many(count, |into| r.words(into)))?;
    one(&reader, book, |r| many(count, |into| r.dwords(into)), |r| many(count, |into| r.dwords(into)))
}

fn one<'a, R: FieldReader + Clone, T: PartialEq + std::fmt::Debug>(
    reader: &R,
    book: &Book<'a>,
    read: impl Fn(&mut R) -> Result<T, FieldError>,
    read_book: impl Fn(&mut Book<'a>) -> Result<T, FieldError>,
) -> Result<(), TestCaseError> {
    let (mut reader, mut book) = (reader.clone(), book.clone());
    let (result, expected) = (read(&mut reader), read_book(&mut book));
    prop_assert_eq!(&result, &expected, "{}", book.framing);
    if result.is_ok() {
        prop_assert_eq!(reader.rest(), book.data, "{}", book.framing);
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

/// Reads character by character, byte by byte.
#[derive(Clone)]
struct Book<'a> {
    framing: Framing,
    data: &'a [u8],
}

impl Book<'_> {
    fn number(&mut self, bytes: usize) -> Result<u32, FieldError> {
        (0..bytes).try_fold(0, |number, _| Ok(number << 8 | u32::from(self.byte()?)))
    }

    fn next(&mut self) -> Result<u8, FieldError> {
        let (&first, rest) = self.data.split_first().ok_or(FieldError::Truncated)?;
        self.data = rest;
        Ok(first)
    }
}

impl FieldReader for Book<'_> {
    fn count(&mut self) -> Result<usize, FieldError> {
        unreachable!("it is not compared")
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
        unreachable!("it is not compared")
    }

    fn element(&mut self) -> Result<Element, FieldError> {
        unreachable!("it is not compared")
    }

    fn rest(&mut self) -> &[u8] {
        std::mem::take(&mut self.data)
    }

    fn is_empty(&self) -> bool {
        self.data.is_empty()
    }
}

/// Writes with what the standard library formats.
struct Scribe<'a> {
    framing: Framing,
    dst: &'a mut BytesMut,
}

impl Scribe<'_> {
    fn put(&mut self, digits: String, bytes: &[u8]) {
        self.dst.put_slice(if self.framing == Framing::Ascii { digits.as_bytes() } else { bytes });
    }
}

impl FieldWriter for Scribe<'_> {
    fn count(&mut self, _count: usize) {
        unreachable!("it is not compared")
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
        unreachable!("it is not compared")
    }

    fn raw(&mut self, _bytes: &[u8]) {
        unreachable!("it is not compared")
    }
}
