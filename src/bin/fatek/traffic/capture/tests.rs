use std::collections::BTreeMap;

use etherparse::PacketBuilder;

use super::*;
use crate::conversation::{Change, Direction};

const REQUEST: &[u8] = b"\x0201411F9\x03";
const REPLY: &[u8] = b"\x0201410F8\x03";

/// A packet of raw IPv4 over UDP.
fn udp(from_plc: bool, payload: &[u8]) -> Vec<u8> {
    let (client, plc) = ([10, 0, 0, 9], [10, 0, 0, 3]);
    let builder = if from_plc {
        PacketBuilder::ipv4(plc, client, 64).udp(500, 4000)
    } else {
        PacketBuilder::ipv4(client, plc, 64).udp(4000, 500)
    };
    let mut packet = Vec::new();
    builder.write(&mut packet, payload).unwrap();
    packet
}

/// A file of pcap, with this magic number and byte order. Times are seconds and parts of them.
fn pcap(magic: u32, is_big: bool, packets: &[(u32, u32, Vec<u8>)]) -> Vec<u8> {
    let word = |word: u32| if is_big { word.to_be_bytes() } else { word.to_le_bytes() };
    let version = if is_big { [0, 2, 0, 4] } else { [2, 0, 4, 0] };
    let mut file = [word(magic), version, word(0), word(0), word(65_535), word(101)].concat();
    for (seconds, part, data) in packets {
        let len = u32::try_from(data.len()).unwrap();
        file.extend([word(*seconds), word(*part), word(len), word(len)].concat());
        file.extend(data);
    }
    file
}

/// A block of pcapng, little-endian.
fn block(kind: u32, body: &[u8]) -> Vec<u8> {
    let padding = vec![0; body.len().next_multiple_of(4) - body.len()];
    let len = u32::try_from(body.len() + padding.len() + 12).unwrap().to_le_bytes();
    [&kind.to_le_bytes()[..], &len, body, &padding, &len].concat()
}

fn section() -> Vec<u8> {
    let magic = 0x1A2B_3C4D_u32.to_le_bytes();
    block(0x0A0D_0D0A, &[&magic[..], &[1, 0, 0, 0], &[0xFF; 8]].concat())
}

/// An interface of raw IP, with a resolution of 10^-`digits` seconds.
fn interface(digits: u8) -> Vec<u8> {
    block(1, &[101, 0, 0, 0, 0, 0, 4, 0, 9, 0, 1, 0, digits, 0, 0, 0, 0, 0, 0, 0])
}

fn enhanced(interface: u32, units: u64, data: &[u8]) -> Vec<u8> {
    let len = u32::try_from(data.len()).unwrap().to_le_bytes();
    let (high, low) = (u32::try_from(units >> 32).unwrap(), units as u32);
    block(6, &[&interface.to_le_bytes()[..], &high.to_le_bytes(), &low.to_le_bytes(), &len, &len, data].concat())
}

fn pcapng() -> Vec<u8> {
    [
        section(),
        interface(9),
        // A block of an unknown kind.
        block(0x0BAD_0001, b"abc"),
        enhanced(0, 1_700_000_000_000_000_001, &udp(false, REQUEST)),
        // Another section, with other interfaces.
        section(),
        interface(3),
        interface(6),
        enhanced(1, 1_700_000_000_000_002, &udp(true, REPLY)),
        // Without a time.
        block(3, &[&37_u32.to_le_bytes()[..], &udp(true, REPLY)].concat()),
    ]
    .concat()
}

/// A reader that gives one byte at a time.
struct Trickle<'b>(&'b [u8]);

impl Read for Trickle<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.0.read(&mut buffer[..1])
    }
}

impl BufRead for Trickle<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        Ok(&self.0[..self.0.len().min(1)])
    }

    fn consume(&mut self, amount: usize) {
        self.0.consume(amount);
    }
}

/// Time in nanoseconds, and bytes. `true`: from the PLC.
type Passed = (u128, bool, Vec<u8>);

/// The bytes of a capture, and its remarks or error.
fn run(reader: &mut dyn BufRead, form: Form) -> (Vec<Passed>, Result<Remarks, String>) {
    let mut passed = Vec::new();
    let remarks = read(reader, form, &[500], &mut |event| {
        if let Change::Bytes { direction, bytes, .. } = event.change {
            passed.push((event.at.as_nanos(), direction == Direction::FromPlc, bytes.to_vec()));
        }
        Ok(())
    });
    let error = |error| match error {
        ReadError::Source(SourceError::Content(rule)) => rule,
        ReadError::Source(SourceError::Io(error)) => format!("I/O: {error}"),
        ReadError::Sink(failure) => panic!("{failure}"),
    };
    (passed, remarks.map_err(error))
}

fn run_bytes(file: &[u8]) -> (Vec<Passed>, Result<Remarks, String>) {
    run(&mut { file }, Form::of(file).unwrap())
}

