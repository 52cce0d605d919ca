use proptest::prelude::*;

mod bits;
mod constants;
mod scaled;
mod text;

use super::*;
use crate::command::Value;
use crate::element::{Symbol, Width};
use crate::{discrete, element, register, register32};

#[test]
fn a_tag_without_a_type_has_the_default_of_its_width() {
    for (text, tag_type) in [("M100", TagType::Bool), ("WM8", TagType::U16), ("DR2", TagType::U32)] {
        let tag = tag(text);
        assert_eq!((tag.tag_type(), tag.element_count(), tag.value_count()), (tag_type, 1, 1));
        assert_eq!(tag, Tag::from(tag.first()));
        assert_eq!(tag.to_string(), text);
    }
}

#[test]
fn tags_display_in_canonical_form() {
    for (input, canonical) in [
        ("r00100:F32", "R100:f32"),
        ("R0-R9", "R0-R9"),
        ("R0-9", "R0-R9"),
        ("r0-r9:U16", "R0-R9"),
        ("R7-R7", "R7"),
        ("R0-R1:f32", "R0:f32"),
        ("R0-R1:u16", "R0-R1"),
        ("x0-x7:bool", "X0-X7"),
        ("DR0-DR8", "DR0-DR8"),
        ("DR2:I32", "DR2:i32"),
        ("DR2:u32", "DR2"),
        ("WM0-32:hex", "WM0-WM32:hex"),
    ] {
        assert_eq!(tag(input).to_string(), canonical, "{input}");
    }
}

#[test]
fn a_range_includes_both_ends_in_the_manuals_steps() {
    let elements = |text| tag(text).elements().map(|e| e.to_string()).collect::<Vec<_>>();
    assert_eq!(elements("WM0-WM32"), ["WM0", "WM16", "WM32"]);
    assert_eq!(elements("DR1-DR5"), ["DR1", "DR3", "DR5"]);
    assert_eq!(elements("R0-R3:f32"), ["R0", "R1", "R2", "R3"]);
    assert_eq!(elements("DWM0-DWM32"), ["DWM0", "DWM32"]);
    assert_eq!(tag("R0-R65535").element_count(), 65536);
    assert_eq!(tag("M0-M9999").element_count(), 10_000);
}

#[test]
fn ten_registers_are_five_floats() {
    let tag = tag("R0-R9:f32");
    assert_eq!((tag.element_count(), tag.value_count(), tag.elements_per_value()), (10, 5, 2));
    let singles: Vec<_> = tag.singles().map(|tag| tag.to_string()).collect();
    assert_eq!(singles, ["R0:f32", "R2:f32", "R4:f32", "R6:f32", "R8:f32"]);
    assert_eq!(Tag::new(register!("R0"), TagType::F32, 5), Ok(tag));
}

#[test]
fn values_of_32_bits_have_the_low_word_first() {
    // 10,000,000, and the float of the manual's example.
    assert_eq!(decode("R100:u32", &[Value::Word(0x9680), Value::Word(0x0098)]), [TagValue::U32(10_000_000)]);
    assert_eq!(decode("DR100", &[Value::DWord(0x0098_9680)]), [TagValue::U32(10_000_000)]);
    assert_eq!(decode("R2:f32", &[Value::Word(0x1000), Value::Word(0xC3FA)]), [TagValue::F32(-500.125)]);
    assert_eq!(decode("DR2:f32", &[Value::DWord(0xC3FA_1000)]), [TagValue::F32(-500.125)]);
    assert_eq!(encode("R2:f32=-500.125"), [Value::Word(0x1000), Value::Word(0xC3FA)]);
    assert_eq!(encode("R0-R3:i32=-2,3"), [0xFFFE, 0xFFFF, 3, 0].map(Value::Word));
}

#[test]
fn values_are_decoded_by_type() {
    let word = [Value::Word(0xFFFE)];
    assert_eq!(decode("R0", &word), [TagValue::U16(65534)]);
    assert_eq!(decode("R0:i16", &word), [TagValue::I16(-2)]);
    assert_eq!(decode("R0:hex", &word), [TagValue::Hex16(0xFFFE)]);
    assert_eq!(decode("DR0:hex", &[Value::DWord(0xFE)]), [TagValue::Hex32(0xFE)]);
    assert_eq!(decode("DR0:i32", &[Value::DWord(u32::MAX)]), [TagValue::I32(-1)]);
    assert_eq!(decode("X0-X1", &[Value::Bit(true), Value::Bit(false)]), [TagValue::Bool(true), TagValue::Bool(false)]);
}

