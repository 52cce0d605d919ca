//! Dictionaries of the fuzzer, generated from the tables of commands and elements.

use fatek::command::{Class, Code};
use fatek::tag::TagType;
use fatek::wire::{Framing, ascii, binary};
use fatek::{Element, Symbol};

/// Returns the dictionary of a target in the format of libFuzzer; empty if it has none.
pub fn of(target: &str) -> String {
    let words = match target {
        "ascii" => ascii_words(),
        "binary" => binary_words(),
        "reply" | "request" => [ascii_words(), binary_words()].concat(),
        "link" => Code::ALL.iter().map(|&code| vec![code.into()]).collect(),
        "element" => [symbols(), addresses(), binary_elements()].concat(),
        "tag" => [symbols(), addresses(), types(), texts(TAG)].concat(),
        "endpoint" => texts(ENDPOINT),
        "program_file" => texts(PROGRAM),
        "backup_file" => [symbols(), types(), texts(BACKUP)].concat(),
        _ => Vec::new(),
    };
    let mut lines: Vec<String> = words.iter().map(|word| line(word)).collect();
    lines.sort();
    lines.dedup();
    lines.concat()
}

const ENDPOINT: &[&str] = &[
    "tcp://",
    "udp://",
    "serial:",
    "serial:/dev/ttyUSB0",
    "COM3",
    "[::1]",
    "fe80::1",
    "?framing=ascii",
    "framing=binary",
    "?baud=",
    "&frame=",
    "7E1",
    "8N1",
    "8O2",
    ":500",
    "9600",
    "115200",
    "65535",
];
const TAG: &[&str] =
    &["*0.1", "+40", "-1e-3", "nan", "inf", "0x", "true", "off", "=\"", "\\x", "\\n", "1e200", "text-hi"];
const FILE: &[&str] =
    &["fatek file 1: ", "length ", "crc32 ", "read ", "about ", "brief ", "status ", "T00:00:00Z", "-\n"];
const PROGRAM: &[&str] =
    &["fatek file 1: program\n", "pages ", "page 0 ", "4642", "464D3030", "FFFF", "read -\nabout -\n"];
const BACKUP: &[&str] =
    &["fatek file 1: backup\n", "station ", "range ", "missing ", "not-read", "refused ", "..", "+"];

fn texts(of: &[&str]) -> Vec<Vec<u8>> {
    of.iter()
        .chain(FILE.iter().filter(|_| of == PROGRAM || of == BACKUP))
        .map(|text| text.as_bytes().to_vec())
        .collect()
}

/// Each command alone, and after the start of a frame; also as a confirmation.
fn ascii_words() -> Vec<Vec<u8>> {
    let commands = Code::ALL.iter().flat_map(|&code| {
        let digits = format!("{:02X}", u8::from(code));
        let end = char::from(ascii::ETX);
        let frame = format!("{}01{digits}", char::from(ascii::STX));
        // Confirmation without data.
        let done = (code.class() != Class::Read).then(|| format!("{frame}000{end}"));
        [Some(digits), Some(format!("{frame}00{end}")), Some(frame), done].into_iter().flatten()
    });
    commands.map(String::into_bytes).chain(addresses()).collect()
}

fn binary_words() -> Vec<Vec<u8>> {
    let heads = [binary::QUERY, binary::REPLY].map(|header| vec![header, binary::ID, 0]);
    let commands = Code::ALL.iter().flat_map(|&code| [vec![1, code.into()], vec![1, code.into(), 0]]);
    heads.into_iter().chain([binary::TERMINATOR.to_vec()]).chain(commands).chain(binary_elements()).collect()
}

fn symbols() -> Vec<Vec<u8>> {
    Symbol::ALL.iter().map(|symbol| symbol.as_str().as_bytes().to_vec()).collect()
}

fn types() -> Vec<Vec<u8>> {
    TagType::ALL.iter().map(|tag_type| format!(":{tag_type}").into_bytes()).collect()
}

/// First and last element of each symbol in the ASCII framing, and counters of 32 bits.
fn addresses() -> Vec<Vec<u8>> {
    ends(Framing::Ascii).map(|element| format!("{element:#}").into_bytes()).collect()
}

/// First and last element of each symbol in the binary framing.
fn binary_elements() -> Vec<Vec<u8>> {
    ends(Framing::Binary).map(|e| [e.symbol().as_str().as_bytes(), &e.address().to_be_bytes()].concat()).collect()
}

fn ends(framing: Framing) -> impl Iterator<Item = Element> {
    let ends =
        move |&symbol: &Symbol| [0, symbol.last_address_in(framing)].map(|address| Element::new(symbol, address));
    let counters = [200, 255].map(|address| Element::new(Symbol::DRC, address));
    Symbol::ALL.iter().flat_map(ends).chain(counters).flatten()
}

fn line(word: &[u8]) -> String {
    let escaped = word.iter().map(|byte| match byte {
        b'"' | b'\\' => format!("\\{}", char::from(*byte)),
        0x20..=0x7E => char::from(*byte).to_string(),
        _ => format!("\\x{byte:02X}"),
    });
    format!("\"{}\"\n", escaped.collect::<String>())
}
