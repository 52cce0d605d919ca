//! Each spelling is executed by a simulated PLC: its reply brings the values that were asked for.

use bytes::BytesMut;
use tokio_util::codec::Decoder;

use super::*;
use crate::command::framing::{decode_spelled, encode_reply, encode_spelled};
use crate::command::{ReadDisabled, ReadDiscretes, ReadRegisters, Request, WriteDiscretes, WriteRegisters};
use crate::element::{Discrete, Register, Register32, Symbol};
use crate::sim::Plc;
use crate::wire::{Codec, Side};

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

fn dr(address: u16) -> Register32 {
    Register32::new(Symbol::DR, address).unwrap()
}

fn m(address: u16) -> Discrete {
    Discrete::new(Symbol::M, address).unwrap()
}

/// Sends a request in a spelling. Returns its bytes, those of the reply, and the values.
fn exchange<C: Command>(plc: &Plc, command: &C, spelling: Spelling, framing: Framing) -> (usize, usize, C::Reply) {
    let (mut sent, mut reply) = (BytesMut::new(), BytesMut::new());
    encode_spelled(command, spelling, framing, 1, &mut sent);
    let bytes = sent.len();
    let frame = Codec::new(framing, Side::Plc).decode(&mut sent).unwrap().unwrap().frame().unwrap();
    let request = Request::decode(&frame, framing).unwrap();
    crate::command::with_command!(&request, request => {
        let done = plc.execute(request);
        encode_reply(request, done.as_ref().map_err(|error| *error), framing, 1, &mut reply);
    });
    let reply_bytes = reply.len();
    let frame = Codec::new(framing, Side::Client).decode(&mut reply).unwrap().unwrap().frame().unwrap();
    (bytes, reply_bytes, decode_spelled(command, spelling, framing, &frame.data).unwrap())
}

/// Checks all spellings of a read. Returns how many there are besides the plain one.
fn check_read<V: PartialEq + std::fmt::Debug, C: Command<Reply = Vec<V>>>(
    plc: &Plc,
    read: &C,
    longer: bool,
    framing: Framing,
) -> usize {
    let (sent, received, values) = exchange(plc, read, read.plain(), framing);
    let candidates = read.candidates(longer, framing);
    // The link distinguishes replies by their size.
    let size = |spelling| usize::try_from(read.reply_size(spelling, framing)).unwrap();
    assert_eq!(size(read.plain()), received - framing.reply_overhead(), "{read:?} in {framing:?}");
    for Candidate { spelling, extra, more_bytes, left, units } in candidates.into_iter().flatten() {
        let (sent_now, received_now, some) = exchange(plc, read, spelling, framing);
        let context = format!("{read:?} as {spelling:?} in {framing:?}");
        assert_eq!(some, values[..values.len() - usize::from(left)], "{context}");
        assert_eq!(size(spelling), received_now - framing.reply_overhead(), "{context}");
        assert_eq!((sent_now + received_now).saturating_sub(sent + received), more_bytes, "{context}");
        assert!(left == 0 || longer, "{context}");
        assert_eq!(extra.is_some(), usize::from(spelling.count) > values.len(), "{context}");
        let (data, unit) =
            (received_now - framing.reply_overhead(), |width| usize::from(units) * framing.value_len(width));
        // Discretes have a byte a unit, others as many as a word.
        assert!((unit(Width::Bit)..=unit(Width::Word)).contains(&data), "{context}: {units} units");
    }
    candidates.iter().flatten().count()
}

#[test]
fn each_spelling_of_a_read_brings_the_values_asked_for() {
    let plc = Plc::new();
    for address in 0..2000 {
        plc.write(Register::r(address), address.wrapping_mul(31)).unwrap();
        plc.write(m(address), address % 3 == 0).unwrap();
    }
    for framing in FRAMINGS {
        for (first, count, longer, spellings) in [
            // Nothing is before R0, and a single register cannot be one less.
            (0, 1, false, 2),
            (0, 1, true, 2),
            (0, 5, true, 3),
            (7, 1, false, 3),
            (7, 2, true, 4),
            (7, 63, true, 4),
            // The maximum of one request.
            (7, 64, false, 1),
            (7, 64, true, 2),
        ] {
            let read = ReadRegisters::new(Register::r(first), count).unwrap();
            let found = check_read(&plc, &read, longer, framing);
            assert_eq!(found, spellings, "{count} from R{first} on, longer: {longer}, {framing:?}");
            let read = ReadRegisters::new(dr(first), count.min(32)).unwrap();
            check_read(&plc, &read, longer, framing);
            let discrete = m(first);
            assert!(check_read(&plc, &ReadDiscretes::new(discrete, count).unwrap(), longer, framing) > 0);
            let disabled = ReadDisabled::new(discrete, count).unwrap();
            assert!(
                disabled.candidates(longer, framing).iter().flatten().all(|it| it.spelling.code == Code::ReadDisabled)
            );
            check_read(&plc, &disabled, longer, framing);
        }
        // All 256 points of a request: it has no other spelling but a shorter one.
        let points = ReadDiscretes::new(m(7), 256).unwrap();
        assert_eq!([false, true].map(|longer| check_read(&plc, &points, longer, framing)), [0, 1]);
        // The last register of the memory: none is behind.
        let last = Register::new(Symbol::R, Symbol::R.last_address()).unwrap();
        let last = ReadRegisters::new(last, 1).unwrap();
        let one_more = last.candidates(false, framing).into_iter().flatten().filter(|it| it.extra.is_some());
        assert!(one_more.map(|it| it.spelling).all(|spelling| spelling.before));
    }
}

