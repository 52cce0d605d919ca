use super::*;
use crate::tag::TagValue;

fn movement(text: &str) -> Movement {
    text.parse().unwrap_or_else(|error| panic!("{error}"))
}

/// The values at these times in milliseconds.
fn values<const N: usize>(text: &str, millis: [u64; N]) -> [f64; N] {
    millis.map(|millis| movement(text).value(Duration::from_millis(millis)))
}

#[test]
fn shapes_have_their_values_at_each_time() {
    assert_eq!(values("ramp(0..100,10s)", [0, 2500, 9999, 10_000, 12_500]), [0.0, 25.0, 99.99, 0.0, 25.0]);
    assert_eq!(values("ramp(100..-100,10s)", [0, 2500, 5000, 7500]), [100.0, 50.0, 0.0, -50.0]);
    assert_eq!(values("triangle(0..10,10s)", [0, 2500, 5000, 7500, 10_000]), [0.0, 5.0, 10.0, 5.0, 0.0]);
    let sine = values("sine(0..10,4s)", [0, 1000, 2000, 3000]).map(|value| (value * 1e6).round() / 1e6);
    assert_eq!(sine, [5.0, 10.0, 5.0, 0.0]);
    assert_eq!(values("square(3..7,1s)", [0, 499, 500, 999, 1000]), [3.0, 3.0, 7.0, 7.0, 3.0]);
    assert_eq!(values("square(1s)", [0, 500]), [0.0, 1.0]);
    assert_eq!(values("step(3..7,1s)", [0, 999, 1000, 1_000_000]), [3.0, 3.0, 7.0, 7.0]);
    assert_eq!(values("counter(8..10,1s)", [0, 999, 1000, 2000, 3000]), [8.0, 8.0, 9.0, 10.0, 8.0]);
    assert_eq!(values("counter(2..0)", [0, 1000, 2000, 3000]), [2.0, 1.0, 0.0, 2.0]);
    assert_eq!(values("counter", [0, 65_536_000]), [0.0, 65_536.0]);
}

#[test]
fn random_numbers_follow_from_seed_and_period() {
    let random = movement("random(-5..5,100ms)");
    let numbers = |random: Movement| (0..200).map(|n| random.value(Duration::from_millis(100 * n))).collect::<Vec<_>>();
    assert_eq!(numbers(random), numbers(random));
    assert_ne!(numbers(random), numbers(random.with_seed(1)));
    let all = numbers(random);
    assert!(all.iter().all(|number| (-5.0..=5.0).contains(number)));
    assert!(all.iter().any(|number| *number < -4.0) && all.iter().any(|number| *number > 4.0));
    assert_eq!(random.value(Duration::from_millis(199)), all[1], "the same until the period ends");
}

#[test]
fn random_integers_are_equally_likely() {
    #[allow(clippy::cast_possible_truncation, reason = "an integer, as asserted")]
    let counts = |tag: &str, text: &str| {
        let random = movement(text).of(&tag.parse().unwrap()).unwrap();
        let mut counts = std::collections::BTreeMap::new();
        for nth in 0..4000 {
            let number = random.value(Duration::from_secs(nth));
            assert_eq!(number, number.round(), "{tag}");
            *counts.entry(number as i64).or_insert(0) += 1;
        }
        counts.into_iter().collect::<Vec<(i64, u32)>>()
    };
    // The chance of the ends was half of that: 500 of 4000.
    for (tag, text, numbers) in [
        ("R0", "random(0..3)", [0, 1, 2, 3]),
        ("R0:i16", "random(1..-2)", [-2, -1, 0, 1]),
        ("R0:bcd16", "random(6.8..9.4)", [7, 8, 9, 9]),
    ] {
        let counts = counts(tag, text);
        assert!(counts.iter().all(|(number, _)| numbers.contains(number)), "{tag}: {counts:?}");
        let even = 4000 / u32::try_from(counts.len()).unwrap();
        assert!(counts.iter().all(|(_, count)| count.abs_diff(even) < 150), "{tag}: {counts:?}");
    }
    let states = counts("M0", "random");
    assert!(states.len() == 2 && states.iter().all(|(_, count)| count.abs_diff(2000) < 150), "{states:?}");
}

#[test]
fn texts_display_as_they_parse() {
    for text in ["ramp(0.0..100.0,10s)", "sine(-1.5..1e300,500ms)", "counter(1m)", "step(1.0..0.0,1h 30m)"] {
        assert_eq!(movement(text).to_string(), text);
        assert_eq!(movement(&movement(text).to_string()), movement(text));
    }
    assert_eq!(movement(" ramp( 0 .. 1 , 1s ) "), movement("ramp(0..1,1s)"));
    assert_eq!(movement("random"), movement("random(0..1,1s)"));
}

