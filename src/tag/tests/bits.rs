use super::*;
use crate::element;

#[test]
fn bits_of_a_register_are_read_by_their_number() {
    let bools = |states: &[u8]| states.iter().map(|&on| TagValue::Bool(on == 1)).collect::<Vec<_>>();
    for (text, canonical, raw, states) in [
        ("R5.3", "R5.3", Value::Word(0x0008), &[1][..]),
        ("r5.03:BOOL", "R5.3", Value::Word(0xFFF7), &[0]),
        ("R5.15", "R5.15", Value::Word(0x8000), &[1]),
        ("R5.0-R5.3", "R5.0-R5.3", Value::Word(0x000D), &[1, 0, 1, 1]),
        ("R5.0-3", "R5.0-R5.3", Value::Word(0xFFF2), &[0, 1, 0, 0]),
        ("D7.12-15:bit", "D7.12-D7.15", Value::Word(0x7000), &[1, 1, 1, 0]),
        ("RT1.0", "RT1.0", Value::Word(1), &[1]),
        ("DR10.31", "DR10.31", Value::DWord(0x8000_0000), &[1]),
        ("DRC200.16-DRC200.17", "DRC200.16-DRC200.17", Value::DWord(0x0002_0000), &[0, 1]),
    ] {
        let tag = tag(text);
        assert_eq!(tag.to_string(), canonical);
        assert_eq!((tag.tag_type(), tag.element_count(), tag.value_count()), (TagType::Bool, 1, states.len()));
        assert!(tag.is_bits_of_register());
        assert_eq!(tag.decode(&[raw]), Ok(bools(states)), "{text}");
        let singles: Vec<_> = tag.singles().map(|tag| tag.decode(&[raw]).unwrap().concat_one()).collect();
        assert_eq!(singles, bools(states));
    }
}

#[test]
fn a_bit_of_a_word_of_discretes_is_the_discrete() {
    for (text, discretes) in [
        ("WM0.0", "M0"),
        ("WM16.3", "M19"),
        ("WY8.0-WY8.15", "Y8-Y23"),
        ("wx0.4-7:bool", "X4-X7"),
        ("DWS8.31", "S39"),
        ("WT0.1", "T1"),
    ] {
        assert_eq!(tag(text), tag(discretes), "{text}");
        assert!(!tag(text).is_bits_of_register());
    }
}

#[test]
fn errors_of_bits_name_the_register_and_the_rule() {
    for (text, rule) in [
        ("R5.16", "R5 is a 16-bit register, which has no bit 16"),
        ("R5.9999", "R5 is a 16-bit register, which has no bit 255"),
        ("DR4.32", "DR4 is a 32-bit register, which has no bit 32"),
        ("M5.0", "M5 is a discrete, which has no bit 0"),
        ("R5.", "R5. is followed by the number of a bit, such as R5.0"),
        ("R5.x", "R5. is followed by the number of a bit, such as R5.0"),
        ("R5.3.1", "R5. is followed by the number of a bit, such as R5.0"),
        ("R5.3-", "R5. is followed by the number of a bit, such as R5.0"),
        ("R5.3-R6.1", "the bits of a range are in one register, and this range is from R5 to R6"),
        ("R5.3-R5.1", "the range goes backwards, from R5.3 to R5.1"),
        ("R5.3-1", "the range goes backwards, from R5.3 to R5.1"),
        ("R5.3:u16", "a bit of a register is bool, not u16"),
        ("R5.3:bool*2", "bool takes neither gain nor offset (types that do: u16 i16 u32 i32 f32 u32-hi i32-hi f32-hi)"),
        ("R5.3:f33", "the type is unknown (known: bool"),
        ("Q5.3", "no element has these letters (known: X"),
        ("R65536.3", "R65536 is past the last address, R65535"),
    ] {
        let error = text.parse::<Tag>().unwrap_err().to_string();
        assert!(error.starts_with(&format!("`{text}` is not a tag: {rule}")), "{error}");
    }
    assert_eq!(Tag::bits(element!("R5"), 3, 0), Err(TagError::NoValues));
    assert!(matches!(Tag::bits(element!("R5"), 8, 9), Err(TagError::NoBit { bit: 16, .. })));
    assert!(matches!(Tag::bits(element!("R5"), 200, 200), Err(TagError::NoBit { bit: 255, .. })));
    assert!(matches!(Tag::bits(element!("M5"), 0, 1), Err(TagError::NoBit { bit: 0, .. })));
}

#[test]
fn bits_of_a_register_are_never_encoded() {
    let tag = tag("R5.3");
    let rule = "R5.3 is a part of R5, and a write replaces all bits of R5; modify_bits reads, changes and writes them";
    assert_eq!(tag.encode(&[TagValue::Bool(true)]).unwrap_err().to_string(), rule);
    let error = "R5.3=1".parse::<Assignment>().unwrap_err().to_string();
    assert_eq!(error, format!("`1` is not a value for R5.3: {rule}"));
    assert_eq!((tag, true).into_assignment().unwrap_err().to_string(), rule);
    let several = ("R5.0-R5.1", [true, false]).into_assignment();
    assert!(matches!(several, Err(TagAccessError::BitsOfRegister(ValueError::BitsOfRegister { .. }))));
}

proptest! {
    #[test]
    fn only_the_bits_of_the_tag_are_modified(register: u32, first in 0..32_u8, states: Vec<bool>, is_double: bool) {
        let (element, raw, width) = match is_double {
            true => (element!("DR4"), Value::DWord(register), 32),
            false => (element!("R4"), Value::Word(register as u16), 16),
        };
        let count = u8::try_from(states.len()).unwrap_or(u8::MAX);
        let Ok(tag) = Tag::bits(element, first, count) else {
            prop_assert!(count == 0 || u32::from(first) + u32::from(count) > width);
            return Ok(());
        };
        prop_assert_eq!(tag.to_string().parse(), Ok(tag));
        prop_assert_eq!(Tag::parse(&tag.to_string()), Ok(tag));
        let modified = tag.modified(raw, &states).unwrap();
        let expected: Vec<_> = states.iter().copied().map(TagValue::Bool).collect();
        prop_assert_eq!(tag.decode(&[modified]).unwrap(), expected);
        for bit in (0..width as u8).filter(|bit| !(first..first + count).contains(bit)) {
            let other = Tag::bits(element, bit, 1).unwrap();
            prop_assert_eq!(other.decode(&[modified]), other.decode(&[raw]));
        }
        prop_assert_eq!(tag.modified(raw, &[states, vec![true]].concat()), None);
    }
}

trait ConcatOne {
    fn concat_one(self) -> TagValue;
}

impl ConcatOne for Vec<TagValue> {
    fn concat_one(mut self) -> TagValue {
        assert_eq!(self.len(), 1);
        self.remove(0)
    }
}