#[test]
fn a_mixed_read_is_spelled_with_its_first_element_twice() {
    let plc = Plc::new();
    let elements: Vec<Element> = vec![Register::r(5).into(), m(9).into(), dr(100).into()];
    plc.write(Register::r(5), 77_u16).unwrap();
    plc.write(dr(100), 0x1234_5678_u32).unwrap();
    for framing in FRAMINGS {
        let read = ReadMixed::new(elements.clone()).unwrap();
        assert_eq!(check_read(&plc, &read, false, framing), 1);
        // As many as one request takes: there is no room for one more.
        let full: Vec<Element> = (0..64).map(|n| Register::r(n).into()).collect();
        assert_eq!(check_read(&plc, &ReadMixed::new(full).unwrap(), false, framing), 0);
    }
}

#[test]
fn each_spelling_of_a_write_writes_the_values() {
    for framing in FRAMINGS {
        for (count, longer, spellings, left) in
            [(1, false, 1, 0), (32, false, 1, 0), (33, false, 0, 0), (33, true, 1, 1), (64, true, 1, 32)]
        {
            let values: Vec<u16> = (1..=count).collect();
            let write = WriteRegisters::new(Register::r(10), values.clone()).unwrap();
            let candidates: Vec<_> = write.candidates(longer, framing).into_iter().flatten().collect();
            assert_eq!(candidates.len(), spellings, "{count} registers, longer: {longer}");
            let plain = exchange(&Plc::new(), &write, write.plain(), framing);
            for Candidate { spelling, more_bytes, left: left_over, .. } in candidates {
                let plc = Plc::new();
                let (sent, received, ()) = exchange(&plc, &write, spelling, framing);
                assert_eq!(left_over, left, "{count} registers");
                let written: Vec<_> = (0..count).map(|n| plc.read(Register::r(10 + n))).collect();
                let expected = values.iter().map(|&value| if value <= count - left { value } else { 0 });
                assert_eq!(written, expected.map(Value::from).collect::<Vec<_>>());
                if left == 0 {
                    assert_eq!(sent + received - plain.0 - plain.1, more_bytes, "{count} registers in {framing:?}");
                }
            }
        }
        let plc = Plc::new();
        let write = WriteDiscretes::new(m(3), [true, false, true]).unwrap();
        let [Some(mixed), ..] = write.candidates(false, framing) else { panic!("49") };
        exchange(&plc, &write, mixed.spelling, framing);
        assert_eq!([3, 4, 5].map(|n| plc.read(m(n))), [true, false, true].map(Value::from));
        let write = WriteRegisters::new(dr(20), [1_u32 << 16, 7]).unwrap();
        let [Some(mixed), ..] = write.candidates(false, framing) else { panic!("49") };
        exchange(&plc, &write, mixed.spelling, framing);
        assert_eq!([20, 22].map(|n| plc.read(dr(n))), [1_u32 << 16, 7].map(Value::from));
    }
}

/// Addresses whose high byte is a letter: in the binary framing, symbol and address could be taken
/// for a longer symbol.
#[test]
fn a_list_is_surely_unambiguous_unless_a_letter_can_follow_its_symbol() {
    let run = |first: u16, count| Run { first: Register::r(first).into(), count };
    for (first, count, sure) in [
        (0, 64, true),
        (0x40FF, 1, true),
        (0x40FF, 2, false),
        (0x4100, 1, false),
        (0x5000, 64, false),
        (0x5AFF, 1, false),
        (0x5AFF, 2, false),
        (0x5B00, 2, true),
        (0x40C1, 64, false),
    ] {
        assert_eq!(run(first, count).is_surely_unambiguous(count, Framing::Binary), sure, "{count} from {first:04X}h");
        assert!(run(first, count).is_surely_unambiguous(count, Framing::Ascii));
    }
    // The first of them only.
    assert!(run(0x40FF, 2).is_surely_unambiguous(1, Framing::Binary));
    let long: Element = dr(0).into();
    assert!(!Run { first: long, count: 1 }.is_surely_unambiguous(1, Framing::Binary), "a symbol of two letters");
    assert!(Run { first: long, count: 1 }.is_surely_unambiguous(1, Framing::Ascii));
}
