//! Explanation of one frame, field by field.

use fatek::command::{Code, Request};
use fatek::wire::ascii::{self, ETX, STX};
use fatek::wire::binary::{self, ID, QUERY, REPLY, TERMINATOR};
use fatek::wire::{AsciiReader, BinaryReader, FieldReader, Framing, MAX_FRAME_LEN};

use super::field::{DataReading, Field, Part};
use super::recorder::Recorder;
use super::reply;
use super::split::Piece;

/// Fields and faults of a frame, or of bytes outside frames.
#[derive(Clone, Debug)]
pub(super) struct Explanation {
    /// `None` for bytes outside frames.
    pub(super) framing: Option<Framing>,
    /// In bytes.
    pub(super) length: usize,
    pub(super) fields: Vec<Field>,
    pub(super) faults: Vec<String>,
}

pub(super) fn explain(piece: &Piece<'_>) -> Explanation {
    match *piece {
        Piece::Noise(bytes) => noise(bytes),
        Piece::Ascii(bytes) => ascii_frame(bytes),
        Piece::Binary(bytes) => binary_frame(bytes),
    }
}

impl Explanation {
    pub(super) fn title(&self) -> String {
        let framing = match self.framing {
            None if self.length == 1 => return "1 byte outside frames".to_owned(),
            None => return format!("{} bytes outside frames", self.length),
            Some(Framing::Binary) => "Binary",
            Some(_) => "ASCII",
        };
        let verdict = if self.faults.is_empty() { "good" } else { "BAD" };
        format!("{framing} frame of {} bytes: {verdict}", self.length)
    }

    fn new(framing: Option<Framing>, bytes: &[u8]) -> Self {
        let mut explanation = Self { framing, length: bytes.len(), fields: Vec::new(), faults: Vec::new() };
        if framing.is_some() && bytes.len() > MAX_FRAME_LEN {
            explanation.faults.push(format!("the frame has {} bytes, the limit is {MAX_FRAME_LEN}", bytes.len()));
        }
        explanation
    }

    fn field(&mut self, name: &str, bytes: &[u8], meaning: impl Into<String>) {
        let field = Field { part: Part::Frame, name: name.to_owned(), bytes: bytes.to_vec(), meaning: meaning.into() };
        self.fields.push(field);
    }

    /// Adds a field that breaks a rule.
    fn fault(&mut self, name: &str, bytes: &[u8], rule: impl Into<String>) {
        let rule = rule.into();
        self.faults.push(format!("{name}: {rule}"));
        self.field(name, bytes, format!("BAD: {rule}"));
    }

    fn check(&mut self, name: &str, bytes: &[u8], good: bool, meaning: &str, rule: impl Into<String>) {
        if good { self.field(name, bytes, meaning) } else { self.fault(name, bytes, rule) }
    }

    fn station(&mut self, bytes: &[u8], station: u8) {
        match station {
            0 => self.field("station", bytes, "0: broadcast, no reply"),
            255 => self.fault("station", bytes, "255 is not a station"),
            station => self.field("station", bytes, station.to_string()),
        }
    }

    /// Adds the command, and the data as fields of that command. `rule`: of a command that is no byte.
    fn command(&mut self, bytes: &[u8], command: Option<u8>, rule: &str, data: &[u8], readings: &[Part]) {
        let Some(framing) = self.framing else { return };
        match command.map(|command| (command, Code::from_u8(command))) {
            None => self.fault("command", bytes, rule),
            Some((command, None)) => self.fault("command", bytes, format!("unknown command {command:02X}")),
            Some((_, Some(code))) if !code.is_in(framing) => {
                self.fault("command", bytes, format!("{code} does not exist in the {framing} framing"));
            }
            Some((_, Some(code))) => {
                self.field("command", bytes, code.to_string());
                return self.data(code, framing, data, readings);
            }
        }
        if !data.is_empty() {
            self.field("data", data, "");
        }
    }

    /// Adds the data in each reading without a fault. An ASCII frame may be both a request and a
    /// reply.
    fn data(&mut self, code: Code, framing: Framing, data: &[u8], readings: &[Part]) {
        let read = |&part: &Part| match framing {
            Framing::Binary => (part, read_data(BinaryReader::new(data), Framing::Binary, data, code, part)),
            Framing::Ascii | _ => (part, read_data(AsciiReader::new(data), Framing::Ascii, data, code, part)),
        };
        let readings: Vec<(Part, DataReading)> = readings.iter().map(read).collect();
        if readings.iter().any(|(_, reading)| reading.fault.is_none()) {
            let fitting = readings.into_iter().filter(|(_, reading)| reading.fault.is_none());
            self.fields.extend(fitting.flat_map(|(_, reading)| reading.fields));
            return;
        }
        for (part, reading) in &readings {
            if let Some(fault) = &reading.fault {
                self.faults.push(format!("data: not a {}: {fault}", part.as_str()));
            }
        }
        // Without a good reading the longest one is shown; of two equal ones, the first.
        let consumed = |reading: &DataReading| reading.fields.iter().map(|field| field.bytes.len()).sum::<usize>();
        let Some((part, DataReading { fields, fault: Some(fault) })) =
            readings.into_iter().rev().max_by_key(|(_, r)| consumed(r))
        else {
            return;
        };
        let rest = data.get(fields.iter().map(|field| field.bytes.len()).sum()..).unwrap_or_default().to_vec();
        self.fields.extend(fields);
        let meaning = format!("BAD: {fault}");
        self.fields.push(Field { part, name: "rest".to_owned(), bytes: rest, meaning });
    }
}