#[test]
fn values_are_parsed_in_all_their_forms() {
    for (text, value) in [
        ("M0=on", TagValue::Bool(true)),
        ("M0=OFF", TagValue::Bool(false)),
        ("M0=True", TagValue::Bool(true)),
        ("M0=0", TagValue::Bool(false)),
        ("M0=0x1", TagValue::Bool(true)),
        ("R0= +5 ", TagValue::U16(5)),
        ("R0=65535", TagValue::U16(65535)),
        ("R0=0xbeef", TagValue::U16(0xBEEF)),
        ("R0:i16=-32768", TagValue::I16(-32768)),
        ("R0:i16=0xFFFF", TagValue::I16(-1)),
        ("R0:u32=4294967295", TagValue::U32(u32::MAX)),
        ("DR0:i32=-2147483648", TagValue::I32(i32::MIN)),
        ("R0:f32=1", TagValue::F32(1.0)),
        ("R0:f32=-1.5e3", TagValue::F32(-1500.0)),
        ("R0:f32=0x3F800000", TagValue::F32(1.0)),
        ("R0:f32=-inf", TagValue::F32(f32::NEG_INFINITY)),
        ("R0:hex=0xff", TagValue::Hex16(0xFF)),
        ("DR0:hex=0X00FF", TagValue::Hex32(0xFF)),
    ] {
        assert_eq!(assignment(text).values(), [value], "{text}");
    }
    assert!(matches!(assignment("R0:f32=NaN").values(), [TagValue::F32(value)] if value.is_nan()));
    assert_eq!(assignment("R0-R2=1,2, 3").values(), [1, 2, 3].map(TagValue::U16));
}

#[test]
fn values_display_as_they_are_parsed() {
    for (text, printed) in [
        ("M0=on", "M0=1"),
        ("r0:f32=0.1", "R0:f32=0.1"),
        ("R0:f32=1e20", "R0:f32=1e20"),
        ("R0:f32=16777216", "R0:f32=16777216.0"),
        ("R0:f32=nan", "R0:f32=NaN"),
        ("R0:f32=-0", "R0:f32=-0.0"),
        ("R0:hex=0xff", "R0:hex=0x00FF"),
        ("DR0:hex=0xff", "DR0:hex=0x000000FF"),
        ("R0-R1:i16=-1,+1", "R0-R1:i16=-1,1"),
    ] {
        assert_eq!(assignment(text).to_string(), printed);
    }
}

