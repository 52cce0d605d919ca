//! Helpers for the tests of frames and commands: exchanges of every command, random noise, and the
//! reference decoder.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![allow(dead_code, reason = "each test file uses a part of it")]

mod reference;
mod rng;

use std::fmt;

use bytes::{Bytes, BytesMut};
use fatek::command::*;
use fatek::wire::{Frame, Framing};
use fatek::{Discrete, Element, ErrorCode, Register, Register32, Symbol, Width};
use proptest::collection::vec;
use proptest::prelude::*;

#[allow(unused_imports, reason = "each test file uses a part of it")]
pub(crate) use reference::*;
#[allow(unused_imports, reason = "each test file uses a part of it")]
pub(crate) use rng::Rng;

pub(crate) const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// A request with a matching reply, of any command.
pub(crate) trait Exchange: fmt::Debug {
    fn code(&self) -> Code;
    fn request(&self) -> Request;
    /// Encodes the request.
    fn encode_request(&self, framing: Framing, station: u8) -> Result<BytesMut, InvalidRequest>;
    /// Encodes the reply, or the refusal.
    fn encode_reply(&self, framing: Framing, station: u8, refusal: Option<ErrorCode>) -> BytesMut;
    /// Returns whether the data decodes as exactly the reply of this exchange.
    fn decode_reply(&self, framing: Framing, data: &[u8]) -> Result<bool, ReplyError>;
    /// Decodes the data and encodes it again, as a reply of station 1.
    fn reencode_reply(&self, framing: Framing, data: &[u8]) -> Result<BytesMut, ReplyError>;

    /// The request as a frame.
    fn request_frame(&self, framing: Framing, station: u8) -> Result<Frame, InvalidRequest>;
    /// The reply, or the refusal, as a frame.
    fn reply_frame(&self, framing: Framing, station: u8, refusal: Option<ErrorCode>) -> Frame;
    /// Returns whether the frame decodes as exactly the reply of this exchange.
    fn decode_reply_frame(&self, framing: Framing, frame: &Frame) -> Result<bool, ReplyError>;
    /// The texts of request and reply.
    fn texts(&self) -> [String; 2];

    /// Data field of the reply or refusal.
    fn reply_data(&self, framing: Framing, refusal: Option<ErrorCode>) -> Vec<u8> {
        frame_content(framing, &self.encode_reply(framing, 1, refusal)).data.to_vec()
    }
}

pub(crate) type AnyExchange = Box<dyn Exchange>;

/// Pairs a request with its reply.
pub(crate) fn exchange<C: Command>(request: C, reply: C::Reply, name: fn(C) -> Request) -> AnyExchange {
    Box::new(TypedExchange { request, reply, name })
}

#[derive(Debug)]
struct TypedExchange<C: Command> {
    request: C,
    reply: C::Reply,
    name: fn(C) -> Request,
}

impl<C: Command> Exchange for TypedExchange<C> {
    fn code(&self) -> Code {
        C::CODE
    }

    fn request(&self) -> Request {
        (self.name)(self.request.clone())
    }

    fn encode_request(&self, framing: Framing, station: u8) -> Result<BytesMut, InvalidRequest> {
        let mut frame = BytesMut::new();
        let result = encode_request(&self.request, framing, station, &mut frame);
        assert!(result.is_ok() || frame.is_empty(), "a failed encoding leaves no partial frame");
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

    fn request_frame(&self, framing: Framing, station: u8) -> Result<Frame, InvalidRequest> {
        Frame::request(station, &self.request, framing)
    }

    fn reply_frame(&self, framing: Framing, station: u8, refusal: Option<ErrorCode>) -> Frame {
        Frame::reply(station, &self.request, refusal.map_or(Ok(&self.reply), Err), framing)
    }

    fn decode_reply_frame(&self, framing: Framing, frame: &Frame) -> Result<bool, ReplyError> {
        frame.decode_reply(&self.request, framing).map(|reply| reply == self.reply)
    }

    fn texts(&self) -> [String; 2] {
        struct Text<'a, C: Command>(&'a C::Reply);

        impl<C: Command> fmt::Display for Text<'_, C> {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                C::fmt_reply(self.0, f)
            }
        }
        [self.request.to_string(), Text::<C>(&self.reply).to_string()]
    }
}

/// Strategies for exchanges, one for each command of the framing (two for 46 and 47: 16 and 32
/// bits).
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

/// Runs a property with `cases` exchanges of every command in both framings.
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

/// A first element and up to `max` consecutive values; fewer at the end of the area.
fn consecutive<E: Copy + fmt::Debug + Into<Element>, V: fmt::Debug>(
    first: impl Strategy<Value = E>,
    max: usize,
    value: impl Strategy<Value = V> + Clone,
) -> impl Strategy<Value = (E, Vec<V>)> {
    let count = prop_oneof![6 => 1..=max, 1 => Just(1), 2 => Just(max)];
    (first, count).prop_flat_map(move |(element, count)| {
        let first: Element = element.into();
        let most = if first.is_counter_of_32_bits() { 1 } else { count };
        let exists = |&n: &usize| first.nth(n).is_ok_and(|element| element.check_in(Framing::Ascii).is_ok());
        (Just(element), vec(value.clone(), (0..most).take_while(exists).count()))
    })
}

fn mixed(max_units: usize) -> impl Strategy<Value = Vec<(Element, Value)>> {
    let any_element = prop_oneof![element(Width::Bit), element(Width::Word), element(Width::DWord)];
    vec((any_element, any::<u32>()), 1..=max_units).prop_map(move |items| {
        let mut units = 0;
        let within = items.into_iter().take_while(|(e, _)| {
            units += e.width().units();
            units <= max_units
        });
        within.map(|(element, bits)| (element, value(element, bits))).collect()
    })
}

/// A value of the element's width.
#[allow(clippy::cast_possible_truncation, reason = "takes the low bits")]
pub(crate) fn value(element: Element, bits: u32) -> Value {
    match element.width() {
        Width::Bit => Value::Bit(bits & 1 == 1),
        Width::Word => Value::Word(bits as u16),
        Width::DWord => Value::DWord(bits),
    }
}

fn loop_back_data(framing: Framing) -> BoxedStrategy<Vec<u8>> {
    // Short data is frequent: an echo of one byte has the shape of a refusal.
    let len = || prop_oneof![1 => 0..=2_usize, 3 => 0..=MAX_LOOP_BACK];
    match framing {
        Framing::Binary => len().prop_flat_map(|len| vec(any::<u8>(), len)).boxed(),
        _ => len().prop_flat_map(|len| vec(0x20_u8..=0x7E, len)).boxed(),
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
    element(Width::DWord).prop_map(|e| e.try_into().unwrap())
}

/// Any element of this width that both framings have; the first and last of each symbol are more
/// frequent.
pub(crate) fn element(width: Width) -> impl Strategy<Value = Element> {
    let symbols: Vec<Symbol> = Symbol::ALL.iter().copied().filter(|s| s.width() == width).collect();
    prop::sample::select(symbols).prop_flat_map(|symbol| {
        let top = symbol.last_address_in(Framing::Ascii) / symbol.alignment();
        prop_oneof![8 => 0..=top, 1 => Just(0), 1 => Just(top)]
            .prop_filter_map("half a counter", move |n| Element::new(symbol, n * symbol.alignment()).ok())
    })
}
