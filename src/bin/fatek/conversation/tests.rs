use std::time::Duration;

use bytes::Bytes;
use fatek::wire::Framing;
use proptest::prelude::*;

use super::*;

/// A frame of the ASCII framing.
fn ascii(content: &str) -> Vec<u8> {
    let mut frame = format!("\x02{content}").into_bytes();
    let sum = fatek::wire::ascii::lrc(&frame);
    frame.extend_from_slice(format!("{sum:02X}\x03").as_bytes());
    frame
}

/// A conversation in milliseconds: `>` to the PLC, `<` from it.
struct Talk {
    analysis: Analysis,
    entries: Vec<Entry>,
}

impl Talk {
    fn new() -> Self {
        Self { analysis: Analysis::new(None), entries: Vec::new() }
    }

    fn bytes(&mut self, millis: u64, direction: Direction, bytes: &[u8]) -> &mut Self {
        let change = Change::Bytes { direction, bytes: Bytes::copy_from_slice(bytes), is_datagram: false };
        let at = Duration::from_millis(millis);
        self.analysis.push(Event { connection: 1, at, change }, &mut self.entries);
        self
    }

    fn asks(&mut self, millis: u64, content: &str) -> &mut Self {
        self.bytes(millis, Direction::ToPlc, &ascii(content))
    }

    fn replies(&mut self, millis: u64, content: &str) -> &mut Self {
        self.bytes(millis, Direction::FromPlc, &ascii(content))
    }

    /// Ends it. Returns a line for each entry.
    #[track_caller]
    fn lines(&mut self) -> Vec<String> {
        self.analysis.finish(&mut self.entries);
        self.entries.iter().map(line).collect()
    }
}

fn line(entry: &Entry) -> String {
    let at = entry.at.as_millis();
    match &entry.found {
        Found::Exchange(exchange) => {
            let (text, attempt) = (exchange.text(), exchange.attempt);
            let outcome = match &exchange.outcome {
                Outcome::Answered(answer) => {
                    let verdict = match &answer.verdict {
                        Verdict::Values(values) => values.clone(),
                        Verdict::Refused(code) => format!("refused {code}"),
                        Verdict::Unknown => "unknown".to_owned(),
                        Verdict::Mismatch(rule) => format!("mismatch {rule}"),
                    };
                    let ambiguous = if answer.is_ambiguous { "ambiguous " } else { "" };
                    format!("{ambiguous}{verdict} after {}", answer.round_trip.as_millis())
                }
                Outcome::Unanswered => "unanswered".to_owned(),
                Outcome::Retried => "retried".to_owned(),
                Outcome::Broadcast => "broadcast".to_owned(),
            };
            format!("{at} #{attempt} {text}: {outcome}")
        }
        Found::Stray { reply, why } => format!("{at} {why:?} {}", reply.text()),
        Found::Bad { direction, bytes, .. } => format!("{at} bad {direction}: {}", bytes.escape_ascii()),
        Found::Missing { direction, count } => format!("{at} missing {direction}: {count}"),
    }
}

const R0: &str = "014601R00000";
const R1: &str = "014601R00001";

#[test]
fn requests_are_paired_with_replies_and_times() {
    let mut talk = Talk::new();
    talk.asks(5, R0).replies(12, "01460000A").asks(20, "024701R000000005");
    talk.replies(25, "02473").asks(30, "01411").replies(31, "01410");
    assert_eq!(
        talk.lines(),
        [
            "5 #1 read registers (46h) R0: 10 after 7",
            "20 #1 write registers (47h) R0 = 5: refused write prohibited, the PLC has a ROM pack (3) after 5",
            "30 #1 control RUN/STOP (41h) run: done after 1",
        ]
    );
}

#[test]
fn frames_in_any_pieces_are_whole_frames() {
    let mut talk = Talk::new();
    for (i, byte) in ascii(R0).into_iter().enumerate() {
        talk.bytes(i as u64, Direction::ToPlc, &[byte]);
    }
    // Two frames at once.
    talk.bytes(20, Direction::FromPlc, &[ascii("014600001"), ascii("014600002")].concat());
    assert_eq!(
        talk.lines(),
        ["15 #1 read registers (46h) R0: 1 after 5", "20 Unexpected read registers (46h) \"00002\""]
    );
}

