//! What the tests of wire and commands share: the manuals' vectors, exchanges of every command, noise, and a decoder
//! by the book to compare with.
#![allow(dead_code, reason = "each test file uses a part of it")]

use std::fmt;
use std::ops::Range;

use bytes::{Bytes, BytesMut};
use fatek::command::*;
use fatek::wire::{Codec, Frame, Framing, MAX_FRAME_LEN, Received, Side};
use fatek::{Discrete, Element, ErrorCode, Register, Register32, Symbol, Width};
use proptest::collection::vec;
use proptest::prelude::*;
use tokio_util::codec::Decoder;

pub(crate) const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// One row of `vectors.tsv`.
#[derive(Clone)]
pub(crate) struct Vector {
    pub(crate) framing: Framing,
    pub(crate) sender: Side,
    pub(crate) command: u8,
    pub(crate) bytes: Vec<u8>,
    pub(crate) row: &'static str,
}

impl Vector {
    /// The codec of the side that receives it.
    pub(crate) fn codec(&self) -> Codec {
        Codec::new(self.framing, other_side(self.sender))
    }

    /// What it carries, found without the codec.
    pub(crate) fn frame(&self) -> Frame {
        carried(self.framing, &self.bytes)
    }
}

pub(crate) fn vectors() -> Vec<Vector> {
    let rows = include_str!("../vectors.tsv").lines().filter(|line| !line.starts_with('#') && !line.is_empty());
    rows.map(|row| {
        let [framing, direction, command, bytes, _meaning, _source] =
            row.split('\t').collect::<Vec<_>>().try_into().unwrap_or_else(|_| panic!("six columns: {row}"));
        let sender = match direction {
            "request" => Side::Client,
            "reply" => Side::Plc,
            _ => panic!("neither request nor reply: {row}"),
        };
        let hex = |text| u8::from_str_radix(text, 16).expect(row);
        let bytes = bytes.split(' ').map(hex).collect();
        Vector { framing: framing.parse().expect(row), sender, command: hex(command), bytes, row }
    })
    .collect()
}

pub(crate) fn other_side(side: Side) -> Side {
    match side {
        Side::Client => Side::Plc,
        Side::Plc => Side::Client,
    }
}

/// A request and a reply that belongs to it, of any command.
pub(crate) trait Exchange: fmt::Debug {
    fn code(&self) -> Code;
    fn request(&self) -> Request;
    /// The frame of the request.
    fn encode_request(&self, framing: Framing, station: u8) -> Result<BytesMut, InvalidRequest>;
    /// The frame of the reply, or of the refusal.
    fn encode_reply(&self, framing: Framing, station: u8, refusal: Option<ErrorCode>) -> BytesMut;
    /// Whether the data is read as the very reply of this exchange.
    fn decode_reply(&self, framing: Framing, data: &[u8]) -> Result<bool, ReplyError>;
    /// The frame, from station 1, of the reply that the data is read as.
    fn reencode_reply(&self, framing: Framing, data: &[u8]) -> Result<BytesMut, ReplyError>;

    /// The data of the reply's frame, or of the refusal's.
    fn reply_data(&self, framing: Framing, refusal: Option<ErrorCode>) -> Vec<u8> {
        carried(framing, &self.encode_reply(framing, 1, refusal)).data.to_vec()
    }
}

pub(crate) type AnyExchange = Box<dyn Exchange>;

/// The exchange of this request and this reply.
pub(crate) fn exchange<C: Command>(request: C, reply: C::Reply, name: fn(C) -> Request) -> AnyExchange {
    Box::new(Pair { request, reply, name })
}

#[derive(Debug)]
struct Pair<C: Command> {
    request: C,
    reply: C::Reply,
    name: fn(C) -> Request,
}

impl<C: Command> Exchange for Pair<C> {
    fn code(&self) -> Code {
        C::CODE
    }

    fn request(&self) -> Request {
        (self.name)(self.request.clone())
    }