#[test]
fn errors_of_tags_name_the_input_and_the_rule() {
    let message = |text: &str| text.parse::<Tag>().unwrap_err().to_string();
    for (input, rule) in [
        ("R0-R8:f32", "a value of f32 takes 2 elements, and the range has 9"),
        ("R0-R0:u32", "a value of u32 takes 2 elements, and the range has 1"),
        (
            "R0:f16",
            "the type is unknown (known: bool u16 i16 u32 i32 f32 u64 i64 f64 bcd16 bcd32 hex text text-hi bcd32-hi u32-hi i32-hi f32-hi u64-hi i64-hi f64-hi)",
        ),
        (
            "R0:",
            "the type is unknown (known: bool u16 i16 u32 i32 f32 u64 i64 f64 bcd16 bcd32 hex text text-hi bcd32-hi u32-hi i32-hi f32-hi u64-hi i64-hi f64-hi)",
        ),
        (
            "R0:bool",
            "R is a 16-bit register, which has no type bool (it has: u16 i16 u32 i32 f32 u64 i64 f64 bcd16 bcd32 hex text text-hi bcd32-hi u32-hi i32-hi f32-hi u64-hi i64-hi \
             f64-hi)",
        ),
        ("DR0:i16", "DR is a 32-bit register, which has no type i16 (it has: u32 i32 f32 u64 i64 f64 bcd32 hex)"),
        ("M0-M7:hex", "M is a discrete, which has no type hex (it has: bool)"),
        ("R0-D9", "a range has elements of one symbol, and this one is from R to D"),
        ("R9-R0", "the range goes backwards, from R9 to R0"),
        ("WM0-WM8", "WM8 does not follow WM0, because WM is counted in steps of 16"),
        ("DR0-DR3", "DR3 does not follow DR0, because DR is counted in steps of 2"),
        ("R0-R65536", "R65536 is past the last address, R65535"),
        ("R0-65536", "R65536 is past the last address, R65535"),
        ("RC190-RC210", "RC210 does not exist: DRC200 to DRC255 are counters of 32 bits, with one address each"),
        (
            "DRC198-DRC200",
            "DRC200 does not follow DRC198: DRC200 to DRC255 are counters of 32 bits, with one address each",
        ),
        ("RC199-RC256", "RC256 does not follow RC199: DRC200 to DRC255 are counters of 32 bits, with one address each"),
        ("RC199:f32", "2 elements from RC199 on reach past the last address, RC199"),
        ("R65535:f32", "2 elements from R65535 on reach past the last address, R65535"),
        ("WM0-4", "WM4: the address of WM must be a multiple of 8"),
        ("R0-", "R needs a decimal address, such as R0"),
        ("R0*0.1", "a gain or offset needs a type before it, such as in R5:u16*0.1"),
        ("R0-R9+5:u16", "a gain or offset needs a type before it, such as in R5:u16*0.1"),
        // Before, the largest number of 32 bits was named.
        ("R18446744073709551616", "the address of R is past the last address, R65535"),
        ("R0-R1-R2", "the address of R must be decimal digits and nothing else"),
        (
            " R0",
            "no element has these letters (known: X Y M S T C WX WY WM WS WT WC RT RC R D F \
             DWX DWY DWM DWS DWT DWC DRT DRC DR DD DF)",
        ),
    ] {
        assert_eq!(message(input), format!("`{input}` is not a tag: {rule}"));
    }
    assert_eq!(Tag::new(register!("R0"), TagType::U16, 0), Err(TagError::NoValues));
    assert!(matches!(Tag::new(register!("R0"), TagType::F32, usize::MAX), Err(TagError::PastTheEnd { .. })));
    assert!(matches!(Tag::new(discrete!("X0"), TagType::U16, 1), Err(TagError::WrongType { .. })));
}

#[test]
fn errors_of_values_name_the_input_and_the_rule() {
    let message = |text: &str| text.parse::<Assignment>().unwrap_err().to_string();
    for (text, input, tag, rule) in [
        ("R0=65536", "65536", "R0", "out of range: u16 takes 0 to 65535"),
        ("R0=-1", "-1", "R0", "out of range: u16 takes 0 to 65535"),
        ("R0=99999999999999999999", "99999999999999999999", "R0", "out of range: u16 takes 0 to 65535"),
        ("R0:i16=40000", "40000", "R0:i16", "out of range: i16 takes -32768 to 32767"),
        ("R0=1.5", "1.5", "R0", "u16 takes 0 to 65535"),
        ("R0=", "", "R0", "a value is missing"),
        ("R0-R2=1,,3", "", "R0-R2", "a value is missing"),
        ("R0-R2=1,2", "1,2", "R0-R2", "the number of values is 2, and R0-R2 takes 3"),
        ("R0=1,2", "1,2", "R0", "the number of values is 2, and R0 takes 1"),
        ("M0=2", "2", "M0", "bool takes 0 or 1, false or true, off or on"),
        ("M0=0x2", "0x2", "M0", "bool takes 0 or 1, false or true, off or on"),
        ("R0=0x10000", "0x10000", "R0", "0x must be followed by 1 to 4 hexadecimal digits"),
        ("R0=0x", "0x", "R0", "0x must be followed by 1 to 4 hexadecimal digits"),
        ("R0=0x+1", "0x+1", "R0", "0x must be followed by 1 to 4 hexadecimal digits"),
        ("R0:hex=10", "10", "R0:hex", "a hexadecimal value begins with 0x, such as 0x00FF"),
        ("R0:f32=0x10", "0x10", "R0:f32", "as the bits of f32, 0x must be followed by all 8 digits"),
        ("R0:f32=1e39", "1e39", "R0:f32", "out of range: f32 takes -3.4028235e38 to 3.4028235e38, nan and inf"),
        ("R0:f32=1,5", "1,5", "R0:f32", "the number of values is 2, and R0:f32 takes 1"),
    ] {
        assert_eq!(message(text), format!("`{input}` is not a value for {tag}: {rule}"), "{text}");
    }
    assert_eq!(message("R0"), "`R0` is not an assignment: it must be TAG=VALUE, such as R5=7");
    assert_eq!(message("Q0=1").split(':').next(), Some("`Q0` is not a tag"));
}

