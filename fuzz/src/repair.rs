//! Correction of checksums and lengths, so that the decoders accept the frames.

use fatek::wire::{Framing, ascii, binary};

/// Corrects the checksums of all frames, and in the binary framing their lengths.
pub fn repair(framing: Framing, bytes: &mut [u8]) {
    match framing {
        Framing::Binary => repair_binary(bytes),
        _ => repair_ascii(bytes),
    }
}

/// Corrects from each STX to the next ETX without an STX between.
fn repair_ascii(bytes: &mut [u8]) {
    let mut start = None;
    for at in 0..bytes.len() {
        match (bytes[at], start) {
            (ascii::STX, _) => start = Some(at),
            (ascii::ETX, Some(from)) if at >= from + 7 => {
                let sum = format!("{:02X}", ascii::lrc(&bytes[from..at - 2]));
                bytes[at - 2..at].copy_from_slice(sum.as_bytes());
                start = None;
            }
            (ascii::ETX, _) => start = None,
            _ => {}
        }
    }
}

/// Corrects from each header over its stated length, limited by the end of the bytes.
fn repair_binary(bytes: &mut [u8]) {
    const HEAD: usize = 4;
    const TAIL: usize = 4;
    let mut at = 0;
    while at + HEAD + 2 + TAIL <= bytes.len() {
        if !matches!(bytes[at], binary::QUERY | binary::REPLY) || bytes[at + 1] != binary::ID {
            at += 1;
            continue;
        }
        let stated = usize::from(u16::from_be_bytes([bytes[at + 2], bytes[at + 3]]));
        let max = bytes.len() - at - HEAD - TAIL;
        let payload = if stated < 2 { max } else { stated.min(max) };
        if let Ok(length) = u16::try_from(payload) {
            bytes[at + 2..at + HEAD].copy_from_slice(&length.to_be_bytes());
            let tail = at + HEAD + payload;
            let crc = binary::crc(&bytes[at + 2..tail]).to_le_bytes();
            bytes[tail..tail + 2].copy_from_slice(&crc);
            bytes[tail + 2..tail + TAIL].copy_from_slice(&binary::TERMINATOR);
        }
        at += HEAD + payload + TAIL;
    }
}