    fn encode_request(&self, framing: Framing, station: u8) -> Result<BytesMut, InvalidRequest> {
        let mut frame = BytesMut::new();
        let result = encode_request(&self.request, framing, station, &mut frame);
        assert!(result.is_ok() || frame.is_empty(), "a request that cannot be sent leaves nothing behind");
        result.map(|()| frame)
    }

    fn encode_reply(&self, framing: Framing, station: u8, refusal: Option<ErrorCode>) -> BytesMut {
        let mut frame = BytesMut::new();
        encode_reply(&self.request, refusal.map_or(Ok(&self.reply), Err), framing, station, &mut frame);
        frame
    }

    fn decode_reply(&self, framing: Framing, data: &[u8]) -> Result<bool, ReplyError> {
        decode_reply(&self.request, framing, data).map(|reply| reply == self.reply)
    }

    fn reencode_reply(&self, framing: Framing, data: &[u8]) -> Result<BytesMut, ReplyError> {
        let mut frame = BytesMut::new();
        let reply = decode_reply(&self.request, framing, data)?;
        encode_reply(&self.request, Ok(&reply), framing, 1, &mut frame);
        Ok(frame)
    }
}

/// Exchanges of every command that the framing has, one strategy a command (two for 46 and 47: 16 and 32 bits).
pub(crate) fn exchanges(framing: Framing) -> Vec<BoxedStrategy<AnyExchange>> {
    let status = any::<[u8; 3]>().prop_map(|raw| exchange(ReadStatus, BriefStatus::from_raw(raw), Request::ReadStatus));
    let plc = prop::sample::select(vec![ControlPlc::Stop, ControlPlc::Run])
        .prop_map(|request| exchange(request, (), Request::ControlPlc));
    let controls =
        [DiscreteControl::Disable, DiscreteControl::Enable, DiscreteControl::Set, DiscreteControl::Reset].to_vec();
    let control_discrete = (prop::sample::select(controls), discrete())
        .prop_map(|(control, e)| exchange(ControlDiscrete::new(control, e), (), Request::ControlDiscrete));
    let disabled = consecutive(discrete(), MAX_POINTS, any::<bool>()).prop_map(|(first, states)| {
        exchange(ReadDisabled::new(first, states.len()).unwrap(), states, Request::ReadDisabled)
    });
    let discretes = consecutive(discrete(), MAX_POINTS, any::<bool>()).prop_map(|(first, states)| {
        exchange(ReadDiscretes::new(first, states.len()).unwrap(), states, Request::ReadDiscretes)
    });
    let write_discretes = consecutive(discrete(), MAX_POINTS, any::<bool>())
        .prop_map(|(first, states)| exchange(WriteDiscretes::new(first, states).unwrap(), (), Request::WriteDiscretes));
    let mixed_read = mixed(MAX_MIXED_READ_UNITS).prop_map(|items| {
        let (elements, values): (Vec<_>, Vec<_>) = items.into_iter().unzip();
        exchange(ReadMixed::new(elements).unwrap(), values, Request::ReadMixed)
    });
    let mixed_write = mixed(MAX_MIXED_WRITE_UNITS)
        .prop_map(|items| exchange(WriteMixed::new(items).unwrap(), (), Request::WriteMixed));
    let loop_back = loop_back_data(framing)
        .prop_map(|data| exchange(LoopBack::new(Bytes::from(data)).unwrap(), (), Request::LoopBack));
    let detailed = vec(any::<u8>(), 28..=100).prop_map(|raw| {
        exchange(ReadDetailedStatus, DetailedStatus::from_raw(raw).unwrap(), Request::ReadDetailedStatus)
    });
    let mut all = vec![
        status.boxed(),
        plc.boxed(),
        control_discrete.boxed(),
        disabled.boxed(),
        discretes.boxed(),
        write_discretes.boxed(),
        read_registers(register(), MAX_UNITS, any::<u16>(), Request::ReadRegisters),
        read_registers(register32(), MAX_UNITS / 2, any::<u32>(), Request::ReadRegisters32),
        write_registers(register(), MAX_UNITS, any::<u16>(), Request::WriteRegisters),
        write_registers(register32(), MAX_UNITS / 2, any::<u32>(), Request::WriteRegisters32),
        mixed_read.boxed(),
        mixed_write.boxed(),
        loop_back.boxed(),
        detailed.boxed(),
    ];
    if framing == Framing::Ascii {
        let read_page = (any::<u16>(), page())
            .prop_map(|(n, page)| exchange(ReadProgramPage::new(n), page, Request::ReadProgramPage));
        let write_page = (any::<u16>(), page())
            .prop_map(|(n, page)| exchange(WriteProgramPage::new(n, page), (), Request::WriteProgramPage));
        all.extend([read_page.boxed(), write_page.boxed()]);
    }
    all
}

