use proptest::prelude::*;

use super::*;
use crate::element::{Symbol, Width};
use crate::wire::Framing;
use crate::{discrete, element, register, register32};

#[test]
fn a_word_of_relays_overlaps_its_bits() {
    let mut memory = Memory::default();
    memory.set_bit(discrete!("M8"), true);
    memory.set_bit(discrete!("M23"), true);
    memory.set_bit(discrete!("M24"), true);
    assert_eq!(memory.word(register!("WM8")), 0x8001);
    memory.set_word(register!("WM16"), 0x0002);
    assert!(memory.bit(discrete!("M17")));
    assert!(!memory.bit(discrete!("M23")) && !memory.bit(discrete!("M24")));
    assert_eq!(memory.dword(register32!("DWM8")), 0x0000_0201);
}

#[test]
fn a_double_word_has_the_low_word_first() {
    let mut memory = Memory::default();
    memory.set_dword(register32!("DR100"), 10_000_000);
    assert_eq!((memory.word(register!("R100")), memory.word(register!("R101"))), (0x9680, 0x0098));
    memory.set_word(register!("R102"), 1);
    assert_eq!(memory.dword(register32!("DR101")), 0x0001_0098);
}

#[test]
fn contact_and_value_of_a_timer_are_separate() {
    let mut memory = Memory::default();
    memory.set_word(register!("WT0"), 0xFFFF);
    memory.set_word(register!("WC0"), 0x00FF);
    assert_eq!((memory.word(register!("RT0")), memory.word(register!("RC0"))), (0, 0));
    memory.set_word(register!("RT0"), 0);
    assert!(memory.bit(discrete!("T0")));
}

#[test]
fn the_last_word_of_relays_includes_the_last_relay() {
    let mut memory = Memory::default();
    memory.set_word(register!("WM9984"), 0x8000);
    assert!(memory.bit(discrete!("M9999")));
    assert_eq!(memory.dword(register32!("DWM9968")), 0x8000_0000);
    memory.set_dword(register32!("DR65534"), 0xABCD_0000);
    assert_eq!(memory.word(register!("R65535")), 0xABCD);
}

#[test]
fn a_value_of_the_wrong_width_is_not_written() {
    let mut memory = Memory::default();
    let element = element!("WM0");
    let value = Value::DWord(1);
    assert_eq!(memory.write(element, value), Err(ElementError::WrongWidth { element, expected: Width::DWord }.into()));
    assert_eq!(memory.read(element), Value::Word(0));
}

/// Before: `DRC201` was the high word of `DRC200` and the low word of `DRC202`.
#[test]
fn counters_of_32_bits_are_separate() {
    let mut memory = Memory::default();
    let counter = |address| Register32::new(Symbol::DRC, address).unwrap();
    memory.set_dword(counter(198), 0x0198_0198);
    (200..=255).for_each(|address| memory.set_dword(counter(address), 0xC0DE_0000 | u32::from(address)));
    memory.set_dword(counter(256), 0x0256_0256);
    memory.set_word(register!("F0"), 7);
    for address in 200..=255 {
        assert_eq!(memory.dword(counter(address)), 0xC0DE_0000 | u32::from(address));
    }
    assert_eq!((memory.dword(counter(198)), memory.word(register!("RC256"))), (0x0198_0198, 0x0256));
}

#[test]
fn memory_is_allocated_on_the_first_write() {
    let mut memory = Memory::default();
    memory.set_dword(register32!("DD7"), 0);
    memory.set_bit(discrete!("M9999"), false);
    assert!(memory.pages.is_empty());
    memory.set_word(register!("D31"), 1);
    memory.set_word(register!("D0"), 1);
    assert_eq!(memory.pages.len(), 1);
}

proptest! {
    #[test]
    fn the_memory_behaves_like_plain_arrays(steps in prop::collection::vec((any_element(), any::<u32>()), 1..40)) {
        let mut memory = Memory::default();
        let mut reference = Reference::default();
        for &(element, bits) in &steps {
            let value = match element.width() {
                Width::Bit => Value::Bit(bits & 1 == 1),
                Width::Word => Value::Word(bits as u16),
                Width::DWord => Value::DWord(bits),
            };
            memory.write(element, value).unwrap();
            reference.write(element, bits);
            for &(other, _) in &steps {
                prop_assert_eq!(memory.read(other), reference.read(other), "{} after {} = {}", other, element, value);
            }
        }
    }
}

/// Elements with few addresses, at both ends of the memory, so that many overlap.
fn any_element() -> impl Strategy<Value = Element> {
    (prop::sample::select(Symbol::ALL), 0_u16..48, any::<bool>()).prop_map(|(symbol, offset, at_the_end)| {
        let address = if at_the_end { symbol.last_address_in(Framing::Ascii) - offset } else { offset };
        Element::new(symbol, address - address % symbol.alignment()).unwrap()
    })
}

/// The memory as in the manual's table: bits and registers by letters.
#[derive(Default)]
struct Reference {
    bits: BTreeMap<&'static str, Vec<bool>>,
    words: BTreeMap<&'static str, Vec<u16>>,
}

impl Reference {
    fn read(&mut self, element: Element) -> Value {
        let bits = (0..element.width().bits()).map(|n| u32::from(self.bit(element, n)) << n).sum::<u32>();
        match element.width() {
            Width::Bit => Value::Bit(bits == 1),
            Width::Word => Value::Word(bits as u16),
            Width::DWord => Value::DWord(bits),
        }
    }

    fn bit(&mut self, element: Element, n: u32) -> bool {
        match self.locate(element) {
            BitsOrWords::Bits(bits) => bits[n as usize],
            BitsOrWords::Words(words) => words[n as usize / 16] >> (n % 16) & 1 == 1,
        }
    }

    fn write(&mut self, element: Element, value: u32) {
        for n in 0..element.width().bits() {
            let on = value >> n & 1 == 1;
            match self.locate(element) {
                BitsOrWords::Bits(bits) => bits[n as usize] = on,
                BitsOrWords::Words(words) => {
                    let word = &mut words[n as usize / 16];
                    *word = *word & !(1 << (n % 16)) | u16::from(on) << (n % 16);
                }
            }
        }
    }

    fn locate(&mut self, element: Element) -> BitsOrWords<'_> {
        let letters = element.symbol().as_str();
        let address = usize::from(element.address());
        let letters = if element.width() == Width::DWord { &letters[1..] } else { letters };
        let letters = letters.strip_prefix('W').unwrap_or(letters);
        if ["X", "Y", "M", "S", "T", "C"].contains(&letters) {
            BitsOrWords::Bits(&mut self.bits.entry(letters).or_insert_with(|| vec![false; 10_000])[address..])
        } else {
            BitsOrWords::Words(&mut self.words.entry(letters).or_insert_with(|| vec![0; 65_536])[address..])
        }
    }
}

enum BitsOrWords<'a> {
    Bits(&'a mut [bool]),
    Words(&'a mut [u16]),
}
