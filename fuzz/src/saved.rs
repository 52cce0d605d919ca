//! Saved files, with length and checksum corrected by choice.

use crate::input::Input;

/// File of an input. After an odd first byte the input is the content, otherwise the whole file.
pub(crate) fn file(kind: &str, input: &[u8]) -> Vec<u8> {
    let mut input = Input::new(input);
    if input.byte() & 1 == 0 { input.rest().to_vec() } else { framed(kind, input.rest()) }
}

/// Returns a file with this content.
pub(crate) fn framed(kind: &str, content: &[u8]) -> Vec<u8> {
    let mut file = format!("fatek file 1: {kind}\nlength {}\n", content.len()).into_bytes();
    file.extend(content);
    let checksum = format!("crc32 {:08X}\n", crc32(&file));
    file.extend(checksum.as_bytes());
    file
}

/// Returns the input for the content of a file.
pub(crate) fn content(file: &str) -> Vec<u8> {
    let lines = file.split_inclusive('\n').collect::<Vec<_>>();
    let [_, _, content @ .., _] = &lines[..] else { panic!("not a saved file") };
    [b"\x01", content.concat().as_bytes()].concat()
}

/// CRC-32 (ISO-HDLC), bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
    !bytes.iter().fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), |crc, _| step(crc)))
}