/// Runs a property with this many exchanges of every command in both framings, each command in its turn.
pub(crate) fn for_every_command(cases: u32, property: impl Fn(Framing, AnyExchange) -> Result<(), TestCaseError>) {
    for framing in FRAMINGS {
        for strategy in exchanges(framing) {
            let config = ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() };
            let mut runner = proptest::test_runner::TestRunner::new(config);
            if let Err(failure) = runner.run(&strategy, |exchange| property(framing, exchange)) {
                panic!("{framing}: {failure}");
            }
        }
    }
}

fn read_registers<E: RegisterElement>(
    first: impl Strategy<Value = E> + 'static,
    max: usize,
    value: impl Strategy<Value = E::Value> + Clone + 'static,
    name: fn(ReadRegisters<E>) -> Request,
) -> BoxedStrategy<AnyExchange> {
    consecutive(first, max, value)
        .prop_map(move |(e, values)| exchange(ReadRegisters::new(e, values.len()).unwrap(), values, name))
        .boxed()
}

fn write_registers<E: RegisterElement>(
    first: impl Strategy<Value = E> + 'static,
    max: usize,
    value: impl Strategy<Value = E::Value> + Clone + 'static,
    name: fn(WriteRegisters<E>) -> Request,
) -> BoxedStrategy<AnyExchange> {
    consecutive(first, max, value)
        .prop_map(move |(e, values)| exchange(WriteRegisters::new(e, values).unwrap(), (), name))
        .boxed()
}

/// A first element and up to `max` values of it and those behind it, as far as there are elements.
fn consecutive<E: Copy + fmt::Debug + Into<Element>, V: fmt::Debug>(
    first: impl Strategy<Value = E>,
    max: usize,
    value: impl Strategy<Value = V> + Clone,
) -> impl Strategy<Value = (E, Vec<V>)> {
    let count = prop_oneof![6 => 1..=max, 1 => Just(1), 2 => Just(max)];
    (first, count).prop_flat_map(move |(first, count)| {
        let symbol = first.into().symbol();
        let behind = usize::from((symbol.last_address() - first.into().address()) / symbol.step());
        (Just(first), vec(value.clone(), count.min(behind + 1)))
    })
}

fn mixed(max_units: usize) -> impl Strategy<Value = Vec<(Element, Value)>> {
    let any_element = prop_oneof![element(Width::Bit), element(Width::Word), element(Width::Double)];
    vec((any_element, any::<u32>()), 1..=max_units).prop_map(move |items| {
        let mut units = 0;
        let within = items.into_iter().take_while(|(e, _)| {
            units += e.width().units();
            units <= max_units
        });
        within.map(|(element, bits)| (element, value(element, bits))).collect()
    })
}

/// A value as wide as the element.
#[allow(clippy::cast_possible_truncation, reason = "the low bits are what is wanted")]
pub(crate) fn value(element: Element, bits: u32) -> Value {
    match element.width() {
        Width::Bit => Value::Bit(bits & 1 == 1),
        Width::Word => Value::Word(bits as u16),
        Width::Double => Value::Double(bits),
    }
}

