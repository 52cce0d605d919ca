mod bits;

use std::time::Duration;

use super::*;
use crate::capabilities::Capabilities;
use crate::error::ErrorCode;
use crate::link::Link;
use crate::sim::fault::Arrival;
use crate::sim::{self, Bus, Fault, Faults, Plc, Rule};
use crate::wire::Framing;

struct Bench {
    plc: Plc,
    faults: Faults,
    station: Station,
}

fn bench(framing: Framing, rules: impl IntoIterator<Item = Rule>) -> Bench {
    let (plc, faults) = (Plc::new(), Faults::new(1));
    faults.set_rules(rules);
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let link = Link::connector_builder("a PLC", framing, sim::connector(bus, framing)).seed(1).build();
    Bench { plc, faults, station: link.station(1).unwrap() }
}

impl Bench {
    /// The commands that were received, checks left out.
    fn commands(&self) -> Vec<u8> {
        let commands = self.faults.log().entries().into_iter().filter_map(|entry| match entry.arrival {
            Arrival::Request { request, .. } => Some(request.code().into()),
            _ => None,
        });
        commands.filter(|&command| command != 0x4E).collect()
    }
}

fn misfit<T: std::fmt::Debug>(result: Result<T, Error>) -> String {
    match result {
        Err(error @ Error::Tag(_)) => error.to_string(),
        other => panic!("{other:?}"),
    }
}

/// Reads a tag into each Rust type. Returns the names of those that it fits.
async fn types_of(station: &Station, tag: &str) -> String {
    let mut names = Vec::new();
    macro_rules! try_types {
        ($($name:ty),*) => {
            $(
                match station.read::<$name, _>(tag).await {
                    Ok(_) => names.push(stringify!($name)),
                    Err(error) => {
                        assert!(matches!(error, Error::Tag(_)), "{error}");
                        let text = error.to_string();
                        assert!(text.contains(tag) && text.contains(&format!("`{}`", stringify!($name))), "{text}");
                    }
                }
            )*
        };
    }
    try_types!(bool, u16, i16, u32, i32, u64, i64, f32, f64, String, TagValue, Vec<u16>, [i16; 2], [f32; 2]);
    names.join(" ")
}

#[tokio::test]
async fn a_tag_is_read_into_each_type_that_holds_all_its_values() {
    let bench = bench(Framing::Ascii, []);
    for (tag, types) in [
        ("M0", "bool TagValue"),
        ("R0", "u16 u32 i32 u64 i64 f32 f64 TagValue Vec<u16>"),
        ("R0:i16", "i16 i32 i64 f32 f64 TagValue"),
        ("R0:u32", "u32 u64 i64 f64 TagValue"),
        ("DR0:i32", "i32 i64 f64 TagValue"),
        ("DR0:f32", "f32 f64 TagValue"),
        ("R0:hex", "u16 u32 i32 u64 i64 TagValue Vec<u16>"),
        ("DR0:hex", "u32 u64 i64 TagValue"),
        ("R0:u16*0.1", "f64 TagValue"),
        ("R0:bcd16", "u16 i16 u32 i32 u64 i64 f64 TagValue Vec<u16>"),
        ("R0:bcd32", "u32 i32 u64 i64 f64 TagValue"),
        ("R0:u64", "u64 TagValue"),
        ("R0:i64-hi", "i64 TagValue"),
        ("DR0:f64", "f64 TagValue"),
        ("R0-R4:text", "String TagValue"),
        ("R0-R1:i16", "[i16; 2] [f32; 2]"),
        ("R0-R3:f32", "[f32; 2]"),
        ("R0-R2", "Vec<u16>"),
    ] {
        assert_eq!(types_of(&bench.station, tag).await, types, "{tag}");
    }
}

