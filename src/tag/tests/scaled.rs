use super::*;

/// Gains and offsets as people choose them, and others.
pub(super) fn scales() -> impl Strategy<Value = Scale> {
    let decimal = |most: i32| (-most..=most, 0..=6_i32).prop_map(|(n, e)| format!("{n}e-{e}").parse::<f64>().unwrap());
    let gain = prop_oneof![decimal(9999), Just(1.0), -1e200..1e200_f64, -1e-9..1e-9_f64, prop::num::f64::NORMAL];
    let offset = prop_oneof![Just(0.0), decimal(100_000), -1e9..1e9_f64, prop::num::f64::NORMAL];
    (gain, offset).prop_filter_map("no such scale", |(gain, offset)| Scale::new(gain, offset).ok())
}

fn scale(text: &str) -> Scale {
    text.parse().unwrap()
}

#[test]
fn scaled_tags_print_as_they_are_parsed() {
    for (input, canonical) in [
        ("R5:i16*0.1", "R5:i16*0.1"),
        ("r5:I16*0.10-40.0", "R5:i16*0.1-40"),
        ("R0-R9:u16*0.01+5", "R0-R9:u16*0.01+5"),
        ("R5:u16+3", "R5:u16+3"),
        ("R5:u16*1+3", "R5:u16+3"),
        ("R5:u16-0.5", "R5:u16-0.5"),
        ("R5:u16*1", "R5:u16*1"),
        ("R5:u16*2-0", "R5:u16*2"),
        ("R5:u16-0", "R5:u16*1"),
        ("R0-3:f32*-2.5E-3-1e3", "R0-R3:f32*-0.0025-1000"),
        ("DR0:u32*1e-9", "DR0:u32*1e-9"),
        ("DR0:u32*1E+20+.5", "DR0:u32*1e20+0.5"),
    ] {
        assert_eq!(tag(input).to_string(), canonical, "{input}");
        assert_eq!(tag(canonical), tag(input));
    }
    assert_eq!(tag("R5:u16-0"), tag("R5:u16*1+0"));
    assert_ne!(tag("R5:u16*1"), tag("R5"));
    assert!(tag("R5:u16*-2") < tag("R5:u16*0.5") && tag("R5:u16*0.5") < tag("R5:u16*0.5+1"));
}

#[test]
fn a_scaled_value_has_the_digits_of_gain_and_offset() {
    for (text, raw, printed) in [
        ("R0:u16*0.1", 123, "12.3"),
        ("R0:u16*0.1", 3, "0.3"),
        ("R0:i16*0.1", 0xFFFF, "-0.1"),
        ("R0:i16*0.1-40", 0, "-40.0"),
        ("R0:i16*0.1-40", 403, "0.3"),
        ("R0:u16*0.01+5", 7, "5.07"),
        ("R0:u16*-0.1", 0, "0.0"),
        ("R0:u16*0.0001", 65535, "6.5535"),
        ("R0:u16+3", 4, "7.0"),
        ("R0:u16*1e20", 3, "3e20"),
        ("R0:u16*1e-20", 3, "3e-20"),
    ] {
        assert_eq!(decode(text, &[Value::Word(raw)])[0].to_string(), printed, "{text} {raw}");
    }
    // A float is the decimal that it prints as.
    let float = |text: &str, value: f32| decode(text, &[Value::DWord(value.to_bits())])[0].to_string();
    assert_eq!(float("DR0:f32*0.1", 12.3), "1.23");
    assert_eq!(float("DR0:f32*0.1-40", 12.3), "-38.77");
    assert_eq!(float("DR0:f32*0.1", -0.0), "-0.0");
    assert_eq!(float("DR0:f32*0.1", f32::NAN), "NaN");
    assert_eq!(float("DR0:f32*-0.1+7", f32::INFINITY), "-inf");
}

