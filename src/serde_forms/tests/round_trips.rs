//! Values written and read again, in JSON and in CBOR.

use std::fmt::Debug;
use std::time::Duration;

use proptest::prelude::*;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{json, read_json, read_values, tag, through_cbor, values_through_cbor};
use crate::element::{Element, Symbol, Value, Width};
use crate::endpoint::{DataBits, Endpoint, InStepSettings, Parity, Rts, SerialSettings, StopBits};
use crate::link::{CallOptions, EchoMode};
use crate::plan::{CostModel, Limits};
use crate::poll::{PollTag, ScanClass};
use crate::tag::{Assignment, Scale, Tag, TagType, TagValue};
use crate::wire::Framing;

const SECOND: Duration = Duration::from_secs(1);
const MINUTE: Duration = Duration::from_secs(60);
const DAY: Duration = Duration::from_secs(86_400);

#[track_caller]
fn assert_round_trip<T: Serialize + DeserializeOwned + PartialEq + Debug>(value: &T) {
    assert_eq!(&read_json::<T>(&json(value)).unwrap(), value);
    assert_eq!(&through_cbor(value), value);
}

#[track_caller]
fn assert_values_round_trip(tag: Tag, values: &[TagValue]) {
    let forms = match values {
        [value] => vec![json(value), json(&values)],
        values => vec![json(&values)],
    };
    let is_same = |read: &[TagValue]| {
        read.len() == values.len() && read.iter().zip(values).all(|(a, b)| a.is_identical(b) || both_nan(a, b))
    };
    for form in forms {
        let read = read_values(tag, &form).unwrap_or_else(|error| panic!("{tag} {form}: {error}"));
        assert!(is_same(&read), "{tag} {form}: {read:?} {values:?}");
    }
    let read = values_through_cbor(tag, values);
    assert!(is_same(&read), "{tag}: {read:?} {values:?}");
}

/// The payload of a NaN is not written.
fn both_nan(a: &TagValue, b: &TagValue) -> bool {
    a.as_f64().is_some_and(f64::is_nan) && b.as_f64().is_some_and(f64::is_nan)
}

fn duration(max: Duration) -> impl Strategy<Value = Duration> {
    let nanoseconds = u64::try_from(max.as_nanos()).unwrap();
    prop_oneof![0..=nanoseconds, 0..=nanoseconds.min(1_000_000_000)].prop_map(Duration::from_nanos)
}

fn optional_duration() -> impl Strategy<Value = Option<Duration>> {
    prop_oneof![Just(None), duration(DAY).prop_map(Some)]
}

fn element() -> impl Strategy<Value = Element> {
    (0..Symbol::ALL.len(), any::<u16>())
        .prop_filter_map("no element", |(symbol, address)| Element::new(Symbol::ALL[symbol], address).ok())
}

fn any_tag() -> impl Strategy<Value = Tag> {
    let tag_type = (0..TagType::ALL.len()).prop_map(|n| TagType::ALL[n]);
    let scale = prop_oneof![Just(None), (1..1000, -1000..1000).prop_map(Some)];
    (element(), tag_type, 1..12_usize, scale, 0..16_u8).prop_filter_map(
        "no tag",
        |(first, tag_type, count, scale, bit)| {
            let tag = match (tag_type, first.width()) {
                (TagType::Bool, Width::Word | Width::DWord) => Tag::bits(first, bit, 1).ok()?,
                _ => Tag::spanning(first, tag_type, count).ok()?,
            };
            match scale {
                Some((gain, offset)) => {
                    let scale = Scale::new(f64::from(gain) / 100.0, f64::from(offset) / 10.0).unwrap();
                    Some(tag.scaled(scale).unwrap_or(tag))
                }
                None => Some(tag),
            }
        },
    )
}

/// The values of a tag from random bits.
fn decoded(tag: &Tag, bits: &mut impl Iterator<Item = u32>) -> Vec<TagValue> {
    let raw: Vec<Value> = tag
        .elements()
        .zip(bits)
        .map(|(element, bits)| match element.width() {
            Width::Bit => Value::Bit(bits % 2 == 1),
            Width::Word => Value::Word((bits >> 16) as u16),
            Width::DWord => Value::DWord(bits),
        })
        .collect();
    tag.decode(&raw).unwrap()
}

