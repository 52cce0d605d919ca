use super::*;

fn rate(text: &str) -> FaultRate {
    text.parse().unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn every_name_is_a_fault_with_its_default() {
    for (name, fault) in FAULTS {
        let rate = rate(&format!("{name}=0.5%"));
        assert_eq!((rate.name(), rate.fault(), rate.per_million()), (name, &fault, 5000));
    }
}

#[test]
fn details_replace_the_defaults() {
    let ms = Duration::from_millis;
    for (text, fault) in [
        ("late=5%:300ms", Fault::Delay { min: ms(300), max: ms(300) }),
        ("stuck=5%: 1s .. 2s", Fault::Delay { min: ms(1000), max: ms(2000) }),
        ("double=5%:10ms..50ms", Fault::Duplicate(Timing::After { min: ms(10), max: ms(50) })),
        ("garbage=5%:100", Fault::GarbageBefore { max_len: 100 }),
        ("noise=5%:1", Fault::GarbageInside { max_len: 1 }),
        ("split=5%:1s", Fault::Split { pieces: 2, pause: ms(1000) }),
        ("short=5%:4", Fault::Truncated { by: 4 }),
        ("long=5%:4", Fault::Extended { by: 4 }),
        ("error=5%:A", Fault::Error(ErrorCode::IllegalAddress)),
    ] {
        assert_eq!((rate(text).fault(), rate(text).per_million), (&fault, 50_000), "{text}");
        assert_eq!(rate(text).to_string(), text);
    }
}

#[test]
fn rates_are_equal_however_they_are_written() {
    assert_eq!(rate("late=5%:300ms"), rate(" late=5.0%: 300ms .. 300ms"));
    assert_ne!(rate("late=5%:300ms"), rate("late=5%"));
    assert_ne!(rate("drop=5%"), rate("drop=5.01%"));
}

#[test]
fn chances_have_up_to_four_decimals() {
    for (text, millionths) in
        [("0%", 0), ("1%", 10_000), ("0.0001%", 1), ("12.5%", 125_000), ("99.9999%", 999_999), ("100%", 1_000_000)]
    {
        assert_eq!(per_million(text), Some(millionths), "{text}");
    }
    for text in ["", "%", "1", "-1%", "+1%", "1.%", "100.0001%", "0.00001%", "1e1%", "99999999999%", ".5%"] {
        assert_eq!(per_million(text), None, "{text}");
    }
}

#[test]
fn faults_of_the_text_name_it_and_the_rule() {
    for (text, item, rule) in [
        ("drop=1%,lose=1%", "lose=1%", "the names are drop, ignore, late, "),
        ("", "", "the names are "),
        ("drop=1%,", "", "the names are "),
        ("drop", "drop", "a chance is 0% to 100%, as in `drop=1%`"),
        ("late=:300ms", "late=:300ms", "a chance is 0% to 100%, as in `late=1%`"),
        ("late=1%:300", "late=1%:300", "`300` must be a time or times up to 24h: 300ms, or 300ms..1s"),
        ("late=1%:2s..1s", "late=1%:2s..1s", "`2s..1s` must be a time or times"),
        ("late=1%:25h", "late=1%:25h", "`25h` must be a time or times"),
        ("split=1%:1s..2s", "split=1%:1s..2s", "`1s..2s` must be one time"),
        ("garbage=1%:0", "garbage=1%:0", "`0` must be a number from 1 to 1024"),
        ("error=1%:0", "error=1%:0", "`0` must be an error code, a hexadecimal digit"),
        ("drop=1%:", "drop=1%:", "`drop` has no detail behind the chance"),
    ] {
        let error = FaultRate::parse_list(text).unwrap_err();
        assert!(error.to_string().starts_with(&format!("`{item}` is not a fault: {rule}")), "{error}");
        assert_eq!(error.input(), item);
        assert!(error.rule().starts_with(rule), "{error}");
    }
}