#[tokio::test]
async fn what_is_written_is_read_back_in_both_framings() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let Bench { station, plc, .. } = bench(framing, []);
        station.write("R0", 65_535).await.unwrap();
        station.write("R1:i16", -1_i8).await.unwrap();
        station.write("R2:u32", u32::MAX).await.unwrap();
        station.write("DR4:i32", i32::MIN).await.unwrap();
        station.write("R6:f32", -500.125).await.unwrap();
        station.write("R8:f32", 7).await.unwrap();
        station.write("R10:hex", 0xBEEF).await.unwrap();
        station.write("R11:i16*0.1-40", 12.3).await.unwrap();
        station.write("R12-R14:text", "abc").await.unwrap();
        station.write("M3-M5", [true, false, true]).await.unwrap();
        station.write("R20-R23:f32", vec![1.5, -2.5]).await.unwrap();
        station.write(crate::register!("R30"), 5_u16).await.unwrap();
        station.write("R31", TagValue::U16(9)).await.unwrap();
        station.write("R40:u64", u64::MAX - 1).await.unwrap();
        station.write("R60:bcd16", 1234).await.unwrap();
        assert_eq!(station.read::<(u16, u16), _>(("R60", "R60:bcd16")).await.unwrap(), (0x1234, 1234));
        station.write("R60:hex", 0x12A4).await.unwrap();
        let error = station.read::<u32, _>("R60:bcd16").await.unwrap_err();
        assert_eq!(error.to_string(), "R60:bcd16 holds 0x12A4, which is no decimal number");
        station.write("R44-R51:f64-hi", [0.1, -2.5]).await.unwrap();
        assert_eq!(station.read::<u64, _>("R40:u64").await.unwrap(), u64::MAX - 1);
        assert_eq!(
            station.read::<(u64, [f64; 2]), _>(("R40:u64", "R44-R51:f64-hi")).await.unwrap(),
            (u64::MAX - 1, [0.1, -2.5])
        );
        assert_eq!(plc.read(crate::register!("R6")), Value::Word(0x1000));
        assert_eq!(plc.read(crate::register!("R7")), Value::Word(0xC3FA));
        type Values = (u16, i16, u32, i32, f32, f64, u64, f64, String, Vec<bool>, [f32; 2], u16);
        let tags = (
            "R0",
            "R1:i16",
            "R2:u32",
            "DR4:i32",
            "R6:f32",
            "R8:f32",
            "R10:hex",
            "R11:i16*0.1-40",
            "R12-R14:text",
            "M3-M5",
            "R20-R23:f32",
            "R31",
        );
        let values: Values = station.read(tags).await.unwrap();
        let text = "abc".to_owned();
        let bits = vec![true, false, true];
        let expected: Values =
            (65_535, -1, u32::MAX, i32::MIN, -500.125, 7.0, 0xBEEF, 12.3, text, bits, [1.5, -2.5], 9);
        assert_eq!(values, expected, "{framing}");
    }
}

#[tokio::test]
async fn values_that_do_not_fit_are_named_and_nothing_is_sent() {
    let Bench { station, faults, .. } = bench(Framing::Ascii, []);
    for (error, text) in [
        (
            misfit(station.write("R0", 65_536).await),
            "65536 cannot be written to R0 (u16 of 16 bits): out of range: u16 takes 0 to 65535",
        ),
        (misfit(station.write("R0", -1).await), "-1 cannot be written to R0 (u16 of 16 bits): out of range"),
        (misfit(station.write("R0", 1.0).await), "1.0 cannot be written to R0 (u16 of 16 bits): u16 takes no floats"),
        (
            misfit(station.write("R0:f32", 16_777_217).await),
            "16777217 cannot be written to R0:f32 (f32 of 32 bits): f32 cannot represent this integer exactly",
        ),
        (
            misfit(station.write("R0:f32", 1e39).await),
            "1e39 cannot be written to R0:f32 (f32 of 32 bits): out of range",
        ),
        (misfit(station.write("R0", true).await), "true cannot be written to R0 (u16 of 16 bits)"),
        (misfit(station.write("M0", 1).await), "1 cannot be written to M0 (bool): bool takes no numbers"),
        (
            misfit(station.write("R0:u16*0.1", 6553.6).await),
            "6553.6 cannot be written to R0:u16*0.1 (scaled): the raw number of 6553.6 is 65536",
        ),
        (
            misfit(station.write("R0-R1:text", "abcde").await),
            "\"abcde\" cannot be written to R0-R1:text (text): \"abcde\" has 5 characters, and 4 fit",
        ),
        (misfit(station.write("R0", "5").await), "\"5\" cannot be written to R0"),
        (misfit(station.write("R0-R2", [1, 2]).await), "2 values cannot be written to R0-R2 (3 values, each u16"),
        (misfit(station.write("R0-R2", [1, 2, 70_000]).await), "70000 cannot be written to R2 (u16"),
        (
            misfit(station.write("R0", TagValue::I16(1)).await),
            "1 (i16 of 16 bits) cannot be written to R0 (u16 of 16 bits)",
        ),
        (misfit(station.write("R5:x", 1).await), "`R5:x` is not a tag"),
        (misfit(station.read::<u16, _>("R0-").await), "`R0-` is not a tag"),
        (misfit(station.read::<(u16, i16), _>(("R0", "M0")).await), "M0 (bool) cannot be read into `i16`"),
        (misfit(station.write("R0-R1", [5]).await), "1 value cannot be written to R0-R1 (2 values"),
        (misfit(station.read::<[u16; 3], _>(["R0", "R1"]).await), "2 tags cannot be read into a Rust type of 3 items"),
        (
            misfit(station.read::<[u16; 3], _>("R0-R1").await),
            "R0-R1 (2 values, each u16 of 16 bits) cannot be read into `[u16; 3]`",
        ),
        (misfit(station.write_all((("R0", 1), ("R1", 70_000))).await), "70000 cannot be written to R1"),
    ] {
        assert!(error.contains(text), "{error}\nshould have: {text}");
    }
    let past = station.write_all([("R0", true.into_values(&"M0".parse().unwrap()).unwrap())]).await;
    assert!(matches!(past, Err(Error::Tag(_))));
    let far = station.write_all((("R0", 1), ("M10000", true))).await;
    assert!(matches!(far, Err(Error::Invalid(_))), "{far:?}");
    assert_eq!(faults.log().arrivals(), 0);
}

