use super::*;

/// Reply to a read of R12 to R14, from the manual.
const READ: &[u8] = b"\x020146010A57FC4000189\x03";
/// Reply to RUN.
const DONE: &[u8] = b"\x0201410F8\x03";
/// Reply to a read of one register, 1234h.
const READ_BINARY: &[u8] = b"\x52\x10\x00\x05\x01\x46\x00\x12\x34\x3E\xAA\x55\xAA";
/// Reply to a loop-back without data.
const EMPTY: &[u8] = b"\x02014EDC\x03";
const EMPTY_BINARY: &[u8] = b"\x52\x10\x00\x02\x01\x4E\x20\x40\x55\xAA";

#[test]
fn a_reply_without_faults_is_unchanged() {
    for (reply, framing) in [(READ, Framing::Ascii), (EMPTY, Framing::Ascii)] {
        assert_eq!(corrupted(reply, framing, &[]), reply);
    }
    for reply in [READ_BINARY, EMPTY_BINARY] {
        assert_eq!(frames(reply, Framing::Binary).len(), 1, "{}", reply.escape_ascii());
        assert_eq!(corrupted(reply, Framing::Binary, &[]), reply);
    }
}

#[test]
fn wrong_station_is_the_next_with_a_good_checksum() {
    assert_ascii(READ, &[Fault::WrongStation], b"\x020246010A57FC400018A\x03");
    assert_ascii(b"\x02FE41022\x03", &[Fault::WrongStation], b"\x0201410F8\x03");
    assert_binary(READ_BINARY, &[Fault::WrongStation], b"\x52\x10\x00\x05\x02\x46\x00\x12\x34\x7A\xAA\x55\xAA");
}

#[test]
fn wrong_command_is_the_next_with_a_good_checksum() {
    assert_ascii(DONE, &[Fault::WrongCommand], b"\x0201420F9\x03");
    assert_eq!([0x40, 0x49, 0x4E, 0x50, 0x53].map(next_command), [0x41, 0x4E, 0x4F, 0x53, 0x40]);
    assert_eq!(
        [0x4A, 0x99, 0xFF].map(next_command),
        [0x4B, 0x9A, 0x00],
        "the code after an unknown one is the next number"
    );
}

#[test]
fn a_wrong_length_has_a_good_checksum() {
    assert_ascii(READ, &[Fault::Truncated { by: 4 }], b"\x020146010A57FC4C8\x03");
    assert_ascii(READ, &[Fault::Extended { by: 4 }], b"\x020146010A57FC40001000049\x03");
    assert_ascii(DONE, &[Fault::Truncated { by: usize::MAX }], b"\x020141C8\x03");
    assert_binary(READ_BINARY, &[Fault::Truncated { by: 1 }], b"\x52\x10\x00\x04\x01\x46\x00\x12\x91\xFF\x55\xAA");
    assert_binary(
        READ_BINARY,
        &[Fault::Extended { by: 2 }],
        b"\x52\x10\x00\x07\x01\x46\x00\x12\x34\x00\x00\x11\xC6\x55\xAA",
    );
    assert_eq!(
        corrupted(DONE, Framing::Ascii, &[Fault::Extended { by: usize::MAX }]).len(),
        DONE.len() + MAX_FRAME_LEN
    );
}

#[test]
fn bad_checksum_changes_the_value_only() {
    assert_ascii(READ, &[Fault::BadChecksum], b"\x020146010A57FC4000089\x03");
    assert_ascii(DONE, &[Fault::BadChecksum], b"\x0201411F8\x03");
    assert_ascii(b"\x0201460000ACE\x03", &[Fault::BadChecksum], b"\x0201460000FCE\x03");
    assert_ascii(EMPTY, &[Fault::BadChecksum], b"\x02014EDB\x03");
    assert_binary(READ_BINARY, &[Fault::BadChecksum], b"\x52\x10\x00\x05\x01\x46\x00\x12\x35\x3E\xAA\x55\xAA");
    assert_binary(EMPTY_BINARY, &[Fault::BadChecksum], b"\x52\x10\x00\x02\x01\x4E\x21\x40\x55\xAA");
    for last in 0..=0xF_u8 {
        let digit = char::from_digit(last.into(), 16).unwrap().to_ascii_uppercase();
        let mut reply = BytesMut::new();
        ascii::emit(&mut reply, 1, 0x46, |data| data.raw(format!("0000{digit}").as_bytes()));
        let bad = corrupted(&reply, Framing::Ascii, &[Fault::BadChecksum]);
        let changed = bad[bad.len() - 4];
        assert!(changed.is_ascii_hexdigit() && !changed.is_ascii_lowercase(), "{digit} became {changed}");
        assert!(frames(&bad, Framing::Ascii).is_empty());
    }
}