#[test]
fn faults_name_the_text_and_the_rule() {
    for (text, rule) in [
        ("rampp(0..1,1s)", "it must be ramp(0..100,10s), triangle("),
        ("5", "it must be ramp("),
        ("", "it must be ramp("),
        ("ramp(0..1,1s", "it must end with `)`, as in `ramp(0..100,10s)`"),
        ("ramp(0..1,1s)x", "it must end with `)`"),
        ("ramp(0..1)", "it needs a period, as in `ramp(0..100,10s)`"),
        ("ramp", "it needs a period"),
        ("sine(1s)", "it needs two numbers, as in `sine(0..100,10s)`"),
        ("ramp(0..,1s)", "`0..` must be two decimal numbers, as in `0..100`"),
        ("ramp(0..inf,1s)", "`0..inf` must be two decimal numbers"),
        ("ramp(0..1,0s)", "`0s` must be a period of more than 0"),
        ("ramp(0..1,25h)", "`25h` must be a period"),
        ("ramp(0..1,1)", "`1` must be a period"),
        ("ramp(0..1,1s,2s)", "`2s` is too much: it must be as `ramp(0..100,10s)`"),
        ("ramp(1s,0..1)", "`0..1` is too much"),
    ] {
        let error = text.parse::<Movement>().unwrap_err();
        assert!(error.to_string().starts_with(&format!("`{text}` is not a movement: {rule}")), "{error}");
    }
    assert_eq!(
        Movement::new(Shape::Ramp, 0.0, f64::NAN, DAY).unwrap_err().to_string(),
        "NaN is not possible: numbers are finite"
    );
    assert_eq!(Movement::counter(Duration::ZERO), Err(MovementError::Period));
}

#[test]
fn tags_hold_both_ends_of_their_movement() {
    let of = |tag: &str, text: &str| movement(text).of(&tag.parse().unwrap()).map(|movement| movement.to);
    let wrong = |tag: &str, text: &str| of(tag, text).unwrap_err().to_string();
    assert_eq!(of("R0", "ramp(0..65535,1s)"), Ok(Some(65_535.0)));
    assert_eq!(wrong("R0", "ramp(0..65536,1s)"), "R0 cannot hold 65536.0");
    assert_eq!(wrong("R0", "sine(-1..1,1s)"), "R0 cannot hold -1.0");
    assert_eq!(of("R5:i16*0.1-40", "sine(-50..50.5,1s)"), Ok(Some(50.5)));
    assert_eq!(wrong("M0", "ramp(0..2,1s)"), "M0 cannot hold 2.0");
    assert_eq!(wrong("R0:text", "square(1s)"), "R0:text cannot move: numbers and discretes can");
    assert_eq!(wrong("R5.3", "square(1s)"), "R5.3 cannot move: numbers and discretes can");
    for (tag, largest) in [("R0", 65_535.0), ("R0:i16", 32_767.0), ("R0:bcd16", 8191.0), ("DR0:hex", 4_294_967_295.0)] {
        assert_eq!(of(tag, "counter"), Ok(Some(largest)), "{tag}");
    }
    assert_eq!(of("M0", "counter"), Ok(Some(1.0)));
    assert_eq!(wrong("R0:f32", "ramp(0..1e39,1s)"), "R0:f32 cannot hold 1e39");
    assert_eq!(of("R0:f64", "ramp(0..1e39,1s)"), Ok(Some(1e39)));
}

#[test]
fn numbers_are_encoded_as_the_nearest_value_of_a_tag() {
    let nearest = |tag: &str, number: f64| {
        let tag: Tag = tag.parse().unwrap();
        let mut raw = Vec::new();
        tag.encode_nearest(number, &mut raw).then(|| tag.decode(&raw).unwrap().remove(0))
    };
    assert_eq!(nearest("R0", 4.5), Some(TagValue::U16(5)));
    assert_eq!(nearest("R0:i16", -4.4), Some(TagValue::I16(-4)));
    assert_eq!(nearest("R0:f32", 0.1), Some(TagValue::F32(0.1)));
    assert_eq!(nearest("R0:f64-hi", 0.1), Some(TagValue::F64(0.1)));
    assert_eq!(nearest("R0:bcd16", 1234.4), Some(TagValue::Bcd16(0x1234)));
    assert_eq!(nearest("WM0:hex", 255.0), Some(TagValue::Hex16(255)));
    assert_eq!(nearest("R0:i16*0.1", 12.34), Some(TagValue::Scaled(12.3)));
    assert_eq!(nearest("M0", 0.5), Some(TagValue::Bool(true)));
    assert_eq!(nearest("M0", 0.49), Some(TagValue::Bool(false)));
    assert_eq!(nearest("R0", -0.6), None);
    assert_eq!(nearest("R0:bcd16", 10_000.0), None);
}