#[test]
fn values_of_another_width_or_type_are_refused() {
    let pair = tag("R0-R1");
    let message = |result: Result<Vec<TagValue>, ValueError>| result.unwrap_err().to_string();
    assert_eq!(message(pair.decode(&[Value::Word(1)])), "the number of values is 1, and R0-R1 takes 2");
    let wide = [Value::Word(1), Value::DWord(7)];
    assert_eq!(message(pair.decode(&wide)), "R0 is a 16-bit register, not a 32-bit register");
    let message = |result: Result<Vec<Value>, ValueError>| result.unwrap_err().to_string();
    assert_eq!(message(pair.encode(&[])), "the number of values is 0, and R0-R1 takes 2");
    let signed = [TagValue::U16(1), TagValue::I16(2)];
    assert_eq!(message(pair.encode(&signed)), "R0-R1 is u16 of 16 bits, and 2 is i16 of 16 bits");
    let wide = [TagValue::Hex32(1)];
    assert_eq!(message(tag("R0:hex").encode(&wide)), "R0:hex is hex of 16 bits, and 0x00000001 is hex of 32 bits");
    assert!(Assignment::new(pair, signed).is_err());
    assert_eq!(Assignment::new(pair, [1, 2].map(TagValue::U16)).unwrap().to_string(), "R0-R1=1,2");
}

#[test]
fn tags_can_be_made_from_elements() {
    assert_eq!(Tag::from(element!("DWM0")).to_string(), "DWM0");
    assert_eq!(Tag::new(register32!("DR0"), TagType::F32, 2).unwrap().to_string(), "DR0-DR2:f32");
    assert_eq!(Tag::new(discrete!("Y0"), TagType::Bool, 3).unwrap().to_string(), "Y0-Y2");
}

fn tag(text: &str) -> Tag {
    text.parse().unwrap()
}

fn assignment(text: &str) -> Assignment {
    text.parse().unwrap()
}

fn decode(text: &str, raw: &[Value]) -> Vec<TagValue> {
    tag(text).decode(raw).unwrap()
}

fn encode(text: &str) -> Vec<Value> {
    assignment(text).encode()
}

/// Any tag of at most eight values, scaled or not, or of a text of any length.
fn tags() -> impl Strategy<Value = Tag> {
    let types = prop::sample::select(TagType::ALL);
    let tags =
        (prop::sample::select(Symbol::ALL), any::<u16>(), types, 1..=64_usize, prop::option::of(scaled::scales()));
    tags.prop_filter_map("no such tag", |(symbol, address, tag_type, count, scale)| {
        let address = address.min(symbol.last_address()) / symbol.alignment() * symbol.alignment();
        let first = Element::new(symbol, address).ok()?;
        let tag = match tag_type.is_text() {
            true => Tag::spanning(first, tag_type, count).ok()?,
            false => Tag::new(first, tag_type, count.div_ceil(8)).ok()?,
        };
        Some(scale.and_then(|scale| tag.scaled(scale).ok()).unwrap_or(tag))
    })
}

fn raw(tag: Tag) -> impl Strategy<Value = Vec<Value>> {
    prop::collection::vec(any::<u32>(), tag.element_count()).prop_map(move |bits| {
        let value = |bits: u32| match tag.first().width() {
            Width::Bit => Value::Bit(bits & 1 == 1),
            Width::Word => Value::Word(bits as u16),
            Width::DWord => Value::DWord(bits),
        };
        bits.into_iter().map(value).collect()
    })
}