#[test]
fn a_scaled_value_is_written_as_the_nearest_raw_number() {
    for (text, raw) in [
        ("R0:u16*0.1=12.3", 123),
        ("R0:u16*0.1= +12.34 ", 123),
        ("R0:u16*0.1=1.236e1", 124),
        ("R0:i16*0.1-40=-40.1", 0xFFFF),
        ("R0:u16*-2=-6", 3),
        ("R0:u16*-2=0", 0),
        ("R0:u16*0.1=6553.54", 65535),
        ("R0:u16*0.1=-0.04", 0),
    ] {
        assert_eq!(encode(text), [Value::Word(raw)], "{text}");
    }
    assert_eq!(encode("R0-R3:u32*0.5=1,1e9"), [2, 0, 0x9400, 0x7735].map(Value::Word));
    assert_eq!(encode("DR0:f32*0.1=1.23"), [Value::DWord(12.3_f32.to_bits())]);
    assert_eq!(encode("DR0:f32*-0.1=inf"), [Value::DWord(f32::NEG_INFINITY.to_bits())]);
    assert!(matches!(encode("DR0:f32*0.1=nan")[..], [Value::DWord(bits)] if f32::from_bits(bits).is_nan()));
}

#[test]
fn a_scaled_value_that_no_raw_number_has_is_refused() {
    let message = |text: &str| text.parse::<Assignment>().unwrap_err().to_string();
    for (text, rule) in [
        ("R0:u16*0.1=6553.55", "6553.55 comes from the raw number 65535.5, which does not fit: u16 takes 0 to 65535"),
        ("R0:u16*0.1=-0.05", "-0.05 comes from the raw number -0.5, which does not fit: u16 takes 0 to 65535"),
        (
            "R0:i16+3=-32766",
            "-32766.0 comes from the raw number -32769.0, which does not fit: i16 takes -32768 to 32767",
        ),
        (
            "DR0:i32+0.5=2147483648.0",
            "2147483648.0 comes from the raw number 2147483647.5, which does not fit: i32 takes -2147483648 to 2147483647",
        ),
        ("R0:u16*2=nan", "NaN comes from the raw number NaN, which does not fit: u16 takes 0 to 65535"),
        ("R0:u16*2=-inf", "-inf comes from the raw number -inf, which does not fit: u16 takes 0 to 65535"),
        (
            "DR0:f32*0.1=1e38",
            "1e38 comes from the raw number 1e39, which does not fit: f32 takes -3.4028235e38 to 3.4028235e38, nan and inf",
        ),
        (
            "DR0:f32*1e-200=1e200",
            "1e200 comes from the raw number inf, which does not fit: f32 takes -3.4028235e38 to 3.4028235e38, nan and inf",
        ),
        ("R0:u16*2=0x10", "a scaled value is a decimal number, such as 12.3 or -1e3"),
        ("R0:f32*2=1e999", "a scaled value is a decimal number, such as 12.3 or -1e3"),
        ("R0:u16*2=", "a value is missing"),
    ] {
        let (tag, input) = text.split_once('=').unwrap();
        assert_eq!(message(text), format!("`{input}` is not a value for {tag}: {rule}"));
    }
    let error = tag("R0:u16*2").encode(&[TagValue::U16(2)]).unwrap_err();
    assert_eq!(error.to_string(), "R0:u16*2 is scaled, and 2 is u16 of 16 bits");
    let error = tag("R0").encode(&[TagValue::Scaled(2.0)]).unwrap_err();
    assert_eq!(error.to_string(), "R0 is u16 of 16 bits, and 2.0 is scaled");
}

