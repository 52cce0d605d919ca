//! Conclusions from traffic in place of an answer. No I/O.

use fatek::endpoint::{DataBits, Parity, SerialSettings};

use crate::enquiry::Traffic;

/// Shortest sample for a conclusion about its parity: by chance, 1 of 128 such samples has one.
const MIN_SAMPLE: usize = 8;

/// Texts about the traffic at these settings; `serial`: of a serial port.
pub(super) fn conclusions(traffic: &Traffic, serial: Option<SerialSettings>) -> Vec<String> {
    let mut texts = Vec::new();
    if traffic.echoes > 0 {
        texts.push("requests are echoed, so that adapter and port work".to_owned());
    }
    if traffic.garbage > 0 {
        let bytes =
            if traffic.garbage == 1 { "1 byte that is" } else { &format!("{} bytes that are", traffic.garbage) };
        let reason = serial.map_or("another protocol?", |serial| reason(&traffic.sample, serial));
        texts.push(format!("{bytes} no frame ({}): {reason}", sample(&traffic.sample)));
    }
    texts
}

/// The first bytes as hexadecimal numbers.
fn sample(bytes: &[u8]) -> String {
    const SHOWN: usize = 8;
    let shown: Vec<String> = bytes.iter().take(SHOWN).map(|byte| format!("{byte:02X}")).collect();
    format!("{}{}", shown.join(" "), if bytes.len() > SHOWN { " ..." } else { "" })
}

fn reason(sample: &[u8], serial: SerialSettings) -> &'static str {
    let zeros = sample.iter().filter(|byte| **byte == 0).count();
    if serial.parity() != Parity::None && zeros > 0 && zeros * 4 >= sample.len() {
        // By Linux.
        return "characters of another parity or speed are read as 00";
    }
    let is_plain = serial.data_bits() == DataBits::Eight && serial.parity() == Parity::None;
    match parity_of(sample).filter(|_| is_plain) {
        Some(Parity::Even) => "bit 7 is an even parity of the others: perhaps 7E1",
        Some(Parity::Odd) => "bit 7 is an odd parity of the others: perhaps 7O1",
        Some(_) | None => "another speed or frame, or noise",
    }
}

/// The parity that bit 7 of all bytes is, if it is one. Bytes without that bit alone show nothing.
fn parity_of(sample: &[u8]) -> Option<Parity> {
    let has_bit = sample.iter().any(|byte| byte & 0x80 != 0);
    if sample.len() < MIN_SAMPLE || !has_bit {
        return None;
    }
    let is_even = |byte: &u8| byte.count_ones().is_multiple_of(2);
    if sample.iter().all(is_even) {
        return Some(Parity::Even);
    }
    (!sample.iter().any(is_even)).then_some(Parity::Odd)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fatek::wire::Framing;

    const REPLY: &[u8] = b"\x020140001400059\x03";

    fn garbage(sample: &[u8]) -> Traffic {
        Traffic { bytes: sample.len(), garbage: sample.len(), sample: sample.to_vec(), ..Traffic::default() }
    }

    /// The bytes of 7 data bits and a parity bit, as 8 data bits.
    fn with_parity(bytes: &[u8], odd: bool) -> Vec<u8> {
        bytes.iter().map(|byte| byte | u8::from((byte.count_ones() % 2 == 1) != odd) << 7).collect()
    }

    #[test]
    fn the_parity_of_seven_data_bits_is_recognised_with_eight() {
        let plain = SerialSettings::new(Framing::Binary);
        for (odd, frame) in [(false, "7E1"), (true, "7O1")] {
            let [text] = &conclusions(&garbage(&with_parity(REPLY, odd)), Some(plain))[..] else { panic!("one") };
            assert!(text.ends_with(&format!("perhaps {frame}")), "{text}");
        }
        // Neither a few bytes, nor text without a parity bit, nor noise.
        for sample in [&with_parity(REPLY, false)[..7], REPLY, b"\x80\x81\x82\x83\x84\x85\x86\x87"] {
            let [text] = &conclusions(&garbage(sample), Some(plain))[..] else { panic!("one") };
            assert!(text.ends_with("another speed or frame, or noise"), "{text}");
        }
    }

    #[test]
    fn characters_of_another_parity_are_recognised_as_zeros() {
        let even = SerialSettings::new(Framing::Ascii);
        let sample = [0x00, 0x30, 0x00, 0x34, 0x30, 0x00, 0x31];
        let texts = conclusions(&garbage(&sample), Some(even));
        assert_eq!(
            texts,
            ["7 bytes that are no frame (00 30 00 34 30 00 31): characters of another parity or speed are read as 00"]
        );
        assert_eq!(conclusions(&garbage(&[0x41]), Some(even)).len(), 1);
        assert_eq!(conclusions(&garbage(&[0x41]), None), ["1 byte that is no frame (41): another protocol?"]);
    }

    #[test]
    fn an_echo_says_that_the_port_works() {
        let traffic = Traffic { bytes: 8, echoes: 1, ..Traffic::default() };
        assert!(conclusions(&traffic, None)[0].starts_with("requests are echoed"));
        assert!(conclusions(&Traffic::default(), None).is_empty());
    }
}
