use super::*;

/// Gains and offsets: decimal ones, and any others.
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
fn scaled_tags_display_as_they_are_parsed() {
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
fn a_scaled_value_has_the_decimals_of_gain_and_offset() {
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
    // Before, the first three had digits of rounding errors: 209597170802.86102, ….2999 and ….0000003.
    for (text, raw, printed) in [
        ("R0:u32*76.768+45.709", 2_730_267_439_u32, "209597170802.861"),
        ("R0:u32*273.21-4511.5", 3_748_280_830, "1024067801052.8"),
        ("R0:u32*0.123456789012345", 4_000_000_003, "493827156.4197504"),
        ("R0:u32*0.1", u32::MAX, "429496729.5"),
        ("R0:i32*12345.6789-0.0001", 0x8000_0000, "-26512143561208.63"),
    ] {
        let raw = [raw & 0xFFFF, raw >> 16].map(|word| Value::Word(u16::try_from(word).unwrap()));
        assert_eq!(decode(text, &raw)[0].to_string(), printed, "{text} {raw:?}");
    }
    // A float counts as the decimal that it displays.
    let float = |text: &str, value: f32| decode(text, &[Value::DWord(value.to_bits())])[0].to_string();
    assert_eq!(float("DR0:f32*0.1", 12.3), "1.23");
    assert_eq!(float("DR0:f32*0.1-40", 12.3), "-38.77");
    assert_eq!(float("DR0:f32*0.1", -0.0), "-0.0");
    assert_eq!(float("DR0:f32*0.1", f32::NAN), "NaN");
    assert_eq!(float("DR0:f32*-0.1+7", f32::INFINITY), "-inf");
}

#[test]
fn a_scaled_value_is_encoded_as_the_nearest_raw_number() {
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
fn a_scaled_value_out_of_range_is_refused() {
    let message = |text: &str| text.parse::<Assignment>().unwrap_err().to_string();
    for (text, rule) in [
        ("R0:u16*0.1=6553.55", "the raw number of 6553.55 is 65535.5, out of range: u16 takes 0 to 65535"),
        ("R0:u16*0.1=-0.05", "the raw number of -0.05 is -0.5, out of range: u16 takes 0 to 65535"),
        ("R0:i16+3=-32766", "the raw number of -32766.0 is -32769.0, out of range: i16 takes -32768 to 32767"),
        (
            "DR0:i32+0.5=2147483648.0",
            "the raw number of 2147483648.0 is 2147483647.5, out of range: i32 takes -2147483648 to 2147483647",
        ),
        ("R0:u16*2=nan", "the raw number of NaN is NaN, out of range: u16 takes 0 to 65535"),
        ("R0:u16*2=-inf", "the raw number of -inf is -inf, out of range: u16 takes 0 to 65535"),
        (
            "DR0:f32*0.1=1e38",
            "the raw number of 1e38 is 1e39, out of range: f32 takes -3.4028235e38 to 3.4028235e38, nan and inf",
        ),
        (
            "DR0:f32*1e-200=1e200",
            "the raw number of 1e200 is inf, out of range: f32 takes -3.4028235e38 to 3.4028235e38, nan and inf",
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
fn an_invalid_scale_is_refused() {
    let message = |text: &str| text.parse::<Tag>().unwrap_err().to_string();
    for (scale, rule) in [
        ("*0", "the gain is 0.0, and it must be from 1e-200 to 1e200, or from -1e200 to -1e-200"),
        ("*-0+1", "the gain is -0.0, and it must be from 1e-200 to 1e200, or from -1e200 to -1e-200"),
        ("*1e999", "the gain is inf, and it must be from 1e-200 to 1e200, or from -1e200 to -1e-200"),
        ("*1e-201", "the gain is 1e-201, and it must be from 1e-200 to 1e200, or from -1e200 to -1e-200"),
        ("+1e999", "the offset is inf, and it must be a finite number"),
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
        let rule = "a scale is *GAIN, +OFFSET, -OFFSET or both in this order, such as *0.1-40";
        let expected = format!("`R0:u16{scale}` is not a tag: {rule}");
        assert_eq!(message(&format!("R0:u16{scale}")), expected);
    }
    for (tag, name) in [("M0:bool*2", "bool"), ("R0:hex*2", "hex"), ("R0:text*2", "text")] {
        let rule =
            format!("{name} takes neither gain nor offset (types that do: u16 i16 u32 i32 f32 u32-hi i32-hi f32-hi)");
        assert_eq!(message(tag), format!("`{tag}` is not a tag: {rule}"));
    }
    assert!(matches!(Scale::new(f64::NAN, 0.0), Err(ScaleError::Gain { .. })));
    assert!(matches!(Scale::new(1.0, f64::NAN), Err(ScaleError::Offset { .. })));
    assert_eq!(Scale::new(2.0, -0.0), Ok(scale("*2")));
}

/// A raw number after decoding, display, parsing and encoding, with the displayed value.
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

    /// Gain and offset are integers over a power of ten here, so the decimal is calculated with integers.
    #[test]
    fn the_value_of_an_integer_is_the_nearest_to_the_decimal(
        gain in 1..1_000_000_000_000_000_i64, offset in -1_000_000_000_000_000 + 1..1_000_000_000_000_000_i64,
        places in (0..17_u32, 0..17_u32), bits: u32,
    ) {
        let text = format!("DR0:u32*{gain}e-{}{offset:+}e-{}", places.0, places.1);
        let Ok(tag) = text.parse::<Tag>() else {
            // The offset is too large beside the gain.
            return Ok(());
        };
        let both = places.0.max(places.1);
        let units = |number: i64, places: u32| i128::from(number) * 10_i128.pow(both - places);
        // The limit of the calculation.
        let Some(product) = units(gain, places.0).checked_mul(bits.into()) else { return Ok(()) };
        let sum = product + units(offset, places.1);
        let expected: f64 = format!("{sum}e-{both}").parse().unwrap();
        prop_assert_eq!(tag.decode(&[Value::DWord(bits)]).unwrap(), [TagValue::Scaled(expected)], "{} {}", text, bits);
    }

    /// Calculated with floats, 16 % of such values were rounded towards zero.
    #[test]
    fn a_value_between_two_raw_numbers_is_rounded_away_from_zero(
        gain in 1..10_000_i64, offset in -100_000..100_000_i64, places in 0..6_u32, raw in -30_000..30_000_i64,
    ) {
        let tag = tag(&format!("R0:i16*{gain}e-{places}{offset:+}e-{places}"));
        // The half of a step above a raw number, in a decimal more.
        let value = (raw * gain + offset) * 10 + 5 * gain;
        let value: f64 = format!("{value}e-{}", places + 1).parse().unwrap();
        let encoded = tag.encode(&[TagValue::Scaled(value)]).unwrap();
        let expected = if raw >= 0 { raw + 1 } else { raw };
        let expected = Value::Word(i16::try_from(expected).unwrap().cast_unsigned());
        prop_assert_eq!(encoded, [expected], "{} {}", tag, value);
    }

    #[test]
    fn a_scaled_integer_round_trips_by_its_text(scale in scales(), bits: u32, near in 0..9_u32) {
        // Also near the ends of the ranges, where values are least exact.
        for bits in [bits, near, u32::MAX - near, 0x7FFF_FFFF - near, 0x8000_0000 + near] {
            for text in ["DR0", "DR0:i32"] {
                let raw = Value::DWord(bits);
                prop_assert_eq!(there_and_back(tag(text).scaled(scale).unwrap(), raw).0, raw);
            }
            for text in ["R0", "R0:i16"] {
                let raw = Value::Word(bits as u16);
                prop_assert_eq!(there_and_back(tag(text).scaled(scale).unwrap(), raw).0, raw);
            }
        }
    }

    #[test]
    fn decimal_scales_give_decimals(
        raw in -100_000_000..100_000_000_i32,
        gain in 1..10_000_i64,
        gain_decimals in 0..5_u32,
        offset in -9999..10_000_i64,
    ) {
        let scale = format!("*{gain}e-{gain_decimals}{offset:+}e-2").parse().unwrap();
        let value = decode(&tag("DR0:i32").scaled(scale).unwrap().to_string(), &[Value::DWord(raw.cast_unsigned())]);
        // The nearest f64 by another way: in integers, then as text.
        let hundred_thousandths = i64::from(raw) * gain * 10_i64.pow(5 - gain_decimals) + offset * 1000;
        let exact: f64 = format!("{hundred_thousandths}e-5").parse().unwrap();
        prop_assert_eq!(value, [TagValue::Scaled(exact + 0.0)]);
    }

    #[test]
    fn a_scaled_float_round_trips_by_its_text(scale in scales(), bits: u32) {
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