#[test]
fn equal_requests_are_retries_and_copies_are_doubled() {
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(300, R0).replies(310, "014600001").replies(311, "014600001");
    // The reply to the first one comes late, with another value.
    talk.replies(400, "014600002");
    assert_eq!(
        talk.lines(),
        [
            "0 #1 read registers (46h) R0: retried",
            "300 #2 read registers (46h) R0: 1 after 10",
            "311 Doubled read registers (46h) \"00001\"",
            "400 Late(400ms) read registers (46h) \"00002\"",
        ]
    );
}

#[test]
fn a_reply_answers_the_oldest_request_that_it_fits() {
    // Pipelined, to two stations. Station 2 is faster.
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(1, "014602R00001").asks(2, "024601R00000");
    talk.replies(10, "024600003").replies(11, "0146000010002").asks(12, R1).replies(13, "014600009");
    assert_eq!(
        talk.lines(),
        [
            "2 #1 read registers (46h) R0: 3 after 8",
            // A station answers in order: the reply to the first is lost.
            "0 #1 read registers (46h) R0: unanswered",
            "1 #1 read registers (46h) R1 to R2: 1, 2 after 10",
            "12 #1 read registers (46h) R1: 9 after 1",
        ]
    );
}

/// Before: `R1: 1 after 301`, and each later reply for the request before its own.
#[test]
fn a_lost_reply_does_not_shift_the_others() {
    let mut talk = Talk::new();
    talk.asks(0, R0).replies(2, "014600009");
    // The reply to R0 is lost, and the client goes on after its timeout.
    talk.asks(10, R0).asks(310, R1).replies(311, "014600001");
    // A reply is damaged, and the client goes on at once.
    talk.asks(320, R0).bytes(321, Direction::FromPlc, b"\x02014600017FF\x03").asks(322, R1).replies(323, "014600002");
    // The capture lacks a reply.
    talk.asks(330, R0);
    let change = Change::Missing { direction: Direction::FromPlc, count: 13 };
    talk.analysis.push(Event { connection: 1, at: Duration::from_millis(331), change }, &mut talk.entries);
    talk.asks(332, R1).replies(333, "014600003");
    assert_eq!(
        talk.lines(),
        [
            "0 #1 read registers (46h) R0: 9 after 2",
            "10 #1 read registers (46h) R0: unanswered",
            "310 #1 read registers (46h) R1: 1 after 1",
            "321 bad from the PLC: \\x02014600017FF\\x03",
            "320 #1 read registers (46h) R0: unanswered",
            "322 #1 read registers (46h) R1: 2 after 1",
            "331 missing from the PLC: 13",
            "330 #1 read registers (46h) R0: unanswered",
            "332 #1 read registers (46h) R1: 3 after 1",
        ]
    );
}

/// Before: `R0: unanswered`, `R1: 10 after 60` and `Late(180ms) "0000B"`.
#[test]
fn replies_of_a_slow_station_are_paired_in_order() {
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(60, R1).replies(120, "01460000A").replies(180, "01460000B");
    assert_eq!(
        talk.lines(),
        ["0 #1 read registers (46h) R0: 10 after 120", "60 #1 read registers (46h) R1: 11 after 120"]
    );
    // With another request between the replies.
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(60, R1).replies(120, "01460000A").asks(121, "014601R00002").replies(180, "01460000B");
    talk.replies(240, "01460000C");
    assert_eq!(
        talk.lines(),
        [
            "0 #1 read registers (46h) R0: 10 after 120",
            "60 #1 read registers (46h) R1: 11 after 120",
            "121 #1 read registers (46h) R2: 12 after 119",
        ]
    );
    // Three are open, and a reply comes after the client has given its request up.
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(60, R1).asks(120, "014601R00002").replies(180, "01460000A").replies(240, "01460000B");
    talk.replies(300, "01460000C").asks(400, R0).asks(1000, R1).replies(1010, "01460000D").replies(1011, "01460000E");
    assert_eq!(
        talk.lines(),
        [
            "0 #1 read registers (46h) R0: 10 after 180",
            "60 #1 read registers (46h) R1: 11 after 180",
            "120 #1 read registers (46h) R2: 12 after 180",
            "400 #1 read registers (46h) R0: 13 after 610",
            "1000 #1 read registers (46h) R1: 14 after 11",
        ]
    );
}

