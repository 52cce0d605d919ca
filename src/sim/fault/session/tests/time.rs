//! Times of execution, transmission and delivery.

use super::*;

#[test]
fn a_late_reply_delays_its_own_station_only() {
    let mut bench = Bench::of([Rule::new(delay_ms(1000, 1000)).station(1).times(1)]);
    bench.receive(0, READ);
    bench.receive(10, SET);
    bench.receive(20, READ_2);
    bench.receive(30, READ);
    assert_eq!(bench.r0(), 0, "the station is busy");
    assert_eq!(bench.all(), [at(20_000, IS_0_OF_2), at(1_000_000, IS_0), at(1_000_000, IS_SET), at(1_000_000, IS_5)]);
}

#[test]
fn a_late_reply_has_the_values_of_its_execution() {
    let mut bench = Bench::of([Rule::new(delay_ms(500, 500))]);
    bench.receive(0, READ);
    bench.plcs[0].write(register!("R0"), 5_u16).unwrap();
    bench.receive(1, READ);
    assert_eq!(bench.all(), [at(500_000, IS_0), at(1_000_000, IS_5)]);
}

#[test]
fn a_station_is_busy_for_all_connections() {
    let mut bench = Bench::of([Rule::new(delay_ms(100, 100)).times(1)]);
    let mut other = bench.connect();
    bench.receive(0, READ);
    other.receive(10, SET);
    assert_eq!(bench.r0(), 0);
    assert_eq!(other.all(), [at(100_000, IS_SET)]);
    assert_eq!(bench.all(), [at(100_000, IS_0)]);
}

#[test]
fn delays_are_drawn_between_min_and_max() {
    let mut bench = Bench::of([Rule::new(delay_ms(5, 25))]);
    for nth in 0..1000 {
        bench.receive(100 * nth, READ);
    }
    let delays: Vec<_> = (0..).zip(bench.all()).map(|(nth, (us, _))| us - 100_000 * nth).collect();
    let (min, max) = (delays.iter().min().unwrap(), delays.iter().max().unwrap());
    assert!((5000..5200).contains(min) && (24_800..=25_000).contains(max), "{min} to {max}");
}

#[test]
fn a_delay_with_max_below_min_is_the_shorter() {
    assert_eq!(under(delay_ms(25, 5), READ), [at(5000, IS_0)]);
}

#[test]
fn all_times_are_limited_to_a_day() {
    let longest = Fault::Delay { min: Duration::MAX, max: Duration::MAX };
    assert_eq!(under(longest, READ), [at(86_400_000_000, IS_0)]);
    let split = Fault::Split { pieces: 3, pause: Duration::MAX };
    assert_eq!(under(split, READ).len(), 3);
    let mut bench = Bench::over(Line::new(1).bits_per_character(u32::MAX).response_time(Duration::MAX, Duration::MAX));
    bench.receive(0, READ);
    assert_eq!(bench.all(), [at(3 * 86_400_000_000, IS_0)]);
    assert_eq!(Line::new(1).bits_per_character(u32::MAX).transmission(usize::MAX), Duration::from_nanos(u64::MAX));
}

#[test]
fn transmission_time_follows_from_the_characters() {
    for (line, bytes, us) in [
        (Line::new(9600), 96, 100_000),
        (Line::new(9600), 1, 1041),
        (Line::new(9600).bits_per_character(11), 96, 110_000),
        (Line::new(115_200), 1152, 100_000),
        (Line::new(115_200), 0, 0),
        (Line::new(0), 1_000_000, 0),
        (Line::default(), 1_000_000, 0),
    ] {
        assert_eq!(line.transmission(bytes).as_micros(), us, "{line:?}");
    }
}

#[test]
fn request_response_time_and_reply_add_up() {
    let response_time = Duration::from_millis(5);
    let mut bench = Bench::over(Line::new(1000).response_time(response_time, response_time));
    bench.receive(0, SET);
    bench.wait(204);
    assert_eq!(bench.r0(), 0);
    bench.wait(205);
    assert_eq!(bench.r0(), 5, "20 characters of 10 ms, and 5 ms");
    assert_eq!(bench.all(), [at(295_000, IS_SET)], "9 characters of 10 ms");
}

#[test]
fn response_times_are_drawn_between_min_and_max() {
    let line = Line::default().response_time(Duration::from_millis(1), Duration::from_millis(20));
    let mut bench = Bench::over(line);
    for nth in 0..1000 {
        bench.receive(100 * nth, READ);
    }
    let times: Vec<_> = (0..).zip(bench.all()).map(|(nth, (us, _))| us - 100_000 * nth).collect();
    assert!(times.iter().all(|us| (1000..=20_000).contains(us)));
    let mean = times.iter().sum::<u128>() / 1000;
    assert!((10_000..11_000).contains(&mean), "{mean}");
}

#[test]
fn the_line_carries_one_request_and_one_reply_at_a_time() {
    // Requests of 160 ms each, replies of 130 ms each.
    let mut bench = Bench::over(Line::new(1000));
    let mut other = bench.connect();
    bench.receive(0, &[READ, READ_2].concat());
    other.receive(10, READ); // transmitted behind the two
    assert_eq!(bench.all(), [at(290_000, IS_0), at(450_000, IS_0_OF_2)]);
    assert_eq!(other.all(), [at(610_000, IS_0)]);

    let mut bench = Bench::of([Rule::new(delay_ms(1000, 1000)).station(1), Rule::new(delay_ms(840, 840)).station(2)]);
    bench.faults.set_line(Line::new(1000));
    bench.receive(0, &[READ, READ_2].concat());
    assert_eq!(bench.all(), [at(1_290_000, IS_0), at(1_420_000, IS_0_OF_2)], "both were ready at 1160 ms");
}