#[test]
fn a_duplicate_lacks_only_the_garbage_before_the_reply() {
    let faults = [Fault::GarbageBefore { max_len: 4 }, Fault::BadChecksum];
    let CorruptedReply { reply, duplicate } =
        corrupt(DONE.into(), Framing::Ascii, &faults, &mut FaultRng::new(1, 2, 3));
    assert_eq!(text(&duplicate), text(b"\x0201411F8\x03"));
    assert!(reply.ends_with(&duplicate) && reply.len() > duplicate.len());
}

#[test]
fn a_dropped_reply_is_empty_and_a_cut_one_is_half() {
    assert_ascii(READ, &[Fault::DropReply], b"");
    assert_ascii(READ, &[Fault::Disconnect(DisconnectAt::BeforeReply)], b"");
    assert_ascii(READ, &[Fault::Disconnect(DisconnectAt::WithinReply)], &READ[..10]);
    assert_ascii(READ, &[Fault::Disconnect(DisconnectAt::AfterReply)], READ);
}

#[test]
fn garbage_inside_keeps_all_bytes_and_leaves_no_good_frame() {
    for (reply, framing) in [(READ, Framing::Ascii), (READ_BINARY, Framing::Binary)] {
        for seed in 0..2000 {
            let changed =
                corrupt(reply.into(), framing, &[Fault::GarbageInside { max_len: 8 }], &mut FaultRng::new(seed, 0, 0))
                    .reply;
            assert_eq!(frames(&changed, framing), [], "seed {seed}: {}", changed.escape_ascii());
            let extra = changed.len() - reply.len();
            assert!((1..=8).contains(&extra));
            let inside =
                (1..reply.len()).any(|at| changed.starts_with(&reply[..at]) && changed.ends_with(&reply[at..]));
            assert!(inside, "seed {seed}: {}", changed.escape_ascii());
        }
    }
}

#[test]
fn garbage_before_adds_no_frame_and_keeps_the_reply() {
    let mut hidden = 0;
    for (reply, framing) in [(READ, Framing::Ascii), (READ_BINARY, Framing::Binary)] {
        let sent = frames(reply, framing);
        for seed in 0..2000 {
            let changed =
                corrupt(reply.into(), framing, &[Fault::GarbageBefore { max_len: 20 }], &mut FaultRng::new(seed, 0, 0))
                    .reply;
            assert!(changed.ends_with(reply));
            assert!((1..=20).contains(&(changed.len() - reply.len())));
            let found = frames(&changed, framing);
            assert!(found == sent || found.is_empty(), "seed {seed}: {}", changed.escape_ascii());
            hidden += usize::from(found.is_empty());
        }
    }
    assert_eq!(hidden, 0, "every frame is found at the end of the input");
}

#[test]
fn garbage_has_1_to_1024_bytes() {
    let longest = |max_len| {
        let lens = (0..200).map(|seed| {
            let fault = [Fault::GarbageBefore { max_len }];
            corrupt(DONE.into(), Framing::Ascii, &fault, &mut FaultRng::new(seed, 0, 0)).reply.len() - DONE.len()
        });
        lens.fold((usize::MAX, 0), |(min, max), len| (min.min(len), max.max(len)))
    };
    assert_eq!(longest(0), (1, 1));
    assert_eq!(longest(1), (1, 1));
    assert_eq!(longest(3), (1, 3));
    assert!(longest(usize::MAX).1 <= MAX_FRAME_LEN);
}

#[test]
fn the_order_of_faults_does_not_change_the_reply() {
    let faults = [Fault::GarbageBefore { max_len: 1 }, Fault::Truncated { by: 8 }, Fault::WrongStation];
    let mut reversed = faults.clone();
    reversed.reverse();
    let spoilt_reply = corrupted(READ, Framing::Ascii, &faults);
    assert_eq!(text(&spoilt_reply[1..]), text(b"\x020246010A5D5\x03"));
    assert_eq!(spoilt_reply, corrupted(READ, Framing::Ascii, &reversed));
}

fn assert_ascii(reply: &[u8], faults: &[Fault], expected: &[u8]) {
    assert_eq!(text(&corrupted(reply, Framing::Ascii, faults)), text(expected));
}

fn assert_binary(reply: &[u8], faults: &[Fault], expected: &[u8]) {
    assert_eq!(text(&corrupted(reply, Framing::Binary, faults)), text(expected));
}

fn corrupted(reply: &[u8], framing: Framing, faults: &[Fault]) -> Bytes {
    corrupt(reply.into(), framing, faults, &mut FaultRng::new(1, 2, 3)).reply
}

fn text(bytes: &[u8]) -> String {
    bytes.escape_ascii().to_string()
}
