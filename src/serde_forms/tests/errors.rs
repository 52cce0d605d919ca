//! Errors of bad input: they name the input and the rule.

use std::fmt::Debug;
use std::time::Duration;

use serde::de::DeserializeOwned;

use super::{read_json, read_values, tag};
use crate::Endpoint;
use crate::element::{Discrete, Element, Register, Register32, Symbol};
use crate::endpoint::{InStepSettings, SerialSettings};
use crate::link::{CallOptions, EchoMode};
use crate::plan::{CostModel, Limits};
use crate::poll::{PollTag, ScanClass};
use crate::tag::{Assignment, Scale, Tag, TagType};
use crate::wire::Framing;

#[track_caller]
fn refused<T: DeserializeOwned + Debug>(json: &str, error: &str) {
    let found = read_json::<T>(json).unwrap_err();
    assert!(found.contains(error), "{json}: {found}");
}

#[test]
fn bad_texts_are_named_with_their_rule() {
    refused::<Tag>(r#""R0:f33""#, "`R0:f33` is not a tag: the type is unknown");
    refused::<TagType>(r#""f33""#, "`f33` is not a type (known: ");
    refused::<Scale>(r#""*0""#, "`*0` is not a scale: the gain is 0.0");
    refused::<Assignment>(r#""R0=70000""#, "`70000` is not a value for R0: out of range");
    refused::<Element>(r#""R""#, "`R` ");
    refused::<Discrete>(r#""R0""#, "`R0` ");
    refused::<Register>(r#""WM4""#, "`WM4` ");
    refused::<Register32>(r#""R0""#, "`R0` ");
    refused::<Symbol>(r#""Q""#, "`Q` is not a symbol: no element has these letters");
    refused::<Framing>(r#""rtu""#, "`rtu` is not a framing: it must be `ascii` or `binary`");
    refused::<EchoMode>(r#""maybe""#, "unknown variant `maybe`");
    refused::<Endpoint>(r#""tcp://a?copy=1""#, "is not an endpoint: unknown option `copy=1`");
}

#[test]
fn other_kinds_of_values_name_the_text_that_is_expected() {
    refused::<Tag>("7", "invalid type: integer `7`, expected a tag, such as \"R100:f32\"");
    refused::<Endpoint>("null", "expected a URL, such as \"tcp://10.0.0.1:500\"");
    refused::<CallOptions>(r#"{"call_timeout": 5}"#, "expected a duration as text, such as \"500ms\"");
}

#[track_caller]
fn value_refused(of: &str, json: &str, error: &str) {
    let found = read_values(tag(of), json).unwrap_err();
    assert!(found.contains(error), "{of} {json}: {found}");
}

#[test]
fn values_of_another_type_or_range_are_refused() {
    value_refused("R0", "65536", "`65536` is not a value for R0: out of range: u16 takes 0 to 65535");
    value_refused("R0", "-1", "`-1` is not a value for R0: out of range: u16 takes 0 to 65535");
    value_refused("R0", "7.0", "`7.0` is not a value for R0: u16 takes no floats");
    value_refused("R0", "true", "`true` is not a value for R0: u16 takes no true and false");
    value_refused("R0", "\"7x\"", "`7x` is not a value for R0: u16 takes 0 to 65535");
    value_refused("R0", "null", "invalid type: null, expected a value of R0");
    value_refused("R0", "{}", "invalid type: map, expected a value of R0");
    value_refused("M0", "1", "`1` is not a value for M0: bool takes no numbers");
    value_refused("R0.3", "1", "`1` is not a value for R0.3: bool takes no numbers");
    value_refused(
        "R0:f32",
        "16777217",
        "`16777217` is not a value for R0:f32: f32 cannot represent this integer exactly",
    );
    value_refused("R0:f32", "1e39", "is not a value for R0:f32: out of range: f32 takes");
    value_refused("R0:u64", "18446744073709551616", "is not a value for R0:u64: out of range: u64 takes 0 to");
    value_refused("R0:hex", "65536", "`65536` is not a value for R0:hex: out of range: hex takes 0x");
    value_refused("R0:hex", "\"10\"", "`10` is not a value for R0:hex: a hexadecimal value begins with 0x");
    value_refused("R0:bcd16", "10000", "`10000` is not a value for R0:bcd16: out of range: bcd16 takes 0 to 9999");
    value_refused("R0:u16*0.1", "6554", "`6554` is not a value for R0:u16*0.1: the raw number of 6554.0 is 65540");
    value_refused("R0:u16*0.1", "\"NaN\"", "`NaN` is not a value for R0:u16*0.1: the raw number of NaN is NaN");
    value_refused("R0-R1:text", "7", "`7` is not a value for R0-R1:text: text takes no numbers");
    value_refused("R0-R1:text", "\"hello\"", "\"hello\" has 5 characters, and 4 fit");
    value_refused("R0-R1:text", "\"\u{20AC}\"", "which is not Latin-1");
}

#[test]
fn another_number_of_values_is_refused() {
    value_refused("R0-R2", "[1, 2]", "the number of values is 2, and R0-R2 takes 3");
    value_refused("R0-R2", "[1, 2, 3, {}, null]", "the number of values is 5, and R0-R2 takes 3");
    value_refused("R0-R2", "[]", "the number of values is 0, and R0-R2 takes 3");
    value_refused("R0-R2", "1", "the number of values is 1, and R0-R2 takes 3");
    value_refused("R0", "[1, 2]", "the number of values is 2, and R0 takes 1");
    value_refused("R0", "[[1]]", "invalid type: sequence, expected a value of R0");
    value_refused("R0-R2", "[1, 2, 70000]", "`70000` is not a value for R0-R2: out of range");
}

#[test]
fn unknown_keys_are_refused() {
    const UNKNOWN: &str = r#""unknown": 1}"#;
    let error = "unknown field `unknown`, expected";
    refused::<CallOptions>(&format!("{{{UNKNOWN}"), error);
    refused::<InStepSettings>(&format!("{{{UNKNOWN}"), error);
    refused::<SerialSettings>(&format!("{{{UNKNOWN}"), error);
    refused::<Limits>(&format!("{{{UNKNOWN}"), error);
    refused::<CostModel>(&format!("{{{UNKNOWN}"), error);
    refused::<ScanClass>(&format!("{{{UNKNOWN}"), error);
    refused::<PollTag>(&format!("{{{UNKNOWN}"), error);
    refused::<ScanClass>("{}", "missing field `period`");
    refused::<PollTag>("{}", "missing field `tag`");
    refused::<CostModel>(r#"{"framing": "ascii"}"#, "missing field `response_time`");
}

#[test]
fn options_beyond_the_limits_of_their_setters_are_refused() {
    refused::<CallOptions>(r#"{"call_timeout": "5"}"#, "`5` is not a duration: it must be a number with a unit");
    refused::<ScanClass>(r#"{"period": "0s"}"#, "the period is 0ns, and must be 1ms to");
    refused::<ScanClass>(r#"{"period": "2days"}"#, "the period is 172800s");
    refused::<PollTag>(r#"{"tag": "R0", "deadband": -1}"#, "the deadband of R0 (R0) is -1");
    refused::<PollTag>(r#"{"tag": "M0", "deadband": 1}"#, "the deadband of M0 (M0) is 1");
    refused::<PollTag>(r#"{"tag": "R0", "on_change": false, "deadband": 1}"#, "`on_change` of R0 is false");
    refused::<PollTag>(r#"{"tag": "R0", "on_change": false, "heartbeat": "1s"}"#, "`on_change` of R0 is false");
    refused::<InStepSettings>(r#"{"copies": 9}"#, "the number of copies 9 is not within 0 to 8");
    refused::<InStepSettings>(r#"{"window": "25h"}"#, "`window` is 1day 1h, and must be at most 1day");
    refused::<InStepSettings>(r#"{"quiet": "25h"}"#, "`quiet` is 1day 1h");
    refused::<InStepSettings>(r#"{"settle": "25h"}"#, "`settle` is 1day 1h");
    refused::<SerialSettings>(r#"{"baud": 299}"#, "the baud rate `299` must be a number from 300 to 921600");
    refused::<SerialSettings>(r#"{"frame": "9N1"}"#, "the frame `9N1` must be data bits");
    refused::<SerialSettings>(r#"{"dtr": "high"}"#, "the level `high` of `dtr` must be `on` or `off`");
    refused::<SerialSettings>(r#"{"rts": "on", "rs485": "rts"}"#, "`rs485` and `rts` exclude each other");
    refused::<Limits>(r#"{"max_registers": 65}"#, "max_registers is 65, and must be 2 to 64");
    refused::<Limits>(r#"{"max_points": 0}"#, "max_points is 0, and must be 1 to 256");
    refused::<Limits>(r#"{"max_mixed": 0}"#, "max_mixed is 0, and must be 1 to 64");
    refused::<Limits>(r#"{"mixed_reads": false, "max_mixed": 5}"#, "`max_mixed` is 5, and `mixed_reads` is false");
    refused::<Limits>(r#"{"readable": ["R9-R5"]}"#, "R9 to R5 is not a range");
    refused::<Limits>(r#"{"avoid": ["R0-M5"]}"#, "R0 to M5 is not a range");
    refused::<Limits>(r#"{"avoid": ["R0-9"]}"#, "`9` ");
    let cost = |key: &str| format!(r#"{{"framing": "ascii", "response_time": "1s", "{key}": "1001ms"}}"#);
    for key in ["byte_time", "frame_gap", "overhead"] {
        refused::<CostModel>(&cost(key), &format!("`{key}` is 1s 1ms, and must be at most 1s"));
    }
    refused::<CostModel>(r#"{"framing": "ascii", "response_time": "61s"}"#, "`response_time` is 1m 1s");
}

#[test]
fn values_that_could_not_be_read_are_not_written() {
    let no_number = PollTag::from(tag("R0")).deadband(f64::NAN);
    assert!(serde_json::to_string(&no_number).unwrap_err().to_string().contains("the deadband of R0 (R0) is NaN"));
    let too_short = ScanClass::every(Duration::ZERO);
    assert!(serde_json::to_string(&too_short).unwrap_err().to_string().contains("the period is 0ns"));
}