/// Before: the value was that of R1 without a mark.
#[test]
fn a_reply_that_may_belong_to_two_requests_is_ambiguous() {
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(60, R1).replies(120, "01460000A");
    assert_eq!(
        talk.lines(),
        ["0 #1 read registers (46h) R0: unanswered", "60 #1 read registers (46h) R1: ambiguous 10 after 60"]
    );
    // A copy looks the same as an equal reply.
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(60, R1).replies(120, "01460000A").replies(121, "01460000A");
    let lines = talk.lines();
    assert!(lines.len() == 2 && lines.iter().all(|line| line.contains(": ambiguous 10 after ")), "{lines:?}");
    // Nothing tells for a long time; a silence ends it.
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(60, R1).replies(120, "01460000A");
    for number in 0..20 {
        talk.asks(121 + 60 * number, &format!("014601R{number:05}")).replies(180 + 60 * number, "01460000B");
    }
    talk.asks(3000, R0).replies(3060, "01460000C");
    let lines = talk.lines();
    let ambiguous = lines.iter().filter(|line| line.contains(": ambiguous ")).count();
    assert_eq!((lines.len(), ambiguous), (23, 21), "{lines:?}");
    assert_eq!(lines.last().unwrap(), "3000 #1 read registers (46h) R0: 12 after 60");
}

#[test]
fn round_trips_tell_whether_a_request_is_given_up() {
    // No round trip is known when the first reply is lost.
    let mut talk = Talk::new();
    talk.asks(0, R0);
    for number in 1..6 {
        talk.asks(300 + 20 * number, &format!("014601R{number:05}")).replies(301 + 20 * number, "014600001");
    }
    let lines = talk.lines();
    assert_eq!(lines.len(), 6, "{lines:?}");
    assert!(lines[0].ends_with("R0: unanswered"), "{lines:?}");
    assert!(lines[1..].iter().all(|line| line.ends_with(": 1 after 1")), "{lines:?}");
}

#[test]
fn requests_that_do_not_wait_are_answered_in_order() {
    // Two are open at any time; each takes 60 ms.
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(1, R1).replies(60, "014600000").asks(61, "014601R00002").replies(120, "014600001");
    talk.replies(180, "014600002");
    assert_eq!(
        talk.lines(),
        [
            "0 #1 read registers (46h) R0: 0 after 60",
            "1 #1 read registers (46h) R1: 1 after 119",
            "61 #1 read registers (46h) R2: 2 after 119",
        ]
    );
}

#[test]
fn replies_that_fit_nothing_are_told_apart() {
    let mut talk = Talk::new();
    talk.replies(0, "014600001").asks(10, R0).replies(15, "03460000A").replies(16, "0146000010002");
    talk.asks(20, R0).replies(21, "0144000").asks(30, R1);
    assert_eq!(
        talk.lines(),
        [
            "0 Unexpected read registers (46h) \"00001\"",
            "15 Unexpected read registers (46h) \"0000A\"",
            "10 #1 read registers (46h) R0: mismatch not a reply to this request: the data is too long after 6",
            "21 Unexpected read discretes (44h) \"000\"",
            "20 #1 read registers (46h) R0: unanswered",
            "30 #1 read registers (46h) R1: unanswered",
        ]
    );
}

#[test]
fn broadcasts_and_wrong_requests_are_exchanges() {
    let mut talk = Talk::new();
    talk.asks(0, "00410").asks(1, "0199").replies(2, "01994").asks(3, "014600R00000").replies(4, "01464");
    let lines = talk.lines();
    assert_eq!(lines[0], "0 #1 control RUN/STOP (41h) stop: broadcast");
    assert_eq!(lines[1], "1 #1 command 99h: unknown after 1");
    assert!(lines[2].ends_with(": unknown after 1"), "{lines:?}");
    let rules: Vec<bool> = talk
        .entries
        .iter()
        .filter_map(|entry| match &entry.found {
            Found::Exchange(exchange) => Some(exchange.decoded.is_err() && exchange.may_write()),
            Found::Stray { .. } | Found::Bad { .. } | Found::Missing { .. } => None,
        })
        .collect();
    assert_eq!(rules, [false, true, true], "a request that is not known may write");
}