/// Reads the data of a frame as a request or a reply.
fn read_data<R: FieldReader + Clone>(inner: R, framing: Framing, data: &[u8], code: Code, part: Part) -> DataReading {
    let mut fields = Recorder::new(inner, data, code, part);
    let fault = match part {
        Part::Reply => reply::read(code, data.len(), &mut fields).err().map(|error| error.to_string()),
        Part::Frame | Part::Request => match Request::read(code, &mut fields) {
            Ok(request) => request.check(framing).err().map(|error| error.to_string()),
            Err(error) => Some(error.to_string()),
        },
    };
    fields.into_reading(fault)
}

fn noise(bytes: &[u8]) -> Explanation {
    let mut explanation = Explanation::new(None, bytes);
    explanation.fault("noise", bytes, "not the start of a frame: expected 02, 51 10 or 52 10");
    explanation
}

/// Explains `STX station command data LRC ETX`.
fn ascii_frame(bytes: &[u8]) -> Explanation {
    let mut it = Explanation::new(Some(Framing::Ascii), bytes);
    let (stx, rest) = bytes.split_at(bytes.len().min(1));
    let (rest, etx) = match rest.strip_suffix(&[ETX]) {
        Some(rest) => (rest, &bytes[bytes.len() - 1..]),
        None => (rest, &[][..]),
    };
    // A frame without ETX is cut off: its last bytes are not the LRC.
    let (rest, lrc) = if etx.is_empty() { (rest, &[][..]) } else { rest.split_at(rest.len().saturating_sub(2)) };
    let (station, rest) = rest.split_at(rest.len().min(2));
    let (command, data) = rest.split_at(rest.len().min(2));

    it.check("STX", stx, stx == [STX], "begin", "expected 02");
    match hex_byte(station) {
        Some(number) => it.station(station, number),
        None => it.fault("station", station, "expected two hexadecimal digits"),
    }
    let rule = "expected two hexadecimal digits";
    it.command(command, hex_byte(command), rule, data, &[Part::Request, Part::Reply]);
    if etx.is_empty() {
        it.fault("end", &[], "the frame is cut off: LRC and ETX (03) are missing");
        return it;
    }
    let summed = &bytes[..bytes.len() - lrc.len() - etx.len()];
    let computed = ascii::lrc(summed);
    match hex_byte(lrc) {
        Some(stated) if stated == computed => it.field("LRC", lrc, format!("{stated:02X}, as computed")),
        Some(stated) => it.fault("LRC", lrc, format!("found {stated:02X}, computed {computed:02X}")),
        None => it.fault("LRC", lrc, format!("expected two hexadecimal digits, computed {computed:02X}")),
    }
    it.field("ETX", etx, "end");
    it
}

/// Explains `header id length station command data CRC terminator`.
fn binary_frame(bytes: &[u8]) -> Explanation {
    let mut it = Explanation::new(Some(Framing::Binary), bytes);
    let (header, rest) = bytes.split_at(bytes.len().min(1));
    let (id, rest) = rest.split_at(rest.len().min(1));
    let (length, rest) = rest.split_at(rest.len().min(2));
    let stated = <[u8; 2]>::try_from(length).map(|length| usize::from(u16::from_be_bytes(length))).ok();
    let (payload, tail) = match rest.strip_suffix(&TERMINATOR) {
        Some(rest_of_it) => rest.split_at(rest_of_it.len().saturating_sub(2)),
        // Without a terminator the length field alone gives the end of the payload.
        None => rest.split_at(rest.len().min(stated.unwrap_or(rest.len()))),
    };
    let (crc, terminator) = tail.split_at(tail.len().min(2));
    let (station, rest) = payload.split_at(payload.len().min(1));
    let (command, data) = rest.split_at(rest.len().min(1));

    match header {
        [QUERY] => it.field("header", header, "request"),
        [REPLY] => it.field("header", header, "reply"),
        _ => it.fault("header", header, "expected 51 (request) or 52 (reply)"),
    }
    it.check("id", id, id == [ID], "always 10", "expected 10");
    match stated {
        Some(stated) if stated == payload.len() && stated >= 2 => {
            it.field("length", length, format!("{stated} bytes, from station to data"));
        }
        Some(stated) => {
            it.fault("length", length, format!("{stated} bytes stated, {} found, minimum 2", payload.len()));
        }
        None => it.fault("length", length, "expected two bytes"),
    }
    match station {
        [number] => it.station(station, *number),
        _ => it.fault("station", station, "missing"),
    }
    let part = if header == [REPLY] { Part::Reply } else { Part::Request };
    it.command(command, command.first().copied(), "missing", data, &[part]);
    let computed = binary::crc(bytes.get(2..bytes.len() - tail.len()).unwrap_or_default());
    // On the wire the low byte is first.
    let [first, second] = computed.to_le_bytes();
    match *crc {
        [a, b] if [a, b] == [first, second] => it.field("CRC", crc, format!("{a:02X} {b:02X}, as computed")),
        [a, b] => it.fault("CRC", crc, format!("found {a:02X} {b:02X}, computed {first:02X} {second:02X}")),
        _ => it.fault("CRC", crc, format!("expected two bytes, computed {first:02X} {second:02X}")),
    }
    it.check("terminator", terminator, terminator == TERMINATOR, "end", "expected 55 AA");
    it
}

fn hex_byte(digits: &[u8]) -> Option<u8> {
    let digit = |byte: u8| char::from(byte).to_digit(16);
    match digits {
        [high, low] => u8::try_from(digit(*high)? << 4 | digit(*low)?).ok(),
        _ => None,
    }
}