#[test]
fn what_is_no_scale_is_refused() {
    let message = |text: &str| text.parse::<Tag>().unwrap_err().to_string();
    for (scale, rule) in [
        ("*0", "the gain is 0.0, and it must be from 1e-200 to 1e200, or the same below 0"),
        ("*-0+1", "the gain is -0.0, and it must be from 1e-200 to 1e200, or the same below 0"),
        ("*1e999", "the gain is inf, and it must be from 1e-200 to 1e200, or the same below 0"),
        ("*1e-201", "the gain is 1e-201, and it must be from 1e-200 to 1e200, or the same below 0"),
        ("+1e999", "the offset is inf, and it must be a number"),
        (
            "*0.1+1e14",
            "the offset 100000000000000.0 is more than 2.8e14 times the gain 0.1, so values could not be told apart",
        ),
    ] {
        assert_eq!(message(&format!("R0:u16{scale}")), format!("`R0:u16{scale}` is not a tag: {rule}"));
    }
    for scale in [
        "*", "+", "-", "*x", "*nan", "+inf", "*1*2", "+1*2", "*+1", "+-1", "*1e", "*.", "*1 ", "*0x1", "-40x", "*1+2+3",
    ] {
        let rule = "it must be *GAIN, +OFFSET, -OFFSET or both in this order, such as *0.1-40";
        let expected = format!("`R0:u16{scale}` is not a tag: `{scale}` is not a scale: {rule}");
        assert_eq!(message(&format!("R0:u16{scale}")), expected);
    }
    for (tag, name) in [("M0:bool*2", "bool"), ("R0:hex*2", "hex"), ("R0:text*2", "text")] {
        let rule = format!("{name} takes neither gain nor offset (those that do: u16 i16 u32 i32 f32)");
        assert_eq!(message(tag), format!("`{tag}` is not a tag: {rule}"));
    }
    assert!(matches!(Scale::new(f64::NAN, 0.0), Err(ScaleError::Gain { .. })));
    assert!(matches!(Scale::new(1.0, f64::NAN), Err(ScaleError::Offset { .. })));
    assert_eq!(Scale::new(2.0, -0.0), Ok(scale("*2")));
}

/// What a raw number is after it has been read, printed, parsed and written; and the value that was printed.
fn there_and_back(tag: Tag, raw: Value) -> (Value, f64) {
    let values = tag.decode(&[raw]).unwrap();
    let text = Assignment::new(tag, values.clone()).unwrap().to_string();
    (text.parse::<Assignment>().unwrap().encode()[0], values[0].as_f64().unwrap())
}

proptest! {
    #[test]
    fn every_scale_round_trips(scale in scales()) {
        prop_assert_eq!(scale.to_string().parse(), Ok(scale));
    }

    #[test]
    fn an_integer_that_is_printed_and_written_back_is_the_same(scale in scales(), bits: u32, near in 0..9_u32) {
        // Also near the ends of the ranges, where values are the least exact.
        for bits in [bits, near, u32::MAX - near, 0x7FFF_FFFF - near, 0x8000_0000 + near] {
            for text in ["DR0", "DR0:i32"] {
                let raw = Value::DWord(bits);
                prop_assert_eq!(there_and_back(tag(text).scaled(scale).unwrap(), raw).0, raw);
            }
            for text in ["R0", "R0:i16"] {
                let raw = Value::Word(low(bits));
                prop_assert_eq!(there_and_back(tag(text).scaled(scale).unwrap(), raw).0, raw);
            }
        }
    }

    #[test]
    fn decimal_scales_give_decimals(raw in -100_000_000..100_000_000_i32, gain in 1..10_000_i64, gain_decimals in 0..5_u32, offset in -9999..10_000_i64) {
        let scale = format!("*{gain}e-{gain_decimals}{offset:+}e-2").parse().unwrap();
        let value = decode(&tag("DR0:i32").scaled(scale).unwrap().to_string(), &[Value::DWord(raw.cast_unsigned())]);
        // In integers, then as text: another way to the nearest f64.
        let hundred_thousandths = i64::from(raw) * gain * 10_i64.pow(5 - gain_decimals) + offset * 1000;
        let exact: f64 = format!("{hundred_thousandths}e-5").parse().unwrap();
        prop_assert_eq!(value, [TagValue::Scaled(exact + 0.0)]);
    }

    #[test]
    fn a_float_that_is_printed_and_written_back_is_the_same(scale in scales(), bits: u32) {
        let (back, value) = there_and_back(tag("DR0:f32").scaled(scale).unwrap(), Value::DWord(bits));
        let raw = f32::from_bits(bits);
        let Value::DWord(back) = back else { panic!("{back:?}") };
        let back = f32::from_bits(back);
        if raw.is_nan() {
            prop_assert!(back.is_nan() && value.is_nan());
        } else if (f64::from(raw) * scale.gain()).abs() * 1e8 >= scale.offset().abs() {
            prop_assert_eq!(back, raw);
        }
        if scale.offset() == 0.0 && !raw.is_nan() {
            prop_assert_eq!(back.to_bits(), bits);
        }
    }
}