#[test]
fn bad_and_missing_bytes_do_not_stop_the_rest() {
    let mut talk = Talk::new();
    let mut broken = ascii(R0);
    broken[8] ^= 1;
    talk.bytes(0, Direction::ToPlc, &broken).bytes(1, Direction::FromPlc, b"\x06\x15");
    talk.bytes(2, Direction::ToPlc, &ascii(R0)[..7]);
    let missing = Change::Missing { direction: Direction::ToPlc, count: 9 };
    let at = Duration::from_millis(3);
    talk.analysis.push(Event { connection: 1, at, change: missing }, &mut talk.entries);
    talk.asks(4, R1).replies(5, "014600001");
    let lines = talk.lines();
    assert!(lines[0].starts_with("0 bad to the PLC: \\x02014601R"), "{lines:?}");
    assert_eq!(
        lines[1..],
        [
            "1 bad from the PLC: \\x06\\x15",
            "3 bad to the PLC: \\x02014601",
            "3 missing to the PLC: 9",
            "4 #1 read registers (46h) R1: 1 after 1",
        ]
    );
}

#[test]
fn an_incomplete_frame_ends_after_a_pause() {
    // The header announces 256 bytes.
    let (stop, done) =
        (b"\x51\x10\x00\x03\x01\x41\x00\x45\xE7\x55\xAA", b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA");
    let crc = fatek::wire::binary::crc(&stop[2..7]).to_le_bytes();
    let stop = [&stop[..7], &crc, b"\x55\xAA"].concat();
    let mut talk = Talk::new();
    talk.bytes(0, Direction::ToPlc, b"\x51\x10\x01\x00\x01").bytes(3000, Direction::ToPlc, &stop);
    talk.bytes(3005, Direction::FromPlc, done);
    let lines = talk.lines();
    assert_eq!(lines.len(), 2, "{lines:?}");
    assert!(lines[0].starts_with("0 bad to the PLC: Q\\x10"), "{lines:?}");
    assert_eq!(lines[1], "3000 #1 control RUN/STOP (41h) stop: done after 5");
}

#[test]
fn requests_without_end_are_given_up() {
    let mut talk = Talk::new();
    talk.asks(0, R0).asks(31_000, R1);
    assert_eq!(talk.entries.len(), 1, "after half a minute");
    for number in 0..1000_u64 {
        talk.asks(31_000 + number, &format!("014601R{number:05}"));
    }
    // The 32 last are open, and one was given up before.
    assert!(talk.entries.len() > 900, "{}", talk.entries.len());
    assert_eq!(talk.lines().len(), 1002);
}

#[test]
fn connections_without_end_are_bounded() {
    let (mut analysis, mut entries) = (Analysis::new(None), Vec::new());
    for connection in 1..=10_000 {
        let bytes = Bytes::from(ascii(R0));
        let change = Change::Bytes { direction: Direction::ToPlc, bytes, is_datagram: false };
        analysis.push(Event { connection, at: Duration::ZERO, change }, &mut entries);
    }
    assert_eq!((analysis.connections.len(), entries.len()), (MAX_CONNECTIONS, 10_000 - MAX_CONNECTIONS));
}

proptest! {
    /// All bytes of a conversation are in its entries, in any pieces.
    #[test]
    fn no_byte_is_lost_or_invented(
        bytes in proptest::collection::vec(
            prop_oneof![
                4 => Just(ascii(R0)),
                2 => Just(ascii("01460000A")),
                1 => Just(b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA".to_vec()),
                2 => proptest::collection::vec(any::<u8>(), 1..20),
                1 => Just(ascii(R1)[..9].to_vec()),
            ],
            1..20,
        ),
        cut in 1_usize..50,
        to_plc: bool,
        framing in proptest::sample::select(vec![None, Some(Framing::Ascii), Some(Framing::Binary)]),
    ) {
        let all = bytes.concat();
        let direction = if to_plc { Direction::ToPlc } else { Direction::FromPlc };
        let mut talk = Talk { analysis: Analysis::new(framing), entries: Vec::new() };
        for piece in all.chunks(cut) {
            talk.bytes(1, direction, piece);
        }
        talk.lines();
        let found: usize = talk.entries.iter().map(|entry| match &entry.found {
            Found::Exchange(exchange) => exchange.request.bytes.len() + match &exchange.outcome {
                Outcome::Answered(answer) => answer.reply.bytes.len(),
                Outcome::Unanswered | Outcome::Retried | Outcome::Broadcast => 0,
            },
            Found::Stray { reply, .. } => reply.bytes.len(),
            Found::Bad { bytes, .. } => bytes.len(),
            Found::Missing { .. } => 0,
        }).sum();
        prop_assert_eq!(found, all.len());
    }
}
