use std::time::Duration;

use tokio::time::advance;

use super::*;
use crate::command::{ControlDiscrete, DiscreteControl, ReadRegisters, Value, WriteRegisters};
use crate::tag::TagValue;
use crate::{discrete, element, register};

fn plc(movements: &[(&str, &str)]) -> Plc {
    let plc = Plc::new();
    for (tag, movement) in movements {
        set(&plc, tag, movement).unwrap();
    }
    plc
}

fn set(plc: &Plc, tag: &str, movement: &str) -> Result<(), MovementError> {
    plc.set_movement(tag.parse().unwrap(), movement.parse().unwrap())
}

fn values(plc: &Plc, tag: &str) -> Vec<TagValue> {
    let tag: Tag = tag.parse().unwrap();
    tag.decode(&tag.elements().map(|element| plc.read(element)).collect::<Vec<_>>()).unwrap()
}

#[tokio::test(start_paused = true)]
async fn values_of_every_kind_move_with_time() {
    let plc = plc(&[
        ("R0", "ramp(0..100,10s)"),
        ("R5:i16*0.1-40", "ramp(-40..60,10s)"),
        ("R100:f32", "ramp(0..1,10s)"),
        ("DR10:i32", "ramp(0..-1000000,10s)"),
        ("R20:bcd16", "ramp(0..100,10s)"),
        ("M0", "square(5s)"),
        ("DRC200", "counter(1s)"),
    ]);
    advance(Duration::from_millis(2500)).await;
    assert_eq!(values(&plc, "R0"), [TagValue::U16(25)]);
    assert_eq!(values(&plc, "R5:i16*0.1-40"), [TagValue::Scaled(-15.0)]);
    assert_eq!(values(&plc, "R100:f32"), [TagValue::F32(0.25)]);
    assert_eq!(values(&plc, "DR10:i32"), [TagValue::I32(-250_000)]);
    assert_eq!(values(&plc, "R20:bcd16"), [TagValue::Bcd16(0x25)]);
    assert_eq!(values(&plc, "M0"), [TagValue::Bool(true)]);
    assert_eq!(values(&plc, "DRC200"), [TagValue::U32(2)]);
    // Also by symbols of the same memory.
    assert_eq!((plc.read(element!("WM0")), plc.read(element!("DR0"))), (Value::Word(1), Value::DWord(25)));
}

#[tokio::test(start_paused = true)]
async fn a_request_reads_values_of_one_time() {
    let plc = plc(&[("R0-R2", "counter(1ms)"), ("R3:f32", "counter(1ms)")]);
    advance(Duration::from_millis(7)).await;
    let read = ReadRegisters::new(register!("R0"), 3).unwrap();
    assert_eq!(plc.execute(&read), Ok(vec![7, 7, 7]));
    assert_eq!(values(&plc, "R3:f32"), [TagValue::F32(7.0)]);
}

#[tokio::test(start_paused = true)]
async fn a_client_write_lasts_until_the_next_access() {
    let plc = plc(&[("R0", "counter(1s)")]);
    plc.execute(&WriteRegisters::new(register!("R0"), [500, 501]).unwrap()).unwrap();
    assert_eq!((plc.read(register!("R0")), plc.read(register!("R1"))), (Value::Word(0), Value::Word(501)));
    advance(Duration::from_secs(3)).await;
    assert_eq!(plc.read(register!("R0")), Value::Word(3));
}

#[tokio::test(start_paused = true)]
async fn a_write_of_the_process_ends_a_movement() {
    let plc = plc(&[("R0-R1", "counter(1s)"), ("R10:f32", "counter(1s)")]);
    advance(Duration::from_secs(3)).await;
    plc.write(register!("R0"), 500_u16).unwrap();
    plc.write(register!("R11"), 0_u16).unwrap();
    advance(Duration::from_secs(3)).await;
    assert_eq!((plc.read(register!("R0")), plc.read(register!("R1"))), (Value::Word(500), Value::Word(6)));
    assert_eq!(plc.read(register!("R10")), Value::Word(0), "half of the value was written");
}

#[tokio::test(start_paused = true)]
async fn a_disabled_discrete_keeps_its_state() {
    let plc = plc(&[("X3", "square(2s)")]);
    let control = |control| plc.execute(&ControlDiscrete::new(control, discrete!("X3"))).unwrap();
    advance(Duration::from_millis(1500)).await;
    control(DiscreteControl::Disable);
    advance(Duration::from_secs(1)).await;
    assert_eq!(plc.read(discrete!("X3")), Value::Bit(true), "the state when it was disabled");
    control(DiscreteControl::Reset);
    advance(Duration::from_secs(1)).await;
    assert_eq!(plc.read(discrete!("X3")), Value::Bit(false), "forced");
    control(DiscreteControl::Enable);
    assert_eq!(plc.read(discrete!("X3")), Value::Bit(true));
}

#[tokio::test(start_paused = true)]
async fn movements_replace_those_of_their_elements() {
    let plc = plc(&[("R0-R3", "counter(1s)"), ("R1:f32", "ramp(0..10,10s)")]);
    advance(Duration::from_secs(5)).await;
    assert_eq!(values(&plc, "R1:f32"), [TagValue::F32(5.0)]);
    assert_eq!((plc.read(register!("R0")), plc.read(register!("R3"))), (Value::Word(5), Value::Word(5)));
}

#[tokio::test(start_paused = true)]
async fn random_values_of_elements_differ() {
    let plc = plc(&[("R0-R1", "random(0..65535)"), ("R100", "random(0..65535)")]);
    let read = |address: &str| plc.read(address.parse::<Element>().unwrap());
    assert_ne!(read("R0"), read("R1"));
    assert_ne!(read("R0"), read("R100"));
    let again = self::plc(&[("R0-R1", "random(0..65535)")]);
    assert_eq!(read("R0"), again.read(register!("R0")), "the same seed");
}

#[test]
fn refused_movements_change_nothing() {
    let plc = plc(&[("R0", "step(7..8,1h)")]);
    for (tag, movement, error) in [
        ("R0-R1", "ramp(0..70000,1s)", "R0 cannot hold 70000.0"),
        ("R4167-R4168", "counter", "R4168 is beyond the memory of this model"),
        ("R0:text", "counter", "R0:text cannot move: numbers and discretes can"),
    ] {
        assert_eq!(set(&plc, tag, movement).unwrap_err().to_string(), error);
    }
    assert_eq!(plc.read(register!("R0")), Value::Word(7));
}