proptest! {
    #[test]
    fn every_tag_round_trips(tag in tags()) {
        prop_assert_eq!(tag.to_string().parse(), Ok(tag));
        prop_assert_eq!(tag.elements().count(), tag.element_count());
        prop_assert_eq!(tag.singles().count(), tag.value_count());
        prop_assert!(tag.singles().flat_map(|single| single.elements()).eq(tag.elements()));
    }

    #[test]
    fn every_raw_value_round_trips((tag, raw) in tags().prop_flat_map(|tag| (Just(tag), raw(tag)))) {
        let values = tag.decode(&raw).unwrap();
        // Scaled floats lose digits beside the offset, and NaNs their payload: see `scaled`.
        prop_assume!(!(tag.scale().is_some() && matches!(tag.tag_type(), TagType::F32 | TagType::F32Hi)));
        prop_assert_eq!(tag.encode(&values).unwrap(), raw);
    }

    #[test]
    fn every_assignment_round_trips((tag, raw) in tags().prop_flat_map(|tag| (Just(tag), raw(tag)))) {
        let values = tag.decode(&raw).unwrap();
        // The payload of a NaN is not displayed.
        prop_assume!(!values.iter().any(|value| value.as_f64().is_some_and(f64::is_nan)));
        let assignment = Assignment::new(tag, values).unwrap();
        prop_assert_eq!(assignment.to_string().parse(), Ok(assignment));
    }

    #[test]
    fn no_text_panics_and_every_accepted_text_round_trips(
        text in prop_oneof![
            "\\PC{0,16}",
            concat!(
                "[RDWMrx]{1,3}[0-9]{1,5}(-[RDM]{0,3}[0-9]{0,5})?",
                "(:([a-z0-9]{0,4}|text(-hi)?|[uif](16|32)[-*+.0-9e]{0,9}))?",
                "(=([-+0-9a-fxX.,]{0,12}|\"?[a-c\\\\\",xnrt0 \u{e9}\u{20ac}]{0,8}\"?))?",
            ),
        ]
    ) {
        if let Ok(tag) = text.parse::<Tag>() {
            prop_assert_eq!(tag.to_string().parse::<Tag>(), Ok(tag));
        }
        if let Ok(assignment) = text.parse::<Assignment>() {
            let printed = assignment.to_string();
            prop_assert_eq!(printed.parse::<Assignment>().unwrap().to_string(), printed);
        }
    }
}

#[test]
fn values_of_64_bits_and_the_high_word_first() {
    let words = |words: &[u16]| words.iter().map(|&word| Value::Word(word)).collect::<Vec<_>>();
    for (text, raw, value) in [
        ("R0:u64", words(&[0xDEF0, 0x9ABC, 0x5678, 0x1234]), TagValue::U64(0x1234_5678_9ABC_DEF0)),
        ("R0:u64-hi", words(&[0x1234, 0x5678, 0x9ABC, 0xDEF0]), TagValue::U64(0x1234_5678_9ABC_DEF0)),
        ("R0:i64", words(&[0xFFFE, 0xFFFF, 0xFFFF, 0xFFFF]), TagValue::I64(-2)),
        ("R0:i64-hi", words(&[0xFFFF, 0xFFFF, 0xFFFF, 0xFFFE]), TagValue::I64(-2)),
        ("R0:f64", words(&[0, 0, 0, 0x4004]), TagValue::F64(2.5)),
        ("R0:f64-hi", words(&[0x4004, 0, 0, 0]), TagValue::F64(2.5)),
        ("R0:f32-hi", words(&[0xC3FA, 0x1000]), TagValue::F32(-500.125)),
        ("R0:u32-hi", words(&[0x0001, 0x0002]), TagValue::U32(0x0001_0002)),
        ("R0:i32-hi", words(&[0xFFFF, 0xFFFE]), TagValue::I32(-2)),
        ("DR0:u64", vec![Value::DWord(0x9ABC_DEF0), Value::DWord(0x1234_5678)], TagValue::U64(0x1234_5678_9ABC_DEF0)),
        ("DR0:f64", vec![Value::DWord(0), Value::DWord(0x4004_0000)], TagValue::F64(2.5)),
    ] {
        let tag = tag(text);
        assert_eq!((tag.to_string().as_str(), tag.value_count()), (text, 1));
        assert_eq!(tag.decode(&raw), Ok(vec![value.clone()]), "{text}");
        assert_eq!(tag.encode(&[value]).as_ref(), Ok(&raw), "{text}");
    }
    assert_eq!(tag("R0-R7:i64").value_count(), 2);
    assert_eq!(tag("DR0-DR6:f64").to_string(), "DR0-DR6:f64");
    for (text, reason) in [
        ("R0-R6:i64", "a value of i64 takes 4 elements, and the range has 7"),
        ("DR0:f32-hi", "has no type f32-hi"),
        ("DRC200:u64", "DRC is a counter of 32 bits here, which has no type u64 (it has: u32 i32 f32 bcd32 hex)"),
        ("R0:i64*2", "i64 takes neither gain nor offset"),
    ] {
        let error = text.parse::<Tag>().unwrap_err().to_string();
        assert!(error.contains(reason), "{error}");
    }
}