#[tokio::test]
async fn several_tags_are_read_and_written_by_the_cheapest_requests() {
    let bench = bench(Framing::Ascii, []);
    // The cost must not depend on the speed of this machine: with a measured 10 us, three writes of one
    // range each are cheapest.
    bench.station.set_capabilities(Capabilities::new().with_response_time(Duration::from_millis(5)));
    let _: (u16, bool, f32) = bench.station.read(("R0", "M100", "R900:f32")).await.unwrap();
    assert_eq!(bench.commands(), [0x48], "one mixed read");
    bench.faults.log().clear();
    bench.station.write_all((("R0", 1), ("M5", true), ("R10-R12", [1, 2, 3]), ("R20:f32", 1.5))).await.unwrap();
    assert_eq!(bench.commands(), [0x49], "one mixed write");
    assert_eq!(
        bench.station.read::<(u16, bool, [u16; 3], f32), _>(("R0", "M5", "R10-R12", "R20:f32")).await.unwrap(),
        (1, true, [1, 2, 3], 1.5)
    );
    // No room for the third in a mixed write.
    bench.faults.log().clear();
    let many = |n: u16| vec![n; 16];
    bench.station.write_all([("R100-R115", many(1)), ("R200-R215", many(2)), ("R300-R315", many(3))]).await.unwrap();
    assert_eq!(bench.commands(), [0x49, 0x47]);
    let read: [Vec<u16>; 3] = bench.station.read(["R100-R115", "R200-R215", "R300-R315"]).await.unwrap();
    assert_eq!(read, [many(1), many(2), many(3)]);
}

#[tokio::test]
async fn a_refused_mixed_write_is_repeated_one_by_one() {
    let refuse = |code| Rule::new(Fault::Error(ErrorCode::NotSupported)).command(code);
    let bench = bench(Framing::Ascii, [refuse(crate::command::Code::WriteMixed)]);
    bench.station.write_all((("R0", 1), ("M5", true))).await.unwrap();
    assert_eq!(bench.station.read::<(u16, bool), _>(("R0", "M5")).await.unwrap(), (1, true));
    // The second is refused by itself.
    bench.faults.add_rule(Rule::new(Fault::Error(ErrorCode::WriteProhibited)).element(crate::discrete!("M7")));
    let error = bench.station.write_all((("R1", 1), ("M7", true), ("R2", 2))).await.unwrap_err();
    assert_eq!(error.error_code(), Some(ErrorCode::WriteProhibited));
    assert!(matches!(error, Error::PartlyWritten { written: 1, count: 3, .. }), "{error:?}");
    assert_eq!(bench.station.read::<[u16; 2], _>("R1-R2").await.unwrap(), [1, 0]);
}

