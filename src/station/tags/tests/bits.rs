//! Bits of registers.

use std::time::Duration;

use tokio::time::Instant;

use super::*;
use crate::plan::{CostModel, Plan};
use crate::{element, register};

#[tokio::test]
async fn bits_are_modified_and_nothing_else() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let Bench { station, plc, .. } = bench(framing, []);
        plc.write(register!("R5"), 0xA5F0_u16).unwrap();
        plc.write(element!("DR10"), 0x8000_0000_u32).unwrap();
        station.modify_bits("R5.0-R5.3", [true, false, true, true]).await.unwrap();
        station.modify_bits("R5.15", [false]).await.unwrap();
        station.modify_bits("DR10.16", vec![true]).await.unwrap();
        assert_eq!(station.read::<(u16, u32), _>(("R5", "DR10")).await.unwrap(), (0x25FD, 0x8001_0000));
        assert!(station.read::<bool, _>("R5.13").await.unwrap());
        assert_eq!(station.read::<[bool; 3], _>("R5.0-2").await.unwrap(), [true, false, true]);
        assert_eq!(station.read::<(bool, u16), _>(("DR10.31", "R5")).await.unwrap(), (true, 0x25FD));
    }
}

#[tokio::test]
async fn bits_that_are_as_they_should_be_are_not_written() {
    let bench = bench(Framing::Ascii, []);
    bench.station.modify_bits("R5.3", [false]).await.unwrap();
    assert_eq!(bench.commands(), [0x46]);
    bench.station.modify_bits("R5.3", [true]).await.unwrap();
    // The link reads by 48, so that its reply differs from the one before.
    assert_eq!(bench.commands(), [0x46, 0x48, 0x47]);
}

#[tokio::test]
async fn a_write_of_bits_sends_nothing() {
    let bench = bench(Framing::Ascii, []);
    let rule = "a write replaces all bits of R5";
    assert!(misfit(bench.station.write("R5.3", true).await).contains(rule));
    assert!(misfit(bench.station.write_all((("R6", 1), ("R5.3", true))).await).contains(rule));
    assert_eq!(
        misfit(bench.station.modify_bits("M5", [true]).await),
        "M5 is not a bit of a register, such as R5.3: it is written by itself"
    );
    assert!(misfit(bench.station.modify_bits("R5", [true]).await).starts_with("R5 is not a bit of a register"));
    assert!(misfit(bench.station.modify_bits("R5.0-R5.3", [true]).await).starts_with("1 value cannot be written"));
    assert!(bench.commands().is_empty());
    // The bit of a word of discretes is a discrete.
    bench.station.write("WM0.3", true).await.unwrap();
    assert_eq!(bench.commands(), [0x45]);
    assert!(bench.station.read::<bool, _>("M3").await.unwrap());
}

/// Without turns, 15 of the 16 bits were lost: all calls read 0 before the first one wrote.
#[tokio::test]
async fn calls_over_one_link_do_not_undo_each_other() {
    let bench = bench(Framing::Ascii, []);
    let calls = (0..16).map(|bit| {
        let station = bench.station.clone();
        async move { station.modify_bits(format!("R5.{bit}"), [true]).await }
    });
    for result in futures::future::join_all(calls).await {
        result.unwrap();
    }
    assert_eq!(bench.station.read::<u16, _>("R5").await.unwrap(), u16::MAX);
}

/// One lock for the link kept all stations waiting for the silent one, beyond their deadlines.
#[tokio::test(start_paused = true)]
async fn a_silent_station_delays_no_other_and_the_deadline_covers_the_turn() {
    let bench = bench(Framing::Ascii, []);
    let link = bench.station.link().clone();
    let options = bench.station.options().with_call_timeout(Duration::from_secs(5));
    // No PLC has this number.
    let silent = link.station(9).unwrap().with_options(options);
    let began = Instant::now();
    let calls = (0..5).map(|bit| silent.modify_bits(format!("R5.{bit}"), [true]));
    let (failed, answered) = tokio::join!(futures::future::join_all(calls), async {
        tokio::time::sleep(Duration::from_millis(10)).await;
        bench.station.modify_bits("R5.0", [true]).await.unwrap();
        began.elapsed()
    });
    for result in failed {
        let error = result.unwrap_err();
        assert!(matches!(error, Error::ReadBeforeWrite { .. }) && !error.may_have_executed(), "{error}");
        assert!(error.is_timeout(), "{error}");
    }
    assert!(answered < Duration::from_secs(3), "{answered:?}");
    assert!(began.elapsed() < Duration::from_millis(5100), "{:?}", began.elapsed());
    assert!(!bench.commands().contains(&0x49));
}

/// The wait for a turn had no timer: it lasted as long as the call that had the turn, here 3 s.
#[tokio::test(start_paused = true)]
async fn the_wait_for_a_turn_ends_at_the_deadline_of_its_own_call() {
    let bench = bench(Framing::Ascii, []);
    let patient = bench.station.link().station(9).unwrap();
    let options = patient.options().with_call_timeout(Duration::from_secs(1));
    let impatient = patient.with_options(options);
    let (held, (error, waited)) = tokio::join!(patient.modify_bits("R5.0", [true]), async {
        tokio::time::sleep(Duration::from_millis(10)).await;
        let began = Instant::now();
        (impatient.modify_bits("R5.1", [true]).await.unwrap_err(), began.elapsed())
    });
    assert!(held.is_err());
    assert!(matches!(error, Error::ReadBeforeWrite { .. }) && error.is_timeout(), "{error}");
    assert!(waited <= Duration::from_millis(1010), "{waited:?}");
}

#[tokio::test]
async fn a_plan_reads_a_register_once_for_all_of_its_bits() {
    let bench = bench(Framing::Ascii, []);
    bench.plc.write(register!("R5"), 0x0104_u16).unwrap();
    let tags = ["R5.2", "R5", "R5.8-R5.15", "R6.0"].map(|tag| tag.parse().unwrap());
    let plan = Plan::builder(CostModel::of_link(bench.station.link())).tags(tags).build().unwrap();
    assert_eq!(plan.requests().len(), 1);
    let readings = plan.read(&bench.station).await;
    let values: Vec<_> = readings.iter().map(|(_, values)| values.unwrap()).collect();
    assert_eq!(values[0], [TagValue::Bool(true)]);
    assert_eq!(values[1], [TagValue::U16(0x0104)]);
    assert_eq!(values[2].iter().filter(|&value| *value == TagValue::Bool(true)).count(), 1);
    assert_eq!(values[3], [TagValue::Bool(false)]);
}