fn loop_back_data(framing: Framing) -> BoxedStrategy<Vec<u8>> {
    match framing {
        Framing::Binary => vec(any::<u8>(), 0..=MAX_LOOP_BACK).boxed(),
        _ => vec(0x20_u8..=0x7E, 0..=MAX_LOOP_BACK).boxed(),
    }
}

fn page() -> impl Strategy<Value = ProgramPage> {
    vec(any::<u16>(), PAGE_WORDS).prop_map(|words| ProgramPage::new(words.try_into().unwrap()))
}

fn discrete() -> impl Strategy<Value = Discrete> {
    element(Width::Bit).prop_map(|e| e.try_into().unwrap())
}

fn register() -> impl Strategy<Value = Register> {
    element(Width::Word).prop_map(|e| e.try_into().unwrap())
}

fn register32() -> impl Strategy<Value = Register32> {
    element(Width::Double).prop_map(|e| e.try_into().unwrap())
}

/// Any element of this width; the first and the last of each symbol more often.
pub(crate) fn element(width: Width) -> impl Strategy<Value = Element> {
    let symbols: Vec<Symbol> = Symbol::ALL.iter().copied().filter(|s| s.width() == width).collect();
    prop::sample::select(symbols).prop_flat_map(|symbol| {
        let top = symbol.last_address() / symbol.alignment();
        prop_oneof![8 => 0..=top, 1 => Just(0), 1 => Just(top)]
            .prop_map(move |n| Element::new(symbol, n * symbol.alignment()).unwrap())
    })
}

/// A small seeded generator (SplitMix64): the same seed gives the same noise on every machine.
pub(crate) struct Rng(u64);

impl Rng {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number below `n`.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.next() % n as u64).unwrap()
    }

    pub(crate) fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }
}

/// Decodes the input, given in these pieces, until nothing is left.
pub(crate) fn decode<'a>(codec: &mut Codec, pieces: impl IntoIterator<Item = &'a [u8]>) -> Vec<Received> {
    decode_within(MAX_FRAME_LEN, codec, pieces)
}

/// The same with a codec of another limit. Panics where the buffer outgrows the limit.
pub(crate) fn decode_within<'a>(
    max_frame_len: usize,
    codec: &mut Codec,
    pieces: impl IntoIterator<Item = &'a [u8]>,
) -> Vec<Received> {
    let mut buffer = BytesMut::new();
    let mut items = Vec::new();
    for piece in pieces {
        buffer.extend_from_slice(piece);
        drain(codec, &mut buffer, &mut items);
        assert!(buffer.len() <= max_frame_len, "{} bytes wait, the limit is {max_frame_len}", buffer.len());
    }
    while let Some(item) = codec.decode_eof(&mut buffer).unwrap() {
        items.push(item);
    }
    assert!(buffer.is_empty(), "{} bytes are left at the end of the input", buffer.len());
    items
}

/// Takes all items that the buffer has at once.
pub(crate) fn drain(codec: &mut Codec, buffer: &mut BytesMut, items: &mut Vec<Received>) {
    while let Some(item) = codec.decode(buffer).unwrap() {
        items.push(item);
    }
}

pub(crate) fn frames(items: Vec<Received>) -> Vec<Frame> {
    items.into_iter().filter_map(Received::frame).collect()
}

/// Where the frames among the items stand in the input. Fails unless the items are the input: every byte once, in order.
pub(crate) fn places(framing: Framing, input: &[u8], items: &[Received]) -> Result<Vec<Range<usize>>, String> {
    let mut at = 0;
    let mut places = Vec::new();
    for item in items {
        let len = match item {
            Received::Discarded { bytes, .. } => bytes.len(),
            Received::Frame(frame) => frame.data.len() + overhead(framing),
            other => return Err(format!("unknown item {other:?}")),
        };
        let part = input.get(at..at + len).ok_or_else(|| format!("{item:?} at {at} is past the end of the input"))?;
        match item {
            Received::Frame(frame) if *frame == carried(framing, part) => places.push(at..at + len),
            Received::Discarded { bytes, .. } if !bytes.is_empty() && bytes == part => {}
            _ => return Err(format!("{item:?} at {at} is not what the input holds there")),
        }
        at += len;
    }
    if at == input.len() { Ok(places) } else { Err(format!("{} bytes of {} came out", at, input.len())) }
}

