//! What is said when.

use super::*;

#[test]
fn a_late_reply_is_not_overtaken_by_the_same_station_and_does_not_hold_up_another() {
    let mut talk = Talk::of([Rule::new(delay_ms(1000, 1000)).station(1).times(1)]);
    talk.hear(0, READ);
    talk.hear(10, SET);
    talk.hear(20, READ_2);
    talk.hear(30, READ);
    assert_eq!(talk.r0(), 0, "the station is busy");
    assert_eq!(
        talk.all(),
        [at(20_000, READS_2), at(1_000_000, READS_0), at(1_000_000, IS_SET), at(1_000_000, READS_5)]
    );
}

#[test]
fn a_late_reply_tells_how_things_were() {
    let mut talk = Talk::of([Rule::new(delay_ms(500, 500))]);
    talk.hear(0, READ);
    talk.plcs[0].write(register!("R0"), 5_u16).unwrap();
    talk.hear(1, READ);
    assert_eq!(talk.all(), [at(500_000, READS_0), at(1_000_000, READS_5)]);
}

#[test]
fn a_station_is_as_busy_for_every_connection() {
    let mut talk = Talk::of([Rule::new(delay_ms(100, 100)).times(1)]);
    let mut other = talk.join();
    talk.hear(0, READ);
    other.hear(10, SET);
    assert_eq!(talk.r0(), 0);
    assert_eq!(other.all(), [at(100_000, IS_SET)]);
    assert_eq!(talk.all(), [at(100_000, READS_0)]);
}

#[test]
fn delays_are_between_the_two_and_differ() {
    let mut talk = Talk::of([Rule::new(delay_ms(5, 25))]);
    for nth in 0..1000 {
        talk.hear(100 * nth, READ);
    }
    let delays: Vec<_> = (0..).zip(talk.all()).map(|(nth, (us, _))| us - 100_000 * nth).collect();
    let (min, max) = (delays.iter().min().unwrap(), delays.iter().max().unwrap());
    assert!((5000..5200).contains(min) && (24_800..=25_000).contains(max), "{min} to {max}");
}

#[test]
fn a_delay_the_wrong_way_round_is_the_shorter_one() {
    assert_eq!(under(delay_ms(25, 5), READ), [at(5000, READS_0)]);
}

#[test]
fn no_time_is_so_long_that_it_cannot_be_told() {
    let longest = Fault::Delay { min: Duration::MAX, max: Duration::MAX };
    assert_eq!(under(longest, READ), [at(86_400_000_000, READS_0)]);
    let split = Fault::Split { pieces: 3, pause: Duration::MAX };
    assert_eq!(under(split, READ).len(), 3);
    let mut talk = Talk::over(Line::new(1).bits_per_character(u32::MAX).turnaround(Duration::MAX, Duration::MAX));
    talk.hear(0, READ);
    assert_eq!(talk.all(), [at(3 * 86_400_000_000, READS_0)]);
    assert_eq!(Line::new(1).bits_per_character(u32::MAX).transmission(usize::MAX), Duration::from_nanos(u64::MAX));
}