/// The PLC must see both values of a pulse, and an element once as a bit and once as a word.
#[tokio::test]
async fn an_element_is_not_written_twice_by_one_request() {
    let bench = bench(Framing::Ascii, []);
    bench.station.write_all([("M5", true), ("M5", false)]).await.unwrap();
    assert_eq!(bench.commands().len(), 2, "a pulse: {:?}", bench.commands());
    bench.faults.log().clear();
    bench.station.write_all((("M5", true), ("WM0", 7), ("R0", 1), ("DR0", 2), ("R1", 3))).await.unwrap();
    assert_eq!(bench.commands().len(), 4, "M5, WM0 and R0, DR0, R1: {:?}", bench.commands());
    assert_eq!(bench.station.read::<(u16, [u16; 2]), _>(("WM0", "R0-R1")).await.unwrap(), (7, [2, 3]));
}

#[tokio::test]
async fn a_refused_element_fails_the_whole_group() {
    let refuse = Rule::new(Fault::Error(ErrorCode::IllegalAddress)).element(crate::register!("R7"));
    let bench = bench(Framing::Ascii, [refuse]);
    let error = bench.station.write_all((("R0", 1), ("M5", true), ("R7", 2))).await.unwrap_err();
    assert_eq!(error.error_code(), Some(ErrorCode::IllegalAddress));
    assert_eq!(error.to_string(), "R0, M5, R7: station 1 refused mixed write (49h): illegal address (A)");
    assert_eq!((bench.commands(), bench.plc.read(crate::register!("R0"))), (vec![0x49], Value::Word(0)));
}

