//! First inputs of the fuzzer: the examples of the manuals, and typical texts.

use fatek::tag::Tag;
use fatek::wire::{Framing, Side};
use fatek::{Backup, Program, Symbol};

use crate::reference::{Vector, vectors};
use crate::saved;

pub fn ascii() -> Vec<Vec<u8>> {
    frames(Framing::Ascii, |_| 1)
}

pub fn binary() -> Vec<Vec<u8>> {
    // The flag is that of the receiver, the other side.
    frames(Framing::Binary, |vector| if vector.sender == Side::Client { 0b11 } else { 0b01 })
}

fn frames(framing: Framing, flags: fn(&Vector) -> u8) -> Vec<Vec<u8>> {
    let of_framing = vectors().into_iter().filter(|vector| vector.framing == framing);
    of_framing.map(|vector| [&[flags(&vector), 3][..], &vector.bytes].concat()).collect()
}

pub fn request() -> Vec<Vec<u8>> {
    let requests = vectors().into_iter().filter(|vector| vector.sender == Side::Client);
    requests
        .map(|vector| [&[1 | u8::from(vector.framing == Framing::Binary) << 1][..], &vector.bytes].concat())
        .collect()
}

/// Each reply after its request.
pub fn reply() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    let mut request: Option<Vector> = None;
    for vector in vectors() {
        match (&request, vector.sender) {
            (Some(request), Side::Plc) if (request.framing, request.command) == (vector.framing, vector.command) => {
                let (request_data, data) = (request.frame().data, vector.frame().data);
                // Lengths over 255 are counted in units of two, which does not fit all data.
                let Ok(len) = u8::try_from(request_data.len()) else { continue };
                let flags = u8::from(vector.framing == Framing::Binary);
                seeds.push([&[flags, 0x80 | vector.command, len][..], &request_data, &data].concat());
            }
            (_, Side::Client) => request = Some(vector),
            _ => {}
        }
    }
    seeds
}

pub fn element() -> Vec<Vec<u8>> {
    let ends = |symbol: &Symbol| [format!("{symbol}0"), format!("{symbol}{}", symbol.last_address())];
    Symbol::ALL.iter().flat_map(ends).map(String::into_bytes).collect()
}

pub fn tag() -> Vec<Vec<u8>> {
    let tags = [
        "R5=7",
        "R0-R2=1,2,3",
        "R100:f32=-1.5",
        "DR100:i32=-2",
        "R5:i16*0.1-40=12.3",
        "R0-R9:text=\"a, b\"",
        "M0-M2=on,0,true",
        "WM8:hex=0xFFFF",
        "R0-R9:text-hi=abc",
        "D10-13:u16",
        "R0-9:u32",
        "X0",
        "DWM0:hex32=0x00000001",
    ];
    tags.map(|tag| tag.as_bytes().to_vec()).to_vec()
}

pub fn endpoint() -> Vec<Vec<u8>> {
    let urls = [
        "tcp://192.168.2.3",
        "udp://[fe80::1]:5000?framing=binary",
        "serial:/dev/ttyUSB0?baud=19200&frame=7E1",
        "serial:COM3",
        "tcp://plc-1.example:501/",
        "serial:///dev/ttyS0?framing=binary&frame=8N2",
    ];
    urls.map(|url| url.as_bytes().to_vec()).to_vec()
}

pub fn program_file() -> Vec<Vec<u8>> {
    let page = |words: u8| [&[b'F', b'B', b'0', b'0', 0, words][..], &[0xFF; 122]].concat();
    let raw = [page(0), [page(64), vec![0xA5; 128]].concat()];
    let files = raw.clone().map(|bytes| saved::content(&Program::from_bytes(&bytes).unwrap().to_file()));
    let whole = [b"\0".to_vec(), Program::from_bytes(&raw[0]).unwrap().to_file().into_bytes()].concat();
    raw.into_iter().chain(files).chain([whole]).collect()
}

pub fn backup_file() -> Vec<Vec<u8>> {
    let backups = [vec!["R0-R9"], vec!["M0-M20", "DR100"], vec!["D0-D3", "X0", "WY8"]].map(|ranges| {
        let tags = ranges.iter().map(|range| range.parse::<Tag>().unwrap());
        Backup::of(tags).unwrap().to_file()
    });
    let filled = "station 1\nread 2026-11-22T07:09:13Z\nabout -\nbrief -\nstatus -\nrange R0-R1\n";
    let contents = backups.iter().map(|file| saved::content(file)).chain([[b"\x01", filled.as_bytes()].concat()]);
    contents.chain([[b"\0", backups[0].as_bytes()].concat()]).collect()
}

/// Framing, followed by steps: calls, replies of many kinds, silence and disconnects.
pub fn link() -> Vec<Vec<u8>> {
    let runs: [&[u8]; 8] = [
        &[0, 1, 0, 4],
        &[0, 1, 12, 1, 0, 4, 4],
        // No reply, followed by a reply.
        &[0, 1, 3, 12, 50, 4, 4, 4],
        // Late, duplicate, split and corrupt replies.
        &[0, 1, 0, 12, 26, 6, 1, 4, 0xA7, 1, 0xC7, 5, 9, 0x87, 1],
        &[0, 1, 2, 13, 4, 1, 2, 14, 4],
        &[0, 15, 1, 0, 12, 40, 0x4F, 12, 40, 4],
        // Station offline, and online again.
        &[0, 1, 3, 12, 100, 1, 1, 12, 20, 4, 1, 0, 4],
        // Echo, unexpected and expected.
        &[0, 1, 0, 10, 4, 1, 24, 10, 4, 1, 0, 10, 4],
    ];
    runs.iter().flat_map(|run| [run.to_vec(), [&[1], &run[1..]].concat()]).collect()
}