#[test]
fn transmission_is_by_the_characters() {
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
fn request_turnaround_and_reply_take_their_time() {
    let turnaround = Duration::from_millis(5);
    let mut talk = Talk::over(Line::new(1000).turnaround(turnaround, turnaround));
    talk.hear(0, SET);
    talk.wait(204);
    assert_eq!(talk.r0(), 0);
    talk.wait(205);
    assert_eq!(talk.r0(), 5, "20 characters of 10 ms, and 5 ms");
    assert_eq!(talk.all(), [at(295_000, IS_SET)], "9 characters of 10 ms");
}

#[test]
fn the_turnaround_is_between_the_two_and_differs() {
    let line = Line::default().turnaround(Duration::from_millis(1), Duration::from_millis(20));
    let mut talk = Talk::over(line);
    for nth in 0..1000 {
        talk.hear(100 * nth, READ);
    }
    let turnarounds: Vec<_> = (0..).zip(talk.all()).map(|(nth, (us, _))| us - 100_000 * nth).collect();
    assert!(turnarounds.iter().all(|us| (1000..=20_000).contains(us)));
    let mean = turnarounds.iter().sum::<u128>() / 1000;
    assert!((10_000..11_000).contains(&mean), "{mean}");
}

#[test]
fn the_line_carries_one_request_and_one_reply_at_a_time() {
    // Requests of 160 ms each, replies of 130 ms each.
    let mut talk = Talk::over(Line::new(1000));
    let mut other = talk.join();
    talk.hear(0, &[READ, READ_2].concat());
    other.hear(10, READ); // behind the two
    assert_eq!(talk.all(), [at(290_000, READS_0), at(450_000, READS_2)]);
    assert_eq!(other.all(), [at(610_000, READS_0)]);

    let mut talk = Talk::of([Rule::new(delay_ms(1000, 1000)).station(1), Rule::new(delay_ms(840, 840)).station(2)]);
    talk.faults.set_line(Line::new(1000));
    talk.hear(0, &[READ, READ_2].concat());
    assert_eq!(talk.all(), [at(1_290_000, READS_0), at(1_420_000, READS_2)], "both were ready at 1160 ms");
}

#[test]
fn another_line_is_for_the_requests_that_come_then() {
    let mut talk = Talk::over(Line::new(1000));
    talk.hear(0, READ);
    talk.faults.set_line(Line::default());
    talk.hear(1000, READ);
    assert_eq!(talk.all(), [at(290_000, READS_0), at(1_000_000, READS_0)]);
}

#[test]
fn noise_takes_its_time_too() {
    let mut talk = Talk::over(Line::new(1000));
    talk.hear(0, &[b"noise", READ].concat());
    assert_eq!(talk.all(), [at(340_000, READS_0)]);
}

#[test]
fn an_echo_ends_with_the_request() {
    let mut talk = Talk::of([Rule::new(Fault::Echo)]);
    talk.faults.set_line(Line::new(1000));
    talk.hear(0, READ);
    assert_eq!(talk.all(), [at(160_000, READ), at(290_000, READS_0)]);
}

#[test]
fn byte_by_byte_every_byte_comes_at_its_time() {
    let mut talk = Talk::over(Line::new(1000).byte_by_byte());
    talk.hear(0, READ);
    let (times, bytes): (Vec<_>, Vec<_>) = talk.all().into_iter().unzip();
    assert_eq!(times, (17..=29).map(|n| n * 10_000).collect::<Vec<_>>());
    assert_eq!(bytes.concat(), text(READS_0));
}

#[test]
fn pauses_and_speed_add_up() {
    let mut talk = Talk::of([Rule::new(Fault::Split { pieces: 2, pause: Duration::from_millis(7) })]);
    talk.faults.set_line(Line::new(1000));
    talk.hear(0, READ);
    assert_eq!(talk.all(), [at(220_000, b"\x0201460"), at(297_000, b"0000BD\x03")]);
}

#[test]
fn a_broadcast_waits_at_each_station_for_its_turn() {
    let mut talk = Talk::of([Rule::new(delay_ms(100, 100)).station(1)]);
    talk.hear(0, READ);
    talk.hear(1, BROADCAST_7);
    assert_eq!((talk.r0(), talk.plcs[1].read(element!("R0"))), (0, Value::Word(7)));
    talk.wait(100);
    assert_eq!(talk.r0(), 7);
}

#[test]
fn a_connection_has_a_bound_on_what_is_under_way() {
    let mut talk = Talk::of([Rule::new(delay_ms(10, 10))]);
    for _ in 0..MAX_EVENTS {
        assert!(talk.conversation.has_room());
        talk.hear(0, READ);
    }
    assert!(!talk.conversation.has_room());
    talk.wait(10);
    assert!(talk.conversation.has_room());
}

#[test]
fn equal_seeds_and_requests_give_equal_faults() {
    let said = |seed, interleaved: bool| {
        let mut talk = Talk::new(Faults::new(seed));
        talk.faults.set_rules([
            Rule::new(Fault::DropReply).per_mille(100),
            Rule::new(delay_ms(1, 50)).one_in(3),
            Rule::new(Fault::GarbageBefore { max_len: 5 }).station(1).one_in(4),
            Rule::new(Fault::GarbageInside { max_len: 5 }).one_in(5),
        ]);
        for nth in 0..300 {
            talk.hear(1000 * nth, READ);
            if interleaved && nth % 3 == 0 {
                talk.hear(1000 * nth + 500, READ_2);
            }
        }
        talk.all()
    };
    assert_eq!(said(3, false), said(3, false));
    assert_ne!(said(3, false), said(4, false));
    // What befalls station 1 does not depend on station 2.
    let mut interleaved = said(3, true);
    interleaved.retain(|(us, _)| us % 1_000_000 < 500_000);
    assert_eq!(interleaved, said(3, false));
}