/// The error had no tag: in a struct of 20 tags none knew which one the PLC does not have.
#[tokio::test]
async fn a_refusal_names_the_tags_of_its_request() {
    let refuse = |element| Rule::new(Fault::Error(ErrorCode::IllegalAddress)).element(element);
    let bench = bench(Framing::Ascii, [refuse(crate::register!("R7")), refuse(crate::register!("R3000"))]);
    // As in `several_tags_are_read_and_written_by_the_cheapest_requests`.
    bench.station.set_capabilities(Capabilities::new().with_response_time(Duration::from_millis(5)));
    let refused = async |tags: &[&str]| bench.station.read::<Vec<u16>, _>(tags).await.unwrap_err().to_string();
    let text = refused(&["R0", "R7", "R9", "R2000"]).await;
    assert_eq!(text, "R0, R7, R9, R2000: station 1 refused mixed read (48h): illegal address (A)");
    assert_eq!(refused(&["R7"]).await, "station 1 refused read registers (46h): illegal address (A)");
    let many: Vec<String> = (0..12).map(|n| format!("R{n}")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    let text = refused(&many).await;
    assert!(text.starts_with("R0, R1, R2, R3, R4, R5, R6, R7 and 4 more: station 1 refused"), "{text}");
    // Of several requests, behind the first one.
    let writes = [("R0-R63", vec![1_u16; 64]), ("R3000-R3063", vec![2; 64])];
    let text = bench.station.write_all(writes).await.unwrap_err().to_string();
    assert!(text.starts_with("R0-R63: station 1 refused write registers (47h)"), "{text}");
    let writes = [("R100-R163", vec![1_u16; 64]), ("R3000-R3063", vec![2; 64])];
    let error = bench.station.write_all(writes).await.unwrap_err();
    assert_eq!(
        error.to_string(),
        "64 of 128 values were written, and then: R3000-R3063: station 1 refused write registers (47h): illegal \
         address (A)"
    );
    assert!(error.error_code() == Some(ErrorCode::IllegalAddress) && error.may_have_executed());
}

/// The values were sent whole, as `014704R00000…` with a limit of 2, although reads of them were refused.
#[tokio::test]
async fn a_value_longer_than_the_declared_requests_is_not_sent() {
    let bench = bench(Framing::Ascii, []);
    bench.station.set_capabilities(Capabilities::new().with_max_registers(2).unwrap());
    let text = |result: Result<(), Error>| match result {
        Err(error @ Error::Invalid(_)) => error.to_string(),
        other => panic!("{other:?}"),
    };
    assert_eq!(
        text(bench.station.write("R0:f64", 1.5).await),
        "invalid request: write registers (47h): the value from R0 on has 4 elements, and the station takes 2 in one \
         request"
    );
    let later = bench.station.write_all((("R9", 1), ("R0-R39:text", "x"))).await;
    assert!(text(later).contains("the value from R0 on has 40 elements"));
    assert!(text(bench.station.write("DR0:f64", 1.5).await).contains("has 2 elements, and the station takes 1"));
    assert_eq!(bench.faults.log().arrivals(), 0);
    bench.station.write_all((("R0:f32", 1.5), ("R10-R14", [1, 2, 3, 4, 5]))).await.unwrap();
    assert_eq!(bench.station.read::<[u16; 5], _>("R10-R14").await.unwrap(), [1, 2, 3, 4, 5]);
}

/// A signalling NaN became a quiet one on its way through `f64`: 0x7F800001 was written as 0x7FC00001.
#[tokio::test]
async fn each_f32_is_written_with_its_own_bits() {
    let bench = bench(Framing::Binary, []);
    for bits in [0x7F80_0001, 0xFFB4_A654, 0x7FC0_0000, 0x8000_0000, 0x0000_0001_u32] {
        bench.station.write("R0:f32", f32::from_bits(bits)).await.unwrap();
        bench.station.write("R2:f32-hi", [f32::from_bits(bits)]).await.unwrap();
        let (low, high): (u32, u32) = bench.station.read(("R0:u32", "R2:u32-hi")).await.unwrap();
        assert_eq!((low, high), (bits, bits), "{bits:08X}");
        let back: f32 = bench.station.read("R0:f32").await.unwrap();
        assert_eq!(back.to_bits(), bits);
    }
}

/// An own type that has no value for 0.
#[tokio::test]
async fn an_own_type_is_read_alone_and_in_lists() {
    #[derive(Debug, PartialEq)]
    struct Mode(u16);
    impl crate::tag::FromTag for Mode {
        fn type_name() -> String {
            "Mode".to_owned()
        }
        fn from_values(values: &[TagValue]) -> Option<Self> {
            u16::from_values(values).filter(|&mode| mode > 0).map(Mode)
        }
        fn fits(tag: &Tag) -> bool {
            u16::fits(tag)
        }
    }
    let bench = bench(Framing::Ascii, []);
    bench.station.write("R0-R1", &[1, 2]).await.unwrap();
    assert_eq!(bench.station.read::<Mode, _>("R0").await.unwrap(), Mode(1));
    assert_eq!(bench.station.read::<Vec<Mode>, _>("R0-R1").await.unwrap(), [Mode(1), Mode(2)]);
    assert_eq!(bench.station.read::<[Mode; 2], _>("R0-R1").await.unwrap(), [Mode(1), Mode(2)]);
    let text = misfit(bench.station.read::<[Mode; 2], _>("R1-R2").await);
    assert_eq!(text, "R1-R2 (2 values, each u16 of 16 bits) cannot be read into `[Mode; 2]`");
}

/// A tag of several requests: each begins and ends between two values.
#[tokio::test]
async fn no_request_splits_a_value() {
    let bench = bench(Framing::Ascii, []);
    let values: Vec<f32> = (0..150_u16).map(|n| f32::from(n) + 0.5).collect();
    bench.station.write("R1-R300:f32", values.as_slice()).await.unwrap();
    let mut runs = Vec::new();
    for entry in bench.faults.log().entries() {
        if let Arrival::Request { request, .. } = entry.arrival {
            match request {
                crate::command::Request::WriteRegisters(write) => {
                    runs.push((write.first().address(), write.values().len()))
                }
                crate::command::Request::WriteMixed(write) => {
                    runs.push((write.items()[0].0.address(), write.items().len()));
                }
                _ => {}
            }
        }
    }
    assert!(runs.len() >= 5, "{runs:?}");
    assert!(runs.iter().all(|(first, count)| first % 2 == 1 && count % 2 == 0), "{runs:?}");
    assert_eq!(bench.station.read::<Vec<f32>, _>("R1-R300:f32").await.unwrap(), values);
    // The third request fails: 64 and 32 words were written.
    bench.faults.add_rule(Rule::new(Fault::Error(ErrorCode::IllegalAddress)).element(crate::register!("R110")));
    let error = bench.station.write("R1-R300:f32", values).await.unwrap_err();
    assert!(matches!(error, Error::PartlyWritten { written: 48, count: 150, .. }), "{error:?}");
}