#[test]
fn a_new_line_applies_to_later_requests() {
    let mut bench = Bench::over(Line::new(1000));
    bench.receive(0, READ);
    bench.faults.set_line(Line::default());
    bench.receive(1000, READ);
    assert_eq!(bench.all(), [at(290_000, IS_0), at(1_000_000, IS_0)]);
}

#[test]
fn noise_takes_transmission_time() {
    let mut bench = Bench::over(Line::new(1000));
    bench.receive(0, &[b"noise", READ].concat());
    assert_eq!(bench.all(), [at(340_000, IS_0)]);
}

#[test]
fn an_echo_comes_at_the_end_of_its_request() {
    let mut bench = Bench::of([Rule::new(Fault::Echo)]);
    bench.faults.set_line(Line::new(1000));
    bench.receive(0, READ);
    assert_eq!(bench.all(), [at(160_000, READ), at(290_000, IS_0)]);
}

#[test]
fn byte_by_byte_delivers_each_byte_at_its_time() {
    let mut bench = Bench::over(Line::new(1000).byte_by_byte(true));
    bench.receive(0, READ);
    let (times, bytes): (Vec<_>, Vec<_>) = bench.all().into_iter().unzip();
    assert_eq!(times, (17..=29).map(|n| n * 10_000).collect::<Vec<_>>());
    assert_eq!(bytes.concat(), text(IS_0));
}

#[test]
fn pauses_and_speed_add_up() {
    let mut bench = Bench::of([Rule::new(Fault::Split { pieces: 2, pause: Duration::from_millis(7) })]);
    bench.faults.set_line(Line::new(1000));
    bench.receive(0, READ);
    assert_eq!(bench.all(), [at(220_000, b"\x0201460"), at(297_000, b"0000BD\x03")]);
}

#[test]
fn a_broadcast_waits_for_busy_stations() {
    let mut bench = Bench::of([Rule::new(delay_ms(100, 100)).station(1)]);
    bench.receive(0, READ);
    bench.receive(1, BROADCAST_7);
    assert_eq!((bench.r0(), bench.plcs[1].read(element!("R0"))), (0, Value::Word(7)));
    bench.wait(100);
    assert_eq!(bench.r0(), 7);
}

#[test]
fn requests_in_progress_are_bounded_per_connection() {
    let mut bench = Bench::of([Rule::new(delay_ms(10, 10))]);
    for _ in 0..MAX_EVENTS {
        assert!(bench.session.has_room());
        bench.receive(0, READ);
    }
    assert!(!bench.session.has_room());
    bench.wait(10);
    assert!(bench.session.has_room());
}

#[test]
fn equal_seeds_and_requests_give_equal_faults() {
    let sent = |seed, interleaved: bool| {
        let mut bench = Bench::new(Faults::new(seed));
        bench.faults.set_rules([
            Rule::new(Fault::DropReply).per_mille(100),
            Rule::new(delay_ms(1, 50)).one_in(3),
            Rule::new(Fault::GarbageBefore { max_len: 5 }).station(1).one_in(4),
            Rule::new(Fault::GarbageInside { max_len: 5 }).one_in(5),
        ]);
        for nth in 0..300 {
            bench.receive(1000 * nth, READ);
            if interleaved && nth % 3 == 0 {
                bench.receive(1000 * nth + 500, READ_2);
            }
        }
        bench.all()
    };
    assert_eq!(sent(3, false), sent(3, false));
    assert_ne!(sent(3, false), sent(4, false));
    // The faults of station 1 do not depend on requests to station 2.
    let mut interleaved = sent(3, true);
    interleaved.retain(|(us, _)| us % 1_000_000 < 500_000);
    assert_eq!(interleaved, sent(3, false));
}

#[test]
fn a_half_duplex_line_carries_one_frame_at_a_time() {
    // A request takes 16 ms, and a reply 13 ms.
    for (half_duplex, second) in [(false, 20_000 + 16_000 + 13_000), (true, 2 * (16_000 + 13_000))] {
        let mut bench = Bench::over(Line::new(10_000).half_duplex(half_duplex));
        let mut other = bench.connect();
        bench.receive(0, READ);
        bench.wait(20);
        other.receive(20, READ_2);
        assert_eq!(bench.all(), [at(29_000, IS_0)], "half-duplex: {half_duplex}");
        assert_eq!(other.all(), [at(second, IS_0_OF_2)], "half-duplex: {half_duplex}");
    }
}

#[test]
fn a_reply_waits_for_a_request_on_a_half_duplex_line() {
    let line = Line::new(10_000).response_time(Duration::from_millis(5), Duration::from_millis(5));
    for (half_duplex, first, second) in [(false, 34_000, 50_000), (true, 45_000, 58_000)] {
        let mut bench = Bench::over(line.half_duplex(half_duplex));
        let mut other = bench.connect();
        bench.receive(0, READ);
        other.receive(0, READ_2);
        // The second request is on the line from 16 to 32 ms, and the first reply is ready at 21 ms.
        assert_eq!(bench.all(), [at(first, IS_0)], "half-duplex: {half_duplex}");
        assert_eq!(other.all(), [at(second, IS_0_OF_2)], "half-duplex: {half_duplex}");
    }
}