/// Where frames for this receiver stand in the input, by the book: from left to right, none inside another.
pub(crate) fn places_by_the_book(framing: Framing, receiver: Side, input: &[u8], max: usize) -> Vec<Range<usize>> {
    let mut places = Vec::new();
    let mut at = 0;
    while at < input.len() {
        let found = match framing {
            Framing::Binary => binary_frame(&input[at..], max),
            _ => ascii_frame(&input[at..], max),
        };
        if let Some(len) = found
            && (framing == Framing::Ascii || (input[at] == 0x52) == (receiver == Side::Client))
        {
            places.push(at..at + len);
        }
        at += found.unwrap_or(1);
    }
    places
}

fn ascii_frame(input: &[u8], max: usize) -> Option<usize> {
    let etx = 1 + input.get(1..)?.iter().position(|b| matches!(b, 2 | 3))?;
    let hex = |range: Range<usize>| std::str::from_utf8(input.get(range)?).ok().filter(|t| !t.contains('+'));
    let number = |range| u8::from_str_radix(hex(range)?, 16).ok();
    let good = input[0] == 2 && input[etx] == 3 && (8..=max).contains(&(etx + 1));
    let good = good && number(1..3).is_some() && number(3..5).is_some();
    (good && number(etx - 2..etx)? == lrc(&input[..etx - 2])).then_some(etx + 1)
}

fn binary_frame(input: &[u8], max: usize) -> Option<usize> {
    let &[0x51 | 0x52, 0x10, high, low, ..] = input else { return None };
    let len = usize::from(u16::from_be_bytes([high, low])) + 8;
    let frame = input.get(..len).filter(|_| (10..=max).contains(&len))?;
    (frame[len - 4..] == trailer(&frame[2..len - 4])).then_some(len)
}

/// The frame of this content, made without the codec. The sender matters in the binary framing only.
pub(crate) fn framed(framing: Framing, sender: Side, station: u8, command: u8, data: &[u8]) -> Vec<u8> {
    if framing == Framing::Ascii {
        let mut frame = format!("\x02{station:02X}{command:02X}").into_bytes();
        frame.extend(data);
        let tail = format!("{:02X}\x03", lrc(&frame));
        return [&frame, tail.as_bytes()].concat();
    }
    let header = if sender == Side::Client { 0x51 } else { 0x52 };
    let length = u16::try_from(data.len() + 2).unwrap().to_be_bytes();
    let covered = [&length[..], &[station, command], data].concat();
    [&[header, 0x10][..], &covered, &trailer(&covered)].concat()
}

/// What a well-formed frame carries.
pub(crate) fn carried(framing: Framing, bytes: &[u8]) -> Frame {
    if framing == Framing::Binary {
        let data = Bytes::copy_from_slice(&bytes[6..bytes.len() - 4]);
        return Frame { station: bytes[4], command: bytes[5], data };
    }
    let byte = |at: usize| u8::from_str_radix(std::str::from_utf8(&bytes[at..at + 2]).unwrap(), 16).unwrap();
    let data = Bytes::copy_from_slice(&bytes[5..bytes.len() - 3]);
    Frame { station: byte(1), command: byte(3), data }
}

/// All of a frame but its data.
pub(crate) fn overhead(framing: Framing) -> usize {
    if framing == Framing::Ascii { 8 } else { 10 }
}

fn lrc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |sum, byte| sum.wrapping_add(*byte))
}

/// CRC-16/MODBUS bit by bit, low byte first, and the terminator.
fn trailer(covered: &[u8]) -> [u8; 4] {
    let crc = covered.iter().fold(0xFFFF_u16, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    });
    let [low, high] = crc.to_le_bytes();
    [low, high, 0x55, 0xAA]
}
