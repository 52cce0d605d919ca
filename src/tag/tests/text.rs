use super::*;

fn text(text: &str) -> TagValue {
    TagValue::Text(text.to_owned())
}

#[test]
fn ten_registers_are_one_text() {
    let tag = tag("R0-R9:text");
    assert_eq!((tag.element_count(), tag.value_count(), tag.elements_per_value()), (10, 1, 10));
    assert!(tag.singles().eq([tag]));
    assert_eq!(Tag::spanning(register!("R0"), TagType::Text, 10), Ok(tag));
    assert_eq!(Tag::new(register!("R0"), TagType::Text, 1).unwrap().to_string(), "R0:text");
}

#[test]
fn text_tags_display_as_they_are_parsed() {
    for (input, canonical) in [
        ("r0-9:TEXT", "R0-R9:text"),
        ("R0-R9:Text-Hi", "R0-R9:text-hi"),
        ("D7-D7:text", "D7:text"),
        ("WM0-WM32:text", "WM0-WM32:text"),
    ] {
        assert_eq!(self::tag(input).to_string(), canonical);
    }
}

#[test]
fn text_has_the_low_byte_first_and_text_hi_the_high() {
    let words = [0x4241, 0x0043, 0].map(Value::Word);
    assert_eq!(decode("R0-R2:text", &words), [text("ABC")]);
    assert_eq!(encode("R0-R2:text=ABC"), words);
    let words = [0x4142, 0x4300, 0].map(Value::Word);
    assert_eq!(decode("R0-R2:text-hi", &words), [text("ABC")]);
    assert_eq!(encode("R0-R2:text-hi=ABC"), words);
    // NULs are characters, except at the end.
    assert_eq!(decode("R0-R2:text", &[0, 0x4100, 0].map(Value::Word)), [text("\0\0\0A")]);
    assert_eq!(decode("R0:text", &[Value::Word(0)]), [text("")]);
    assert_eq!(decode("R0:text", &[Value::Word(0xFFE9)]), [text("éÿ")]);
}

#[test]
fn texts_parse_with_or_without_quotes_and_display_with() {
    for (input, value, printed) in [
        ("hello", "hello", r#""hello""#),
        (" two words ", "two words", r#""two words""#),
        (r#" " blank " "#, " blank ", r#"" blank ""#),
        (r#""a, b""#, "a, b", r#""a, b""#),
        (r#""say \"hi\\\"""#, r#"say "hi\""#, r#""say \"hi\\\"""#),
        (r#""\n\r\t\0.""#, "\n\r\t\0.", r#""\n\r\t\0.""#),
        (r#""\x1b\xA0\xe9""#, "\u{1B}\u{A0}é", r#""\x1B\xA0é""#),
        (r#""""#, "", r#""""#),
        ("0x41", "0x41", r#""0x41""#),
        ("=a'b:c=", "=a'b:c=", r#""=a'b:c=""#),
    ] {
        let assignment: Assignment = format!("R0-R9:text={input}").parse().unwrap();
        assert_eq!(assignment.values(), [text(value)], "{input}");
        assert_eq!(assignment.to_string(), format!("R0-R9:text={printed}"));
    }
}

#[test]
fn a_text_that_does_not_fit_is_refused() {
    let message = |text: &str| text.parse::<Assignment>().unwrap_err().to_string();
    let bare =
        r#"a text with a comma, a quote, a backslash or a control character needs double quotes, such as "a, b""#;
    let quotes = "a text in double quotes must end with one, and a quote within it needs a backslash before it";
    let escape = r#"a backslash must be followed by one of " \ n r t 0, or by x and two hexadecimal digits"#;
    for (input, rule) in [
        ("abcde", r#""abcde" has 5 characters, and 4 fit"#),
        ("\"abc\\0\\0\"", r#""abc\0\0" has 5 characters, and 4 fit"#),
        ("1€", r#""1€" has the character '€', which is not Latin-1"#),
        ("", "a value is missing"),
        ("a,b", bare),
        ("a\"b", bare),
        ("a\\b", bare),
        ("a\tb", bare),
        ("\"", quotes),
        ("\"ab", quotes),
        ("\"ab\\\"", quotes),
        ("\"a\"b\"", quotes),
        ("\"\\q\"", escape),
        ("\"\\x4\"", escape),
        ("\"\\xg0\"", escape),
    ] {
        let shown = input.replace('\t', r"\t");
        assert_eq!(message(&format!("R0-R1:text={input}")), format!("`{shown}` is not a value for R0-R1:text: {rule}"));
    }
    let error = tag("R0:text").encode(&[text("é€")]).unwrap_err();
    assert_eq!(error.to_string(), "\"é€\" has the character '€', which is not Latin-1");
    let error = tag("R0:text").encode(&[TagValue::U16(2)]).unwrap_err();
    assert_eq!(error.to_string(), "R0:text is text, and 2 is u16 of 16 bits");
    let error = tag("R0").encode(&[text("2")]).unwrap_err();
    assert_eq!(error.to_string(), "R0 is u16 of 16 bits, and \"2\" is text");
}

#[test]
fn a_text_is_at_most_as_long_as_one_request() {
    let message = |text: &str| text.parse::<Tag>().unwrap_err().to_string();
    assert_eq!(tag("R0-R63:text").element_count(), 64);
    for (input, rule) in [
        ("R0-R64:text", "a text comes from one request, which holds 64 registers, and the range has 65"),
        ("DR0-DR8:text", "DR is a 32-bit register, which has no type text (it has: u32 i32 f32 u64 i64 f64 bcd32 hex)"),
        ("M0-M15:text-hi", "M is a discrete, which has no type text-hi (it has: bool)"),
        ("R0:text-ho", "a scale is *GAIN, +OFFSET, -OFFSET or both in this order, such as *0.1-40"),
    ] {
        assert_eq!(message(input), format!("`{input}` is not a tag: {rule}"));
    }
    let error = Tag::new(register!("R0"), TagType::Text, 2).unwrap_err();
    assert_eq!(error.to_string(), "a tag has one text, as long as its range, not several from R0 on");
    assert_eq!(Tag::spanning(register!("R0"), TagType::TextHi, 0), Err(TagError::NoValues));
}

proptest! {
    #[test]
    fn every_text_that_fits_round_trips(characters in prop::collection::vec(any::<u8>(), 0..=8), high: bool) {
        let value: String = characters.iter().copied().map(char::from).collect();
        let tag = tag(if high { "R0-R3:text-hi" } else { "R0-R3:text" });
        let assignment = Assignment::new(tag, [TagValue::Text(value.clone())]).unwrap();
        prop_assert_eq!(assignment.to_string().parse(), Ok(assignment.clone()));
        prop_assert!(assignment.to_string().chars().all(|c| !c.is_control()));
        prop_assert_eq!(tag.decode(&assignment.encode()).unwrap(), [text(value.trim_end_matches('\0'))]);
    }

    #[test]
    fn no_text_panics_and_a_displayed_text_parses_to_the_same(value in "\\PC{0,9}|[\"\\\\,\u{0}-\u{20}a-c]{0,9}") {
        let printed = text(&value).to_string();
        let bytes = value.chars().all(|c| u32::from(c) < 256) && value.chars().count() <= 128;
        match tag("R0-R63:text").parse_values(&printed) {
            Ok(values) => prop_assert_eq!(values, [text(&value)]),
            Err(error) => prop_assert!(!bytes, "{}", error),
        }
    }
}