#[test]
fn both_byte_orders_and_resolutions_of_pcap_are_read() {
    for (magic, is_big, unit) in
        [(0xA1B2_C3D4, false, 1000), (0xA1B2_C3D4, true, 1000), (0xA1B2_3C4D, false, 1), (0xA1B2_3C4D, true, 1)]
    {
        let file = pcap(magic, is_big, &[(1, 5, udp(false, REQUEST)), (2, 7, udp(true, REPLY))]);
        let expected =
            vec![(1_000_000_000 + 5 * unit, false, REQUEST.to_vec()), (2_000_000_000 + 7 * unit, true, REPLY.to_vec())];
        assert_eq!(run_bytes(&file), (expected.clone(), Ok(Remarks::new())), "{magic:X} {is_big}");
        let (slowly, _) = run(&mut Trickle(&file), Form::Pcap);
        assert_eq!(slowly, expected);
    }
}

#[test]
fn sections_interfaces_and_resolutions_of_pcapng_are_read() {
    let (passed, remarks) = run_bytes(&pcapng());
    let at = 1_700_000_000_000_000_000;
    let expected =
        vec![(at + 1, false, REQUEST.to_vec()), (at + 2000, true, REPLY.to_vec()), (at + 2000, true, REPLY.to_vec())];
    assert_eq!((passed, remarks), (expected.clone(), Ok(Remarks::new())));
    let (slowly, _) = run(&mut Trickle(&pcapng()), Form::PcapNg);
    assert_eq!(slowly, expected);
}

#[test]
fn a_damaged_capture_gives_its_packets_up_to_the_damage() {
    let pcap = pcap(0xA1B2_C3D4, false, &[(1, 5, udp(false, REQUEST)), (2, 7, udp(true, REPLY))]);
    let (passed, ended) = run_bytes(&pcap[..pcap.len() - 1]);
    assert_eq!((passed.len(), ended.unwrap_err().as_str()), (1, "it is cut off after byte 77"));
    let unknown = [section(), enhanced(0, 0, &udp(false, REQUEST))].concat();
    let (_, ended) = run_bytes(&unknown);
    assert_eq!(ended.unwrap_err(), "it has a packet of an unknown interface, 0");
    assert_eq!(run_bytes(b"\xA1\xB2\xC3\xD4").1.unwrap_err(), "its first block is damaged or cut off");
}

#[test]
fn a_block_without_end_is_refused() {
    let mut file = [section(), interface(6)].concat();
    file.extend(6_u32.to_le_bytes());
    file.extend(0x7FFF_FFF0_u32.to_le_bytes());
    let mut endless = io::BufReader::new(io::Cursor::new(file).chain(io::repeat(0)));
    let (_, ended) = run(&mut endless, Form::PcapNg);
    let rule = ended.unwrap_err();
    assert!(rule.starts_with("it has a block that is too long") || rule.starts_with("it is damaged"), "{rule}");
}

#[test]
fn skipped_packets_are_named() {
    let mut fragment = udp(false, REQUEST);
    fragment[6] |= 0x20;
    let mut file = pcap(0xA1B2_C3D4, false, &[(1, 5, fragment), (1, 6, udp(false, REQUEST)[..30].to_vec())]);
    assert_eq!(
        run_bytes(&file).1.unwrap(),
        ["1 packet skipped: fragments of IP", "1 packet cut off by the capture: capture with a larger length (-s)"]
    );
    file[20] = 147;
    let remarks = run_bytes(&file).1.unwrap();
    assert_eq!(remarks, ["2 packets of the unknown link type 147 skipped", "none of 2 packets has port 500"]);
    let other = udp(false, REQUEST);
    let mut other = pcap(0xA1B2_C3D4, false, &[(1, 5, other)]);
    let at = other.len() - REQUEST.len() - 6;
    other[at..at + 2].copy_from_slice(&5000_u16.to_be_bytes());
    let remarks = run_bytes(&other).1.unwrap();
    assert_eq!(remarks, ["none of 1 packet has port 500; most of them have port 4000: try --port 4000"]);
}

/// Hostile captures: no panic, no endless loop.
#[test]
fn mutated_captures_end() {
    let pcap = pcap(0xA1B2_C3D4, false, &[(1, 5, udp(false, REQUEST)), (2, 7, udp(true, REPLY))]);
    let mut state = 0x2545_F491_4F6C_DD1D_u64;
    let mut random = |below: usize| {
        // xorshift64
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        usize::try_from(state >> 33).unwrap() % below
    };
    let mut ends: BTreeMap<String, u32> = BTreeMap::new();
    for _ in 0..2000 {
        for (file, form) in [(&pcap, Form::Pcap), (&pcapng(), Form::PcapNg)] {
            let mut file = file.clone();
            for _ in 0..=random(4) {
                let at = random(file.len());
                match random(4) {
                    0 => file[at] = u8::try_from(random(256)).unwrap(),
                    1 => file[at] = [0, 0xFF, 0x7F, 0x80][random(4)],
                    2 => file.truncate(at + 1),
                    _ => {
                        let part = file[at..(at + random(40)).min(file.len())].to_vec();
                        let to = random(file.len());
                        file.splice(to..to, part);
                    }
                }
            }
            let (_, ended) = run(&mut &file[..], form);
            let rule = ended.err().unwrap_or_default();
            *ends.entry(rule.split(" after").next().unwrap_or_default().to_owned()).or_default() += 1;
        }
    }
    // Each way to end was taken.
    for rule in ["", "it is cut off", "it is damaged"] {
        assert!(ends.get(rule).is_some_and(|&count| count > 20), "{ends:?}");
    }
}
