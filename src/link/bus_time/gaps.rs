//! The cost of the frame gap, and what a line with slow RS-485 drivers does to it.

use std::time::Duration;

use super::{RESPONSE_TIME, World};
use crate::command::WriteRegisters;
use crate::element::Register;
use crate::link;
use crate::link::config::Config;
use crate::link::frame_gap::GapLengths;
use crate::sim::{Bus, Line, Plc};
use crate::wire::Framing;

const SECOND: Duration = Duration::from_secs(1);

/// The gaps that are compared.
fn gap(baud: u32) -> GapLengths {
    link::Line { baud, bits_per_character: 10 }.frame_gap()
}

/// One station that is read without a pause, one register at a time. Returns the number of replies
/// in this time, and the world.
fn read(baud: u32, turnaround: Duration, time: Duration, gap: GapLengths) -> (u32, World) {
    let bus = Bus::new().with_station(1, Plc::new()).unwrap();
    let line = Line::new(baud).response_time(RESPONSE_TIME, RESPONSE_TIME).turnaround(turnaround);
    let set = |config: &mut Config| {
        config.frame_gap = gap;
        config.in_step = config.in_step.with_copies(0).unwrap();
    };
    let mut world = World::on_line(bus, Framing::Ascii, line, &[], set);
    world.stations = 1;
    world.registers = 1;
    world.run(time);
    (world.answered[&1], world)
}

/// Before, with a gap of 2 ms: 80.2 % at 115200 baud, 83.6 % at 57600.
#[test]
fn the_default_gap_costs_a_one_register_read_a_few_percent_at_fast_lines() {
    for (baud, least) in [(57_600, 0.93), (115_200, 0.96), (921_600, 0.99)] {
        let without = read(baud, Duration::ZERO, 60 * SECOND, GapLengths::fixed(Duration::ZERO)).0;
        let with = read(baud, Duration::ZERO, 60 * SECOND, gap(baud)).0;
        let before = read(baud, Duration::ZERO, 60 * SECOND, GapLengths::fixed(gap(baud).long)).0;
        let share = |replies: u32| f64::from(replies) / f64::from(without);
        println!(
            "{baud} baud: {:.1} % of the reads without a gap, {:.1} % with 2 ms",
            100.0 * share(with),
            100.0 * share(before)
        );
        assert!(share(with) >= least, "{baud} baud: {}", share(with));
    }
}

/// A line on which each request waits only for the one before it has a load of 1, gaps included.
#[test]
fn the_counted_bus_time_of_a_line_that_is_never_idle_is_all_the_time() {
    for baud in [9600, 115_200] {
        let (_, world) = read(baud, Duration::ZERO, 60 * SECOND, gap(baud));
        let load = world.stats.link_stats().bus_time.as_secs_f64() / 60.0;
        println!("{baud} baud: {:.2} % of the time is counted", 100.0 * load);
        assert!((0.998..1.002).contains(&load), "{baud} baud: {load}");
    }
}

/// With the short gap alone each second read is lost, with its timeout.
#[test]
fn a_line_with_slow_drivers_loses_few_reads_and_no_write() {
    let slow = Duration::from_millis(1);
    let time = 600 * SECOND;
    let (replies, mut world) = read(115_200, slow, time, gap(115_200));
    let fixed = read(115_200, slow, time, GapLengths::fixed(gap(115_200).long)).0;
    let only_short = read(115_200, slow, time, GapLengths::fixed(gap(115_200).short)).0;
    let timeouts = world.stats.station_stats(1).timeouts;
    println!("{replies} replies, {timeouts} timeouts; {fixed} with 2 ms, {only_short} with the short gap alone");
    assert!(timeouts < 10 && f64::from(replies) > 0.99 * f64::from(fixed), "{replies} of {fixed}, {timeouts} lost");
    assert!(only_short < fixed / 10);
    assert_eq!(u64::from(world.stats.link_stats().long_gaps > 0), 1);

    // A write behind a read, while the gap is short.
    let bus = Bus::new().with_station(1, Plc::new()).unwrap();
    let line = Line::new(115_200).response_time(RESPONSE_TIME, RESPONSE_TIME).turnaround(slow);
    world = World::on_line(bus, Framing::Ascii, line, &[], |config| config.frame_gap = gap(115_200));
    for n in 0..100 {
        let write = WriteRegisters::new(Register::r(n), [1, 2, 3]).unwrap();
        assert!(world.call(1, write).is_ok(), "write {n}");
    }
    assert_eq!(world.stats.station_stats(1).timeouts, 0);
}