#[test]
fn numbers_of_64_bits_are_exact() {
    for (text, value) in [
        ("R0:u64=18446744073709551615", TagValue::U64(u64::MAX)),
        ("R0:i64=-9223372036854775808", TagValue::I64(i64::MIN)),
        ("R0:u64=9007199254740993", TagValue::U64((1 << 53) + 1)),
        ("R0:u64=0xFFFFFFFFFFFFFFFF", TagValue::U64(u64::MAX)),
        ("R0:f64=0.1", TagValue::F64(0.1)),
    ] {
        let assignment: Assignment = text.parse().unwrap();
        assert_eq!(assignment.values(), std::slice::from_ref(&value));
        assert_eq!(assignment.tag().decode(&assignment.encode()), Ok(vec![value]));
    }
    for text in ["R0:u64=18446744073709551616", "R0:i64=9223372036854775808", "R0:u64=-1", "R0:f64=1e309"] {
        let error = text.parse::<Assignment>().unwrap_err().to_string();
        assert!(error.contains("out of range"), "{error}");
    }
}

#[test]
fn names_of_other_systems_are_accepted_for_types() {
    for (text, canonical) in [
        ("R0:float", "R0:f32"),
        ("R0:REAL*0.5+1", "R0:f32*0.5+1"),
        ("R0:Double", "R0:f64"),
        ("R0:int", "R0:i16"),
        ("R0:int16-40", "R0:i16-40"),
        ("R0:dint", "R0:i32"),
        ("R0:LINT", "R0:i64"),
        ("R0:word", "R0"),
        ("DR0:dword", "DR0"),
        ("M0:bit", "M0"),
        ("R0-R4:string", "R0-R4:text"),
        ("R0:real-hi-40", "R0:f32-hi-40"),
        ("R0:F32-HI*2", "R0:f32-hi*2"),
        ("R0:dint-hi", "R0:i32-hi"),
        ("R0:qword", "R0:u64"),
        ("R0:lword-hi", "R0:u64-hi"),
    ] {
        assert_eq!(tag(text).to_string(), canonical, "{text}");
    }
    for text in ["R0:", "R0: ", "R0:uint16 uint", "R0:f32-", "R0:f32-h", "R0:-hi", "R0:hi"] {
        assert!(text.parse::<Tag>().is_err(), "{text}");
    }
    // No name stands for two types.
    let mut names: Vec<String> = Vec::new();
    for tag_type in TagType::ALL {
        names.push(tag_type.to_string());
        assert_eq!(tag_type.to_string().parse(), Ok(*tag_type));
        for alias in tag_type.aliases().split_whitespace() {
            names.push(alias.to_owned());
            assert_eq!(alias.parse(), Ok(*tag_type));
        }
    }
    let all = names.len();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), all);
}

#[test]
fn decimal_digits_are_a_number_or_none() {
    for (text, raw, shown) in [
        ("R0:bcd16", &[0x1234][..], "1234"),
        ("R0:bcd16", &[0], "0"),
        ("R0:bcd16", &[0x0007], "7"),
        ("R0:bcd16", &[0x1A00], "0x1A00"),
        ("R0:bcd32", &[0x5678, 0x1234], "12345678"),
        ("R0:bcd32-hi", &[0x1234, 0x5678], "12345678"),
        ("R0:bcd32", &[0x5678, 0xF234], "0xF2345678"),
    ] {
        let raw: Vec<Value> = raw.iter().map(|&word| Value::Word(word)).collect();
        let tag = tag(text);
        let values = tag.decode(&raw).unwrap();
        assert_eq!(values[0].to_string(), shown);
        assert_eq!(values[0].as_f64().is_some(), !shown.starts_with("0x"));
        assert_eq!(tag.encode(&values).as_ref(), Ok(&raw), "{text}");
        let parsed = format!("{text}={shown}").parse::<Assignment>().unwrap();
        assert_eq!(parsed.encode(), raw);
    }
    for text in ["R0:bcd16=10000", "R0:bcd32=100000000", "R0:bcd16=-1"] {
        let error = text.parse::<Assignment>().unwrap_err().to_string();
        assert!(error.contains("out of range: bcd") && error.contains("takes 0 to 9999"), "{error}");
    }
    let all = (0..10_000_u32).map(|n| u16::from_str_radix(&n.to_string(), 16).unwrap());
    for (n, digits) in (0_u16..).zip(all) {
        assert_eq!(u16::try_from(TagValue::Bcd16(digits)), Ok(n));
    }
}