proptest! {
    #[test]
    fn texts_round_trip(tag in any_tag(), bits: [u32; 16]) {
        assert_round_trip(&tag);
        assert_round_trip(&tag.tag_type());
        let first = tag.first();
        assert_round_trip(&first);
        assert_round_trip(&first.symbol());
        match first {
            Element::Discrete(discrete) => assert_round_trip(&discrete),
            Element::Register(register) => assert_round_trip(&register),
            Element::Register32(register) => assert_round_trip(&register),
        }
        if let Some(scale) = tag.scale() {
            assert_round_trip(&scale);
        }
        let values = decoded(&tag, &mut bits.into_iter());
        let has_nan = values.iter().any(|value| value.as_f64().is_some_and(f64::is_nan));
        if !tag.is_bits_of_register() && !has_nan {
            assert_round_trip(&Assignment::new(tag, values).unwrap());
        }
    }

    #[test]
    fn values_round_trip_by_their_tag(tag in any_tag(), bits: [u32; 16]) {
        assert_values_round_trip(tag, &decoded(&tag, &mut bits.into_iter()));
    }

    #[test]
    fn floats_of_all_bits_round_trip(single: u32, double: u64) {
        assert_values_round_trip(tag("R0:f32"), &[TagValue::F32(f32::from_bits(single))]);
        assert_values_round_trip(tag("R0:f64"), &[TagValue::F64(f64::from_bits(double))]);
        assert_values_round_trip(tag("R0:u64"), &[TagValue::U64(double)]);
        assert_values_round_trip(tag("R0:i64"), &[TagValue::I64(double.cast_signed())]);
        assert_values_round_trip(tag("R0:bcd32"), &[TagValue::Bcd32(single)]);
        assert_values_round_trip(tag("R0:f32*0.25+3"), &decoded(&tag("R0:f32*0.25+3"), &mut [single, 0].into_iter()));
    }

    #[test]
    fn call_options_round_trip(
        times in (optional_duration(), duration(DAY), optional_duration()),
        retries: u32,
        retry_writes: bool,
        background: bool,
    ) {
        let (response, call, adaptive) = times;
        let mut options = CallOptions::new().with_call_timeout(call).with_retries(retries);
        options = options.with_retry_writes(retry_writes).with_background(background);
        options = response.map_or(options, |timeout| options.with_response_timeout(timeout));
        options = adaptive.map_or(options, |shortest| options.with_adaptive_timeout(shortest));
        assert_round_trip(&options);
    }

    #[test]
    fn classes_and_their_tags_round_trip(
        period in 1_000_000..=86_400_000_000_000_u64,
        times in (optional_duration(), optional_duration(), optional_duration(), duration(DAY)),
        tag in any_tag(),
        name in "\\PC{0,12}",
        report in 0..4,
        deadband in 0.0..1e300_f64,
    ) {
        let (phase, stale, bad, probe) = times;
        let mut class = ScanClass::every(Duration::from_nanos(period)).probe_refused(probe);
        class = phase.map_or(class, |phase| class.phase(phase));
        class = stale.map_or(class, |age| class.stale_after(age));
        class = bad.map_or(class, |age| class.bad_after(age));
        assert_round_trip(&class);

        let mut polled = PollTag::new(name, tag).on_change(report > 0);
        if report > 1 && tag.tag_type().is_number() {
            polled = polled.deadband(deadband);
        }
        if report > 2 {
            polled = polled.heartbeat(probe);
        }
        assert_round_trip(&polled);
    }

    #[test]
    fn settings_of_lines_round_trip(
        copies in 0..=8_u8,
        times in (duration(DAY), duration(DAY), duration(DAY)),
        one_request: bool,
        serial in (300..=921_600_u32, any::<[bool; 4]>(), 0..5_usize, 0..3_usize),
    ) {
        let (window, quiet, settle) = times;
        let in_step = InStepSettings::new().with_copies(copies).unwrap().with_window(window).with_quiet(quiet);
        let in_step = in_step.with_settle(settle).with_one_request(one_request);
        assert_round_trip(&in_step);
        let (baud, [eight, two, has_dtr, dtr], rts, parity) = serial;
        let parity = [Parity::None, Parity::Even, Parity::Odd][parity];
        let rts = [Rts::Unchanged, Rts::On, Rts::Off, Rts::OnWhileSending, Rts::OffWhileSending][rts];
        let mut settings = SerialSettings::new(Framing::Ascii).with_baud(baud).unwrap().with_parity(parity);
        settings = settings.with_data_bits(if eight { DataBits::Eight } else { DataBits::Seven }).with_rts(rts);
        settings = settings.with_stop_bits(if two { StopBits::Two } else { StopBits::One });
        settings = if has_dtr { settings.with_dtr(dtr) } else { settings };
        assert_round_trip(&settings);
        let endpoint = Endpoint::serial("COM3").with_serial(settings).unwrap().with_in_step(in_step);
        assert_round_trip(&endpoint);
        assert_round_trip(&Endpoint::udp("plc", 500).with_framing(Framing::Binary).with_in_step(in_step));
    }

    #[test]
    fn limits_and_costs_round_trip(
        maxima in (2..=64_usize, 1..=256_usize, 0..=64_usize),
        ranges in prop::collection::vec((element(), 0..40_u16, any::<bool>()), 0..6),
        times in (duration(MINUTE), duration(SECOND), duration(SECOND)),
        (is_binary, words, at_16) in any::<(bool, bool, bool)>(),
    ) {
        let (registers, points, mixed) = maxima;
        let limits = Limits::new().max_registers(registers).unwrap().max_points(points).unwrap();
        let mut limits = if mixed == 0 { limits.mixed_reads(false) } else { limits.max_mixed(mixed).unwrap() };
        for (first, distance, avoid) in ranges {
            let last = first.address().saturating_add(distance * first.symbol().alignment());
            let Ok(last) = Element::new(first.symbol(), last) else { continue };
            let with = if avoid { limits.clone().avoid(first, last) } else { limits.clone().readable(first, last) };
            limits = with.unwrap_or(limits);
        }
        // Before, the form left out words of discretes.
        assert_round_trip(&limits.words_of_discretes(words).words_at_multiples_of_16(at_16));
        let (response, byte, gap) = times;
        let framing = if is_binary { Framing::Binary } else { Framing::Ascii };
        let cost = CostModel::network(framing, response).with_byte_time(byte).with_frame_gap(gap).with_overhead(gap);
        assert_round_trip(&cost);
    }

    #[test]
    fn durations_of_any_length_round_trip(seconds: u64, nanoseconds in 0..1_000_000_000_u32) {
        let duration = Duration::new(seconds, nanoseconds);
        assert_round_trip(&CallOptions::new().with_call_timeout(duration));
    }

    #[test]
    fn no_json_causes_a_panic(tag in any_tag(), json in "[-\\[\\]0-9.,e\"xa-f ]{0,20}") {
        if let Ok(values) = read_values(tag, &json) {
            prop_assert_eq!(values.len(), tag.value_count());
        }
    }
}

#[test]
fn names_of_echo_modes_round_trip() {
    for (mode, name) in [(EchoMode::Auto, "auto"), (EchoMode::On, "on"), (EchoMode::Off, "off")] {
        assert_eq!(json(&mode), format!("{name:?}"));
        assert_round_trip(&mode);
    }
}

#[test]
fn ranges_through_counters_of_32_bits_are_split_into_elements() {
    let element = |text: &str| text.parse::<Element>().unwrap();
    let limits = Limits::new().readable(element("RC10"), element("RC199")).unwrap();
    let limits = limits.readable(element("DRC200"), element("DRC255")).unwrap();
    let limits = limits.readable(element("RC256"), element("RC300")).unwrap();
    let form = json(&limits);
    assert!(form.contains(r#""readable":["RC10-RC199","DRC200-DRC255","RC256-RC300"]"#), "{form}");
    assert_round_trip(&limits);
}

#[test]
fn missing_keys_have_the_defaults_of_the_code() {
    assert_eq!(read_json("{}"), Ok(CallOptions::new()));
    assert_eq!(read_json("{}"), Ok(InStepSettings::new()));
    assert_eq!(read_json("{}"), Ok(SerialSettings::new(Framing::Ascii)));
    assert_eq!(read_json("{}"), Ok(Limits::new()));
    assert_eq!(read_json(r#"{"mixed_reads": false}"#), Ok(Limits::new().mixed_reads(false)));
    assert_eq!(read_json(r#"{"retries": 5}"#), Ok(CallOptions::new().with_retries(5)));
    assert_eq!(read_json(r#"{"period": "1s"}"#), Ok(ScanClass::every(Duration::from_secs(1))));
    assert_eq!(read_json(r#"{"tag": "R5:i16"}"#), Ok(PollTag::from(tag("R5:i16"))));
    let deadband = PollTag::from(tag("R5:i16")).deadband(2.0);
    assert_eq!(read_json(r#"{"tag": "R5:i16", "deadband": 2}"#), Ok(deadband));
    let network = CostModel::network(Framing::Binary, Duration::from_millis(7));
    assert_eq!(read_json(r#"{"framing": "binary", "response_time": "7ms"}"#), Ok(network));
}
